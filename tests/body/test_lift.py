"""The lift against autograd through hand-written kinematics, plain loops and finite differences."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from reference import kinematics as reference
from torch import Tensor

from torchcss.body.catalog import BODY_NAMES
from torchcss.body.lift import lift_to_joints
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel, BodyPose
from torchcss.cost.term import differentiate_twice
from torchcss.types import Curvature, PointCost

NUM_POINTS = 30


class Problem(NamedTuple):
    """Points fixed in links, and a random quadratic cost of each."""

    link: Tensor
    offset: Tensor
    constant: Tensor
    slope: Tensor
    curvature: Tensor

    def cost_at(self, points: Tensor) -> PointCost:
        """`c + g.p + p.A p / 2` with its derivatives."""
        bent = (self.curvature @ points[..., None])[..., 0]
        value = self.constant + (points * (self.slope + 0.5 * bent)).sum(-1)
        hessian = self.curvature.expand(*points.shape[:-1], 3, 3)
        return PointCost(value, self.slope + bent, hessian)


def make_body(name: str, *, free: bool) -> BodyModel:
    body = load_body(name, free_proportions=free, lengths={"forearm": 0.25} if free else None)
    turn = reference.rotation(0.4, -0.9, 0.3)
    return body.with_base(turn, torch.tensor([0.3, -1.1, 4.0]).double())


def make_problem(body: BodyModel, generator: torch.Generator) -> Problem:
    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    links = torch.randint(len(body.tree.link_names), (NUM_POINTS,), generator=generator)
    square = randn(NUM_POINTS, 3, 3)
    return Problem(
        links, 0.2 * randn(NUM_POINTS, 3), randn(NUM_POINTS), randn(NUM_POINTS, 3),
        square + square.mT,
    )  # fmt: skip


def random_states(body: BodyModel, *batch: int, generator: torch.Generator) -> Tensor:
    size = (*batch, body.num_parameters)
    return body.bounds.project(torch.randn(size, generator=generator, dtype=torch.float64))


def points_by_hand(body: BodyModel, problem: Problem, x: Tensor) -> Tensor:
    """World points through the reference's kinematics: no pytorch-kinematics involved."""
    q = x @ body.tie.T + body.offset
    values = dict(zip(body.tree.joint_names, q.unbind(-1), strict=True))
    poses = reference.forward_kinematics(body.tree.specifications, values)
    points = []
    for link, offset in zip(problem.link.tolist(), problem.offset, strict=True):
        turn, origin = poses[body.tree.link_names[link]]
        point = (turn @ offset[:, None])[..., 0] + origin
        points.append(point.expand(*x.shape[:-1], 3))
    stacked = torch.stack(points, dim=-2)
    return stacked @ body.base_rotation.T + body.base_translation


def lifted(body: BodyModel, problem: Problem, x: Tensor, curvature: Curvature) -> tuple:
    pose = body.pose(x)
    points = body.points_on_links(pose.tree, problem.link, problem.offset)
    model = body.lift(pose, points, problem.link, problem.cost_at(points), curvature=curvature)
    return pose, points, model


def assert_relative(got: Tensor, expected: Tensor, tolerance: float = 1e-10) -> None:
    scale = float(expected.abs().max())
    torch.testing.assert_close(got, expected, rtol=0.0, atol=tolerance * max(scale, 1e-30))


@pytest.mark.parametrize("free", [False, True])
@pytest.mark.parametrize("name", BODY_NAMES)
def test_exact_lift_is_the_hessian_of_autograd(
    name: str, free: bool, generator: torch.Generator
) -> None:
    body = make_body(name, free=free)
    problem = make_problem(body, generator)
    x = random_states(body, 2, generator=generator).requires_grad_()
    points = points_by_hand(body, problem, x)
    cost = problem.cost_at(points)
    expected = differentiate_twice(cost.value.sum(-1), x)
    _, got_points, got = lifted(body, problem, x.detach(), Curvature.EXACT)
    assert_relative(got_points, points.detach(), 1e-12)
    assert_relative(got.value, expected.value)
    assert_relative(got.gradient, expected.gradient)
    assert_relative(got.hessian, expected.hessian)
    assert_relative(got.hessian, got.hessian.mT, 1e-13)

    # Without the curvature of the kinematics: sum J^T A J.
    jacobian = torch.stack(
        [
            torch.autograd.grad(points[..., p, a].sum(), x, retain_graph=True)[0]
            for p in range(NUM_POINTS)
            for a in range(3)
        ],
        dim=-2,
    ).unflatten(-2, (NUM_POINTS, 3))
    bent = problem.curvature @ jacobian
    newton = (jacobian.mT @ bent).sum(-3)
    _, _, gauss = lifted(body, problem, x.detach(), Curvature.GAUSS_NEWTON)
    assert_relative(gauss.gradient, expected.gradient)
    assert_relative(gauss.hessian, newton)


@pytest.mark.parametrize("name", ["arm7", "body34"])
@pytest.mark.parametrize("second_order", [True, False])
def test_lift_to_joints_is_the_plain_loop(
    name: str, second_order: bool, generator: torch.Generator
) -> None:
    body = make_body(name, free=True)
    problem = make_problem(body, generator)
    pose = body.pose(random_states(body, generator=generator)).tree
    points = body.points_on_links(pose, problem.link, problem.offset)
    few = slice(0, 8)
    cost = PointCost(*(part[few] for part in problem.cost_at(points)))
    tree, given = body.tree, (points[few], problem.link[few], cost)
    got = lift_to_joints(tree, pose, *given, second_order_kinematics=second_order)
    above = tree.ancestors, tree.joint_ancestors
    expected = reference.lift(pose, *above, *given, second_order_kinematics=second_order)
    for ours, plain in zip(got, expected, strict=True):
        assert_relative(ours, plain)


def test_autograd_curvature_is_the_exact_one(generator: torch.Generator) -> None:
    body = make_body("body34", free=True)
    problem = make_problem(body, generator)
    x = random_states(body, 2, generator=generator)
    pose, points, exact = lifted(body, problem, x, Curvature.EXACT)
    cost = problem.cost_at(points)
    autograd = reference.lift_by_autograd(body, pose, points, problem.link, cost)
    for ours, reference_ in zip(exact, autograd, strict=True):
        assert_relative(ours, reference_)


def test_hessian_is_the_finite_difference_of_the_gradient(generator: torch.Generator) -> None:
    """The default backward of pytorch-kinematics fails this; see the field notes."""
    body = make_body("body34", free=False)
    problem = make_problem(body, generator)
    x = 0.5 * random_states(body, generator=generator)
    step = 1e-5
    shifts = step * torch.eye(body.num_parameters, dtype=torch.float64)
    ahead = lifted(body, problem, x + shifts, Curvature.GAUSS_NEWTON)[2]
    behind = lifted(body, problem, x - shifts, Curvature.GAUSS_NEWTON)[2]
    slope = (ahead.value - behind.value) / (2 * step)
    rows = (ahead.gradient - behind.gradient) / (2 * step)
    pose, points, exact = lifted(body, problem, x, Curvature.EXACT)
    cost = problem.cost_at(points)
    for model in (exact, reference.lift_by_autograd(body, pose, points, problem.link, cost)):
        assert_relative(model.gradient, slope, 1e-7)
        assert_relative(model.hessian, rows, 1e-7)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_leading_shapes_and_types(
    batch: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator
) -> None:
    body = make_body("body30", free=True)
    problem = make_problem(body, generator)
    x = random_states(body, *batch, generator=generator)
    _, _, expected = lifted(body, problem, x, Curvature.EXACT)
    body = body.to(dtype)
    problem = Problem(*(t.to(dtype) if t.is_floating_point() else t for t in problem))
    n = body.num_parameters
    for curvature in Curvature:
        _, _, model = lifted(body, problem, x.to(dtype), curvature)
        assert model.value.shape == batch
        assert model.gradient.shape == (*batch, n)
        assert model.hessian.shape == (*batch, n, n)
        assert all(part.dtype == dtype for part in model)
        if x.numel() and curvature is not Curvature.GAUSS_NEWTON:
            tolerance = 1e-10 if dtype == torch.float64 else 1e-5
            assert_relative(model.gradient.double(), expected.gradient, tolerance)
            assert_relative(model.hessian.double(), expected.hessian, tolerance)


def test_far_from_the_origin_costs_no_digits(generator: torch.Generator) -> None:
    body = make_body("body34", free=False)
    problem = make_problem(body, generator)
    x = random_states(body, generator=generator)
    base = body.base_rotation
    near, far = (body.with_base(base, torch.full((3,), d).double()) for d in (0.0, 1e4))

    def model(body: BodyModel) -> Tensor:
        pose: BodyPose = body.pose(x)
        points = body.points_on_links(pose.tree, problem.link, problem.offset)
        cost = problem.cost_at(points - body.base_translation)
        return body.lift(pose, points, problem.link, cost).hessian

    assert_relative(model(far), model(near), 1e-10)


def test_no_points_and_points_on_the_root(generator: torch.Generator) -> None:
    body = make_body("arm7", free=False)
    x = random_states(body, 3, generator=generator)
    pose = body.pose(x)
    for count in (0, 4):
        link = torch.zeros(count, dtype=torch.long)
        points = torch.randn(3, count, 3, generator=generator, dtype=torch.float64)
        cost = PointCost(points.sum(-1), points, points[..., None] * points[..., None, :])
        for curvature in Curvature:
            model = body.lift(pose, points, link, cost, curvature=curvature)
            torch.testing.assert_close(model.value, cost.value.sum(-1))
            assert not model.gradient.any()
            assert not model.hessian.any()


def test_items_of_a_batch_do_not_meet(generator: torch.Generator) -> None:
    body = make_body("body34", free=False)
    problem = make_problem(body, generator)
    x = random_states(body, 4, generator=generator)
    _, _, whole = lifted(body, problem, x, Curvature.EXACT)
    spoilt = x.clone()
    spoilt[1] = float("nan")
    _, _, other = lifted(body, problem, spoilt, Curvature.EXACT)
    for ours, theirs in zip(whole, other, strict=True):
        assert torch.equal(ours[[0, 2, 3]], theirs[[0, 2, 3]])
