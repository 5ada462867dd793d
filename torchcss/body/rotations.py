"""Rotation matrices, and the angles and vectors that stand for them.

| call | for |
|---|---|
| `about`, `about_fixed_axes` | turns about coordinate axes: URDF, BVH, Acclaim |
| `euler_angles` | angles in any order, continuous over frames: BVH, MOT |
| `axis_angle`, `from_axis_angle` | rotation vectors: SMPL, OpenCV |
| `quaternions`, `from_quaternion` | quaternions: skins, viewer, MJCF |
| `root_rotation`, `root_angles` | yaw, pitch, roll of a body's root, as tensors |
| `within_half_turn` | angles that differ by whole turns |
| `check_rotation` | matrices that users give |
| `frame_along` | a frame whose z axis has a direction |
| `frame_at` | a rotation and a place in one matrix |
| `as_vector`, `as_rows` | plain numbers, as specifications hold them |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import ArrayLike
from torch import Tensor

from torchcss.errors import ConfigurationError, check_floating, check_shape
from torchcss.types import Numbers

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Matrix = Float[np.ndarray, "3 3"]

Vector3 = tuple[float, float, float]

ROUNDING = 1e-4
"""What is rounding in a rotation that was written down, in the entries of `R R^T`."""

ROTATION_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


def about(axis: int, angle: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation about one coordinate axis (0, 1, 2), radians, right-handed."""
    angle = np.asarray(angle, dtype=np.float64)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((*angle.shape, 3, 3))
    matrix[..., axis, axis] = 1.0
    matrix[..., j, j] = matrix[..., k, k] = np.cos(angle)
    matrix[..., k, j] = np.sin(angle)
    matrix[..., j, k] = -np.sin(angle)
    return matrix


def about_fixed_axes(angles: Sequence[float], order: str) -> Matrix:
    """Turns about fixed axes one after the other, in the order of the letters, radians."""
    matrix = np.eye(3)
    for angle, letter in zip(angles, order, strict=True):
        matrix = about("XYZ".index(letter), np.array(angle)) @ matrix
    return matrix


def from_axis_angle(vector: Float[np.ndarray, "3"]) -> Matrix:
    """Rotation about a vector by its length in radians (Rodrigues' formula)."""
    x, y, z = vector
    angle = float(np.linalg.norm(vector))
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # sin(a) / a and (1 - cos(a)) / a^2, both regular at zero.
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.eye(3) + first * cross + second * (cross @ cross)


def from_quaternion(quaternion: Float[np.ndarray, "4"]) -> Matrix:
    """Rotation of a unit quaternion, scalar first."""
    vector = quaternion[1:]
    length = float(np.linalg.norm(vector))
    angle = 2 * math.atan2(length, quaternion[0])
    return from_axis_angle(vector * (angle / length if length else 0.0))


def check_rotation(name: str, matrix: Float[Tensor, "3 3"]) -> None:
    """Check that a matrix is a rotation, to `ROUNDING`.

    Args:
        name: How the caller calls it, for the message.
        matrix: The matrix.

    Raises:
        ShapeError: If it is not 3 x 3, or of whole numbers.
        ConfigurationError: If it is no rotation.
    """
    check_shape(name, matrix, 3, 3)
    check_floating(name, matrix)
    error = float((matrix @ matrix.mT - torch.eye(3).to(matrix)).abs().max())
    if not error < ROUNDING or float(torch.linalg.det(matrix)) < 0:
        raise ConfigurationError(
            f"{name}: expected a rotation, got a matrix whose R R^T differs from the identity by "
            f"{error:.2g} and whose determinant is {float(torch.linalg.det(matrix)):.4g}"
        )


def frame_along(
    direction: Sequence[float] | np.ndarray, side: Float[np.ndarray, "3"] | None = None
) -> Matrix:
    """A rotation whose third column is a direction, and whose first one is nearest to `side`."""
    z = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    if side is None:
        x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    else:
        x = side - z * (side @ z)
        if np.linalg.norm(x) < 1e-6 * np.linalg.norm(side):
            return frame_along(direction)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def euler_angles(
    rotation: Float[np.ndarray, "t *nodes 3 3"], order: str
) -> Float[np.ndarray, "t *nodes 3"]:
    """Angles a, b, c with `R = R_i(a) R_j(b) R_k(c)` for the order "IJK", radians.

    The axes turn with the body (intrinsic), as in BVH. From frame to frame the angles are
    continuous: of the two triples that give a rotation, and of their whole turns, each frame has
    the nearest to the frame before. Where only a sum of a and c is determined (b a right angle), c
    stays what it was.

    Args:
        rotation: Rotations, frame by frame.
        order: A member of `ROTATION_ORDERS`.
    """
    i, j, k = ("XYZ".index(letter) for letter in order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    level = np.hypot(rotation[..., i, i], rotation[..., i, j])  # |cos b|
    middle = np.arctan2(sign * rotation[..., i, k], level)
    last = np.arctan2(-sign * rotation[..., i, j], rotation[..., i, i])
    angles = np.zeros((*rotation.shape[:-2], 3))
    before = np.zeros(angles.shape[1:])
    for t in range(len(rotation)):
        c = np.where(level[t] > 1e-9, last[t], before[..., 2])
        # R_k(-c) taken off from the right leaves R_i(a) R_j(b), whose column j shows a alone.
        column = (
            np.cos(c)[..., None] * rotation[t, ..., :, j]
            + sign * np.sin(c)[..., None] * rotation[t, ..., :, i]
        )
        a = np.arctan2(sign * column[..., k], column[..., j])
        one = np.stack([a, middle[t], c], axis=-1)
        other = np.stack([a + np.pi, np.pi - middle[t], c + np.pi], axis=-1)
        near = [
            before + np.remainder(triple - before + np.pi, 2 * np.pi) - np.pi
            for triple in (one, other)
        ]
        far = [np.abs(triple - before).sum(-1, keepdims=True) for triple in near]
        # The first frame keeps the usual range, however far from zero.
        use_one = far[0] <= far[1] if t else np.ones_like(far[0], dtype=bool)
        before = angles[t] = np.where(use_one, near[0], near[1])
    return angles


def axis_angle(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Rotation vectors: the axis times the angle in [0, pi], radians."""
    return _of_scipy(rotation).as_rotvec().reshape(rotation.shape[:-1])


def quaternions(rotation: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions (w, x, y, z); of the two that are one rotation any."""
    quaternion = np.roll(_of_scipy(rotation).as_quat(), 1, axis=-1)
    return quaternion.reshape(*rotation.shape[:-2], 4)


def _of_scipy(rotation: Float[np.ndarray, "*batch 3 3"]) -> Rotation:
    """Rotations in a row, as SciPy has them."""
    from scipy.spatial.transform import Rotation  # takes a second to import

    return Rotation.from_matrix(rotation.reshape(-1, 3, 3))


def within_half_turn(angle: Numbers) -> Numbers:
    """The same angles, from minus half a turn to half a turn, radians."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def root_rotation(angles: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of yaw, pitch and roll (radians)."""
    a, b, c = angles.unbind(-1)
    zero, one = torch.zeros_like(a), torch.ones_like(a)

    def matrix(*entries: Tensor) -> Tensor:
        return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))

    yaw = matrix(a.cos(), zero, a.sin(), zero, one, zero, -a.sin(), zero, a.cos())
    pitch = matrix(one, zero, zero, zero, b.cos(), -b.sin(), zero, b.sin(), b.cos())
    roll = matrix(c.cos(), -c.sin(), zero, c.sin(), c.cos(), zero, zero, zero, one)
    return yaw @ pitch @ roll


def root_angles(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Yaw, pitch and roll of a rotation; pitch lies in [-pi/2, pi/2].

    At a pitch of a right angle only the sum or difference of yaw and roll is determined: the angles
    returned still give the rotation, but their derivatives are not finite.
    """
    yaw = torch.atan2(rotation[..., 0, 2], rotation[..., 2, 2])
    pitch = torch.asin((-rotation[..., 1, 2]).clamp(-1, 1))
    roll = torch.atan2(rotation[..., 1, 0], rotation[..., 1, 1])
    return torch.stack([yaw, pitch, roll], dim=-1)


def frame_at(rotation: ArrayLike, place: ArrayLike) -> Float[np.ndarray, "4 4"]:
    """A rotation and a place in one matrix."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, place
    return pose


def as_vector(values: Float[np.ndarray, "3"]) -> Vector3:
    """Three numbers, as specifications hold them."""
    x, y, z = values.tolist()
    return x, y, z


def as_rows(matrix: Matrix) -> tuple[Vector3, Vector3, Vector3]:
    """The rows of a rotation, as specifications hold them."""
    a, b, c = matrix
    return as_vector(a), as_vector(b), as_vector(c)
