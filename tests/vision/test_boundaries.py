"""Motion boundaries from outlier maps, and those of a known flow."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import torch
from common.flow_files import flow_discontinuities, read_flow
from torch import Tensor
from torch.nn import functional

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.vision.boundaries import BoundaryConfiguration, motion_boundaries
from torchcss.vision.flow import TRACKING, OpticalFlow, robust_flow


def with_outliers(outlier: Tensor) -> OpticalFlow:
    flow = torch.zeros(*outlier.shape[:-2], 2, *outlier.shape[-2:]).to(outlier)
    return OpticalFlow(flow, torch.zeros_like(outlier), outlier)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("smoothing", [1.0, 1.5, 3.0])
def test_clean_boundary(dtype: torch.dtype, smoothing: float) -> None:
    outlier = torch.zeros(40, 41, dtype=dtype)
    outlier[:, 19:21] = 1.0
    configuration = BoundaryConfiguration(smoothing=smoothing, half_strength_line=0.5)
    strength, potential = motion_boundaries(with_outliers(outlier), configuration)
    assert strength.dtype == dtype
    # The line response is the mean of the Gaussian over the two pixels, relative to its peak.
    offset = torch.arange(-math.ceil(3.0 * smoothing), math.ceil(3.0 * smoothing) + 1)
    kernel = torch.exp(-offset.square() / (2.0 * smoothing**2))
    kernel /= kernel.sum()
    middle = len(kernel) // 2
    line = math.sqrt(0.5 * math.pi) * smoothing * float(kernel[middle] + kernel[middle + 1])
    assert 0.8 < line < 1.0
    expected = torch.full((40, 2), line**2 / (line**2 + 0.25), dtype=dtype)
    torch.testing.assert_close(strength[:, 19:21], expected, rtol=1e-4, atol=1e-5)
    assert (strength[:, :9] == 0.0).all()
    torch.testing.assert_close(strength + potential, torch.ones_like(strength))
    torch.testing.assert_close(strength, strength.flip(0))


def test_noise_scores_less_than_a_line(generator: torch.Generator) -> None:
    outlier = (torch.rand(60, 60, generator=generator) < 0.05).float()
    outlier[:, 30:32] = 1.0
    strength = motion_boundaries(with_outliers(outlier)).strength
    assert strength[:, 30:32].min() > 0.7
    assert strength[:, :24].mean() < 0.1


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("size", [(1, 1), (1, 30), (30, 1), (7, 12)])
def test_any_batch_and_size(
    batch: tuple[int, ...], size: tuple[int, int], generator: torch.Generator
) -> None:
    outlier = torch.rand(*batch, *size, generator=generator)
    result = motion_boundaries(with_outliers(outlier))
    for field in result:
        assert field.shape == outlier.shape
        assert ((field >= 0.0) & (field <= 1.0)).all()
    if batch:
        last = tuple(count - 1 for count in batch)
        alone = motion_boundaries(with_outliers(outlier[last]))
        torch.testing.assert_close(result.strength[last], alone.strength)


@pytest.mark.parametrize("shape", [(8,), (0, 4)])
def test_no_map_is_refused(shape: tuple[int, ...]) -> None:
    broken = OpticalFlow(torch.zeros(2, 4, 4), torch.zeros(4, 4), torch.zeros(shape))
    with pytest.raises(ShapeError, match="smoothness_outlier"):
        motion_boundaries(broken)


@pytest.mark.parametrize("name", ["smoothing", "half_strength_line"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_choices_without_sense_are_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigurationError, match=name):
        BoundaryConfiguration(**{name: value})


def test_true_boundaries_are_found(shared_data: Path) -> None:
    folder = shared_data / "flow_middlebury" / "RubberWhale"
    first, second = (
        torch.from_numpy(np.array(matplotlib.image.imread(folder / f"frame{number}.png")))
        for number in (10, 11)
    )
    flow = robust_flow(first[..., :3].mean(dim=-1), second[..., :3].mean(dim=-1), TRACKING)
    found = motion_boundaries(flow).strength > 0.5
    true = flow_discontinuities(*read_flow(folder / "flow10.flo"))

    def near(mask: Tensor) -> Tensor:
        return functional.max_pool2d(mask[None].float(), 7, 1, 3)[0] > 0.0

    assert (found & near(true)).sum() > 0.8 * found.sum()
    assert (true & near(found)).sum() > 0.9 * true.sum()
