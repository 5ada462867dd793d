"""Fig. 8d of [IJRR]: where three samplers look, on one two-dimensional slice of a cost.

    python scripts/sampler_slices.py --out slices/

The slice goes through the start mode of a reprojection problem (`torchcss.studies.sampling_study`),
along two eigen-directions of its covariance. On an arm, the most uncertain one leads to the other
minimum of a forward-backward flip. In the slice, (1) CONDENSATION randomises the mode by dynamical
noise, (2) the multiple-hypothesis tracker of Cham and Rehg samples the mode's covariance and adds
the same noise, and (3) covariance scaled sampling inflates the covariance. All samples then descend
within the slice. The table says at what cost samples are placed, and how many end in another
minimum.

The noise is large enough to reach as far along the uncertain direction as CSS does; `--noise`
sets it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import Table, start, write_report
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from torch import Tensor

from torchcss.files import prepare_output_folder
from torchcss.inference.mixture import GaussianMixture, distinct_modes
from torchcss.inference.proposals import ChamRehg, Condensation, CovarianceScaled, Proposal
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.linalg import squared_mahalanobis
from torchcss.show.style import save_figure
from torchcss.studies.sampling_study import StudyChoice, study_problem
from torchcss.types import Bounds, CostFunction, LocalModel, Status, frozen

CHOICE = StudyChoice(pixel_noise=2.0, prior_scale=3.0)
"""Priors that reach as far as the flip, and noise that leaves the valley there narrow."""


@frozen
class Config:
    """The slice and the samplers."""

    body: str = "arm8"
    """A body of the catalogue."""
    seed: int = 0
    """Seed of pose, noise and samples."""
    directions: tuple[int, int] = (0, 3)
    """Eigen-directions that span the slice; 0 is the most uncertain."""
    samples: int = 150
    """Samples per method."""
    deviation_scale: float = 2.0
    """Factor on the standard deviations for CSS; 4 on the covariance."""
    noise: float | None = None
    """Standard deviation of the dynamical noise, radians; CSS's along the first direction."""
    reach: float = 2.5
    """Half the side of the picture, radians."""
    resolution: int = 121
    """Points of the picture along each side."""
    out: Path | None = None
    """Folder for the figure and the table."""
    report: Path | None = None
    """Where else to write the JSON file, such as docs/results/sampler_slices.json."""


@dataclass(frozen=True)
class Plane:
    """A cost on the plane `origin + x basis^T`."""

    cost: CostFunction
    origin: Tensor  # [n]
    basis: Tensor  # [n 2]

    def take(self, items: Tensor) -> Plane:
        """The same cost for all items."""
        return self

    def value(self, x: Tensor) -> Tensor:
        """Cost in nats."""
        return self.cost.value(self.origin + x @ self.basis.mT)

    def local_model(self, x: Tensor) -> LocalModel:
        """Cost and derivatives on the plane."""
        model = self.cost.local_model(self.origin + x @ self.basis.mT)
        hessian = self.basis.mT @ model.hessian @ self.basis
        return LocalModel(model.value, model.gradient @ self.basis, hessian)


def ellipse(axis: Axes, covariance: Tensor, **style: Any) -> None:
    """Draw the curve at two standard deviations."""
    values, vectors = torch.linalg.eigh(covariance)
    width, height = (4 * values.sqrt()).tolist()
    angle = np.degrees(np.arctan2(float(vectors[1, 0]), float(vectors[0, 0])))
    axis.add_patch(Ellipse((0, 0), width, height, angle=angle, fill=False, **style))


def picture(
    config: Config, plane: Plane, own: Tensor, noise: float, runs: dict[str, Any]
) -> Figure:
    """The slice once per method, with samples and minima."""
    side = torch.linspace(-config.reach, config.reach, config.resolution, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(side, side, indexing="xy"), -1)
    height = plane.value(grid).clamp(max=1e6).log10()
    figure = Figure(figsize=(15, 5.2), layout="constrained")
    axes = figure.subplots(1, 3, sharex=True, sharey=True)
    shades = [axis.contourf(side, side, height, levels=24, cmap="Greys") for axis in axes]
    for axis, (name, (row, raw, modes, kept)) in zip(axes, runs.items(), strict=True):
        axis.plot(*raw.T, ".", ms=4, color="#D55E00", label="samples")
        axis.plot(*modes.mean[kept].T, "*", ms=13, color="#0072B2", label="minima found")
        ellipse(axis, own, ls="--", lw=1.5, color="#009E73")
        shape = {"CONDENSATION": noise**2 * torch.eye(2), "MHT": own + noise**2 * torch.eye(2)}
        scaled = config.deviation_scale**2 * own
        ellipse(axis, shape.get(name, scaled).double(), lw=1.5, color="#D55E00")
        axis.set(xlim=(-config.reach, config.reach), ylim=(-config.reach, config.reach))
        axis.set_xlabel(f"eigen-direction {config.directions[0]} (rad)")
        axis.set_title(
            f"{name}: median cost {row['median_cost']:.0f}, {100 * row['share_elsewhere']:.0f} % "
            "end elsewhere", fontsize=10,
        )  # fmt: skip
    axes[0].set_ylabel(f"eigen-direction {config.directions[1]} (rad)")
    axes[0].legend(loc="upper left")
    figure.colorbar(shades[0], ax=axes, label="log10 of the cost in nats")
    return figure


def main(config: Config) -> dict[str, Any]:
    """Sample, descend, print, draw; return what is written."""
    generator = torch.Generator().manual_seed(config.seed)
    problem = study_problem(config.body, generator=generator, choice=CHOICE)
    start = problem.start
    values, vectors = (part.flip(-1) for part in torch.linalg.eigh(start.covariance))
    plane = Plane(problem.cost, start.mean, vectors[:, list(config.directions)])
    own = torch.diag(values[list(config.directions)])
    free = torch.full((2,), torch.inf, dtype=torch.float64)
    limits = Bounds(-free, free)
    zero = torch.zeros(1, 2, dtype=torch.float64)
    mode = GaussianMixture(zero, own[None], zero[:, 0])
    noise = config.noise or config.deviation_scale * float(own[0, 0].sqrt())
    proposals: dict[str, Proposal] = {
        "CONDENSATION": Condensation(deviation=noise, include_modes=False),
        "MHT": ChamRehg(deviation=noise, include_modes=False),
        "CSS": CovarianceScaled(deviation_scale=config.deviation_scale, include_modes=False),
    }
    runs: dict[str, Any] = {}
    print(f"noise {noise:.2f} rad; deviations of the mode {own.diagonal().sqrt().tolist()}")
    for name, proposal in proposals.items():
        generator = torch.Generator().manual_seed(config.seed)
        raw = proposal.sample(mode, config.samples, limits, generator=generator).x
        modes = TrustRegionNewton(max_steps=200).minimise(plane, raw, limits)
        value = plane.value(raw)
        seen = (modes.status == Status.CONVERGED) & (modes.mean.abs() < config.reach).all(-1)
        done = torch.where(seen, modes.cost, torch.inf)
        kept = distinct_modes(modes.mean, modes.covariance, done)
        apart = squared_mahalanobis(modes.mean, own)
        row = {
            "median_cost": float(value.median()),
            "share_low": float((value < float(start.cost) + 100).double().mean()),
            "share_elsewhere": float((apart > 1).double().mean()),
            "minima": modes.mean[kept].tolist(),
            "minima_cost": modes.cost[kept].tolist(),
        }
        runs[name] = (row, raw, modes, kept)
    report = {"config": config, "noise": noise, "methods": {k: run[0] for k, run in runs.items()}}
    cells = [
        [name, row["median_cost"], 100 * row["share_low"], 100 * row["share_elsewhere"], len(kept)]
        for name, (row, _, _, kept) in runs.items()
    ]
    columns = ("sampler", "median cost", "within 100 nats %", "end elsewhere %", "minima")
    table = Table("Samplers on a slice through a cost", columns, cells)
    table.print()
    if config.out is not None:
        folder = prepare_output_folder(config.out)
        save_figure(picture(config, plane, own, noise, runs), folder / "fig8d.png", dpi=90)
        write_report(folder / "sampler_slices.json", report, table)
    write_report(config.report, report, table)
    return report


if __name__ == "__main__":
    start(main, Config, __doc__)
