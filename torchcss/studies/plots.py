"""Plots of cost slices, and of the errors of many trackers against time.

Every function draws into the axes that it is given, so that a notebook lays out its own page, or
returns a `Figure` that belongs to nobody: no window opens and no global state changes, whatever
matplotlib's backend. Colours are those that colour-blind viewers can tell apart.

Call `draw_slice` for a slice by terms; `error_curves`, then `failure_figure` for the runs of
`scripts/failure_modes.py`; `torchcss.show.style.save_figure` writes a figure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchcss.body.root import ROOT_NAMES
from torchcss.show.style import OKABE_ITO
from torchcss.show.track_plots import tidy
from torchcss.studies.metrics import spread
from torchcss.studies.slices import PROMINENCE, Slice, StateLine

_TERM_COLOURS = {
    "sum": "black",
    "contour": "blue",
    "flow": "orange",
    "joints": "green",
    "stabiliser": "purple",
    "temporal": "vermilion",
    "temporal_mixture": "vermilion",
    "edge_energy": "sky",
    "interpenetration": "yellow",
}
GREY = "0.45"
_COLUMNS = 4
_ABOVE = 1.6
"""Height of the panels of failures as a multiple of the error from which a frame has failed."""


class Unit(NamedTuple):
    """How the offsets of a line are shown.

    Attributes:
        label: What the axis says.
        factor: Shown number per unit of offset.
    """

    label: str
    factor: float = 1.0


def unit_of(line: StateLine, *, close: bool = False) -> Unit:
    """How to show offsets on a line: degrees, metres, or for eigen-directions what both mix to.

    Args:
        line: The line.
        close: Whether the slice is so short that standard deviations say most.
    """
    if line.name.startswith("eigen"):
        if close:
            return Unit("standard deviations", 1 / line.deviation)
        return Unit("length of the step (radians and metres)")
    if line.name in ROOT_NAMES[:3] or line.name.endswith("_length"):
        return Unit("metres")
    return Unit("degrees", 180 / math.pi)


def term_colour(name: str) -> str:
    """The colour of a term, the same in every figure; grey for terms without a colour of theirs."""
    return OKABE_ITO.get(_TERM_COLOURS.get(name, ""), GREY)


def title_of(line: StateLine) -> str:
    """A line's name for people."""
    return line.name.replace("_", " ").replace("eigen", "eigen-direction")


def draw_slice(axes: Axes, sampled: Slice, unit: Unit, *, prominence: float = PROMINENCE) -> None:
    """Draw every term of a slice, and their sum in black with its minima as open circles.

    All curves are relative to their value at offset zero, so that they add up by eye.

    Args:
        axes: Where to draw.
        sampled: The slice.
        unit: How to show its offsets.
        prominence: Least prominence of a marked minimum, see `torchcss.studies.slices`.
    """
    t = sampled.offsets * unit.factor
    for name, curve in sampled.values.items():
        relative = curve - np.interp(0.0, sampled.offsets, curve)
        total = name == "sum"
        if not total and not np.ptp(curve) > 0:
            continue  # a term that is silent here
        axes.plot(
            t, relative, label=name, color=term_colour(name), lw=1.6 if total else 1.1,
            zorder=3 if total else 2,
        )  # fmt: skip
        if total:
            at = sampled.minima(name, prominence).sample
            axes.plot(t[at], relative[at], "o", mfc="none", mec="black", ms=5, zorder=4)
    decorate(axes, unit)
    axes.set_xlim(t[0], t[-1])


def decorate(axes: Axes, unit: Unit | None = None) -> None:
    """Give axes a quiet look, and say what is along the first one."""
    if unit is not None:
        axes.axvline(0.0, color=GREY, lw=0.8, ls=":", zorder=1)
        axes.set_xlabel(unit.label, labelpad=1)
    tidy(axes)


class ErrorCurves(NamedTuple):
    """One tracker's panel.

    Attributes:
        name: The tracker.
        best_mm: Error of the best mode by seed and time; `inf` after the end of a run that was
            stopped since the body was lost, NaN where nothing is known.
        best_of_modes_mm: The same of the mode that is nearest to the truth.
        lost_s: When each seed lost the body, NaN if it did not.
        published_s: When the paper's tracker failed on its own sequence.
    """

    name: str
    best_mm: Float[np.ndarray, "seeds t"]
    best_of_modes_mm: Float[np.ndarray, "seeds t"]
    lost_s: Sequence[float]
    published_s: Sequence[float] = ()


def error_curves(
    runs: Sequence[Mapping[str, Any]], published_s: Mapping[str, Sequence[float]]
) -> tuple[Float[np.ndarray, " t"], list[ErrorCurves]]:
    """Times of the frames, and the panels, from runs as `scripts/failure_modes.py` writes them.

    Args:
        runs: What `torchcss.studies.evaluation.summarise` gave, with `preset`; at least one with
            frames. Runs that ended before the first frame have none, and are left out.
        published_s: When the paper's trackers failed, by preset.
    """
    runs = [run for run in runs if "per_frame" in run]
    times = np.array(max((run["per_frame"]["time_s"] for run in runs), key=len), np.float64)

    def errors(own: Sequence[Mapping[str, Any]], key: str) -> np.ndarray:
        values = np.full((len(own), len(times)), np.inf)
        for row, run in zip(values, own, strict=True):
            known = run["per_frame"][key]
            row[: len(known)] = np.array(known, np.float64)  # what files have for NaN is None
        return values

    curves = []
    for name in dict.fromkeys(run["preset"] for run in runs):
        own = [run for run in runs if run["preset"] == name]
        curves.append(
            ErrorCurves(
                name,
                errors(own, "root_aligned_mm"),
                errors(own, "root_aligned_best_of_modes_mm"),
                np.array([run["lost_s"] for run in own], np.float64).tolist(),
                published_s.get(name, ()),
            )
        )
    return times, curves


def failure_figure(
    times_s: Float[np.ndarray, " t"], curves: Sequence[ErrorCurves], *, title: str, failed_mm: float
) -> Figure:
    """Median error over the seeds against time, with the range of the seeds as a band.

    A seed that was stopped counts as infinitely far from then on, so that the median leaves the
    panel when half of the seeds are lost.

    Args:
        times_s: Times of the frames.
        curves: The trackers.
        title: What all panels show.
        failed_mm: Error from which a frame has failed, a dotted line.
    """
    rows = math.ceil(len(curves) / _COLUMNS)
    columns = min(len(curves), _COLUMNS)
    figure = Figure(figsize=(0.6 + 3.1 * columns, 1.4 + 2.1 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(curves) :]:
        axes.set_visible(False)
    for index, (axes, tracker) in enumerate(zip(grid.flat, curves, strict=False)):
        _draw(axes, times_s, tracker, failed_mm)
        if index + columns >= len(curves):
            axes.set_xlabel("seconds")
            axes.tick_params(labelbottom=True)
    grid[0, 0].set_xlim(times_s[0], max(times_s[-1], times_s[0] + 1e-3))
    grid[0, 0].set_ylim(0, _ABOVE * failed_mm)
    figure.supylabel("mean root-aligned error of the joints (mm)", fontsize=9)
    entries: Mapping[str, object] = {
        label: handle
        for axes in grid.flat
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=5, fontsize=9,
        frameon=False,
    )  # fmt: skip
    figure.suptitle(title, fontsize=10)
    return figure


def _draw(axes: Axes, times: np.ndarray, tracker: ErrorCurves, failed_mm: float) -> None:
    top = _ABOVE * failed_mm
    middle, low, high = _spreads(tracker.best_mm)
    # The band of a seed that is lost goes up to the border.
    axes.fill_between(
        times, low.clip(max=2 * top), high.clip(max=2 * top), color=OKABE_ITO["blue"], alpha=0.2,
        lw=0, label="range over the seeds",
    )  # fmt: skip
    axes.plot(times, middle, color=OKABE_ITO["blue"], lw=1.6, label="best mode, median")
    nearest, _, _ = _spreads(tracker.best_of_modes_mm)
    axes.plot(
        times, nearest, color=OKABE_ITO["orange"], lw=1.3, ls="--", label="nearest mode, median"
    )
    axes.axhline(failed_mm, color=GREY, lw=0.8, ls=":")
    lost = [time for time in tracker.lost_s if not math.isnan(time)]
    if lost:
        axes.plot(
            lost, np.full(len(lost), failed_mm), "x", color=OKABE_ITO["vermilion"], ms=7, mew=1.8,
            clip_on=False, zorder=4, label="body lost",
        )  # fmt: skip
    inside = [time for time in tracker.published_s if time <= times[-1]]
    if inside:
        axes.plot(
            inside, np.full(len(inside), 0.95 * top), "v", color="black", ms=7, zorder=4,
            label="failure in the paper, on its own sequence",
        )  # fmt: skip
    count = len(tracker.lost_s)
    axes.set_title(f"{tracker.name}: lost {len(lost)} of {count}", fontsize=9)
    decorate(axes)


def _spreads(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Median, least and greatest over the known seeds of every time; NaN where there is none."""
    middle, low, high = np.array([spread(column) for column in errors.T]).T
    return np.where(np.isinf(middle), np.nan, middle), low, high
