"""Visibility: contours on the surface and on the rendered outline, hidden nodes by casting rays."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from reference.visibility import boundary_distance, is_hidden, shape_function
from torch import Tensor

from torchcss.body.catalog import BODY_NAMES
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.surface import surface_points
from torchcss.cost import visibility
from torchcss.cost.contour import ContourTerm
from torchcss.cost.interior import InteriorNodes
from torchcss.cost.visibility import (
    ContourPredictor,
    SeenNodes,
    facing_nodes,
    line_of_sight,
    visible_nodes,
)
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import grid_faces, rasterise

EYE = torch.zeros(3, dtype=torch.float64)
UPRIGHT = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""A body that stands upright before a camera at the origin, which looks along z with y down."""


def before_camera(name: str, *, dtype: torch.dtype = torch.float64) -> BodyModel:
    depth = 3.5 if name.startswith("body") else 2.0
    body = load_body(name, dtype=dtype)
    return body.with_base(UPRIGHT.to(dtype), torch.tensor([0.1, 0.0, depth]).to(dtype))


def with_shapes(body: BodyModel, shape: Tensor) -> BodyModel:
    """The same body with other flesh."""
    body = body.with_base(body.base_rotation, body.base_translation)
    body._buffers["part_shape"] = shape
    return body


def uniform(low: float, high: float, *size: int, generator: torch.Generator) -> Tensor:
    return low + (high - low) * torch.rand(size, generator=generator, dtype=torch.float64)


def poses_about_rest(body: BodyModel, *batch: int, generator: torch.Generator) -> Tensor:
    size = (*batch, body.num_parameters)
    noise = torch.randn(size, generator=generator, dtype=torch.float64)
    spread = torch.where(body.sticky_deviation.isfinite(), body.sticky_deviation.double(), 0.4)
    return body.bounds.project(body.sticky_mean.double() + spread * noise)


def any_poses(body: BodyModel, count: int, *, generator: torch.Generator) -> Tensor:
    """Half of them about the rest pose, half anywhere in the limits; seen from all sides."""
    tame = poses_about_rest(body, count - count // 2, generator=generator)
    wild = poses_about_rest(body, count // 2, generator=generator)
    bounded = body.lower.isfinite() & body.upper.isfinite()
    span = torch.where(bounded, body.upper - body.lower, 0.0).double()
    fraction = uniform(0, 1, *wild.shape, generator=generator)
    wild = torch.where(bounded, body.lower.double() + fraction * span, wild)
    x = torch.cat([tame, wild])
    if "root_yaw" in body.state_names:
        x[:, body.state_index("root_yaw")] = uniform(-3.1, 3.1, count, generator=generator)
    return body.bounds.project(x)


def check_against_rays(body: BodyModel, x: Tensor) -> None:
    """99.9 % of nodes as the ray caster says; the others a millimetre or two from a boundary."""
    pose = body.pose(x)
    predictor, interior = ContourPredictor(body), InteriorNodes(body)
    contour, inner = predictor(body, pose, EYE), interior(body, pose)
    points = torch.cat([contour.points, inner.points], dim=-2)
    own = torch.cat([predictor.node_part, interior.node_part])
    seen = visible_nodes(body, pose, EYE, points, own)
    # Contours that do not exist are not looked at; the others are seen as any node is.
    exists = contour.exists > 0
    of_contour = seen[..., : predictor.num_nodes]
    torch.testing.assert_close(contour.visible[exists], of_contour[exists], rtol=0, atol=1e-4)
    hidden = seen < 0.5
    truth = is_hidden(body, pose, EYE, points, own)
    assert 0.1 < float(truth.double().mean()) < 0.9
    check(body, x, points, own, hidden, truth, by_own=False)
    # Facing: of convex parts exactly the nodes that face away are hidden by their own part.
    away = facing_nodes(inner.points, inner.normals, EYE).exists == 0
    truth = is_hidden(body, pose, EYE, inner.points, interior.node_part, by_own=True)
    if not body.part_shape[:, 7].any():
        check(body, x, inner.points, interior.node_part, away, truth, by_own=True)
    else:
        assert float((truth | ~away).double().mean()) > 0.999


def check(
    body: BodyModel,
    x: Tensor,
    points: Tensor,
    own: Tensor,
    hidden: Tensor,
    truth: Tensor,
    *,
    by_own: bool,
) -> None:
    wrong = hidden != truth
    assert float(wrong.double().mean()) < 1e-3
    for item in wrong.any(-1).nonzero()[:, 0].tolist():
        nodes = wrong[item]
        distance = boundary_distance(
            body, body.pose(x[item]), EYE, points[item, nodes], own[nodes], (5e-4, 1e-3, 2e-3),
            by_own=by_own,
        )  # fmt: skip
        assert float(distance.max()) <= 2e-3


@pytest.mark.parametrize("name", BODY_NAMES)
def test_agrees_with_casting_rays(name: str, generator: torch.Generator) -> None:
    """Contour nodes and interior nodes of every body, half of the poses anywhere in the limits."""
    body = before_camera(name)
    poses = 40 if name in ("body30", "body32") else 100  # the flesh is that of body34
    check_against_rays(body, any_poses(body, poses, generator=generator))


@pytest.mark.parametrize("kind", ["round", "boxes", "diamonds", "tapered", "bent", "all"])
@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_agrees_for_parts_of_any_shape(name: str, kind: str, generator: torch.Generator) -> None:
    body = before_camera(name)
    shape, parts = body.part_shape.clone(), body.num_parts
    low, high = {"boxes": (0.2, 1.0), "diamonds": (1.0, 1.8), "all": (0.2, 1.0)}.get(
        kind, (0.65, 1.2)
    )
    shape[:, 3:5] = uniform(low, high, parts, 2, generator=generator)
    taper = 0.7 if kind in ("tapered", "all") else 0.34
    shape[:, 5:7] = uniform(-taper, taper, parts, 2, generator=generator)
    if kind in ("bent", "all"):  # up to 80 degrees from end to end
        bend = uniform(0, 3, parts, generator=generator)
        direction = uniform(0, 2 * math.pi, parts, generator=generator)
        shape[:, 7], shape[:, 8] = bend * direction.cos(), bend * direction.sin()
    body = with_shapes(body, shape)
    check_against_rays(body, any_poses(body, 16, generator=generator))


@pytest.mark.parametrize("taper", [-0.34, 0.0])
@pytest.mark.parametrize("exponents", [(0.65, 0.65), (0.65, 1.2), (1.2, 1.2), (0.7, 1.0)])
def test_a_few_steps_find_where_a_line_is_nearest_to_a_round_part(
    exponents: tuple[float, float], taper: float, generator: torch.Generator
) -> None:
    """Against two thousand points of each line; of what grazes a part 99 % err by below 0.01."""
    numbers = [0.04, 0.045, 0.16, *exponents, taper, taper, 0.0, 0.0]
    shape = torch.tensor([numbers], dtype=torch.float64)
    parts = visibility.tabulate_parts(shape)
    assert bool(parts.plain.all())
    place, along = torch.randn(2, 3000, 3, generator=generator, dtype=torch.float64)
    along, place = along / along.norm(dim=-1, keepdim=True), 0.7 * shape[0, :3] * place
    foot = place - (place * along).sum(-1, keepdim=True) * along
    half = (parts.radius.square() - foot.square().sum(-1)).clamp(min=0).sqrt()
    number, part = torch.arange(len(foot)), torch.zeros(len(foot), dtype=torch.long)
    (x, y, z), (u, v, w) = foot.unbind(-1), along.unbind(-1)
    lines = visibility._Stretches(number, part, x, y, z, u, v, w, -half, half)
    found = visibility._least_gap(parts, lines, len(foot), plain=True)
    share, truths = torch.linspace(0, 1, 2001, dtype=torch.float64)[:, None], []
    for some in number.split(50):  # that stay in the processor's cache
        few = lines.take(some)
        square, slope = visibility.radial_square(
            parts.shapes(part[some]), *few.point(torch.lerp(few.begin, few.end, share)), bent=False
        )
        radial = square.sqrt()
        nearest = radial.argmin(0, keepdim=True)
        radial, *slope = (each.gather(0, nearest)[0] for each in (radial, *slope))
        truths.append((radial - 1) * radial / torch.stack(slope).norm(dim=0))
    truth = torch.cat(truths)
    graze = (half > 0) & (truth.abs() < visibility.RAMP) & found.isfinite()
    assert int(graze.sum()) > 300
    assert float(((found - truth)[graze] / visibility.RAMP).abs().quantile(0.99)) < 0.01


def test_the_reference_knows_the_surface(generator: torch.Generator) -> None:
    """Its shape function against the map from angles to points."""
    for _ in range(20):
        size = uniform(0.05, 0.3, 3, generator=generator)
        exponents = uniform(0.3, 1.7, 2, generator=generator)
        deform = uniform(-0.8, 0.8, 4, generator=generator) * torch.tensor([1.0, 1.0, 2.0, 2.0])
        shape = torch.cat([size, exponents, deform])
        eta, omega = (
            uniform(-1.5, 1.5, 50, generator=generator),
            uniform(-3, 3, 50, generator=generator),
        )
        sample = surface_points(shape.expand(50, 9), eta, omega)
        assert float(shape_function(shape, sample.points).abs().max()) < 1e-9
        for distance, sign in ((1e-4, 1), (-1e-4, -1)):
            moved = shape_function(shape, sample.points + distance * sample.normals)
            assert (moved.sign() == sign).double().mean() > 0.95  # not where edges are sharp


def test_slight_bends_are_exact_in_single_precision(generator: torch.Generator) -> None:
    body = before_camera("arm8")
    x = any_poses(body, 20, generator=generator)
    straight = ContourPredictor(body)(body, body.pose(x), EYE)
    for bend in (1e-7, 2e-6, 1e-4):
        shape = body.part_shape.clone()
        shape[:, 7:] = bend
        other = with_shapes(body, shape)
        bent = ContourPredictor(other)(other, other.pose(x), EYE)
        assert float((bent.visible - straight.visible).abs().max()) < 0.01
        assert float((bent.exists - straight.exists).abs().max()) < 0.01


WIDTH, HEIGHT, FINER = 640, 480, 2


def draw(body: BodyModel, x: Tensor, camera: Camera) -> Tensor:
    """Which part is seen, -1 for none, on a raster `FINER` times as fine as the image."""
    rings, meridians = 48, 48
    rotation, centre = body.part_poses(body.pose(x))
    mesh = body.mesh(rings, meridians).points.flatten(1, 2)
    vertices = mesh @ rotation.transpose(-1, -2) + centre[:, None, :]
    faces = grid_faces(rings, meridians)
    every = faces + (torch.arange(body.num_parts) * rings * meridians)[:, None, None]
    projection = camera.project(vertices.flatten(0, 1))
    uv = (projection.uv + 0.5) * FINER - 0.5
    face = rasterise(
        uv, projection.depth, every.flatten(0, 1), FINER * HEIGHT, FINER * WIDTH,
        valid=projection.valid,
    ).face  # fmt: skip
    return torch.where(face >= 0, face // len(faces), -1)


def outline(region: Tensor) -> Tensor:
    """Where a region of the fine raster ends, pixels of the image `[m 2]`."""
    down = (region[1:] != region[:-1]).nonzero() + torch.tensor([0.5, 0.0])
    right = (region[:, 1:] != region[:, :-1]).nonzero() + torch.tensor([0.0, 0.5])
    return ((torch.cat([down, right]).double() + 0.5) / FINER - 0.5).flip(-1)


def distances(points: Tensor, line: Tensor) -> Tensor:
    """Distance of each point to the nearest of a line's."""
    return torch.cdist(points, line).amin(-1) if len(line) else points.new_full((len(points),), 1e9)


@pytest.mark.parametrize(("name", "poses", "depth"), [("arm8", 6, 1.5), ("body34", 5, 3.0)])
def test_contours_lie_on_the_rendered_outlines(
    name: str, poses: int, depth: float, generator: torch.Generator
) -> None:
    """Every existing, visible node is within 1.5 px of where its part's picture ends.

    Where a part ends in the picture includes inner contours, in front of other parts; nothing is
    left out. Nodes with nothing half a pixel beside them, nearer or farther, are on the boundary of
    the silhouette too, and that boundary has predicted nodes all along.
    """
    body = load_body(name, dtype=torch.float64)
    body = body.with_base(UPRIGHT, torch.tensor([0.1, 0.0, depth]).double())
    camera = Camera.pinhole(WIDTH, HEIGHT, focal_px=600.0).double()
    predictor = ContourPredictor(body)
    x = any_poses(body, 2 * poses, generator=generator)[poses // 2 :][:poses]
    inner, outer, covered = [], [], []
    for state in x:
        pose = body.pose(state)
        nodes = predictor(body, pose, EYE)
        uv = camera.project(nodes.points).uv
        margin = torch.minimum(uv, torch.tensor([WIDTH - 1.0, HEIGHT - 1.0]) - uv).amin(-1)
        use = (nodes.exists > 0.5) & (nodes.visible > 0.5) & (margin > 3)
        seen = draw(body, state, camera)
        for part in range(body.num_parts):
            of_part = use & (predictor.node_part == part)
            inner.append(distances(uv[of_part], outline(seen == part)))
        beside = 2.0 * (nodes.points + 0.5 / 600.0 * nodes.points[:, 2:] * nodes.normals)
        nobody = torch.full_like(predictor.node_part, -1)
        alone = use & ~is_hidden(body, pose, EYE, beside, nobody)
        boundary = outline(seen >= 0)
        outer.append(distances(uv[alone], boundary))
        covered.append(distances(boundary, uv[use]))
    inner, outer, covered = torch.cat(inner), torch.cat(outer), torch.cat(covered)
    assert len(outer) > 0.7 * len(inner) > 50 * poses
    assert float(inner.max()) < 1.5
    assert float(inner.mean()) < 0.3
    assert float(outer.max()) < 1.5
    assert float((covered < 10).double().mean()) > 0.95
    assert float((covered < 20).double().mean()) > 0.99


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_nodes_lie_on_their_part_where_it_turns_from_sight(
    name: str, generator: torch.Generator
) -> None:
    body = before_camera(name)
    predictor = ContourPredictor(body)
    x = any_poses(body, 10, generator=generator)
    nodes = predictor(body, body.pose(x), EYE)
    assert predictor.node_part.shape == predictor.node_link.shape == (predictor.num_nodes,)
    assert torch.equal(body.part_link[predictor.node_part], predictor.node_link)
    torch.testing.assert_close(nodes.normals.norm(dim=-1), torch.ones_like(nodes.exists))
    assert ((nodes.exists >= 0) & (nodes.exists <= 1)).all()
    assert ((nodes.visible >= 0) & (nodes.visible <= 1)).all()
    # Grazing, on interpolated normals.
    sight = EYE - nodes.points
    sight = sight / sight.norm(dim=-1, keepdim=True)
    cosine = (nodes.normals * sight).sum(-1).abs()
    assert float(cosine[nodes.exists > 0].max()) < math.sin(math.radians(0.2))
    # On the surface, to a third of a millimetre.
    rotation, centre = body.part_poses(body.pose(x))
    for part in range(body.num_parts):
        of_part = predictor.node_part == part
        local = (nodes.points[:, of_part] - centre[:, None, part]) @ rotation[:, part]
        local = local[nodes.exists[:, of_part] > 0]
        away = 3e-4 * local / local.norm(dim=-1, keepdim=True) / 0.6
        assert (shape_function(body.part_shape[part], local + away) > 0).all()
        assert (shape_function(body.part_shape[part], local - away) < 0).all()


def test_a_ball_has_the_contour_of_its_cone() -> None:
    """The contour of a ball is a circle in a known plane."""
    radius, distance = 0.1, 0.5
    ball = torch.tensor([radius] * 3 + [1.0, 1.0, 0, 0, 0, 0], dtype=torch.float64)
    body = before_camera("arm7")
    body = with_shapes(body, ball.expand(body.num_parts, 9).clone())
    predictor = ContourPredictor(body)
    pose = body.pose(body.rest)
    _, centre = body.part_poses(pose)
    eye = centre[0] + torch.tensor([0.0, 0.0, -distance], dtype=torch.float64)
    nodes = predictor(body, pose, eye)
    own = (predictor.node_part == 0) & (nodes.exists > 0)
    assert int(own.sum()) > 20
    away = nodes.points[own] - centre[0]
    height = torch.full_like(away[:, 2], -radius * radius / distance)
    torch.testing.assert_close(away[:, 2], height, rtol=0, atol=1.5e-3)
    length = torch.full_like(away[:, 2], radius)
    torch.testing.assert_close(away.norm(dim=-1), length, rtol=0, atol=2e-4)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_leading_shapes_and_types(
    batch: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator
) -> None:
    double = before_camera("arm8")
    body = before_camera("arm8", dtype=dtype)
    predictor = ContourPredictor(body)
    x = poses_about_rest(double, *batch, generator=generator)
    nodes = predictor(body, body.pose(x.to(dtype)), EYE.to(dtype))
    expected = ContourPredictor(double)(double, double.pose(x), EYE)
    p = predictor.num_nodes
    assert nodes.points.shape == nodes.normals.shape == (*batch, p, 3)
    assert nodes.exists.shape == nodes.visible.shape == (*batch, p)
    for ours, theirs in zip(nodes, expected, strict=True):
        assert ours.dtype == dtype
        assert not ours.isnan().any()
        if x.numel():
            assert float((ours.double() - theirs).abs().mean()) < 1e-3
    points = nodes.points[..., :7, :]
    seen = visible_nodes(body, body.pose(x.to(dtype)), EYE, points, predictor.node_part[:7])
    assert seen.shape == (*batch, 7)
    assert seen.dtype == dtype
    torch.testing.assert_close(seen, nodes.visible[..., :7], rtol=0, atol=1e-4)


def test_items_of_a_batch_do_not_meet(generator: torch.Generator) -> None:
    """More poses than are tested at a time; some of the parts need the longer search."""
    body = before_camera("body34")
    shape = body.part_shape.clone()
    shape[::3, 3] = 0.3
    body = with_shapes(body, shape)
    predictor = ContourPredictor(body)
    x = any_poses(body, 60, generator=generator)
    together = predictor(body, body.pose(x), EYE)
    for item in (0, 17, 35, 59):
        alone = predictor(body, body.pose(x[item]), EYE)
        for ours, theirs in zip(together, alone, strict=True):
            torch.testing.assert_close(ours[item], theirs, rtol=1e-5, atol=2e-5)


def test_line_of_sight_without_neighbours(generator: torch.Generator) -> None:
    body = before_camera("body34")
    predictor = ContourPredictor(body)
    pose = body.pose(poses_about_rest(body, 3, generator=generator))
    nodes = predictor(body, pose, EYE)
    rotation, centre = body.part_poses(pose)
    eye = -(centre[..., None, :] @ rotation)[..., 0, :]
    scene = body.part_shape, rotation, eye, nodes.points
    visible = line_of_sight(*scene, predictor.other > 0)
    assert torch.equal(visible[nodes.exists > 0], nodes.visible[nodes.exists > 0])
    # What is beside a neighbour is in front of it or behind it, and only there is it not free.
    touching = predictor.touching > 0
    reach = 3.5 * body.part_shape[:, :2].mean(-1).expand_as(predictor.touching)
    free = line_of_sight(*scene, touching, behind=reach)
    by_neighbour = line_of_sight(*scene, touching)
    assert (free <= by_neighbour + 1e-3).all()
    assert float((by_neighbour - free).max()) == 1


def test_an_arm_that_points_at_the_camera_has_a_contour_from_its_meridians() -> None:
    body = before_camera("arm7")
    predictor = ContourPredictor(body)
    pose = body.pose(torch.zeros(7, dtype=torch.float64))
    _, centre = body.part_poses(pose)
    forearm = body.part_names.index("r_forearm")
    # Straight below the hanging arm, looking up along it.
    eye = centre[forearm] + UPRIGHT @ torch.tensor([0.0, -2.0, 0.0], dtype=torch.float64)
    nodes = predictor(body, pose, eye)
    per_part = predictor.num_nodes // body.num_parts
    from_meridians = torch.arange(predictor.num_nodes) % per_part >= 2 * predictor.num_rings
    upper = predictor.node_part == body.part_names.index("r_upper_arm")
    assert int((nodes.exists[upper & from_meridians] > 0.5).sum()) >= 6
    # From the side, the rings do it.
    side = predictor(body, pose, EYE)
    assert int((side.exists[upper & ~from_meridians] > 0.5).sum()) >= predictor.num_rings


def test_an_arm_is_hidden_behind_the_body_and_not_before_it() -> None:
    body = before_camera("body34")
    predictor = ContourPredictor(body)
    for yaw in (math.pi / 2, -math.pi / 2):  # seen from either side
        x = body.rest.clone()
        x[body.state_index("root_yaw")] = yaw
        pose = body.pose(x)
        nodes = predictor(body, pose, EYE)
        seen = {}
        for side in ("l", "r"):
            part = predictor.node_part == body.part_names.index(f"{side}_forearm")
            part &= nodes.exists > 0.5
            depth = pose.joints[body.joint_index(f"{side}_elbow"), 2]
            seen[float(depth)] = float(nodes.visible[part].mean())
        assert seen[min(seen)] > 0.9
        assert seen[max(seen)] < 0.3


def test_visibility_fades_without_jumps() -> None:
    """A forearm sweeps before the body, a millimetre a step: no node behind it flips."""
    body = before_camera("body34")
    predictor = ContourPredictor(body)
    num = 801
    x = body.rest.repeat(num, 1)
    x[:, body.state_index("l_elbow_flexion")] = math.radians(90)
    x[:, body.state_index("l_shoulder_twist")] = torch.linspace(-1.5, 1.5, num).double()
    nodes = predictor(body, body.pose(x), EYE)
    still = [body.part_names.index(name) for name in ("pelvis", "chest", "r_forearm", "neck")]
    behind = torch.isin(predictor.node_part, torch.tensor(still))
    visible = nodes.visible[:, behind]
    assert float((visible.amax(0) - visible.amin(0)).max()) > 0.9
    assert float(visible.diff(dim=0).abs().max()) < 0.3


def largest_change(values: Callable[[Tensor], Tensor], x: Tensor) -> float:
    """Of values `[b p]` along a path of states, where it changes most, in a hundredth of a step."""
    step = int(values(x).diff(dim=0).abs().amax(-1).argmax())
    fraction = torch.linspace(0, 1, 101, dtype=x.dtype)[:, None]
    return float(values(torch.lerp(x[step], x[step + 1], fraction)).diff(dim=0).abs().max())


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_no_node_comes_or_goes_at_once(name: str, generator: torch.Generator) -> None:
    """Where one appears most suddenly on a path, steps of 20 microradians leave nothing of it.

    A node may jump only while it does not count, when its ring or meridian has found another
    crossing. The same holds for the cost, over an image without edges: it is then a constant times
    the share of nodes that are seen.
    """
    body = before_camera(name)
    predictor, term = ContourPredictor(body), ContourTerm()
    camera = Camera.pinhole(WIDTH, HEIGHT, focal_px=600.0).double()
    blank = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.float64)

    def counts(x: Tensor) -> Tensor:
        nodes = predictor(body, body.pose(x), EYE)
        return nodes.exists * nodes.visible

    def cost(x: Tensor) -> Tensor:
        return term.value(predictor(body, body.pose(x), EYE), camera, blank).mean(-1, keepdim=True)

    for start in any_poses(body, 5, generator=generator):
        direction = uniform(-1, 1, body.num_parameters, generator=generator)
        x = start + torch.linspace(-0.1, 0.1, 101).double()[:, None] * direction
        assert largest_change(counts, x) < 0.03
        assert largest_change(cost, x) < 0.0005
        nodes = predictor(body, body.pose(x), EYE)
        weight = nodes.exists * nodes.visible
        moved = nodes.points.diff(dim=0).norm(dim=-1)
        assert float((moved * torch.minimum(weight[1:], weight[:-1])).max()) < 0.04


def test_visibility_past_bent_boxes_has_no_jumps(generator: torch.Generator) -> None:
    body = before_camera("body34")
    shape = body.part_shape.clone()
    shape[:, 3:5] = uniform(0.3, 1.0, len(shape), 2, generator=generator)
    shape[:, 7:] = uniform(-1.5, 1.5, len(shape), 2, generator=generator)
    body = with_shapes(body, shape)
    interior = InteriorNodes(body)

    def visible(x: Tensor) -> Tensor:
        pose = body.pose(x)
        return visible_nodes(body, pose, EYE, interior(body, pose).points, interior.node_part)

    for start in any_poses(body, 2, generator=generator):
        direction = uniform(-1, 1, body.num_parameters, generator=generator)
        x = start + torch.linspace(-0.1, 0.1, 101).double()[:, None] * direction
        assert largest_change(visible, x) < 0.03


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["own", "bent"])
@pytest.mark.parametrize(
    "place",
    [(0.0, 0.0, -3.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1e-3), (5e3, 0.0, 1.0), (1e15, -1e15, 1e15)],
)
def test_awkward_places_give_no_nan(
    place: tuple[float, float, float],
    kind: str,
    dtype: torch.dtype,
    generator: torch.Generator,
) -> None:
    """Behind the camera, around it, touching it, far off."""
    body = before_camera("body34", dtype=dtype)
    body = body.with_base(body.base_rotation, torch.tensor(place, dtype=dtype))
    if kind == "bent":
        shape = body.part_shape.clone()
        shape[:, 3:5] = uniform(0.05, 2.5, len(shape), 2, generator=generator).to(dtype)
        shape[:, 7:] = uniform(-3, 3, len(shape), 2, generator=generator).to(dtype)
        body = with_shapes(body, shape)
    predictor = ContourPredictor(body)
    x = poses_about_rest(body, 5, generator=generator).to(dtype)
    for part in predictor(body, body.pose(x), EYE.to(dtype)):
        assert not part.isnan().any()


def test_a_body_far_off_is_seen_as_one_nearby_is(generator: torch.Generator) -> None:
    """At 300 m single precision still tells parts from each other."""
    body = load_body("body34", dtype=torch.float64)
    body = body.with_base(UPRIGHT, torch.tensor([20.0, 5.0, 300.0]).double())
    check_against_rays(body, any_poses(body, 10, generator=generator))


def test_parts_behind_the_camera_hide_nothing() -> None:
    """A chest at the camera's back, exactly opposite to the limbs that it sees."""
    body = before_camera("body34")
    predictor = ContourPredictor(body)
    x = body.rest.clone()
    for side in ("l", "r"):
        x[body.state_index(f"{side}_elbow_flexion")] = math.radians(90)
    pose = body.pose(x)
    _, centre = body.part_poses(pose)
    chest = body.part_names.index("chest")
    eye = centre[chest] + torch.tensor([0.0, 0.0, -0.22], dtype=torch.float64)
    nodes = predictor(body, pose, eye)
    truth = is_hidden(body, pose, eye, nodes.points, predictor.node_part)
    seen = (predictor.node_part == body.part_names.index("l_hand")) & ~truth
    assert int(seen.sum()) > 10
    assert float((nodes.visible[seen] > 0.5).double().mean()) == 1


def test_a_body_without_flesh(generator: torch.Generator) -> None:
    body = before_camera("arm8")
    bare = body.with_base(body.base_rotation, body.base_translation)
    for name in ("part_link", "part_rotation", "part_translation", "part_shape"):
        bare._buffers[name] = getattr(body, name)[:0]
    bare.part_names, bare.neighbours = (), ()
    nodes = ContourPredictor(bare)(bare, bare.pose(any_poses(body, 3, generator=generator)), EYE)
    assert isinstance(nodes, SeenNodes)
    assert nodes.points.shape == (3, 0, 3)
    assert nodes.visible.shape == nodes.exists.shape == (3, 0)
