"""The weight of edges by foreground: one on the body and its outline, lower far from it."""

from __future__ import annotations

import pytest
import torch

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.vision.edges import foreground_weight


def test_weight_of_a_body_and_a_thin_limb() -> None:
    mask = torch.zeros(120, 160, dtype=torch.float64)
    mask[40:80, 40:70] = 1.0
    mask[58:61, 70:110] = 1.0
    weight = foreground_weight(mask, band=8.0, background=0.2)
    assert weight.shape == mask.shape
    assert weight.dtype == mask.dtype
    # On the foreground, thin parts included, and on the pixels around it.
    around = torch.nn.functional.max_pool2d(mask[None], 3, stride=1, padding=1)[0] > 0
    assert float(weight[around].min()) > 0.95
    assert float(weight.max()) <= 1.0
    # Half-way down a band outside, background beyond.
    assert float(weight[60, 31:33].mean()) == pytest.approx(0.6, abs=0.06)
    assert float(weight[60, 15]) == pytest.approx(0.2, abs=1e-3)
    assert (weight[60, :40].diff() >= -1e-12).all()


def test_soft_masks_and_masks_without_contrast() -> None:
    mask = torch.zeros(50, 60)
    mask[20:30, 20:30] = 0.5
    weight = foreground_weight(mask, background=0.0)
    assert float(weight.max()) == pytest.approx(0.5, abs=1e-2)
    assert (foreground_weight(torch.zeros(9, 9), background=0.3) == 0.3).all()
    torch.testing.assert_close(foreground_weight(torch.ones(9, 9)), torch.ones(9, 9))
    torch.testing.assert_close(foreground_weight(mask, background=1.0), torch.ones(50, 60))


@pytest.mark.parametrize("size", [(1, 1), (1, 30), (17, 1), (2, 3)])
@pytest.mark.parametrize("band", [0.2, 3.0, 40.0])
def test_thin_masks(size: tuple[int, int], band: float, generator: torch.Generator) -> None:
    weight = foreground_weight(torch.rand(size, generator=generator), band=band)
    assert weight.shape == size
    assert weight.isfinite().all()
    assert 0.3 - 1e-6 <= float(weight.min()) <= float(weight.max()) <= 1.0


def test_bad_masks_and_choices_are_refused() -> None:
    for bad in (torch.zeros(3), torch.zeros(1, 3, 4), torch.zeros(0, 4), torch.zeros(3, 4).bool()):
        with pytest.raises(ShapeError, match="mask: expected"):
            foreground_weight(bad)
    for band in (0.0, -1.0, float("inf")):
        with pytest.raises(ConfigurationError, match="band"):
            foreground_weight(torch.zeros(3, 4), band=band)
    for background in (-0.1, 1.5, float("nan")):
        with pytest.raises(ConfigurationError, match="background"):
            foreground_weight(torch.zeros(3, 4), background=background)
