"""What a mapping of a calibration file says of K, P and places, in whatever words and shape.

Pixels have their centres at integers here. They count from the corner of the image in COLMAP and
Nerfstudio, and from 1 in MATLAB.

Call `matrices_of`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from torchcss.errors import CameraError
from torchcss.files import real_numbers, refusing
from torchcss.io.keypoints.words import first_of
from torchcss.joint_names import names_in

K_WORDS = names_in(
    "k matrix cameramatrix cammatrix camatrix mtx cammtx cameramtx kmatrix intrinsicmatrix "
    "intrinsicsmatrix m kmx intrinsic intrinsics cameraintrinsic cameraintrinsics "
    "cameraintrinsicmatrix calibrationmatrix"
)
"""What K is called (`torchcss.io.keypoints.words`); of these and those below the first counts."""

P_WORDS = names_in("p projectionmatrix pmatrix projmat projection proj")
"""What all numbers together are called."""

FOCAL_WORDS = names_in("focallength focal fc f")
_CENTRE_WORDS = names_in("principalpoint center centre cc c")

POSE_WORDS = names_in("extrinsic extrinsics extrinsicmatrix extrinsicsmatrix rt w2c worldtocamera")
"""What rotation and translation together are called."""

_PLACE_WORDS = {
    "rotation": names_in("r rotation rot rvec rotationmatrix rotationvector"),
    "translation": names_in("t translation tvec translationvector"),
}

_ONE_BY_ONE = (
    ("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"), ("mu", "mv", "u0", "v0"),
    ("gamma1", "gamma2", "u0", "v0"), ("fl_x", "fl_y", "cx", "cy"),
)  # fmt: skip
"""What the numbers of K are called where each has a name; the last are Nerfstudio's."""

_ROUNDING = 1e-3
"""Skew that is taken for rounding, in focal lengths."""


def matrices_of(values: Mapping[str, Any]) -> dict[str, Any]:
    """K, rotation and translation, the first three by name; None for what is not there."""
    words = {"K": K_WORDS, **_PLACE_WORDS}
    found = {name: as_lists(first_of(values, words[name])) for name in words}
    pose = square_matrix(first_of(values, POSE_WORDS), 4)
    if found["rotation"] is None and pose is not None:
        found |= {"rotation": pose[:3, :3].tolist(), "translation": pose[:3, 3].tolist()}
    if (K := square_matrix(found["K"], 3)) is not None:
        found["K"] = K.tolist()
    elif (numbers := _one_by_one(values)) is not None:
        found["K"] = numbers
    if (projection := projection_of(values)) is not None:
        parts = _parts_of(projection)
        # Of K with a column of zeros the place is not known.
        found |= parts if projection[:, 3].any() else {"K": parts["K"]}
    return found


def has_camera(values: object) -> bool:
    """Whether a mapping holds a camera's numbers, by whatever words, itself or one level below."""
    if not isinstance(values, Mapping):
        return False
    K = first_of(values, (*K_WORDS, "projectionparameters", "mappingcoefficients"))
    if isinstance(K, Mapping) and "data" not in K:
        return has_camera(K)
    return any(each is not None for each in (K, projection_of(values), _one_by_one(values)))


def projection_of(values: Mapping[str, Any]) -> np.ndarray | None:
    """The 3 x 4 matrix that projects points of the world; None: there is none, or K beside it."""
    given = first_of(values, K_WORDS)
    matrix = square_matrix(first_of(values, P_WORDS) if given is None else given, 4)
    return None if matrix is None else matrix[:3]


def as_lists(value: Any) -> Any:
    """A matrix as OpenCV's JSON and ROS have it, as lists; anything else as it is."""
    if isinstance(value, dict) and isinstance(value.get("data"), list):
        rows, columns = value.get("rows"), value.get("cols")
        data = value["data"]
        if isinstance(rows, int) and isinstance(columns, int) and rows * columns == len(data):
            return [data[i : i + columns] for i in range(0, len(data), columns)] if columns else []
        if rows is None and columns is None:
            return data
    return value


def nested_shape(value: Any) -> tuple[int, ...]:
    """The shape of nested lists; none of what is no array."""
    with suppress(ValueError):
        return np.shape(value)
    return ()


def square_matrix(value: Any, size: int) -> np.ndarray | None:
    """A square matrix given by rows or by columns, or by rows without the last; None: it is none.

    Its last row is 0, ..., 0, 1.
    """
    with suppress(CameraError):
        numbers = real_numbers(as_lists(value), "", CameraError).ravel()
        if (numbers.size, size) == (12, 4):
            return np.vstack([numbers.reshape(3, 4), [0, 0, 0, 1]])
        if numbers.size == size * size:
            matrix = numbers.reshape(size, size)
            by_columns = matrix[-1, :-1].any() and not matrix[:-1, -1].any()
            return matrix.T if by_columns else matrix
    return None


def counted_from_one(K: Any) -> list[Any]:
    """MATLAB's intrinsic matrix, or fx, fy, cx, cy, with pixels that count from 0.

    Raises:
        CameraError: If it is neither.
    """
    with refusing(CameraError, "expected cameraParams"):
        K = real_numbers(K, "K", CameraError)
        K = K - (0, 0, 1, 1) if K.shape == (4,) else K - [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    return K.tolist()


def _counted_from_corner(numbers: Sequence[Any]) -> list[Any]:
    """fx, fy, cx, cy of pixels that are squares from (0, 0) on, as of such with integer centres."""
    try:
        fx, fy, cx, cy = map(float, numbers)
    except (TypeError, ValueError):
        return list(numbers)  # what is no number is told where the camera is made
    return [fx, fy, cx - 0.5, cy - 0.5]


def _one_by_one(values: Mapping[str, Any]) -> list[Any] | None:
    """fx, fy, cx, cy where each has a name, or focal lengths and principal point have."""
    for names in _ONE_BY_ONE:
        if None not in (numbers := [values.get(each) for each in names]):
            return _counted_from_corner(numbers) if names[0] == "fl_x" else numbers
    focal, centre = (as_lists(first_of(values, words)) for words in (FOCAL_WORDS, _CENTRE_WORDS))
    if isinstance(focal, (int, float)):
        focal = [focal, focal]
    given = isinstance(focal, list) and isinstance(centre, list)
    return [*focal, *centre] if given and len(focal) == len(centre) == 2 else None


def _parts_of(projection: np.ndarray) -> dict[str, Any]:
    """K, rotation and translation of a 3 x 4 matrix that projects points of the world."""
    with refusing(CameraError, "not a camera's projection matrix"), np.errstate(all="ignore"):
        projection = projection * np.sign(np.linalg.det(projection[:, :3]))
        turn, inverse = np.linalg.qr(np.linalg.inv(projection[:, :3]))
        signs = np.diag(np.sign(np.diag(inverse)))
        inverse = signs @ inverse
        K = np.triu(np.linalg.inv(inverse))
        K /= K[2, 2]
        if abs(K[0, 1]) < _ROUNDING * K[0, 0]:
            K[0, 1] = 0
        parts = {"K": K, "rotation": (turn @ signs).T, "translation": inverse @ projection[:, 3]}
    return {name: part.tolist() for name, part in parts.items()}
