"""Robust flow: its parts against plain twins, scenes of known motion, Middlebury, bad input."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import torch
from common.flow_files import flow_discontinuities, read_flow, with_potentials
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline
from torch import Tensor
from torch.nn import functional

from torchcss.errors import ConfigurationError, FrameError, ShapeError
from torchcss.robust import Charbonnier, Leclerc, Lorentzian, Quadratic
from torchcss.vision import flow as module
from torchcss.vision import warping
from torchcss.vision.flow import (
    ACCURATE,
    TRACKING_FLOW,
    FlowConfiguration,
    OpticalFlow,
    robust_flow,
)

KINDS = (Lorentzian, Leclerc, Charbonnier, Quadratic)


def texture(u: Tensor, v: Tensor, seed: int = 0) -> Tensor:
    """A pattern of wavelengths from 6 to 100 px, coarse ones stronger, evaluated at any points."""
    generator = torch.Generator().manual_seed(seed)
    total = torch.zeros_like(u)
    for octave in torch.linspace(0.0, 1.0, 32).tolist():
        wavelength = 6.0 * (100.0 / 6.0) ** octave
        angle, phase = (2.0 * math.pi * torch.rand(2, generator=generator).double()).tolist()
        wave = 2.0 * math.pi / wavelength * (math.cos(angle) * u + math.sin(angle) * v)
        total = total + (0.5 + octave) * torch.sin(wave + phase)
    return (0.5 + total / 24.0).clamp(0.0, 1.0)


def grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    v, u = torch.meshgrid(
        torch.arange(height).double(), torch.arange(width).double(), indexing="ij"
    )
    return u, v


def shifted(height: int, width: int, du: float, dv: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    u, v = grid(height, width)
    return texture(u, v, seed).float(), texture(u - du, v - dv, seed).float()


def disc(height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """A textured disc moves right by 4 px over a background that moves left by 1 px."""
    u, v = grid(height, width)
    radius = 0.3 * height

    def frame(time: float) -> Tensor:
        du = u - width / 2 - 4.0 * time
        inside = du.square() + (v - height / 2).square() < radius**2
        return torch.where(inside, texture(du, v, 1), texture(u + time, v, 2)).float()

    inside = (u - width / 2).square() + (v - height / 2).square() < radius**2
    truth = torch.stack([torch.where(inside, 4.0, -1.0), torch.zeros_like(u)]).float()
    return frame(0.0), frame(1.0), truth


def end_point_error(flow: Tensor, truth: Tensor) -> Tensor:
    return (flow - truth).square().sum(dim=-3).sqrt()


def assert_sound(result: OpticalFlow, shape: tuple[int, ...]) -> None:
    assert result.flow.shape == (*shape[:-2], 2, *shape[-2:])
    assert result.flow.isfinite().all()
    for outlier in (result.data_outlier, result.smoothness_outlier):
        assert outlier.shape == shape
        assert ((outlier >= 0.0) & (outlier <= 1.0)).all()


# The parts against plain twins


def test_solver_reaches_the_dense_solution(generator: torch.Generator) -> None:
    height, width = 5, 6
    sizes = {"generator": generator, "dtype": torch.float64}
    constancy = warping.Constancy(
        torch.randn(1, 2, height, width, **sizes),
        torch.randn(1, 1, height, width, **sizes),
        torch.ones(1, 1, height, width),
    )
    weight = torch.rand(1, 1, height, width, **sizes)
    right = torch.rand(1, 1, height, width - 1, **sizes)
    down = torch.rand(1, 1, height - 1, width, **sizes)
    start = torch.randn(1, 2, height, width, **sizes)

    def energy(flat: Tensor) -> Tensor:
        flow = flat.view(1, 2, height, width)
        return (
            (weight * constancy.residual(flow).square()).sum()
            + (right * flow.diff(dim=-1).square()).sum()
            + (down * flow.diff(dim=-2).square()).sum()
        )

    zero = torch.zeros(2 * height * width, dtype=torch.float64)
    gradient = torch.autograd.functional.jacobian(energy, zero)
    hessian = torch.autograd.functional.hessian(energy, zero)
    expected = -torch.linalg.solve(hessian, gradient)
    found = module._solve(start, module._Quadratic.of(constancy, weight, right, down), 300)
    torch.testing.assert_close(found.flatten(), expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("radius", [1, 2, 3])
@pytest.mark.parametrize("strip_values", [1, 4 * 4 * 13, 65_536])
def test_median_is_the_median(
    radius: int, strip_values: int, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_STRIP_VALUES", strip_values)
    images = torch.randn(2, 2, 9, 13, generator=generator).round(decimals=1)
    padded = functional.pad(images, (radius,) * 4, mode="replicate")
    side = 2 * radius + 1
    windows = padded.unfold(-2, side, 1).unfold(-2, side, 1).flatten(-2)
    assert torch.equal(module._median(images, radius), windows.median(dim=-1).values)


def test_weighted_median_against_a_loop(generator: torch.Generator) -> None:
    height, width, radius = 9, 11, 2
    flow = torch.randn(1, 2, height, width, generator=generator, dtype=torch.float64)
    held = torch.rand(1, 1, height, width, generator=generator, dtype=torch.float64)
    guide = 0.05 * torch.rand(1, 1, height, width, generator=generator, dtype=torch.float64)
    found = module._with_weighted_median_along_jumps(flow, flow, held, guide, radius)
    for row in range(height):
        for column in range(width):
            voters = [
                (r, c)
                for r in range(max(0, row - radius), min(height, row + radius + 1))
                for c in range(max(0, column - radius), min(width, column + radius + 1))
                if (r - row + c - column) % 2 == 0
            ]
            weights = np.array(
                [
                    float(held[0, 0, r, c])
                    * np.exp(-((r - row) ** 2 + (c - column) ** 2) / (2 * (1.4 * radius) ** 2))
                    * np.exp(
                        -(float(guide[0, 0, r, c] - guide[0, 0, row, column]) ** 2)
                        / (2 * (7.0 / 255.0) ** 2)
                    )
                    for r, c in voters
                ]
            )
            for axis in range(2):
                values = np.array([float(flow[0, axis, r, c]) for r, c in voters])
                order = np.argsort(values)
                middle = np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())
                assert float(found[0, axis, row, column]) == values[order][middle]


def test_spline_against_scipy(generator: torch.Generator) -> None:
    """Values and slopes between the pixels; scipy's natural spline, one axis after the other."""
    image = torch.rand(1, 1, 7, 9, generator=generator, dtype=torch.float64)
    flow = 2 * torch.rand(1, 2, 7, 9, generator=generator, dtype=torch.float64) - 1
    for line in (flow[0, 0, :, 0], flow[0, 1, 0]):
        line.abs_()
    for line in (flow[0, 0, :, -1], flow[0, 1, -1]):
        line.abs_().neg_()
    value, slope, visible = warping._sampled(warping.image_spline(image), flow)
    assert visible.all()
    across = CubicSpline(np.arange(7), image[0, 0].numpy(), bc_type="natural")
    for row, column in np.ndindex(7, 9):
        u, v = column + float(flow[0, 0, row, column]), row + float(flow[0, 1, row, column])
        along = CubicSpline(np.arange(9), across(v), bc_type="natural")
        upwards = CubicSpline(np.arange(9), across(v, 1), bc_type="natural")
        assert float(value[0, 0, row, column]) == pytest.approx(float(along(u)), abs=1e-12)
        expected = [float(along(u, 1)), float(upwards(u))]
        assert slope[0, :, row, column].tolist() == pytest.approx(expected, abs=1e-12)


def test_slopes_are_those_of_the_spline(generator: torch.Generator) -> None:
    spline = warping.image_spline(torch.rand(1, 1, 7, 9, generator=generator))
    _, expected, _ = warping._sampled(spline, torch.zeros(1, 2, 7, 9))
    torch.testing.assert_close(warping.image_slopes(spline), expected, atol=1e-5, rtol=0)


def test_sampling_at_whole_pixels(generator: torch.Generator) -> None:
    image = torch.rand(1, 1, 7, 9, generator=generator)
    flow = torch.zeros(1, 2, 7, 9)
    flow[:, 0], flow[:, 1] = 2.0, -1.0
    sampled, _, visible = warping._sampled(warping.image_spline(image), flow)
    torch.testing.assert_close(sampled[..., 1:, :-2], image[..., :-1, 2:], atol=1e-5, rtol=0)
    assert visible[0, 0, 1:, :-2].all()
    assert not visible[0, 0, 0].any()
    assert not visible[0, 0, :, -2:].any()


@pytest.mark.parametrize("deviation", [0.0, 2.0, 6.0])
def test_noise_is_taken_out_and_nothing_else(deviation: float, generator: torch.Generator) -> None:
    u, v = grid(80, 100)
    frames = torch.stack([texture(u / 4, v / 4, seed).float() for seed in (1, 2)])[None]
    noise = deviation / 255 * torch.randn(frames.shape, generator=generator)
    cleaned = module._without_noise(frames + noise)
    if deviation:
        assert (cleaned - frames).std() < 0.6 * noise.std()
    else:
        assert torch.equal(cleaned, frames)


def test_structure_does_not_bend_at_the_border() -> None:
    """A slope is all structure, to the border."""
    slope = torch.linspace(0.2, 0.8, 40).expand(1, 2, 30, 40)
    left = slope - module._structure_of_wider(slope)
    assert left[..., :3].abs().max() < 0.2 * (slope - module._structure(slope))[..., 0].abs().max()


def test_structure_keeps_the_mean_and_has_less_variation(generator: torch.Generator) -> None:
    images = torch.rand(2, 2, 15, 20, generator=generator)
    structure = module._structure(images)
    torch.testing.assert_close(structure.mean(dim=(-2, -1)), images.mean(dim=(-2, -1)))

    def variation(x: Tensor) -> Tensor:
        return x.diff(dim=-1).abs().sum() + x.diff(dim=-2).abs().sum()

    assert variation(structure) < 0.6 * variation(images)
    flat = torch.full((1, 2, 6, 6), 0.3)
    assert torch.equal(module._structure(flat), flat)


# Scenes of known motion


@pytest.mark.parametrize("configuration", [ACCURATE, TRACKING_FLOW])
@pytest.mark.parametrize("motion", [(0.4, -0.3), (5.5, 2.25)])
def test_subpixel_translation(
    configuration: FlowConfiguration, motion: tuple[float, float]
) -> None:
    first, second = shifted(60, 81, *motion)
    result = robust_flow(first, second, configuration)
    error = end_point_error(result.flow, torch.tensor(motion).view(2, 1, 1))
    assert error[8:-8, 8:-8].mean() < 0.05
    assert error[8:-8, 8:-8].max() < 0.15
    assert result.smoothness_outlier[8:-8, 8:-8].mean() < 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_every_potential_finds_the_motion(kind: type[Quadratic]) -> None:
    first, second = shifted(48, 64, 1.5, -2.0)
    result = robust_flow(first, second, with_potentials(TRACKING_FLOW, kind))
    error = end_point_error(result.flow, torch.tensor([1.5, -2.0]).view(2, 1, 1))
    assert error[6:-6, 6:-6].mean() < 0.03


@pytest.mark.parametrize("configuration", [ACCURATE, TRACKING_FLOW])
def test_moving_disc(configuration: FlowConfiguration) -> None:
    first, second, truth = disc(80, 100)
    boundary = flow_discontinuities(truth)
    near = functional.max_pool2d(boundary[None].float(), 11, 1, 5)[0] > 0.0
    robust = robust_flow(first, second, configuration)
    quadratic = robust_flow(first, second, with_potentials(configuration, Quadratic))
    error, quadratic_error = (end_point_error(x.flow, truth) for x in (robust, quadratic))
    assert error[near].mean() < 0.75 * quadratic_error[near].mean()
    assert error[~near].mean() < 0.1
    # The outliers of smoothness lie on the boundary, those of the data on what gets covered.
    assert robust.smoothness_outlier[boundary].mean() > 0.6
    assert robust.smoothness_outlier[~near].mean() < 0.05
    u, v = grid(80, 100)
    covered = ((u - 54.0).square() + (v - 40.0).square() < 23.0**2) & (truth[0] < 0.0)
    covered &= (u - 50.0).square() + (v - 40.0).square() > 25.0**2
    assert robust.data_outlier[covered].mean() > 3.0 * robust.data_outlier[~near].mean()
    assert (quadratic.smoothness_outlier == 0.0).all()


@pytest.mark.parametrize("configuration", [ACCURATE, TRACKING_FLOW])
def test_motion_of_a_tenth_of_the_frame(configuration: FlowConfiguration) -> None:
    first, second = shifted(120, 160, 12.0, -5.0)
    error = end_point_error(
        robust_flow(first, second, configuration).flow, torch.tensor([12.0, -5.0]).view(2, 1, 1)
    )
    assert error[8:-8, 8:-16].mean() < 0.05


@pytest.mark.parametrize("configuration", [ACCURATE, TRACKING_FLOW])
def test_light_that_changes(configuration: FlowConfiguration) -> None:
    """Also on smooth texture and along the border, where texture alone says little."""
    u, v = grid(60, 81)
    first, second = (texture(u / 3 - move, v / 3, 4) for move in (0.0, 0.5))
    second = (1.05 * second + 0.04 * u / 81 - 0.02).clamp(0.0, 1.0)
    result = robust_flow(first.float(), second.float(), configuration)
    error = end_point_error(result.flow, torch.tensor([1.5, 0.0]).view(2, 1, 1))
    assert error[:, :-3].mean() < 0.2


def test_what_leaves_the_view_is_an_outlier() -> None:
    first, second = shifted(48, 64, 6.0, 0.0)
    outlier = robust_flow(first, second, TRACKING_FLOW).data_outlier
    assert outlier[:, -4:].mean() > 0.95
    assert outlier[:, 8:-8].mean() < 0.1


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("configuration", [ACCURATE, TRACKING_FLOW])
def test_any_batch(batch: tuple[int, ...], configuration: FlowConfiguration) -> None:
    first, second = (frame.expand(*batch, 33, 38) for frame in shifted(33, 38, 1.0, 0.5))
    result = robust_flow(first, second, configuration)
    assert_sound(result, (*batch, 33, 38))
    error = end_point_error(result.flow, torch.tensor([1.0, 0.5]).view(2, 1, 1))
    assert error[..., 6:-6, 6:-6].mean() < 0.03


@pytest.mark.parametrize("configuration", [ACCURATE, TRACKING_FLOW])
def test_items_do_not_influence_each_other(
    configuration: FlowConfiguration, generator: torch.Generator
) -> None:
    frames = torch.stack(disc(33, 38)[:2])
    others = torch.rand(2, 2, 33, 38, generator=generator)
    one, other = (
        robust_flow(*torch.stack([frames, x], dim=1), configuration=configuration) for x in others
    )
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a[0], b[0])
        assert not torch.equal(a[1], b[1])


def test_double_agrees_with_single_precision() -> None:
    first, second = shifted(40, 50, 2.0, 1.0)
    single = robust_flow(first, second, TRACKING_FLOW)
    double = robust_flow(first.double(), second.double(), TRACKING_FLOW)
    assert double.flow.dtype == torch.float64
    torch.testing.assert_close(single.flow.double(), double.flow, atol=1e-2, rtol=0)


def test_frames_that_require_gradients_are_fine() -> None:
    first, second = shifted(20, 20, 1.0, 0.0)
    assert not robust_flow(first.requires_grad_(), second, TRACKING_FLOW).flow.requires_grad


# Middlebury


def read_grey(path: Path) -> Tensor:
    image = torch.from_numpy(np.asarray(matplotlib.image.imread(path), np.float32))
    return image[..., :3] @ image.new_tensor([0.299, 0.587, 0.114])


@pytest.fixture(scope="module", params=["RubberWhale", "Grove3"])
def pair(shared_data: Path, request: pytest.FixtureRequest) -> tuple[Tensor, ...]:
    folder = shared_data / "flow_middlebury" / request.param
    frames = (read_grey(folder / f"frame{number}.png") for number in (10, 11))
    return *frames, *read_flow(folder / "flow10.flo")


# Measured with OpenCV 5's DIS, preset medium, on the same frames.
DIS = {388: (0.223, 0.474), 480: (0.853, 1.715)}
REACH = {388: 0.16, 480: 0.75}


@pytest.mark.parametrize("configuration", [ACCURATE, TRACKING_FLOW])
def test_middlebury(pair: tuple[Tensor, ...], configuration: FlowConfiguration) -> None:
    first, second, truth, known = pair
    result = robust_flow(first, second, configuration)
    assert_sound(result, tuple(first.shape))
    error = end_point_error(result.flow, truth)[known]
    dis_mean, dis_root = DIS[len(first)]
    assert error.mean() < min(dis_mean, REACH[len(first)])
    assert error.square().mean().sqrt() < dis_root


def test_robust_beats_quadratic_near_boundaries(pair: tuple[Tensor, ...]) -> None:
    first, second, truth, known = pair
    boundary = flow_discontinuities(truth, known)
    near = known & (functional.max_pool2d(boundary[None].float(), 11, 1, 5)[0] > 0.0)
    robust, quadratic = (
        end_point_error(robust_flow(first, second, configuration).flow, truth)[near].mean()
        for configuration in (TRACKING_FLOW, with_potentials(TRACKING_FLOW, Quadratic))
    )
    assert robust < 0.97 * quadratic


# Awkward and bad input


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("configuration", [ACCURATE, TRACKING_FLOW])
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (2, 3), (37, 23)])
def test_awkward_frames_give_finite_flow(
    kind: type[Quadratic],
    configuration: FlowConfiguration,
    size: tuple[int, int],
    generator: torch.Generator,
) -> None:
    noise = torch.rand(size, generator=generator)
    frames = torch.stack(
        [torch.zeros(size), torch.ones(size), torch.full(size, 0.4), noise, noise.round()]
    )
    first = frames.repeat_interleave(len(frames), dim=0)
    second = frames.repeat(len(frames), 1, 1)
    result = robust_flow(first, second, with_potentials(configuration, kind))
    assert_sound(result, (len(frames) ** 2, *size))
    flow = result.flow.view(len(frames), len(frames), 2, *size)
    assert flow.diagonal().abs().max() < 1e-4
    assert (flow[:3, :3] == 0.0).all()


@settings(max_examples=25, deadline=None)
@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    seed=st.integers(0, 2**31),
    kind=st.sampled_from(KINDS),
    coarse=st.booleans(),
)
def test_no_nan_leaves(height: int, width: int, seed: int, kind: type, coarse: bool) -> None:
    generator = torch.Generator().manual_seed(seed)
    frames = torch.rand(2, height, width, generator=generator)
    if coarse:  # large flat patches, black and white
        frames = (torch.rand(2, 1, 3, 3, generator=generator) > 0.5).float()
        frames = functional.interpolate(frames, size=(height, width))[:, 0]
    assert_sound(robust_flow(*frames, with_potentials(ACCURATE, kind)), (height, width))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (torch.zeros(8, 9), torch.zeros(9, 8)),
        (torch.zeros(2, 8, 9), torch.zeros(8, 9)),
        (torch.zeros(8), torch.zeros(8)),
        (torch.zeros(0, 9), torch.zeros(0, 9)),
        (torch.zeros(8, 9), torch.zeros(8, 9, dtype=torch.float64)),
        (torch.zeros(8, 9, dtype=torch.uint8), torch.zeros(8, 9, dtype=torch.uint8)),
    ],
)
def test_frames_that_do_not_fit_are_refused(first: Tensor, second: Tensor) -> None:
    with pytest.raises(ShapeError, match="expected two frames"):
        robust_flow(first, second)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 255.0, -3.0])
def test_pixels_that_are_no_grey_levels_are_refused(value: float) -> None:
    frame, broken = torch.zeros(8, 9), torch.zeros(8, 9)
    broken[3, 4] = value
    with pytest.raises(FrameError, match="second frame must hold grey levels"):
        robust_flow(frame, broken)


@pytest.mark.parametrize(
    "change",
    [
        {"num_warps": 0},
        {"num_warps": 2},
        {"num_reweightings": 0},
        {"weighted_median_radius": -1},
        {"texture": 1.5},
        {"pyramid_factor": 1.0},
        {"sigma_factors": ()},
        {"sigma_factors": (1.0, float("nan"))},
    ],
)
def test_choices_without_sense_are_refused(change: dict) -> None:
    with pytest.raises(ConfigurationError, match="flow: "):
        dataclasses.replace(ACCURATE, **change)
