"""A body on the world's origin, and posed on bases that differ from item to item.

A track says for each frame where the base of its body is; the body itself lies on the origin.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.kinematics import TreePose
from torchcss.body.model import BodyModel, BodyPose
from torchcss.linalg import multiply
from torchcss.types import Vectors


def on_origin(body: BodyModel) -> BodyModel:
    """The same body on the world's origin, float64 on the processor; the given one stays."""
    return body.with_base(torch.eye(3), torch.zeros(3)).to(dtype=torch.float64, device="cpu")


def pose_track(body: BodyModel, state: Vectors, base: Float[Tensor, "*batch 4 4"]) -> BodyPose:
    """Pose a body on a base of its own in every item.

    Args:
        body: A body on the origin, as that of a `Track` is.
        state: States.
        base: Base transforms, in any frame.

    Returns:
        The poses in the frame of the base transforms.
    """
    pose = body.pose(state)
    turn, shift = base[..., None, :3, :3], base[..., None, :3, 3]
    omega = multiply(turn, pose.tree.omega)
    velocity = multiply(turn, pose.tree.velocity)
    tree = TreePose(
        turn @ pose.tree.rotation,
        multiply(turn, pose.tree.translation) + shift,
        omega,
        # The twist is taken at the origin, which moved away from the base by -shift.
        velocity + torch.linalg.cross(shift.expand_as(omega), omega),
    )
    return BodyPose(state, tree, multiply(turn, pose.joints) + shift)
