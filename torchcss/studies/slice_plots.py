"""Plots of cost slices and of their minima, in colours that colour-blind viewers can tell apart.

Every function draws into the axes that it is given, so that a notebook lays out its own page, or
returns a `Figure` that belongs to nobody: no window opens and no global state changes, whatever
matplotlib's backend.

By default: `slices_figure` for slices by terms, `curves_figure` for variants of one cost side by
side, `counts_figure` for how many minima the variants have, and `save_figure`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchcss.body.root import ROOT_NAMES
from torchcss.show.style import OKABE_ITO
from torchcss.studies.slices import PROMINENCE, Line, Slice, find_minima

_TERM_COLOURS = {
    "sum": "black",
    "contour": "blue",
    "flow": "orange",
    "joints": "green",
    "stabiliser": "purple",
    "temporal": "vermilion",
    "edge_energy": "sky",
    "interpenetration": "yellow",
}
_GREY = "0.45"
_PERCENTS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)


class Unit(NamedTuple):
    """How the offsets of a line are shown.

    Attributes:
        label: What the axis says.
        factor: Shown number per unit of offset.
    """

    label: str
    factor: float = 1.0


def unit_of(line: Line, *, close: bool = False) -> Unit:
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
    return OKABE_ITO.get(_TERM_COLOURS.get(name, ""), _GREY)


def title_of(line: Line) -> str:
    """A line's name for people."""
    return line.name.replace("_", " ").replace("eigen", "eigen-direction")


def draw_slice(
    axes: Axes,
    sampled: Slice,
    unit: Unit,
    *,
    prominence: float = PROMINENCE,
) -> None:
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
    _decorate(axes, unit)
    axes.set_xlim(t[0], t[-1])


def _decorate(axes: Axes, unit: Unit) -> None:
    axes.axvline(0.0, color=_GREY, lw=0.8, ls=":", zorder=1)
    axes.grid(visible=True, color="0.92", lw=0.6)
    axes.set_axisbelow(True)
    axes.set_xlabel(unit.label, labelpad=1)
    axes.tick_params(labelsize=8)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def slices_figure(
    rows: Sequence[tuple[tuple[Slice, Unit], tuple[Slice, Unit]]],
    title: str,
    *,
    centre: str = "mode",
    prominence: float = PROMINENCE,
) -> Figure:
    """One row per line: a small slice on the left, a large one on the right.

    Args:
        rows: The slices and how to show them.
        title: What the whole figure shows.
        centre: What is at offset zero.
        prominence: See `draw_slice`.
    """
    figure = Figure(figsize=(9.0, 0.9 + 1.9 * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), 2, squeeze=False)
    for axes_row, row in zip(grid, rows, strict=True):
        for axes, (sampled, unit) in zip(axes_row, row, strict=True):
            draw_slice(axes, sampled, unit, prominence=prominence)
        axes_row[0].set_ylabel(f"cost above that\nat the {centre} (nats)", fontsize=9)
        for axes, scale in zip(axes_row, ("close", "as far as the limits admit"), strict=True):
            axes.set_title(f"{title_of(row[0][0].line)}, {scale}", fontsize=10)
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
        f"{title}\ndotted: the {centre}; circles: minima of the sum with a prominence above "
        f"{100 * prominence:g} % of its range",
        fontsize=10,
    )
    return figure


def curves_figure(
    offsets: Float[np.ndarray, " s"],
    panels: Mapping[str, Mapping[str, Float[np.ndarray, " s"]]],
    unit: Unit,
    title: str,
    *,
    prominence: float = PROMINENCE,
) -> Figure:
    """Variants of one cost along one line: a panel per name, curves scaled to their own ranges.

    Args:
        offsets: Offsets of the samples; the truth is at zero.
        panels: Curves by panel and label, at most three to a panel.
        unit: How to show the offsets.
        title: What the whole figure shows.
        prominence: Least prominence of a marked minimum.
    """
    figure = Figure(figsize=(9.0, 0.9 + 1.9 * len(panels)), layout="constrained")
    column = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    t = unit.factor * offsets
    for axes, (name, curves) in zip(column, panels.items(), strict=True):
        for (label, curve), colour in zip(
            curves.items(), ("vermilion", "blue", "green"), strict=False
        ):
            height = (curve - curve.min()) / max(float(np.ptp(curve)), np.finfo(float).tiny)
            at = find_minima(height).above(prominence).sample
            axes.plot(t, height, color=OKABE_ITO[colour], lw=1.3, label=f"{label}: {len(at)}")
            axes.plot(t[at], height[at], "o", mfc="none", mec=OKABE_ITO[colour], ms=5)
        _decorate(axes, unit if axes is column[-1] else Unit(""))
        axes.set_xlim(t[0], t[-1])
        axes.set_title(name, fontsize=10, loc="left")
        axes.set_ylabel("share of\nthe range", fontsize=9)
        axes.legend(
            loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False, title="minima"
        )
    figure.suptitle(
        f"{title}\ndotted: the truth; circles: minima with a prominence above "
        f"{100 * prominence:g} % of the range",
        fontsize=10,
    )
    return figure


def limit_figure(
    sampled: Slice,
    unit: Unit,
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
    _decorate(axes, unit)
    at_zero = min(admissible, key=abs)
    axes.axvline(shown * at_zero, color=OKABE_ITO["vermilion"], lw=1.3, label="joint limit")
    axes.plot(0, 0, "o", mfc="none", mec="black", ms=7, zorder=4, label="constrained minimum")
    axes.set_ylabel("cost above that at the mode (nats)")
    axes.set_title(title, fontsize=10)
    axes.legend(fontsize=8, framealpha=0.9)
    return figure


class CountCurve(NamedTuple):
    """Number of minima of one variant, by least prominence.

    Attributes:
        label: The variant.
        colour: A name in `OKABE_ITO`.
        dashed: Whether the line is dashed.
        share: Its minima as a share of those of the variant that all are compared with.
    """

    label: str
    colour: str
    dashed: bool
    share: Float[np.ndarray, " m"]


def counts_figure(
    thresholds: Float[np.ndarray, " m"],
    panels: Mapping[str, Sequence[CountCurve]],
    title: str,
    *,
    prominence: float = PROMINENCE,
) -> Figure:
    """How many minima the variants have compared with the first, whatever counts as a minimum.

    Args:
        thresholds: Least prominences, shares of the range.
        panels: Variants by panel.
        title: What the whole figure shows.
        prominence: The one that tables state, marked by a vertical line.
    """
    figure = Figure(figsize=(4.6 * len(panels), 4.6), layout="constrained")
    ticks = [t for t in _PERCENTS if thresholds[0] <= t / 100 <= thresholds[-1]]
    row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (name, curves) in zip(row, panels.items(), strict=True):
        for curve in curves:
            axes.plot(
                100 * thresholds, curve.share, color=OKABE_ITO[curve.colour], lw=1.6,
                ls="--" if curve.dashed else "-", label=curve.label,
            )  # fmt: skip
        _decorate(axes, Unit("least prominence counted (% of the slice's range)"))
        axes.axvline(100 * prominence, color=_GREY, lw=0.8, ls=":")
        axes.axhline(1.0, color=_GREY, lw=0.8)
        axes.set_xscale("log")
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set_xlim(100 * thresholds[0], 100 * thresholds[-1])
        axes.set_ylim(0.0, 2.0)
        axes.set_title(name, fontsize=10)
    row[0].set_ylabel("number of minima, as a share of\nthose of the first variant")
    handles, labels = row[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.suptitle(title, fontsize=10)
    return figure
