"""The edge-energy term: one smooth interpolant, derivatives per point against autograd."""

from __future__ import annotations

import pytest
import torch
from reference.autograd import differentiated
from reference.camera import jacobian_of, skew_camera
from reference.spline import spline
from torch import Tensor

from torchcss.cost.edge_energy import EdgeEnergyTerm, SplineField, edge_energy_field
from torchcss.cost.visibility import SeenNodes
from torchcss.robust import Leclerc, Lorentzian
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor

WIDTH, HEIGHT = 40, 30
DISTORTION = [-0.33, 0.046, -0.0043, 0.0041, 0.067]


def make_camera(distortion: list[float] | None = None) -> Camera:
    return skew_camera((50.0, 48.0), (19.0, 15.0), (WIDTH, HEIGHT), distortion=distortion)


def random_edges(generator: torch.Generator, height: int = HEIGHT, width: int = WIDTH) -> Tensor:
    """An edge field with vectors of length up to one."""
    direction = torch.randn(2, height, width, generator=generator, dtype=torch.float64)
    length = torch.rand(height, width, generator=generator, dtype=torch.float64)
    return length * direction / direction.norm(dim=0)


def random_nodes(*batch: int, generator: torch.Generator, count: int = 30) -> SeenNodes:
    def uniform(*shape: int) -> Tensor:
        return torch.rand(*batch, count, *shape, generator=generator, dtype=torch.float64)

    normals = torch.randn(*batch, count, 3, generator=generator, dtype=torch.float64)
    return SeenNodes(
        2.4 * (uniform(3) - 0.5),
        normals / normals.norm(dim=-1, keepdim=True),
        uniform().clamp(max=0.7) / 0.7,
        uniform().clamp(max=0.7) / 0.7,
    )


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (6, 1), (2, 2), (9, 14)])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_the_field_is_the_spline_of_its_twin(
    size: tuple[int, int], batch: tuple[int, ...], generator: torch.Generator
) -> None:
    height, width = size
    field = edge_energy_field(random_edges(generator, height, width))
    uv = torch.rand(*batch, 50, 2, generator=generator, dtype=torch.float64)
    uv = uv * torch.tensor([width + 8.0, height + 8.0]) - 4.5
    uv[..., :10, :] = uv[..., :10, :].round()
    uv[..., 10:20, :] = uv[..., 10:20, :].round() + 0.5
    uv.requires_grad_()
    inner = field.coefficients[0, 4:-4, 4:-4]
    assert inner.shape == size
    expected = spline(inner, uv)
    _, gradient, hessian = differentiated(expected, uv)
    got = field.sample(uv.detach())
    for ours, theirs in zip(got, (expected.detach(), gradient, hessian), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(field.value(uv.detach()), got.value, rtol=0.0, atol=0.0)
    own = differentiated(field.value(uv), uv)[1:]
    torch.testing.assert_close(got.gradient, own[0], rtol=0.0, atol=1e-12)
    torch.testing.assert_close(got.hessian, own[1], rtol=0.0, atol=1e-12)


def test_value_slope_and_curvature_pass_from_pixel_to_pixel_and_over_the_border(
    generator: torch.Generator,
) -> None:
    field = edge_energy_field(random_edges(generator))
    across = torch.arange(-3.0, WIDTH + 3.0, dtype=torch.float64)
    for offset in (0.0, 0.5, 1.5, 2.5, 7.3):
        at = torch.stack([across, torch.full_like(across, offset)], dim=-1)
        for side in (torch.tensor([1e-9, 0.0]).double(), torch.tensor([0.0, 1e-9]).double()):
            before, after = field.sample(at - side), field.sample(at + side)
            for one, other in zip(before, after, strict=True):
                torch.testing.assert_close(one, other, rtol=0.0, atol=1e-7)
    outside = torch.tensor(
        [[-2.0, 5.0], [WIDTH + 1.0, 5.0], [5.0, -2.0], [5.0, HEIGHT + 1.0], [-1e30, 1e30]],
        dtype=torch.float64,
    )  # fmt: skip
    for part in field.sample(outside):
        assert not part.any()


def test_the_energy_stays_in_its_range(generator: torch.Generator) -> None:
    for edges in (random_edges(generator), torch.ones(2, 9, 9) / 2**0.5, torch.zeros(2, 9, 9)):
        field = edge_energy_field(edges)
        uv = 50 * torch.rand(4000, 2, generator=generator) - 5
        value = field.value(uv)
        assert float(value.min()) >= 0.0
        assert float(value.max()) <= 1.0 + 1e-6


@pytest.mark.parametrize("kind", [Lorentzian, Leclerc])
@pytest.mark.parametrize("distortion", [None, DISTORTION])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_derivatives_per_point_are_those_of_autograd(
    kind: type, distortion: list[float] | None, batch: tuple[int, ...], generator: torch.Generator
) -> None:
    camera = make_camera(distortion)
    term = EdgeEnergyTerm(potential_kind=kind, nu=1.3)
    field = edge_energy_field(random_edges(generator))
    nodes = random_nodes(*batch, generator=generator)
    got = term.point_cost(nodes, camera, field)
    leaf = nodes.points.clone().requires_grad_()
    value = term.value(nodes._replace(points=leaf), camera, field)
    expected = differentiated(value, leaf)
    assert int((expected.gradient != 0).any(-1).sum()) > 0
    for ours, theirs in zip(got, expected, strict=True):
        scale = float(theirs.abs().max())
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-11 * scale)


def test_gauss_newton_leaves_out_the_curvature_of_the_projection(
    generator: torch.Generator,
) -> None:
    camera, term = make_camera(), EdgeEnergyTerm()
    field = edge_energy_field(random_edges(generator))
    nodes = random_nodes(generator=generator)
    model = camera.project_with_derivatives(nodes.points)
    leaf = model.uv.clone().requires_grad_()
    value = 0.5 * term.potential(1 - field.value(leaf)).rho * nodes.exists * nodes.visible
    bowl = differentiated(value, leaf).hessian
    got = term.point_cost(nodes, camera, field, gauss_newton=True)
    jacobian = jacobian_of(camera, model)
    torch.testing.assert_close(got.hessian, jacobian.mT @ bowl @ jacobian)


def test_nodes_without_an_edge_have_the_costs_of_the_docstring(
    generator: torch.Generator,
) -> None:
    camera, term = make_camera(), EdgeEnergyTerm(nu=2.0)
    field = edge_energy_field(random_edges(generator))
    nodes = random_nodes(generator=generator, count=5)
    one = torch.ones_like(nodes.exists)
    behind = (torch.tensor([0.0, 0.0, -2.0]) - camera.t_camera_world) @ camera.R_camera_world
    beside = (torch.tensor([9.0, 0.0, 3.0]) - camera.t_camera_world) @ camera.R_camera_world
    unseen = nodes._replace(points=nodes.points.clone(), exists=one, visible=one)
    unseen.points[0], unseen.points[1] = behind, beside
    for cases, level in (
        (nodes._replace(exists=0 * one), term.fitted_level * term.nu),
        (nodes._replace(exists=one, visible=0 * one), 1.1 * term.fitted_level * term.nu),
        (unseen, term.unmatched),
        (nodes._replace(exists=one, visible=one), None),
    ):
        cost = term.point_cost(cases, camera, field)
        value = cost.value[:2] if cases is unseen else cost.value
        torch.testing.assert_close(cost.value, term.value(cases, camera, field))
        if level is None:
            assert float(value.max()) <= term.unmatched
            assert float(value.min()) < 0.5 * term.unmatched
            continue
        torch.testing.assert_close(value, torch.full_like(value, level))
        assert not cost.gradient[: len(value)].any()
        assert not cost.hessian[: len(value)].any()
    flat = edge_energy_field(torch.zeros(2, HEIGHT, WIDTH).double())
    alone = term.value(nodes._replace(exists=one, visible=one), camera, flat)
    torch.testing.assert_close(alone, torch.full_like(alone, term.unmatched))


def test_a_node_is_drawn_to_the_edge_and_rests_there() -> None:
    """A clean step: least cost on the edge, force towards it from both sides."""
    picture = torch.full((60, 80), 0.2, dtype=torch.float64)
    picture[:, 40:] = 0.8
    features = FeatureExtractor().double()(picture)
    field = edge_energy_field(features.edge_field())
    camera = Camera.pinhole(80, 60, focal_px=80.0)
    u = torch.linspace(33.0, 46.0, 131, dtype=torch.float64)
    points = torch.stack([(u - 39.5) / 80, torch.zeros_like(u), torch.ones_like(u)], dim=-1)
    nodes = SeenNodes(points, torch.tensor([1.0, 0, 0]).double().expand(131, 3), u**0, u**0)
    term = EdgeEnergyTerm()
    cost = term.point_cost(nodes, camera, field)
    best = int(cost.value.argmin())
    assert float(u[best]) == pytest.approx(39.5, abs=0.06)
    assert float(cost.value[best]) < 0.25 * term.unmatched
    assert float(cost.hessian[best, 0, 0]) > 0.0
    left, right = (u > 35.5) & (u < 39.3), (u > 39.7) & (u < 43.5)
    assert (cost.gradient[left, 0] < 0).all()
    assert (cost.gradient[right, 0] > 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_types_and_awkward_points(dtype: torch.dtype, generator: torch.Generator) -> None:
    camera, term = make_camera(), EdgeEnergyTerm()
    edges = random_edges(generator)
    nodes = random_nodes(4, generator=generator)
    expected = term.point_cost(nodes, camera, edge_energy_field(edges))
    single = SeenNodes(*(part.to(dtype) for part in nodes))
    field = edge_energy_field(edges.to(dtype))
    for ours, theirs in zip(term.point_cost(single, camera, field), expected, strict=True):
        assert ours.dtype == dtype
        scale = float(theirs.abs().max())
        torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=1e-4 * scale)
    far = torch.tensor(
        [[1e6, 0.0, 0.0], [1e15, 1e15, 1e15], [0.0, 1e3, 1e-3], [0.0, 0.0, 5.0], [-1.0, 1.0, 1.0]],
        dtype=dtype,
    )
    one = torch.ones(5, dtype=dtype)
    for small in (
        field,
        edge_energy_field(edges[:, :1, :1].to(dtype)),
        SplineField(field[0] * 0),
    ):
        for part in term.point_cost(SeenNodes(far, far, one, one), camera, small):
            assert torch.isfinite(part).all()
