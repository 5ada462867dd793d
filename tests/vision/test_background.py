"""What a still camera sees where nobody is."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchcss.vision.appearance import Appearance
from torchcss.vision.background import Background

HEIGHT, WIDTH = 40, 60


def room(*, dtype: torch.dtype = torch.float64, seed: int = 0) -> Tensor:
    """A picture of clutter."""
    generator = torch.Generator().manual_seed(seed)
    return (0.2 + 0.6 * torch.rand(3, HEIGHT, WIDTH, generator=generator)).to(dtype)


def grain(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.01 * torch.randn(3, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)


def everywhere() -> Tensor:
    return torch.ones(HEIGHT, WIDTH, dtype=torch.bool)


def block(top: int, left: int) -> Tensor:
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[top : top + 10, left : left + 10] = True
    return mask


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_is_known_where_it_was_bare(dtype: torch.dtype) -> None:
    picture, hidden = room(dtype=dtype), block(5, 5)
    known = Background.unknown(picture).learn(picture, ~hidden)
    assert known.mean.dtype == known.confidence.dtype == known.log_density(picture).dtype == dtype
    assert torch.equal(known.sure, ~hidden)
    torch.testing.assert_close(known.mean[:, ~hidden], picture[:, ~hidden])
    assert not Background.unknown(picture).confidence.any()


def test_mean_and_variance_are_those_of_the_frames() -> None:
    frames = [room() + grain(seed) for seed in range(12)]
    known = Background.unknown(frames[0])
    for frame in frames:
        known = known.learn(frame, everywhere())
    stack = torch.stack(frames)
    torch.testing.assert_close(known.mean, stack.mean(0))
    squares = (stack - stack.mean(0)).square().sum(0).mean(0)
    torch.testing.assert_close(known.squares, squares)
    # Four frames' worth of what is taken for granted.
    torch.testing.assert_close(known.variance, (squares + 4 * 0.05**2) / (12 + 4))


def test_the_density_is_one_over_all_colours() -> None:
    picture = room()
    known = Background.unknown(picture).learn(picture, everywhere())
    steps = 60
    axis = (torch.arange(3 * steps, dtype=torch.float64) + 0.5) / steps - 1.0
    colours = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).flatten(1)
    one = Background(*(part[..., :1, :1] for part in known))
    density = one.log_density(colours[:, None, :]).exp()
    assert float(density.sum()) / steps**3 == pytest.approx(1.0, abs=0.02)


def test_a_shadow_is_background_and_another_hue_is_not() -> None:
    picture = torch.tensor([0.6, 0.5, 0.4], dtype=torch.float64)[:, None, None].repeat(
        1, HEIGHT, WIDTH
    )
    known = Background.unknown(picture).learn(picture, everywhere())
    same, shadow = known.log_density(picture), known.log_density(0.5 * picture)
    other = known.log_density(picture.flip(0) * 0.8)
    assert float(same.mean()) > float(shadow.mean()) > float(other.mean()) + 3


def test_what_comes_before_it_looks_like_the_body_in_the_colours_of_the_wall() -> None:
    picture, body = room(), block(5, 5)
    picture[:, body] = picture[:, block(5, 40)]
    looks = Appearance.unknown(1, like=picture).learn(picture, body[None], ~body[None])
    known = Background.unknown(picture).learn(picture, ~body)
    after = picture.clone()
    after[:, block(25, 25)] = picture[:, body]
    blind, seeing = looks.foreground_ratio(after)[0], looks.foreground_ratio(after, known)[0]
    assert float(seeing[block(25, 25)].mean()) > float(blind[block(25, 25)].mean()) + 0.3
    assert float(seeing[block(5, 40)].mean()) < -0.8
    # Where nothing is known colours say what they said.
    torch.testing.assert_close(seeing[body], blind[body])
    assert float(seeing.abs().max()) <= 1.0
    # Of a thing never seen it is known only that it is not the background.
    strange = Appearance.unknown(1, like=picture).foreground_ratio(after, known)[0]
    assert float(strange[block(25, 25)].mean()) > 0.5
    assert float(strange[block(5, 40)].mean()) < -0.8


def test_what_never_was_bare_and_does_not_change_is_a_guess() -> None:
    picture, hidden = room(), block(5, 5)
    picture[:, hidden] = torch.tensor([0.7, 0.4, 0.3], dtype=torch.float64)[:, None]
    looks = Appearance.unknown(1, like=picture).learn(picture, hidden[None], ~hidden[None])
    known = Background.unknown(picture)
    for frame in range(4):
        assert float(known.confidence[hidden].max()) == (0.1 if frame >= 3 else 0.0)
        known = known.learn(picture, ~hidden)
    # Who stands still is not taken for the wall, but his colours count for less.
    blind, seeing = (
        looks.foreground_ratio(picture)[0][hidden],
        looks.foreground_ratio(picture, known)[0][hidden],
    )
    assert float(blind.min()) > 0.9
    assert float(seeing.min()) >= 0
    assert float(seeing.max()) < float(blind.min()) - 0.05
    # What has moved counts as before.
    moved = picture.clone()
    moved[:, hidden] = 1 - picture[:, hidden]
    strange = Appearance.unknown(1, like=moved).learn(moved, hidden[None], ~hidden[None])
    again = strange.foreground_ratio(moved, known)[0][hidden]
    torch.testing.assert_close(again, strange.foreground_ratio(moved)[0][hidden], atol=0.12, rtol=0)
    # Once it is bare what it showed before is forgotten.
    bare = known.learn(moved, everywhere())
    torch.testing.assert_close(bare.mean[:, hidden], moved[:, hidden])
    assert float(bare.frames[hidden].max()) == 1.0
    assert not bare.squares[hidden].any()
    assert bare.sure.all()


def test_a_camera_that_moves_has_no_background() -> None:
    wide = torch.rand(3, HEIGHT, 200, generator=torch.Generator().manual_seed(3)).double()
    known = Background.unknown(wide[..., :WIDTH])
    for shift in range(0, 20, 4):
        picture = wide[..., shift : shift + WIDTH]
        known = known.learn(picture, everywhere())
        assert float(known.frames.max()) == 1.0, "each picture is the first again"
    # A slow pan of a smooth wall is told by the flow.
    wall = torch.full_like(wide[..., :WIDTH], 0.5)
    panned = Background.unknown(wall).learn(wall, everywhere())
    flow = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.float64)
    assert panned.learn(wall, everywhere(), flow).sure.all()
    flow[0] = 0.6
    assert not panned.learn(wall, everywhere(), flow).sure.any()


def test_a_cut_is_noticed_wherever_the_body_is() -> None:
    picture = room()
    known = Background.unknown(picture).learn(picture, everywhere())
    body = picture.clone()
    body[:, block(5, 5)] = 1.0
    assert known.holds(body)
    assert not known.holds(room(seed=1))
    assert Background.unknown(picture).holds(picture)


def test_the_light_may_change_by_degrees() -> None:
    picture = room()
    known = Background.unknown(picture)
    for frame in range(200):
        picture = picture * math.exp(-0.002)
        known = known.learn(picture, everywhere())
        assert float(known.frames.max()) == min(frame + 1, 50)
    assert known.holds(picture)
