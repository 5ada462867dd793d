"""The states that put points of a body where they should be, and how to move among them.

With one parameter more than there are conditions, these states form curves: the self-motion
manifolds of a redundant arm (Burdick, *On the inverse kinematics of redundant manipulators*, ICRA
1989), an elbow that swings while the hand stands still. `SolutionSet.follow` walks along them: a
step along the null vector of the Jacobian, then Gauss-Newton steps back in the plane across it
(pseudo-arclength continuation), from many starts at once. `SolutionSet.polish` brings states near
the set onto it, to machine precision.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.cost.targets import PointTargets
from torchcss.linalg import multiply
from torchcss.types import Bounds

_POLISHING = 12
"""Gauss-Newton steps at most; three do unless the arm is nearly singular."""

_CORRECTIONS = 3
"""Steps back to a curve after a step along it."""

_ON_THE_CURVE = 1e-5
"""Metres off the targets that a corrected step may be; the points are polished in the end."""

_TURN = 0.9
"""Least cosine between the directions before and after a step; below, the step is halved."""

_LEAST_STEP = 1e-4
"""Share of the spacing below which a curve counts as ended."""

_MOST_STEPS = 5000

States = Float[Tensor, "k m"]
"""Some states, a row each."""


class Curve(NamedTuple):
    """A connected piece of a solution set within the bounds.

    Attributes:
        x: Points along it, in order.
        closed: Whether it comes back to its first point; else it ends at bounds.
    """

    x: Float[Tensor, "s m"]
    closed: bool


class SolutionSet(NamedTuple):
    """The states within bounds at which the points are on target.

    Attributes:
        cost: Points and targets.
        bounds: Limits of the states.
        period: By what a parameter may change without effect: a whole turn for a joint without
            limits, 0 for others.
        tolerance: Metres by which a point may be off target.
    """

    cost: PointTargets
    bounds: Bounds
    period: Float[Tensor, " m"]
    tolerance: float

    def apart(self, x: Float[Tensor, "*a m"], y: Float[Tensor, "*b m"]) -> Float[Tensor, "*c m"]:
        """Difference of states, whole periods left out."""
        return _less_periods(x - y, self.period)

    def wrapped(self, x: Float[Tensor, "*batch m"]) -> Float[Tensor, "*batch m"]:
        """Joints without limits brought within half a turn from zero."""
        return self.apart(x, torch.zeros_like(x))

    def polish(
        self, x: States, held: Bool[Tensor, "k m"] | None = None
    ) -> tuple[States, Bool[Tensor, " k"]]:
        """Go to the nearest states of the set by Gauss-Newton steps of least length.

        Args:
            x: States near it.
            held: Parameters that keep their values.

        Returns:
            States within the bounds, and which of them are on target.
        """
        x, exact = x.clone(), torch.zeros_like(x[:, 0], dtype=torch.bool)
        for _ in range(_POLISHING):
            todo = torch.nonzero(~exact)[:, 0]
            error, jacobian = self.cost.errors(x[todo])
            done = error.norm(dim=-1).amax(-1) <= self.tolerance
            exact[todo[done]] = True
            todo, error, jacobian = todo[~done], error[~done], jacobian[~done]
            if not len(todo):
                break
            if held is not None:
                jacobian = jacobian * ~held[todo, None, None]
            step = torch.linalg.pinv(jacobian.flatten(1, 2)) @ error.flatten(1)[..., None]
            x[todo] = self.bounds.project(x[todo] - step[..., 0])
        return x, exact

    def follow(self, x: States, spacing: float) -> list[Curve]:
        """Walk along the curves through some states until they close or end at bounds.

        Args:
            x: States of the set.
            spacing: Greatest distance between points of a curve.
        """
        direction = self._direction(x)
        ahead = self._walk(x, direction, spacing)
        is_open = [index for index, curve in enumerate(ahead) if not curve.closed]
        back = self._walk(x[is_open], -direction[is_open], spacing)
        curves = list(ahead)
        for index, behind in zip(is_open, back, strict=True):
            joined = torch.cat([behind.x.flip(0)[:-1], ahead[index].x])
            curves[index] = Curve(joined, False)
        exact = []
        for curve in curves:
            polished, on_target = self.polish(curve.x)
            exact.append(Curve(polished[on_target], curve.closed))
        return exact

    def _direction(self, x: States) -> States:
        """Unit null vectors of the Jacobian, of either sign."""
        jacobian = self.cost.errors(x)[1].flatten(1, 2)
        return torch.linalg.eigh(jacobian.mT @ jacobian)[1][..., 0]

    def _walk(self, start: States, direction: States, spacing: float) -> list[Curve]:
        """Walk one way from every start."""
        chains = [[point] for point in start]
        closed = [False] * len(start)
        item = torch.arange(len(start), device=start.device)
        x, along = start, direction
        step = torch.full_like(x[:, 0], spacing)
        for _ in range(_MOST_STEPS):
            if not len(item):
                break
            target, ok = self._step(x, along, step)
            after = self._direction(target)
            cosine = (after * along).sum(-1)
            after = torch.where(cosine[:, None] < 0, -after, after)
            ok = ok & (cosine.abs() >= _TURN)
            inside = ((target >= self.bounds.lower) & (target <= self.bounds.upper)).all(-1)
            ends = ok & ~inside
            if bool(ends.any()):
                landed, there = self._land(x[ends], target[ends])
                for index, point in zip(item[ends][there].tolist(), landed[there], strict=True):
                    chains[index].append(point)
            moved = ok & inside
            for index, point in zip(item[moved].tolist(), target[moved], strict=True):
                chains[index].append(point)
            back = self.apart(target, start[item]).norm(dim=-1) <= spacing
            back = back & ((after * direction[item]).sum(-1) >= _TURN) & moved
            for place in torch.nonzero(back)[:, 0].tolist():
                index = int(item[place])
                # Next to the start it is after the first steps too.
                closed[index] = len(chains[index]) > 3
                back[place] = closed[index]
            x = torch.where(moved[:, None], target, x)
            along = torch.where(moved[:, None], after, along)
            step = torch.where(ok, (2 * step).clamp(max=spacing), 0.5 * step)
            goes_on = ~ends & ~back & (step >= _LEAST_STEP * spacing)
            item, x, along, step = item[goes_on], x[goes_on], along[goes_on], step[goes_on]
        return [Curve(torch.stack(c), done) for c, done in zip(chains, closed, strict=True)]

    def _step(
        self, x: States, along: States, step: Float[Tensor, " k"]
    ) -> tuple[States, Bool[Tensor, " k"]]:
        """A step along the curve, and which of them came back to it."""
        ahead = x + step[:, None] * along
        target = ahead
        for _ in range(_CORRECTIONS):
            error, jacobian = self.cost.errors(target)
            off = ((target - ahead) * along).sum(-1)
            rows = torch.cat([jacobian.flatten(1, 2), along[:, None]], 1)
            right = torch.cat([error.flatten(1), off[:, None]], 1)
            target = target - multiply(torch.linalg.pinv(rows), right)
        error = self.cost.errors(target)[0].norm(dim=-1).amax(-1)
        aside = (target - ahead).norm(dim=-1)
        return target, (error <= _ON_THE_CURVE) & (aside <= 0.5 * step)

    def _land(self, x: States, beyond: States) -> tuple[States, Bool[Tensor, " k"]]:
        """Where curves from within the bounds meet them; False where that is at x itself."""
        move = beyond - x
        limit = torch.where(move > 0, self.bounds.upper, self.bounds.lower)
        outside = (beyond < self.bounds.lower) | (beyond > self.bounds.upper)
        share = torch.where(outside, (limit - x) / torch.where(outside, move, 1.0), torch.inf)
        first, joint = share.min(-1, keepdim=True)
        landed = (x + first * move).scatter(1, joint, limit.gather(1, joint))
        held = torch.zeros_like(outside).scatter(1, joint, True)
        landed, exact = self.polish(self.bounds.project(landed), held)
        away = (landed - x).norm(dim=-1)
        near = away <= 2 * move.norm(dim=-1)
        return landed, exact & near & (away > self.tolerance)


def distance_from(
    curve: Curve, x: States, period: Float[Tensor, " m"] | None = None
) -> Float[Tensor, " k"]:
    """Distance of states from the line through the points of a curve.

    Args:
        curve: A curve, or a single point.
        x: States.
        period: See `SolutionSet`; by default no parameter has one.
    """
    period = x.new_zeros(x.shape[-1]) if period is None else period
    ends = torch.cat([curve.x[1:], curve.x[:1] if curve.closed else curve.x[-1:]])
    step = _less_periods(ends - curve.x, period)
    offset = _less_periods(x[:, None] - curve.x, period)
    length = step.square().sum(-1)
    share = (offset * step).sum(-1) / torch.where(length > 0, length, 1.0)
    return (offset - share.clamp(0, 1)[..., None] * step).norm(dim=-1).amin(-1)


def _less_periods(difference: Float[Tensor, "*c m"], period: Float[Tensor, " m"]) -> Tensor:
    whole = torch.where(period > 0, period, 1.0)
    return difference - period * (difference / whole).round()
