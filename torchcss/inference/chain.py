"""States in a row, tied to their neighbours: the sum that smoothing minimises, and its descent.

`ChainSum` is `sum_t f_t(x_t)` plus the transitions of `torchcss.inference.smoothing`; at a state it
gives a `Chain`, the quadratic model of the whole, whose Hessian is block-banded
(`torchcss.inference.band`). `descend` is Newton's method on it, with limits and damping;
`marginals` are the covariances of the states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.errors import check_positive
from torchcss.inference.band import Band, least_in_box
from torchcss.linalg import mask_free, multiply, symmetric_part
from torchcss.types import (
    Bounds,
    Differentiable,
    LocalModel,
    Status,
    Times,
    Trajectory,
    Vector,
    frozen,
)

Changes = Mapping[int, Callable[[Tensor], Tensor]]
"""By the index of a frame, a differentiable map `[*batch n] -> [*batch n]` from the coordinates of
that frame to those of the next one. Frames that are not in it share the coordinates of the next."""

_MOST_DAMPING = 1e12
"""Multiple of a typical curvature; a step so short changes nothing."""
_ATTEMPTS = 60
"""At making a matrix definite by more and more damping, tenfold each time."""


@frozen
class Transition:
    """How a state moves between frames: standard deviations of its velocity and acceleration.

    Attributes:
        velocity: Units per second, one number or one per parameter; infinite: not judged. A body's
            `motion_rate` is one.
        acceleration: Change of velocity, units per second squared, likewise.
    """

    velocity: float | tuple[float, ...] = math.inf
    acceleration: float | tuple[float, ...] = math.inf

    def __post_init__(self) -> None:
        check_positive(self, "velocity", "acceleration")

    @property
    def judges_acceleration(self) -> bool:
        """Whether any parameter's acceleration is judged."""
        return bool(torch.as_tensor(self.acceleration).isfinite().any())

    def deviations(
        self, times: Times, n: int
    ) -> tuple[Float[Tensor, "steps n"], Float[Tensor, "changes n"]]:
        """Standard deviation of every motion, and of every change of motion, as terms count them.

        Args:
            times: Seconds.
            n: Number of parameters.

        Returns:
            For `x_t - x_t-1`, from t = 1; and for `x_t - x_t-1 - r (x_t-1 - x_t-2)` with r the
            ratio of the two time steps, from t = 2.
        """
        step = times.diff()[:, None]
        change = 0.5 * step[1:] * (step[1:] + step[:-1])
        velocity, acceleration = (
            torch.as_tensor(deviation, dtype=times.dtype, device=times.device).expand(n)
            for deviation in (self.velocity, self.acceleration)
        )
        return step * velocity, change * acceleration


class Chain(NamedTuple):
    """The quadratic model of the whole sum.

    Attributes:
        value: The sum.
        gradient: Its derivative.
        hessian: Of the frames' costs.
        motion: Second derivative of the transitions, in the layout of `Band.block`.
        frames: The frames' costs alone.
    """

    value: Float[Tensor, ""]
    gradient: Trajectory
    hessian: Float[Tensor, "t n n"]
    motion: Float[Tensor, "t w n n"]
    frames: LocalModel

    @property
    def is_finite(self) -> bool:
        """Whether the sum has a value and derivatives."""
        parts = (self.value, self.gradient, self.hessian)
        return all(bool(part.isfinite().all()) for part in parts)

    @property
    def band(self) -> Band:
        """Second derivative of the sum."""
        block = self.motion.clone()
        block[:, 0] += self.hessian
        return Band(block)

    def convex(self) -> Chain:
        """With the frames' negative curvatures turned round."""
        values, vectors = torch.linalg.eigh(self.hessian)
        return self._replace(hessian=(vectors * values.abs()[:, None, :]) @ vectors.mT)

    def curvature(self) -> float:
        """A typical curvature, never zero."""
        typical = float(torch.linalg.diagonal(self.band.block[:, 0]).abs().median())
        return typical if typical > 0 else 1.0


class ChainSum(NamedTuple):
    """What is minimised: weighted costs of the frames, and transitions.

    Attributes:
        cost: Costs of the frames.
        likelihood_power: Factor on them.
        times: Seconds.
        transition: What motion is to be expected.
        changes: Where coordinates change.
        dtype: Type in which the costs are evaluated.
    """

    cost: Differentiable
    likelihood_power: float
    times: Times
    transition: Transition
    changes: Changes
    dtype: torch.dtype

    def at(self, x: Trajectory) -> Chain:
        """The model of the sum at a state."""
        model = self.cost.local_model(x.to(self.dtype))
        frames = LocalModel(*(self.likelihood_power * part.detach().double() for part in model))
        return linked(frames, x, self.times, self.transition, self.changes)


def descend(
    sum_: ChainSum, x: Tensor, limits: Bounds, max_steps: int, tolerance: float
) -> tuple[Trajectory, Chain, Status, int]:
    """Newton's method on all frames at once.

    Args:
        sum_: The sum that is minimised.
        x: States to start from.
        limits: Box limits on the state of every frame.
        max_steps: Most evaluations after the first.
        tolerance: Promised decrease, nats, below which the descent has converged.

    Returns:
        The states, the model there, why it ended, and how many steps it took.
    """
    x = limits.project(x)
    chain, damping, steps = sum_.at(x), 0.0, 0
    if not chain.is_finite:
        return x, chain, Status.NON_FINITE, 0
    while True:
        step, used = _chain_step(chain, x, limits, damping)
        predicted = -float((step * (chain.gradient + 0.5 * chain.band.times(step))).sum())
        resolution = 4 * torch.finfo(sum_.dtype).eps * abs(float(chain.value))
        if predicted < tolerance and used == damping == 0.0:
            return x, chain, Status.CONVERGED, steps
        if predicted <= max(1e-3 * tolerance, resolution):
            return x, chain, Status.SMALL_STEP, steps
        if steps >= max_steps:
            return x, chain, Status.STEP_LIMIT, steps
        steps += 1
        # A sum may miss the bound that it is to reach by its rounding.
        candidate = torch.where(step <= limits.lower - x, limits.lower, x + step)
        candidate = torch.where(step >= limits.upper - x, limits.upper, candidate)
        other = sum_.at(limits.project(candidate))
        decrease = float(chain.value - other.value) if other.is_finite else -math.inf
        typical = chain.curvature()
        if decrease >= 0 and decrease > 1e-4 * predicted:
            x, chain = limits.project(candidate), other
            damping = 0.0 if damping < 1e-3 * typical else 0.2 * damping
            if decrease < 0.25 * predicted:
                damping = max(2 * used, 1e-3 * typical)
        else:
            damping = max(5 * used, 1e-2 * typical)
            if damping > _MOST_DAMPING * typical:
                return x, chain, Status.SMALL_STEP, steps


def marginals(
    chain: Chain, free: Bool[Tensor, "t n"], prior_variance: Vector
) -> Float[Tensor, "t n n"]:
    """Covariances of the states: diagonal blocks of the inverse Hessian on the free variables.

    Args:
        chain: The model at the minimum. A frame whose cost is not finite says nothing.
        free: Variables that no bound holds; the others get the prior's variance.
        prior_variance: Variance of each parameter before any image is seen.
    """
    finite = chain.hessian.isfinite().all(-1).all(-1)[:, None, None]
    chain = model = chain._replace(hessian=torch.where(finite, chain.hessian, 0.0))
    for attempt in range(_ATTEMPTS):
        weak = prior_variance.reciprocal() * 10.0 ** max(attempt - 1, 0)
        factor = model.band.plus_diagonal(weak).masked(free).factor()
        if factor is not None:
            break
        model = chain.convex()
    else:
        return torch.diag_embed(prior_variance.expand_as(chain.gradient))
    covariance = mask_free(factor.inverse_diagonal(), free)
    torch.linalg.diagonal(covariance).copy_(
        torch.where(free, torch.linalg.diagonal(covariance), prior_variance)
    )
    return covariance


def held_by(x: Tensor, gradient: Tensor, bounds: Bounds) -> Bool[Tensor, "t n"]:
    """Variables at a bound that the sum pushes against it, or without room between two."""
    return bounds.hold(x, gradient) | (bounds.lower == bounds.upper)


def linked(
    frames: LocalModel,
    x: Trajectory,
    times: Times,
    transition: Transition,
    changes: Changes,
) -> Chain:
    """The frames with the transitions between them, whose Hessian is Gauss-Newton's.

    Args:
        frames: Costs of the frames.
        x: State of every frame.
        times: Times of the frames, seconds.
        transition: How far states may move, and may change how they move.
        changes: Steps at which the coordinates of the state change, and how.
    """
    t, n = x.shape
    motion, turn = transition.deviations(times, n)
    eye = torch.eye(n, dtype=x.dtype, device=x.device)
    width = 1 + min(2 if transition.judges_acceleration else 1, t - 1)
    value, gradient, band = x.new_zeros(()), torch.zeros_like(x), x.new_zeros(t, width, n, n)
    # Where each frame lies in the coordinates of the next and of the next but one.
    ahead, slope = x.clone(), eye.repeat(t, 1, 1)
    for step, change in changes.items():
        if step < t - 1:
            ahead[step], slope[step] = with_slope(change, x[step])
    far, far_slope = ahead.clone(), slope.clone()
    for step, change in changes.items():
        if 1 <= step < t - 1:
            far[step - 1], turned = with_slope(change, ahead[step - 1])
            far_slope[step - 1] = turned @ slope[step - 1]

    def add(residual: Tensor, factors: list[Tensor]) -> None:
        """Half a squared residual; `factors[d]` is its derivative by the state d frames earlier."""
        nonlocal value
        first = t - len(residual)
        value = value + 0.5 * residual.square().sum()
        for d, factor in enumerate(factors):
            rows = slice(first - d, t - d)
            gradient[rows] += multiply(factor.mT, residual)
            for e in range(d, len(factors)):
                band[rows, e - d] += factor.mT @ factors[e]

    if t > 1:
        weight = motion.reciprocal()
        add(
            weight * (x[1:] - ahead[:-1]),
            [torch.diag_embed(weight), -weight[..., None] * slope[:-1]],
        )
    if t > 2 and transition.judges_acceleration:
        weight = turn.reciprocal()
        step = times.diff()
        ratio = (step[1:] / step[:-1])[:, None]
        add(
            weight * (x[2:] - (1 + ratio) * ahead[1:-1] + ratio * far[:-2]),
            [
                torch.diag_embed(weight),
                -(weight * (1 + ratio))[..., None] * slope[1:-1],
                (weight * ratio)[..., None] * far_slope[:-2],
            ],
        )
    gradient += frames.gradient
    return Chain(frames.value.sum() + value, gradient, symmetric_part(frames.hessian), band, frames)


def with_slope(
    change: Callable[[Tensor], Tensor], x: Float[Tensor, "*b n"]
) -> tuple[Float[Tensor, "*b n"], Float[Tensor, "*b n n"]]:
    """A change of coordinates and its derivative."""
    # The derivative in a step that all items share is that of every item in its own.
    slope = torch.autograd.functional.jacobian(
        lambda step: change(x + step), x.new_zeros(x.shape[-1])
    )
    assert isinstance(slope, Tensor)
    return change(x).detach(), slope


def _chain_step(
    chain: Chain, x: Tensor, limits: Bounds, damping: float
) -> tuple[Trajectory, float]:
    """The step to the least of the damped model in the box, and the damping that it took."""
    fixed, held = limits.lower == limits.upper, held_by(x, chain.gradient, limits)
    lower, upper = limits.lower - x, limits.upper - x
    trial, model = damping, chain
    for attempt in range(_ATTEMPTS):
        band = model.band.plus_diagonal(trial)
        # A definite model may take variables off their bounds; else those stay that are held.
        for kept in (fixed, held):
            if band.masked(~kept).factor() is not None:
                step = least_in_box(band, chain.gradient, lower, upper, kept)
                if step is not None:
                    return step, trial
        if attempt == 0:
            model = chain.convex()
        else:
            trial = max(10 * trial, 1e-12 * chain.curvature())
    # Every entry of the model would have to be beyond all bounds; there is no step to take.
    return torch.zeros_like(x), trial
