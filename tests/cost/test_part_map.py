"""Masks grow by as many pixels as they are told, at borders too."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from torchcss.cost.part_map import grow


@pytest.mark.parametrize("size", [(23, 31), (2, 3), (1, 1), (1, 40)])
@pytest.mark.parametrize("radius", [0, 1, 2, 3, 4, 7, 12, 30])
def test_growing_is_a_maximum_over_squares(
    size: tuple[int, int], radius: int, generator: torch.Generator
) -> None:
    masks = torch.rand(3, *size, generator=generator) > 0.95
    side = 2 * radius + 1
    padded = functional.pad(masks.float(), (radius,) * 4)
    expected = functional.unfold(padded[:, None], side).amax(1).reshape(3, *size) > 0
    before = masks.clone()
    assert torch.equal(grow(masks, radius), expected)
    assert torch.equal(masks, before), "the masks given stay as they are"
