"""Sub-pixel sampling against a plain loop, borders, small images."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchcss.errors import ShapeError
from torchcss.vision.sampling import inside_image, interpolate_bilinear, sample_bilinear


def plain_sample(image: Tensor, u: float, v: float) -> Tensor:
    """The four-corner formula, borders replicated."""
    _, height, width = image.shape
    u, v = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
    column, row = math.floor(u), math.floor(v)
    total = torch.zeros_like(image[:, 0, 0])
    for i, weight_v in ((row, 1.0 - (v - row)), (row + 1, v - row)):
        for j, weight_u in ((column, 1.0 - (u - column)), (column + 1, u - column)):
            total += weight_u * weight_v * image[:, min(i, height - 1), min(j, width - 1)]
    return total


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (6, 1), (2, 2), (5, 9)])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sampling_agrees_with_the_plain_formula(
    size: tuple[int, int], batch: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator
) -> None:
    height, width = size
    image = torch.rand(3, height, width, dtype=dtype, generator=generator)
    uv = (
        torch.rand(*batch, 8, 2, dtype=dtype, generator=generator)
        * torch.tensor([width + 2.0, height + 2.0], dtype=dtype)
        - 1.5
    )
    values, inside = sample_bilinear(image, uv)
    assert torch.equal(values, interpolate_bilinear(image, uv))
    assert torch.equal(inside, inside_image(uv, *image.shape[1:]))
    blocks = uv.movedim(-1, 0).contiguous().movedim(0, -1)
    torch.testing.assert_close(interpolate_bilinear(image, blocks), values)
    assert values.shape == (*batch, 8, 3)
    assert values.dtype == dtype
    tolerance = 1e-5 if dtype == torch.float32 else 1e-13
    expected = torch.stack([plain_sample(image, *point) for point in uv.reshape(-1, 2).tolist()])
    torch.testing.assert_close(values.reshape(-1, 3), expected, rtol=0.0, atol=tolerance)
    u, v = uv.unbind(-1)
    covered = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
    assert torch.equal(inside, covered)


def test_pixel_centres_are_at_whole_numbers() -> None:
    image = torch.arange(12.0, dtype=torch.float64).reshape(1, 3, 4)
    rows, columns = torch.meshgrid(torch.arange(3.0), torch.arange(4.0), indexing="ij")
    uv = torch.stack([columns, rows], dim=-1).double()
    values, inside = sample_bilinear(image, uv)
    torch.testing.assert_close(values[..., 0], image[0])
    assert inside.all()


def test_points_far_away_are_finite_and_outside() -> None:
    image = torch.rand(1, 5, 6)
    uv = torch.tensor([[1e30, 2.0], [-1e30, -1e30], [2.0, 1e9]])
    values, inside = sample_bilinear(image, uv)
    assert torch.isfinite(values).all()
    assert not inside.any()
    values, _ = sample_bilinear(image, torch.zeros(0, 2))
    assert values.shape == (0, 1)


def test_samples_take_the_dtype_of_the_points() -> None:
    values, _ = sample_bilinear(torch.rand(1, 4, 4), torch.zeros(3, 2, dtype=torch.float64))
    assert values.dtype == torch.float64


def test_bad_images_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"expected \[c, h, w\]"):
        sample_bilinear(torch.zeros(4, 4), torch.zeros(3, 2))
    with pytest.raises(ShapeError, match="at least one pixel"):
        sample_bilinear(torch.zeros(1, 0, 4), torch.zeros(3, 2))
    with pytest.raises(ShapeError, match="uv"):
        sample_bilinear(torch.zeros(1, 4, 4), torch.zeros(3))
