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
from dataclasses import dataclass, fields, replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from common import Table, start, write_report
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from torchcss.cli.options import SettingsOptions
from torchcss.cost.total import TrackingCost
from torchcss.errors import ConfigurationError
from torchcss.inference.grid_tracker import GridTracker
from torchcss.inference.proposals import CovarianceScaled
from torchcss.io.video import VideoReader
from torchcss.studies.comparison import find_start, plan_of, session_of
from torchcss.studies.evaluation import Evaluator, Thresholds, over_seeds, summarise
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
    """A cost that scores as another one does, and notes both.

    Attributes:
        edges: What the edges say.
        full: What the whole cost says.
        by_edges: Which of the two scores.
        noted: Where both are kept, call by call.
    """

    edges: TrackingCost
    full: TrackingCost
    by_edges: bool
    noted: list[tuple[Tensor, Tensor]]

    def value(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
        """The score, nats."""
        both = self.edges.value(x), self.full.value(x)
        self.noted.append(both)
        return both[0] if self.by_edges else both[1]

    def local_model(self, x: Float[Tensor, "*batch n"]) -> LocalModel:
        """That of the cost which scores."""
        return (self.edges if self.by_edges else self.full).local_model(x)

    def take(self, items: Int[Tensor, " m"]) -> CostFunction:
        """The same of some items."""
        return replace(self, edges=self.edges.take(items), full=self.full.take(items))


def noting(cost: TrackingCost, by_edges: bool, noted: list[tuple[Tensor, Tensor]]) -> TrackingCost:
    """A frame's cost whose hypotheses are scored by `Scores`."""

    class Noting(TrackingCost):
        def screening(self) -> Any:
            return Scores(super().screening(), self, by_edges, noted)

    return Noting(**{each.name: getattr(cost, each.name) for each in fields(cost) if each.init})


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


def follow(
    config: Config, sequence: RecordedSequence, way: str, seed: int
) -> tuple[dict[str, Any], list[tuple[float, float]]]:
    """One run: its row, and rank correlation and common best of every frame."""
    body = config.tracking.body if sequence.truth is None else sequence.truth.body.name
    settings = replace(config.tracking, body=body, seed=seed)
    begin, thresholds = find_start(sequence, settings), Thresholds.of(sequence)
    plan = plan_of(sequence, settings, begin)
    if way == "random" and isinstance(plan.tracker, GridTracker):
        drawn = replace(plan.tracker, pattern=CovarianceScaled(covariance_scale=1.0))
        plan = plan._replace(tracker=drawn)
    session = session_of(sequence, settings, begin, plan)
    if not isinstance(plan.tracker, GridTracker):
        raise ConfigurationError(f"--preset: expected one of [RR], got {settings.preset!r}")
    evaluator = Evaluator(sequence, begin.first.body, thresholds)
    measures, compared, first = [], [], None
    reader = VideoReader(sequence.video, stop=min(config.frames, sequence.num_frames))
    for frame in tqdm(reader, desc=f"{sequence.name}, {way}, {seed}", dynamic_ncols=True):
        first, noted = first or frame, []
        observation = session.observe(frame)
        posterior = session.step(
            observation, lambda cost, noted=noted: noting(cost, way != "full", noted)
        )
        measures.append(evaluator(posterior, first, observation.seconds))
        for edges, full in noted if way == "edges" else ():
            common = same_best(edges, full, plan.tracker.num_modes)
            compared.append((rank_correlation(edges, full), common))
    row = summarise(measures, thresholds, 1 / sequence.frame_rate)
    return row, [pair for pair in compared if not math.isnan(pair[0])]


def main(config: Config) -> dict[str, Any]:
    """Run, print, write; return what is written."""
    rows, cells = {}, []
    for folder in config.sequences:
        sequence = read_sequence(folder)
        for way in WAYS:
            runs, compared = [], []
            for seed in range(config.tracking.seed, config.tracking.seed + config.seeds):
                run, pairs = follow(config, sequence, way, seed)
                runs.append(run)
                compared += pairs
            row = over_seeds(runs)
            row["rank_correlation"] = median(pair[0] for pair in compared) if compared else math.nan
            row["same_best"] = median(pair[1] for pair in compared) if compared else math.nan
            rows.setdefault(sequence.name, {})[way] = row
            error, nearest = row["root_aligned_mm"], row["root_aligned_best_of_modes_mm"]
            cells.append([
                f"{sequence.name}: {way}", f"{row['lost']} of {row['seeds']}",
                *(f"{middle:.0f} ({least:.0f} to {most:.0f})"
                  for middle, least, most in (error, nearest)),
                row["rank_correlation"], row["same_best"], row["search_s_per_frame"][0],
            ])  # fmt: skip
    columns = (
        *("sequence: hypotheses", "lost", "best mode, mm", "best of modes, mm"),
        *("rank correlation", "same best", "search, s/frame"),
    )
    table = Table("How hypotheses are scored and laid out", columns, cells)
    table.print()
    report = {"frames": config.frames, "seeds": config.seeds, "by_sequence": rows}
    write_report(config.out, report, table)
    return report


if __name__ == "__main__":
    start(main, Config, __doc__)
