"""What makes spurious minima fewer on cluttered frames: robust potentials, motion boundaries, flow.

    python scripts/cost_minima.py --data DIR --out out/minima

Section 3.1 [IJRR] wants few spurious minima, by robust error potentials and by edges weighted with
motion boundaries, W = 1 - k S_p. Here the contour term is varied in both, without and with flow, on
the same lines: through the truth (of the clip: the fit to the keypoints nearest the 3D reference),
along joints and eigenvectors of the covariance of the mode there, as far as the limits admit. The
frames are some of the rendered arm before clutter and, with `--data`, of DIR/balance_beam_4cam. A
minimum is spurious if it is not the one nearest the truth; `torchcss.studies.slices` says how
minima and their prominence are found. A slice misleads if its lowest point is over 0.1 (radians,
metres) away: few minima are worth nothing if the lowest is wrong. All potentials are given one cost
of a node without match; all of them, the quadratic one too, saturate there, at the search window's
edge.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import Table, start, write_report
from jaxtyping import Float
from matplotlib.figure import Figure

from torchcss.cost.choice import CostChoice
from torchcss.cost.contour import ContourTerm
from torchcss.cost.total import TrackingCost
from torchcss.files import prepare_output_folder
from torchcss.robust import Leclerc, Lorentzian, Quadratic
from torchcss.show.style import OKABE_ITO, save_figure
from torchcss.studies import plots
from torchcss.studies.scenes import Scene, arm_scenes, sequence_scenes
from torchcss.studies.sequences import read_sequence
from torchcss.studies.slices import PROMINENCE, curve_minima
from torchcss.tracking.settings import Settings, make_choice
from torchcss.types import frozen

COUNTED_TERMS = ("contour", "motion_boundaries", "flow", "stabiliser")
POTENTIALS = {  # with sigma in pixels and the colour of its lines
    "quadratic": (Quadratic, 2.5, "vermilion"),
    "Lorentzian": (Lorentzian, 2.5, "blue"),
    "Leclerc": (Leclerc, 2.5, "green"),
    "Leclerc, wide": (Leclerc, 6.0, "purple"),  # as wide at half its depth as the Lorentzian
}
EMPHASES = (0.0, 0.3, 1.0)  # k; the paper found 0.2 to 0.4 to work well
ON_BODY = ("root_z", "root_yaw", "r_shoulder_swing", "r_elbow_flexion", "l_elbow_flexion")
ON_BODY += ("r_hip_flexion", "r_knee_flexion", "l_knee_flexion", "eigen 0", "eigen 1", "eigen 2")
STATED = (0.0, 0.005, 0.01, PROMINENCE, 0.05, 0.1)  # least prominences; 0 counts every ripple
LEAST = sorted({*STATED, *np.geomspace(0.002, 0.1, 25).tolist()})  # of the figure
PERCENTS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)  # ticks of the figure
FIRST, DRAWN, MISLEADING = ("quadratic", 0.0), "r_shoulder_swing", 0.1


@frozen
class Config:
    """Which frames, and how their slices are sampled."""

    data: Path | None = None
    """Folder that holds balance_beam_4cam; without it only the arm is looked at."""
    seeds: tuple[int, ...] = (0, 1)
    """Seeds of the arm's room."""
    frames: tuple[int, ...] = (10, 25, 40)
    """Frames of the arm's sequence."""
    clip_frames: tuple[int, ...] = (10, 30, 70)
    """Frames of the clip."""
    samples: int = 401
    """Samples of a slice."""
    small: bool = False
    """One frame of the arm, few samples: for tests."""
    out: Path | None = None
    """Folder for cost_minima.json and the figures."""
    report: Path | None = None
    """Where else to write the JSON file, such as docs/results/cost_minima.json."""


class SliceCounts(NamedTuple):
    """What is kept of a slice: spurious minima by least prominence, and where it is lowest."""

    frame: str
    spurious: list[int]
    lowest_at: float


CountsByCase = dict[
    tuple[str, str, str, float], list[SliceCounts]
]  # by body, terms, potential and k


def main(config: Config) -> dict[str, Any]:
    """Count on all frames, print, draw; return what is written."""
    if config.small:
        config = replace(config, data=None, seeds=(0,), frames=(3,), samples=41)
    if config.out is not None:
        prepare_output_folder(config.out)
    curves: CountsByCase = defaultdict(list)
    for scene in scenes(config):
        measure(scene, config, curves)
    rows = [row_of(key, curves) for key in sorted(curves, key=lambda key: key[:2])]
    report = {"settings": config, "least_prominences": LEAST, "rows": rows}
    table = table_of(rows)
    table.print()
    if config.out is not None:
        draw_counts(rows, config.out)
        write_report(config.out / "cost_minima.json", report, table)
    write_report(config.report, report, table)
    return report


def scenes(config: Config) -> Iterator[Scene]:
    settings = Settings(body="arm8", terms=COUNTED_TERMS)
    for seed in config.seeds:
        generator, name = torch.Generator().manual_seed(seed), f"arm {seed}"
        yield from arm_scenes(config.frames, generator=generator, settings=settings, name=name)
    if config.data is not None:
        clip = read_sequence(config.data / "balance_beam_4cam", view="cam01")
        yield from sequence_scenes(
            clip._replace(name="cam01"), config.clip_frames,
            generator=torch.Generator().manual_seed(0), settings=replace(settings, body="body34"),
        )  # fmt: skip


def contour_of(scene: Scene, potential: type, sigma: float, k: float) -> TrackingCost:
    """A variant of the contour term; a node without match costs as many nats as by default."""
    usual = make_choice(Settings(terms=COUNTED_TERMS, boundary_emphasis=k), 1.0)
    contour = usual.find(ContourTerm)
    assert contour is not None
    term = replace(contour, potential_kind=potential, sigma=sigma)
    ratio = term.unmatched / contour.unmatched
    level, weight = contour.fitted_level * ratio, contour.weight / ratio
    term = replace(term, fitted_level=level, weight=weight)
    field = scene.features.edge_field(boundary_emphasis=k).to(scene.truth)
    view = replace(scene.cost.views[0], edge_field=field)
    return replace(scene.cost, choice=CostChoice(terms=(term,)), views=(view,))


def measure(scene: Scene, config: Config, curves: CountsByCase) -> None:
    """Add the slices of one frame; draw those along one line."""
    limits, body = scene.limits(scene.truth), scene.cost.body.name
    flow = replace(scene.cost, choice=scene.cost.choice.only(["flow"]))
    for line in scene.lines(scene.truth):
        if body != "arm8" and line.name not in ON_BODY:
            continue
        offsets = np.linspace(*line.interval(limits), config.samples)
        states = line.states(offsets)
        by_flow, shown = flow.value(states).numpy(), defaultdict(dict)
        for name, (potential, sigma, _) in POTENTIALS.items():
            for k in EMPHASES:
                edges = contour_of(scene, potential, sigma, k).value(states).numpy()
                shown[name][f"k = {k:g}"] = edges
                for terms, curve in (("contour", edges), ("contour + flow", edges + by_flow)):
                    minima, extent = curve_minima(curve), float(np.ptp(curve))
                    found = [len(minima.above(least * extent).sample) for least in LEAST]
                    # One, wherever it is, is that of the truth.
                    counts = [max(number - 1, 0) for number in found]
                    taken = SliceCounts(scene.name, counts, float(offsets[curve.argmin()]))
                    curves[body, terms, name, k].append(taken)
        if line.name == DRAWN and config.out is not None:
            title = f"Contour term of {scene.name}, {plots.title_of(line)}"
            figure = curves_figure(offsets, shown, plots.unit_of(line), title)
            save_figure(figure, config.out / f"variants_{scene.slug}.png")


def row_of(key: tuple[str, str, str, float], curves: CountsByCase) -> dict[str, Any]:
    """Means over slices; and what is gained on the first row, with the error over frames."""
    found, first, usual = curves[key], curves[*key[:2], *FIRST], LEAST.index(PROMINENCE)
    gains: dict[str, list[int]] = defaultdict(list)
    for curve, other in zip(found, first, strict=True):
        gains[curve.frame].append(other.spurious[usual] - curve.spurious[usual])
    by_frame = {frame: np.mean(gain) for frame, gain in gains.items()}
    counts, of_first = (np.mean([c.spurious for c in curves], axis=0) for curves in (found, first))
    return {
        **dict(zip(("body", "terms", "potential", "k"), key, strict=True)),
        "spurious": counts,
        "share_of_first": counts / np.where(of_first > 0, of_first, np.nan),
        "fewer_by_frame": by_frame,
        "fewer": np.mean(list(by_frame.values())),
        "standard_error": np.std(list(by_frame.values())) / max(len(by_frame) - 1, 1) ** 0.5,
        "misleading": np.mean([abs(curve.lowest_at) > MISLEADING for curve in found]),
        "num_slices": len(found),
    }


def table_of(rows: list[dict[str, Any]]) -> Table:
    """Counts by least prominence."""
    cells = [
        [
            f"{row['body']}, {row['terms']}, {row['potential']}, k = {row['k']:g}",
            *(row["spurious"][LEAST.index(least)] for least in STATED),
            row["fewer"],
            row["standard_error"],
            100 * row["misleading"],
        ]
        for row in rows
    ]
    counts = (f"minima of {100 * least:g} %" for least in STATED)
    columns = ("cost", *counts, "fewer than first", "standard error", "misleading %")
    return Table("Spurious minima of the contour term", columns, cells)


def draw_counts(rows: list[dict[str, Any]], out: Path) -> None:
    figures: dict[str, dict[str, list[CountCurve]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if row["k"] in EMPHASES[:2]:
            label = f"{row['potential']}, {'motion boundaries' if row['k'] else 'plain edges'}"
            look = POTENTIALS[row["potential"]][2], row["k"] == 0, row["share_of_first"][1:]
            figures[row["body"]][row["terms"]].append(CountCurve(label, *look))
    for body, panels in figures.items():
        figure = counts_figure(np.array(LEAST[1:]), panels, f"Spurious minima of {body}")
        save_figure(figure, out / f"minima_{body}.png")


def curves_figure(
    offsets: Float[np.ndarray, " s"],
    panels: Mapping[str, Mapping[str, Float[np.ndarray, " s"]]],
    unit: plots.Unit,
    title: str,
) -> Figure:
    """Variants of one cost along one line: a panel per name, curves scaled to their own ranges.

    Args:
        offsets: Offsets of the samples; the truth is at zero.
        panels: Curves by panel and label, at most three to a panel.
        unit: How to show the offsets.
        title: What the whole figure shows.
    """
    figure = Figure(figsize=(9.0, 0.9 + 1.9 * len(panels)), layout="constrained")
    column = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    t = unit.factor * offsets
    for axes, (name, curves) in zip(column, panels.items(), strict=True):
        for (label, curve), colour in zip(
            curves.items(), ("vermilion", "blue", "green"), strict=False
        ):
            height = (curve - curve.min()) / max(float(np.ptp(curve)), np.finfo(float).tiny)
            at = curve_minima(height).above(PROMINENCE).sample
            axes.plot(t, height, color=OKABE_ITO[colour], lw=1.3, label=f"{label}: {len(at)}")
            axes.plot(t[at], height[at], "o", mfc="none", mec=OKABE_ITO[colour], ms=5)
        plots.decorate(axes, unit if axes is column[-1] else plots.Unit(""))
        axes.set_xlim(t[0], t[-1])
        axes.set_title(name, fontsize=10, loc="left")
        axes.set_ylabel("share of\nthe range", fontsize=9)
        axes.legend(
            loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8, frameon=False, title="minima"
        )
    figure.suptitle(
        f"{title}\ndotted: the truth; circles: minima with a prominence above "
        f"{100 * PROMINENCE:g} % of the range",
        fontsize=10,
    )
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
) -> Figure:
    """How many minima the variants have compared with the first, whatever counts as a minimum.

    Args:
        thresholds: Least prominences, shares of the range.
        panels: Variants by panel.
        title: What the whole figure shows.
    """
    figure = Figure(figsize=(4.6 * len(panels), 4.6), layout="constrained")
    ticks = [t for t in PERCENTS if thresholds[0] <= t / 100 <= thresholds[-1]]
    row = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, (name, curves) in zip(row, panels.items(), strict=True):
        for curve in curves:
            axes.plot(
                100 * thresholds, curve.share, color=OKABE_ITO[curve.colour], lw=1.6,
                ls="--" if curve.dashed else "-", label=curve.label,
            )  # fmt: skip
        plots.decorate(axes, plots.Unit("least prominence counted (% of the slice's range)"))
        axes.axvline(100 * PROMINENCE, color=plots.GREY, lw=0.8, ls=":")
        axes.axhline(1.0, color=plots.GREY, lw=0.8)
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


if __name__ == "__main__":
    start(main, Config, __doc__)
