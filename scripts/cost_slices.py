"""Slices through the cost of a frame, by terms: how many minima, how continuous (Fig. 4, 7, 8).

    python scripts/cost_slices.py --sequence CLUTTER --data DIR --out out/slices

The cost is that of a preset, by default the one printed in [IJRR]. The frames are one of the
rendered arm before clutter; with `--sequence`, those of a rendered sequence at 0.8 and 0.9 s, where
both papers have two minima; with `--data`, one of DIR/balance_beam_4cam. Lines go through the mode
at which the optimiser arrives from the truth (for the clip, from the fit to the keypoints that is
nearest the 3D reference), along joints and along eigenvectors of its covariance, close (a few
standard deviations) and as far as the joint limits admit. How minima and jumps are
counted is in `torchcss.studies.slices`.

Printed and written to the folder `--out`: a table by terms, the slices as figures, and, as Fig. 4
[IJRR], a minimum that a joint limit displaced. `scripts/cost_minima.py` goes on from here: what
makes minima fewer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import Table, start, write_report
from matplotlib.artist import Artist
from matplotlib.figure import Figure

from torchcss.body.root import ROOT_NAMES
from torchcss.files import prepare_output_folder
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.show.style import OKABE_ITO, save_figure
from torchcss.studies import plots
from torchcss.studies.scenes import Scene, arm_scenes, sequence_scenes
from torchcss.studies.sequences import read_sequence
from torchcss.studies.slices import PROMINENCE, Slice, StateLine, sample_slice
from torchcss.tracking.settings import Settings
from torchcss.types import frozen

# Of a body the lines that are looked at; of an arm all of them are.
ON_BODY = (
    *("root_x", "root_y", "root_z", "root_yaw", "lumbar_flexion", "neck_flexion"),
    *("r_shoulder_swing", "r_shoulder_raising", "r_shoulder_twist", "r_elbow_flexion"),
    *("l_shoulder_swing", "l_elbow_flexion", "r_hip_flexion", "r_hip_abduction"),
    *("r_knee_flexion", "l_knee_flexion", "eigen 0", "eigen 1", "eigen 2", "eigen 3", "eigen 33"),
)
DRAWN = ("root_z", "r_shoulder_swing", "r_elbow_flexion", "r_knee_flexion", "eigen 0", "eigen 1")
DRAWN += ("eigen 7", "eigen 33")  # the most certain of arm8 and body34
LEAST_CERTAIN = ("eigen 0", "eigen 1", "eigen 2")
NEAR = 0.35  # radians or metres to either side of a limit


@frozen
class Config:
    """Which frames, and how their slices are sampled."""

    data: Path | None = None
    """Folder that holds balance_beam_4cam; without it only the arm is looked at."""
    sequence: Path | None = None
    """Folder of a rendered body before clutter; without it none is looked at."""
    times: tuple[float, ...] = (0.8, 0.9)
    """Seconds of that, as in Fig. 7 [IJRR] and Fig. 5 [RR]."""
    frame: int = 15
    """Frame of the arm's sequence."""
    clip_frame: int = 30
    """Frame of the clip."""
    view: str = "cam01"
    """Camera of the clip."""
    seed: int = 0
    """Seed of the arm's room and of starting poses."""
    samples: int = 401
    """Samples of a slice; jumps are also measured at twice the density."""
    deviations: float = 4.0
    """Half length of a close slice, standard deviations."""
    prominence: float = PROMINENCE
    """Least prominence of a minimum that counts, share of the slice's range."""
    preset: str = "ijrr_css"
    """Whose cost it is."""
    terms: tuple[str, ...] | None = None
    """Terms of the cost, see `torchcss.tracking.settings.all_terms`; the preset's by default."""
    small: bool = False
    """The arm alone, few lines and samples: for tests."""
    out: Path | None = None
    """Folder for cost_slices.json and the figures."""
    report: Path | None = None
    """Where else to write the JSON file, such as docs/results/cost_slices.json."""


def main(config: Config) -> dict[str, Any]:
    """Look at the frames, print, draw; return what is written."""
    if config.small:
        config = replace(config, data=None, sequence=None, frame=3, samples=51)
    if config.out is not None:
        prepare_output_folder(config.out)
    report: dict[str, Any] = {"settings": config, "frames": {}}
    for scene in scenes(config):
        rows = look(scene, config)
        table = summarise(rows)
        terms_table(scene.name, table, len(rows)).print()
        report["frames"][scene.name] = {"table": table, "slices": rows}
        report["frames"][scene.name]["displaced_minimum"] = displaced_minimum(scene, config)
    table = table_of(report["frames"])
    if config.out is not None:
        write_report(config.out / "cost_slices.json", report, table)
    write_report(config.report, report, table)
    return report


def scenes(config: Config) -> Iterator[Scene]:
    generator = torch.Generator().manual_seed(config.seed)
    settings = Settings(body="arm8", preset=config.preset, terms=config.terms)
    yield from arm_scenes([config.frame], generator=generator, settings=settings)
    settings = replace(settings, body="body34")
    if config.sequence is not None:
        sequence = read_sequence(config.sequence)
        frames = [round(time * sequence.frame_rate) for time in config.times]
        yield from sequence_scenes(sequence, frames, generator=generator, settings=settings)
    if config.data is not None:
        clip = read_sequence(config.data / "balance_beam_4cam", view=config.view)
        yield from sequence_scenes(
            clip._replace(name=config.view), [config.clip_frame], generator=generator,
            settings=settings,
        )  # fmt: skip


def look(scene: Scene, config: Config) -> list[dict[str, Any]]:
    """Slices through the mode, described and drawn."""
    mode = scene.mode.mean
    limits, lines, rows, drawn = scene.limits(mode), scene.lines(mode), [], []
    chosen = [line.name for line in lines] if scene.cost.body.name == "arm8" else ON_BODY
    for line in lines:
        if line.name not in (DRAWN if config.small else chosen):
            continue
        pair = []
        for scale, reach in (("close", config.deviations * line.deviation), ("far", math.inf)):
            interval = line.interval(limits, reach)
            taken = sample_slice(scene.cost.terms, line, interval, config.samples)
            terms = {name: taken.report(name, config.prominence)._asdict() for name in taken.values}
            row = {"line": line.name, "deviation": line.deviation, "interval": interval}
            rows.append({**row, "scale": scale, "terms": terms})
            pair.append((taken, plots.unit_of(line, close=scale == "close")))
        if line.name in DRAWN:
            drawn.append(pair)
    if config.out is not None:
        title = f"Cost of {scene.name}, by terms"
        figure = slices_figure(drawn, title, config.prominence)
        save_figure(figure, config.out / f"slices_{scene.slug}.png")
    return rows


def summarise(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mean counts and worst jumps over all lines, by term and scale."""
    table = []
    for name in rows[0]["terms"]:
        for scale in ("close", "far"):
            found = [(row["terms"][name], row["line"]) for row in rows if row["scale"] == scale]
            entry: dict[str, Any] = {"term": name, "scale": scale}
            for key in ("num_minima_raw", "num_minima"):
                entry[key] = float(np.mean([report[key] for report, _ in found]))
            for key in ("largest_jump", "largest_jump_twice_density", "discontinuity"):
                entry[key], entry[f"{key}_on"] = max((report[key], line) for report, line in found)
            table.append(entry)
    return table


def table_of(frames: dict[str, Any]) -> Table:
    """Minima of the whole cost on all lines of a frame, and on the least certain ones."""
    cells = []
    for name, frame in frames.items():
        of_all = {row["scale"]: row for row in frame["table"] if row["term"] == "sum"}
        cells.append([f"{name}, mean of all lines", *_counts(of_all)])
        for line in LEAST_CERTAIN:
            own = [row for row in frame["slices"] if row["line"] == line]
            if own:
                counts = _counts({row["scale"]: row["terms"]["sum"] for row in own})
                cells.append([f"{name}, {line}", *counts])
    columns = ("frame, line", "close: all", "counted", "far: all", "counted", "largest jump %")
    return Table("Minima and jumps of the cost along lines", columns, cells)


def _counts(by_scale: dict[str, Any]) -> list[float]:
    """Minima close to the mode and as far as the limits, and the largest jump."""
    close, far = by_scale["close"], by_scale["far"]
    minima = [row[key] for row in (close, far) for key in ("num_minima_raw", "num_minima")]
    return [*minima, 100 * max(row["discontinuity"] for row in (close, far))]


def terms_table(name: str, entries: list[dict[str, Any]], num_slices: int) -> Table:
    """Minima per slice, and the largest jump on any slice in % of its range, term by term."""
    keys = ("largest_jump", "largest_jump_twice_density", "discontinuity")
    rows = [
        [
            f"{entry['term']}, {entry['scale']}",
            entry["num_minima_raw"],
            entry["num_minima"],
            *(100 * entry[key] for key in keys),
            entry["discontinuity_on"],
        ]
        for entry in entries
    ]
    columns = ("term", "all minima", "counted", "jump %", "2 x density", "bisected", "on")
    return Table(f"\n{name}: {num_slices // 2} lines, close and far", columns, rows)


def displaced_minimum(scene: Scene, config: Config) -> dict[str, Any] | None:
    """The mode that presses hardest against a joint limit: Fig. 4 (a) [IJRR].

    It is searched from the frame's mode with one joint after the other put at its limits. The
    root's are no joint's.
    """
    cost, (lower, upper) = scene.cost, scene.cost.body.bounds
    at_limit = [torch.diag_embed(limit) for limit in (lower, upper)]
    joints = torch.tensor([name not in ROOT_NAMES for name in cost.body.state_names])
    mask = torch.diag_embed(joints)
    starts = torch.cat([torch.where(mask, limit, scene.mode.mean)[joints] for limit in at_limit])
    starts = starts[starts.isfinite().all(dim=1)]
    modes = TrustRegionNewton(max_steps=40).minimise(cost, starts, cost.body.bounds)
    model = cost.local_model(modes.mean)
    slope = torch.where(modes.active.bool() & joints, model.gradient, 0.0)
    mode, joint = divmod(int(slope.abs().argmax()), slope.shape[1])
    if float(slope[mode, joint]) == 0:
        return None
    name = cost.body.state_names[joint]
    line = StateLine(name, modes.mean[mode], torch.eye(slope.shape[1]).to(slope)[joint], 1.0)
    low, high = line.interval(scene.limits(line.centre))
    shown = (max(low, -NEAR), NEAR) if high < -low else (-NEAR, min(high, NEAR))
    taken = sample_slice(cost.terms, line, shown, config.samples)
    expansion = float(slope[mode, joint]), float(model.hessian[mode, joint, joint])
    if config.out is not None:
        title = f"{scene.name}: a minimum displaced by the limit of {plots.title_of(line)}"
        figure = limit_figure(taken, plots.unit_of(line), (low, high), expansion, title)
        save_figure(figure, config.out / f"limit_{scene.slug}.png")
    return {"line": name, "slope_nats_per_radian": expansion[0], "cost_nats": modes.cost[mode]}


def slices_figure(
    rows: Sequence[tuple[tuple[Slice, plots.Unit], tuple[Slice, plots.Unit]]],
    title: str,
    prominence: float,
) -> Figure:
    """One row per line: a small slice on the left, a large one on the right.

    Args:
        rows: The slices and how to show them.
        title: What the whole figure shows.
        prominence: See `draw_slice`.
    """
    figure = Figure(figsize=(9.0, 0.9 + 1.9 * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), 2, squeeze=False)
    for axes_row, row in zip(grid, rows, strict=True):
        for axes, (sampled, unit) in zip(axes_row, row, strict=True):
            plots.draw_slice(axes, sampled, unit, prominence=prominence)
        axes_row[0].set_ylabel("cost above that\nat the mode (nats)", fontsize=9)
        for axes, scale in zip(axes_row, ("close", "as far as the limits admit"), strict=True):
            axes.set_title(f"{plots.title_of(row[0][0].line)}, {scale}", fontsize=10)
    entries: dict[str, Artist] = {}
    for axes in grid.flat:
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    entries = {"sum": entries.pop("sum"), **entries}
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=len(entries),
        frameon=False, fontsize=9,
    )  # fmt: skip
    figure.suptitle(
        f"{title}\ndotted: the mode; circles: minima of the sum with a prominence above "
        f"{100 * prominence:g} % of its range",
        fontsize=10,
    )
    return figure


def limit_figure(
    sampled: Slice,
    unit: plots.Unit,
    admissible: tuple[float, float],
    expansion: tuple[float, float],
    title: str,
) -> Figure:
    """A minimum displaced by a joint limit, as Fig. 4 (a) [IJRR].

    Args:
        sampled: A slice through a mode at a limit that goes on beyond it.
        unit: How to show its offsets.
        admissible: The offsets between which the limits hold.
        expansion: Slope and curvature at offset zero of the second-order expansion.
        title: What the figure shows.
    """
    figure = Figure(figsize=(6.5, 3.8), layout="constrained")
    axes = figure.subplots()
    t, curve = sampled.fine_offsets, sampled.fine_values["sum"]
    curve = curve - np.interp(0.0, t, curve)
    inside = (t >= admissible[0]) & (t <= admissible[1])
    shown = unit.factor
    for mask, style, label in ((inside, "-", "cost"), (~inside, "--", "cost, not admissible")):
        axes.plot(shown * t[mask], curve[mask], style, color="black", lw=1.6, label=label)
    slope, curvature = expansion
    parabola = slope * t + 0.5 * curvature * t**2
    seen = (parabola > curve.min() - 0.3 * np.ptp(curve)) & (parabola < curve.max())
    axes.plot(
        shown * t[seen],
        parabola[seen],
        color=OKABE_ITO["blue"],
        lw=1.3,
        label="second-order expansion",
    )
    plots.decorate(axes, unit)
    at_zero = min(admissible, key=abs)
    axes.axvline(shown * at_zero, color=OKABE_ITO["vermilion"], lw=1.3, label="joint limit")
    axes.plot(0, 0, "o", mfc="none", mec="black", ms=7, zorder=4, label="constrained minimum")
    axes.set_ylabel("cost above that at the mode (nats)")
    axes.set_title(title, fontsize=10)
    axes.legend(fontsize=8, framealpha=0.9)
    return figure


if __name__ == "__main__":
    start(main, Config, __doc__)
