"""Truth of rendered sequences: flow and occlusion against rays, and sequences as a whole."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from torchcss.body.catalog import LENGTHS
from torchcss.body.load import load_body
from torchcss.errors import ConfigurationError
from torchcss.studies.random_person import random_lengths
from torchcss.studies.render.character import distance_to_part
from torchcss.studies.render.mesh_truth import MeshTruth, joints_own_parts
from torchcss.studies.render.motions import Motion
from torchcss.studies.render.scene import look_at
from torchcss.studies.render.sequences import (
    STYLES,
    SequenceFrame,
    Shot,
    camera_in_front,
    shot,
    shot_of_motion,
)
from torchcss.vision.rasterise import grid_faces, join_faces

WIDE, HIGH = 80, 60
SHIFT = torch.tensor([0.3, 0.0, 0.0], dtype=torch.float64)


def sphere(middle: Tensor, radius: float) -> Tensor:
    """Corners that go with `grid_faces(24, 36)`."""
    rings, meridians = 24, 36
    eta = (torch.arange(rings).double() + 0.5) / rings * math.pi - math.pi / 2
    omega = torch.arange(meridians).double() * (2 * math.pi / meridians)
    eta, omega = torch.meshgrid(eta, omega, indexing="ij")
    points = torch.stack([eta.cos() * omega.cos(), eta.cos() * omega.sin(), eta.sin()], -1)
    return middle + radius * points.reshape(-1, 3)


def nearest_hit(start: Tensor, direction: Tensor, triangles: Tensor) -> Tensor:
    """Distance along rays `[p 3]` to the first of the triangles `[f 3 3]`; the slow twin."""
    a, b, c = triangles.unbind(1)
    first, second = b - a, c - a
    across = torch.linalg.cross(direction[:, None], second[None])
    determinant = (first * across).sum(-1)
    apart = start[:, None] - a
    u = (apart * across).sum(-1) / determinant
    q = torch.linalg.cross(apart, first[None].expand_as(apart))
    v = (direction[:, None] * q).sum(-1) / determinant
    t = (second * q).sum(-1) / determinant
    inside = (determinant.abs() > 1e-14) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return torch.where(inside, t, math.inf).amin(-1)


@pytest.fixture(scope="module")
def two_spheres() -> tuple[MeshTruth, Tensor, Tensor]:
    """A small sphere that passes before a turning large one, in two frames."""
    grid = grid_faces(24, 36)
    faces, owner = join_faces([grid, grid], [24 * 36] * 2)
    camera = look_at((0.2, 0.1, 3.0), (0.0, 0.0, 0.0), focal_px=90.0, image_size_wh=(WIDE, HIGH))
    truth = MeshTruth(camera, faces, owner, torch.eye(2, dtype=torch.bool))
    large, small = torch.tensor([0.0, 0.0, 0.0]).double(), torch.tensor([-0.3, 0.1, 1.0]).double()
    c, s = math.cos(0.5), math.sin(0.5)
    turn = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    now = torch.cat([sphere(large, 0.8), sphere(small, 0.25)])
    after = torch.cat([sphere(large, 0.8) @ turn.T, sphere(small + SHIFT, 0.25)])
    return truth, now, after


def test_flow_carries_surface_points(two_spheres: tuple[MeshTruth, Tensor, Tensor]) -> None:
    truth, now, after = two_spheres
    labels = truth.labels(now)
    flow, _ = truth.flow(labels, truth.labels(after))
    assert float(flow[labels.part < 0].abs().max()) == 0
    # The small sphere only shifts: its pixels move by the shift of their points.
    row, column = (labels.part == 1).nonzero(as_tuple=True)
    camera = truth.camera
    pixel = torch.stack([column, row], -1).double()
    K, rotation = camera.K, camera.R_camera_world
    ray = torch.cat([(pixel - K[:2, 2]) / K[[0, 1], [0, 1]], torch.ones(len(pixel), 1)], -1)
    local = ray * labels.depth[row, column, None]
    world = (local - camera.t_camera_world) @ rotation
    moved = camera.project(world + SHIFT).uv
    torch.testing.assert_close(flow[row, column], moved - pixel, rtol=0, atol=1e-4)


def test_occlusion_is_what_rays_say(two_spheres: tuple[MeshTruth, Tensor, Tensor]) -> None:
    truth, now, after = two_spheres
    labels = truth.labels(now)
    flow, occluded = truth.flow(labels, truth.labels(after))
    row, column = (labels.part >= 0).nonzero(as_tuple=True)
    face, weights = labels.face[row, column], labels.barycentric[row, column]
    points = (after[truth.faces[face]] * weights[..., None].double()).sum(1)
    eye = truth.camera.centre_world
    away = points - eye
    distance = away.norm(dim=-1, keepdim=True)
    first = nearest_hit(eye.expand_as(points), away / distance, after[truth.faces])
    hidden = first < distance[:, 0] - 0.005
    wrong = hidden != occluded[row, column]
    assert 0.02 < float(hidden.double().mean()) < 0.5
    # They may differ where the covering outline passes within half a pixel.
    assert float(wrong.double().mean()) < 0.003
    # Elsewhere hidden is what the characters cover next.
    background = labels.part < 0
    assert torch.equal(occluded[background], truth.labels(after).part[background] >= 0)
    assert float(flow.abs().max()) > 1


def test_a_point_that_leaves_the_image_is_occluded() -> None:
    grid = grid_faces(24, 36)
    camera = look_at((0, 0, 3.0), (0, 0, 0), focal_px=90.0, image_size_wh=(WIDE, HIGH))
    truth = MeshTruth(camera, grid, torch.zeros(len(grid)).long(), torch.ones(1, 1).bool())
    now = sphere(torch.tensor([1.2, 0.0, 0.0]).double(), 0.3)
    labels = truth.labels(now)
    flow, occluded = truth.flow(labels, truth.labels(now + torch.tensor([0.3, 0.0, 0.0])))
    column = torch.arange(WIDE).expand(HIGH, WIDE)
    seen = labels.part >= 0
    out = seen & (column + flow[..., 0] >= WIDE - 0.5)
    assert bool(out.any())
    assert bool(occluded[out].all())


def test_a_joint_is_visible_through_its_own_flesh_only(
    two_spheres: tuple[MeshTruth, Tensor, Tensor],
) -> None:
    truth, now, _ = two_spheres
    looking = MeshTruth(
        truth.camera, truth.faces, truth.part, torch.tensor([[True, False]]).expand(4, 2)
    )
    eye = truth.camera.centre_world
    small = now[24 * 36 :].mean(0)
    joints = torch.stack([
        torch.tensor([0.4, 0.2, 0.55]).double(),  # just under the large sphere's surface
        torch.tensor([0.0, 0.0, 0.0]).double(),  # too deep in it to be a joint of its surface
        small + 0.3 * (small - eye),  # before its surface, and behind the small sphere
        torch.tensor([5.0, 0.0, 0.0]).double(),  # beside the picture
    ])  # fmt: skip
    _, visible, inside = looking.joints(truth.labels(now), joints)
    assert visible.tolist() == [True, False, False, False]
    assert inside.tolist() == [True, True, True, False]


def test_joints_belong_to_the_parts_around_them() -> None:
    body = load_body("body34")
    own = joints_own_parts(body)

    def parts(joint: str) -> set[str]:
        row = own[body.joint_index(joint)]
        return {name for name, mine in zip(body.part_names, row.tolist(), strict=True) if mine}

    assert parts("l_elbow") == {"l_upper_arm", "l_forearm"}
    assert parts("r_knee") == {"r_thigh", "r_shank"}
    assert parts("skull_tip") == {"head"}
    assert bool(own.any(-1).all())


def test_lengths_are_within_the_prior() -> None:
    drawn = random_lengths(generator=torch.Generator().manual_seed(3))
    ratio = torch.tensor([drawn[name] / LENGTHS[name] for name in LENGTHS])
    assert float((ratio - 1).abs().max()) <= 0.1 + 1e-12
    assert float(ratio.std()) > 0.01


def test_a_camera_in_front_sees_all_of_a_motion() -> None:
    body = load_body("body34")
    states = body.rest.repeat(3, 1)
    states[:, body.state_index("root_x")] = torch.tensor([-0.8, 0.0, 1.5])
    states[:, body.state_index("root_yaw")] = 2.0
    camera = camera_in_front(body, states)
    points = body.surface(body.pose(states)).points
    uv, _, valid = camera.project(points)
    assert bool(valid.all() & (uv > 20).all() & (uv < torch.tensor([620, 460])).all())
    # It looks into the face.
    nose, ear = (body.pose(states[0]).joints[body.joint_index(n)] for n in ("nose", "l_ear"))
    face = nose - ear
    assert float((camera.centre_world - nose) @ face) > 0


def test_an_unknown_sequence_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="no sequence 'leg'; expected one of arm"):
        shot("leg")


# Whole pictures.


def few(name: str) -> Shot:
    """Three neighbouring frames from the middle of a sequence, small."""
    whole = shot(name, small=True)
    middle = len(whole.states) // 2
    return dataclasses.replace(whole, states=whole.states[middle : middle + 3])


@pytest.fixture(scope="module", params=["arm", "body-dark"])
def rendered(request: pytest.FixtureRequest) -> tuple[Shot, list[SequenceFrame]]:
    chosen = few(request.param)
    return chosen, list(chosen.frames())


def test_frames_are_the_same_for_the_same_seed() -> None:
    chosen = few("body-dark")
    first, again = (next(chosen.frames()) for _ in range(2))
    assert torch.equal(again.image, first.image)
    assert torch.equal(again.part, first.part)
    assert first.flow is not None
    assert again.flow is not None
    assert torch.equal(again.flow, first.flow)
    other = next(dataclasses.replace(chosen, seed=1).frames())
    assert not torch.equal(other.image, first.image)


def test_a_frame_has_all_its_truth(rendered: tuple[Shot, list[SequenceFrame]]) -> None:
    chosen, frames = rendered
    width, height = chosen.camera.image_size_wh
    truth = chosen.body.pose(chosen.states).joints
    for index, frame in enumerate(frames):
        assert frame.image.shape == (height, width, 3)
        assert torch.equal(frame.joints, truth[index])
        torch.testing.assert_close(frame.uv, chosen.camera.project(truth[index]).uv)
        assert torch.equal(frame.mask, frame.part >= 0)
        assert bool(frame.in_image.all())
        assert 0.3 < float(frame.visible.double().mean()) <= 1
    assert frames[-1].flow is None
    assert frames[-1].occluded is None


def test_the_picture_moves_as_the_flow_says(rendered: tuple[Shot, list[SequenceFrame]]) -> None:
    """Warped back by the flow, the next picture is nearer to this one than as it stands."""
    _, frames = rendered
    now, after = (frame.image.double().mean(-1) for frame in frames[:2])
    flow, occluded = frames[0].flow, frames[0].occluded
    assert flow is not None
    assert occluded is not None
    row, column = (frames[0].mask & ~occluded).nonzero(as_tuple=True)
    height, width = now.shape
    target = torch.stack([column, row], -1) + flow[row, column]
    grid = target / torch.tensor([width - 1, height - 1]) * 2 - 1
    warped = torch.nn.functional.grid_sample(
        after[None, None], grid[None, None].double(), align_corners=True
    )[0, 0, 0]
    here, there = now[row, column], after[row, column]
    assert float((warped - here).abs().mean()) < 0.8 * float((there - here).abs().mean())


def test_the_person_is_not_the_trackers_model() -> None:
    """Lengths differ by some per cent, and so does the surface, within reason."""
    chosen = few("body-clutter")
    ratio = torch.tensor([chosen.body.lengths[name] / LENGTHS[name] for name in LENGTHS])
    assert 0.01 < float((ratio - 1).abs().mean()) < 0.1
    (character,), _ = chosen.characters()
    skin = character.pose(chosen.states[0])
    body = load_body(chosen.body.name, lengths=chosen.body.lengths).with_base(
        chosen.body.base_rotation, chosen.body.base_translation
    )
    rotation, centre = body.part_poses(body.pose(chosen.states[0]))
    local = (skin.vertices_world - centre[:, None]) @ rotation
    apart = torch.stack(
        [distance_to_part(s, p) for s, p in zip(body.part_shape, local, strict=True)]
    ).amin(0)
    radius = float((body.part_shape[:, 0] * body.part_shape[:, 1]).sqrt().mean())
    relative = apart.abs() / radius
    assert 0.03 < float(relative.median()) < 0.12


def test_a_users_motion_is_filmed() -> None:
    body = load_body("arm7")
    states = body.rest.repeat(2, 1)
    states[1, body.state_index("r_elbow_flexion")] += 0.1
    motion = Motion(body, states, 30.0, "bend")
    with pytest.raises(ConfigurationError, match="num_frames must be at least 1, got 0"):
        shot_of_motion(motion, num_frames=0)
    frames = list(shot_of_motion(motion, style=STYLES["dark"], small=True).frames())
    assert len(frames) == 2
    assert float(frames[0].mask.double().mean()) > 0.01
    assert frames[0].flow is not None
    assert float(frames[0].flow.abs().max()) > 0.3
