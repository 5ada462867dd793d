"""The overlay: what changes, what must not, and odd input."""

from __future__ import annotations

import math

import pytest
import torch

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.show import overlay
from torchcss.show.overlay import PALETTE, ProjectedBody, draw_overlay
from torchcss.vision.rasterise import join_faces


def disc(u, v, radius, *, depth=2.0, part=0, dtype=torch.float32):
    """A fan of triangles round its middle."""
    angle = torch.arange(48, dtype=dtype) * (2 * math.pi / 48)
    rim = torch.stack((angle.cos(), angle.sin()), -1) * radius
    uv = torch.cat((rim, rim.new_zeros(1, 2))) + rim.new_tensor([u, v])
    index = torch.arange(48)
    faces = torch.stack((index, (index + 1) % 48, torch.full_like(index, 48)), -1)
    far = torch.full((49,), depth, dtype=dtype)
    return ProjectedBody(uv, far, far > 0, faces, torch.full_like(index, part))


def together(*bodies):
    """Several meshes as one body."""
    uv, depth, valid, faces, part = zip(*bodies, strict=True)
    faces, _ = join_faces(faces, [len(points) for points in uv])
    return ProjectedBody(*map(torch.cat, (uv, depth, valid)), faces, torch.cat(part))


def grey(height=120, width=160, level=90):
    return torch.full((height, width, 3), level, dtype=torch.uint8)


def changed(image, drawn):
    return (image != drawn).any(-1)


def rings(u, v):
    y, x = torch.meshgrid(torch.arange(120), torch.arange(160), indexing="ij")
    return ((x - u) ** 2 + (y - v) ** 2).sqrt()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_only_the_body_and_its_outline_change(dtype):
    image = grey()
    drawn = draw_overlay(image, [disc(70, 60, 30, dtype=dtype)])
    assert (image == 90).all()  # the input is not touched
    touched, distance = changed(image, drawn), rings(70, 60)
    assert touched[distance < 29].all()
    assert not touched[distance > 34].any()
    # Inside translucent and bluish, the outline bright.
    inside = drawn[60, 70].int()
    assert inside[2] > inside[0]
    assert (drawn[60, 97:104].float().mean(-1) > 180).any()


def test_lines_have_the_same_width_in_every_direction(monkeypatch):
    monkeypatch.setattr(overlay, "_FILL", 0.0)
    for resolution in (10**6, 6000):  # at full size, and rasterised at about a third
        image = grey(960, 220, 0)  # lines of 3 pixels
        monkeypatch.setattr(overlay, "_RESOLUTION", resolution)
        bright = draw_overlay(image, [disc(110, 110, 80)]).float().mean(-1)
        y, x = torch.meshgrid(torch.arange(960), torch.arange(220), indexing="ij")
        sector = (torch.atan2(y - 110.0, x - 110.0) / (2 * math.pi) * 24).floor().long() % 24
        ink = torch.zeros(24).index_add(0, sector.view(-1), bright.view(-1)) / bright.max()
        width = ink / (2 * math.pi * 80 / 24)
        # Bright core plus the dim halo round it; the antialiased ramps add one pixel.
        assert width.min() > 2.4
        assert width.max() < 4.8
        assert width.max() / width.min() < 1.25


def test_other_modes_are_outlines_and_their_weight_shows():
    image = grey()
    best = disc(-500, -500, 5)

    def ink(share):
        other = disc(70, 60, 30)
        drawn = draw_overlay(image, [best, other], weights=[1.0, share])
        distance = rings(70, 60)
        assert not changed(image, drawn)[(distance - 30).abs() > 4].any()
        line = drawn[(distance - 30).abs() < 0.5].float().mean(0)
        return line - 90

    heavy, light = ink(1.0), ink(0.05)
    colour = torch.tensor(PALETTE[1]) - 90.0
    assert torch.nn.functional.cosine_similarity(heavy, colour, dim=0) > 0.99
    assert heavy.norm() > 1.5 * light.norm() > 10


def test_hidden_parts_are_dashed(monkeypatch):
    image = grey()
    front, back = disc(70, 60, 40, depth=1.0, part=0), disc(70, 60, 20, depth=2.0, part=1)
    with_back = draw_overlay(image, [together(front, back)])
    alone = draw_overlay(image, [front])
    ring = (rings(70, 60) - 20).abs() < 0.6
    lit = (with_back.float() - alone.float()).mean(-1)[ring] > 10
    assert 0.15 < lit.float().mean() < 0.85
    # The same with the parts' depths exchanged is a solid line.
    solid = draw_overlay(image, [together(front._replace(depth=3 * front.depth), back)])
    assert (solid[ring].float().mean(-1) > 180).all()
    monkeypatch.setattr(overlay, "_HIDDEN", 0.0)
    assert torch.equal(draw_overlay(image, [together(front, back)]), alone)


def test_meshes_of_one_part_share_an_outline(monkeypatch):
    image = grey()
    monkeypatch.setattr(overlay, "_FILL", 0.0)
    one = draw_overlay(image, [together(disc(60, 60, 20), disc(80, 60, 20))])
    two = draw_overlay(image, [together(disc(60, 60, 20), disc(80, 60, 20, part=1))])
    lens = rings(60, 60).maximum(rings(80, 60)) < 15
    assert not changed(image, one)[lens].any()
    assert changed(image, one).any()
    border = ((rings(80, 60) - 20).abs() < 1) & (rings(60, 60) < 15)
    assert changed(image, two)[border].any()


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 7), (33, 17), (121, 163)])
def test_odd_sizes(height, width):
    image = grey(height, width)
    one = disc(width / 2, height / 2, 6)
    two = together(one, disc(width / 3, 0, 9, depth=1.0, part=1))
    drawn = draw_overlay(image, [two, one], keypoints=torch.tensor([[0.0, 0.0]]), text="frame 1")
    assert drawn.shape == image.shape
    assert drawn.dtype == torch.uint8
    assert changed(image, drawn).any()


def test_no_modes_and_empty_modes_change_nothing():
    image = grey()
    assert torch.equal(draw_overlay(image, []), image)
    nothing = ProjectedBody(*(values[:0] for values in disc(70, 60, 30)))
    assert torch.equal(draw_overlay(image, [nothing, nothing]), image)


def test_bodies_out_of_sight_change_nothing():
    image = grey()
    seen = disc(70, 60, 30)
    away = [
        seen._replace(depth=-seen.depth, valid=seen.depth < 0),
        seen._replace(valid=torch.zeros_like(seen.valid)),
        seen._replace(depth=-seen.depth),
        seen._replace(uv=torch.full_like(seen.uv, torch.nan)),
        seen._replace(uv=torch.full_like(seen.uv, torch.inf)),
        disc(-400, 60, 30),
        disc(70, 600, 30),
        disc(1e8, 1e8, 30),
        disc(1e30, -1e30, 30),
    ]
    for part in away:
        assert torch.equal(draw_overlay(image, [part, part]), image)


def test_bodies_far_larger_than_the_frame_fill_it():
    image = grey()
    for radius in (1e3, 1e6):
        drawn = draw_overlay(image, [disc(80, 60, radius), disc(70, 60, radius)])
        assert changed(image, drawn).all()


def test_a_body_cut_by_the_frame_has_no_line_along_the_cut(monkeypatch):
    monkeypatch.setattr(overlay, "_FILL", 0.0)
    image = grey()
    drawn = draw_overlay(image, [disc(0, 60, 30)])
    touched = changed(image, drawn)
    assert touched[60, 28:32].any()
    assert not touched[50:70, :10].any()


def test_keypoints_are_rings_and_missing_ones_are_skipped():
    image = grey()
    points = torch.tensor([[40.0, 30], [torch.nan, 5], [-300, 50], [torch.inf, 1], [159.4, 119.2]])
    drawn = draw_overlay(image, [], keypoints=points)
    touched = changed(image, drawn)
    near = (rings(40, 30) < 8) | (rings(159.4, 119.2) < 8)
    assert touched[near].any()
    assert not touched[~near].any()
    assert drawn[100:, 150:].float().max() > 200
    assert torch.equal(drawn[30, 40], image[30, 40])  # one sees what is measured


def test_text_stays_in_its_corner():
    image = grey(200, 400)
    touched = changed(image, draw_overlay(image, [], text="frame 12  cost 3.21\nmodes 7"))
    assert touched[-5:, :50].any()
    assert not touched[:160].any()
    assert not touched[:, 300:].any()
    long = draw_overlay(image, [], text="many words " * 40)
    assert long.shape == image.shape
    assert torch.equal(draw_overlay(image, [], text=""), image)


def test_bad_input_is_named():
    mode = disc(70, 60, 30)
    with pytest.raises(ShapeError, match="uint8"):
        draw_overlay(grey().float(), [mode])
    with pytest.raises(ShapeError, match="image"):
        draw_overlay(grey()[..., 0], [mode])
    with pytest.raises(ShapeError, match="weights"):
        draw_overlay(grey(), [mode], weights=[0.5, 0.5])
    with pytest.raises(ConfigurationError, match="exponentiate"):
        draw_overlay(grey(), [mode], weights=[-3.0])
    with pytest.raises(ShapeError, match="keypoints"):
        draw_overlay(grey(), [mode], keypoints=torch.zeros(3, 3))
