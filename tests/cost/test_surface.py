"""The surface term: plain twin, derivatives on awkward input, what is not seen says nothing."""

from __future__ import annotations

import math

import pytest
import torch
from reference.autograd import differentiated
from torch import Tensor

from torchcss.cost.surface import SurfaceTargets, SurfaceTerm, surface_targets
from torchcss.cost.visibility import facing_nodes
from torchcss.robust import Leclerc
from torchcss.vision.camera import Camera
from torchcss.vision.spline import SplineField, spline_field

WIDTH, HEIGHT = 64, 48


def make_camera(distortion: list[float] | None = None) -> Camera:
    return Camera(
        [[60.0, 0.0, 31.0], [0.0, 58.0, 24.0], [0.0, 0.0, 1.0]],
        (WIDTH, HEIGHT),
        distortion=distortion,
    )


def a_field(generator: torch.Generator) -> SplineField:
    return spline_field(torch.randn(1, HEIGHT, WIDTH, generator=generator, dtype=torch.float64))


def some_nodes(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Nodes in the image, beside it, and behind the camera; some of them turned away."""
    points = torch.randn(2, 40, 3, generator=generator, dtype=torch.float64)
    points[..., 2] = points[..., 2].abs() + 1.5
    points[:, 0, :2] = 4.0
    points[:, 1, 2] = -1.0
    normals = torch.randn(2, 40, 3, generator=generator, dtype=torch.float64)
    return points, torch.nn.functional.normalize(normals, dim=-1)


def some_targets(generator: torch.Generator) -> SurfaceTargets:
    level = torch.randn(2, 40, generator=generator, dtype=torch.float64)
    weight = torch.rand(2, 40, generator=generator, dtype=torch.float64)
    weight[:, 5] = 0
    return SurfaceTargets(level, weight)


def test_value_is_the_docstring(generator: torch.Generator) -> None:
    camera, field, term = make_camera(), a_field(generator), SurfaceTerm(sigma=0.7)
    (points, normals), targets = some_nodes(generator), some_targets(generator)
    nodes = facing_nodes(points, normals, camera.centre_world)
    value = term.point_cost(nodes, camera, field, targets).value
    for item in range(2):
        for node in range(points.shape[1]):
            uv = camera.project(points[item, node][None]).uv
            residual = float(field.value(uv)) - float(targets.level[item, node])
            rho = 1 - math.exp(-((residual / 0.7) ** 2))
            f, w = float(nodes.exists[item, node]), float(targets.weight[item, node])
            expected = w * (f * 0.5 * rho + (1 - f) * term.fitted_level)
            assert float(value[item, node]) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("distortion", [None, [-0.33, 0.046, -0.0043, 0.0041, 0.067]])
def test_derivatives_are_those_of_autograd(
    generator: torch.Generator, distortion: list[float] | None
) -> None:
    camera, field, term = make_camera(distortion), a_field(generator), SurfaceTerm()
    (points, normals), targets = some_nodes(generator), some_targets(generator)
    nodes = facing_nodes(points, normals, camera.centre_world)
    cost = term.point_cost(nodes, camera, field, targets)

    at = points.clone().requires_grad_()
    error = field.value(camera.project(at).uv) - targets.level
    rho = Leclerc(nu=term.nu, sigma=term.sigma)(error.square()).rho
    (gradient,) = torch.autograd.grad((targets.weight * nodes.exists * 0.5 * rho).sum(), at)
    torch.testing.assert_close(cost.gradient, gradient)
    # Beside the image and behind the camera there is nothing to go by.
    assert torch.equal(cost.gradient[:, :2], torch.zeros_like(cost.gradient[:, :2]))
    assert torch.equal(cost.value[:, 5], torch.zeros_like(cost.value[:, 5]))


def test_the_hessian_is_that_of_gauss_and_newton(generator: torch.Generator) -> None:
    """Never with a negative eigenvalue, and exact where the two pictures agree."""
    camera, field, term = make_camera(), a_field(generator), SurfaceTerm()
    (points, normals), targets = some_nodes(generator), some_targets(generator)
    nodes = facing_nodes(points, normals, camera.centre_world)
    model = term.point_cost(nodes, camera, field, targets)
    assert torch.linalg.eigvalsh(model.hessian).min() > -1e-10
    agreed = targets._replace(level=field.value(camera.project(points).uv))
    model = term.point_cost(nodes, camera, field, agreed)
    at = points.clone().requires_grad_()
    value = term.point_cost(nodes._replace(points=at), camera, field, agreed).value
    exact = differentiated(value, at).hessian
    assert exact.abs().max() > 1.0
    torch.testing.assert_close(model.hessian, exact, atol=1e-9, rtol=1e-9)


def test_where_the_surface_was_it_costs_nothing(generator: torch.Generator) -> None:
    camera, field, term = make_camera(), a_field(generator), SurfaceTerm()
    points, _ = some_nodes(generator)
    towards = torch.nn.functional.normalize(camera.centre_world - points, dim=-1)
    visible = torch.ones(points.shape[:-1], dtype=torch.float64)
    visible[:, 7] = 0
    nodes = facing_nodes(points, towards, camera.centre_world)._replace(visible=visible)
    targets = surface_targets(nodes, camera, field)
    assert torch.equal(term.point_cost(nodes, camera, field, targets).value, 0 * visible)
    hidden = targets.weight == 0
    assert hidden[:, [0, 1, 7]].all()
    uv, valid = camera.project(points).uv, camera.project(points).valid
    inside = ((uv >= 0) & (uv <= uv.new_tensor([WIDTH - 1, HEIGHT - 1]))).all(-1) & valid
    assert torch.equal(hidden, ~(inside & (visible > 0)))
    away = surface_targets(facing_nodes(points, -towards, camera.centre_world), camera, field)
    assert not away.weight.any()
    assert torch.equal(targets.take(torch.tensor([1])).level, targets.level[1:])


def test_turning_away_is_no_gain(generator: torch.Generator) -> None:
    """A node that faces away costs as much as one that is found, not less."""
    camera, field, term = make_camera(), a_field(generator), SurfaceTerm()
    points, _ = some_nodes(generator)
    towards = torch.nn.functional.normalize(camera.centre_world - points, dim=-1)
    targets = surface_targets(facing_nodes(points, towards, camera.centre_world), camera, field)
    nodes = facing_nodes(points, -towards, camera.centre_world)
    away = term.point_cost(nodes, camera, field, targets)
    torch.testing.assert_close(away.value, term.fitted_level * targets.weight)
