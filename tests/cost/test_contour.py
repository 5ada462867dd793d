"""The contour term: derivatives with matches held fixed, continuity, and images without edges."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from reference.autograd import differentiated
from reference.camera import jacobian_of, skew_camera
from reference.contour import cost_of_fixed_matches, edges_along_lines
from torch import Tensor

from torchcss.cost import contour
from torchcss.cost.contour import ContourTerm
from torchcss.cost.visibility import SeenNodes
from torchcss.robust import Leclerc, Quadratic
from torchcss.vision.camera import Camera

WIDTH, HEIGHT = 128, 96
TERM = ContourTerm()
AS_PRINTED = ContourTerm(assignment="sum", fitted_level=1.0)
PRINTED = {
    "ijrr": AS_PRINTED,
    "rr": replace(AS_PRINTED, strength=True, occlusion_factor=0.9, potential_kind=Leclerc),
    "gaussian": replace(AS_PRINTED, assignment="nearest", sigma=8.5, potential_kind=Quadratic),
}


def make_camera(distortion: list[float] | None = None) -> Camera:
    size = WIDTH, HEIGHT
    return skew_camera((120.0, 118.0), (61.0, 47.0), size, away=2.0, distortion=distortion)


def ridges(*ridge: tuple[float, float, float]) -> Tensor:
    """Vertical edges: position, width and height of each, and a gradient along u."""
    u = torch.arange(WIDTH, dtype=torch.float64)
    profile = torch.zeros_like(u)
    for centre, width, height in ridge:
        profile = profile + height * torch.exp(-0.5 * ((u - centre) / width).square())
    field = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.float64)
    field[0] = profile
    return field


def rough_field(generator: torch.Generator) -> Tensor:
    """A smooth random picture of edges, of length below one."""
    small = torch.randn(1, 2, HEIGHT // 4, WIDTH // 4, generator=generator, dtype=torch.float64)
    field = torch.nn.functional.interpolate(small, (HEIGHT, WIDTH), mode="bicubic")[0]
    return 0.9 * field / (0.5 + field.norm(dim=0)).clamp(min=1.0)


def weighed_field(generator: torch.Generator) -> Tensor:
    """The same with weights of 0.3 to 1."""
    weight = 0.3 + 0.7 * torch.rand(1, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    return torch.cat([rough_field(generator), weight])


def random_nodes(camera: Camera, *batch: int, generator: torch.Generator) -> SeenNodes:
    """Nodes in view, their normals at right angles to the line of sight."""

    def rand(*size: int) -> Tensor:
        return torch.rand(*batch, 40, *size, generator=generator, dtype=torch.float64)

    uv = rand(2) * torch.tensor([WIDTH - 1.0, HEIGHT - 1.0]).double()
    points = camera.unproject(uv, 1 + 2 * rand())
    sight = points - camera.centre_world
    normals = torch.linalg.cross(sight, rand(3) - 0.5)
    normals = normals / normals.norm(dim=-1, keepdim=True)
    exists, visible = (3 * rand() - 1).clamp(0, 1), (3 * rand() - 1).clamp(0, 1)
    return SeenNodes(points, normals, exists, visible)


def node_costs(field: Tensor, u: Tensor, term: ContourTerm = TERM) -> tuple[Tensor, Tensor]:
    """Cost of visible nodes at pixels (u, 40) with normals along u, and its slope by the term.

    The camera looks along z from one metre, a pixel a millimetre: projection is all but a shift.
    """
    camera = Camera([[1e3, 0.0, 64.0], [0.0, 1e3, 40.0], [0.0, 0.0, 1.0]], (WIDTH, HEIGHT))
    points = torch.stack([(u - 64) / 1e3, 0 * u, 0 * u + 1], dim=-1)
    normals = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand_as(points)
    ones = torch.ones_like(u)
    cost = term.point_cost(SeenNodes(points, normals, ones, ones), camera, field)
    return cost.value, cost.gradient[:, 0] / 1e3


@pytest.mark.parametrize("distortion", [None, [-0.2, 0.05, -0.004, 0.004, 0.0]])
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("kind", ["Lorentzian", "Leclerc", *PRINTED])
def test_derivatives_are_those_of_fixed_matches(
    distortion: list[float] | None,
    batch: tuple[int, ...],
    kind: str,
    generator: torch.Generator,
) -> None:
    ours = {"Lorentzian": ContourTerm(nu=1.7), "Leclerc": ContourTerm(potential_kind=Leclerc)}
    term = {**ours, **PRINTED}[kind]
    camera = make_camera(distortion)
    field = weighed_field(generator)
    field = field[:2] if kind in ours else field
    nodes = random_nodes(camera, *batch, generator=generator)
    got = term.point_cost(nodes, camera, field)
    model = camera.project_with_derivatives(nodes.points)
    normal = camera.image_normals(model, nodes.normals)
    found = term.search(model.uv, normal, field)
    points = nodes.points.clone().requires_grad_()
    value = cost_of_fixed_matches(term, nodes, camera, found, model.uv, normal, points)
    expected = differentiated(value, points)
    assert expected.gradient.any()
    for ours, theirs in zip(got, expected, strict=True):
        scale = float(theirs.abs().max())
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-11 * scale)
    torch.testing.assert_close(term.value(nodes, camera, field), got.value)


def test_gauss_newton_leaves_out_the_curvature_of_the_projection(
    generator: torch.Generator,
) -> None:
    camera = make_camera()
    field, nodes = rough_field(generator), random_nodes(camera, generator=generator)
    full = TERM.point_cost(nodes, camera, field)
    newton = TERM.point_cost(nodes, camera, field, gauss_newton=True)
    assert torch.equal(full.gradient, newton.gradient)
    # What is left is a multiple of one outer product.
    model = camera.project_with_derivatives(nodes.points)
    m = camera.image_normals(model, nodes.normals)
    direction = (jacobian_of(camera, model) * m[..., None]).sum(-2)
    outer = direction[..., :, None] * direction[..., None, :]
    factor = (newton.hessian * outer).sum((-1, -2)) / outer.square().sum((-1, -2))
    torch.testing.assert_close(newton.hessian, factor[:, None, None] * outer)


def test_the_image_normal_is_that_of_the_projected_contour(generator: torch.Generator) -> None:
    """Motion along the surface does not move the contour across itself, off the axis too."""
    for distortion in (None, [-0.2, 0.05, -0.004, 0.004, 0.0]):
        camera = make_camera(distortion)
        nodes = random_nodes(camera, generator=generator)
        model = camera.project_with_derivatives(nodes.points)
        m, jacobian = camera.image_normals(model, nodes.normals), jacobian_of(camera, model)
        tangent = torch.linalg.cross(nodes.normals, nodes.points - camera.centre_world)
        across = ((jacobian * tangent[..., None, :]).sum(-1) * m).sum(-1)
        assert float(across.abs().max()) < 1e-9
        outward = ((jacobian * nodes.normals[..., None, :]).sum(-1) * m).sum(-1)
        assert (outward > 0).all()
        torch.testing.assert_close(m.norm(dim=-1), torch.ones_like(outward))


@pytest.mark.parametrize(("window", "step"), [(12.0, 1.0), (7.5, 1.7)])
@pytest.mark.parametrize("kind", ["ours", *PRINTED])
def test_the_search_is_that_of_its_plain_twin(
    window: float, step: float, kind: str, generator: torch.Generator
) -> None:
    """All over the image and beyond: lines that leave it, or lie outside, among them."""
    term = replace(PRINTED.get(kind, TERM), window=window, step=step, least_edge=0.2)
    field = weighed_field(generator)
    size = torch.tensor([WIDTH + 30.0, HEIGHT + 30.0], dtype=torch.float64)
    uv = size * torch.rand(60, 2, generator=generator, dtype=torch.float64) - 15
    angle = 7 * torch.rand(60, generator=generator, dtype=torch.float64)
    normal = torch.stack([angle.cos(), angle.sin()], dim=-1)
    found = term.search(uv, normal, field)
    rows = zip(*(part.tolist() for part in found), strict=True)
    got = sorted((node, distance, weight) for node, distance, weight in rows if weight > 1e-6)
    expected = sorted(row for row in edges_along_lines(term, uv, normal, field) if row[2] > 1e-6)
    assert len(got) > (30 if kind == "gaussian" else 60)
    torch.testing.assert_close(torch.tensor(got), torch.tensor(expected), rtol=0, atol=2e-4)


def test_blocks_of_lines_are_invisible(
    monkeypatch: pytest.MonkeyPatch, generator: torch.Generator
) -> None:
    camera, field = make_camera(), rough_field(generator)
    nodes = random_nodes(camera, 2, generator=generator)
    whole = TERM.point_cost(nodes, camera, field)
    monkeypatch.setattr(contour, "_LINES", 7)
    for ours, theirs in zip(TERM.point_cost(nodes, camera, field), whole, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6 * float(theirs.abs().max()))


def test_edges_are_found_where_they_are() -> None:
    u = torch.tensor([50.0, 50.3, 57.5, 69.0, 85.0], dtype=torch.float64)
    uv = torch.stack([u, torch.full_like(u, 40.0)], dim=-1)
    normal = torch.tensor([1.0, 0.0], dtype=torch.float64).expand_as(uv)
    for sign in (1.0, -1.0):
        found = TERM.search(uv, sign * normal, ridges((60.0, 1.5, 0.8), (75.0, 1.5, 0.5)))
        for item, distances in enumerate(([10.0], [9.7], [2.5], [-9.0, 6.0], [-10.0])):
            near = (found.node == item) & (found.weight > 0)
            got = sorted((sign * found.distance[near]).tolist())
            assert got == pytest.approx(distances, abs=0.1)
        assert (found.weight >= 0).all()


def test_weights_are_the_response_and_share_one() -> None:
    uv = torch.tensor([[60.0, 40.0]], dtype=torch.float64)
    along = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    alone = TERM.search(uv, along, ridges((60.0, 2.0, 0.7)))
    assert float(alone.weight.sum()) == pytest.approx(0.7, abs=0.01)
    two = TERM.search(uv, along, ridges((56.0, 1.0, 0.9), (64.0, 1.0, 0.9)))
    assert float(two.weight.sum()) == pytest.approx(1.0)
    # An edge along the search line does not answer.
    across = TERM.search(uv, torch.tensor([[0.0, 1.0]]).double(), ridges((60.0, 2.0, 0.7)))
    assert not across.weight.any()


def largest_jump(cost: Callable[[Tensor], Tensor]) -> tuple[float, float]:
    """The largest change over a fiftieth of a pixel, and the range, as a contour slides by."""
    u = torch.arange(25.0, 105.0, 0.02, dtype=torch.float64)
    value = cost(u)
    return float(value.diff().abs().max()), float(value.max() - value.min())


@pytest.mark.parametrize("width", [1.0, 1.5, 2.5, 4.0])
def test_a_contour_slides_past_an_edge_without_jumps(width: float) -> None:
    """Over both ends of the window: the steepest honest slope is 0.01 in a fiftieth of a pixel."""
    jump, spread = largest_jump(lambda u: node_costs(ridges((64.3, width, 0.9)), u)[0])
    assert spread > 0.8 * TERM.unmatched * 0.9
    assert jump < 0.025 * spread


@pytest.mark.parametrize("apart", [6.0, 9.0, 11.0, 13.0, 20.0])
def test_an_edge_that_enters_the_window_does_not_shake_the_others(apart: float) -> None:
    field = ridges((58.3, 1.5, 0.9), (58.3 + apart, 1.5, 0.8))
    jump, spread = largest_jump(lambda u: node_costs(field, u)[0])
    assert jump < 0.025 * spread


def test_a_maximum_that_is_born_on_a_slope_starts_at_nothing() -> None:
    """A bump grows on the flank of an edge."""
    u = torch.full((1,), 50.0, dtype=torch.float64)
    steps = torch.linspace(0, 0.4, 401, dtype=torch.float64)  # of height, the step is 0.001
    value = torch.cat(
        [node_costs(ridges((60.0, 4.0, 0.9), (53.0, 1.2, float(s))), u)[0] for s in steps]
    )
    assert float(value.diff().abs().max()) < 0.06 * float(value.max() - value.min())


def test_slopes_pull_towards_the_edge() -> None:
    field = ridges((64.0, 1.5, 0.9))
    u = torch.tensor([58.0, 62.0, 66.0, 70.0], dtype=torch.float64)
    _, slope = node_costs(field, u)
    assert (slope[:2] < 0).all()
    assert (slope[2:] > 0).all()
    # The slope is that of the cost itself, but for the ripple of sampling and for the weights.
    fine = torch.arange(57.0, 63.0, 0.05, dtype=torch.float64)
    value, slope = node_costs(field, fine)
    change = (slope[1:] + slope[:-1]).sum() * 0.05 / 2
    assert float(change) == pytest.approx(float(value[-1] - value[0]), rel=0.1)


@pytest.mark.parametrize("window", [7.0, 11.5, 12.0])
@pytest.mark.parametrize("step", [1.0, 2.0, 1.7])
def test_windows_and_steps_of_any_length(window: float, step: float) -> None:
    term = ContourTerm(window=window, step=step)
    field = ridges((64.0, 2.0, 0.9))
    jump, spread = largest_jump(lambda u: node_costs(field, u, term)[0])
    assert jump < 0.04 * spread
    u = torch.tensor([64.0 - window - 0.3, 64.0 - window + 1.0], dtype=torch.float64)
    value = node_costs(field, u, term)[0]
    assert float(value[0]) == pytest.approx(term.unmatched, abs=1e-9)
    assert float(value[1]) < term.unmatched - 1e-3


def test_levels_are_ordered_as_the_paper_wants() -> None:
    """A good fit is better than no contour, that better than hidden, and a bad fit is the worst."""
    absent = TERM.fitted_level * TERM.nu
    hidden = TERM.occlusion_factor * absent
    perfect = float(node_costs(ridges((64.0, 1.5, 0.95)), torch.tensor([64.0]).double())[0])
    assert perfect < absent < hidden < TERM.unmatched


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("filled", [0.0, 1.0])
def test_images_without_structure(
    filled: float, dtype: torch.dtype, generator: torch.Generator
) -> None:
    """No edges, and all edge."""
    camera = make_camera()
    nodes = random_nodes(camera, 2, generator=generator)
    nodes = SeenNodes(*(part.to(dtype) for part in nodes))
    field = torch.full((2, HEIGHT, WIDTH), filled / math.sqrt(2), dtype=dtype)
    cost = TERM.point_cost(nodes, camera, field)
    seen = nodes.visible * TERM.unmatched + (1 - nodes.visible) * 1.1 * TERM.fitted_level
    expected = nodes.exists * seen + (1 - nodes.exists) * TERM.fitted_level
    assert all(part.dtype == dtype for part in cost)
    if filled == 0.0:
        torch.testing.assert_close(cost.value, expected)
        assert not cost.gradient.any()
        assert not cost.hessian.any()
    else:
        # The only maxima are at the border of the image, where the field ends.
        assert (cost.value <= expected + 1e-5).all()
        assert all(torch.isfinite(part).all() for part in cost)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nodes_that_the_camera_does_not_see_cost_as_unmatched(
    dtype: torch.dtype, generator: torch.Generator
) -> None:
    camera = make_camera()
    field = rough_field(generator).to(dtype)
    places = torch.tensor(
        [[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [5.0, 0.0, 1.0], [0.0, -9.0, 1.0], [1e20, 1.0, 1.0],
         [1e15, 1e15, 1e15]]
    ).double()  # fmt: skip
    points = (places - camera.t_camera_world) @ camera.R_camera_world
    normals = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    ones = torch.ones(6, dtype=dtype)
    nodes = SeenNodes(points.to(dtype), normals.to(dtype), ones, ones)
    cost = TERM.point_cost(nodes, camera, field)
    for part in cost:
        assert torch.isfinite(part).all()
    expected = torch.full((6,), TERM.unmatched, dtype=dtype)
    torch.testing.assert_close(cost.value[:5], expected[:5])
    assert not cost.gradient[:5].any()


def test_hidden_and_absent_nodes_have_no_pull(generator: torch.Generator) -> None:
    camera = make_camera()
    nodes = random_nodes(camera, generator=generator)
    field = rough_field(generator)
    zero, one = torch.zeros_like(nodes.exists), torch.ones_like(nodes.exists)
    hidden = TERM.point_cost(nodes._replace(exists=one, visible=zero), camera, field)
    absent = TERM.point_cost(nodes._replace(exists=zero, visible=one), camera, field)
    for cost, level in ((hidden, 1.1 * TERM.fitted_level), (absent, TERM.fitted_level)):
        torch.testing.assert_close(cost.value, level * one)
        assert not cost.gradient.any()
        assert not cost.hessian.any()
    seen = TERM.point_cost(nodes._replace(exists=one, visible=one), camera, field)
    assert (seen.value >= 0).all()
    assert (seen.value <= TERM.unmatched + 1e-6).all()


def printed_cost(u: float, term: ContourTerm, *ridge: tuple[float, float, float]) -> float:
    """Cost of a node beside edges of weight one."""
    field = torch.cat([ridges(*ridge), torch.ones(1, HEIGHT, WIDTH).double()])
    return float(node_costs(field, torch.tensor([u]).double(), term)[0])


def test_edges_add_up_as_printed() -> None:
    """Eq. 8: a second and a third edge each add half of their rho, and none is better than one."""
    edges = [(67.0, 1.0, 0.9), (72.0, 1.0, 0.9), (58.0, 1.0, 0.9)]
    halves = [0.5 * math.log(1 + (d / 2.5) ** 2) for d in (3.0, 8.0, 6.0)]
    for count in (1, 2, 3):
        got = printed_cost(64.0, AS_PRINTED, *edges[:count])
        assert got == pytest.approx(sum(halves[:count]), abs=0.02)
    nearest = PRINTED["gaussian"]
    assert printed_cost(64.0, nearest, *edges) == pytest.approx(0.5 * (3 / 8.5) ** 2, abs=0.01)
    assert printed_cost(64.0, AS_PRINTED) == AS_PRINTED.fitted_level
    assert printed_cost(64.0, AS_PRINTED, (66.0, 1.0, 0.39)) == AS_PRINTED.fitted_level


def test_weights_are_within_rho_as_printed() -> None:
    """At the edge's own pixel; in [RR] times the strength."""
    field = torch.cat([ridges((67.0, 1.0, 0.9)), torch.ones(1, HEIGHT, WIDTH).double()])
    field[2, :, 66:69] = 0.5
    u = torch.tensor([64.0], dtype=torch.float64)
    for strength, weight in ((False, 0.5), (True, 0.45)):
        got = node_costs(field, u, replace(AS_PRINTED, strength=strength))[0]
        assert float(got) == pytest.approx(0.5 * math.log(1 + weight * (3 / 2.5) ** 2), abs=0.01)


@pytest.mark.parametrize("term", PRINTED.values(), ids=PRINTED)
def test_no_limb_gains_by_hiding_as_printed(term: ContourTerm) -> None:
    """A node on its edge costs less than one that is hidden, or that faces away."""
    hidden = min(term.occlusion_factor, 1.0) * term.fitted_level * term.nu
    assert printed_cost(64.0, term, (64.0, 1.0, 0.9)) < 0.1 * hidden
    if term.assignment == "nearest":  # and wherever its edge is in the window
        assert printed_cost(64.0, term, (75.0, 1.0, 0.9)) < hidden


def test_no_nodes() -> None:
    empty = torch.zeros(2, 0, dtype=torch.float64)
    points = torch.zeros(2, 0, 3, dtype=torch.float64)
    nodes = SeenNodes(points, points, empty, empty)
    cost = TERM.point_cost(nodes, make_camera(), ridges())
    assert cost.value.shape == (2, 0)
    assert cost.hessian.shape == (2, 0, 3, 3)
