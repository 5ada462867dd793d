"""Scenes: pictures agree with the labels, shadows fall, scenes come from their seed."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.errors import CameraError, ConfigurationError
from torchcss.studies.render.character import Character, Clothing
from torchcss.studies.render.scene import SceneRenderer, Standpoint, Style, look_at
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import rasterise

PLACE = Standpoint(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), 0.0, 0.3)
PLAIN = Style(scene="dark", lamps=(), shadows=False, fill=0.0, ambient=1.0, specular=0.0)
"""Nothing but the colour of things."""


def awkward_camera() -> Camera:
    """Off centre, tilted, with pixels that are not square."""
    camera = look_at((0.7, 1.6, 2.3), (0.1, 0.9, 0.0), focal_px=150.0, image_size_wh=(160, 120))
    K = camera.K.clone()
    K[0, 0], K[0, 2], K[1, 2] = 165.0, 66.3, 71.8
    tilt = torch.tensor([[0.995, -0.0998, 0], [0.0998, 0.995, 0], [0, 0, 1]], dtype=torch.float64)
    rotation = tilt @ camera.R_camera_world
    return Camera(
        K, (160, 120), R_camera_world=rotation, t_camera_world=-rotation @ camera.centre_world
    )


@pytest.fixture(scope="module")
def character() -> Character:
    body = load_body("body34").with_base(torch.eye(3), torch.tensor([0.0, 0.92, 0.0]))
    return Character(body, Clothing(), generator=torch.Generator().manual_seed(0), spacing=0.02)


def test_the_silhouette_is_the_rasterisers(character: Character) -> None:
    camera, skin = awkward_camera(), character.pose(character.body.rest)
    white = torch.ones_like(character.colour)
    renderer = SceneRenderer(camera, PLACE, PLAIN, generator=torch.Generator().manual_seed(0))
    empty = renderer.picture([]).double().mean(-1)
    full = renderer.picture([skin._replace(colour=white)]).double().mean(-1)
    seen = ((full - empty) / (255 - empty)).clamp(0, 1)
    # The same coverage by our own rasteriser, at eight times the size.
    fine, (width, height) = 8, camera.image_size_wh
    uv, depth, valid = camera.project(skin.vertices_world)
    faces = rasterise(
        (uv + 0.5) * fine - 0.5, depth, character.faces, fine * height, fine * width, valid=valid
    ).face
    covered = (faces >= 0).double()
    coverage = torch.nn.functional.avg_pool2d(covered[None, None], fine)[0, 0]
    assert 0.05 < float(coverage.mean()) < 0.6

    def middle(share: Tensor) -> Tensor:
        column, row = torch.arange(width).double(), torch.arange(height).double()
        return torch.stack([share.sum(0) @ column, share.sum(1) @ row]) / share.sum()

    # As a whole it is not shifted, by far less than the 0.3 pixels that would matter,
    assert float((middle(seen) - middle(coverage)).abs().max()) < 0.05
    # and along the outline it covers what it should: four samples see a share to about a quarter.
    outline = (coverage > 0) & (coverage < 1)
    assert float((seen - coverage)[outline].mean().abs()) < 0.05
    assert float((seen - coverage)[outline].abs().mean()) < 0.15
    assert float((seen - coverage)[~outline].abs().max()) < 0.02
    # A shift by 0.3 pixels would be seen.
    moved = torch.nn.functional.avg_pool2d(covered.roll(round(0.3 * fine), 1)[None, None], fine)[
        0, 0
    ]
    assert float((middle(seen) - middle(moved)).abs().max()) > 0.2


def test_a_character_casts_a_shadow_on_scene_and_self(character: Character) -> None:
    camera = look_at((0.3, 1.3, 3.6), (0, 0.9, 0), focal_px=180.0, image_size_wh=(160, 120))
    pictures = {}
    for shadows in (True, False):
        style = dataclasses.replace(Style(), shadows=shadows)
        renderer = SceneRenderer(camera, PLACE, style, generator=torch.Generator().manual_seed(2))
        empty = renderer.picture([]).double().mean(-1)
        skin = character.pose(character.body.rest)
        pictures[shadows] = (empty, renderer.picture([skin]).double().mean(-1))
    uv, depth, valid = camera.project(skin.vertices_world)
    person = rasterise(uv, depth, character.faces, 120, 160, valid=valid).face >= 0
    grown = torch.nn.functional.max_pool2d(person[None].double(), 3, 1, 1)[0] > 0
    empty, full = pictures[True]
    darker = (empty - full)[~grown]
    assert float(darker.min()) >= -1
    assert float((darker > 10).double().mean()) > 0.01
    empty, full = pictures[False]
    assert float((empty - full)[~grown].abs().max()) <= 1
    assert float((pictures[False][1] - pictures[True][1])[person].max()) > 10


def test_scenes_come_from_their_seed() -> None:
    camera = look_at((0.3, 1.3, 3.6), (0, 0.9, 0), focal_px=180.0, image_size_wh=(160, 120))

    def scene(seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        return SceneRenderer(camera, PLACE, Style(), generator=generator).picture([])

    first = scene(0)
    assert torch.equal(first, scene(0))
    assert not torch.equal(first, scene(1))


def test_what_cannot_be_drawn_is_refused() -> None:
    K = [[150.0, 0, 80], [0, 150, 60], [0, 0, 1]]
    camera = Camera(K, (160, 120), distortion=[-0.2, 0, 0, 0, 0])
    with pytest.raises(CameraError, match="without distortion only"):
        SceneRenderer(camera, PLACE, PLAIN, generator=torch.Generator())
    with pytest.raises(ConfigurationError, match='expected "clutter" or "dark"'):
        Style(scene="kitchen")
