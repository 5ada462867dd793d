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
    second_order_kinematics: bool = True,
) -> LocalModel:
    """Sum a cost over points and differentiate it with respect to the joint values.

    Args:
        pose: Poses and twists of the tree at the state where the cost was evaluated.
        ancestors: True where a joint moves a link.
        joint_ancestors: True at (i, j) where joint i moves joint j or i is j.
        points: World positions of the points, metres.
        point_link: The link that carries each point.
        cost: Value, gradient and Hessian of each point's cost in its world position.
        second_order_kinematics: False leaves the curvature of the kinematics out (eq. 9 [RR]).

    Returns:
        The cost summed over points, its gradient and its Hessian in the joints.
    """
    # Any fixed reference point will do; one near the body avoids cancellation.
    reference = pose.translation[..., :1, :]
    velocity = pose.velocity + torch.linalg.cross(pose.omega, reference.expand_as(pose.omega))
    x, y, z = (points - reference).unbind(-1)
    fx, fy, fz = cost.gradient.unbind(-1)
    (axx, axy, axz), (_, ayy, ayz), (_, _, azz) = (
        row.unbind(-1) for row in cost.hessian.unbind(-2)
    )
    # Components as whole tensors: on a CPU this is many times faster than 3 x 3 products.
    # mixed = [p]x A and angular = [p]x A [p]x^T, of which the upper triangle is enough.
    mixed = (
        y * axz - z * axy, y * ayz - z * ayy, y * azz - z * ayz,
        z * axx - x * axz, z * axy - x * ayz, z * axz - x * azz,
        x * axy - y * axx, x * ayy - y * axy, x * ayz - y * axz,
    )  # fmt: skip
    angular = (
        y * mixed[2] - z * mixed[1], z * mixed[0] - x * mixed[2], x * mixed[1] - y * mixed[0],
        z * mixed[3] - x * mixed[5], x * mixed[4] - y * mixed[3], x * mixed[7] - y * mixed[6],
    )  # fmt: skip
    moment = (x * fx, x * fy, x * fz, y * fx, y * fy, y * fz, z * fx, z * fy, z * fz)
    features = torch.stack(
        [axx, axy, axz, ayy, ayz, azz, *mixed, *angular, *moment, fx, fy, fz], dim=-2
    )
    links = torch.unique(point_link)
    carried = (point_link[:, None] == links).to(features)
    per_joint = (features @ carried) @ ancestors[:, links].T.to(features)

    def symmetric(first: int) -> Tensor:
        index = torch.tensor([0, 1, 2, 1, 3, 4, 2, 4, 5], device=points.device) + first
        return per_joint[..., index, :].movedim(-2, -1).unflatten(-1, (3, 3))

    def square(first: int) -> Tensor:
        return per_joint[..., first : first + 9, :].movedim(-2, -1).unflatten(-1, (3, 3))

    k_vv, k_wv, k_ww, moment = symmetric(0), square(6), symmetric(15), square(21)
    force = per_joint[..., 30:, :].movedim(-2, -1)
    torque = torch.stack(
        [
            moment[..., 1, 2] - moment[..., 2, 1],
            moment[..., 2, 0] - moment[..., 0, 2],
            moment[..., 0, 1] - moment[..., 1, 0],
        ],
        dim=-1,
    )
    omega = pose.omega
    gradient = (omega * torque).sum(-1) + (velocity * force).sum(-1)

    def times(matrix: Tensor, vector: Tensor) -> Tensor:
        a, b, c = vector.unbind(-1)
        return (
            matrix[..., 0] * a[..., None]
            + matrix[..., 1] * b[..., None]
            + (matrix[..., 2] * c[..., None])
        )

    reaction_w = times(k_ww, omega) + times(k_wv, velocity)
    reaction_v = times(k_wv.transpose(-1, -2), omega) + times(k_vv, velocity)
    if second_order_kinematics:
        trace = moment.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
        reaction_w = reaction_w + times(moment, omega) - trace * omega
        reaction_w = reaction_w + torch.linalg.cross(velocity, force)
    twist = torch.cat([omega, velocity], dim=-1)
    reaction = torch.cat([reaction_w, reaction_v], dim=-1)
    upper = (twist @ reaction.transpose(-1, -2)) * joint_ancestors.to(twist)
    hessian = upper + upper.transpose(-1, -2)
    hessian = hessian - torch.diag_embed(upper.diagonal(dim1=-2, dim2=-1))
    return LocalModel(cost.value.sum(-1), gradient, hessian)
