"""Colours of things and their surroundings."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchcss.kernels import compiler
from torchcss.vision.appearance import BINS, Appearance, colour_bins

RED, GREEN, GREY = (0.9, 0.1, 0.1), (0.1, 0.8, 0.2), (0.5, 0.5, 0.5)


def picture(*, like: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """A red square on green, with a grey stripe that runs through both; and where the square is."""
    image = torch.tensor(GREEN, dtype=torch.float64)[:, None, None].repeat(1, 40, 60)
    thing = torch.zeros(40, 60, dtype=torch.bool)
    thing[10:30, 20:40] = True
    image[:, thing] = torch.tensor(RED, dtype=torch.float64)[:, None]
    image[:, 20:22] = torch.tensor(GREY, dtype=torch.float64)[:, None, None]
    return (image if like is None else image.to(like)), thing


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_pixels_look_like_what_they_were_learnt_to_be(dtype: torch.dtype) -> None:
    image, thing = picture(like=torch.zeros((), dtype=dtype))
    known = Appearance.unknown(2, like=image).learn(
        image, torch.stack([thing, ~thing & False]), torch.stack([~thing, ~thing & False])
    )
    ratio = known.foreground_ratio(image)
    assert ratio.shape == (2, 40, 60)
    assert ratio.dtype == dtype
    assert float(ratio[0, 12, 25]) > 0.95
    assert float(ratio[0, 5, 5]) < -0.95
    assert abs(float(ratio[0, 21, 25])) < 0.5, "grey is both"
    assert not ratio[1].any(), "a thing never seen looks like nothing"
    stranger = torch.full_like(image, 0.02)
    assert float(known.foreground_ratio(stranger)[0].abs().max()) < 1e-6


def test_the_ratio_is_that_of_the_posteriors() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(3, 64, 64, generator=generator, dtype=torch.float64) ** 2
    thing = torch.rand(64, 64, generator=generator) < 0.3
    known = Appearance.unknown(1, like=image).learn(image, thing[None], ~thing[None])
    assert float(known.inside.sum()) == pytest.approx(1.0)
    ratio = known.foreground_ratio(image)
    assert float(ratio.abs().max()) <= 1.0
    # The same colours inside and out: nothing to tell them apart on average.
    assert abs(float(ratio[0][thing].mean() - ratio[0][~thing].mean())) < 0.6


def test_old_colours_are_forgotten_by_degrees_and_too_few_pixels_teach_nothing() -> None:
    image, thing = picture()
    known = Appearance.unknown(1, like=image).learn(image, thing[None], ~thing[None])
    blue = torch.zeros_like(image)
    blue[2] = 0.9
    after = known.learn(blue, thing[None], ~thing[None], inside_rate=0.25, outside_rate=0.5)
    place = int(colour_bins(blue)[0, 0])
    assert float(after.inside[0, place]) == pytest.approx(0.25)
    assert float(after.outside[0, place]) == pytest.approx(0.5)
    torch.testing.assert_close(after.inside.sum(-1), torch.ones(1, dtype=torch.float64))
    few = torch.zeros_like(thing)
    few[0, :10] = True
    same = known.learn(blue, few[None], few[None])
    torch.testing.assert_close(same.inside, known.inside)
    torch.testing.assert_close(same.outside, known.outside)


def test_each_mask_counts_its_own_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    image, _ = picture()
    masks = torch.rand(3, 40, 60, generator=torch.Generator().manual_seed(0)) > 0.6
    known, bins = Appearance.unknown(3, like=image).learn(image, masks, ~masks), colour_bins(image)
    for found, where in zip(known, (masks, ~masks), strict=True):
        for row, mask in zip(found, where, strict=True):
            share = torch.stack([(bins[mask] == one).double().mean() for one in bins.unique()])
            torch.testing.assert_close(row[bins.unique()], share)
            assert float(row.sum()) == pytest.approx(1)
    monkeypatch.setattr(compiler, "COMPILED", False)
    twin = Appearance.unknown(3, like=image).learn(image, masks, ~masks)
    assert all(torch.equal(one, other) for one, other in zip(known, twin, strict=True))
    empty = Appearance.unknown(0, like=image).learn(image, masks[:0], masks[:0])
    assert empty.inside.shape == (0, BINS**3)


def test_the_whole_range_of_colours_has_bins() -> None:
    corners = torch.tensor([[0.0, 1.0], [0.0, 1.0], [0.0, 1.0]])[:, None]
    assert colour_bins(corners).flatten().tolist() == [0, BINS**3 - 1]
