"""Errors with the terms of the cost switched on one by one, as a table and as JSON.

    python scripts/ablation.py --data DIR --out ablation.json

The demo (seeds 0 to 2), and, with `--data`, the clips of DIR/balance_beam_4cam from either camera,
with keypoints in all frames and in the first frame only. Every row tracks with the terms of the row
before it and one more, or with one exchanged; the demo's arm has neither segmentation nor
background nor silhouette. A clip with reference is measured as `scripts/evaluate_track.py` does;
the demo against its own truth.
"""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import Table, start, write_report

from torchcss.app.track import track_video
from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.studies.demo import run_demo
from torchcss.studies.evaluation import evaluate
from torchcss.tracking.settings import Settings

BASE = ("joints", "stabiliser", "temporal_mixture")
EDGES = ("contour", *BASE)
BOUNDARIES = ("motion_boundaries", *EDGES)
FLOW = ("flow", *BOUNDARIES)
BODY = ("interpenetration", *FLOW)
REGION = ("region", *BODY)
SEGMENTATION = ("segmentation", *REGION)
POSES = ("pose_prior", *SEGMENTATION)
ROWS = {
    "joints and priors only": BASE,
    "+ contour": EDGES,
    "+ motion boundaries": BOUNDARIES,
    "+ flow": FLOW,
    "+ interpenetration": BODY,
    "+ region": REGION,
    "+ segmentation": SEGMENTATION,
    "+ pose prior": POSES,
    "+ background": ("background", *POSES),
    "+ silhouette": ("silhouette", "background", *POSES),
    "+ edge energy": ("edge_energy", *POSES),
    "parent mode for mixture": (
        "temporal",
        *(name for name in POSES if name != "temporal_mixture"),
    ),
    "contour + flow": ("flow", *EDGES),
    "contour + interpenetration": ("interpenetration", *EDGES),
    "edge energy for contour": ("edge_energy", *BASE),
}
SEQUENCES = ("demo", "cam01:all", "cam03:all", "cam01:first", "cam03:first")
SMALL_SAMPLES = 8
TRACKING = Settings(overlay=False)
"""How this script tracks, where nothing else is said."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """What is tracked, and with which rows of the table."""

    data: Path | None = None
    """Folder that holds balance_beam_4cam; without it only the demo runs."""
    sequences: tuple[str, ...] = SEQUENCES
    """"demo", or a camera of the clip and where keypoints are used."""
    rows: tuple[str, ...] = tuple(ROWS)
    """Rows of the table."""
    seeds: int = 3
    """Seeds of the demo."""
    frames: int = 50
    """Frames of the demo."""
    clip_frames: int = 100
    """Frames of the clips."""
    tracking: SettingsOptions = TRACKING
    """How to track. The seed is the first of the seeds; terms are those of the rows, the body is
    the demo's where that is tracked, and where keypoints are used the sequence says."""
    small: bool = False
    """Four frames of the demo, and two of a clip, with few samples, to see that it runs."""
    out: Path | None = None
    """JSON file to write."""


def main(config: Config) -> dict[str, Any]:
    """Track, print and write the table; return what is written."""
    if unknown := sorted(set(config.rows) - set(ROWS)):
        raise ConfigurationError(f"no rows {unknown}; there are {', '.join(ROWS)}")
    if unknown := sorted(set(config.sequences) - set(SEQUENCES)):
        raise ConfigurationError(f"no sequences {unknown}; there are {', '.join(SEQUENCES)}")
    sequences = config.sequences
    if config.data is None:
        sequences = tuple(name for name in sequences if name == "demo")
        if not sequences:
            raise ConfigurationError("sequences: the clips need --data, the folder that holds them")
    print(f"{'mean over frames, mm':28}" + "".join(f"{name:>24}" for name in sequences))
    print(f"{'':28}" + f"{'best   of K  lost  s/fr':>24}" * len(sequences))
    rows: dict[str, dict[str, Any]] = {}
    report: dict[str, Any] = {}
    for name in config.rows:
        print(f"{name:28}", end="", flush=True)
        rows[name] = {}
        for sequence in sequences:
            cell = demo(config, ROWS[name]) if sequence == "demo" else clip(config, sequence, name)
            rows[name][sequence] = cell
            print(
                f"{cell['best_mm']:9.1f}{cell['best_of_modes_mm']:7.1f}"
                f"{cell['frames_lost']:4d}{cell['seconds_per_frame']:5.1f}",
                end="",
                flush=True,
            )
        print()
        report = {
            "unit": "mm",
            "direction": "lower is better",
            "note": "demo: absolute error, its frames lost are not counted; clips: root-aligned",
            "terms": {name: ROWS[name] for name in rows},
            "rows": rows,
        }
        cells = [[n, *(cell["best_mm"] for cell in row.values())] for n, row in rows.items()]
        table = Table("Terms switched on one by one, best mode, mm", ("terms", *sequences), cells)
        write_report(config.out, report, table)
    return report


def settings_of(config: Config, **varied: Any) -> Settings:
    """How a cell is tracked."""
    settings = replace(config.tracking, **varied)
    return replace(settings, samples=SMALL_SAMPLES) if config.small else settings


def demo(config: Config, terms: tuple[str, ...]) -> dict[str, Any]:
    """Mean over seeds of the demo's errors."""
    runs = []
    first = config.tracking.seed
    for seed in range(first, first + (1 if config.small else config.seeds)):
        settings = settings_of(config, body="arm8", keypoints_use="first", terms=terms, seed=seed)
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
            runs.append(
                run_demo(
                    Path(folder), settings=settings, num_frames=4 if config.small else config.frames
                )
            )
    return {
        "best_mm": float(np.mean([run["mpjpe_mm"] for run in runs])),
        "best_of_modes_mm": float(np.mean([run["mpjpe_best_of_modes_mm"] for run in runs])),
        "best_mm_by_seed": [run["mpjpe_mm"] for run in runs],
        "frames_lost": 0,
        **_shares(runs[0]),
    }


def clip(config: Config, sequence: str, row: str) -> dict[str, Any]:
    """Errors on one view of the beam clip."""
    camera, use = sequence.split(":")
    assert config.data is not None
    folder = config.data / "balance_beam_4cam"
    settings = settings_of(
        config, terms=ROWS[row], keypoints_use="first" if use == "first" else "all"
    )
    silent = io.StringIO()
    with (
        tempfile.TemporaryDirectory() as out,
        contextlib.redirect_stderr(silent),
        contextlib.redirect_stdout(silent),
    ):
        run = track_video(
            folder / f"{camera}.mp4",
            camera=folder / "cameras.json",
            keypoints=folder / f"keypoints2d_{camera}.npz",
            out=Path(out),
            settings=settings,
            stop=2 if config.small else config.clip_frames,
        )
        found = evaluate(out, folder / "reference3d.npz")
    errors, lost = found.errors, found.frames[found.errors.lost]
    return {
        "best_mm": errors.root_aligned.mean_mm,
        "best_of_modes_mm": errors.root_aligned_best_of_modes.mean_mm,
        "procrustes_mm": errors.procrustes.mean_mm,
        "procrustes_best_of_modes_mm": errors.procrustes_best_of_modes.mean_mm,
        "frames_lost": len(lost),
        "first_frame_lost": int(lost[0]) if lost.size else None,
        **_shares(run.summary),
    }


def _shares(summary: Mapping[str, Any]) -> dict[str, Any]:
    names = ("seconds_per_frame", "share_of_cost_by_term", "share_of_search_time_by_term")
    return {name: summary[name] for name in names}


if __name__ == "__main__":
    start(main, Config, __doc__)
