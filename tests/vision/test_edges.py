"""Edge energy: flat images, steps, contrast, direction, borders, a rendered figure's outline."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.vision.edges import EdgeConfiguration, edge_features, foreground_weight


def step_image(low: float = 0.3, high: float = 0.7) -> Tensor:
    """A vertical step between columns 39 and 40."""
    image = torch.full((60, 80), low, dtype=torch.float64)
    image[:, 40:] = high
    return image


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("level", [0.0, 0.1, 1.0 / 3.0, 0.7, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (2, 3), (48, 64)])
def test_flat_image_has_no_energy(dtype: torch.dtype, level: float, size: tuple[int, int]) -> None:
    features = edge_features(torch.full(size, level, dtype=dtype))
    assert features.energy.shape == size
    assert features.direction.shape == (2, *size)
    for tensor in features:
        assert tensor.dtype == dtype
        assert (tensor == 0.0).all()


def test_step_has_its_peak_on_the_step_and_points_to_the_bright_side() -> None:
    features = edge_features(step_image())
    row = features.energy[30]
    assert set(row.topk(2).indices.tolist()) == {39, 40}
    torch.testing.assert_close(row[39], row[40])
    assert row[39] > 0.6
    assert row[:30].max() < 0.05
    torch.testing.assert_close(
        features.direction[:, 30, 39], torch.tensor([1.0, 0.0], dtype=torch.float64)
    )
    upside_down = edge_features(1.0 - step_image().T)
    torch.testing.assert_close(upside_down.energy.T, features.energy)
    torch.testing.assert_close(
        upside_down.direction[:, 39, 30], torch.tensor([0.0, -1.0], dtype=torch.float64)
    )


def test_energy_is_bounded_and_direction_is_a_unit_vector(generator: torch.Generator) -> None:
    features = edge_features(torch.rand(50, 70, generator=generator))
    assert (features.energy >= 0.0).all()
    assert (features.energy < 1.0).all()
    length = features.direction.norm(dim=0)
    torch.testing.assert_close(length, (features.energy > 0.0).float())
    torch.testing.assert_close(
        features.direction * features.gradient.norm(dim=0), features.gradient
    )


def test_normalisation_evens_out_light_and_the_floor_keeps_noise_quiet(
    generator: torch.Generator,
) -> None:
    strong = edge_features(step_image(low=0.1, high=0.9)).energy[30, 39]
    weak = edge_features(step_image(low=0.3, high=0.5)).energy[30, 39]
    faint = edge_features(step_image(low=0.400, high=0.405)).energy[30, 39]
    assert weak > 0.6 * strong  # the gradient is four times, its square sixteen times smaller
    assert faint < 0.05
    noise = 0.5 + 0.01 * torch.randn(100, 100, generator=generator)
    assert edge_features(noise).energy.mean() < 0.02


def test_without_a_window_contrast_is_not_normalised() -> None:
    """[RR] 3.2: a step of one floor has half the energy, in whatever surroundings."""
    plain = EdgeConfiguration(window=None, floor=0.1)
    for low in (0.1, 0.5):
        energy = edge_features(step_image(low=low, high=low + 0.1), plain).energy
        assert float(energy.max()) == pytest.approx(0.5, abs=0.1)
    strong = edge_features(step_image(low=0.1, high=0.9), plain).energy[30, 39]
    weak = edge_features(step_image(low=0.3, high=0.35), plain).energy[30, 39]
    assert weak < 0.3 * strong


def test_smoothing_does_not_change_the_scale() -> None:
    """The factor sqrt(2 pi) smoothing makes the peak that of the step, less Sobel's own blur."""
    peaks = [
        edge_features(step_image(), EdgeConfiguration(smoothing=s)).gradient[0, 30, 39]
        for s in (1.5, 2.0, 3.0)
    ]
    assert max(peaks) / min(peaks) < 1.25


def test_border_shows_the_full_slope_and_no_edge_of_its_own() -> None:
    ramp = torch.arange(80, dtype=torch.float64).expand(60, 80) / 79.0
    choice = EdgeConfiguration(smoothing=0.3, window=500.0)  # practically no smoothing
    gradient = edge_features(ramp, choice).gradient[0]
    torch.testing.assert_close(gradient[:, [0, -1]], gradient[:, [1, -2]], rtol=0.02, atol=0.0)
    energy = edge_features(step_image()).energy
    torch.testing.assert_close(energy[0], energy[30])
    torch.testing.assert_close(energy[-1], energy[30])


def test_outline_of_a_figure_stands_out(shared_data) -> None:
    """On the outline of a rendered figure before clutter the energy is several times the rest's."""
    av = pytest.importorskip("av")
    folder = shared_data / "rendered_upper_body"
    with av.open(str(folder / "video.mp4")) as container:
        frame = next(container.decode(video=0)).to_ndarray(format="gray")
    mask = torch.from_numpy(np.load(folder / "mask.npz")["mask"][0]).float()[None, None]
    widened = torch.nn.functional.max_pool2d(mask, 3, 1, 1)
    narrowed = -torch.nn.functional.max_pool2d(-mask, 3, 1, 1)
    outline = (widened - narrowed)[0, 0] > 0.0
    energy = edge_features(torch.from_numpy(frame).float() / 255.0).energy
    near = torch.nn.functional.max_pool2d(energy[None, None], 3, 1, 1)[0, 0]
    assert near[outline].median() > 0.5
    assert energy[outline].median() > 5.0 * energy.median()


def test_bad_input_is_refused() -> None:
    for bad in (torch.zeros(3, 4, 5), torch.zeros(0, 4), torch.zeros(3, 4, dtype=torch.uint8)):
        with pytest.raises(ShapeError, match="grey"):
            edge_features(bad)
    for name in ("smoothing", "window", "floor", "half_energy_step"):
        with pytest.raises(ConfigurationError, match=name):
            EdgeConfiguration(**{name: 0.0})


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


def test_bad_masks_are_refused() -> None:
    for bad in (torch.zeros(3), torch.zeros(1, 3, 4), torch.zeros(0, 4), torch.zeros(3, 4).bool()):
        with pytest.raises(ShapeError, match="mask: expected"):
            foreground_weight(bad)
