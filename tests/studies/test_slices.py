"""Slices: minima against their definition, jumps against curves whose jumps are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.studies.slices import (
    StateLine,
    curve_minima,
    eigen_lines,
    joint_lines,
    largest_jump,
    sample_slice,
)
from torchcss.types import Bounds


def line(deviation: float = 1.0) -> StateLine:
    zero = torch.zeros(2, dtype=torch.float64)
    return StateLine("first", zero, torch.tensor([1.0, 0.0], dtype=torch.float64), deviation)


@pytest.mark.parametrize("levels", [3, 8, 1000])
def test_minima_and_prominences_are_as_defined(levels: int) -> None:
    """Few levels make runs of equal samples, also at the ends."""

    def climb(from_here: np.ndarray) -> float:
        lower = np.flatnonzero(from_here < from_here[0])
        return from_here[: lower[0] if len(lower) else None].max() - from_here[0]

    random = np.random.default_rng(levels)
    for length in (3, 4, 7, 60):
        for _ in range(50):
            curve = random.integers(levels, size=length).astype(float)
            minima = curve_minima(curve)
            runs = np.split(np.arange(length), np.flatnonzero(np.diff(curve)) + 1)
            level = curve[[run[0] for run in runs]]
            found = np.flatnonzero((level[1:-1] < level[:-2]) & (level[1:-1] < level[2:])) + 1
            middle = [(runs[i][0] + runs[i][-1]) // 2 for i in found]
            expected = [min(climb(level[i::-1]), climb(level[i:])) for i in found]
            assert minima.sample.tolist() == middle
            assert minima.prominence.tolist() == expected


def test_prominence_is_the_easier_climb_and_ends_are_no_minima() -> None:
    curve = [0.0, 5.0, 3.0, 4.0, 1.0, 9.0, 2.0]
    minima = curve_minima(curve)
    assert minima.sample.tolist() == [2, 4]
    assert minima.prominence.tolist() == [1.0, 4.0]  # over 4 to the 1; over 5 to the 0
    assert minima.above(2.0).sample.tolist() == [4]
    for monotone in ([1.0, 2.0, 3.0], [3.0, 2.0, 2.0], [1.0] * 5, [1.0]):
        assert curve_minima(monotone).sample.tolist() == []


@pytest.mark.parametrize("values", [[[1.0, 2.0]], [1.0, math.nan, 2.0]])
def test_no_curve_is_a_typed_error(values: list) -> None:
    with pytest.raises(ShapeError, match="one axis of numbers"):
        curve_minima(values)


def test_lines_follow_the_covariance(generator: torch.Generator) -> None:
    root = torch.randn(4, 4, generator=generator, dtype=torch.float64)
    covariance, centre = root @ root.mT, torch.arange(4.0, dtype=torch.float64)
    values = torch.linalg.eigvalsh(covariance).flip(0)
    eigen = eigen_lines(centre, covariance)
    assert [li.name for li in eigen] == ["eigen 0", "eigen 1", "eigen 2", "eigen 3"]
    for li, value in zip(eigen, values, strict=True):
        torch.testing.assert_close(covariance @ li.direction, value * li.direction)
        assert li.deviation == pytest.approx(float(value) ** 0.5)
        assert float(li.direction[li.direction.abs().argmax()]) > 0
    precision = torch.linalg.inv(covariance)
    for i, li in enumerate(joint_lines("abcd", centre, covariance)):
        assert li.name == "abcd"[i]
        assert li.deviation == pytest.approx(float(precision[i, i]) ** -0.5)
        states = li.states([-1.0, 0.0, 2.0])
        torch.testing.assert_close(states[1], centre)
        assert float(states[2, i] - centre[i]) == pytest.approx(2.0)


def test_the_interval_ends_at_the_first_bound() -> None:
    bounds = Bounds(torch.tensor([-1.0, -3.0]), torch.tensor([2.0, math.inf]))
    centre = torch.tensor([0.0, 0.0], dtype=torch.float64)

    def interval(direction: list[float], at: torch.Tensor = centre, **reach: float):
        d = torch.tensor(direction, dtype=torch.float64)
        return StateLine("x", at, d, 1.0).interval(bounds, **reach)

    assert interval([1.0, 0.0]) == (-1.0, 2.0)
    assert interval([-1.0, 0.0]) == (-2.0, 1.0)
    assert interval([1.0, -2.0]) == (-1.0, 1.5)
    assert interval([1.0, 0.0], reach=0.5) == (-0.5, 0.5)
    # At a bound there is nothing on one side, also where rounding put the state beyond it.
    assert interval([1.0, 0.0], torch.tensor([2.0, 0.0], dtype=torch.float64)) == (-3.0, 0.0)
    assert interval([1.0, 0.0], torch.tensor([2.1, 0.0], dtype=torch.float64))[1] == 0.0
    # A component that is rounding does not hold the line there.
    assert interval([1e-12, 1.0], torch.tensor([2.0, 0.0], dtype=torch.float64), reach=5.0) == (
        -3.0,
        5.0,
    )
    assert interval([0.0, 1.0], reach=5.0) == (-3.0, 5.0)
    with pytest.raises(ConfigurationError, match="reach"):
        interval([0.0, 1.0])


def test_a_gaussian_rises_by_half_a_squared_deviation() -> None:
    taken = sample_slice(lambda x: {"prior": 2 * x[:, 0] ** 2}, line(0.5), (-2.0, 2.0), 41)
    assert taken.offsets.shape == (41,)
    assert taken.fine_offsets.shape == (81,)
    np.testing.assert_allclose(taken.values["sum"], 0.5 * (taken.offsets / 0.5) ** 2)
    report = taken.report("sum")
    assert (report.num_minima_raw, report.num_minima) == (1, 1)
    assert report.lowest_at == 0.0
    assert report.range_nats == pytest.approx(8.0)


def test_slopes_halve_and_discontinuities_stay() -> None:
    def terms(x: torch.Tensor) -> dict[str, torch.Tensor]:
        t = x[:, 0]
        # Neither is where a sample is. The step is smaller than the slope between two samples.
        return {
            "slope": torch.tanh(20 * (t - 0.1234)),
            "step": torch.where(t > 0.4321, 0.1, 0.0) + torch.tanh(20 * (t - 0.1234)),
            "nothing": 3.0 + 1e-9 * torch.sin(1000 * t),
        }

    taken = sample_slice(terms, line(), (-1.0, 1.0), 101)
    slope, step, nothing = (taken.report(name) for name in ("slope", "step", "nothing"))
    assert slope.largest_jump_twice_density == pytest.approx(slope.largest_jump / 2, rel=0.05)
    assert slope.discontinuity < 1e-3 * slope.largest_jump
    assert step.discontinuity * step.range_nats == pytest.approx(0.1, rel=1e-3)
    total = taken.report("sum")
    assert total.discontinuity * total.range_nats == pytest.approx(0.1, rel=1e-3)
    assert set(nothing[:1] + nothing[2:]) == {0.0}
    assert largest_jump([0.0, 1.0, 5.0]) == 4.0


def test_counts_go_by_the_share_of_the_range() -> None:
    """Two wells a thousand nats deep or a thousandth: the same counts."""
    for scale in (1e-3, 1.0, 1e3):
        taken = sample_slice(
            lambda x, scale=scale: {"wells": scale * ((x[:, 0] ** 2 - 1) ** 2 + 0.05 * x[:, 0])},
            line(),
            (-1.5, 1.5),
            201,
        )
        assert len(taken.minima("wells", 0.1).sample) == 2
        assert len(taken.minima("wells", 0.7).sample) == 1
        at = taken.offsets[taken.minima("wells").sample]
        np.testing.assert_allclose(at, [-1.0, 1.0], atol=0.03)


@pytest.mark.parametrize(
    ("interval", "num_samples"), [((0.0, 1.0), 2), ((1.0, 1.0), 9), ((0.0, math.nan), 9)]
)
def test_empty_slices_are_refused(interval: tuple[float, float], num_samples: int) -> None:
    with pytest.raises(ConfigurationError, match="first"):
        sample_slice(lambda x: {"a": x[:, 0]}, line(), interval, num_samples)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_state_keeps_its_dtype(dtype: torch.dtype) -> None:
    seen = []

    def terms(x: torch.Tensor) -> dict[str, torch.Tensor]:
        seen.append(x.dtype)
        return {"a": x.square().sum(-1)}

    centre = torch.zeros(3, dtype=dtype)
    for li in joint_lines("abc", centre, torch.eye(3, dtype=dtype)):
        sample_slice(terms, li, (-1.0, 1.0), 5)
    assert set(seen) == {dtype}
