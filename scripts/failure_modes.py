"""The failure modes of trackers: section 6 of [IJRR] on a sequence whose truth is known.

    python scripts/failure_modes.py --sequence DIR --seeds 3 --stop-when-lost --out J --plot P.png

DIR is a sequence folder (`torchcss.studies.sequences`). Every preset starts from the same first
pose per seed and gets one row: when it loses the body, its errors until then, whether the true mode
is among those kept, how often the truth is inside the regions that it states, impossible poses, and
what it takes. Definitions are in `torchcss.studies.evaluation`. Beside ours stand the paper's own
failure times, which were measured on its sequences. A second table has the weight of the modes that
are another explanation than the best one, over time: over the whole sequence without
`--stop-when-lost`.

The trackers of a seed run side by side through the video and share its features; `--together 6`
puts six runs side by side, of several seeds where a seed has fewer. The file OUT is written
whenever a run ends, and `--resume` goes on from it: what it has is not repeated. A study that is
interrupted loses the runs that were under way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from common import Table, start, write_report
from common.comparison import TRACKING, body_of
from peers.published import PUBLISHED
from tqdm import tqdm

from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.io.tracks import read_summary
from torchcss.show.style import save_figure
from torchcss.studies.comparison import Start, TrackerRun, find_start, track_together
from torchcss.studies.evaluation import Thresholds, compared_joints, over_seeds, summarise
from torchcss.studies.metrics import spread
from torchcss.studies.plots import error_curves, failure_figure
from torchcss.studies.sequences import RecordedSequence, read_sequence
from torchcss.tracking.presets import PRESETS, preset_name
from torchcss.tracking.settings import Settings
from torchcss.types import frozen

COLUMNS = {
    # title: entry, factor
    "limb at s": ("limb_lost_s", 1),
    "of K at s": ("limb_lost_of_modes_s", 1),
    "best mm": ("root_aligned_mm", 1),
    "of K mm": ("root_aligned_best_of_modes_mm", 1),
    "PA mm": ("pa_mpjpe_mm", 1),
    "overlap": ("overlap", 1),
    "kept %": ("true_mode_kept", 100),
    "in 90 %": ("inside_90_best", 100),
    "nearest": ("inside_90_nearest", 100),
    "limits %": ("outside_share", 100),
    "deep %": ("deep_share", 100),
    "of K %": ("deep_modes_share", 100),
    "m/s^2": ("acceleration_error", 1),
    "evals": ("evaluations_per_frame", 1),
    "s/frame": ("search_s_per_frame", 1),
}
"""What the table has: until the loss, the last two over all frames."""
STEP_S = 0.5
"""Over how long weights are averaged, seconds."""


@frozen
class Config:
    """What is tracked, by whom, and how long."""

    sequence: Path
    """Sequence folder."""
    view: str | None = None
    """Camera, of a sequence with several."""
    tracked_as: str | None = None
    """Body that tracks, if other than that which moved: `arm7`, the arm of [RR], for one of 8."""
    presets: tuple[str, ...] = tuple(PRESETS)
    """Trackers."""
    seeds: int = 3
    """Runs per tracker."""
    tracking: SettingsOptions = TRACKING
    """How to track. The seed is the first of the seeds; the body counts where the sequence does not
    say which one moved; the trackers are those of --presets."""
    start: int = 0
    """First frame."""
    frames: int | None = None
    """Number of frames; all by default."""
    stop_when_lost: bool = False
    """End a run when the body is lost for good."""
    together: int | None = None
    """How many runs go side by side, of several seeds too; all of one seed by default."""
    small: bool = False
    """Four frames with few samples and small images, to see that it runs."""
    out: Path | None = None
    """JSON file to write."""
    resume: bool = False
    """Keep the runs that OUT has."""
    plot: Path | None = None
    """PNG file of error against time."""


def main(config: Config) -> dict[str, Any]:
    """Run, print, draw, write; return what is written."""
    config = replace(config, presets=tuple(map(preset_name, config.presets)))
    if config.together is not None and config.together < 1:
        raise ConfigurationError(f"--together: expected at least 1, got {config.together}")
    sequence = read_sequence(config.sequence, view=config.view)
    thresholds = Thresholds.of(sequence)
    study = study_of(config, sequence, thresholds)
    runs = earlier_runs(config, study)
    done = {(run["preset"], run["seed"]) for run in runs}
    report = write(config, study, runs)
    starts: dict[int, Start] = {}
    for group in groups_of(config, done):
        settings = [settings_of(config, study["body"], name, seed) for name, seed in group]
        for each in settings:
            if each.seed not in starts:
                starts[each.seed] = find_start(sequence, each, start=config.start)
        together = [(each, starts[each.seed]) for each in settings]
        for run in follow(config, sequence, together, thresholds):
            body = together[run.number][1].first.body
            entry = entry_of(run, thresholds, 1 / sequence.frame_rate)
            runs.append(entry | {"joints": compared_joints(sequence, body)})
            report = write(config, study, runs)
    trackers_table(report["by_tracker"], sequence.name).print()
    weights_table(report["apart_weight"]).print()
    if config.plot is not None and report["by_tracker"]:
        told = {row.preset: row.times_s for row in report["published"]}
        order = [name for name in PRESETS if name in config.presets]
        shown = [run for name in order for run in runs if run["preset"] == name]
        times, curves = error_curves(shown, told)
        title = f"{sequence.name}; dotted: frames with a greater error have failed"
        figure = failure_figure(times, curves, title=title, failed_mm=thresholds.lost_mm)
        save_figure(figure, config.plot)
    return report


def groups_of(config: Config, done: set[tuple[str, int]]) -> Iterator[list[tuple[str, int]]]:
    """Presets and seeds that are still to be run, in groups that run side by side."""
    seeds = range(config.tracking.seed, config.tracking.seed + config.seeds)
    of_seeds = [[(name, seed) for name in config.presets] for seed in seeds]
    groups = [[run for run in group if run not in done] for group in of_seeds]
    if config.together is not None:
        pending = [run for group in groups for run in group]
        starts = range(0, len(pending), config.together)
        groups = [pending[start : start + config.together] for start in starts]
    yield from (group for group in groups if group)


def study_of(config: Config, sequence: RecordedSequence, thresholds: Thresholds) -> dict[str, Any]:
    """What all runs of a file have in common."""
    shared = ("start", "frames", "stop_when_lost", "small")
    tracked = {k: v for k, v in asdict(config.tracking).items() if k not in ("seed", "preset")}
    return {
        "sequence": sequence.name,
        "num_frames": sequence.num_frames,
        "frame_rate": sequence.frame_rate,
        "body": config.tracked_as or body_of(config.tracking, sequence),
        "thresholds": asdict(thresholds),
        "settings": {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in tracked.items()
        },
        **{name: getattr(config, name) for name in shared},
    }


def earlier_runs(config: Config, study: dict[str, Any]) -> list[dict[str, Any]]:
    """The runs of a study that was stopped."""
    if not config.resume:
        return []
    if config.out is None:
        raise ConfigurationError("--resume: expected --out, the file to resume from")
    if not config.out.exists():
        return []
    report = read_summary(config.out)
    if report.get("study") != study:
        raise ConfigurationError(
            f"{config.out}: is of another study: expected {study}, found {report.get('study')}; "
            "choose another --out"
        )
    return report["runs"]


def write(config: Config, study: dict[str, Any], runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Make the table of all trackers so far, and write what there is."""
    table, weights = {}, {}
    for name in PRESETS:
        own = [run for run in runs if run["preset"] == name]
        if measured := [run for run in own if "num_frames" in run]:
            errors = sum(run["ended"].startswith("error") for run in own)
            table[name] = {**over_seeds(measured), "errors": errors}
            weights[name] = weight_over_time([run["per_frame"] for run in measured])
    published = [row for row in PUBLISHED if row.sequence == study["sequence"]]
    report = {
        "study": study, "published": published, "runs": runs, "by_tracker": table,
        "apart_weight": weights,
    }  # fmt: skip
    write_report(config.out, report, trackers_table(table, study["sequence"]))
    return report


def trackers_table(by_tracker: dict[str, dict[str, Any]], sequence: str) -> Table:
    """The medians, and the paper's words on the time of failure."""
    told = {row.preset: row.told for row in PUBLISHED if row.sequence == sequence}
    cells = []
    for name, row in by_tracker.items():
        middle, least, most = (f"{t:.1f}" if math.isfinite(t) else "-" for t in row["lost_s"])
        when = f"{middle} ({least}..{most})" if row["lost"] else "never"
        values = (factor * row.get(key, [math.nan])[0] for key, factor in COLUMNS.values())
        shown = ("never" if math.isinf(value) else value for value in values)
        lost = f"{row['lost']} of {row['seeds']}"
        cells.append([name, lost, row["errors"], when, told.get(name), *shown])
    columns = ("tracker", "lost", "errors", "lost at s", "paper", *COLUMNS)
    return Table(f"Trackers on {sequence}, medians over seeds", columns, cells)


def weight_over_time(frames: list[dict[str, Any]]) -> dict[str, list[tuple[float, float, float]]]:
    """Weight of other explanations: median, least and most over the seeds, by `STEP_S`."""
    steps = [np.array(run["time_s"]) // STEP_S for run in frames]
    weights = [np.array(run["apart_weight"], np.float64) for run in frames]
    count = int(max(step[-1] for step in steps)) + 1

    def during(i: int) -> list[float]:
        pairs = zip(steps, weights, strict=True)
        return [float(weight[step == i].mean()) for step, weight in pairs if (step == i).any()]

    whole = spread([float(weight.mean()) for weight in weights])
    return {"whole": [whole], "by_step": [spread(during(i)) for i in range(count)]}


def weights_table(weights: dict[str, dict[str, list[tuple[float, float, float]]]]) -> Table:
    """Medians over time of the trackers that have several modes."""
    several = {name: row for name, row in weights.items() if row["whole"][0][2] > 0}
    count = max((len(row["by_step"]) for row in several.values()), default=0)
    cells = []
    for name, row in several.items():
        steps = [step[0] for step in row["by_step"]]
        cells.append([name, row["whole"][0][0], *steps, *[None] * (count - len(steps))])
    columns = ("tracker", "all", *(f"from {STEP_S * i:g} s" for i in range(count)))
    return Table("Weight of other explanations, 3 cm from the best mode", columns, cells)


def settings_of(config: Config, body: str, preset: str, seed: int) -> Settings:
    """How one tracker runs."""
    settings = replace(config.tracking, body=body, preset=preset, seed=seed)
    if not config.small:
        return settings
    return replace(settings, samples=min(PRESETS[preset].samples_arm, 6), working_size=320)


def follow(
    config: Config,
    sequence: RecordedSequence,
    together: list[tuple[Settings, Start]],
    thresholds: Thresholds,
) -> Iterator[TrackerRun]:
    """Run some trackers side by side, with a progress bar."""
    frames = 4 if config.small else config.frames or sequence.num_frames
    stop = min(config.start + frames, sequence.num_frames)
    seeds = ",".join(str(seed) for seed in sorted({each.seed for each, _ in together}))
    with tqdm(total=stop - config.start, unit="frame", dynamic_ncols=True) as bar:

        def progress(_: int, left: int) -> None:
            bar.set_postfix(seeds=seeds, trackers=left)
            bar.update()

        yield from track_together(
            sequence, together, thresholds, start=config.start, stop=stop,
            stop_when_lost=config.stop_when_lost, progress=progress,
        )  # fmt: skip


def entry_of(run: TrackerRun, thresholds: Thresholds, interval_s: float) -> dict[str, Any]:
    """A run as it is written."""
    entry = {"preset": run.settings.preset, "seed": run.settings.seed, "ended": run.ended}
    return entry | summarise(run.measures, thresholds, interval_s) if run.measures else entry


if __name__ == "__main__":
    start(main, Config, __doc__)
