"""From derivatives at 3D points to gradient and exact Hessian in the joints, in closed form.

A term of the cost hands over, for every surface point p, its gradient g (3) and Hessian A (3 x 3)
with respect to p. With `dp/dq_j = omega_j x p + v_j` for every joint j above the point, sums over
the points below each joint are all that is needed:

- wrench: `tau = sum p x g`, `f = sum g`;
- stiffness: `K = sum B^T A B` with `B = [-[p]x, I]`;
- moment: `P = sum p g^T`.

With `S_j = (omega_j, v_j)` and i an ancestor of j or j itself,

    gradient_j  = S_j . (tau, f)_j
    hessian_ij = S_i^T K_j S_j + omega_i . (P_j omega_j - tr(P_j) omega_j + v_j x f_j)

and zero between branches. The first term is the Gauss-Newton form of eq. 9 [RR]; the second is the
curvature of the kinematics. The work over points does not depend on the number of joints. Call
`lift_to_joints`; `BodyModel.lift` adds the state layout on top.

`point_moments` and `reactions` are its two halves, for sums over other points than those below a
joint: pairs of parts that move against each other (`torchcss.cost.interpenetration`). `wrench`
serves parameters that deform the points (`torchcss.body.shape`).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.kinematics import KinematicTree, TreePose
from torchcss.types import LocalModel, Numbers, PointCost


def lift_to_joints(
    tree: KinematicTree,
    pose: TreePose,
    points: Float[Tensor, "*batch p 3"],
    point_link: Int[Tensor, " p"],
    cost: PointCost,
    *,
    second_order_kinematics: bool | Numbers = True,
) -> LocalModel:
    """Sum a cost over points and differentiate it with respect to the joint values.

    Args:
        tree: The tree.
        pose: Its poses and twists at the state where the cost was evaluated.
        points: World positions of the points, metres.
        point_link: The link that carries each point.
        cost: Value, gradient and Hessian of each point's cost in its world position.
        second_order_kinematics: False leaves the curvature of the kinematics out (eq. 9 [RR]); a
            tensor scales it item by item.

    Returns:
        The cost summed over points, its gradient and its Hessian in the joints.
    """
    batch, num_points, num_joints = points.shape[:-2], points.shape[-2], pose.omega.shape[-2]
    # Any fixed reference point will do; one near the body avoids cancellation.
    reference = pose.translation[..., :1, :]
    velocity = pose.velocity + torch.linalg.cross(pose.omega, reference.expand_as(pose.omega))
    # The batch is innermost in memory: nothing is copied where it is laid out like that already.
    moments = point_moments(
        _components(points - reference),
        _components(cost.gradient),
        _components(cost.hessian.flatten(-2)),
    )
    features = torch.stack(moments, dim=1).flatten(1)
    below = tree.ancestors.to(features)
    if num_points > num_joints:  # fewer products by way of the links
        by_link = features.new_zeros(below.shape[1], features.shape[1])
        features = by_link.index_add_(0, point_link, features)
    else:
        below = below[:, point_link]
    per_joint = (below @ features).unflatten(1, (33, batch.numel()))

    twist = (*_components(pose.omega), *_components(velocity))
    if isinstance(second_order_kinematics, Tensor):
        second_order_kinematics = second_order_kinematics.reshape(batch.numel())
    gradient, reaction = reactions(per_joint.unbind(1), twist, second_order_kinematics)
    left = torch.stack(twist).permute(2, 1, 0).contiguous()
    right = torch.stack(reaction).permute(2, 0, 1).contiguous()
    # Every pair of joints on a branch once, the diagonal twice by half.
    half_diagonal = tree.joint_ancestors.to(left)
    half_diagonal.diagonal().fill_(0.5)
    upper = (left @ right).mul_(half_diagonal)
    hessian = upper + upper.mT
    return LocalModel(
        cost.value.sum(-1),
        gradient.T.reshape(*batch, num_joints),
        hessian.reshape(*batch, num_joints, num_joints),
    )


def point_moments(
    point: Sequence[Tensor], force: Sequence[Tensor], hessian: Sequence[Tensor]
) -> list[Tensor]:
    """What the lift sums over points: K, P and f, of which 33 numbers are enough.

    Components are whole tensors: on a CPU this is many times faster than 3 x 3 products.

    Args:
        point: The three components of positions.
        force: Those of the costs' gradients.
        hessian: The nine of the costs' Hessians, row by row.
    """
    axx, axy, axz, _, ayy, ayz, _, _, azz = hessian
    # mixed = [p]x A and angular = [p]x A [p]x^T, of which the upper triangle is enough.
    columns = [
        _cross(point, column) for column in ((axx, axy, axz), (axy, ayy, ayz), (axz, ayz, azz))
    ]
    rows = tuple(zip(*columns, strict=True))
    angular = [_cross(point, row) for row in rows]
    mixed = [entry for row in rows for entry in row]
    angular = [angular[i][j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    moment = [p * f for p in point for f in force]
    return [axx, axy, axz, ayy, ayz, azz, *mixed, *angular, *moment, *force]


def reactions(
    sums: Sequence[Tensor], twist: Sequence[Tensor], second_order_kinematics: bool | Tensor = True
) -> tuple[Tensor, list[Tensor]]:
    """How the points below joints react to their twists.

    Args:
        sums: `point_moments`, summed over the points below each joint.
        twist: The six components of the joints' twists, about the same point and in the same axes.
        second_order_kinematics: As in `lift_to_joints`.

    Returns:
        The gradient in the joints, and the six components of what the twist of another joint is
        multiplied by for the Hessian.
    """
    (sxx, sxy, sxz, syy, syz, szz,
     mxx, mxy, mxz, myx, myy, myz, mzx, mzy, mzz,
     kxx, kxy, kxz, kyy, kyz, kzz,
     pxx, pxy, pxz, pyx, pyy, pyz, pzx, pzy, pzz,
     fx, fy, fz) = sums  # fmt: skip
    wx, wy, wz, vx, vy, vz = twist
    # Torque and force are the six components of the wrench; so are the reactions to a twist.
    gradient = _dot(twist, (pyz - pzy, pzx - pxz, pxy - pyx, fx, fy, fz))
    turning = [
        _dot((kxx, kxy, kxz, mxx, mxy, mxz), twist),
        _dot((kxy, kyy, kyz, myx, myy, myz), twist),
        _dot((kxz, kyz, kzz, mzx, mzy, mzz), twist),
    ]
    shifting = [
        _dot((mxx, myx, mzx, sxx, sxy, sxz), twist),
        _dot((mxy, myy, mzy, sxy, syy, syz), twist),
        _dot((mxz, myz, mzz, sxz, syz, szz), twist),
    ]
    if second_order_kinematics is False:
        return gradient, turning + shifting
    curvature = [
        _dot((pxy, pxz, -pyy - pzz, fz, -fy), (wy, wz, wx, vy, vz)),
        _dot((pyx, pyz, -pxx - pzz, fx, -fz), (wx, wz, wy, vz, vx)),
        _dot((pzx, pzy, -pxx - pyy, fy, -fx), (wx, wy, wz, vx, vy)),
    ]
    if isinstance(second_order_kinematics, Tensor):
        share = second_order_kinematics
        turning = [torch.addcmul(a, share, b) for a, b in zip(turning, curvature, strict=True)]
    else:
        turning = [a + b for a, b in zip(turning, curvature, strict=True)]
    return gradient, turning + shifting


def wrench(
    points: Float[Tensor, "p 3 c"], force: Float[Tensor, "p 3 c"], *, couple: bool = False
) -> Float[Tensor, "p 6 c"]:
    """Torque and force (tau, f) of columns of forces at points; of couples the torque alone."""
    torque = torch.linalg.cross(points, force, dim=-2)
    return torch.cat([torque, torch.zeros_like(force) if couple else force], dim=-2)


def _components(vectors: Float[Tensor, "*batch m c"]) -> tuple[Float[Tensor, "m b"], ...]:
    """Each component of some vectors, the batch flattened and innermost in memory."""
    last = vectors.reshape(vectors.shape[:-2].numel(), *vectors.shape[-2:]).permute(2, 1, 0)
    return last.contiguous().unbind()


def _dot(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    """Sum of products, each added as it is made."""
    total = a[0] * b[0]
    for left, right in zip(a[1:], b[1:], strict=True):
        total.addcmul_(left, right)
    return total


def _cross(a: Sequence[Tensor], b: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Cross product of vectors given by their components."""
    x, y, z = a
    u, v, w = b
    return (
        (y * w).addcmul_(z, v, value=-1),
        (z * u).addcmul_(x, w, value=-1),
        (x * v).addcmul_(y, u, value=-1),
    )
