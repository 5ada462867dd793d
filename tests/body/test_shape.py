"""Shape columns against autograd through kinematics and surface together."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchcss.body.catalog import BODY_NAMES
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.shape import (
    CROSS_SECTIONS,
    ShapeParameters,
    lift_with_shape,
    surface_angles,
    surface_derivatives,
    with_shape,
)
from torchcss.body.surface import SHAPE_NAMES, surface_points
from torchcss.initialise.multi_start import PAPER_PROPORTIONS
from torchcss.types import PointCost

NUM_POINTS = 25


def randn(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def shapes(num: int, generator: torch.Generator, *, bent: bool = True) -> Tensor:
    """Random plausible shape numbers."""
    low = torch.tensor([0.03, 0.03, 0.1, 0.4, 0.4, -0.3, -0.3, *[-1.0 * bent] * 2])
    high = torch.tensor([0.15, 0.15, 0.3, 1.3, 1.3, 0.3, 0.3, *[1.0 * bent] * 2])
    share = torch.rand(num, 9, generator=generator, dtype=torch.float64)
    return low.double() + share * (high - low).double()


def angles(num: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    eta = 1.4 * (2 * torch.rand(num, generator=generator, dtype=torch.float64) - 1)
    return eta, 3.1 * (2 * torch.rand(num, generator=generator, dtype=torch.float64) - 1)


@pytest.mark.parametrize("bent", [True, False])
def test_angles_undo_the_surface(generator: torch.Generator, bent: bool):
    shape, (eta, omega) = shapes(50, generator, bent=bent), angles(50, generator)
    found = surface_angles(shape, surface_points(shape, eta, omega).points)
    torch.testing.assert_close(found[0], eta, atol=1e-9, rtol=0)
    torch.testing.assert_close(found[1], omega, atol=1e-9, rtol=0)


@pytest.mark.parametrize("bend", [None, 0.0, 1e-7, 1e-3])
def test_surface_derivatives_are_finite_differences(generator: torch.Generator, bend: float | None):
    shape, (eta, omega) = shapes(20, generator), angles(20, generator)
    if bend is not None:
        shape[:, 7], shape[:, 8] = bend, -bend
    along = randn(generator, 20, 3)
    local = surface_derivatives(shape, eta, omega, along)
    for k in range(9):
        step = torch.zeros(9, dtype=torch.float64)
        step[k] = 1e-5
        near = [(shape + sign * step, eta, omega) for sign in (1, -1)]
        slopes = [surface_derivatives(*there, along).first for there in near]
        for got, pair in (
            (local.first[..., k], [surface_points(*there).points for there in near]),
            (local.second[..., k], [(along[..., None] * slope).sum(-2) for slope in slopes]),
        ):
            torch.testing.assert_close(got, (pair[0] - pair[1]) / 2e-5, atol=1e-7, rtol=1e-6)


def test_left_and_right_share_their_parameters():
    body = load_body("body34")
    free = ShapeParameters(body)
    assert len(free.names) == len(set(free.names)) == len(CROSS_SECTIONS) * 11
    z = torch.linspace(-0.01, 0.01, len(free.names), dtype=torch.float64)
    shape = free.shape(z)
    left, right = (body.part_names.index(f"{side}_thigh") for side in "lr")
    assert torch.equal(shape[left], shape[right])
    assert torch.equal(free.shape(torch.zeros_like(z)), body.part_shape)
    assert (free.bounds.lower < 0).all()
    changed = (shape != body.part_shape).any(0)
    assert [SHAPE_NAMES[k] for k in torch.nonzero(changed)[:, 0].tolist()] == list(CROSS_SECTIONS)


def test_left_and_right_bend_as_mirror_images():
    body = load_body("body34")
    free = ShapeParameters(body, SHAPE_NAMES)
    z = torch.zeros(len(free.names), dtype=torch.float64)
    for number, name in enumerate(free.names):
        z[number] = (0.5 + 0.01 * number) * name.endswith(("_bend_x", "_bend_y"))
    pose = body.pose(body.rest)
    turns, centres = body.part_poses(pose)
    # The tips of the parts alone: a mirrored surface has its longitudes elsewhere.
    tips, _ = surface_points(
        free.shape(z),
        torch.full((body.num_parts,), torch.pi / 2, dtype=torch.float64),
        torch.zeros(1, dtype=torch.float64),
    )
    tips = (turns @ tips[..., None])[..., 0] + centres
    hips = body.joint_columns(("l_hip", "r_hip"))
    across = pose.joints[hips[0]] - pose.joints[hips[1]]
    across = across / across.norm()
    middle = pose.joints[hips].mean(0)
    for part, name in enumerate(body.part_names):
        if not name.startswith("l_"):
            continue
        other = body.part_names.index(f"r_{name[2:]}")
        mirrored = tips[part] - 2 * ((tips[part] - middle) @ across) * across
        torch.testing.assert_close(tips[other], mirrored, rtol=0, atol=1e-9)


@pytest.mark.parametrize("free_proportions", [False, True, PAPER_PROPORTIONS])
@pytest.mark.parametrize("name", BODY_NAMES)
def test_columns_are_exact(
    name: str, free_proportions: bool | tuple[str, ...], generator: torch.Generator
):
    """Value, gradient and Hessian in pose and shape against double backward through both."""
    body = load_body(name, free_proportions=free_proportions)
    turn, _ = torch.linalg.qr(randn(generator, 3, 3))
    body = body.with_base(turn * turn.det(), randn(generator, 3))
    shape = shapes(body.num_parts, generator)
    body = with_shape(body, shape)
    # Left and right must have the same numbers for ties to make sense; here only T matters.
    free = ShapeParameters(body, SHAPE_NAMES)
    part = torch.randint(body.num_parts, (NUM_POINTS,), generator=generator)
    eta, omega = angles(NUM_POINTS, generator)
    slope, square = randn(generator, NUM_POINTS, 3), randn(generator, NUM_POINTS, 3, 3)
    square = square + square.mT

    def cost_at(points: Tensor) -> PointCost:
        bowed = (square @ points[..., None])[..., 0]
        return PointCost(
            (points * (slope + 0.5 * bowed)).sum(-1), slope + bowed, square.expand(*points.shape, 3)
        )

    def total(both: Tensor) -> Tensor:
        x, z = both[: body.num_parameters], both[body.num_parameters :]
        rotation, centre = body.part_poses(body.pose(x))
        local = surface_points(free.shape(z)[part], eta, omega).points
        return cost_at((rotation[part] @ local[..., None])[..., 0] + centre[part]).value.sum()

    x = body.bounds.project(randn(generator, body.num_parameters))
    both = torch.cat([x, torch.zeros(len(free.names), dtype=torch.float64)])
    pose = body.pose(x)
    rotation, centre = body.part_poses(pose)
    local = surface_points(shape[part], eta, omega).points
    points = (rotation[part] @ local[..., None])[..., 0] + centre[part]
    got = lift_with_shape(body, pose, points, part, (eta, omega), cost_at(points), free)
    torch.testing.assert_close(got.value, total(both))
    gradient = torch.autograd.functional.jacobian(total, both)
    hessian = torch.autograd.functional.hessian(total, both, vectorize=True)
    torch.testing.assert_close(got.gradient, gradient, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(got.hessian, hessian, atol=1e-8, rtol=1e-8)


def test_other_body_is_untouched():
    body = load_body("arm7")
    before = body.part_shape.clone()
    assert isinstance(with_shape(body, before + 1), BodyModel)
    assert torch.equal(body.part_shape, before)
