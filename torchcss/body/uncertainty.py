"""How sure the joints are in space: covariances of positions from the covariance of a state.

A joint centre p moves with the state as `dp = J dx`; a state of covariance S leaves it the
covariance `J S J^T` to first order. The Jacobian is read off the twists of the tree: a joint of
the tree that carries p moves it with `omega x p + v`.

What one camera does not show, the size of the body and its distance, is held while a body is
tracked, and is in no state's covariance. `Held` says how little is known of it, and moves the
joints by their sensitivity: a body that is larger by a share s and farther by the same share looks
the same, and so does one that is farther by a share f before a lens that is longer by it.

Call `joint_covariance`; `point_jacobian` gives J alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.kinematics import TreePose
from torchcss.body.model import BodyModel, BodyPose
from torchcss.errors import check_shape
from torchcss.types import Matrices


class Held(NamedTuple):
    """How well size and focal length are known, which tracking holds and one camera does not show.

    Attributes:
        size: Standard deviation of the logarithm of the body's size.
        focal: The same of the camera's focal length.
        eye: The camera's centre, world, metres.
        axis: The direction in which it looks, a unit vector.
    """

    size: float
    focal: float
    eye: Float[Tensor, "3"]
    axis: Float[Tensor, "3"]

    def turned(self, turn: Float[Tensor, "3 3"]) -> Held:
        """The same in another frame of reference with the same origin."""
        return self._replace(eye=turn @ self.eye, axis=turn @ self.axis)

    def covariance(
        self, joints: Float[Tensor, "*batch j 3"], about: Sequence[int] = ()
    ) -> Float[Tensor, "*batch j 3 3"]:
        """What it adds to the covariances of places; see `joint_covariance`."""
        eye, axis = self.eye.to(joints), self.axis.to(joints)
        origin = joints[..., list(about), :].mean(-2, keepdim=True) if about else eye
        moved = self.size * (joints - origin)
        found = moved[..., :, None] * moved[..., None, :]
        if about:
            return found
        depth = ((joints.mean(-2) - eye) @ axis)[..., None, None, None]
        return found + (self.focal * depth).square() * torch.outer(axis, axis)


def point_jacobian(
    body: BodyModel, tree: TreePose, points: Float[Tensor, "*batch p 3"], link: Int[Tensor, " p"]
) -> Float[Tensor, "*batch p 3 n"]:
    """Derivatives of points in the state, metres per radian or metre.

    Args:
        body: The body.
        tree: Its twists.
        points: Points that links carry, metres.
        link: The link of each.
    """
    swept = torch.linalg.cross(tree.omega[..., None, :, :], points[..., :, None, :])
    moved = swept + tree.velocity[..., None, :, :]
    carries = body.tree.ancestors[:, link].T
    return torch.where(carries[..., None], moved, 0.0).mT @ body.tie


def joint_covariance(
    body: BodyModel,
    pose: BodyPose,
    covariance: Matrices,
    *,
    about: Sequence[int] = (),
    held: Held | None = None,
) -> Float[Tensor, "*batch j 3 3"]:
    """Covariances of the joint centres, square metres, to first order.

    It is a good account of the spread as long as the state's deviations turn the limbs by well
    under a radian; a limb that may swing further spreads along an arc, which no ellipsoid is.

    Args:
        body: The body.
        pose: What `body.pose` gave for the means.
        covariance: Covariances of the states.
        about: Joints from whose middle the places of all are told, such as the hips: where the
            whole body is then does not count. Empty: places in the world.
        held: What the state does not hold and is not known either; None: all is known.

    Raises:
        ShapeError: If the covariance has another size than the state.
    """
    check_shape("covariance", covariance, body.num_parameters, body.num_parameters)
    jacobian = point_jacobian(body, pose.tree, pose.joints, body.marker_link)
    if about:
        jacobian = jacobian - jacobian[..., list(about), :, :].mean(-3, keepdim=True)
    found = jacobian @ covariance[..., None, :, :] @ jacobian.mT
    return found if held is None else found + held.covariance(pose.joints, about)
