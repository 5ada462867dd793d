"""Superquadrics: normals against tangents from autograd, inside and outside, bending and back."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.surface import (
    SHAPE_NAMES,
    angular_grid,
    implicit,
    straighten,
    surface_points,
)


def uniform(low: float, high: float, *size: int, generator: torch.Generator) -> Tensor:
    return low + (high - low) * torch.rand(*size, generator=generator, dtype=torch.float64)


def random_shapes(num: int, generator: torch.Generator) -> Tensor:
    """Tapered and bent either way; exponents of both kinds, box-like and star-like."""
    columns = [
        uniform(0.03, 0.15, num, 3, generator=generator),
        uniform(0.3, 1.7, num, 2, generator=generator),
        uniform(-0.5, 0.5, num, 2, generator=generator),
        # The axis bends by up to a radian each way, around a circle wider than the part.
        uniform(-3.0, 3.0, num, 2, generator=generator),
    ]
    shapes = torch.cat(columns, dim=-1)
    shapes[::5, 7:] = 0.0
    shapes[1::5, 8] = 0.0
    return shapes


def random_angles(num: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Away from the seams and poles by a degree, where exponents other than 1 have ridges."""
    eta = uniform(0.02, math.pi / 2 - 0.02, num, generator=generator)
    omega = uniform(0.02, math.pi / 2 - 0.02, num, generator=generator)
    sign = torch.where(torch.rand(num, generator=generator) < 0.5, -1.0, 1.0).double()
    quarter = torch.randint(-2, 2, (num,), generator=generator) * (math.pi / 2)
    return eta * sign, omega + quarter


def test_there_are_nine_numbers() -> None:
    assert len(SHAPE_NAMES) == 9


def test_normals_are_the_cross_product_of_the_tangents(generator: torch.Generator) -> None:
    num = 400
    shapes = random_shapes(num, generator)
    eta, omega = random_angles(num, generator)
    eta.requires_grad_()
    omega.requires_grad_()
    points, normals = surface_points(shapes, eta, omega)
    along, around = (
        torch.stack(
            [
                torch.autograd.grad(points[:, a].sum(), angle, retain_graph=True)[0]
                for a in range(3)
            ],
            dim=-1,
        )
        for angle in (eta, omega)
    )
    expected = torch.linalg.cross(around, along)
    expected = expected / expected.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(normals.detach(), expected, rtol=0, atol=1e-9)


def test_points_lie_on_the_surface_and_normals_point_out(generator: torch.Generator) -> None:
    shapes = random_shapes(400, generator)
    points, normals = surface_points(shapes, *random_angles(400, generator))
    torch.testing.assert_close(
        implicit(shapes, points), torch.zeros(400, dtype=torch.float64), rtol=0, atol=1e-9
    )
    step = 1e-6 * normals
    assert (implicit(shapes, points + step) > 0).all()
    assert (implicit(shapes, points - step) < 0).all()


def test_normals_are_unit_on_ridges_and_poles(generator: torch.Generator) -> None:
    shapes = random_shapes(50, generator)[:, None]
    quarter = math.pi / 2
    eta = torch.tensor([-quarter, -quarter, 0.0, 0.0, 0.0, quarter, 0.3], dtype=torch.float64)
    omega = torch.tensor([0.0, 1.0, 0.0, quarter, -math.pi, 0.5, quarter], dtype=torch.float64)
    points, normals = surface_points(shapes, eta.expand(50, 7), omega.expand(50, 7))
    assert torch.isfinite(points).all()
    length = normals.norm(dim=-1)
    torch.testing.assert_close(length, torch.ones_like(length))
    # The poles' normals lie along the bent axis.
    straight = shapes[:, 0, 7] == 0
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(normals[straight, 5], axis.expand(10, 3))
    torch.testing.assert_close(normals[straight, 0], -axis.expand(10, 3))


def test_straighten_undoes_taper_and_bend(generator: torch.Generator) -> None:
    shapes = random_shapes(300, generator)
    eta, omega = random_angles(300, generator)
    plain = shapes.clone()
    plain[:, 5:] = 0.0
    torch.testing.assert_close(
        straighten(shapes, surface_points(shapes, eta, omega).points),
        surface_points(plain, eta, omega).points,
        rtol=0,
        atol=1e-12,
    )


def test_an_ellipsoid_is_an_ellipsoid(generator: torch.Generator) -> None:
    shape = torch.tensor([0.1, 0.2, 0.4, 1, 1, 0, 0, 0, 0], dtype=torch.float64)
    points = uniform(-0.5, 0.5, 200, 3, generator=generator)
    expected = (points / shape[:3]).square().sum(-1) - 1
    torch.testing.assert_close(implicit(shape, points), expected)
    eta, omega = random_angles(200, generator)
    points, normals = surface_points(shape, eta, omega)
    slope = points / shape[:3].square()
    torch.testing.assert_close(normals, slope / slope.norm(dim=-1, keepdim=True))


def test_bending_turns_the_axis_into_a_circle_towards_the_direction() -> None:
    shape = torch.tensor([0.01, 0.01, 0.5, 1, 1, 0, 0, 0.0, 2.0], dtype=torch.float64)
    pole = torch.tensor([math.pi / 2, 0.0], dtype=torch.float64)
    tip = surface_points(shape, pole[0], pole[1])
    expected = torch.tensor([0.0, (1 - math.cos(1.0)) / 2, math.sin(1.0) / 2], dtype=torch.float64)
    torch.testing.assert_close(tip.points, expected)
    towards = torch.tensor([0.0, math.sin(1.0), math.cos(1.0)], dtype=torch.float64)
    torch.testing.assert_close(tip.normals, towards)


@pytest.mark.parametrize("bend", [0.0, 1e-9, 1e-6, 1e-5, 1e-3, 0.1, 0.4, -1e-5, 3.0])
def test_bends_of_any_size_are_bent_in_float32(generator: torch.Generator, bend: float) -> None:
    shapes = random_shapes(100, generator)
    shapes[:, 7:] = bend * shapes[:, 7:].sign() / 2**0.5
    shapes = shapes.float().double()
    eta, omega = random_angles(100, generator)
    expected = surface_points(shapes, eta, omega).points
    points = surface_points(shapes.float(), eta.float(), omega.float()).points
    torch.testing.assert_close(points.double(), expected, rtol=0, atol=5e-6)
    torch.testing.assert_close(
        straighten(shapes.float(), expected.float()).double(),
        straighten(shapes, expected),
        rtol=0,
        atol=5e-6,
    )


@pytest.mark.parametrize("bend", [0.0, 1e-7, 0.3])
def test_straightening_can_be_differentiated(generator: torch.Generator, bend: float) -> None:
    shapes = random_shapes(8, generator)
    shapes[:, 7], shapes[:, 8] = bend, 0.2
    points = surface_points(shapes, *random_angles(8, generator)).points
    bends = shapes[:, 7].clone().requires_grad_()

    def straight(bends: Tensor, points: Tensor) -> Tensor:
        return straighten(torch.cat([shapes[:, :7], bends[:, None], shapes[:, 8:]], -1), points)

    points.requires_grad_()
    assert torch.autograd.gradcheck(straight, (bends, points))


def test_a_straight_part_is_straightened_with_derivatives(generator: torch.Generator) -> None:
    shapes = random_shapes(8, generator)
    shapes[:, 7:] = 0.0
    points = surface_points(shapes, *random_angles(8, generator)).points.requires_grad_()
    assert torch.autograd.gradcheck(lambda points: straighten(shapes, points), points)


def test_a_small_bend_joins_none_smoothly(generator: torch.Generator) -> None:
    shapes = random_shapes(50, generator)
    eta, omega = random_angles(50, generator)
    shapes[:, 7:] = 0.0
    straight = surface_points(shapes, eta, omega)
    for bend in (1e-7, 2e-6, -2e-6):
        shapes[:, 7] = bend
        bent = surface_points(shapes, eta, omega)
        torch.testing.assert_close(bent.points, straight.points, rtol=0, atol=1e-7)
        torch.testing.assert_close(bent.normals, straight.normals, rtol=0, atol=1e-5)


def test_implicit_tells_in_from_out_and_stays_finite(generator: torch.Generator) -> None:
    shapes = random_shapes(200, generator)
    centre = torch.zeros(200, 3, dtype=torch.float64)
    assert (implicit(shapes, centre) < 0).all()
    directions = torch.randn(200, 3, generator=generator, dtype=torch.float64)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    for distance in (1.0, 1e3, 1e8):
        value = implicit(shapes, distance * directions)
        assert (value > 0).all()
        assert not value.isnan().any()
        single = implicit(shapes.float(), (distance * directions).float())
        assert (single > 0).all()
        assert not single.isnan().any()


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_leading_shapes_and_types(
    batch: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator
) -> None:
    num = math.prod(batch)
    shapes = random_shapes(max(num, 2), generator)[-num:].reshape(*batch, 9)
    eta, omega = (angle.reshape(batch) for angle in random_angles(num, generator))
    expected = surface_points(shapes, eta, omega)
    got = surface_points(shapes.to(dtype), eta.to(dtype), omega.to(dtype))
    assert got.points.shape == got.normals.shape == (*batch, 3)
    assert got.points.dtype == got.normals.dtype == dtype
    torch.testing.assert_close(got.points.double(), expected.points, rtol=0, atol=1e-5)
    value = implicit(shapes.to(dtype), got.points)
    assert value.shape == batch
    assert value.dtype == dtype
    assert float(value.abs().max()) < (1e-3 if dtype == torch.float32 else 1e-9)


def test_angular_grid() -> None:
    eta, omega = angular_grid(6, 8, dtype=torch.float64)
    assert eta.shape == omega.shape == (6, 8)
    heights = eta[:, 0].sin()
    torch.testing.assert_close(heights.diff(), torch.full((5,), 1 / 3, dtype=torch.float64))
    torch.testing.assert_close(heights, -heights.flip(0))
    assert float(heights[-1]) < 1
    assert torch.equal(eta, eta[:, :1].expand(6, 8))
    torch.testing.assert_close(omega[0].diff(), torch.full((7,), math.pi / 4, dtype=torch.float64))
    assert float(omega[0, 0]) == pytest.approx(-math.pi)
    assert angular_grid(2, 3, dtype=torch.float32)[0].dtype == torch.float32


def test_nodes_of_the_bodies_lie_on_their_parts() -> None:
    body = load_body("body34")
    mesh = body.mesh(9, 10)
    shape = body.part_shape[:, None, None, :].expand(*mesh.points.shape[:3], 9)
    assert float(implicit(shape, mesh.points).abs().max()) < 1e-9
    assert (implicit(shape, mesh.points + 1e-5 * mesh.normals) > 0).all()
