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
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.body.kinematics import TreePose
from torchcss.types import LocalModel, PointCost


def lift_to_joints(
    pose: TreePose,
    ancestors: Bool[Tensor, "q l"],
    joint_ancestors: Bool[Tensor, "q q"],
    points: Float[Tensor, "*batch p 3"],
    point_link: Int[Tensor, " p"],
    cost: PointCost,
    *,
    second_order_kinematics: bool | Float[Tensor, "*batch"] = True,
) -> LocalModel:
    """Sum a cost over points and differentiate it with respect to the joint values.

    Args:
        pose: Poses and twists of the tree at the state where the cost was evaluated.
        ancestors: True where a joint moves a link.
        joint_ancestors: True at (i, j) where joint i moves joint j or i is j.
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
    # Components as whole tensors with the batch innermost: on a CPU this is many times faster than
    # 3 x 3 products, and nothing is copied where the memory is laid out like that already.
    x, y, z = _components(points - reference)
    fx, fy, fz = _components(cost.gradient)
    axx, axy, axz, _, ayy, ayz, _, _, azz = _components(cost.hessian.flatten(-2))
    # mixed = [p]x A and angular = [p]x A [p]x^T, of which the upper triangle is enough.
    point, force = (x, y, z), (fx, fy, fz)
    columns = [
        _cross(point, column) for column in ((axx, axy, axz), (axy, ayy, ayz), (axz, ayz, azz))
    ]
    rows = tuple(zip(*columns, strict=True))
    angular = [_cross(point, row) for row in rows]
    mixed = [entry for row in rows for entry in row]
    angular = [angular[i][j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    moment = [p * f for p in point for f in force]
    features = torch.stack(
        [axx, axy, axz, ayy, ayz, azz, *mixed, *angular, *moment, *force], dim=1
    ).flatten(1)
    below = ancestors.to(features)
    if num_points > num_joints:  # fewer products by way of the links
        links, place = torch.unique(point_link, return_inverse=True)
        features = features.new_zeros(len(links), features.shape[1]).index_add(0, place, features)
        below = below[:, links]
    else:
        below = below[:, point_link]
    per_joint = (below @ features).unflatten(1, (33, batch.numel()))

    (sxx, sxy, sxz, syy, syz, szz,
     mxx, mxy, mxz, myx, myy, myz, mzx, mzy, mzz,
     kxx, kxy, kxz, kyy, kyz, kzz,
     pxx, pxy, pxz, pyx, pyy, pyz, pzx, pzy, pzz,
     fx, fy, fz) = per_joint.unbind(1)  # fmt: skip
    wx, wy, wz = _components(pose.omega)
    vx, vy, vz = _components(velocity)
    # Torque and force are the six components of the wrench; so are the reactions to a twist.
    twist = (wx, wy, wz, vx, vy, vz)
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
    if second_order_kinematics is not False:
        curvature = [
            _dot((pxy, pxz, -pyy - pzz, fz, -fy), (wy, wz, wx, vy, vz)),
            _dot((pyx, pyz, -pxx - pzz, fx, -fz), (wx, wz, wy, vz, vx)),
            _dot((pzx, pzy, -pxx - pyy, fy, -fx), (wx, wy, wz, vx, vy)),
        ]
        if isinstance(second_order_kinematics, Tensor):
            share = second_order_kinematics.reshape(batch.numel())
            turning = [torch.addcmul(a, share, b) for a, b in zip(turning, curvature, strict=True)]
        else:
            turning = [a + b for a, b in zip(turning, curvature, strict=True)]
    left = torch.stack(twist).permute(2, 1, 0).contiguous()
    right = torch.stack([*turning, *shifting]).permute(2, 0, 1).contiguous()
    # Every pair of joints on a branch once, the diagonal twice by half.
    half_diagonal = joint_ancestors.to(left)
    half_diagonal.diagonal().fill_(0.5)
    upper = (left @ right).mul_(half_diagonal)
    hessian = upper + upper.mT
    return LocalModel(
        cost.value.sum(-1),
        gradient.T.reshape(*batch, num_joints),
        hessian.reshape(*batch, num_joints, num_joints),
    )


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
