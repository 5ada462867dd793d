"""Occluding contours and occlusion: on the surface, at grazing angle, against marched rays."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchcss.body.model import BodyModel, load_body
from torchcss.body.surface import implicit
from torchcss.cost.visibility import ContourNodes, ContourPredictor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from reference.visibility import is_hidden, neighbourhood

EYE = torch.zeros(3, dtype=torch.float64)
UPRIGHT = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""A body that stands upright before a camera at the origin, which looks along z with y down."""


def before_camera(name: str, *, dtype: torch.dtype = torch.float64) -> BodyModel:
    depth = 3.5 if name.startswith("body") else 2.0
    body = load_body(name, dtype=dtype)
    return body.with_base(UPRIGHT.to(dtype), torch.tensor([0.1, 0.0, depth]).to(dtype))


def poses_about_rest(body: BodyModel, *batch: int, generator: torch.Generator) -> Tensor:
    size = (*batch, body.num_parameters)
    noise = torch.randn(size, generator=generator, dtype=torch.float64)
    spread = torch.where(body.sticky_deviation.isfinite(), body.sticky_deviation.double(), 0.4)
    return body.bounds.project(body.sticky_mean.double() + spread * noise)


def local_frame(body: BodyModel, nodes: ContourNodes, x: Tensor, part_of: Tensor) -> Tensor:
    rotation, centre = body.part_poses(body.pose(x))
    away = nodes.points - centre[..., part_of, :]
    return (rotation[..., part_of, :, :] * away[..., :, None]).sum(-2)


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_nodes_lie_on_their_part_where_it_turns_from_sight(
    name: str, generator: torch.Generator
) -> None:
    body = before_camera(name)
    predictor = ContourPredictor(body)
    x = poses_about_rest(body, 6, generator=generator)
    nodes = predictor(body, body.pose(x), EYE)
    assert predictor.node_part.shape == predictor.node_link.shape == (predictor.num_nodes,)
    assert torch.equal(body.part_link[predictor.node_part], predictor.node_link)
    exists = nodes.exists > 0
    torch.testing.assert_close(nodes.normals.norm(dim=-1), torch.ones_like(nodes.exists))
    # Grazing: the crossing is found by linear interpolation, to a degree or so.
    sight = EYE - nodes.points
    sight = sight / sight.norm(dim=-1, keepdim=True)
    cosine = (nodes.normals * sight).sum(-1).abs()[exists]
    assert float(cosine.max()) < math.sin(math.radians(3.0))
    assert float(cosine.mean()) < math.sin(math.radians(0.5))
    # On the surface, but for the sag of the mesh's chords: millimetres.
    local = local_frame(body, nodes, x, predictor.node_part)
    shape = body.part_shape[predictor.node_part]
    outside, inside = (
        implicit(shape, local + sign * 0.008 * turned)
        for sign, turned in (
            (sign, local / local.norm(dim=-1, keepdim=True)) for sign in (1.0, -1.0)
        )
    )
    assert (outside[exists] > 0).all()
    assert (inside[exists] < 0).all()
    assert ((nodes.exists >= 0) & (nodes.exists <= 1)).all()
    assert ((nodes.visible >= 0) & (nodes.visible <= 1)).all()


def test_a_ball_has_the_contour_of_its_cone() -> None:
    """The contour of a ball is a circle in a known plane."""
    body = before_camera("arm7")
    radius, distance = 0.1, 0.5
    ball = torch.tensor([radius] * 3 + [1.0, 1.0, 0, 0, 0, 0], dtype=torch.float64)
    body._buffers["part_shape"] = ball.expand(body.num_parts, 9).clone()
    predictor = ContourPredictor(body)
    pose = body.pose(body.rest)
    _, centre = body.part_poses(pose)
    eye = centre[0] + torch.tensor([0.0, 0.0, -distance], dtype=torch.float64)
    nodes = predictor(body, pose, eye)
    own = (predictor.node_part == 0) & (nodes.exists > 0)
    assert int(own.sum()) > 20
    away = nodes.points[own] - centre[0]
    height = -radius * radius / distance
    torch.testing.assert_close(away[:, 2], torch.full_like(away[:, 2], height), rtol=0, atol=3e-3)
    torch.testing.assert_close(
        away.norm(dim=-1), torch.full_like(away[:, 2], radius), rtol=0, atol=2.5e-3
    )


@pytest.mark.parametrize(("name", "poses", "least_hidden"), [("arm7", 12, 3), ("body34", 4, 40)])
def test_occlusion_agrees_with_marched_rays(
    name: str, poses: int, least_hidden: int, generator: torch.Generator
) -> None:
    """At least 95 % where not within 1.5 cm of a visibility boundary (measured: 98 % and more).

    Parts are taken as tapered ellipsoids by the predictor, as what they are by the march.
    """
    body = before_camera(name)
    predictor = ContourPredictor(body)
    x = poses_about_rest(body, poses, generator=generator)
    if name == "arm7":  # any arm at all
        fraction = torch.rand(poses, 7, generator=generator, dtype=torch.float64)
        x = body.lower + fraction * (body.upper - body.lower)
    else:
        x[:, body.state_index("root_yaw")] = torch.linspace(0.0, 2.5, poses).double()
    agreeing = clear = hidden = 0
    for state in x:
        pose = body.pose(state)
        nodes = predictor(body, pose, EYE)
        targets = nodes.points + predictor.clearance * nodes.normals
        truth = is_hidden(body, pose, EYE, targets, predictor.node_part)
        boundary = torch.zeros_like(truth)
        for moved in neighbourhood(targets, EYE, 0.015):
            boundary |= is_hidden(body, pose, EYE, moved, predictor.node_part) != truth
        use = (nodes.exists > 0.5) & ~boundary
        clear += int(use.sum())
        hidden += int((use & truth).sum())
        agreeing += int((use & ((nodes.visible < 0.5) == truth)).sum())
    assert hidden >= least_hidden
    assert agreeing >= 0.95 * clear


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


def test_items_of_a_batch_do_not_meet(generator: torch.Generator) -> None:
    body = before_camera("body34")
    predictor = ContourPredictor(body)
    x = poses_about_rest(body, 4, generator=generator)
    together = predictor(body, body.pose(x), EYE)
    for item in range(4):
        alone = predictor(body, body.pose(x[item]), EYE)
        for ours, theirs in zip(together, alone, strict=True):
            torch.testing.assert_close(ours[item], theirs, rtol=1e-5, atol=1e-5)


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
    num_rings = predictor.ring_points.shape[1]
    from_meridians = torch.arange(predictor.num_nodes) % per_part >= 2 * num_rings
    upper = predictor.node_part == body.part_names.index("r_upper_arm")
    assert int((nodes.exists[upper & from_meridians] > 0.5).sum()) >= 6
    # From the side, the rings do it.
    side = predictor(body, pose, EYE)
    assert int((side.exists[upper & ~from_meridians] > 0.5).sum()) >= num_rings


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
        assert seen[min(seen)] > 0.95
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
    # Where a contour fades in or out it does so by degrees.
    moved = nodes.points.diff(dim=0).norm(dim=-1)
    jump = nodes.exists.diff(dim=0).abs()
    assert float(jump[moved < 0.005].max()) < 0.3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "place",
    [(0.0, 0.0, -3.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1e-3), (5e3, 0.0, 1.0), (1e15, -1e15, 1e15)],
)
def test_awkward_places_give_no_nan(
    place: tuple[float, float, float], dtype: torch.dtype, generator: torch.Generator
) -> None:
    """Behind the camera, around it, touching it, far off."""
    body = before_camera("body34", dtype=dtype)
    body = body.with_base(body.base_rotation, torch.tensor(place, dtype=dtype))
    predictor = ContourPredictor(body)
    x = poses_about_rest(body, 5, generator=generator).to(dtype)
    for part in predictor(body, body.pose(x), EYE.to(dtype)):
        assert not part.isnan().any()


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
    part = predictor.node_part == body.part_names.index("l_hand")
    targets = nodes.points + predictor.clearance * nodes.normals
    truth = is_hidden(body, pose, eye, targets, predictor.node_part)
    seen = part & (nodes.exists > 0.5) & ~truth
    assert int(seen.sum()) > 10
    assert float(nodes.visible[seen].mean()) > 0.9
