"""What the parts of the default tracker are worth: errors without each, paired over many clips.

    python scripts/ablation.py --data clips --frames 30 --seeds 3 --out ablation.json

The clips are folders as `scripts/evaluate_posterior.py` takes them. Every row tracks all of them
with one part less, or one more or exchanged, and is compared with the first row, the default, clip
by clip. After an error stands its difference from the default with the standard error of the mean
over the clips: a difference below twice that is none. With several seeds each figure of each clip
is judged as well, seeds in pairs: those that are worse or better by two standard errors after
Holm's correction are printed. Runs are kept in `--runs`, a folder for each
row, and those that are there already are not made again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import evaluate_posterior as posterior
import numpy as np
from common import Table, start, write_report

from torchcss import Settings
from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.tracking.presets import PRESETS
from torchcss.types import frozen

DEFAULT = "the default"
KEYPOINTS = (
    *("joints", "stabiliser", "anthropometric", "pose_prior", "interpenetration"),
    "temporal_mixture",
)
ROWS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    **{
        f"without {name.replace('_', ' ')}": {"without": name}
        for name in (
            *("contour", "motion_boundaries", "region", "segmentation", "flow"),
            *("pose_prior", "interpenetration", "stabiliser"),
        )
    },
    "keypoints and priors alone": {"terms": KEYPOINTS},
    "without halving": {"preset": "css, all descend"},
    "with background": {"with": "background"},
    "with silhouette": {"with": "silhouette"},
    "likelihood power 0.2": {"likelihood_power": 0.2},
    "likelihood power 1": {"likelihood_power": 1.0},
}
"""What is tracked otherwise: settings, or a term that is left out or added."""

PRESETS["css, all descend"] = replace(PRESETS["css"], survivors_arm=0, survivors_body=0)

TWO_ERRORS = math.erfc(math.sqrt(2))
"""Chance of a normal number beyond two standard deviations."""

ERRORS = ("PA", "best PA", "root", "best root")
OTHERS = ("NLL", "lost", "s")


@frozen
class Config:
    """Which clips, and which rows."""

    data: Path
    """Folder of the clips, or of one."""
    rows: tuple[str, ...] = tuple(ROWS)
    """Rows of the table; the default is tracked in any case."""
    runs: Path = Path("ablation-runs")
    """Folder of the runs."""
    seeds: int = 3
    """Number of seeds, from --seed on."""
    frames: int | None = None
    """Only the first frames of each clip."""
    deviation: float | None = None
    """Standard deviation of the references, metres; see `scripts/evaluate_posterior.py`."""
    tracking: SettingsOptions = posterior.TRACKING
    """How to track, where the row does not say it."""
    out: Path | None = None
    """JSON file to write."""


def settings_of(row: str, base: Settings) -> Settings:
    """How a row is tracked."""
    varied = dict(ROWS[row])
    if name := varied.pop("without", None):
        varied["terms"] = tuple(term for term in base.used_terms if term != name)
    if name := varied.pop("with", None):
        varied["terms"] = (*base.used_terms, name)
    return replace(base, **varied)


def main(config: Config) -> dict[str, Any]:
    """Track, measure, print, write; return what is written."""
    if unknown := sorted(set(config.rows) - set(ROWS)):
        raise ConfigurationError(f"no rows {unknown}; there are {', '.join(ROWS)}")
    clips = posterior.find_clips(config.data)
    seeds = range(config.tracking.seed, config.tracking.seed + config.seeds)
    measured: dict[str, list[dict[str, Any]]] = {}
    cells: list[list[Any]] = []
    report: dict[str, Any] = {}
    told: dict[str, list[str]] = {}
    for name in dict.fromkeys((DEFAULT, *config.rows)):
        own = posterior.Config(
            data=config.data, runs=config.runs / name.replace(" ", "-"), smooth=False,
            frames=config.frames, deviation=config.deviation,
            tracking=settings_of(name, config.tracking),
        )  # fmt: skip
        measured[name] = [posterior.measure(own, clip, seed) for clip in clips for seed in seeds]
        cells.append([name, *row_of(measured[name], measured[DEFAULT], config.seeds)])
        head = ("tracked", *ERRORS, "cal.", *OTHERS)
        table = Table(f"{len(clips)} clips, {config.seeds} seeds", head, cells)
        table.print()
        told[name] = judged(measured[name], measured[DEFAULT])
        print(f"{name}: {', '.join(told[name]) or 'no figure of a clip differs'}")
        report = {"settings": asdict(config.tracking), "rows": measured, "judged": told}
        write_report(config.out, report, table)
    return report


def judged(rows: Sequence[dict[str, Any]], default: Sequence[dict[str, Any]]) -> list[str]:
    """Figures of clips that differ from the default's by two standard errors, as Holm counts.

    Args:
        rows: Runs of all clips and seeds.
        default: The same runs of the default.
    """
    found: list[tuple[float, str]] = []
    for clip in dict.fromkeys(row["clip"] for row in rows):
        for name in ERRORS:
            pairs = [(a[name], b[name]) for a, b in zip(rows, default, strict=True)
                     if a["clip"] == clip]  # fmt: skip
            apart = np.subtract(*np.transpose(pairs))
            if len(apart) < 2 or not apart.any():
                found.append((1.0, ""))
                continue
            error = np.std(apart, ddof=1) / math.sqrt(len(apart))
            chance = math.erfc(abs(apart.mean()) / max(error, 1e-12) / math.sqrt(2))
            found.append((chance, f"{clip} {name} {apart.mean():+.1f} ± {error:.1f}"))
    kept: list[str] = []
    for place, (chance, words) in enumerate(sorted(found)):
        if chance * (len(found) - place) > TWO_ERRORS:
            break
        kept.append(words)
    return kept


def row_of(
    rows: Sequence[dict[str, Any]], default: Sequence[dict[str, Any]], seeds: int
) -> list[Any]:
    """A row of the table: means, and differences from the default with their standard errors."""
    found: list[Any] = []
    for name in ERRORS:
        # Seeds of a clip are no independent clips.
        own, other = (
            np.array([row[name] for row in each]).reshape(-1, seeds).mean(1)
            for each in (rows, default)
        )
        text = f"{own.mean():.1f}"
        if rows is not default:
            error = np.std(own - other, ddof=1) / math.sqrt(len(own)) if len(own) > 1 else math.nan
            text += f" ({(own - other).mean():+.1f} ± {error:.1f})"
        found.append(text)
    pooled = {
        level: float(np.mean([row["inside"][level] for row in rows])) for level in posterior.LEVELS
    }
    others = (posterior.summed([row[name] for row in rows], np.mean) for name in OTHERS)
    return [*found, posterior.miss(pooled), *others]


if __name__ == "__main__":
    start(main, Config, __doc__)
