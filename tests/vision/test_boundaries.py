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

from torchcss.errors import ShapeError
from torchcss.vision.boundaries import displaced, motion_boundaries
from torchcss.vision.flow import TRACKING_FLOW, OpticalFlow, robust_flow


def with_outliers(outlier: Tensor) -> OpticalFlow:
    flow = torch.zeros(*outlier.shape[:-2], 2, *outlier.shape[-2:]).to(outlier)
    return OpticalFlow(flow, torch.zeros_like(outlier), outlier)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("smoothing", [1.0, 1.5, 3.0])
def test_clean_boundary(dtype: torch.dtype, smoothing: float) -> None:
    outlier = torch.zeros(40, 41, dtype=dtype)
    outlier[:, 19:21] = 1.0
    strength = 1 - motion_boundaries(with_outliers(outlier), smoothing=smoothing)
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
    torch.testing.assert_close(strength, strength.flip(0))


def test_noise_scores_less_than_a_line(generator: torch.Generator) -> None:
    outlier = (torch.rand(60, 60, generator=generator) < 0.05).float()
    outlier[:, 30:32] = 1.0
    strength = 1 - motion_boundaries(with_outliers(outlier))
    assert strength[:, 30:32].min() > 0.7
    assert strength[:, :24].mean() < 0.1


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("size", [(1, 1), (1, 30), (30, 1), (7, 12)])
def test_any_batch_and_size(
    batch: tuple[int, ...], size: tuple[int, int], generator: torch.Generator
) -> None:
    outlier = torch.rand(*batch, *size, generator=generator)
    result = motion_boundaries(with_outliers(outlier))
    assert result.shape == outlier.shape
    assert ((result >= 0.0) & (result <= 1.0)).all()
    if batch:
        last = tuple(count - 1 for count in batch)
        alone = motion_boundaries(with_outliers(outlier[last]))
        torch.testing.assert_close(result[last], alone)


@pytest.mark.parametrize("moved", [1, 2, 4, 6])
def test_boundaries_lie_where_the_second_frame_has_them(
    moved: int, generator: torch.Generator
) -> None:
    """Before ground that stands still, the trailing outline has left the place that it had."""

    def texture(height: int, width: int) -> Tensor:
        noise = functional.avg_pool2d(
            torch.rand(1, height + 4, width + 4, generator=generator), 5, 1
        )
        return ((noise - noise.mean()) / noise.std() * 0.12)[0]

    ground, thing = texture(120, 160) + 0.5, texture(60, 50) + 0.6

    def picture(offset: int) -> Tensor:
        whole = ground.clone()
        whole[30:90, 50 + offset : 100 + offset] = thing
        return whole

    flow = robust_flow(picture(0), picture(moved), TRACKING_FLOW)
    strength = 1 - motion_boundaries(flow)[40:80].mean(0)
    assert strength[50 + moved - 1 : 50 + moved + 1].max() > 0.75, "trailing"
    assert strength[100 + moved - 1 : 100 + moved + 1].max() > 0.75, "leading"
    assert strength[50 + moved + 7 : 100 - 7].max() < 0.1
    assert max(strength[:35].max(), strength[115 + moved :].max()) < 0.1


@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.0, -2.0), (0.5, 0.25), (40.0, 0.0)])
def test_carried_outliers_move_with_the_picture(shift: tuple[float, float]) -> None:
    outlier = torch.zeros(2, 20, 30)
    outlier[0, 8:12, 10:12] = 1.0
    flow = torch.tensor(shift)[:, None, None].expand(2, 2, 20, 30)
    there = displaced(outlier, flow, reach=3)
    u, v = math.floor(shift[0]), math.floor(shift[1])
    assert not there[1].any()
    if u == 40:
        assert not there.any()
        return
    torch.testing.assert_close(there.sum(), outlier.sum())
    whole = torch.zeros(22, 32)
    for x in (0, 1):
        for y in (0, 1):
            share = (shift[0] - u if x else 1 - shift[0] + u) * (
                shift[1] - v if y else 1 - shift[1] + v
            )
            whole[8 + v + y : 12 + v + y, 10 + u + x : 12 + u + x] += share
    torch.testing.assert_close(there[0], whole[:20, :30])


def test_outliers_need_their_flow() -> None:
    with pytest.raises(ShapeError, match="flow: expected two numbers"):
        motion_boundaries(OpticalFlow(torch.zeros(2, 4, 4), torch.zeros(5, 4), torch.zeros(5, 4)))


@pytest.mark.parametrize("shape", [(8,), (0, 4)])
def test_no_map_is_refused(shape: tuple[int, ...]) -> None:
    broken = OpticalFlow(torch.zeros(2, 4, 4), torch.zeros(4, 4), torch.zeros(shape))
    with pytest.raises(ShapeError, match="smoothness_outlier"):
        motion_boundaries(broken)


def test_true_boundaries_are_found(shared_data: Path) -> None:
    folder = shared_data / "flow_middlebury" / "RubberWhale"
    first, second = (
        torch.from_numpy(np.array(matplotlib.image.imread(folder / f"frame{number}.png")))
        for number in (10, 11)
    )
    flow = robust_flow(first[..., :3].mean(dim=-1), second[..., :3].mean(dim=-1), TRACKING_FLOW)
    found = motion_boundaries(flow) < 0.5
    true = flow_discontinuities(*read_flow(folder / "flow10.flo"))

    def near(mask: Tensor) -> Tensor:
        return functional.max_pool2d(mask[None].float(), 7, 1, 3)[0] > 0.0

    assert (found & near(true)).sum() > 0.8 * found.sum()
    assert (true & near(found)).sum() > 0.9 * true.sum()
