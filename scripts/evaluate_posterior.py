"""How good a posterior is: leading mode, best mode, weights and regions, over many clips.

    python scripts/evaluate_posterior.py --data clips --out posterior.json
    python scripts/evaluate_posterior.py --data clips --seeds 3 --samples 200 --out J

DIR holds clips as folders (`video.mp4`, `cameras.json`, `keypoints2d.npz`, `reference3d.npz`), as
`scripts/make_clips.py` and `scripts/make_sequence.py` write them, or is one of them. Each is
tracked with every seed. Of each run, over its frames:

| column | meaning |
|---|---|
| PA, root | error of the leading mode after Procrustes, and with the hips on each other, mm |
| best PA, best root | the same of the mode that is nearest by that error |
| smooth PA, root | of the smoothed track |
| lag PA, root | of the same with 15 frames after each in view (`--lag`) |
| rank | place of the nearest mode by weight; 1 is the first |
| cal. | mean absolute difference between stated and true shares of joints in ten regions |
| in 90 % | share of joints in the region that should hold 90 % |
| NLL | negative log density of a joint's place under the mixture, nats, in cubic metres |
| lost | frames that are lost |
| s | the processor's seconds a frame |

Regions are those of places from the middle of the hips, as the errors are. The last rows are the
median and the mean over the clips, and the calibration error of the shares over all of them.
Runs are kept in `--runs`; those that are there already are not made again.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import Table, finish, start
from jaxtyping import Float
from torch import Tensor

from torchcss import Run, Settings, smooth, track_video
from torchcss.body.bases import pose_track
from torchcss.body.uncertainty import joint_covariance
from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.joint_names import LIMB_JOINTS
from torchcss.linalg import squared_mahalanobis
from torchcss.studies.evaluation import evaluate
from torchcss.studies.sequences import read_reference
from torchcss.tracking.smooth import Smoothing
from torchcss.types import frozen

FILES = ("video.mp4", "cameras.json", "keypoints2d.npz", "reference3d.npz")
LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
HEADS = ("clip", "PA", "best PA", "root", "best root", "smooth PA", "smooth root", "lag PA",
         "lag root", "rank", "cal.", "in 90 %", "NLL", "lost", "s")  # fmt: skip


TRACKING = Settings(overlay=False)


@frozen
class Config:
    """Which clips, tracked how."""

    data: Path
    """Folder of the clips, or of one."""
    out: Path | None = None
    """JSON file to write."""
    runs: Path = Path("posterior-runs")
    """Folder of the runs."""
    seeds: int = 1
    """Number of seeds, from --seed on."""
    frames: int | None = None
    """Only the first frames of each clip."""
    tracking: SettingsOptions = TRACKING
    """How to track."""
    smooth: bool = True
    """Whether to smooth each track too, with all frames in view and with `--lag`."""
    lag: int = 15
    """Frames after each that may say something of it, at that lag."""
    deviation: float | None = None
    """Standard deviation of the references, metres; what they say of themselves by default, or
    0.02. Zero: they are exact."""


def find_clips(data: Path) -> list[Path]:
    """The folders that hold a clip."""
    clips = [
        folder
        for folder in (data, *sorted(path for path in data.glob("*") if path.is_dir()))
        if all((folder / name).exists() for name in FILES)
    ]
    if not clips:
        raise ConfigurationError(f"{data}: no clip in it, that is no folder with {FILES}")
    return clips


def track(config: Config, clip: Path, seed: int) -> tuple[Run, float | None]:
    """The run of a clip, and the processor's seconds a frame if it was made now."""
    folder = config.runs / clip.name / str(seed)
    if (folder / "summary.json").exists():
        return Run.open(folder), None
    video, camera, keypoints, _ = (clip / name for name in FILES)
    began = time.process_time()
    run = track_video(
        video,
        camera=camera,
        keypoints=keypoints,
        out=folder,
        settings=replace(config.tracking, seed=seed),
        stop=config.frames,
    )
    return run, (time.process_time() - began) / max(1, len(run.track.frames))


class Apart(NamedTuple):
    """The limbs' joints of all modes against their true places, with the hips on each other.

    Attributes:
        offset: Metres.
        covariance: Stated covariances of the joints, and the reference's.
        log_weight: Of the modes; `-inf` where there is none.
    """

    offset: Float[Tensor, "t k j 3"]
    covariance: Float[Tensor, "t k j 3 3"]
    log_weight: Float[Tensor, "t k"]

    @property
    def rank(self) -> float:
        """Mean place of the nearest mode by weight."""
        distance = self.offset.norm(dim=-1).nanmean(-1)
        distance[self.log_weight.isinf()] = torch.inf
        return 1 + float(distance.argmin(1).double().mean())

    @property
    def nll(self) -> float:
        """Mean negative log density of a joint's true place under the mixture, nats."""
        exponent = -0.5 * squared_mahalanobis(self.offset, self.covariance)
        height = -0.5 * torch.logdet(2 * math.pi * self.covariance)
        density = (self.log_weight[..., None] + height + exponent).logsumexp(1)
        return -float(density[density.isfinite()].mean())


def compare(run: Run, reference: Path, deviation_m: float) -> Apart:
    """Every mode of a run against the truth, which errs by so much per coordinate."""
    found = run.track
    true, names = read_reference(reference)
    joints = [name for name in LIMB_JOINTS if name in names and name in found.joint_names]
    here = [found.joint_names.index(name) for name in joints]
    there = [list(names).index(name) for name in joints]
    hips = [joints.index(name) for name in ("l_hip", "r_hip")]

    def about_hips(places: np.ndarray) -> Tensor:
        return torch.from_numpy(places - places[..., hips, :].mean(-2, keepdims=True))

    offset = about_hips(found.joints_world[:, :, here])
    offset = offset - about_hips(true[found.frames][:, there])[:, None]
    state, spread = torch.from_numpy(found.state), torch.from_numpy(found.covariance)
    base = torch.from_numpy(found.base_transform)[:, None]
    pose = pose_track(run.body, state, base.expand(-1, state.shape[1], -1, -1))
    hips_of_body = [here[index] for index in hips]
    covariance = joint_covariance(run.body, pose, spread, about=hips_of_body, held=found.held)
    covariance = covariance[:, :, here]
    own = deviation_m**2 * torch.eye(3).to(covariance)
    return Apart(offset, covariance + own, torch.from_numpy(found.log_weight))


def measure(config: Config, clip: Path, seed: int) -> dict[str, Any]:
    """One row of the table."""
    run, seconds = track(config, clip, seed)
    reference = clip / "reference3d.npz"
    found = evaluate(run, reference, deviation_m=config.deviation)
    errors, inside = found.errors, found.inside(levels=LEVELS)
    apart = compare(run, reference, found.deviation_m)
    row = {
        "clip": clip.name,
        "seed": seed,
        "PA": errors.procrustes.mean_mm,
        "best PA": errors.procrustes_best_of_modes.mean_mm,
        "root": errors.root_aligned.mean_mm,
        "best root": errors.root_aligned_best_of_modes.mean_mm,
        **dict.fromkeys(("smooth PA", "smooth root", "lag PA", "lag root")),
        "rank": apart.rank,
        "cal.": miss(inside),
        "inside": inside,
        "in 90 %": inside[0.9],
        "NLL": apart.nll,
        "lost": int(errors.lost.sum()),
        "s": seconds,
    }
    if config.smooth and len(found.frames) > 2:
        for name, lag in (("smooth", None), ("lag", config.lag)):
            errors = evaluate(smooth(run, Smoothing(lag=lag)), reference).errors
            row[f"{name} PA"] = errors.procrustes.mean_mm
            row[f"{name} root"] = errors.root_aligned.mean_mm
    return row


def main(config: Config) -> dict[str, Any]:
    """Track, measure, print, write; return what is written."""
    if config.seeds < 1:
        raise ConfigurationError(f"--seeds {config.seeds}: expected at least 1")
    first, rows = config.tracking.seed, []
    for clip in find_clips(config.data):
        for seed in range(first, first + config.seeds):
            rows.append(measure(config, clip, seed))
            print(json.dumps(rows[-1]), flush=True)
    by_clip: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_clip.setdefault(row["clip"], []).append(row)
    cells = [[clip, *over(own, np.mean)] for clip, own in by_clip.items()]
    columns = list(zip(*(row[1:] for row in cells), strict=True))
    for name, middle in (("median", np.median), ("mean", np.mean)):
        cells.append([name, *(summed(column, middle) for column in columns)])
    pooled = {level: float(np.mean([row["inside"][level] for row in rows])) for level in LEVELS}
    last = {"clip": "all together", "cal.": miss(pooled)}
    cells.append([last.get(name) for name in HEADS])
    table = Table(f"{len(by_clip)} clips, {config.seeds} seeds", HEADS, cells)
    report = {
        "settings": asdict(config.tracking), "frames": config.frames, "rows": rows,
        "inside": pooled,
    }  # fmt: skip
    return finish(config.out, report, table)


def miss(inside: Mapping[float, float]) -> float:
    """The calibration error: mean absolute difference of shares and levels."""
    return float(np.mean([abs(share - level) for level, share in inside.items()]))


def over(rows: list[dict[str, Any]], middle: Callable[[list[float]], Any]) -> list[float | None]:
    """The numbers of several runs of a clip as one row."""
    return [summed([row[name] for row in rows], middle) for name in HEADS[1:]]


def summed(values: Sequence[float | None], middle: Callable[[list[float]], Any]) -> float | None:
    """The middle of what is known."""
    known = [value for value in values if value is not None]
    return float(middle(known)) if known else None


if __name__ == "__main__":
    start(main, Config, __doc__)
