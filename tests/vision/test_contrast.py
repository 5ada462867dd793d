"""Local contrast: light falls out, texture stays, nothing comes from nothing."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from torchcss.errors import ShapeError
from torchcss.vision.contrast import local_contrast


def a_cloth(generator: torch.Generator, dtype: torch.dtype = torch.float64) -> Tensor:
    cloth = torch.rand(1, 1, 20, 30, generator=generator, dtype=dtype)
    return functional.interpolate(cloth, size=(80, 120), mode="bicubic")[0, 0].clamp(0, 1)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_light_falls_out(generator: torch.Generator, dtype: torch.dtype) -> None:
    cloth = a_cloth(generator, dtype)
    bright, dark = local_contrast(cloth), local_contrast(0.4 * cloth + 0.1)
    assert bright.dtype == dtype
    assert bright.shape == cloth.shape
    assert bright.std() > 0.4
    assert (bright - dark).abs().max() < 0.1 * bright.abs().max()


def test_what_is_plain_has_none() -> None:
    assert local_contrast(torch.full((40, 50), 0.7)).abs().max() < 1e-4
    ramp = torch.linspace(0.3, 0.7, 100).expand(60, 100)
    assert local_contrast(ramp)[:, 35:-35].abs().max() < 0.02


def test_it_is_the_formula() -> None:
    """A wave of one frequency, far from the borders: all three Gaussians are known factors."""
    radius, blur, floor, frequency = 4.0, 1.0, 0.05, 0.9
    angle = frequency * torch.arange(200, dtype=torch.float64)
    picture = (0.5 + 0.2 * angle.cos()).expand(60, 200)

    def passed(deviation: float, factor: float = 1.0) -> float:
        return float(torch.exp(torch.tensor(-0.5 * (factor * frequency * deviation) ** 2)))

    wave = 0.2 * (1 - passed(radius))
    variance = 0.5 * wave**2 * (1 + passed(radius, 2.0) * (2 * angle).cos())
    expected = passed(blur) * wave * angle.cos() / (variance + floor**2).sqrt()
    found = local_contrast(picture, radius=radius, blur=blur, floor=floor)[30]
    torch.testing.assert_close(found[40:-40], expected[40:-40], atol=0.01, rtol=0)


def test_a_small_picture_is_no_error() -> None:
    assert local_contrast(torch.rand(3, 2)).shape == (3, 2)


def test_bad_input_is_told() -> None:
    with pytest.raises(ShapeError, match="grey"):
        local_contrast(torch.rand(5))
