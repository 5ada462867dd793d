"""The multiple-hypothesis tracker of Fig. 4 [RR]: descend from k hypotheses, lay a pattern, prune.

For every frame, each of the k hypotheses descends once, and the minima are the posterior. About
each minimum a pattern is laid along the least certain eigen-directions of its own Hessian; it is
scored on this frame by edges alone and does not descend. The best k of all patterns start the next
frame. There are no dynamics, no weights from frame to frame and no test for duplicates: hypotheses
that meet in one minimum count as often as they are.

| Fig. 4 [RR] | here |
|---|---|
| `k` | `GridTracker.num_modes` |
| `ns`, `pf` | `EigenDirectionGrid.num_directions`, `EigenDirectionGrid.num_steps` |
| `InitializeModel` | the pattern about the first fit, scored on the first frame |
| `RobustContinuousOptimize` | `TrustRegionNewton`; in the preset by `Curvature.GAUSS_NEWTON` |
| `GeneralizedEigenDecomposition` | eigenvectors of `constrained_inverse`, the widest first |
| `EvaluateCost` | `by_edges`: `SearchProblem.screening` |
| `Prune` | the k of least score, of one pool (decision "regular sampling") |

What is not printed: a hypothesis has the optical flow of the minimum that it was laid about; what
has not converged is left out; weights are exp(-cost).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field

import torch

from torchcss.inference.importance import survival
from torchcss.inference.mixture import GaussianMixture, Prior, cheapest_first
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import Proposal
from torchcss.inference.tracker import (
    Particles,
    SequenceTracker,
    TrackerInfo,
    TrackerState,
    as_printed,
    finite_cost,
)
from torchcss.inference.trust_region import TrustRegionNewton, check_bounds
from torchcss.types import Bounds, CostFunction, Status, frozen


def by_edges(problem: SearchProblem) -> CostFunction:
    """What scores the hypotheses of a frame (section 4.2 [RR]): the edges alone, if it has some."""
    return problem.screening or problem.cost


@frozen
class GridTracker(SequenceTracker):
    """Fig. 4 [RR]; a `SequenceTracker` without randomness.

    Attributes:
        num_samples: Most hypotheses that are scored in a frame, the best minima's first.
        num_modes: k, the hypotheses that descend: 3 for an arm and 7 for a body in section 6 [RR].
        pattern: What is laid about each minimum, itself included: an `EigenDirectionGrid`, or for
            studies a random proposal, which then draws the same numbers in every frame.
        optimiser: How hypotheses descend.
        scoring: What scores the hypotheses of a frame; the paper's way, or for studies another.
    """

    pattern: Proposal
    optimiser: TrustRegionNewton = field(default_factory=TrustRegionNewton)
    scoring: Callable[[SearchProblem], CostFunction] = by_edges

    def step(
        self, state: TrackerState, problem: SearchProblem, bounds: Bounds
    ) -> tuple[TrackerState, TrackerInfo]:
        """Process one frame.

        Args:
            state: Where the last frame left off. Without hypotheses (`TrackerState.particles`) they
                are laid about its mixture and scored on this frame.
            problem: The frame.
            bounds: Box limits on the state.

        Returns:
            The next state and what was done. If no hypothesis has come to an end with a finite
            cost, all stay where they are.
        """
        check_bounds(bounds, state.mixture.mean.shape[-1])
        prior = Prior.of(state.mixture)
        starts = state.particles
        if starts is None:
            starts = self._prune(state.mixture, problem.children(prior.parent, prior), bounds)
        own, origin = problem.children(starts.component, prior), starts.component
        waiting = self.optimiser.start(bounds.project(starts.x))
        descents = self.optimiser.descend(own.cost, waiting, bounds)
        ends, floored = as_printed(self.optimiser.modes(descents, bounds), descents, bounds)

        cost = finite_cost(ends.status, ends.cost, converged_only=True)
        if own.weight_only is not None:
            cost = cost + own.weight_only(ends.mean)
        order = cheapest_first(cost)
        num_found = len(order)
        if num_found:
            cost, origin = cost[order], origin[order]
            mixture = GaussianMixture(ends.mean[order], ends.covariance[order], -cost).normalise()
            starts = self._prune(mixture, own.take(order), bounds)
        else:
            mixture, origin = state.mixture, prior.parent
            cost = torch.full_like(mixture.log_weight, torch.inf)
        info = TrackerInfo(
            cost=cost,
            parent=origin,
            origin=origin,
            status_counts=torch.bincount(ends.status, minlength=len(Status)),
            num_steps=ends.num_steps,
            num_samples=torch.tensor(len(ends.cost)),
            num_distinct=torch.tensor(num_found),
            effective_sample_size=survival(mixture.log_weight).effective_sample_size,
            num_floored=floored,
            survival=survival(torch.full_like(ends.cost, -torch.inf)),
            prior=prior,
        )
        velocity, frame = mixture.mean - state.mixture.mean[origin], state.frame + 1
        return TrackerState(mixture, velocity, state.generator_state, frame, starts), info

    def _prune(self, minima: GaussianMixture, problem: SearchProblem, bounds: Bounds) -> Particles:
        """The best k of the patterns about the minima, by edges alone.

        Args:
            minima: The best first.
            problem: That of the minima, in their order.
            bounds: Box limits on the state.
        """
        pool = self.pattern.sample(minima, self.num_samples, bounds, generator=torch.Generator())
        problem = problem.take(pool.parent)
        score = self.scoring(problem).value(pool.x).nan_to_num(torch.inf)
        best = score.argsort(stable=True)[: self.num_modes]
        x = pool.x[best]
        return Particles(x, torch.zeros_like(x), -score[best], pool.parent[best])
