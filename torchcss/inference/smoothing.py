"""One trajectory through a sequence of mixtures: the best path of modes, and its joint refinement.

A tracker decides frame by frame; once the sequence is over, later frames may tell which of the
modes of an earlier one was right, and a motion that is possible tells where in a mode it went.

Of a path that takes mode k_t in frame t, the energy is

    sum_t  cost_t(k_t)  -  sum_t log N(x_t - x_t-1; 0, Q_t + Sigma_t-1 + Sigma_t)

`best_path` finds the path of least energy, by dynamic programming (Viterbi 1967). `mode_weights`
sums `exp(-power * energy)` over all paths through a mode, by the forward-backward algorithm (Baum
et al. 1970): how probable the mode is when all frames are known. What the frames do not show, the
best path decides by small differences of many frames; the sum over paths does not.

`refine` then moves states of all frames together, to the least of

    sum_t  f_t(x_t)  +  1/2 sum_t |(x_t - x_t-1) / (v d_t)|^2
                     +  1/2 sum_t |(x_t - x_t-1 - (d_t / d_t-1) (x_t-1 - x_t-2)) / (a e_t)|^2

within the joint limits, where f_t is any cost of frame t, `d_t` the time since the frame before and
`e_t = d_t (d_t + d_t-1) / 2`. With Gaussian modes as costs (`GaussianEvidence`) this is the fixed
interval smoother of Rauch, Tung and Striebel (1965) under limits; with the costs of the images it
is the joint fit of the whole window. The Hessian is block-banded (three blocks wide with velocity
alone, five with acceleration), so that a Newton step takes time linear in the number of frames, and
so do the covariances, the diagonal blocks of its inverse.

Both terms are deviations per frame and not densities of a Wiener process: errors of images persist
over frames, so that more frames per second are not more evidence, and with terms that scale in the
same way the smoothing of a motion does not depend on the frame rate. For the same reason a cost
counts less than its nats when frames are weighed against each other: `likelihood_power`, as
`Tracker.likelihood_power` does while tracking.

Where the coordinates of the state change between frames (a body is hung on another base),
`changes` maps them: a step t that is in it takes states of frame t into the coordinates of frame
t + 1. Everything is computed in float64 and returned in the type that came in.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.errors import ConfigurationError, ShapeError, check_positive, check_range, check_shape
from torchcss.inference.chain import (
    Chain,
    ChainSum,
    Changes,
    Transition,
    descend,
    held_by,
    linked,
    marginals,
    with_slope,
)
from torchcss.inference.trust_region import default_prior_variance
from torchcss.linalg import multiply, solve_lower, symmetric_part, whitener, with_least_width
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


class Path(NamedTuple):
    """What `best_path` chose.

    Attributes:
        mode: One mode per frame.
        cost: Least of the sum, nats, a scalar.
    """

    mode: Int[Tensor, " t"]
    cost: Float[Tensor, ""]


class Refined(NamedTuple):
    """What `refine` found.

    Attributes:
        mean: The states, within the bounds.
        covariance: Of each state, all frames known: diagonal blocks of the inverse Hessian.
        cost: Cost of each frame at its state, without the transitions, nats.
        total: What was minimised, transitions included, a scalar.
        active: True where a variable ended at a bound that holds it.
        status: A `Status`, a scalar.
        num_steps: Iterations, a scalar.
    """

    mean: Trajectory
    covariance: Float[Tensor, "t n n"]
    cost: Float[Tensor, " t"]
    total: Float[Tensor, ""]
    active: Bool[Tensor, "t n"]
    status: Int[Tensor, ""]
    num_steps: Int[Tensor, ""]


_KNOWN = 1e-6
"""Deviation of what a mode knows exactly, a parameter that a bound holds, as evidence."""


class GaussianEvidence(NamedTuple):
    """Frames of which each says `1/2 (x - mean)^T precision (x - mean)`; a `Differentiable`.

    Attributes:
        mean: What each frame says that the state is.
        precision: Inverse covariance; zero for a frame that says nothing.
    """

    mean: Trajectory
    precision: Float[Tensor, "t n n"]

    @staticmethod
    def of_modes(
        mean: Trajectory,
        covariance: Float[Tensor, "t n n"],
        *,
        seen: Bool[Tensor, " t"] | None = None,
    ) -> GaussianEvidence:
        """From modes; covariances may be singular, see `torchcss.linalg`.

        Args:
            mean: The modes.
            covariance: Their covariances.
            seen: False for a frame without evidence.
        """
        white = whitener(with_least_width(covariance.double(), _KNOWN))
        precision = symmetric_part(white.mT @ white)
        if seen is not None:
            precision = torch.where(seen[:, None, None], precision, 0.0)
        return GaussianEvidence(mean.double(), precision)

    def local_model(self, x: Trajectory) -> LocalModel:
        """Cost, gradient and Hessian of every frame."""
        apart = x - self.mean
        pull = multiply(self.precision, apart)
        return LocalModel(0.5 * (apart * pull).sum(-1), pull, self.precision)


def best_path(
    mean: Float[Tensor, "t k n"],
    covariance: Float[Tensor, "t k n n"] | None,
    cost: Float[Tensor, "t k"],
    times: Times,
    transition: Transition,
    *,
    changes: Changes | None = None,
    period: Vector | None = None,
) -> Path:
    """Choose the mode of every frame, all frames considered.

    Args:
        mean: The modes of every frame; those of infinite cost may hold anything finite.
        covariance: Their covariances, which widen the transition; None: modes are points.
        cost: Negative logarithm of each mode's likelihood (or weight), nats; `inf`: no such mode.
            A frame without any is passed over: all its modes cost the same.
        times: Seconds, increasing; gaps make steps longer.
        transition: What velocities are to be expected; accelerations are for `refine`.
        changes: Where coordinates change, see the module's page.
        period: Period of each parameter, infinite for most: differences are taken the short way.

    Returns:
        The path and its cost. Of equally good paths that of the lower indices, from the end on.

    Raises:
        ShapeError: If the shapes do not agree, or a mode of finite cost is not finite.
        ConfigurationError: If the times do not increase, or the transition judges accelerations.
    """
    return _viterbi(*_energies(mean, covariance, cost, times, transition, changes, period))


def mode_weights(
    mean: Float[Tensor, "t k n"],
    covariance: Float[Tensor, "t k n n"] | None,
    cost: Float[Tensor, "t k"],
    times: Times,
    transition: Transition,
    *,
    power: float = 1.0,
    changes: Changes | None = None,
    period: Vector | None = None,
) -> Float[Tensor, "t k"]:
    """How probable each mode of every frame is, all frames considered.

    Args:
        mean: As `best_path`, like all that follow but for the power.
        covariance: Their covariances.
        cost: Negative logarithm of each mode's likelihood.
        times: Seconds, increasing.
        transition: What velocities are to be expected.
        power: Power of the energy of a path, in (0, 1] as a rule: how much of what frames and
            motions say is new in each of them.
        changes: Where coordinates change.
        period: Period of each parameter.

    Returns:
        Logarithms of the weights, which sum to one in every frame; `-inf`: no such mode.

    Raises:
        ShapeError: As `best_path`.
        ConfigurationError: As `best_path`, or if the power is not positive.
    """
    if not power > 0:
        raise ConfigurationError(f"mode_weights: expected a positive power, got {power}")
    node, edges = _energies(mean, covariance, cost, times, transition, changes, period)
    own, steps = -power * node, [-power * edge for edge in edges]
    before, after = [own[0]], [torch.zeros_like(own[-1])]
    for step, here in zip(steps, own[1:], strict=True):
        before.append((before[-1][:, None] + step).logsumexp(0) + here)
    for step, there in zip(reversed(steps), reversed(list(own[1:])), strict=True):
        after.append((step + there + after[-1]).logsumexp(1))
    return (torch.stack(before) + torch.stack(after[::-1])).log_softmax(1).to(mean)


def _energies(
    mean: Tensor,
    covariance: Tensor | None,
    cost: Tensor,
    times: Tensor,
    transition: Transition,
    changes: Changes | None,
    period: Vector | None,
) -> tuple[Float[Tensor, "t k"], list[Float[Tensor, "k k"]]]:
    """What each mode costs a path, and each step from a mode to one of the next frame."""
    if transition.judges_acceleration:
        raise ConfigurationError("transition: it judges velocities alone; leave accelerations out")
    state, spread, node = _checked_modes(mean, covariance, cost)
    motion, _ = transition.deviations(_checked_times(times, len(state)), state.shape[-1])
    edges = []
    for step, deviation in enumerate(motion):
        own = None if spread is None else spread[step]
        before, wide = _carried(state[step], own, step, changes)
        apart = state[step + 1][None] - before[:, None]
        if period is not None:
            apart = apart - whole_periods(apart, period)
        if spread is not None and wide is not None:
            wide = wide[:, None] + spread[step + 1][None]
        edges.append(_gaussian_cost(apart, deviation, wide))
    return node, edges


def _checked_modes(
    mean: Tensor, covariance: Tensor | None, cost: Tensor
) -> tuple[Float[Tensor, "t k n"], Float[Tensor, "t k n n"] | None, Float[Tensor, "t k"]]:
    """Means, covariances and what each mode costs the path, in float64."""
    check_shape("mean", mean, None, None, None)
    t, k, n = mean.shape
    check_shape("cost", cost, t, k)
    if covariance is not None:
        check_shape("covariance", covariance, t, k, n, n)
    if bool(cost.isnan().any()):
        raise ShapeError("cost: holds NaN; expected numbers, inf for a missing mode")
    present, finite = cost.isfinite(), mean.isfinite().all(-1)
    if covariance is not None:
        finite = finite & covariance.isfinite().flatten(-2).all(-1)
    if not bool(finite[present].all()):
        raise ShapeError("mean, covariance: expected finite numbers of the modes")
    node = torch.where(present.any(1, keepdim=True), cost.double(), 0.0)
    return mean.double(), None if covariance is None else covariance.double(), node


@frozen
class Refinement:
    """How all frames descend together.

    Attributes:
        likelihood_power: Factor on the costs.
        max_steps: Iterations, each one evaluation of all frames.
        tolerance: Expected decrease of the sum, nats, below which it is done.
    """

    likelihood_power: float = 1.0
    max_steps: int = 50
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        check_positive(self, "likelihood_power", finite=True)
        check_range(self, "max_steps", "tolerance")


TO_CONVERGENCE = Refinement()
"""For all frames at once."""

IN_WINDOWS = Refinement(max_steps=15, tolerance=0.05)
"""For a window of frames, which those after it will move again."""


@frozen
class Windows:
    """How many frames are moved together.

    Attributes:
        window: Frames of a window.
        overlap: Frames of a window that the next one moves again.
    """

    window: int = 9
    overlap: int = 4

    def __post_init__(self) -> None:
        if not 0 <= self.overlap < self.window:
            raise ConfigurationError(
                f"Windows: expected a window longer than its overlap, got {self.window} and "
                f"{self.overlap}"
            )


WINDOWS = Windows()


def refine(
    cost: Differentiable,
    start: Trajectory,
    times: Times,
    transition: Transition,
    bounds: Bounds,
    *,
    choice: Refinement = TO_CONVERGENCE,
    changes: Changes | None = None,
) -> Refined:
    """Move the states of all frames together to where costs and transitions are least.

    Newton's method on all frames at once, with the bounds held exactly in every step and damping
    (eq. 13 [IJRR]) where a step fails. Frames whose Hessian spoils the definiteness of the whole
    count with the absolute values of its curvatures.

    Args:
        cost: Costs of the frames: item t of its batch is frame t.
        start: Where to start; moved into the bounds.
        times: Seconds, increasing.
        transition: What motion is to be expected.
        bounds: Box limits, of shape `[n]` or, where they differ by frame, `[t n]`. Equal bounds
            hold a variable where it is.
        choice: How to descend.
        changes: Where coordinates change, see the module's page. Their curvature is neglected in
            the Hessian and nowhere else.

    Returns:
        States, covariances, costs. The sum is never above that of the start.

    Raises:
        ShapeError: If the shapes do not agree, or the start is not finite.
        ConfigurationError: If times do not increase, or a lower bound exceeds the upper one.
    """
    x, times, limits = _checked(start, times, bounds)
    power = choice.likelihood_power
    sum_ = ChainSum(cost, power, times, transition, changes or {}, start.dtype)
    ended = descend(sum_, x, limits, choice.max_steps, choice.tolerance)
    return _refined(*ended, limits, choice, start)


def refine_in_windows(
    costs: Iterable[Differentiable],
    start: Trajectory,
    times: Times,
    transition: Transition,
    bounds: Bounds,
    *,
    choice: Refinement = IN_WINDOWS,
    windows: Windows = WINDOWS,
    changes: Changes | None = None,
) -> Refined:
    """`refine` a window of frames at a time, for costs that are dear to keep.

    Windows overlap, so that each frame is moved with frames after it in view. What is outside a
    window stays where it is at the time and holds the window by the transitions: the windows
    descend on the same sum as `refine`, and none raises it. Only the covariances consider all
    frames at once: each frame's Hessian is kept from the last time it was moved.

    Args:
        costs: The cost of every frame in their order, each for states `[b n]`. They are asked for
            when their window begins, and let go when it is done.
        start: Where to start; moved into the bounds.
        times: Seconds, increasing.
        transition: What motion is to be expected.
        bounds: Box limits, of shape `[n]` or `[t n]`.
        choice: How to descend in each window.
        windows: How many frames are moved together.
        changes: Where coordinates change.

    Returns:
        As `refine`; the status is the least good of the windows', the steps are all of theirs.

    Raises:
        ShapeError: As `refine`.
        ConfigurationError: As `refine`, or if there are fewer costs than frames.
    """
    x, times, limits = _checked(start, times, bounds)
    t, changes = len(x), changes or {}
    queue = iter(costs)
    held: dict[int, Differentiable] = {}
    models: list[LocalModel] = []
    worst, steps, first = Status.CONVERGED, 0, 0
    while len(models) < t:
        last = min(first + windows.window, t)
        _ask_for(queue, held, range(max([*held, first - 1]) + 1, last), t)
        # The neighbours that transitions reach stay where they are.
        before, after = max(first - 2, 0), min(last + 2, t)
        near = range(before, after)
        moves = torch.tensor([first <= frame < last for frame in near], device=x.device)[:, None]
        part = x[before:after]
        box = Bounds(
            torch.where(moves, limits.lower[before:after], part),
            torch.where(moves, limits.upper[before:after], part),
        )
        here = {step - before: change for step, change in changes.items() if step in near}
        costs_here = _FrameByFrame([held.get(frame) for frame in near])
        part, chain, status, taken = descend(
            ChainSum(
                costs_here, choice.likelihood_power, times[before:after], transition, here,
                start.dtype,
            ),
            part, box, choice.max_steps, choice.tolerance,
        )  # fmt: skip
        del costs_here  # Nothing keeps the costs of a window but `held`.
        x[before:after] = part
        worst, steps = max(worst, status), steps + taken
        done = t if last == t else last - windows.overlap
        for frame in range(len(models), done):
            models.append(LocalModel(*(entry[frame - before] for entry in chain.frames)))
            del held[frame]
        first = done
    frames = LocalModel(*(torch.stack(entries) for entries in zip(*models, strict=True)))
    chain = linked(frames, x, times, transition, changes)
    return _refined(x, chain, worst, steps, limits, choice, start)


def _ask_for(
    queue: Iterator[Differentiable], held: dict[int, Differentiable], frames: range, of: int
) -> None:
    """Hold the costs of the next frames too."""
    for frame in frames:
        cost = next(queue, None)
        if cost is None:
            raise ConfigurationError(
                f"refine_in_windows: expected a cost for each of {of} frames, got {frame}"
            )
        held[frame] = cost


# --- best path -----------------------------------------------------------------------------------


def _carried(
    state: Tensor, spread: Tensor | None, step: int, changes: Changes | None
) -> tuple[Tensor, Tensor | None]:
    """States of a frame and their covariances in the coordinates of the next."""
    if not changes or step not in changes:
        return state, spread
    moved, slope = with_slope(changes[step], state)
    return moved, None if spread is None else slope @ spread @ slope.mT


def whole_periods(apart: Float[Tensor, "*b n"], period: Vector) -> Float[Tensor, "*b n"]:
    """What differences have to lose to be at most half a period long.

    Args:
        apart: The differences.
        period: Period of each parameter, infinite for those that have none.
    """
    finite = torch.where(period.isfinite(), period, 1.0).to(apart)
    return torch.where(period.isfinite(), finite * (apart / finite).round(), 0.0)


def _gaussian_cost(
    apart: Float[Tensor, "*b n"], deviation: Vector, wide: Tensor | None
) -> Float[Tensor, "*b"]:
    """Negative log density of differences under the motion and the modes' own covariances.

    In units of the motion's deviations, and without the constants that all paths share. Parameters
    that are not judged are left out.
    """
    judged = deviation.isfinite()
    z = apart[..., judged] / deviation[judged]
    if wide is None:
        return 0.5 * z.square().sum(-1)
    units = torch.outer(deviation[judged], deviation[judged])
    matrix = wide[..., judged, :][..., judged] / units
    torch.linalg.diagonal(matrix).add_(1.0)
    factor = torch.linalg.cholesky(symmetric_part(matrix))
    white = solve_lower(factor, z)
    return 0.5 * white.square().sum(-1) + torch.linalg.diagonal(factor).log().sum(-1)


def _viterbi(node: Float[Tensor, "t k"], edges: list[Tensor]) -> Path:
    """Least sum of nodes and edges, by dynamic programming."""
    best, back = node[0], []
    for edge, own in zip(edges, node[1:], strict=True):
        reached, came_from = (best[:, None] + edge).min(0)
        back.append(came_from)
        best = reached + own
    mode = [int(best.argmin())]
    for came_from in reversed(back):
        mode.append(int(came_from[mode[-1]]))
    return Path(torch.tensor(mode[::-1], device=node.device), best.min())


# --- refinement ----------------------------------------------------------------------------------


class _FrameByFrame(NamedTuple):
    """The costs of single frames as the cost of all of them; None costs nothing."""

    costs: list[Differentiable | None]

    def local_model(self, x: Trajectory) -> LocalModel:
        """Cost, gradient and Hessian of every frame."""
        models = [
            LocalModel(
                own.new_zeros(1), own.new_zeros(1, len(own)), own.new_zeros(1, len(own), len(own))
            )
            if cost is None
            else cost.local_model(own[None])
            for cost, own in zip(self.costs, x, strict=True)
        ]
        return LocalModel(*(torch.cat(parts) for parts in zip(*models, strict=True)))


def _refined(
    x: Trajectory,
    chain: Chain,
    status: Status,
    steps: int,
    limits: Bounds,
    choice: Refinement,
    like: Tensor,
) -> Refined:
    """The result, in the type that came in."""
    # Of variables that a bound holds (decision: active bounds), and a weak prior on the others in
    # the covariances, not in the means. The box is the one that holds those of all frames: a frame
    # that is held says nothing of the others.
    prior_variance = default_prior_variance(Bounds(limits.lower.amin(0), limits.upper.amax(0)))
    active = held_by(x, chain.gradient, limits)
    return Refined(
        mean=x.to(like),
        covariance=marginals(chain, ~active, prior_variance.double()).to(like),
        cost=(chain.frames.value / choice.likelihood_power).to(like),
        total=chain.value.to(like),
        active=active,
        status=torch.tensor(int(status)),
        num_steps=torch.tensor(steps),
    )


def _checked_times(times: Tensor, t: int) -> Times:
    check_shape("times", times, t)
    if t == 0:
        raise ShapeError("smoothing: expected at least one frame, got none")
    seconds = times.double()
    if not bool((seconds.diff() > 0).all()) or not bool(seconds.isfinite().all()):
        raise ConfigurationError("smoothing: expected times that increase from frame to frame")
    return seconds


def _checked(start: Tensor, times: Tensor, bounds: Bounds) -> tuple[Trajectory, Times, Bounds]:
    """The start within the bounds, times and bounds of every frame, in float64."""
    check_shape("start", start, None, None)
    t, n = start.shape
    times = _checked_times(times, t)
    for name, vector in zip(("lower", "upper"), bounds, strict=True):
        if vector.shape not in ((n,), (t, n)):
            raise ShapeError(
                f"bounds.{name}: expected shape [{n}] or [{t}, {n}], got {list(vector.shape)}"
            )
    if not bool((bounds.lower <= bounds.upper).all()):
        raise ConfigurationError("bounds: expected lower <= upper; correct the limits")
    if not bool(start.isfinite().all()):
        raise ShapeError("refine: expected a finite start")
    limits = Bounds(bounds.lower.double().expand(t, n), bounds.upper.double().expand(t, n))
    return limits.project(start.detach().double()), times, limits
