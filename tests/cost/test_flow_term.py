"""The flow term: targets and costs against plain twins, derivatives, continuity, bad input."""

from __future__ import annotations

import math

import pytest
import torch
from reference import flow_residual as reference
from reference.autograd import differentiated
from reference.camera import jacobian_of
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.surface import implicit
from torchcss.cost.flow import FlowTargets, FlowTerm, flow_targets
from torchcss.cost.interior import InteriorNodes
from torchcss.cost.visibility import SeenNodes, facing_nodes
from torchcss.errors import ConfigurationError, ShapeError
from torchcss.robust import Leclerc, Lorentzian
from torchcss.studies.render.sequences import arm_sequence
from torchcss.types import Curvature
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor
from torchcss.vision.flow import TRACKING_FLOW

WIDTH, HEIGHT = 64, 48
DISTORTION = [-0.33, 0.046, -0.0043, 0.0041, 0.067]


def make_camera(distortion: list[float] | None = None) -> Camera:
    return Camera(
        [[60.0, 0.0, 31.0], [0.0, 58.0, 24.0], [0.0, 0.0, 1.0]],
        (WIDTH, HEIGHT),
        distortion=distortion,
        R_camera_world=torch.diag(torch.tensor([1.0, -1.0, -1.0])),
        t_camera_world=[0.0, 0.0, 2.0],
    )


def make_body(dtype: torch.dtype = torch.float64) -> BodyModel:
    return load_body("arm8", dtype=dtype)


def random_poses(body: BodyModel, *batch: int, generator: torch.Generator) -> Tensor:
    size = (*batch, body.num_parameters)
    spread = 0.4 * torch.randn(size, generator=generator, dtype=torch.float64)
    return body.bounds.project(spread.to(body.dtype))


def random_flow(generator: torch.Generator) -> tuple[Tensor, Tensor]:
    coarse = torch.randn(1, 3, 5, 6, generator=generator, dtype=torch.float64)
    fine = torch.nn.functional.interpolate(coarse, size=(HEIGHT, WIDTH), mode="bicubic")[0]
    return 3 * fine[:2], fine[2].sigmoid()


def random_visibility(*shape: int, generator: torch.Generator) -> Tensor:
    drawn = torch.rand(*shape, generator=generator, dtype=torch.float64)
    return (1.4 * drawn - 0.2).clamp(0, 1)


def random_nodes(*batch: int, generator: torch.Generator, count: int = 24) -> tuple[Tensor, Tensor]:
    points = torch.rand(*batch, count, 3, generator=generator, dtype=torch.float64) - 0.5
    normals = torch.randn(*batch, count, 3, generator=generator, dtype=torch.float64)
    return 1.6 * points, normals / normals.norm(dim=-1, keepdim=True)


def random_targets(*batch: int, generator: torch.Generator, count: int = 24) -> FlowTargets:
    uv = torch.rand(*batch, count, 2, generator=generator, dtype=torch.float64)
    return FlowTargets(
        uv * torch.tensor([WIDTH, HEIGHT]), random_visibility(*batch, count, generator=generator)
    )


def seen(points: Tensor, normals: Tensor, visible: Tensor | None, camera: Camera) -> SeenNodes:
    """Nodes that face the camera or not, of which all are visible or some."""
    nodes = facing_nodes(points, normals, camera.centre_world)
    return nodes if visible is None else nodes._replace(visible=visible)


@pytest.mark.parametrize("name", ["arm7", "body34"])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_nodes_lie_on_the_surface_of_their_part(
    name: str, batch: tuple[int, ...], generator: torch.Generator
) -> None:
    body = load_body(name)
    nodes = InteriorNodes(body)
    pose = body.pose(random_poses(body, *batch, generator=generator))
    points, normals = nodes(body, pose)
    assert points.shape == normals.shape == (*batch, nodes.num_nodes, 3)
    assert 8 <= nodes.num_nodes / body.num_parts <= 16
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones_like(normals[..., 0]))
    assert torch.equal(nodes.node_link, body.part_link[nodes.node_part])
    rotation, centre = body.part_poses(pose)
    turn = rotation[..., nodes.node_part, :, :]
    local = (turn * (points - centre[..., nodes.node_part, :])[..., :, None]).sum(-2)
    shape = body.part_shape[nodes.node_part]
    surface = implicit(shape, local)
    torch.testing.assert_close(surface, torch.zeros_like(surface), rtol=0.0, atol=1e-9)
    outward = (turn * normals[..., :, None]).sum(-2)
    assert (implicit(shape, local + 1e-4 * outward) > 0).all()
    # The nodes move with their link: what the lift assumes.
    at_rest = body.pose(body.rest)
    link = at_rest.tree.rotation[nodes.node_link], at_rest.tree.translation[nodes.node_link]
    offset = (link[0] * (nodes(body, at_rest).points - link[1])[:, :, None]).sum(-2)
    moved = body.points_on_links(pose.tree, nodes.node_link, offset)
    torch.testing.assert_close(points, moved, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("distortion", [None, DISTORTION])
def test_targets_and_costs_are_those_of_the_twin(
    distortion: list[float] | None, generator: torch.Generator
) -> None:
    body, camera, term = make_body(), make_camera(distortion), FlowTerm(nu=1.2)
    nodes = InteriorNodes(body)
    flow, outlier = random_flow(generator)
    previous = random_poses(body, 3, generator=generator)
    was_visible = random_visibility(3, nodes.num_nodes, generator=generator)
    targets = flow_targets(
        seen(*nodes(body, body.pose(previous)), was_visible, camera), camera, flow, outlier
    )
    parent = torch.tensor([2, 0, 2, 1])
    x = random_poses(body, 4, generator=generator)
    visible = random_visibility(4, nodes.num_nodes, generator=generator)
    points, normals = nodes(body, body.pose(x))
    of_parents = FlowTargets(targets.uv[parent], targets.weight[parent])
    value = term.value(seen(points, normals, visible, camera), camera, of_parents)
    before = nodes(body, body.pose(previous))
    choices = {"nu": 1.2, "sigma": term.sigma, "level": term.fitted_level, "factor": 1.1}
    assert float(targets.weight.max()) > 0.3
    for sample in range(4):
        for node in range(nodes.num_nodes):
            mode = int(parent[sample])
            aim = reference.target(
                before.points[mode, node], before.normals[mode, node],
                float(was_visible[mode, node]), camera, flow, outlier,
            )  # fmt: skip
            got = *targets.uv[mode, node].tolist(), float(targets.weight[mode, node])
            assert got == pytest.approx(aim, abs=1e-9)
            cost = reference.cost(
                points[sample, node], normals[sample, node], float(visible[sample, node]),
                camera, aim, **choices,
            )  # fmt: skip
            assert float(value[sample, node]) == pytest.approx(cost, abs=1e-9)


@pytest.mark.parametrize("kind", [Lorentzian, Leclerc])
@pytest.mark.parametrize("distortion", [None, DISTORTION])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_derivatives_per_point_are_those_of_autograd(
    kind: type, distortion: list[float] | None, batch: tuple[int, ...], generator: torch.Generator
) -> None:
    """Normals point to the camera or away from it, where the facing ramp is flat: held fixed."""
    camera, term = make_camera(distortion), FlowTerm(potential_kind=kind, sigma=8.0)
    points, normals = random_nodes(*batch, generator=generator)
    towards = camera.centre_world - points
    normals = torch.where(
        (normals[..., :1] > -0.5), towards / towards.norm(dim=-1, keepdim=True), -towards
    )
    targets = random_targets(*batch, generator=generator)
    visible = random_visibility(*batch, 24, generator=generator)
    got = term.point_cost(seen(points, normals, visible, camera), camera, targets)
    leaf = points.clone().requires_grad_()
    value = term.value(seen(leaf, normals, visible, camera), camera, targets)
    expected = differentiated(value, leaf)
    assert int((expected.gradient != 0).any(-1).sum()) > 0
    for ours, theirs in zip(got, expected, strict=True):
        scale = float(theirs.abs().max())
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-11 * scale)


def test_gauss_newton_leaves_out_the_curvature_of_the_projection(
    generator: torch.Generator,
) -> None:
    camera, term = make_camera(), FlowTerm()
    points, _ = random_nodes(generator=generator)
    targets, one = random_targets(generator=generator), torch.ones(24, dtype=torch.float64)
    model = camera.project_with_derivatives(points)
    error = (model.uv - targets.uv).requires_grad_()
    rho = term.potential(targets.weight * error.square().sum(-1)).rho
    bowl = differentiated(0.5 * rho, error).hessian
    normals = camera.centre_world - points
    got = term.point_cost(seen(points, normals, one, camera), camera, targets, gauss_newton=True)
    jacobian = jacobian_of(camera, model)
    torch.testing.assert_close(got.hessian, jacobian.mT @ bowl @ jacobian)


def test_the_lifted_gradient_is_that_of_the_cost_in_x(generator: torch.Generator) -> None:
    """Where all nodes face the camera or none, the whole way from x by finite differences."""
    body, camera, term = make_body(), make_camera(), FlowTerm(sigma=5.0)
    nodes = InteriorNodes(body)
    flow, outlier = random_flow(generator)
    previous, x = random_poses(body, 2, generator=generator)
    targets = flow_targets(
        seen(*nodes(body, body.pose(previous)), None, camera), camera, flow, outlier
    )
    pose = body.pose(x)
    points, normals = nodes(body, pose)
    visible = torch.ones(nodes.num_nodes, dtype=torch.float64)
    toward = camera.centre_world - points
    facing = ((normals * toward).sum(-1) / toward.norm(dim=-1) > 0.3).double()

    def cost_of(state: Tensor) -> Tensor:
        moved = nodes(body, body.pose(state)).points
        faced = (camera.centre_world - moved) * (2 * facing - 1)[:, None]
        return term.value(seen(moved, faced, visible, camera), camera, targets).sum(-1)

    faced = toward * (2 * facing - 1)[:, None]
    cost = term.point_cost(seen(points, faced, visible, camera), camera, targets)
    model = body.lift(pose, points, nodes.node_link, cost, curvature=Curvature.EXACT)
    step = 1e-5 * torch.eye(body.num_parameters, dtype=torch.float64)
    ahead = torch.stack([cost_of(x + row) for row in step])
    behind = torch.stack([cost_of(x - row) for row in step])
    torch.testing.assert_close(model.gradient, (ahead - behind) / 2e-5, rtol=1e-6, atol=1e-7)
    curvature = (ahead + behind - 2 * cost_of(x)) / 1e-10
    torch.testing.assert_close(model.hessian.diagonal(), curvature, rtol=1e-4, atol=2e-4)


def test_a_body_that_moves_as_the_flow_says_has_no_residual(generator: torch.Generator) -> None:
    """A shift parallel to the image of a body seen from afar is a constant flow, if it is flat."""
    body = make_body()
    camera = Camera.pinhole(200, 160, focal_px=20000.0)
    far = body.with_base(torch.eye(3), torch.tensor([0.1, 0.0, 150.0]).double())
    moved = body.with_base(torch.eye(3), torch.tensor([0.1225, -0.015, 150.0]).double())
    x = random_poses(body, generator=generator)
    flow = torch.tensor([3.0, -2.0]).double()[:, None, None].expand(2, 160, 200)
    nodes = InteriorNodes(body)
    targets = flow_targets(seen(*nodes(far, far.pose(x)), None, camera), camera, flow)
    points, normals = nodes(moved, moved.pose(x))
    visible = torch.ones(nodes.num_nodes, dtype=torch.float64)
    error = (camera.project(points).uv - targets.uv).norm(dim=-1)
    assert float(error.max()) < 0.05
    term = FlowTerm()
    value = term.value(seen(points, normals, visible, camera), camera, targets)
    assert float(targets.weight.max()) == 1.0
    assert float(value.max()) <= term.fitted_level * term.nu + 1e-9
    assert float(value[targets.weight == 1.0].max()) < 1e-3
    still = term.value(seen(*nodes(far, far.pose(x)), visible, camera), camera, targets)
    assert (still[targets.weight == 1.0] > 0.5).all()


def test_costs_without_a_measurement(generator: torch.Generator) -> None:
    camera, term = make_camera(), FlowTerm(nu=2.0)
    points, normals = random_nodes(generator=generator)
    towards = camera.centre_world - points
    targets, one = random_targets(generator=generator), torch.ones(24, dtype=torch.float64)
    level = torch.full_like(one, term.fitted_level * term.nu)
    silent = targets._replace(weight=0 * one)
    behind = points + torch.tensor([0.0, 0.0, 3.0])
    far = 0.5 * term.potential(targets.weight * (WIDTH**2 + HEIGHT**2)).rho
    cases = (
        ("back-facing", points, -towards, one, targets, level),
        ("occluded", points, towards, 0 * one, targets, term.occlusion_factor * level),
        ("no target", points, towards, one, silent, level),
        ("behind the camera", behind, camera.centre_world - behind, one, targets,
         far + (1 - targets.weight) * level),
    )  # fmt: skip
    for name, where, normal, visible, aim, expected in cases:
        cost = term.point_cost(seen(where, normal, visible, camera), camera, aim)
        torch.testing.assert_close(cost.value, expected, msg=lambda text, name=name: name + text)
        assert not cost.gradient.any()
        assert not cost.hessian.any()
        torch.testing.assert_close(
            term.value(seen(where, normal, visible, camera), camera, aim), cost.value
        )
    assert not term.point_cost(
        seen(points, 0 * normals, one, camera), camera, targets
    ).gradient.any()
    # Eq. 9 has no constant for what was not measured.
    printed = FlowTerm(nu=2.0, printed=True)
    assert not printed.value(seen(points, towards, one, camera), camera, silent).any()


def test_nodes_out_of_sight_at_the_parent_have_no_target(generator: torch.Generator) -> None:
    body, camera = make_body(), make_camera()
    nodes = InteriorNodes(body)
    flow, outlier = random_flow(generator)
    x = random_poses(body, 2, generator=generator)
    known = flow_targets(seen(*nodes(body, body.pose(x)), None, camera), camera, flow, outlier)
    assert (known.weight > 0).any(-1).all()
    for shift in ((0.0, 0.0, 9.0), (7.0, 0.0, 0.0), (0.0, -1e6, 0.0)):
        away = body.with_base(torch.eye(3), torch.tensor(shift).double())
        gone = flow_targets(seen(*nodes(away, away.pose(x)), None, camera), camera, flow, outlier)
        assert not gone.weight.any()
        assert gone.uv.isfinite().all()
    hidden = torch.zeros(2, nodes.num_nodes, dtype=torch.float64)
    unseen = seen(*nodes(body, body.pose(x)), hidden, camera)
    assert not flow_targets(unseen, camera, flow, outlier).weight.any()
    doubted = flow_targets(
        seen(*nodes(body, body.pose(x)), None, camera), camera, flow, torch.ones_like(outlier)
    )
    assert not doubted.weight.any()
    trusted = flow_targets(seen(*nodes(body, body.pose(x)), None, camera), camera, flow)
    assert (trusted.weight >= known.weight).all()
    holes = flow.clone()
    holes[:, :, ::2] = 1e10
    holes[0, 3] = math.inf
    holes[1, 7] = math.nan
    patchy = flow_targets(seen(*nodes(body, body.pose(x)), None, camera), camera, holes, outlier)
    assert patchy.uv.isfinite().all()
    assert (patchy.weight <= known.weight + 1e-12).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_unknown_flow_does_not_shorten_that_beside_it(
    dtype: torch.dtype, generator: torch.Generator
) -> None:
    """A shift that is the same everywhere is that at the border of what is unknown too."""
    body, camera = make_body(dtype), make_camera().to(dtype)
    nodes = InteriorNodes(body)
    x = random_poses(body, 2, 2, generator=generator)
    shift = torch.tensor([20.0, -7.0], dtype=dtype)
    flow = shift[:, None, None].repeat(1, HEIGHT, WIDTH)
    flow[:, :, ::3] = math.inf
    flow[:, ::4] = math.nan
    flow[:, 10:20, 20:40] = 1e10
    targets = flow_targets(seen(*nodes(body, body.pose(x)), None, camera), camera, flow)
    uv, known = camera.project(nodes(body, body.pose(x)).points).uv, targets.weight > 0
    moved = targets.uv - uv
    torch.testing.assert_close(
        moved[known], shift.expand_as(moved[known]), rtol=0.0, atol=2e3 * torch.finfo(dtype).eps
    )
    assert 0 < float(targets.weight[known].min()) < 0.5 < float(targets.weight.max())
    nothing = flow_targets(
        seen(*nodes(body, body.pose(x)), None, camera), camera, torch.full_like(flow, math.inf)
    )
    assert torch.equal(nothing.uv, uv)
    assert not nothing.weight.any()


@pytest.mark.parametrize("sweep", ["turn", "leave", "approach"])
def test_the_cost_is_continuous_where_nodes_come_and_go(
    sweep: str, generator: torch.Generator
) -> None:
    body, camera, term = make_body(), make_camera(), FlowTerm()
    nodes = InteriorNodes(body)
    flow, outlier = random_flow(generator)
    x = random_poses(body, generator=generator)
    targets = flow_targets(seen(*nodes(body, body.pose(x)), None, camera), camera, flow, outlier)
    visible = torch.ones(nodes.num_nodes, dtype=torch.float64)

    start = nodes(body, body.pose(x))

    def along(steps: int) -> Tensor:
        t = torch.linspace(0.0, 1.0, steps, dtype=torch.float64)
        angle, nothing = 2 * math.pi * t * (sweep == "turn"), 0 * t
        c, s = angle.cos(), angle.sin()
        rows = [c, nothing, s, nothing, nothing + 1, nothing, -s, nothing, c]
        turn = torch.stack(rows, dim=-1).reshape(-1, 3, 3)
        shift = torch.stack([3 * t * (sweep == "leave"), nothing, 3 * t * (sweep == "approach")])
        points = start.points @ turn + shift.T[:, None]
        return term.value(seen(points, start.normals @ turn, visible, camera), camera, targets)

    coarse, fine = (float(along(steps).diff(dim=0).abs().max()) for steps in (2001, 8001))
    spread = float(along(101).max())
    assert fine < 0.1 * spread
    assert fine < 0.4 * coarse  # a jump would stay as it is


def test_a_true_pose_costs_less_than_its_neighbours(generator: torch.Generator) -> None:
    """The whole way from rendered frames: the truth against the pose before and one too far on."""
    sequence = arm_sequence(generator=generator, num_frames=4)
    body, camera = sequence.body, sequence.camera
    features = FeatureExtractor(flow=TRACKING_FLOW).double()(sequence.frames[3], sequence.frames[2])
    assert features.flow is not None
    nodes, term = InteriorNodes(body), FlowTerm()
    before, truth = sequence.states[2], sequence.states[3]
    targets = flow_targets(
        seen(*nodes(body, body.pose(before)), None, camera),
        camera,
        features.flow,
        features.flow_outlier,
    )
    x = torch.stack([truth, before, 2 * truth - before])
    visible = torch.ones(3, nodes.num_nodes, dtype=torch.float64)
    points, normals = nodes(body, body.pose(x))
    right, late, early = (
        term.value(seen(points, normals, visible, camera), camera, targets).mean(-1).tolist()
    )
    assert right < 0.8 * late
    assert right < 0.8 * early


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_types_and_awkward_points(dtype: torch.dtype, generator: torch.Generator) -> None:
    body, camera, term = make_body(dtype), make_camera(), FlowTerm()
    nodes = InteriorNodes(body)
    flow, outlier = (part.to(dtype) for part in random_flow(generator))
    x = random_poses(body, 2, 3, generator=generator)
    targets = flow_targets(seen(*nodes(body, body.pose(x)), None, camera), camera, flow, outlier)
    points, normals = nodes(body, body.pose(x))
    assert targets.uv.shape == (2, 3, nodes.num_nodes, 2)
    one = torch.ones(nodes.num_nodes, dtype=dtype)
    for part in (*targets, *term.point_cost(seen(points, normals, one, camera), camera, targets)):
        assert part.dtype == dtype
        assert part.isfinite().all()
    far = torch.tensor(
        [[1e6, 0, 0], [1e12, 1e12, -1e12], [0, 1e3, 2.0], [0, 0, 2], [0, 0, 1.95], [1, 1, 1]],
        dtype=dtype,
    )
    far[3] = camera.centre_world
    for aim in (0.0, 1e4, -1e9):
        wild = FlowTargets(torch.full((6, 2), aim, dtype=dtype), torch.ones(6, dtype=dtype))
        for part in term.point_cost(
            seen(far, -far, torch.ones(6, dtype=dtype), camera), camera, wild
        ):
            assert part.isfinite().all()


def test_bad_input_is_refused(generator: torch.Generator) -> None:
    body, camera = make_body(), make_camera()
    nodes, x = InteriorNodes(body), body.rest
    flow, outlier = random_flow(generator)
    with pytest.raises(ShapeError, match="flow: expected"):
        flow_targets(seen(*nodes(body, body.pose(x)), None, camera), camera, flow[:, 1:])
    with pytest.raises(ShapeError, match="one flow"):
        flow_targets(seen(*nodes(body, body.pose(x)), None, camera), camera, flow[None])
    with pytest.raises(ShapeError, match="outlier: expected"):
        flow_targets(seen(*nodes(body, body.pose(x)), None, camera), camera, flow, outlier[:, 1:])
    with pytest.raises(ConfigurationError, match="sigma"):
        _ = FlowTerm(sigma=0.0).potential


@pytest.mark.parametrize("miss", [0.0, 0.5, 0.8])
def test_no_node_gains_by_facing_away_or_hiding(miss: float, generator: torch.Generator) -> None:
    """A node costs less where it misses the flow by as much as fitted bodies do."""
    camera, term = make_camera(), FlowTerm()
    points, _ = random_nodes(3, generator=generator)
    here = camera.project(points).uv
    away = torch.randn(*here.shape, generator=generator, dtype=torch.float64)
    uv = here + miss * away / away.norm(dim=-1, keepdim=True)
    targets = FlowTargets(uv, torch.ones_like(uv[..., 0]))
    one = torch.ones_like(targets.weight)
    facing = SeenNodes(points, torch.zeros_like(points), one, one)
    cost = term.value(facing, camera, targets)
    assert (cost < term.value(facing._replace(exists=0 * one), camera, targets)).all()
    assert (cost < term.value(facing._replace(visible=0 * one), camera, targets)).all()
