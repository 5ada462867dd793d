"""One-dimensional slices through a cost: how many minima, how continuous.

A cost of 30 parameters cannot be looked at; along a line it can (Fig. 4, 7 and 8 [IJRR]):

    f(c + t d),    t from -a to b

The lines worth a look go through a mode or the truth c, along single joints and along eigenvectors
d of the mode's covariance, where alternative minima are most likely (section 4.2 [IJRR]). A small
slice spans a few standard deviations of t on the line, `1 / sqrt(d^T Sigma^-1 d)`, so that an
honest covariance shows as a parabola that rises by half a squared deviation; a large one spans
what the joint limits admit.

**Minima.** A sample, or a run of equal ones, lower than both its neighbours, neither of them beyond
the end of the slice. Each has a *prominence*: how far one must climb to get from it to a lower
sample, on the easier side; an end of the slice ends the climb. The raw count has all of them. The
count that means something has those of a prominence above a stated share of the slice's range, so
that it depends neither on the units of the cost nor on ripples between samples.

**Jumps.** The largest difference between neighbouring samples over the range, at the stated density
and at twice that: a steep slope halves, a discontinuity stays. For certainty the steps that stand
out most from the steps beside them are then bisected, always into the half with the larger
difference; what is left of it when the step is thousands of times shorter is the discontinuity.

Call `joint_lines` or `eigen_lines`, then `sample_slice` on `Line.interval`, then
`Slice.report`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.linalg import squared_mahalanobis
from torchcss.types import Bounds, Vector, as_array

PROMINENCE = 0.02
"""Share of a slice's range above which a minimum counts."""

Terms = Callable[[Float[Tensor, "s n"]], Mapping[str, Float[Tensor, " s"]]]
"""Cost of every term by name, as `TrackingCost.terms` gives it."""

SampledCurve = Float[np.ndarray, " s"]
"""A number at every sample of a slice."""

_ROUNDING_NATS = 1e-6
"""A term whose range is below this is constant: what is left is rounding."""

_ROUNDING_SHARE = 1e-6
"""Components of a direction below this share of its largest one are rounding."""

_SUSPECTS = 4
"""Steps of every term that are bisected."""
_HALVINGS = 12
"""A bisected step ends 4096 times shorter, and with it the share that a slope has in its height."""


class StateLine(NamedTuple):
    """A straight line through the space of states.

    Attributes:
        name: A parameter's name, or "eigen 0" and so on, the least certain first.
        centre: The state at offset zero.
        direction: Change of the state per unit of offset.
        deviation: Standard deviation of the offset, given that the state is on the line.
    """

    name: str
    centre: Vector
    direction: Vector
    deviation: float

    def states(self, offsets: Float[ArrayLike, " s"]) -> Float[Tensor, "s n"]:
        """The states at some offsets."""
        steps = torch.as_tensor(np.asarray(offsets)).to(self.centre)
        return self.centre + steps[:, None] * self.direction

    def interval(self, bounds: Bounds, reach: float = math.inf) -> tuple[float, float]:
        """The offsets, at most `reach` from zero, between which the line keeps the bounds.

        Args:
            bounds: Box limits; the centre keeps them.
            reach: Largest distance from the centre.

        Raises:
            ConfigurationError: If neither a bound nor the reach ends the line.
        """
        lower, upper = (bound.to(self.centre) for bound in bounds)
        # Components that are rounding move nothing; at a bound they would end the line at once.
        moving = self.direction.abs() > _ROUNDING_SHARE * self.direction.abs().max()
        direction = self.direction[moving]
        ends = (torch.stack([lower, upper])[:, moving] - self.centre[moving]) / direction
        below = ends.amin(dim=0).clamp(max=0.0).max()
        above = ends.amax(dim=0).clamp(min=0.0).min()
        low, high = max(float(below), -reach), min(float(above), reach)
        if not math.isfinite(high - low):
            raise ConfigurationError(
                f"the line {self.name!r} meets no bound; say how far it goes with reach"
            )
        return low, high


def joint_lines(
    names: Sequence[str], centre: Vector, covariance: Float[Tensor, "n n"]
) -> list[StateLine]:
    """The lines along which one parameter moves and the others stay.

    Args:
        names: Names of the parameters.
        centre: The state that all lines go through.
        covariance: Covariance of the mode there.
    """
    axes = torch.eye(len(names), dtype=centre.dtype, device=centre.device)
    return [_line(name, centre, d, covariance) for name, d in zip(names, axes, strict=True)]


def eigen_lines(centre: Vector, covariance: Float[Tensor, "n n"]) -> list[StateLine]:
    """The lines along the eigenvectors of a covariance, the least certain first.

    Directions have unit length in the units of the state, metres and radians alike, and the sign
    that makes their largest component positive.

    Args:
        centre: The state that all lines go through.
        covariance: Covariance of the mode there.
    """
    vectors = torch.linalg.eigh(covariance).eigenvectors.mT.flip(0)
    largest = vectors.gather(1, vectors.abs().argmax(dim=1, keepdim=True))
    vectors = torch.where(largest < 0, -vectors, vectors)
    return [_line(f"eigen {i}", centre, d, covariance) for i, d in enumerate(vectors)]


def _line(name: str, centre: Tensor, direction: Tensor, covariance: Tensor) -> StateLine:
    # Of the offset given the line, that is with all other directions held: as a slice shows it.
    return StateLine(
        name, centre, direction, float(squared_mahalanobis(direction, covariance)) ** -0.5
    )


class Minima(NamedTuple):
    """Strict interior minima of a sampled curve, in its order.

    Attributes:
        sample: Index of each; the middle one of a run of equal samples.
        prominence: How far one must climb to leave it, in the unit of the curve.
    """

    sample: Int[np.ndarray, " m"]
    prominence: Float[np.ndarray, " m"]

    def above(self, prominence: float) -> Minima:
        """Those of at least this prominence, or of any prominence at all where that is zero."""
        kept = self.prominence >= prominence
        return Minima(self.sample[kept], self.prominence[kept])


def curve_minima(values: Float[ArrayLike, " s"]) -> Minima:
    """Find the minima of a sampled curve, as the module page defines them.

    Args:
        values: Samples, none of them NaN.

    Raises:
        ShapeError: If there is not exactly one axis, or a sample is NaN.
    """
    from scipy.signal import find_peaks  # takes a second to import

    curve = np.asarray(values, float)
    if curve.ndim != 1 or np.isnan(curve).any():
        raise ShapeError(f"values: expected one axis of numbers, got shape {list(curve.shape)}")
    sample, found = find_peaks(-curve, prominence=0.0)
    return Minima(sample, found["prominences"])


def largest_jump(values: Float[ArrayLike, " s"]) -> float:
    """Largest difference between neighbouring samples of a curve."""
    return float(np.abs(np.diff(np.asarray(values, float))).max())


class SliceReport(NamedTuple):
    """What one curve of a slice looks like.

    Attributes:
        range_nats: Greatest less least cost.
        lowest_at: Offset of the least cost.
        num_minima_raw: All strict interior minima.
        num_minima: Those above the stated prominence.
        largest_jump: Between neighbouring samples, as a share of the range.
        largest_jump_twice_density: The same with twice the samples.
        discontinuity: What bisection leaves of any jump, as a share of the range.
    """

    range_nats: float
    lowest_at: float
    num_minima_raw: int
    num_minima: int
    largest_jump: float
    largest_jump_twice_density: float
    discontinuity: float


class Slice(NamedTuple):
    """The terms of a cost along a line.

    Attributes:
        line: The line.
        offsets: Offsets of the samples, evenly spaced.
        values: Cost of every term by name, and their "sum", nats.
        fine_offsets: The same with a sample more between any two.
        fine_values: Cost there.
        discontinuity: See `SliceReport`, nats.
    """

    line: StateLine
    offsets: SampledCurve
    values: dict[str, SampledCurve]
    fine_offsets: Float[np.ndarray, " f"]
    fine_values: dict[str, Float[np.ndarray, " f"]]
    discontinuity: dict[str, float]

    def extent(self, name: str) -> float:
        """Range of one term, nats; 0 where it is rounding."""
        extent = float(np.ptp(self.values[name]))
        return extent if extent > _ROUNDING_NATS else 0.0

    def minima(self, name: str, prominence: float = PROMINENCE) -> Minima:
        """The minima of one term.

        Args:
            name: The term, or "sum".
            prominence: Least prominence as a share of the range; 0 for the raw count.
        """
        extent = self.extent(name)
        return curve_minima(self.values[name]).above(
            prominence * extent if extent > 0 else math.inf
        )

    def report(self, name: str, prominence: float = PROMINENCE) -> SliceReport:
        """Describe one term; arguments as for `minima`."""
        curve, extent = self.values[name], self.extent(name)

        def share(nats: float) -> float:
            return nats / extent if extent > 0 else 0.0

        return SliceReport(
            range_nats=extent,
            lowest_at=float(self.offsets[curve.argmin()]),
            num_minima_raw=len(self.minima(name, 0.0).sample),
            num_minima=len(self.minima(name, prominence).sample),
            largest_jump=share(largest_jump(curve)),
            largest_jump_twice_density=share(largest_jump(self.fine_values[name])),
            discontinuity=share(self.discontinuity[name]),
        )


def sample_slice(
    terms: Terms, line: StateLine, interval: tuple[float, float], num_samples: int = 401
) -> Slice:
    """Evaluate a cost along a line.

    Args:
        terms: The cost by terms.
        line: The line.
        interval: First and last offset.
        num_samples: Samples, both ends included.

    Raises:
        ConfigurationError: If there are fewer than three samples or the interval is empty.
    """
    low, high = interval
    if num_samples < 3 or not low < high:
        raise ConfigurationError(
            f"slice {line.name!r}: expected at least 3 samples on an interval of some length, got "
            f"{num_samples} on {low:g} to {high:g}"
        )

    def evaluate(offsets: SampledCurve) -> dict[str, SampledCurve]:
        costs = terms(line.states(offsets))
        curves = {name: as_array(cost) for name, cost in costs.items()}
        return {**curves, "sum": np.sum(list(curves.values()), axis=0)}

    fine_offsets = np.linspace(low, high, 2 * num_samples - 1)
    fine = evaluate(fine_offsets)
    coarse = {name: curve[::2] for name, curve in fine.items()}
    left = _bisected_jumps(evaluate, fine_offsets, fine)
    return Slice(line, fine_offsets[::2], coarse, fine_offsets, fine, left)


def _bisected_jumps(
    evaluate: Callable[[np.ndarray], dict[str, np.ndarray]],
    offsets: Float[np.ndarray, " f"],
    values: dict[str, np.ndarray],
) -> dict[str, float]:
    """Follow the suspicious steps of every curve into their steeper halves; what is left."""
    curves = np.stack(list(values.values()))
    curve = np.arange(len(curves))[:, None]
    # A slope goes on in the steps beside it, a discontinuity does not.
    steps = np.diff(curves, axis=1)
    around = np.pad(steps, ((0, 0), (1, 1)), mode="reflect")
    excess = np.abs(steps - 0.5 * (around[:, :-2] + around[:, 2:]))
    step = np.argsort(-excess, axis=1, kind="stable")[:, :_SUSPECTS]
    low, high = offsets[step], offsets[step + 1]
    at_low, at_high = curves[curve, step], curves[curve, step + 1]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        # All curves come back at all offsets; each one's own are taken.
        found = np.stack(list(evaluate(middle.ravel()).values()))
        at_middle = found.reshape(len(curves), *middle.shape)[curve[:, 0], curve[:, 0]]
        first = np.abs(at_middle - at_low) >= np.abs(at_high - at_middle)
        low, at_low = np.where(first, low, middle), np.where(first, at_low, at_middle)
        high, at_high = np.where(first, middle, high), np.where(first, at_middle, at_high)
    return dict(zip(values, np.abs(at_high - at_low).max(axis=1).tolist(), strict=True))
