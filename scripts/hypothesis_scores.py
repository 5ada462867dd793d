"""How [RR] scores and lays out its hypotheses: edges or the full cost, a pattern or random samples.

    python scripts/hypothesis_scores.py --sequences ARM CLUTTER DARK --seeds 3 --out scores.json

Fig. 4 [RR] lays a pattern about every minimum, scores it by the edges alone, for speed (section
4.2), and descends from the best k in the next frame. Three trackers differ from each other in one
point: "edges" is the preset `rr_multiple_hypothesis`, "full" scores by the whole cost, and "random"
draws as many hypotheses from the minima's Gaussians as the pattern has, the minima among them.

Each is run on the sequences of `scripts/failure_modes.py`, from the same first pose. Where both
scores are known, in "edges", they are also compared: the rank correlation of the two over the
hypotheses of a frame, and how many of the best k are the same.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, replace
from functools import partial
from statistics import median
from typing import Any

import torch
from common import Table, finish, start
from common.comparison import Comparison, Entrants, by_sequence, cells_of
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.inference.grid_tracker import GridTracker, by_edges
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import CovarianceScaled
from torchcss.studies.comparison import find_start, plan_of
from torchcss.studies.sequences import RecordedSequence
from torchcss.tracking.settings import Settings
from torchcss.types import CostFunction, LocalModel, Numbers, Vectors, frozen

ERRORS = "root_aligned_mm", "root_aligned_best_of_modes_mm"
"""What the table shows of each tracker."""
TRACKING = Settings(preset="rr_multiple_hypothesis", overlay=False)
"""How this script tracks, where nothing else is said."""


@frozen
class Config(Comparison):
    """What is tracked, and how long."""

    frames: int = 100
    """Frames of each run."""
    tracking: SettingsOptions = TRACKING
    """How to track. The seed is the first of the seeds; the body counts where the sequence does not
    say which one moved; the preset is one of [RR]."""


@dataclass(frozen=True)
class Scores:
    """The edges' cost, which is compared with the whole cost whenever it scores.

    Attributes:
        edges: What scores.
        full: The whole cost.
        num_kept: How many of the best are kept.
        noted: Where is kept what comes out: rank correlation, and share of the best in common.
    """

    edges: CostFunction
    full: CostFunction
    num_kept: int
    noted: list[tuple[float, float]]

    def value(self, x: Vectors) -> Numbers:
        """The score, nats."""
        scores = self.edges.value(x), self.full.value(x)
        if not math.isnan(correlation := rank_correlation(*scores)):
            self.noted.append((correlation, same_best(*scores, self.num_kept)))
        return scores[0]

    def local_model(self, x: Vectors) -> LocalModel:
        """That of the cost which scores."""
        return self.edges.local_model(x)

    def take(self, items: Int[Tensor, " m"]) -> CostFunction:
        """The same of some items."""
        return replace(self, edges=self.edges.take(items), full=self.full.take(items))


@dataclass(frozen=True)
class Compared:
    """Scores hypotheses as the paper does, and notes what the whole cost says of them.

    Attributes:
        num_kept: How many of the best are kept.
        noted: See `Scores`.
    """

    num_kept: int
    noted: list[tuple[float, float]]

    def __call__(self, problem: SearchProblem) -> CostFunction:
        """What scores the hypotheses of a frame."""
        return Scores(by_edges(problem), problem.cost, self.num_kept, self.noted)


def by_the_whole_cost(problem: SearchProblem) -> CostFunction:
    """The frame's whole cost."""
    return problem.cost


def rank_correlation(first: Float[Tensor, " m"], second: Float[Tensor, " m"]) -> float:
    """Spearman's; NaN of fewer than three, or where one says the same of all."""
    ranks = torch.stack([each.argsort().argsort().double() for each in (first, second)])
    if len(first) < 3 or any(bool((each == each[0]).all()) for each in (first, second)):
        return math.nan
    return float(torch.corrcoef(ranks)[0, 1])


def same_best(first: Float[Tensor, " m"], second: Float[Tensor, " m"], k: int) -> float:
    """Share of the best k that two scores have in common."""
    best = [set(each.argsort(stable=True)[:k].tolist()) for each in (first, second)]
    return len(best[0] & best[1]) / max(1, min(k, len(first)))


def entrants(
    config: Config,
    noted: defaultdict[str, list[tuple[float, float]]],
    sequence: RecordedSequence,
    seed: int,
) -> Entrants:
    """The trackers of a seed by how their hypotheses are scored and laid out.

    Args:
        config: How to track.
        noted: Where is kept, by sequence, what comes out where both scores are known, see `Scores`.
        sequence: What.
        seed: The seed.
    """
    settings = config.settings_of(sequence, seed)
    begin = find_start(sequence, settings)
    plan = plan_of(sequence, settings, begin)
    tracker = plan.tracker
    if not isinstance(tracker, GridTracker):
        raise ConfigurationError(f"--preset: expected one of [RR], got {settings.preset!r}")
    ways = {
        "edges": replace(tracker, scoring=Compared(tracker.num_modes, noted[sequence.name])),
        "full": replace(tracker, scoring=by_the_whole_cost),
        "random": replace(tracker, pattern=CovarianceScaled(covariance_scale=1.0)),
    }
    return {way: (settings, begin, plan._replace(tracker=each)) for way, each in ways.items()}


def main(config: Config) -> dict[str, Any]:
    """Run, print, write; return what is written."""
    noted: defaultdict[str, list[tuple[float, float]]] = defaultdict(list)
    rows = by_sequence(config, partial(entrants, config, noted))
    for name, found in rows.items():
        if noted[name] and "edges" in found:
            ranks, shares = zip(*noted[name], strict=True)
            found["edges"] |= {"rank_correlation": median(ranks), "same_best": median(shares)}
    compared = ("rank_correlation", "same_best")
    cells = [
        [f"{name}: {way}", *cells_of(row, *ERRORS), *map(row.get, compared)]
        for name, found in rows.items()
        for way, row in found.items()
    ]
    columns = (
        *("sequence: hypotheses", "lost", "best mode, mm", "best of modes, mm"),
        *("rank correlation", "same best"),
    )
    table = Table("How hypotheses are scored and laid out", columns, cells)
    return finish(config.out, config.report(rows), table)


if __name__ == "__main__":
    start(main, Config, __doc__)
