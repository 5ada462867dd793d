"""The radial function: its value as Barr writes it, and its derivatives by autograd."""

from __future__ import annotations

import pytest
import torch
from reference.autograd import differentiated
from torch import Tensor

from torchcss.body.superquadric import Superquadrics, radial_hessian, radial_square, unbend
from torchcss.body.surface import implicit, surface_points
from torchcss.types import PointCost


def random_shapes(number: int, generator: torch.Generator, *, bent: bool) -> Tensor:
    def uniform(low: float, high: float, *size: int) -> Tensor:
        return low + (high - low) * torch.rand(
            number, *size, generator=generator, dtype=torch.float64
        )

    bends = uniform(-2, 2, 2) * bent
    parts = [uniform(0.05, 0.15, 2), uniform(0.1, 0.3, 1), uniform(0.3, 1.3, 2)]
    return torch.cat([*parts, uniform(-0.6, 0.6, 2), bends], dim=-1)


def by_autograd(shape: Tensor, points: Tensor, *, bent: bool) -> PointCost:
    """The same with `pow` and derivatives by double backward."""
    leaf = points.clone().requires_grad_()
    rows = Superquadrics.of(shape)
    x, y, z = leaf.unbind(-1)
    if bent:
        (x, y, z), _ = unbend(rows, x, y, z)
    a1, a2, a3, e1, e2 = shape[:, :5].unbind(-1)
    height = rows.height(z / a3)
    x, y = x / (1 + shape[:, 5] * height), y / (1 + shape[:, 6] * height)
    section = (x / a1).abs() ** (2 / e2) + (y / a2).abs() ** (2 / e2)
    value = (section ** (e2 / e1) + (z / a3).abs() ** (2 / e1)) ** e1
    return differentiated(value, leaf)


@pytest.mark.parametrize("bent", [False, True])
def test_derivatives_are_those_of_autograd(bent: bool, generator: torch.Generator) -> None:
    shape = random_shapes(400, generator, bent=bent)
    points = torch.randn(400, 3, generator=generator, dtype=torch.float64) * shape[:, :3]
    points[::3] *= 1.7  # beyond the ends, where the taper levels off
    expected = by_autograd(shape, points, bent=bent)
    rows = Superquadrics.of(shape)
    found = radial_hessian(rows, *points.unbind(-1), bent=bent)
    for got, want in zip(found, expected, strict=True):
        size = want.flatten(1).abs().amax(-1) if want.dim() > 1 else want
        error = (got - want).reshape(400, -1).abs().amax(-1)
        assert float((error / size.clamp(min=1e-6)).max()) < 1e-9
    value, half = radial_square(rows, *points.unbind(-1), bent=bent)
    torch.testing.assert_close(value, found[0], rtol=1e-12, atol=0)
    torch.testing.assert_close(2 * torch.stack(half, -1), found[1], rtol=1e-9, atol=1e-9)


def test_a_bend_near_zero_is_none(generator: torch.Generator) -> None:
    shape = random_shapes(50, generator, bent=False)
    points = torch.randn(50, 3, generator=generator, dtype=torch.float64) * shape[:, :3]
    slight = shape.clone()
    slight[:, 7] = 1e-9
    straight = radial_hessian(Superquadrics.of(shape), *points.unbind(-1), bent=False)
    bent = radial_hessian(Superquadrics.of(slight), *points.unbind(-1), bent=True)
    for one, other in zip(straight, bent, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("bent", [False, True])
def test_one_on_the_surface(bent: bool, generator: torch.Generator) -> None:
    shape = random_shapes(200, generator, bent=bent)
    eta, omega = torch.rand(2, 200, generator=generator, dtype=torch.float64) * 3 - 1.5
    points, normals = surface_points(shape, eta, 2 * omega)
    value, half = radial_square(Superquadrics.of(shape), *points.unbind(-1), bent=bent)
    torch.testing.assert_close(value, torch.ones_like(value), rtol=0, atol=1e-6)
    torch.testing.assert_close(implicit(shape, points), value - 1)
    slope = torch.stack(half, -1)
    torch.testing.assert_close(slope / slope.norm(dim=-1, keepdim=True), normals, atol=1e-5, rtol=0)


def test_single_precision_holds_far_beyond_a_tip(generator: torch.Generator) -> None:
    """Where the section is a tenth, points next to the part are dozens of sections away."""
    shape = random_shapes(300, generator, bent=False)
    shape[:, 5:7] = torch.where(shape[:, 5:7] > 0, 0.9, -0.9)
    points = 3 * torch.randn(300, 3, generator=generator, dtype=torch.float64) * shape[:, 2:3]
    value, slope = radial_square(Superquadrics.of(shape), *points.unbind(-1), bent=False)
    assert float(value.max()) > 2000
    single = Superquadrics.of(shape.float()), *points.float().unbind(-1)
    found, half = radial_square(*single, bent=False)
    torch.testing.assert_close(found.double(), value, rtol=1e-3, atol=1e-3)
    size = torch.stack(slope, -1).norm(dim=-1, keepdim=True)
    error = (torch.stack(half, -1) - torch.stack(slope, -1)) / size
    assert float(error.abs().max()) < 1e-3
