"""The dressed character: a closed skin that follows its body."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.surface import surface_points
from torchcss.studies.render.character import Character, Clothing, distance_to_part

STIFF = Clothing(girth=0.0, looseness=0.0, creases=0.0, muscle=0.0)


def volume(vertices: Tensor, faces: Tensor) -> float:
    a, b, c = vertices[faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum()) / 6


@pytest.fixture(scope="module")
def person() -> tuple[BodyModel, Character]:
    body = load_body("body34")
    return body, Character(body, STIFF, generator=torch.Generator().manual_seed(0), spacing=0.02)


def reaching(body: BodyModel) -> Tensor:
    state = body.rest.clone()
    for name, degrees in {
        "root_yaw": 50.0,
        "l_shoulder_swing": -95.0,
        "l_elbow_flexion": 80.0,
        "r_elbow_flexion": 120.0,
        "l_hip_flexion": 60.0,
        "l_knee_flexion": 90.0,
        "lumbar_twist": 30.0,
    }.items():
        state[body.state_index(name)] = math.radians(degrees)
    return state


def test_distances_are_those_of_an_offset_surface() -> None:
    """Near the surface the first-order distance is the distance, also where a part tapers."""
    shape = torch.tensor([0.05, 0.06, 0.17, 0.7, 1.0, -0.2, -0.1, 0, 0], dtype=torch.float64)
    eta = torch.linspace(-1.2, 1.2, 15, dtype=torch.float64)
    points, normals = surface_points(shape.expand(15, 9), eta, 2 * eta)
    assert float(distance_to_part(shape, points).abs().max()) < 1e-9
    for step in (0.002, -0.002):
        found = distance_to_part(shape, points + step * normals)
        torch.testing.assert_close(found, torch.full_like(found, step), rtol=0.15, atol=0)


def test_the_skin_is_closed_and_turned_outwards(person: tuple[BodyModel, Character]) -> None:
    body, character = person
    faces = character.faces
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = edges[:, 0] * character.num_vertices + edges[:, 1]
    backward = edges[:, 1] * character.num_vertices + edges[:, 0]
    # Every edge belongs to two triangles, which run along it in opposite directions.
    assert torch.equal(forward.sort().values, backward.sort().values)
    skin = character.pose(body.rest)
    assert 0.04 < volume(skin.vertices_world, faces) < 0.09  # cubic metres: 40 to 90 litres
    assert set(character.part.tolist()) == set(range(body.num_parts))
    assert bool(((character.colour >= 0) & (character.colour <= 1)).all())


def test_limbs_keep_their_volume_when_they_bend(person: tuple[BodyModel, Character]) -> None:
    """Linear blending would lose it at twisted and bent joints."""
    body, character = person
    still = volume(character.pose(body.rest).vertices_world, character.faces)
    bent = volume(character.pose(reaching(body)).vertices_world, character.faces)
    assert abs(bent / still - 1) < 0.05


def test_the_skin_lies_on_the_parts(person: tuple[BodyModel, Character]) -> None:
    """Of a character without cloth or other girths, but for what fills the joints."""
    body, character = person
    state = reaching(body)
    skin = character.pose(state)
    rotation, centre = body.part_poses(body.pose(state))
    local = (skin.vertices_world - centre[:, None]) @ rotation
    apart = torch.stack(
        [distance_to_part(s, p) for s, p in zip(body.part_shape, local, strict=True)]
    ).amin(0)
    assert float(apart.abs().median()) < 0.008
    middle = character._weight[:, 0] > 0.98
    assert float(apart[middle].abs().quantile(0.95)) < 0.02


def test_a_skin_moves_with_its_base_and_root(person: tuple[BodyModel, Character]) -> None:
    body, character = person
    state = reaching(body)
    skin = character.pose(state)
    shifted = state.clone()
    shifted[body.state_index("root_x")] += 0.4
    moved = character.pose(shifted)
    torch.testing.assert_close(
        moved.vertices_world,
        skin.vertices_world + skin.vertices_world.new_tensor([0.4, 0, 0]),
        rtol=0,
        atol=1e-9,
    )
    torch.testing.assert_close(moved.normals_world, skin.normals_world, rtol=0, atol=1e-9)


def test_cloth_moves_with_the_pose_and_muscles_swell() -> None:
    body = load_body("arm8")
    clothing = Clothing(girth=0.0, looseness=0.0, creases=0.0, muscle=0.02)
    character = Character(body, clothing, generator=torch.Generator().manual_seed(0), spacing=0.012)
    plain = Character(body, STIFF, generator=torch.Generator().manual_seed(0), spacing=0.012)
    straight, bent = body.rest.clone(), body.rest.clone()
    bent[body.state_index("r_elbow_flexion")] = math.radians(110)

    def swelling(state: Tensor) -> Tensor:
        return (character.pose(state).vertices_world - plain.pose(state).vertices_world).norm(
            dim=-1
        )

    assert float(swelling(straight).max()) < 1e-3
    swollen = swelling(bent)
    assert 0.01 < float(swollen.max()) < 0.025
    # On the upper arm, on the side to which the forearm bends.
    most = int(swollen.argmax())
    pose = body.pose(bent)
    shoulder, elbow, wrist = (
        pose.joints[body.joint_index(f"r_{name}")] for name in ("shoulder", "elbow", "wrist")
    )
    place = character.pose(bent).vertices_world[most]
    axis = (elbow - shoulder) / (elbow - shoulder).norm()
    along = float((place - shoulder) @ axis) / float((elbow - shoulder).norm())
    assert 0.2 < along < 0.8
    across = place - shoulder - ((place - shoulder) @ axis) * axis
    assert float(across @ (wrist - elbow)) > 0


def test_parts_can_be_left_out() -> None:
    body = load_body("arm7")
    generator = torch.Generator().manual_seed(0)
    character = Character(body, STIFF, generator=generator, spacing=0.015, without=("r_hand",))
    assert body.part_names.index("r_hand") not in character.part.tolist()
