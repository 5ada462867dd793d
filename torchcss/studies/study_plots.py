"""Figures 1, 5 and 13 of [IJRR]: what samplers find, and the spectra that they exploit.

Every function returns a `Figure` that belongs to nobody: no window opens and no global state
changes, whatever matplotlib's backend.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from torchcss.studies.sampling_study import Lengths, SamplerRun

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
"""Okabe and Ito's, which everybody can tell apart."""

LABELS = {
    "distance": "parameter distance from the start",
    "deviations": "standard deviations from the start",
    "cost": "cost (nats)",
}


def samples_and_minima_figure(runs: Mapping[str, SamplerRun], title: str = "") -> Figure:
    """Fig. 13: histograms of raw samples and minima over distance, deviations and cost.

    Args:
        runs: By the sampler's name.
        title: Above all.
    """
    figure = Figure(figsize=(12, 4.4 * len(runs)), layout="constrained")
    grid = figure.subplots(2 * len(runs), 3, squeeze=False)
    for number, (name, run) in enumerate(runs.items()):
        for kind, lengths in enumerate((run.minima, run.raw)):
            row = grid[2 * number + kind]
            for axis, (key, label) in zip(row, LABELS.items(), strict=True):
                log, values = key == "cost", _values(lengths, key)
                axis.hist(values, bins=_bins(values, log=log), color=COLOURS[number])
                axis.set(xlabel=label, xscale="log" if log and len(values) else "linear")
            row[0].set_ylabel(f"{name}: {('minima', 'samples')[kind]}")
            row[1].set_title(f"{len(lengths.cost)} {('minima', 'raw samples')[kind]}")
    figure.suptitle(title)
    return figure


def minima_and_costs_figure(runs: Mapping[str, SamplerRun], title: str = "") -> Figure:
    """Fig. 1: (a) how far the minima lie from the start, (b) at what cost samples are placed.

    Args:
        runs: By the sampler's name.
        title: Above all.
    """
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axis, key, kind in ((left, "distance", "minima"), (right, "cost", "raw")):
        values = {name: _values(getattr(run, kind), key) for name, run in runs.items()}
        bins = _bins(np.concatenate(list(values.values())), log=key == "cost")
        for colour, (name, own) in zip(COLOURS, values.items(), strict=False):
            axis.hist(own, bins=bins, histtype="step", color=colour, label=name, lw=1.8)
        axis.set(xlabel=LABELS[key], ylabel="minima" if kind == "minima" else "samples")
        axis.legend(frameon=False)
    left.set_title("(a) minima")
    right.set(title="(b) raw samples", xscale="log")
    figure.suptitle(title)
    return figure


def spectra_figure(spectra: Mapping[str, Sequence[float]]) -> Figure:
    """Fig. 5: standard deviations along the eigenvectors of a mode's covariance, on a log scale.

    Args:
        spectra: Deviations, the widest first, by the body's name.
    """
    figure = Figure(figsize=(4.5 * len(spectra), 4), layout="constrained")
    for axis, (name, values) in zip(
        figure.subplots(1, len(spectra), squeeze=False)[0], spectra.items(), strict=True
    ):
        axis.semilogy(range(1, len(values) + 1), values, "o-", color=COLOURS[0])
        axis.set(
            title=f"{name}: largest over smallest {values[0] / values[-1]:.0f}",
            xlabel="eigen-direction",
            ylabel="standard deviation (m, rad)",
        )
        axis.grid(alpha=0.3)
    return figure


def _values(lengths: Lengths, key: str) -> Float[np.ndarray, " s"]:
    """The finite ones."""
    values = getattr(lengths, key).numpy(force=True)
    return values[np.isfinite(values)]


def _bins(values: Float[np.ndarray, " s"], *, log: bool) -> Float[np.ndarray, " b"] | int:
    """Edges of bins: equal steps, or equal ratios."""
    if not len(values):
        return 40
    if not log:
        return np.histogram_bin_edges(values, 40)
    low, high = max(float(values.min()), 1e-9), float(values.max())
    return np.geomspace(low * 0.999, max(high, low) * 1.001, 41)
