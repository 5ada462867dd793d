"""Which likelihood power predicts keypoints best that the tracker has not seen.

    python scripts/predictive_power.py --data clips --out predictive_power.json

DIR holds clips as for `scripts/evaluate_posterior.py`; their 3D references are not read. Each is
tracked with every power, and two limbs have no keypoints below shoulder and hip: left arm and right
leg for `BLOCK` frames, then right arm and left leg, and so on; all are seen in the first frame. The
posterior of a frame predicts those keypoints of the same frame that were kept back (elbows, wrists,
knees and ankles); with `--keypoints-use first` they are those of all limbs. It is the mixture

    p(uv) = (1 - e) sum_k w_k N(uv; c_k, J_k S_k J_k' + s^2 I / confidence) + e / area

of the modes with their weights w and stated covariances S, where c is a joint's place in the
picture, J its Jacobian, and e the share of keypoints that lie anywhere in it (`OUTLIERS`). Scored
is the mean log density, nats a keypoint. The detector's noise s is fitted for each clip and power,
so that no power gains by a wrong one.

Whole limbs are kept back, and for several frames, since else there is little to predict: a wrist
lies beside its own keypoint of the frame before, with the same error, and beside the hand's, and
any pose that fits this frame's keypoints predicts the next one's. Where a limb has no keypoints,
modes differ in the picture, and the power says how far to trust what picture and priors tell of
them: with too large a power modes are too narrow and the leading one is too sure.

The table has a row for each clip: its scores less that with the reference power (`--reference`),
its best power, the power that is best for all other clips, and the score with that less those with
its own and with the reference; then the mean over the clips and its standard error. Runs are kept
in `--runs`; those that are there already go on where they ended.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import Table, finish, start
from degrade_clips import twin
from evaluate_posterior import find_clips
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss import Run, Settings, track_video
from torchcss.app.track import TrackOptions
from torchcss.body.bases import pose_track
from torchcss.body.uncertainty import joint_covariance
from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.files import prepare_output_folder, save_arrays
from torchcss.io.keypoints.read import read_keypoints
from torchcss.joint_names import canonical_joint_name
from torchcss.types import frozen
from torchcss.vision.camera import Camera

PREDICTED = ("l_elbow", "l_wrist", "r_knee", "r_ankle")
KEPT_BACK = (*PREDICTED, "l_hand_tip", "r_heel", "r_midtarsal", "r_toe")
"""What is kept back in the first block; in the next one those of the other side."""
BLOCK = 8
"""Frames for which the same limbs have no keypoints."""
OUTLIERS = 0.05
NOISES_PX = tuple(np.geomspace(0.5, 50.0, 47).tolist())
"""Noises of which the best is taken."""
POWERS = (0.03, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)
TRACKING = Settings(overlay=False)


@frozen
class Config:
    """Which clips, tracked how."""

    data: tuple[Path, ...]
    """Folders of clips, or clips."""
    powers: tuple[float, ...] = POWERS
    """Likelihood powers."""
    reference: float = 0.15
    """The power that scores are compared with, one of them."""
    frames: int = 4 * BLOCK + 1
    """Only the first frames of each clip."""
    tracking: SettingsOptions = TRACKING
    """How to track, but for the power."""
    runs: Path = Path("predictive-runs")
    """Folder of the runs."""
    out: Path | None = None
    """JSON file to write."""


def kept_back(names: tuple[str, ...], num_frames: int) -> Bool[np.ndarray, "t j"]:
    """Which keypoints the tracker does not see, by frame and the joints' names."""
    gone = np.zeros((num_frames, len(names)), bool)
    first, other = np.isin(names, KEPT_BACK), np.isin(names, [*map(twin, KEPT_BACK)])
    block = np.arange(num_frames - 1) // BLOCK
    gone[1:] = np.where((block % 2 == 0)[:, None], first, other)
    return gone


def name_of(clip: Path) -> str:
    """What a clip is called beside those of other folders."""
    return "/".join(clip.absolute().parts[-2:])


def track(config: Config, clip: Path, power: float) -> Run:
    """The run of a clip without the keypoints that are kept back."""
    folder = config.runs / name_of(clip) / f"{power:g}"
    with np.load(clip / "keypoints2d.npz") as file:
        arrays = dict(file)
    names = tuple(canonical_joint_name(str(name)) or "" for name in arrays["joint_names"])
    gone = kept_back(names, len(arrays["confidence"]))
    arrays["confidence"] = np.where(gone, 0.0, arrays["confidence"])
    arrays["keypoints"] = np.where(gone[..., None], np.nan, arrays["keypoints"])
    shown = prepare_output_folder(folder.parent) / "keypoints2d.npz"
    save_arrays(shown, arrays)
    return track_video(
        clip / "video.mp4",
        camera=clip / "cameras.json",
        keypoints=shown,
        out=folder,
        settings=replace(config.tracking, likelihood_power=power),
        stop=config.frames,
        options=TrackOptions(resume=True),
    )


class Prediction(NamedTuple):
    """What the modes say of keypoints that were kept back, one row for each of `m`.

    Attributes:
        offset: Of the keypoint from a joint's place in the picture, pixels; infinite where the
            camera does not see that.
        covariance: Of that place, square pixels.
        log_weight: Of the modes; `-inf` where there is none.
        confidence: The detector's.
        area: Of the picture, square pixels.
    """

    offset: Float[Tensor, "m k 2"]
    covariance: Float[Tensor, "m k 2 2"]
    log_weight: Float[Tensor, "m k"]
    confidence: Float[Tensor, " m"]
    area: float

    def score(self, noise_px: float) -> float:
        """Mean log density of a keypoint, nats."""
        own = (noise_px**2 / self.confidence)[:, None, None, None] * torch.eye(2).double()
        wide = self.covariance + own
        solved = torch.linalg.solve(wide, self.offset.nan_to_num(posinf=0.0)[..., None])[..., 0]
        exponent = -0.5 * (self.offset * solved).sum(-1)
        density = self.log_weight + exponent - 0.5 * torch.logdet(2 * math.pi * wide)
        density = torch.where(self.offset.isfinite().all(-1), density, -torch.inf).logsumexp(-1)
        anywhere = density.new_tensor(math.log(OUTLIERS / self.area))
        return float(torch.logaddexp(math.log1p(-OUTLIERS) + density, anywhere).mean())

    def best(self) -> tuple[float, float]:
        """The score with the noise that predicts best, and that noise in pixels."""
        return max((self.score(noise), noise) for noise in NOISES_PX)


def in_picture(
    camera: Camera, joints: Float[Tensor, "*b j 3"], covariance: Float[Tensor, "*b j 3 3"]
) -> tuple[Float[Tensor, "*b j 2"], Float[Tensor, "*b j 2 2"]]:
    """Places in the picture, infinite where it does not show them, and their covariances."""
    points = joints.detach().requires_grad_()
    seen = camera.project(points)
    rows = [
        torch.autograd.grad(seen.uv[..., k].sum(), points, retain_graph=True)[0] for k in (0, 1)
    ]
    jacobian = torch.stack(rows, -2)
    place = torch.where(seen.valid[..., None], seen.uv.detach(), torch.inf)
    return place, jacobian @ covariance @ jacobian.mT


def predict(run: Run, clip: Path) -> Prediction:
    """The posterior of each frame against the keypoints of that frame that were kept back."""
    camera, found = run.camera, run.track
    size = camera.image_size_wh
    keypoints = read_keypoints(clip / "keypoints2d.npz", image_size_wh=size)
    known = {*keypoints.names} & {*found.joint_names}
    joints = [name for name in (*PREDICTED, *map(twin, PREDICTED)) if name in known]
    here = [found.joint_names.index(name) for name in joints]
    there = [keypoints.names.index(name) for name in joints]
    gone = torch.from_numpy(kept_back(tuple(joints), len(keypoints.positions)))[found.frames]
    if run.settings.get("keypoints_use") == "first":
        gone[1:] = True
    gone &= keypoints.known[found.frames][:, there]
    state, spread = torch.from_numpy(found.state), torch.from_numpy(found.covariance)
    base = torch.from_numpy(found.base_transform)[:, None].expand(-1, state.shape[1], -1, -1)
    pose = pose_track(run.body, state, base)
    covariance = joint_covariance(run.body, pose, spread)[:, :, here]
    place, covariance = in_picture(camera, pose.joints[:, :, here], covariance)
    offset = keypoints.positions[found.frames][:, None, there] - place
    weight = torch.from_numpy(found.log_weight)[..., None].expand(-1, -1, len(here))
    modes = (part.transpose(1, 2)[gone] for part in (offset, covariance, weight))
    confidence = keypoints.confidence[found.frames][:, there][gone]
    return Prediction(*modes, confidence=confidence, area=math.prod(size))


def measure(config: Config, clip: Path) -> dict[str, Any]:
    """Scores and noises of a clip by power."""
    found = [predict(track(config, clip, power), clip) for power in config.powers]
    if not len(found[0].offset):
        raise ConfigurationError(f"{clip}: no keypoint of a limb that could be kept back")
    scores, noises = zip(*(prediction.best() for prediction in found), strict=True)
    known = {"clip": name_of(clip), "keypoints": len(found[0].offset)}
    return known | {"scores": scores, "noise_px": noises}


def main(config: Config) -> dict[str, Any]:
    """Track, score, print, write; return what is written."""
    if config.reference not in config.powers:
        raise ConfigurationError(f"--reference {config.reference}: not one of --powers")
    rows = []
    for clip in (clip for folder in config.data for clip in find_clips(folder)):
        rows.append(measure(config, clip))
        print(json.dumps(rows[-1]), flush=True)
    told = {"settings": asdict(config.tracking), "frames": config.frames, "powers": config.powers}
    report = told | {"rows": rows}
    return finish(config.out, report, table_of(rows, config))


def table_of(rows: list[dict[str, Any]], config: Config) -> Table:
    """How the powers compare on each clip, and how the best of the others does."""
    scores = np.array([row["scores"] for row in rows])
    others = (scores.sum(0) - scores) if len(rows) > 1 else scores
    chosen, own, each = others.argmax(1), scores.argmax(1), np.arange(len(rows))
    gain = scores - scores[:, [config.powers.index(config.reference)]]
    loss, against = scores[each, chosen] - scores[each, own], gain[each, chosen]
    numbers = np.column_stack([gain, loss, against])
    cells: list[list[str | float | None]] = [
        [row["clip"], *own_gain, config.powers[best], config.powers[other], missed, more]
        for row, own_gain, best, other, missed, more in zip(
            rows, gain.tolist(), own, chosen, loss.tolist(), against.tolist(), strict=True
        )
    ]
    error = numbers.std(0, ddof=1) / len(rows) ** 0.5 if len(rows) > 1 else np.nan * numbers[0]
    for name, values in (("mean", numbers.mean(0)), ("standard error", error)):
        *of_powers, missed, more = values.tolist()
        cells.append([name, *of_powers, None, None, missed, more])
    heads = ("clip", *(f"{power:g}" for power in config.powers), "best", "others' best")
    columns = (*heads, "less its own", f"less {config.reference:g}")
    title = f"Keypoints kept back, nats less those with power {config.reference:g}"
    return Table(title, columns, cells)


if __name__ == "__main__":
    start(main, Config, __doc__)
