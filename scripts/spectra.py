"""Spectra of the image's cost: how uncertain a mode is along its eigen-directions (Fig. 5 [IJRR]).

    python scripts/spectra.py --sequences ARM CLUTTER --frames 30 --out spectra.json

Each sequence folder is tracked by the paper's sampler with the paper's cost, edges and motion
boundaries and flow, keypoints in the first frame alone. Of the best mode of every frame the inverse
Hessian is taken on the parameters that no limit holds, with no cap on its width:

| column | meaning |
|---|---|
| largest over smallest | deviation along the widest eigen-direction over the narrowest's |
| volume | the ball of the widest deviation over the ellipsoid, power of 10 |
| floored | share of the frames in which some mode's Hessian was given a least curvature |

Numbers are medians over the frames, then over the seeds. `scripts/table1.py` has the spectra of a
cost of joints alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import torch
from common import Table, start, write_report
from jaxtyping import Float
from torch import Tensor

from torchcss import Settings
from torchcss.cli.options import SettingsOptions
from torchcss.io.video import VideoReader
from torchcss.studies.comparison import find_start, session_of
from torchcss.studies.sampling_study import spectrum
from torchcss.studies.sequences import RecordedSequence, read_sequence

TRACKING = Settings(preset="ijrr_css", overlay=False)


@dataclass(frozen=True, kw_only=True)
class Config:
    """What is tracked, and how long."""

    sequences: tuple[Path, ...]
    """Sequence folders."""
    frames: int = 30
    """Frames of each."""
    seeds: int = 3
    """Runs of each."""
    tracking: SettingsOptions = TRACKING
    """How to track. The seed is the first of the seeds; the body counts where the sequence does not
    say which one moved."""
    out: Path | None = None
    """JSON file to write."""


class Spread(NamedTuple):
    """How unlike the deviations of a mode are.

    Attributes:
        ratio: Largest over smallest.
        volume: Power of ten of the ball of the largest over the ellipsoid.
    """

    ratio: float
    volume: float


def spread_of(covariance: Float[Tensor, "n n"]) -> Spread:
    """Of a covariance whose held parameters have no width."""
    free = torch.nonzero(covariance.diagonal() > 0)[:, 0]
    deviation = spectrum(covariance[free][:, free])
    logs = (deviation[0] / deviation).log10()
    return Spread(float(deviation[0] / deviation[-1]), float(logs.sum()))


def track(sequence: RecordedSequence, settings: Settings, frames: int) -> dict[str, Any]:
    """The medians over the frames of one run."""
    session = session_of(sequence, settings, find_start(sequence, settings))
    spreads, floored = [], []
    for tracked in session.track(VideoReader(sequence.video, stop=frames)):
        spreads.append(spread_of(tracked.state.mixture.covariance[0].double().cpu()))
        floored.append(float(tracked.info.num_floored > 0))
    ratio, volume = (median(values) for values in zip(*spreads, strict=True))
    return {
        "seed": settings.seed, "ratio": ratio, "volume": volume, "body": session.state.body.name,
        "floored": sum(floored) / len(floored), "ratio_by_frame": [each.ratio for each in spreads],
    }  # fmt: skip


def main(config: Config) -> dict[str, Any]:
    """Track, print, write; return what is written."""
    found: dict[str, list[dict[str, Any]]] = {}
    cells = []
    for folder in config.sequences:
        sequence = read_sequence(folder)
        own = config.tracking.body if sequence.truth is None else sequence.truth.body.name
        found[sequence.name] = runs = []
        for seed in range(config.tracking.seed, config.tracking.seed + config.seeds):
            runs.append(
                track(sequence, replace(config.tracking, body=own, seed=seed), config.frames)
            )
        numbers = [median(run[name] for run in runs) for name in ("ratio", "volume", "floored")]
        cells.append([f"{sequence.name}, {own}", *numbers])
    columns = ("sequence, body", "largest over smallest", "volume, power of 10", "floored")
    table = Table("Spectra of the image's cost", columns, cells)
    table.print()
    report = {"frames": config.frames, "by_sequence": found}
    write_report(config.out, report, table)
    return report


if __name__ == "__main__":
    start(main, Config, __doc__)
