"""Table 1 of [IJRR]: how many minima covariance scaled sampling (CSS) and spheres (SS) find.

    python scripts/table1.py --num-seeds 10 --out table1.json

One pose per seed is seen as joints in one image (`torchcss.studies.reprojection`), and the minima
of that cost are searched from its start mode: samples of its covariance, scaled, against samples of
a ball of the same volume; both are projected onto the joint limits and descend. Scales are factors
on the standard deviations. A minimum counts if its descent converged, if it satisfies the limits,
if the cost curves upwards there along all free variables, and if it is none that was found before.
The paper's own figures stand beside ours; its poses and its priors are lost.

Distances are Euclidean in the parameters, "deviations" in the start mode's metric, costs are those
above the start's; medians and standard deviations are over the raw samples, and over the minima.
"Shared" are the minima of SS that CSS found too at the same scale. What the paper leaves open is a
tracker's: its stabilisers (`--prior-scale 3` reaches three times as far), no other width, 3 pixels
of a click. `--correlated-projection` is the other way to project samples, which the paper leaves
open too. `--figures DIR` draws Figs. 1, 5 and 13.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from common import Table, start, write_report
from jaxtyping import Float
from matplotlib.figure import Figure

from torchcss.errors import ConfigurationError
from torchcss.files import load_json, real_numbers
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import CovarianceScaled, Spherical
from torchcss.show.style import OKABE_ITO, save_figure
from torchcss.studies.minima import FoundMinima
from torchcss.studies.reprojection import ReprojectionProblem
from torchcss.studies.sampling_study import (
    Lengths,
    SamplerRun,
    StudyChoice,
    run_sampler,
    spectrum,
    study_problem,
)
from torchcss.types import Modes, frozen

COLUMNS = {
    "minima": "minima",
    "distance_raw": "distance raw", "distance": "minima's",
    "deviations_raw": "deviations raw", "deviations": "minima's",
    "cost_raw": "cost raw", "cost": "minima's",
}  # fmt: skip
CHECKS = {
    "shared": "shared", "minima_half": "distance / 2", "minima_double": "distance x 2",
    "valleys": "valleys", "back": "back", "cheap": "cheap", "below_start": "below start",
    "converged": "converged", "inside": "inside", "upward": "upward", "steps": "steps",
    "seconds": "seconds",
}  # fmt: skip
"""Minima of SS that CSS found too, minima when the duplicate distance is halved and doubled, those
not joined by low paths, share of the samples that descend back to the start; minima at most `cheap`
nats above it, those below it; shares of the samples that pass each test."""

TABLE1 = {
    ("CSS", 1.0): (8, 1.148, 2.552, 10.94, 47.60, 117.0, 8.497),
    ("CSS", 4.0): (59, 3.212, 2.947, 35.29, 55.32, 1995.0, 6.981),
    ("CSS", 8.0): (180, 4.969, 3.347, 75.11, 109.8, 16201.0, 7.099),
    ("SS", 1.0): (0, 0.199, math.nan, 24.53, math.nan, 273.5, math.nan),
    ("SS", 4.0): (11, 0.767, 2.049, 96.15, 39.07, 4291.0, 6.280),
    ("SS", 8.0): (42, 1.473, 2.549, 188.2, 56.83, 16856.0, 6.965),
}
"""Table 1 [IJRR] by method and scale: number of minima, then medians of parameter distance,
standard deviations and cost difference, each of the raw samples and of the minima."""

LABELS = {
    "distance": "parameter distance from the start",
    "deviations": "standard deviations from the start",
    "cost": "cost above the start's (nats)",
}


@frozen
class Config:
    """The problem, the search and the counting."""

    body: str = "body34"
    """A body of the catalogue."""
    samples: int = 2000
    """Samples per method and scale."""
    scales: tuple[float, ...] = (1.0, 2.0, 4.0, 8.0)
    """Factors on the standard deviations: 1, 4, 8 in the paper's table, 1, 2, 8 in its text."""
    seed: int = 0
    """Seed of pose, noise and samples."""
    num_seeds: int = 1
    """How many seeds from there; with several, the medians are printed."""
    pose: Path | None = None
    """JSON of parameter names and values: this pose instead of one drawn from plausible ones."""
    choice: Annotated[StudyChoice, tyro.conf.arg(name="")] = field(default_factory=StudyChoice)
    correlated_projection: bool = False
    """Samples return to the limits along their covariance instead of each parameter for itself."""
    exact_steps: bool = True
    """Descents take exact Hessians throughout, which keeps them in the basin that they start in."""
    duplicate_distance: float = 1.0
    """Minima closer than this many standard deviations are one; also counted at half and double."""
    cheap: float = 20.0
    """Nats above the start within which a minimum is a serious alternative; counted too."""
    figures: Path | None = None
    """Folder for the figures."""
    out: Path | None = None
    """JSON file to write."""


def read_pose(path: Path) -> dict[str, float]:
    """Parameter names and values."""
    pose = load_json(path, ConfigurationError)
    if not isinstance(pose, dict):
        raise ConfigurationError(f"{path}: expected an object of parameter names and values")
    real_numbers(list(pose.values()), str(path), ConfigurationError)
    return pose


def make_problem(config: Config, seed: int, body: str) -> ReprojectionProblem:
    """The problem of one seed, with its start mode."""
    given = config.pose if body == config.body else None
    pose = None if given is None else read_pose(given)
    generator = torch.Generator().manual_seed(seed)
    return study_problem(body, generator=generator, choice=config.choice, pose=pose)


def row_of(config: Config, run: SamplerRun) -> dict[str, Any]:
    """What the table says of a run."""
    modes, tests, minima = run.found.modes, run.found.tests, run.found.minima
    lengths = {"_raw": run.raw, "": run.minima}
    return {
        "minima": len(minima),
        **{name + kind: float(values.quantile(0.5)) if len(values) else math.nan
           for kind, part in lengths.items() for name, values in part._asdict().items()},
        **{f"{name}{kind}_spread": float(values.std()) if len(values) > 1 else math.nan
           for kind, part in lengths.items() for name, values in part._asdict().items()},
        "minima_half": run.num_half, "minima_double": run.num_double, "valleys": run.num_valleys,
        "back": float((run.ends.deviations <= config.duplicate_distance).double().mean()),
        "cheap": int((run.minima.cost < config.cheap).sum()),
        "below_start": int((run.minima.cost < 0).sum()),
        **{name: float(part.double().mean()) for name, part in tests._asdict().items()},
        "steps": float(modes.num_steps.double().mean()), "seconds": run.seconds, "flips": run.flips,
    }  # fmt: skip


def tables(rows: list[dict[str, Any]], poses: str) -> tuple[Table, Table]:
    """The paper's columns, ours above the paper's, and what the count is worth."""
    cells, checks = [], []
    for row in rows:
        key = row["method"], row["scale"]
        name = f"{key[0]} {key[1]:g}"
        cells.append([name, *(row[column] for column in COLUMNS)])
        if key in TABLE1:
            cells.append([f"{name}, paper", *TABLE1[key]])
        flips = ", ".join(f"{k} {n}" for k, n in row.get("flips", {}).items())
        checks.append([name, *(row.get(column) for column in CHECKS), flips])
    method = "method, scale"
    return (
        Table(f"Table 1 of [IJRR], {poses}", (method, *COLUMNS.values()), cells),
        Table("What the counts are worth", (method, *CHECKS.values(), "flipped"), checks),
    )


def run_seed(config: Config, seed: int) -> dict[str, Any]:
    """All runs of one pose; the figures are of the last scale."""
    problem, rows, found = make_problem(config, seed, config.body), [], {}
    for method, kind in (("CSS", CovarianceScaled), ("SS", Spherical)):
        for scale in config.scales:
            run = found[method, scale] = run_sampler(
                problem, kind(deviation_scale=scale, include_modes=False,
                              correlated_projection=config.correlated_projection),
                config.samples, generator=torch.Generator().manual_seed(1000 + seed),
                distance=config.duplicate_distance, exact_steps=config.exact_steps,
            )  # fmt: skip
            row = {"method": method, "scale": scale, **row_of(config, run)}
            if method == "SS":
                row["shared"] = num_shared(
                    run.found, found["CSS", scale].found, problem.start,
                    distance=config.duplicate_distance,
                )  # fmt: skip
            rows.append(row)
    last = {method: found[method, config.scales[-1]] for method in ("CSS", "SS")}
    starts = {name: make_problem(config, seed, name).start for name in ("arm8", "body32")}
    spectra = {name: spectrum(start.covariance).tolist() for name, start in starts.items()}
    if config.figures is not None:
        title = f"{config.body}, seed {seed}, scale {config.scales[-1]:g}, {config.samples} samples"
        figures = {
            "fig1": minima_and_costs_figure(last, title),
            "fig5": eigenvector_figure(spectra),
            "fig13": samples_and_minima_figure(last, title),
        }
        for name, figure in figures.items():
            save_figure(figure, config.figures / f"{name}_seed{seed}.png", dpi=90)
    ratio = {name: values[0] / values[-1] for name, values in spectra.items()}
    return {"seed": seed, "spectrum_ratio": ratio, "start_cost": float(problem.start.cost),
            "seconds": sum(row["seconds"] for row in rows), "rows": rows}  # fmt: skip


def num_shared(
    first: FoundMinima, second: FoundMinima, start: Modes, *, distance: float = 1.0
) -> int:
    """How many minima of one run another one found too.

    Two minima are the same where they are closer than a threshold in the metric of either; the
    tests by which a run tells its own minima apart are `other_minima`.

    Args:
        first: The run whose minima are looked for.
        second: The run among whose minima they are looked for.
        start: What both started from.
        distance: The threshold, standard deviations.
    """
    mine, theirs = (
        GaussianMixture(
            found.modes.mean[found.minima],
            found.modes.covariance[found.minima],
            start.cost.new_zeros(len(found.minima)),
        )
        for found in (first, second)
    )
    if not len(mine.mean) or not len(theirs.mean):
        return 0
    apart = torch.minimum(mine.squared_distance(theirs.mean).mT, theirs.squared_distance(mine.mean))
    return int((apart.amin(-1) <= distance**2).sum())


def medians(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Medians over seeds; a run without minima has no distances to give."""
    table = []
    for rows in zip(*(run["rows"] for run in runs), strict=True):
        row = {"method": rows[0]["method"]}
        for key in (key for key, value in rows[0].items() if isinstance(value, (int, float))):
            known = [other[key] for other in rows if not math.isnan(other[key])]
            row[key] = float(np.median(known)) if known else math.nan
        table.append(row)
    return table


def main(config: Config) -> dict[str, Any]:
    """Run, print, draw, write; return what is written."""
    runs = []
    for seed in range(config.seed, config.seed + config.num_seeds):
        runs.append(run := run_seed(config, seed))
        ratio = ", ".join(f"{name} {value:.0f}" for name, value in run["spectrum_ratio"].items())
        print(f"seed {seed}: spectrum ratio {ratio}; start at {run['start_cost']:.2f} nats; "
              f"{run['seconds']:.1f} s")  # fmt: skip
        if config.num_seeds > 1:
            for table in tables(run["rows"], f"seed {seed}"):
                table.print()
    several = len(runs) > 1
    rows = medians(runs) if several else runs[0]["rows"]
    shown = tables(rows, f"medians over {len(runs)} poses" if several else "one pose")
    for table in shown:
        table.print()
    counts = {(row["method"], row["scale"]): row["minima"] for row in rows}
    times = {f"{scale:g}": counts["CSS", scale] / (counts["SS", scale] or math.nan)
             for scale in config.scales}  # fmt: skip
    print("minima of CSS over those of SS by scale:", times)
    report = {"config": config, "runs": runs, "median": rows, "css_over_ss": times}
    write_report(config.out, report, shown[0])
    return report


def samples_and_minima_figure(runs: Mapping[str, SamplerRun], title: str = "") -> Figure:
    """Fig. 13: histograms of raw samples and minima over distance, deviations and cost.

    Args:
        runs: By the sampler's name.
        title: Above all.
    """
    colours = list(OKABE_ITO.values())
    figure = Figure(figsize=(12, 4.4 * len(runs)), layout="constrained")
    grid = figure.subplots(2 * len(runs), 3, squeeze=False)
    for number, (name, run) in enumerate(runs.items()):
        for kind, lengths in enumerate((run.minima, run.raw)):
            row = grid[2 * number + kind]
            for axis, (key, label) in zip(row, LABELS.items(), strict=True):
                log, values = key == "cost", _values(lengths, key)
                axis.hist(values, bins=_bins(values, log=log), color=colours[number])
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
        for colour, (name, own) in zip(OKABE_ITO.values(), values.items(), strict=False):
            axis.hist(own, bins=bins, histtype="step", color=colour, label=name, lw=1.8)
        axis.set(xlabel=LABELS[key], ylabel="minima" if kind == "minima" else "samples")
        axis.legend(frameon=False)
    left.set_title("(a) minima")
    right.set(title="(b) raw samples", xscale="log")
    figure.suptitle(title)
    return figure


def eigenvector_figure(spectra: Mapping[str, Sequence[float]]) -> Figure:
    """Fig. 5: standard deviations along the eigenvectors of a mode's covariance, on a log scale.

    Args:
        spectra: Deviations, the widest first, by the body's name.
    """
    figure = Figure(figsize=(4.5 * len(spectra), 4), layout="constrained")
    for axis, (name, values) in zip(
        figure.subplots(1, len(spectra), squeeze=False)[0], spectra.items(), strict=True
    ):
        axis.semilogy(range(1, len(values) + 1), values, "o-", color=OKABE_ITO["blue"])
        axis.set(
            title=f"{name}: largest over smallest {values[0] / values[-1]:.0f}",
            xlabel="eigen-direction",
            ylabel="standard deviation (m, rad)",
        )
        axis.grid(alpha=0.3)
    return figure


def _values(lengths: Lengths, key: str) -> Float[np.ndarray, " s"]:
    """The finite ones; of costs those above the start's, which have a place on a log axis."""
    values = getattr(lengths, key).numpy(force=True)
    values = values[np.isfinite(values)]
    return values[values > 0] if key == "cost" else values


def _bins(values: Float[np.ndarray, " s"], *, log: bool) -> Float[np.ndarray, " b"] | int:
    """Edges of bins: equal steps, or equal ratios."""
    if not len(values):
        return 40
    if not log:
        return np.histogram_bin_edges(values, 40)
    low, high = max(float(values.min()), 1e-9), float(values.max())
    return np.geomspace(low * 0.999, max(high, low) * 1.001, 41)


if __name__ == "__main__":
    start(main, Config, __doc__)
