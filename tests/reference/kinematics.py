"""Twins of kinematics and lift, as a textbook writes them: one joint, one point at a time."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchcss.body.chain import JointSpecification
from torchcss.body.kinematics import TreePose
from torchcss.body.model import BodyModel, BodyPose
from torchcss.cost.term import differentiate_twice
from torchcss.types import LocalModel, PointCost


def skew(w: Tensor) -> Tensor:
    """The matrix of the cross product with `w`."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def rotation(*vector: float) -> Tensor:
    """Rotation about a vector by its length, radians."""
    return torch.linalg.matrix_exp(skew(torch.tensor(vector, dtype=torch.float64)))


def rodrigues(axis: Tensor, angle: Tensor) -> Tensor:
    """Rotation about a unit axis."""
    k = skew(axis)
    angle = angle[..., None, None]
    return torch.eye(3, dtype=axis.dtype) + angle.sin() * k + (1 - angle.cos()) * (k @ k)


def forward_kinematics(
    joints: Sequence[JointSpecification], values: dict[str, Tensor]
) -> dict[str, tuple[Tensor, Tensor]]:
    """Rotation and origin of every link by name; `values` holds those of the moving joints."""
    poses: dict[str, tuple[Tensor, Tensor]] = {}
    like = next(iter(values.values()))
    for joint in joints:
        if joint.parent is None:
            turn, origin = torch.eye(3).to(like), torch.zeros(3).to(like)
        else:
            turn, origin = poses[joint.parent]
        origin = (
            origin + (turn @ torch.tensor(joint.translation, dtype=like.dtype)[:, None])[..., 0]
        )
        turn = turn @ torch.tensor(joint.rotation, dtype=like.dtype)
        axis = torch.tensor(joint.axis, dtype=like.dtype)
        axis = axis / axis.norm()
        if joint.kind == "revolute":
            turn = turn @ rodrigues(axis, values[joint.name])
        elif joint.kind == "prismatic":
            slide = (turn @ axis[:, None])[..., 0]
            origin = origin + values[joint.name][..., None] * slide
        poses[joint.link] = (turn, origin)
    return poses


def lift(
    pose: TreePose,
    ancestors: Tensor,
    joint_ancestors: Tensor,
    points: Tensor,
    point_link: Tensor,
    cost: PointCost,
    *,
    second_order_kinematics: bool,
) -> LocalModel:
    """Gradient and Hessian of one pose (no batch) by loops over points and pairs of joints."""
    num = len(pose.omega)
    gradient = torch.zeros(num, dtype=points.dtype)
    hessian = torch.zeros(num, num, dtype=points.dtype)
    for p in range(len(points)):

        def moves(j: int, p: int = p) -> bool:
            return bool(ancestors[j, point_link[p]])

        def velocity(j: int, p: int = p) -> Tensor:
            return torch.linalg.cross(pose.omega[j], points[p]) + pose.velocity[j]

        for i in range(num):
            if not moves(i):
                continue
            gradient[i] += cost.gradient[p] @ velocity(i)
            for j in range(num):
                if not moves(j):
                    continue
                hessian[i, j] += velocity(i) @ cost.hessian[p] @ velocity(j)
                if second_order_kinematics:
                    upper, lower = (i, j) if joint_ancestors[i, j] else (j, i)
                    turned = torch.linalg.cross(pose.omega[upper], velocity(lower))
                    hessian[i, j] += cost.gradient[p] @ turned
    return LocalModel(cost.value.sum(), gradient, hessian)


def lift_by_autograd(
    body: BodyModel, pose: BodyPose, points: Tensor, point_link: Tensor, cost: PointCost
) -> LocalModel:
    """`BodyModel.lift` by double backward through the kinematics."""
    rotation, translation = pose.tree.rotation.detach(), pose.tree.translation.detach()
    local = points.detach() - translation[..., point_link, :]
    local = (rotation[..., point_link, :, :] * local[..., :, None]).sum(-2)
    with torch.enable_grad():
        x = pose.x.detach().requires_grad_()
        moved = body.points_on_links(body.pose(x).tree, point_link, local)
        step = moved - points.detach()
        bowl = (step[..., None, :] @ cost.hessian.detach() @ step[..., :, None]).flatten(-3)
        value = cost.value.detach().sum(-1) + (cost.gradient.detach() * step).sum((-1, -2))
        return differentiate_twice(value + 0.5 * bowl.sum(-1), x)
