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
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from common import Table, start, write_report
from common.side_by_side import Entrants, side_by_side
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.inference.grid_tracker import GridTracker, by_edges
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import CovarianceScaled
from torchcss.studies.comparison import find_start, plan_of
from torchcss.studies.evaluation import over_seeds
from torchcss.studies.sequences import RecordedSequence, read_sequence
from torchcss.tracking.settings import Settings
from torchcss.types import CostFunction, LocalModel

WAYS = ("edges", "full", "random")
TRACKING = Settings(preset="rr_multiple_hypothesis", overlay=False)
"""How this script tracks, where nothing else is said."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """What is tracked, and how long."""

    sequences: tuple[Path, ...]
    """Sequence folders."""
    seeds: int = 3
    """Runs of each way."""
    frames: int = 100
    """Frames of each run."""
    tracking: SettingsOptions = TRACKING
    """How to track. The seed is the first of the seeds; the body counts where the sequence does not
    say which one moved; the preset is one of [RR]."""
    out: Path | None = None
    """JSON file to write."""


@dataclass(frozen=True)
class Scores:
    """The edges' cost, which notes what the whole cost says beside it.

    Attributes:
        edges: What scores.
        full: The whole cost.
        noted: Where the scores of both are kept, frame by frame.
    """

    edges: CostFunction
    full: CostFunction
    noted: list[tuple[Tensor, Tensor]]

    def value(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
        """The score, nats."""
        self.noted.append((self.edges.value(x), self.full.value(x)))
        return self.noted[-1][0]

    def local_model(self, x: Float[Tensor, "*batch n"]) -> LocalModel:
        """That of the cost which scores."""
        return self.edges.local_model(x)

    def take(self, items: Int[Tensor, " m"]) -> CostFunction:
        """The same of some items."""
        return replace(self, edges=self.edges.take(items), full=self.full.take(items))


@dataclass(frozen=True)
class Noting:
    """Scores hypotheses as the paper does, and notes what the whole cost says of them.

    Attributes:
        noted: Where the scores of both are kept, frame by frame.
    """

    noted: list[tuple[Tensor, Tensor]]

    def __call__(self, problem: SearchProblem) -> CostFunction:
        """What scores the hypotheses of a frame."""
        return Scores(by_edges(problem), problem.cost, self.noted)


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
    config: Config, sequence: RecordedSequence, seed: int, noted: list[tuple[Tensor, Tensor]]
) -> Entrants:
    """The trackers of a seed by how their hypotheses are scored and laid out.

    Args:
        config: How to track.
        sequence: What.
        seed: The seed.
        noted: Where the scores by edges and by the whole cost are kept.
    """
    body = config.tracking.body if sequence.truth is None else sequence.truth.body.name
    settings = replace(config.tracking, body=body, seed=seed)
    begin = find_start(sequence, settings)
    plan = plan_of(sequence, settings, begin)
    tracker = plan.tracker
    if not isinstance(tracker, GridTracker):
        raise ConfigurationError(f"--preset: expected one of [RR], got {settings.preset!r}")
    ways = {
        "edges": replace(tracker, scoring=Noting(noted)),
        "full": replace(tracker, scoring=by_the_whole_cost),
        "random": replace(tracker, pattern=CovarianceScaled(covariance_scale=1.0)),
    }
    return {way: (settings, begin, plan._replace(tracker=each)) for way, each in ways.items()}


def compared(noted: list[tuple[Tensor, Tensor]], k: int) -> list[tuple[float, float]]:
    """Rank correlation of two scores of the same, and the share of the best k in common."""
    pairs = [(rank_correlation(*scores), same_best(*scores, k)) for scores in noted]
    return [pair for pair in pairs if not math.isnan(pair[0])]


def main(config: Config) -> dict[str, Any]:
    """Run, print, write; return what is written."""
    rows, cells = {}, []
    for folder in config.sequences:
        sequence = read_sequence(folder)
        runs: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
        pairs: list[tuple[float, float]] = []
        for seed in range(config.tracking.seed, config.tracking.seed + config.seeds):
            noted: list[tuple[Tensor, Tensor]] = []
            named = entrants(config, sequence, seed, noted)
            for way, row in side_by_side(sequence, named, config.frames):
                runs[way].append(row)
            pairs += compared(noted, named["edges"][2].tracker.num_modes)
        for way, each in runs.items():
            if not each:
                continue
            row = over_seeds(each)
            if way == "edges" and pairs:
                row["rank_correlation"] = median(pair[0] for pair in pairs)
                row["same_best"] = median(pair[1] for pair in pairs)
            rows.setdefault(sequence.name, {})[way] = row
            error, nearest = row["root_aligned_mm"], row["root_aligned_best_of_modes_mm"]
            cells.append([
                f"{sequence.name}: {way}", f"{row['lost']} of {row['seeds']}",
                *(f"{middle:.0f} ({least:.0f} to {most:.0f})"
                  for middle, least, most in (error, nearest)),
                row.get("rank_correlation"), row.get("same_best"),
            ])  # fmt: skip
    columns = (
        *("sequence: hypotheses", "lost", "best mode, mm", "best of modes, mm"),
        *("rank correlation", "same best"),
    )
    table = Table("How hypotheses are scored and laid out", columns, cells)
    table.print()
    report = {"frames": config.frames, "seeds": config.seeds, "by_sequence": rows}
    write_report(config.out, report, table)
    return report


if __name__ == "__main__":
    start(main, Config, __doc__)
