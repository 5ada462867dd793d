"""The six root parameters and the base transform they hang on (decision "root").

The root is three prismatic joints and yaw, pitch, roll (rotations about y, x, z, in that order) on
a base transform. The base is set when tracking starts and moved when the pitch nears a right angle,
so that the angles never lock; means and covariances are mapped along. Call `move_base` for that.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.chain import offset_matrix
from torchcss.body.model import BodyModel
from torchcss.body.rotations import root_angles, root_rotation
from torchcss.types import Bounds, Matrices, Vector, Vectors

ROOT_NAMES = ("root_x", "root_y", "root_z", "root_yaw", "root_pitch", "root_roll")


def has_root(body: BodyModel) -> bool:
    """Whether the body has the six root parameters."""
    return set(ROOT_NAMES) <= set(body.state_names)


def unwound(body: BodyModel, x: Vectors) -> Vectors:
    """The same poses without whole turns of joints, as far as limits let them.

    The angles of a free root stay as they are.

    Args:
        body: The body.
        x: States, radians and metres.
    """
    less = x - 2 * math.pi * (x / (2 * math.pi)).round()
    fits = body.comes_round & (less >= body.lower) & (less <= body.upper)
    joints = torch.tensor([name not in ROOT_NAMES for name in body.state_names], device=x.device)
    return torch.where(fits & joints, less, x)


def free_turns(body: BodyModel) -> Bounds:
    """The body's limits, but none on a root's yaw and roll, which wind up over a long motion."""
    lower, upper = body.lower.clone(), body.upper.clone()
    if has_root(body):
        turns = body.state_columns(("root_yaw", "root_roll"))
        lower[turns], upper[turns] = -math.inf, math.inf
    return Bounds(lower, upper)


def root_pose(
    body: BodyModel, x: Vectors
) -> tuple[Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """World pose of the root link."""
    index = body.state_columns(ROOT_NAMES)
    root = x[..., index]
    rotation = body.base_rotation @ root_rotation(root[..., 3:])
    return rotation, root[..., :3] @ body.base_rotation.T + body.base_translation


def base_without_root(
    rooted: BodyModel, fixed: BodyModel, x: Vector
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Base on which a body without a root stands where it stands with one.

    A body of a file hangs on its root turned to Y up, and by the place of its first link.

    Args:
        rooted: The body with root parameters.
        fixed: The same body without.
        x: State of the first one.
    """
    rotation, translation = root_pose(rooted, x)
    hung, own = (
        next(joint for joint in body.tree.specifications if joint.link == fixed.tree.link_names[0])
        for body in (rooted, fixed)
    )
    offset = torch.from_numpy(offset_matrix(hung) @ np.linalg.inv(offset_matrix(own))).to(x)
    return rotation @ offset[:3, :3], translation + rotation @ offset[:3, 3]


def move_base(
    body: BodyModel,
    rotation: Float[Tensor, "3 3"],
    translation: Float[Tensor, "3"],
    x: Vectors,
    covariance: Matrices | None = None,
) -> tuple[BodyModel, Vectors, Matrices | None]:
    """Hang the body on another base without moving it.

    Args:
        body: A body with root parameters.
        rotation: Orientation of the new base in the world.
        translation: Its origin in the world, metres.
        x: States on the old base.
        covariance: Their covariances. On the new base no item may have a pitch of exactly a right
            angle, where its covariance is not finite; choose a base near the body.

    Returns:
        The body on the new base, and the states and covariances in its parameters.
    """
    index = body.state_columns(ROOT_NAMES)
    turn = rotation.T @ body.base_rotation
    shift = (body.base_translation - translation) @ rotation

    def mapped(root: Tensor) -> Tensor:
        angles = root_angles(turn @ root_rotation(root[..., 3:]))
        return torch.cat([root[..., :3] @ turn.T + shift, angles], dim=-1)

    moved = x.clone()
    moved[..., index] = mapped(x[..., index])
    if covariance is not None and covariance.numel():
        root, size = x[..., index], x.shape[-1]
        # The derivative in a step that all items share is that of every item in its own. (The
        # forward-mode transforms of torch.func import the compiler: seconds, for a 6 x 6 matrix.)
        jacobian = torch.autograd.functional.jacobian(
            lambda step: mapped(root + step), root.new_zeros(6)
        )
        full = torch.eye(size, dtype=x.dtype, device=x.device).repeat(*x.shape[:-1], 1, 1)
        rows = torch.tensor(index, device=x.device)
        full[..., rows[:, None], rows] = jacobian
        covariance = full @ covariance @ full.mT
    return body.with_base(rotation, translation), moved, covariance
