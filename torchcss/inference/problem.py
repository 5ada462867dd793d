"""What a tracker searches: a cost, and what else is known of the same frame.

A `SearchProblem` has named parts, of which only the cost has to be there. The search never looks
inside them:

| part | what it is for |
|---|---|
| `cost` | what samples descend on |
| `coarse` | a smoother cost, on which some samples descend first |
| `screening` | a cheaper cost, by which more samples than descend are sorted out |
| `weight_only` | what has no derivatives and counts among modes, nats |
| `past` | the part of the cost that says what the modes before make likely |
| `motion` | the part of the cost that compares a state with the mode before that it came from |
| `landmarks` | points by whose distance two states are told apart |
| `restrict` | the problem of some of the samples |
| `of_children` | the problem of samples of a prior, where they are compared with it |
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from torchcss.inference.mixture import Prior
from torchcss.types import CostFunction, Items, Numbers, Vectors

_COSTS = ("cost", "coarse", "screening", "past", "motion")
"""The parts that are costs."""


class SearchProblem(NamedTuple):
    """The posterior of one frame, as a tracker sees it; see the module's table.

    Attributes:
        cost: Negative log posterior.
        coarse: A smoother one; None: there is none.
        screening: A cheaper one; None: the cost itself.
        weight_only: Cost in nats of what counts in the weights of modes alone.
        past: The part of the cost that says what the modes before make likely: it guides descents,
            and is no news of the frame. Weights that inherit from these modes leave it out.
        motion: The part of the cost that says how a state moved since the mode before that it came
            from, and not where it is: flow. What is not known of that mode is not known of the
            state either (`torchcss.inference.marginal`).
        landmarks: Points of each state.
        restrict: Makes the problem of some samples, by index; None: by the costs' `take`.
        of_children: Makes the problem of samples from the component of the prior that each came
            from, and the prior; None: where samples come from does not matter.
    """

    cost: CostFunction
    coarse: CostFunction | None = None
    screening: CostFunction | None = None
    weight_only: Callable[[Vectors], Numbers] | None = None
    past: CostFunction | None = None
    motion: CostFunction | None = None
    landmarks: Callable[[Vectors], Float[Tensor, "b m d"]] | None = None
    restrict: Callable[[Items], SearchProblem] | None = None
    of_children: Callable[[Int[Tensor, " s"], Prior], SearchProblem] | None = None

    def children(self, component: Int[Tensor, " s"], prior: Prior) -> SearchProblem:
        """The problem of samples of a prior's components."""
        return self if self.of_children is None else self.of_children(component, prior)

    def take(self, items: Items) -> SearchProblem:
        """The problem of some of the samples."""
        if self.restrict is not None:
            return self.restrict(items)
        costs = {name: cost for name, cost in self._asdict().items() if name in _COSTS}
        taken = {name: cost.take(items) for name, cost in costs.items() if cost is not None}
        return self._replace(**taken)
