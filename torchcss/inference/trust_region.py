"""Batched, bound-constrained trust-region Newton descent: section 4.1 of [IJRR].

From each start the search solves, per item, the damped Newton system of eq. 13 [IJRR] (eq. 11 [RR])

    (H + lambda W) dx = -g      with  lower <= x + dx <= upper

with the exact, usually indefinite Hessian. `W = diag(1 / scale^2)`, so that lengths are counted in
units of `scale`. `lambda` is the multiplier of a trust region: the least damping, found by a few
Cholesky factorisations on the secular equation (Moré and Sorensen 1983), for which `H + lambda W`
is positive definite and the step is no longer than a radius; the radius follows the ratio of
actual to predicted decrease. A factorisation is some ten times cheaper than an evaluation of an
image cost, so that a well-chosen step is worth several of them. Where the gradient does not
show the way down (at a saddle), the step goes along the direction of negative curvature, which two
inverse iterations with the last factor give; there are no eigenvectors inside the iterations.

Hard bounds are handled by an active set. A variable at a bound whose gradient points outwards is
fixed; the step is computed on the free ones; whatever would cross a bound is pinned to it (or let
go again) and the others are solved again. The candidate is accepted on the true cost, with the
decrease predicted for the step that was actually taken. Each iteration evaluates `cost.local_model`
once, at the candidate: its value decides on acceptance, its derivatives are kept if accepted.

No item of a batch influences another: radius, damping, acceptance and `Status` are per item, and
`minimise` drops items as they finish, and restricts the cost to those that are left. On a CPU
all but the evaluation is one compiled call (`torchcss.inference.planning`), and what stands here in
torch is its plain twin; a GPU and a machine without numba take that.

An item stops as

* `CONVERGED` when the undamped Newton step, on a positive definite model, promises less than
  `tolerance` nats: half the squared Newton decrement, in which the units of the state cancel;
* `SMALL_STEP` when a damped step promised less than `tolerance` and fell so far short of that that
  the trust radius shrinks, or when the promise is below the rounding of the cost. A cost that jumps
  or has kinks (matches and what is hidden are found fresh at each state) ends here; a short step
  that does as it promised, along a curved valley, is no reason to stop;
* `STEP_LIMIT`, or `NON_FINITE` if the cost is not finite at the start; that item is returned as it
  came.

Call `TrustRegionNewton().minimise(cost, x0, bounds)`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.errors import (
    ConfigurationError,
    ShapeError,
    check_floating,
    check_positive,
    check_shape,
)
from torchcss.kernels import compiler
from torchcss.kernels.checked import run
from torchcss.linalg import (
    cholesky_apply,
    damped_cholesky,
    inverse_on_free,
    solve_lower,
    wall,
)
from torchcss.types import (
    BlendedCost,
    Bounds,
    CostFunction,
    Items,
    LocalModel,
    Matrices,
    Modes,
    Numbers,
    Status,
    Vector,
    Vectors,
    frozen,
)

LEAST_RATIO = 1e-4
"""Share of the predicted decrease below which a step is not worth taking."""
PLEASANT = 0.25
"""Weight of the prediction's error where the cost falls by more than was predicted."""
GOOD_ERROR = 0.25
"""Relative error of the predicted decrease at which the radius stays, see `_next_radius`."""


class TrustRegionState(NamedTuple):
    """Where every item stands, and the step that it will try next.

    Attributes:
        x: Current states, admissible.
        model: Cost and derivatives there; the cost of an item not evaluated yet is `inf`.
        share: Which share of the second-order parts the model's Hessian contains; 1 is exact.
        radius: Trust radius, in units of `scale`.
        damping: `lambda` of eq. 13 for the coming step.
        step: The coming step; it stays inside the bounds.
        predicted: Decrease that the quadratic model predicts for it, nats; zero where the next
            evaluation is to be at `x` itself.
        status: A `Status` per item.
        num_steps: Iterations taken.
    """

    x: Vectors
    model: LocalModel
    share: Numbers
    radius: Numbers
    damping: Numbers
    step: Vectors
    predicted: Numbers
    status: Int[Tensor, " b"]
    num_steps: Int[Tensor, " b"]

    def take(self, items: Items) -> TrustRegionState:
        """Some of the items, as a copy."""
        return TrustRegionState.of([field.index_select(0, items) for field in self.tensors])

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors, those of the model in their place."""
        return (self.x, *self.model, *self[2:])

    @staticmethod
    def of(tensors: Sequence[Tensor]) -> TrustRegionState:
        """The state of such tensors."""
        return TrustRegionState(tensors[0], LocalModel(*tensors[1:4]), *tensors[4:])


class TrustRegionInfo(NamedTuple):
    """What one iteration did.

    Attributes:
        accepted: Whether the candidate replaced the state.
        decrease: Actual decrease of the cost at the candidate, nats; `-inf` if not finite there.
    """

    accepted: Bool[Tensor, " b"]
    decrease: Numbers


class _Trial(NamedTuple):
    """Where every item was evaluated, and what the cost is there.

    Attributes:
        x: The states, admissible.
        model: Cost and derivatives.
        share: Which share of the second-order parts the Hessians contain.
    """

    x: Vectors
    model: LocalModel
    share: Numbers


_PINNING_ROUNDS = 12
"""Solves that may be spent on finding which bounds a step ends at."""
FLAT = 1e-9
"""Share of the trust radius below which a damped step counts as none: the slope is zero."""
_FAST, _SLOW = 0.02, 0.005
"""Share of the cost that a step must promise to remove for Gauss-Newton to be the better model, and
below which the exact one is."""
_POOL_SIZE = 1024
"""Items worked on at a time on a CPU."""
_FACTOR_CHUNK = 128
"""Matrices factored at a time: they and their factors stay in the caches."""


@frozen
class TrustRegionNewton:
    """Second-order descent from many starts at once, eq. 13 [IJRR].

    Attributes:
        max_steps: Iterations per item, each one evaluation of the cost. The papers give no number;
            at the default 34-parameter bodies converge from almost every sample.
        tolerance: Expected decrease, in nats, below which an item is done. At the default the
            quadratic model puts the minimum a thousandth of a standard deviation away; in a valley
            that curves within that length, the true decrease left is a few times more. With 1e-3
            there are fewer steps, and more modes that look distinct but are not.
        initial_radius: First trust radius in units of `scale`; the default is a radian.
        factorisations: Cholesky factorisations that may be spent on the damping of one step; two
            to four are taken as a rule.
        pool_size: Items worked on at a time; by default 1024 on a CPU and all on other devices.
    """

    max_steps: int = 100
    tolerance: float = 1e-6
    initial_radius: float = 1.0
    factorisations: int = 8
    pool_size: int | None = None

    def __post_init__(self) -> None:
        check_positive(
            self,
            *("max_steps", "tolerance", "initial_radius", "factorisations", "pool_size"),
            hint="; leave it out for the default",
        )

    def start(self, x0: Vectors) -> TrustRegionState:
        """Items that wait for their first evaluation, which is not counted as a step."""
        b, n = x0.shape
        zero = x0.new_zeros(b)
        return TrustRegionState(
            x=x0.detach().clone(),
            model=LocalModel(zero + torch.inf, x0.new_zeros(b, n), x0.new_zeros(b, n, n)),
            share=zero,
            radius=zero + self.initial_radius,
            damping=zero,
            step=x0.new_zeros(b, n),
            predicted=zero,
            status=torch.full_like(zero, int(Status.RUNNING), dtype=torch.long),
            num_steps=torch.full_like(zero, -1, dtype=torch.long),
        )

    def step(
        self,
        cost: CostFunction,
        state: TrustRegionState,
        bounds: Bounds,
        *,
        scale: Vector | None = None,
    ) -> tuple[TrustRegionState, TrustRegionInfo]:
        """Evaluate the planned steps once, keep those that lower the cost, and plan the next.

        Args:
            cost: What is minimised, one item per row of the state.
            state: From `start` or the step before. Items that are not `RUNNING` stay as they are.
            bounds: Box limits on the state.
            scale: Positive length of each parameter that the trust region counts as one; ones by
                default, which suits radians and metres.

        Returns:
            The next state, and what became of the steps. Of an item that is not finite at the
            start, the state has `Status.NON_FINITE` and the start as given.
        """
        items = torch.arange(len(state.status), device=state.x.device)
        after = state.take(items)
        info = _Pool(self, cost, after, bounds, scale).step(cost, items)
        return after, info

    def _advance(
        self, state: TrustRegionState, trial: _Trial, bounds: Bounds, weight: Vector, reach: float
    ) -> tuple[TrustRegionState, TrustRegionInfo]:
        """Keep the trials that lower the cost, and plan steps no longer than a reach."""
        candidate, model, share = trial
        running, value = state.status == Status.RUNNING, state.model.value
        finite = _is_finite(model) & candidate.isfinite().all(-1)
        decrease = torch.where(finite, value - model.value, -torch.inf)
        stays = state.predicted == 0
        ratio = decrease / torch.where(stays, 1.0, state.predicted)
        accepted = running & finite & (stays | ((decrease >= 0) & (ratio > LEAST_RATIO)))
        length = _norm(state.step, weight)
        radius = _next_radius(state.radius, length, ratio, accepted).clamp(max=reach)
        unusable = running & value.isinf() & ~accepted
        fell_short = ~stays & (~accepted | (radius < length)) & (state.predicted < self.tolerance)
        state = TrustRegionState(
            x=torch.where(accepted[:, None], candidate, state.x),
            model=LocalModel(
                torch.where(accepted, model.value, value),
                torch.where(accepted[:, None], model.gradient, state.model.gradient),
                torch.where(accepted[:, None, None], model.hessian, state.model.hessian),
            ),
            share=torch.where(accepted, share, state.share),
            radius=torch.where(running & ~stays, radius, state.radius),
            damping=state.damping * _change_of_damping(state, model, accepted, weight),
            step=state.step,
            predicted=state.predicted,
            status=torch.where(unusable, int(Status.NON_FINITE), state.status),
            num_steps=state.num_steps + running,
        )
        state = self._plan(state, bounds, weight, fell_short)
        spent = (state.status == Status.RUNNING) & (state.num_steps >= self.max_steps)
        status = torch.where(spent, int(Status.STEP_LIMIT), state.status)
        return state._replace(status=status), TrustRegionInfo(accepted, decrease)

    def minimise(
        self,
        cost: CostFunction,
        x0: Vectors,
        bounds: Bounds,
        *,
        scale: Vector | None = None,
        prior_variance: Vector | None = None,
    ) -> Modes:
        """Descend from every start until it stops, and return the modes with their covariances.

        Args:
            cost: What to minimise. It is called with one leading dimension, the batch flattened,
                and restricted to the items still running.
            x0: Starts; those outside the bounds are projected onto them first.
            bounds: Box limits; they hold exactly, in the dtype of `x0`.
            scale: See `step`.
            prior_variance: Variance of each parameter before the image is seen; no direction of a
                covariance exceeds it. By default `default_prior_variance(bounds)`.

        Returns:
            One mode per start; no cost exceeds that of the (projected) start.

        Raises:
            ShapeError: If the shapes of `x0`, `bounds`, `scale` and `prior_variance` do not agree,
                `x0` is neither float32 nor float64, or the cost answers in other shapes.
            ConfigurationError: If a lower bound exceeds the upper one, or `scale` or
                `prior_variance` is not positive.
        """
        check_shape("x0", x0, None)
        check_floating("x0", x0)
        batch, n = x0.shape[:-1], x0.shape[-1]
        check_bounds(bounds, n)
        for name, vector in (("scale", scale), ("prior_variance", prior_variance)):
            if vector is not None:
                _check_vector(name, vector, n)
                if not bool((vector > 0).all()):
                    raise ConfigurationError(
                        f"{name}: expected positive numbers, got {vector.tolist()}"
                    )
        starts = self.start(x0.reshape(batch.numel(), n))
        result = self.descend(cost, starts, bounds, scale=scale)
        modes = self.modes(result, bounds, prior_variance=prior_variance)
        return Modes(*(field.reshape(batch + field.shape[1:]) for field in modes))

    def ends(self, cost: CostFunction, x0: Vectors, bounds: Bounds) -> Vectors:
        """Where descents end, as `minimise` finds it, without the covariances there.

        Args:
            cost: What to minimise, one item per start.
            x0: Starts; those outside the bounds are projected onto them first.
            bounds: Box limits.
        """
        return self.descend(cost, self.start(x0), bounds).x

    def descend(
        self,
        cost: CostFunction,
        state: TrustRegionState,
        bounds: Bounds,
        *,
        scale: Vector | None = None,
    ) -> TrustRegionState:
        """Go on from a state until every item stops.

        Args:
            cost: What is minimised, one item per row of the state; see `minimise`.
            state: From `start`, `step` or a descent before; it stays as it is. What stopped at a
                lower step limit goes on.
            bounds: Box limits on the state.
            scale: See `step`.
        """
        limited = (state.status == Status.STEP_LIMIT) & (state.num_steps < self.max_steps)
        status = torch.where(limited, int(Status.RUNNING), state.status)
        result = state._replace(status=status).take(torch.arange(len(status), device=status.device))
        size = self.pool_size or (_POOL_SIZE if status.device.type == "cpu" else len(status))
        queue = torch.nonzero(status == Status.RUNNING)[:, 0]
        items, queue = queue[:size], queue[size:]
        pool = _Pool(self, cost, result, bounds, scale)
        part = cost if len(items) == len(status) else cost.take(items)
        while len(items):
            pool.step(part, items)
            left = items[result.status.index_select(0, items) == Status.RUNNING]
            if places := len(items) - len(left):
                # Waiting items take the places of finished ones; when none waits fewer are left.
                items, queue = torch.cat([left, queue[:places]]), queue[places:]
                part = cost.take(items)
        return result

    def modes(
        self, state: TrustRegionState, bounds: Bounds, *, prior_variance: Vector | None = None
    ) -> Modes:
        """Where the items of a state stand, with the covariances there; see `minimise`."""
        bounds, model = bounds.to(state.x), state.model
        if prior_variance is None:
            prior_variance = default_prior_variance(bounds)
        active = bounds.hold(state.x, model.gradient)
        sound = state.status != Status.NON_FINITE
        hessian = torch.where(sound[:, None, None], model.hessian, 0.0)
        covariance = inverse_on_free(hessian, ~active, prior_variance, model.gradient)
        return Modes(state.x, covariance, model.value, active, state.status, state.num_steps)

    def promised(self, state: TrustRegionState, bounds: Bounds) -> TrustRegionState:
        """Where the next step from every item would lead, by the quadratic model.

        After the first `step` it says well enough which of many starts are worth a descent.

        Args:
            state: From `step`, or later.
            bounds: Box limits on the state.

        Returns:
            The ends of the steps, with the costs that the model promises there (infinite for starts
            with `Status.NON_FINITE`); nothing was evaluated there.
        """
        bounds = bounds.to(state.x)
        model = state.model._replace(value=state.model.value - state.predicted)
        ends = bounds.project(state.x + state.step)
        return state._replace(x=ends, model=model)

    def _plan(
        self,
        state: TrustRegionState,
        bounds: Bounds,
        weight: Vector,
        fell_short: Bool[Tensor, " b"],
    ) -> TrustRegionState:
        """Find the next step of every running item, and stop those with nothing to gain.

        `fell_short` says of which items the last step promised less than the tolerance, and did not
        keep even that.
        """
        x, model = state.x, state.model
        running = state.status == Status.RUNNING
        free = running[:, None] & ~bounds.hold(x, model.gradient)
        problem = _Quadratic.of(model, free, weight)
        # Curvature that could change the cost by `tolerance` over a unit length counts as none.
        floor = 2 * self.tolerance
        step, damping = _damped_step(
            problem, state.radius, state.damping, floor, self.factorisations
        )
        step = _step_in_box(problem, damping, x, step, bounds, 0.1 * self.tolerance)
        predicted = -(step * (problem.gradient + 0.5 * problem.times(step))).sum(-1)
        converged = (predicted < self.tolerance) & (damping <= floor)
        # A short damped step that keeps its promise is progress along a curved valley, not an end.
        futile = fell_short | (predicted <= 4 * torch.finfo(x.dtype).eps * model.value.abs())
        # No item ends on a model that is not exact: it is evaluated once more where it stands.
        ends = running & (converged | futile)
        exact = state.share == 1
        again = ends & ~exact
        reason = torch.where(converged, int(Status.CONVERGED), int(Status.SMALL_STEP))
        return state._replace(
            step=torch.where(running[:, None], torch.where(again[:, None], 0.0, step), state.step),
            damping=torch.where(running, damping, state.damping),
            predicted=torch.where(running, torch.where(again, 0.0, predicted), state.predicted),
            status=torch.where(ends & exact, reason, state.status),
        )


class _Pool:
    """Items that are advanced side by side, in the memory of their state.

    Args:
        newton: The optimiser.
        cost: What is minimised.
        state: Where they stand; nobody else's, as `TrustRegionState.take` makes it.
        bounds: Box limits.
        scale: See `TrustRegionNewton.step`.
    """

    def __init__(
        self,
        newton: TrustRegionNewton,
        cost: CostFunction,
        state: TrustRegionState,
        bounds: Bounds,
        scale: Vector | None,
    ) -> None:
        self._newton, self._state, self._bounds = newton, state, bounds.to(state.x)
        self._blends = isinstance(cost, BlendedCost)
        self._reach = newton.initial_radius if self._blends else torch.inf
        self._weight = state.x.new_ones(state.x.shape[-1])
        if scale is not None:
            self._weight = scale.to(state.x).square().reciprocal()
        self._packed = self._pack() if _is_compiled(state.x) else None

    def step(self, cost: CostFunction, items: Items) -> TrustRegionInfo:
        """Evaluate the planned steps of some items, and plan their next ones.

        Args:
            cost: The cost of these items.
            items: Which items; what is not `RUNNING` stays as it is.
        """
        state = self._state
        x, step = (field.index_select(0, items) for field in (state.x, state.step))
        x = self._bounds.project(x + step)
        share = x.new_ones(len(x))
        if self._blends:
            assert isinstance(cost, BlendedCost)
            share = _share_of_second_order(state.model.value[items], state.predicted[items])
            model = cost.blended_model(x, share)
        else:
            model = cost.local_model(x)
        trial = _Trial(x, _checked(model, x), share)
        return (self.advance if self._packed is None else self.advance_compiled)(items, trial)

    def advance(self, items: Items, trial: _Trial) -> TrustRegionInfo:
        """Keep the trials that lower the cost, and plan the next steps of their items."""
        before, space = self._state.take(items), (self._bounds, self._weight)
        after, info = self._newton._advance(before, trial, *space, self._reach)
        for into, field in zip(self._state.tensors, after.tensors, strict=True):
            into.index_copy_(0, items, field)
        return info

    def advance_compiled(self, items: Items, trial: _Trial) -> TrustRegionInfo:
        """The same in one compiled call."""
        from torchcss.inference import planning  # compiled: only where it is used

        assert self._packed is not None
        accepted, decrease = (
            torch.empty_like(items, dtype=torch.bool),
            torch.empty_like(trial.share),
        )
        tried = planning.Points(*map(_array, (trial.x, *trial.model, trial.share)))
        run(planning.advance, _array(items), tried, *self._packed, accepted, decrease)
        return TrustRegionInfo(accepted, decrease)

    def _pack(self) -> tuple[Any, ...]:
        """What the kernel needs to know of the state, the space and the rules."""
        from torchcss.inference import planning

        newton, weight = self._newton, self._weight
        arrays = [field.numpy() for field in self._state.tensors]
        real: Any = arrays[0].dtype.type
        return (
            planning.Items(planning.Points(*arrays[:5]), *arrays[5:]),
            planning.Space(*map(_array, (*self._bounds, weight, weight.reciprocal()))),
            planning.Rules(
                tolerance=real(newton.tolerance),
                greatest_radius=real(self._reach),
                factorisations=newton.factorisations,
                pinning_rounds=_PINNING_ROUNDS,
                max_steps=newton.max_steps,
            ),
            planning.make_memory(len(weight), real),
        )


class _Quadratic(NamedTuple):
    """The quadratic model on the free variables: those that no bound holds.

    Attributes:
        hessian: Second derivative; the free rows and columns matter.
        gradient: First derivative, zero on variables that are not free.
        ridge: What every factorisation adds to the diagonal: its rounding, and a wall where a
            variable is not free.
        free: Which variables may move.
        weight: Diagonal of `W`.
    """

    hessian: Matrices
    gradient: Vectors
    ridge: Vectors
    free: Bool[Tensor, "b n"]
    weight: Vector

    @staticmethod
    def of(model: LocalModel, free: Tensor, weight: Tensor) -> _Quadratic:
        """The model of a cost."""
        # A factorisation cannot tell a curvature within the rounding of the diagonal from zero.
        diagonal = torch.linalg.diagonal(model.hessian)
        rounding = 8 * torch.finfo(weight.dtype).eps * diagonal.abs()
        ridge = torch.where(free, rounding, wall(weight.dtype))
        return _Quadratic(
            model.hessian, torch.where(free, model.gradient, 0.0), ridge, free, weight
        )

    def take(self, items: Items) -> _Quadratic:
        """Some of the items."""
        # Several times faster than indexing, which gathers entry by entry.
        fields = (field.index_select(0, items) for field in self[:-1])
        return _Quadratic(*fields, weight=self.weight)

    def times(self, vector: Vectors) -> Vectors:
        """Hessian times a vector."""
        # As a row: twice as fast as a column on a CPU, and rounded alike in a batch of one.
        return (vector[:, None, :] @ self.hessian)[:, 0]


def default_prior_variance(bounds: Bounds) -> Vector:
    """Square of a quarter of each parameter's range; 1 where a bound is infinite.

    A parameter whose range has no width gets the least variance that is safe to divide by.
    """
    quarter = (bounds.upper - bounds.lower) / 4
    least = torch.finfo(quarter.dtype).eps
    return torch.where(quarter.isfinite(), quarter.clamp(min=least), 1.0).square()


def check_bounds(bounds: Bounds, n: int) -> None:
    """Check that bounds fit a state of `n` parameters and leave room between them.

    Raises:
        ShapeError: If a bound does not have one number per parameter.
        ConfigurationError: If a lower bound exceeds the upper one, or either is not a number.
    """
    for name, bound in zip(Bounds._fields, bounds, strict=True):
        _check_vector(f"bounds.{name}", bound, n)
    wrong = ~(bounds.lower <= bounds.upper)
    if bool(wrong.any()):
        first = int(torch.nonzero(wrong)[0, 0])
        raise ConfigurationError(
            f"bounds: expected lower <= upper, got {float(bounds.lower[first])} and "
            f"{float(bounds.upper[first])} for parameter {first}; correct its limits"
        )


def _check_vector(name: str, vector: Tensor, n: int) -> None:
    check_shape(name, vector)
    if vector.shape != (n,):
        raise ShapeError(
            f"{name}: expected one number per parameter, shape [{n}], got {list(vector.shape)}"
        )


def _next_radius(radius: Tensor, length: Tensor, ratio: Tensor, accepted: Tensor) -> Tensor:
    """Trust radius after a step of some length had some ratio of actual to predicted decrease.

    The factor falls with the root of the prediction's relative error, from 2 to 1/5, and is at
    most 1/2 after a rejection. An error for the better counts less: robust potentials are concave
    in the squared error, so that Gauss-Newton promises too little all along the way, and would go
    in ever shorter steps.
    """
    error = torch.where(ratio > 1, PLEASANT * (ratio - 1), 1 - ratio).clamp(min=1e-3)
    factor = (GOOD_ERROR / error).sqrt().clamp(0.2, 2.0)
    factor = torch.where(accepted, factor, factor.clamp(max=0.5))
    return torch.where(
        factor < 1, factor * torch.minimum(length, radius), torch.maximum(factor * length, radius)
    )


def _norm(vector: Vectors, weight: Vector) -> Numbers:
    """Length in the metric `W`."""
    return (weight * vector.square()).sum(-1).sqrt()


def _change_of_damping(
    state: TrustRegionState, model: LocalModel, accepted: Tensor, weight: Tensor
) -> Numbers:
    """First guess of the next lambda over the last one: it falls with the gradient."""
    before, after = (
        (gradient.square() / weight).sum(-1).sqrt()
        for gradient in (state.model.gradient, model.gradient)
    )
    shrinks = accepted & (after < before)
    return torch.where(shrinks, after / torch.where(shrinks, before, 1.0), 1.0)


def _damped_step(
    problem: _Quadratic, radius: Numbers, damping: Numbers, floor: float, rounds: int
) -> tuple[Vectors, Numbers]:
    """Solve `(H + lambda W) dx = -g` for the least admissible lambda.

    Admissible is a positive definite matrix, `lambda >= floor`, and `|dx| <= radius` in the metric
    `W`, met within a quarter. Newton's method on `1 / |dx(lambda)|` (Moré and Sorensen) inside a
    bracket, starting from the last step's lambda; items leave as they are solved.

    Returns:
        The steps, and the lambdas that belong to them.
    """
    gradient, weight = problem.gradient, problem.weight
    length = (gradient.square() / weight).sum(-1).sqrt()
    # Kept where no factor is found in time: steepest descent.
    step = -gradient / weight * (radius / torch.where(length > 0, length, 1.0))[:, None]
    # A first guess where the undamped matrix is not definite.
    curvature = torch.linalg.diagonal(problem.hessian) / weight
    curvature = torch.where(problem.free, curvature, 0.0)
    guess = torch.maximum(-curvature.amin(-1), 1e-3 * curvature.abs().amax(-1))
    guess = torch.maximum(guess, 0.1 * length / radius)

    found = torch.maximum(damping, guess)
    todo = torch.arange(len(gradient), device=gradient.device)
    lam, rad, guess = damping.clamp(min=floor), radius, guess
    lo, hi = torch.zeros_like(lam), torch.full_like(lam, torch.inf)
    flat = torch.zeros_like(lam, dtype=torch.bool)
    for remaining in reversed(range(rounds)):
        d, slope, ok = _solve_damped(problem, todo, lam[:, None] * weight)
        size = _norm(d, weight)
        too_long, too_short = ok & (size > 1.25 * rad), ok & (size < 0.75 * rad) & (lam > floor)
        lo = torch.where(~ok | (size > rad), lam, lo)
        hi = torch.where(ok & (size <= rad), lam, hi)
        flat = torch.where(ok, size <= FLAT * rad, flat)
        # Almost singular and still short: the gradient has no share in the direction of negative
        # curvature ("hard case"; a saddle is one). Go along it as far as the radius allows.
        stuck = too_short & ((lo >= 0.5 * lam) | (remaining == 0))
        best = d * (rad / torch.where(size > rad, size, rad))[:, None]
        again = ~ok | too_long | (too_short & ~stuck)
        hard, left = (  # one transfer
            torch.as_tensor(np.flatnonzero(mask), device=todo.device)
            for mask in torch.stack([stuck, again]).tolist()
        )
        if len(hard):
            best[hard] = _along_negative_curvature(
                problem, todo[hard], lam[hard, None] * weight, d[hard], rad[hard]
            )
        step[todo] = torch.where(ok[:, None], best, step[todo])
        found[todo] = torch.where(ok, lam, torch.maximum(found[todo], 10 * lam))
        if remaining == 0 or not len(left):
            break
        todo, lam, rad, guess, lo, hi, size, slope, ok, flat = (
            part[left] for part in (todo, lam, rad, guess, lo, hi, size, slope, ok, flat)
        )
        newton = lam + size.square() / torch.where(slope > 0, slope, 1.0) * (size - rad) / rad
        after = torch.where(ok, newton, torch.maximum(10 * lam, guess)).clamp(min=floor)
        between = torch.where(hi.isfinite(), (lo * hi).sqrt(), 10 * lo)
        lam = torch.where((after > lo) & (after < hi), after, between)
        # On a saddle no lambda makes the step longer: back to the one that has a factor.
        lam = torch.where(~ok & flat & ((lo >= 0.5 * hi) | (remaining == 1)), hi, lam)
    return step, found


def _solve_damped(
    problem: _Quadratic, items: Items, damping: Float[Tensor, "m n"]
) -> tuple[Float[Tensor, "m n"], Float[Tensor, " m"], Bool[Tensor, " m"]]:
    """Steps of some items, `-1/2` the derivative of their squared lengths, and which exist.

    On a CPU worked off a few at a time, so that matrices and factors need not leave the caches.
    """
    parts, size = [], _FACTOR_CHUNK if items.device.type == "cpu" else max(1, len(items))
    for some, extra in zip(items.split(size), damping.split(size), strict=True):
        part = problem.take(some)
        factor, ok = damped_cholesky(part.hessian, extra + part.ridge, overwrite=True)
        step = -torch.where(part.free, cholesky_apply(factor, part.gradient), 0.0)
        slope = solve_lower(factor, part.weight * step).square().sum(-1)
        parts.append((step, slope, ok))
    step, slope, ok = (torch.cat(part) for part in zip(*parts, strict=True))
    return step, slope, ok


def _along_negative_curvature(
    problem: _Quadratic, items: Items, damping: Vectors, step: Vectors, radius: Numbers
) -> Vectors:
    """Extend steps to the radius along the lowest eigenvector, found by two inverse iterations."""
    part = problem.take(items)
    weight, free = part.weight, part.free
    probe = weight.sqrt() * torch.arange(1, len(weight) + 1, device=weight.device).to(weight).cos()
    factor, _ = damped_cholesky(part.hessian, damping + part.ridge)
    down = cholesky_apply(factor, torch.where(free, probe, 0.0))
    down = cholesky_apply(factor, weight * down / down.norm(dim=-1, keepdim=True))
    down = torch.where(free, down, 0.0)
    down = down / _norm(down, weight)[:, None]
    down = torch.where(((part.gradient * down).sum(-1) > 0)[:, None], -down, down)
    along = (weight * step * down).sum(-1)
    rest = (radius.square() - _norm(step, weight).square()).clamp(min=0)
    return step + ((along.square() + rest).sqrt() - along)[:, None] * down


def _step_in_box(
    problem: _Quadratic,
    damping: Numbers,
    x: Vectors,
    step: Vectors,
    bounds: Bounds,
    negligible: float,
) -> Vectors:
    """Solve the damped quadratic inside the box, for the items whose step leaves it.

    Free variables that cross a bound are pinned to it and the others solved again, until none
    crosses; a pinned variable is let go again if that lowers the model by more than `negligible`
    nats (without this, a step can be pinned to nothing at a point that is not stationary). The
    matrices are principal parts of definite ones. An item not settled in time takes a projected
    gradient step so short that the model is sure to fall; its damping, changed in place, says so.
    """
    below, above = x + step < bounds.lower, x + step > bounds.upper
    pin = above.to(x) - below.to(x)  # 1 at the upper bound, -1 at the lower
    todo = torch.nonzero((pin != 0).any(-1))[:, 0]
    high = wall(x.dtype)
    for _ in range(_PINNING_ROUNDS):
        if not len(todo):
            break
        part, position, side = problem.take(todo), x[todo], pin[todo]
        gap = torch.where(side > 0, bounds.upper - position, bounds.lower - position)
        pinned = torch.where(side != 0, gap, 0.0)
        loose = part.free & (side == 0)
        force = torch.where(loose, part.gradient + part.times(pinned), 0.0)
        ridge = damping[todo, None] * part.weight
        wall_or_ridge = torch.where(side == 0, part.ridge, high)
        factor, ok = damped_cholesky(part.hessian, ridge + wall_or_ridge)
        moved = torch.where(loose & ok[:, None], -cholesky_apply(factor, force), pinned)
        moved = torch.where(ok[:, None], moved, 0.0)
        slope = part.gradient + part.times(moved) + ridge * moved
        diagonal = torch.linalg.diagonal(part.hessian) + ridge
        gain = slope.square() / (2 * torch.where(diagonal > 0, diagonal, 1.0))
        released = (side * slope > 0) & (gain > negligible)
        target = position + moved
        below, above = loose & (target < bounds.lower), loose & (target > bounds.upper)
        step[todo] = moved
        pin[todo] = torch.where(released, 0.0, side) + above.to(x) - below.to(x)
        todo = todo[(released | below | above).any(-1) | ~ok]
    if len(todo):
        part = problem.take(todo)
        # A bound on the largest eigenvalue in the metric W, row by row.
        rows = (part.hessian.abs() / (part.weight[:, None] * part.weight).sqrt()).sum(-1).amax(-1)
        damping[todo] += rows
        step[todo] = -part.gradient / part.weight / damping[todo, None]
    return bounds.project(x + step) - x


def _checked(model: LocalModel, x: Vectors) -> LocalModel:
    """A cost's answer, which compiled code may read: a number, a slope and a curvature a state.

    Contiguous, because sums over other layouts round differently in other batches.
    """
    b, n = x.shape
    for name, part, shape in zip(LocalModel._fields, model, ((b,), (b, n), (b, n, n)), strict=True):
        if part.shape != shape:
            raise ShapeError(
                f"cost.local_model: {name}: expected {list(shape)} for states {[b, n]}, got "
                f"{list(part.shape)}"
            )
    return LocalModel(*(part.detach().to(x).contiguous() for part in model))


def _is_finite(model: LocalModel) -> Bool[Tensor, " b"]:
    # A sum is finite if its terms are (short of overflow), and far cheaper than looking at each.
    parts = model.value + model.gradient.sum(-1) + model.hessian.flatten(1).sum(-1)
    return parts.isfinite()


def _is_compiled(x: Tensor) -> bool:
    """Whether the step of these items has a compiled twin."""
    known = x.device.type == "cpu" and x.dtype in (torch.float32, torch.float64)
    return compiler.AVAILABLE and known and not torch.compiler.is_compiling()


def _array(tensor: Tensor) -> np.ndarray:
    """The same memory, where it is contiguous: other layouts round differently."""
    return tensor.contiguous().numpy()


def _share_of_second_order(value: Numbers, predicted: Numbers) -> Tensor:
    """How much of the second-order parts the model at the next candidate is to contain.

    None as long as the step promises to remove a good part of what the cost can fall by, all of
    it near the end (after Fletcher and Xu 1987, who decide by the decrease that was had).
    """
    promise = predicted / torch.where(value > 0, value, 1.0)
    exact = (_FAST - promise) / (_FAST - _SLOW)
    return torch.where(value.isinf(), 0.0, exact.clamp(0, 1))
