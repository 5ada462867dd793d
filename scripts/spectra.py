"""Spectra of costs: how uncertain a mode is along its eigen-directions (Fig. 5 [IJRR]).

    python scripts/spectra.py --sequences ARM CLUTTER --frames 30 --out spectra.json

Each sequence folder is tracked by the paper's sampler with the paper's cost, edges and motion
boundaries and flow, keypoints in the first frame alone. Of the best mode of every frame the inverse
Hessian is taken on the parameters that no limit holds, with no cap on its width:

| column | meaning |
|---|---|
| largest over smallest | deviation along the widest eigen-direction over the narrowest's |
| volume | the ball of the widest deviation over the ellipsoid, power of 10 |
| floored | share of the frames in which some mode's Hessian was given a least curvature |

Numbers are medians over the frames, then over the seeds. The same is said of the cost of joints in
one image (section 7 [IJRR], `torchcss.studies.sampling_study`) for the paper's bodies, of 8 and 32
parameters, at a start mode of each of `--poses` seeds.
"""

from __future__ import annotations

from statistics import median
from typing import Any, NamedTuple

import torch
from common import Table, finish, start
from common.comparison import Comparison
from jaxtyping import Float
from torch import Tensor

from torchcss import Settings
from torchcss.cli.options import SettingsOptions
from torchcss.inference.trust_region import default_prior_variance
from torchcss.io.video import VideoReader
from torchcss.linalg import constrained_inverse
from torchcss.studies.comparison import find_start, session_of
from torchcss.studies.sampling_study import spectrum, study_problem
from torchcss.studies.sequences import RecordedSequence, read_sequence
from torchcss.types import frozen

TRACKING = Settings(preset="ijrr_css", overlay=False)
BODIES = ("arm8", "body32")
"""Of Fig. 5."""


@frozen
class Config(Comparison):
    """What is tracked, and how long."""

    frames: int = 30
    """Frames of each run."""
    poses: int = 10
    """Poses of each body whose joints are seen in one image."""
    tracking: SettingsOptions = TRACKING
    """How to track. The seed is the first of the seeds; the body counts where the sequence does not
    say which one moved."""


class Spread(NamedTuple):
    """How unlike the deviations of a mode are.

    Attributes:
        ratio: Largest over smallest.
        volume: Power of ten of the ball of the largest over the ellipsoid.
    """

    ratio: float
    volume: float


def spread_of(covariance: Float[Tensor, "n n"]) -> Spread:
    """Of a covariance whose held parameters have no width."""
    free = torch.nonzero(covariance.diagonal() > 0)[:, 0]
    deviation = spectrum(covariance[free][:, free])
    logs = (deviation[0] / deviation).log10()
    return Spread(float(deviation[0] / deviation[-1]), float(logs.sum()))


def track(sequence: RecordedSequence, settings: Settings, frames: int) -> dict[str, Any]:
    """The medians over the frames of one run."""
    session = session_of(sequence, settings, find_start(sequence, settings))
    spreads, floored = [], []
    for tracked in session.track(VideoReader(sequence.video, stop=frames)):
        spreads.append(spread_of(tracked.state.mixture.covariance[0].double().cpu()))
        floored.append(float(tracked.info.num_floored > 0))
    ratio, volume = (median(values) for values in zip(*spreads, strict=True))
    return {
        "seed": settings.seed, "ratio": ratio, "volume": volume, "body": session.state.body.name,
        "floored": sum(floored) / len(floored), "ratio_by_frame": [each.ratio for each in spreads],
    }  # fmt: skip


def of_joints(body: str, seed: int) -> dict[str, Any]:
    """The same of a pose whose joints are seen in one image."""
    problem = study_problem(body, generator=torch.Generator().manual_seed(seed))
    covariance, floored = constrained_inverse(
        problem.cost.local_model(problem.start.mean[None]).hessian[0],
        problem.start.active == 0,
        default_prior_variance(problem.bounds),
    )
    spread = spread_of(covariance)
    return {"seed": seed, **spread._asdict(), "body": body, "floored": float(floored)}


def main(config: Config) -> dict[str, Any]:
    """Track, print, write; return what is written."""
    found: dict[str, list[dict[str, Any]]] = {}
    cells: list[list[str | float | None]] = []
    for folder in config.sequences:
        sequence = read_sequence(folder)
        every = [config.settings_of(sequence, seed) for seed in config.all_seeds]
        found[sequence.name] = runs = [track(sequence, each, config.frames) for each in every]
        cells.append([f"{sequence.name}, {every[0].body}", *medians(runs)])
    for body in BODIES:
        found[f"joints of {body}"] = runs = [of_joints(body, seed) for seed in range(config.poses)]
        cells.append([f"joints in one image, {body}", *medians(runs)])
    columns = ("sequence, body", "largest over smallest", "volume, power of 10", "floored")
    table = Table("Spectra of the image's cost", columns, cells)
    return finish(config.out, {"frames": config.frames, "by_sequence": found}, table)


def medians(runs: list[dict[str, Any]]) -> list[float]:
    """What the table says of some runs."""
    return [median(run[name] for run in runs) for name in ("ratio", "volume", "floored")]


if __name__ == "__main__":
    start(main, Config, __doc__)
