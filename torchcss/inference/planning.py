"""The step of the trust region for a pool of items in one compiled call.

`torchcss.inference.trust_region` has its twin in torch, which says what is computed; a GPU and a
machine without numba take that. Items are worked off one after the other, so that no item's result
depends on the pool. Numbers are of the precision of the states.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from torchcss.inference.trust_region import FLAT, GOOD_ERROR, LEAST_RATIO, PLEASANT
from torchcss.kernels.compiler import by_precision, entry, inlined, kernel, sqrt
from torchcss.types import Status

Array = np.ndarray[Any, Any]

_RUNNING = int(Status.RUNNING)
_CONVERGED = int(Status.CONVERGED)
_SMALL_STEP = int(Status.SMALL_STEP)
_STEP_LIMIT = int(Status.STEP_LIMIT)
_NON_FINITE = int(Status.NON_FINITE)


class Points(NamedTuple):
    """States, and what the cost is there: value, gradient, Hessian and its second-order share."""

    x: Array
    value: Array
    gradient: Array
    hessian: Array
    share: Array


class Items(NamedTuple):
    """Where every item stands; the fields of `TrustRegionState`, which are changed in place."""

    at: Points
    radius: Array
    damping: Array
    step: Array
    predicted: Array
    status: Array
    num_steps: Array


class Space(NamedTuple):
    """Box limits, the diagonal of `W`, and its inverse."""

    lower: Array
    upper: Array
    weight: Array
    inverse: Array


class Rules(NamedTuple):
    """The attributes of `TrustRegionNewton`, in the precision of the states, and limits."""

    tolerance: float
    greatest_radius: float
    factorisations: int
    pinning_rounds: int
    max_steps: int


class Memory(NamedTuple):
    """What is found of one item on the way.

    Attributes:
        factor: Upper factor `U`, `U^T U` the matrix; on its diagonal are reciprocals.
        free: 1 for a variable that no bound holds, else 0.
        side: 1 for a variable pinned to its upper bound, -1 to the lower, else 0.
        loose: 1 for a variable that is free and not pinned, else 0.
        gradient: Of the free variables; else zero.
        step: The coming step.
        product: A matrix times a vector.
        solved: A solution.
        other: Another.
    """

    factor: Array
    free: Array
    side: Array
    loose: Array
    gradient: Array
    step: Array
    product: Array
    solved: Array
    other: Array


def make_memory(n: int, real: Any) -> Memory:
    """Memory for items of `n` parameters."""
    return Memory(np.zeros((n, n), real), *(np.zeros(n, real) for _ in Memory._fields[1:]))


@entry
def advance(
    pool: Array,
    trial: Points,
    items: Items,
    space: Space,
    rules: Rules,
    memory: Memory,
    accepted: Array,
    decrease: Array,
) -> None:
    """Keep the steps that lower the cost, and plan the next.

    Args:
        pool: Numbers of the items that made a step; what is not `RUNNING` stays as it is.
        trial: What the cost is at the ends of these steps, one after the other.
        items: All items.
        space: Bounds and metric.
        rules: Constants.
        memory: Memory for one item.
        accepted: Becomes whether each trial replaced the state.
        decrease: Becomes the decrease of each cost, `-inf` if not finite.
    """
    for k in range(len(pool)):
        b, finite = int(pool[k]), _is_finite(trial, k)
        decrease[k] = items.at.value[b] - trial.value[k] if finite else -math.inf
        accepted[k] = False
        if items.status[b] == _RUNNING:
            accepted[k] = finite and _accepts(decrease[k], items.predicted[b])
            fell_short = _judge(items, b, trial, k, space, rules, accepted[k], decrease[k])
            if items.status[b] == _RUNNING:
                _plan(items, b, space, rules, memory, fell_short)


@kernel
def _is_finite(trial: Points, k: int) -> bool:
    """Whether all is finite: then a sum is, short of overflow."""
    total = trial.value[k]
    for i in range(trial.x.shape[1]):
        total += trial.gradient[k, i] + trial.x[k, i] * 0.0
        for j in range(trial.x.shape[1]):
            total += trial.hessian[k, i, j]
    return np.isfinite(total)


@inlined
def _accepts(decrease: float, predicted: float) -> bool:
    """Whether a step removed a fair share of what it promised."""
    return predicted == 0.0 or (decrease >= 0.0 and decrease / predicted > LEAST_RATIO)


@kernel
def _judge(
    items: Items,
    b: int,
    trial: Points,
    k: int,
    space: Space,
    rules: Rules,
    accepted: bool,
    decrease: float,
) -> bool:
    """Radius, damping and status of item b after trial k; take its place if it is accepted.

    Returns whether the step promised less than the tolerance, and fell short even of that.
    """
    predicted, at, fell_short = items.predicted[b], items.at, False
    items.num_steps[b] += 1
    if predicted != 0.0:
        length = _norm(items.step[b], space.weight)
        after = _next_radius(items.radius[b], length, decrease / predicted, accepted)
        items.radius[b] = min(after, rules.greatest_radius)
        shrinks = not accepted or items.radius[b] < length
        fell_short = shrinks and predicted < rules.tolerance
    if accepted:
        before = _norm(at.gradient[b], space.inverse)
        after = _norm(trial.gradient[k], space.inverse)
        if after < before:
            items.damping[b] *= after / before
        at.value[b], at.share[b] = trial.value[k], trial.share[k]
        for i in range(at.x.shape[1]):
            at.x[b, i], at.gradient[b, i] = trial.x[k, i], trial.gradient[k, i]
            for j in range(at.x.shape[1]):
                at.hessian[b, i, j] = trial.hessian[k, i, j]
    elif math.isinf(at.value[b]):
        items.status[b] = _NON_FINITE
    return fell_short


@kernel
def _next_radius(radius: float, length: float, ratio: float, accepted: bool) -> float:
    error = PLEASANT * (ratio - 1.0) if ratio > 1.0 else 1.0 - ratio
    factor = min(max(sqrt(GOOD_ERROR / max(error, 1e-3)), 0.2), 2.0)
    if not accepted:
        factor = min(factor, 0.5)
    return factor * min(length, radius) if factor < 1.0 else max(factor * length, radius)


@inlined
def _dot(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@inlined
def _norm(vector: Array, metric: Array) -> float:
    """Length of a vector in a diagonal metric."""
    total = 0.0
    for i in range(len(vector)):
        total += metric[i] * vector[i] * vector[i]
    return sqrt(total)


@kernel
def _times(matrix: Array, vector: Array, product: Array) -> None:
    """A symmetric matrix times a vector."""
    for i in range(len(vector)):
        product[i] = _dot(matrix[i], vector)


@kernel
def _plan(
    items: Items, b: int, space: Space, rules: Rules, memory: Memory, fell_short: bool
) -> None:
    """Find the next step of an item, or stop it if there is nothing to gain."""
    at, step, floor = items.at, memory.step, 2.0 * rules.tolerance
    x, hessian = at.x[b], at.hessian[b]
    for i in range(len(x)):
        slope = at.gradient[b, i]
        held = (x[i] <= space.lower[i] and slope > 0.0) or (x[i] >= space.upper[i] and slope < 0.0)
        memory.free[i], memory.gradient[i] = (0.0, 0.0) if held else (1.0, slope)
    start = (items.radius[b], items.damping[b])
    damping = _damped_step(hessian, start, floor, space, rules, memory)
    damping = _step_in_box(hessian, x, damping, space, rules, memory)
    _times(hessian, step, memory.product)
    predicted = -_dot(step, memory.gradient) - 0.5 * _dot(step, memory.product)
    converged = predicted < rules.tolerance and damping <= floor
    ends = converged or fell_short or predicted <= 4.0 * _epsilon(damping) * abs(at.value[b])
    items.damping[b] = damping
    share = 0.0 if ends and at.share[b] != 1.0 else 1.0
    items.predicted[b] = share * predicted
    for i in range(len(step)):
        items.step[b, i] = share * step[i]
    if ends and at.share[b] == 1.0:
        items.status[b] = _CONVERGED if converged else _SMALL_STEP
    elif items.num_steps[b] >= rules.max_steps:
        items.status[b] = _STEP_LIMIT


@inlined
def _epsilon(x: float) -> float:
    return by_precision(x, 2.0**-23, 2.0**-52)


@kernel
def _damped_step(
    hessian: Array,
    start: tuple[float, float],
    floor: float,
    space: Space,
    rules: Rules,
    memory: Memory,
) -> float:
    """The step inside a radius, into `memory.step`, and its lambda; see the twin."""
    (radius, damping), step, solved = start, memory.step, memory.solved
    guess = _steepest_descent(hessian, radius, space, memory)
    size, slope, lo, hi, lam = 0.0, 0.0, 0.0, 0.0, max(damping, floor)
    found = max(damping, guess)
    for remaining in range(rules.factorisations - 1, -1, -1):
        ok = _factor(hessian, memory.free, lam, space, memory)
        too_long = too_short = stuck = False
        if ok:
            size, slope = _solve_step(space, memory)
            too_long, too_short = size > 1.25 * radius, size < 0.75 * radius and lam > floor
        if not ok or size > radius:
            lo = lam
        else:
            hi = lam
        found = lam if ok else max(found, 10.0 * lam)
        after = max(10.0 * lam, guess)
        if ok:
            # Almost singular and still short: the "hard case".
            stuck = too_short and (lo >= 0.5 * lam or remaining == 0)
            for i in range(len(step)):
                step[i] = solved[i] * (radius / max(size, radius))
            if stuck:
                _extend(radius, size, space, memory)
            if not too_long and (stuck or not too_short):
                break
            after = lam + size * size / (slope if slope > 0.0 else 1.0) * (size - radius) / radius
        lam = max(after, floor)
        if lam <= lo or 0.0 < hi <= lam:
            lam = sqrt(lo * hi) if hi > 0.0 else 10.0 * lo
        # On a saddle no lambda makes the step longer: back to the one that has a factor.
        closed = lo >= 0.5 * hi or remaining == 1
        if not ok and hi > 0.0 and size <= FLAT * radius and closed:
            lam = hi
    return found


@kernel
def _steepest_descent(hessian: Array, radius: float, space: Space, memory: Memory) -> float:
    """Steepest descent into `memory.step`; a lambda to begin with."""
    length = _norm(memory.gradient, space.inverse)
    lowest = highest = 0.0
    for i in range(len(memory.step)):
        curvature = hessian[i, i] * space.inverse[i] * memory.free[i]
        lowest, highest = min(lowest, curvature), max(highest, abs(curvature))
        far = radius / length if length > 0.0 else 1.0
        memory.step[i] = -memory.gradient[i] * space.inverse[i] * far
    return max(-lowest, 1e-3 * highest, 0.1 * length / radius)


@kernel
def _factor(hessian: Array, among: Array, lam: float, space: Space, memory: Memory) -> bool:
    """Factor a damped matrix of some variables; whether it is positive definite."""
    factor, n = memory.factor, len(among)
    for i in range(n):
        for j in range(i, n):
            factor[i, j] = hessian[i, j] * (among[i] * among[j])
        # A factorisation cannot tell a curvature within its rounding from zero.
        ridge = lam * space.weight[i] + 8.0 * _epsilon(lam) * abs(hessian[i, i])
        factor[i, i] += ridge if among[i] == 1.0 else 1.0
    for i in range(n):
        # Row by row, four of the rows above at a time: each number is loaded and stored less often.
        k = 0
        while k + 4 <= i:
            _subtract_four(factor, i, k)
            k += 4
        while k < i:
            _subtract(factor[i, i:], factor[k, i:], factor[k, i])
            k += 1
        if not factor[i, i] > 0.0:
            return False
        inverse = 1.0 / sqrt(factor[i, i])
        factor[i, i] = inverse
        for j in range(i + 1, n):
            factor[i, j] *= inverse
    return True


@inlined
def _subtract_four(factor: Array, i: int, k: int) -> None:
    """Subtract from row `i` what four rows from `k` on contribute."""
    row, a, b, c, d = factor[i], factor[k], factor[k + 1], factor[k + 2], factor[k + 3]
    by_a, by_b, by_c, by_d = a[i], b[i], c[i], d[i]
    for j in range(i, len(row)):
        row[j] = row[j] - by_a * a[j] - by_b * b[j] - by_c * c[j] - by_d * d[j]


@inlined
def _subtract(row: Array, other: Array, times: float) -> None:
    for j in range(len(row)):
        row[j] -= times * other[j]


@kernel
def _forward(factor: Array, vector: Array) -> None:
    """Multiply a vector by the inverse of `U^T`."""
    for k in range(len(vector)):
        vector[k] *= factor[k, k]
        _subtract(vector[k + 1 :], factor[k, k + 1 :], vector[k])


@kernel
def _solve(factor: Array, vector: Array) -> None:
    """Multiply a vector by the inverse of `U^T U`."""
    _forward(factor, vector)
    for k in range(len(vector) - 1, -1, -1):
        rest = _dot(factor[k, k + 1 :], vector[k + 1 :])
        vector[k] = (vector[k] - rest) * factor[k, k]


@kernel
def _solve_step(space: Space, memory: Memory) -> tuple[float, float]:
    """The damped step into `memory.solved`; its length, and `-1/2` the slope of its square."""
    solved, other = memory.solved, memory.other
    for i in range(len(solved)):
        solved[i] = -memory.gradient[i]
    _solve(memory.factor, solved)
    for i in range(len(solved)):
        other[i] = space.weight[i] * solved[i]
    square = _dot(other, solved)
    _forward(memory.factor, other)
    return sqrt(square), _dot(other, other)


@kernel
def _extend(radius: float, size: float, space: Space, memory: Memory) -> None:
    """Extend a step to the radius along the lowest eigenvector: two inverse iterations."""
    weight, down, other = space.weight, memory.other, memory.product
    for i in range(len(down)):
        down[i] = memory.free[i] * sqrt(weight[i]) * math.cos(i + 1.0)
    _solve(memory.factor, down)
    length = sqrt(_dot(down, down))
    for i in range(len(down)):
        down[i] *= weight[i] / length
    _solve(memory.factor, down)
    norm = _norm(down, weight)
    if _dot(memory.gradient, down) > 0.0:
        norm = -norm
    for i in range(len(down)):
        down[i] /= norm
        other[i] = weight[i] * down[i]
    along = _dot(other, memory.solved)
    far = sqrt(along * along + max(radius * radius - size * size, 0.0)) - along
    for i in range(len(down)):
        memory.step[i] = memory.solved[i] + far * down[i]


@kernel
def _step_in_box(
    hessian: Array, x: Array, damping: float, space: Space, rules: Rules, memory: Memory
) -> float:
    """Solve the damped quadratic inside the box where the step leaves it; its lambda."""
    step, settled = memory.step, True
    for i in range(len(x)):
        memory.side[i] = _side(x, i, space, memory)
        settled &= memory.side[i] == 0.0
    for _ in range(rules.pinning_rounds):
        if settled:
            break
        settled = _solve_pinned(hessian, x, damping, space, rules, memory)
    if not settled:
        greatest = 0.0
        for i in range(len(x)):
            row = 0.0
            for j in range(len(x)):
                row += abs(hessian[i, j]) * sqrt(space.inverse[i] * space.inverse[j])
            greatest = max(greatest, row)
        damping += greatest
        for i in range(len(x)):
            step[i] = -memory.gradient[i] * space.inverse[i] / damping
    for i in range(len(x)):
        step[i] = min(max(x[i] + step[i], space.lower[i]), space.upper[i]) - x[i]
    return damping


@inlined
def _side(x: Array, i: int, space: Space, memory: Memory) -> float:
    """Which bound a variable crosses: 1 the upper, -1 the lower, 0 none."""
    end = x[i] + memory.step[i]
    return 1.0 if end > space.upper[i] else (-1.0 if end < space.lower[i] else 0.0)


@kernel
def _solve_pinned(
    hessian: Array, x: Array, damping: float, space: Space, rules: Rules, memory: Memory
) -> bool:
    """Solve again for what is loose; whether all pins are settled then."""
    step, side, loose, product = memory.step, memory.side, memory.loose, memory.product
    for i in range(len(x)):
        gap = (space.upper[i] if side[i] > 0.0 else space.lower[i]) - x[i]
        step[i] = gap if side[i] != 0.0 else 0.0
        loose[i] = memory.free[i] if side[i] == 0.0 else 0.0
    _times(hessian, step, product)
    settled = _factor(hessian, loose, damping, space, memory)
    for i in range(len(x)):
        memory.solved[i] = -loose[i] * (memory.gradient[i] + product[i])
    if settled:
        _solve(memory.factor, memory.solved)
    for i in range(len(x)):
        step[i] = step[i] + memory.solved[i] if settled else 0.0
    _times(hessian, step, product)
    for i in range(len(x)):
        ridge = damping * space.weight[i]
        slope, diagonal = memory.gradient[i] + product[i] + ridge * step[i], hessian[i, i] + ridge
        gain = slope * slope / (2.0 * (diagonal if diagonal > 0.0 else 1.0))
        if loose[i] == 1.0:
            side[i] = _side(x, i, space, memory)
            settled &= side[i] == 0.0
        elif side[i] * slope > 0.0 and gain > 0.1 * rules.tolerance:
            side[i] = 0.0
            settled = False
    return settled
