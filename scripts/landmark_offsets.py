"""Where a detector's keypoints lie on a body: their offsets from the joints, on clips with truth.

    python scripts/landmark_offsets.py --data clips --out landmark_offsets.json

DIR holds clips as for `scripts/evaluate_posterior.py`, whose `keypoints2d.npz` are a detector's
(`torchcss detect`). Of each joint, left and right together, the offset is the constant place in
axes of the body that explains its keypoints best in all frames and clips, with Lorentzian errors
of the scale `--scale`: millimetres to the left (of a right joint: to the right), up and forwards.

| joints | left | up |
|---|---|---|
| hips, shoulders | from the right one to the left | from the hips to the shoulders |
| elbows, wrists, knees, ankles | as the hips or shoulders have it | along the limb, to the trunk |
| heels, toes | across the foot | from the heel to the ankle |
| nose, eyes, ears | from the right ear to the left | from the shoulders to the ears |

*Spread* is its standard deviation over the clips, *before* and *after* are the median distances of
keypoint and joint at the joint's depth, without and with the offset. An offset that a detector had
on every body could be taken out of its keypoints; one that differs from clip to clip cannot.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import Table, finish, start
from evaluate_posterior import find_clips

from torchcss import read_camera, read_keypoints
from torchcss.body.catalog import without_side
from torchcss.studies.sequences import read_reference
from torchcss.types import frozen

HEADS = ("joint", "keypoints", "left", "up", "forwards", "spread", "before", "after")

_LIMBS = {"elbow": "shoulder", "wrist": "elbow", "knee": "hip", "ankle": "knee"}
"""Each joint of a limb, and the one above it."""

_STEP = 1e-4
"""Metres by which joints are moved to see how their pictures move."""

_FEWEST = 20
"""Keypoints of a joint that tell a clip's own offset."""


@frozen
class Config:
    """Which clips."""

    data: Path
    """Folder of the clips, or of one."""
    scale: float = 0.05
    """Scale of the errors, metres."""
    out: Path | None = None
    """JSON file to write."""


class Seen(NamedTuple):
    """Keypoints of one joint in one clip, in metres at the joint's depth.

    Attributes:
        slope: How the picture moves with an offset, `[n 2 3]`.
        error: From the joint to its keypoint, `[n 2]`.
        weight: Confidences, `[n]`.
    """

    slope: np.ndarray
    error: np.ndarray
    weight: np.ndarray


def axes(joints: dict[str, np.ndarray], name: str) -> np.ndarray | None:
    """The axes left, up and forwards at a joint as columns, `[t 3 3]`; None: joints are missing."""
    kind, side = without_side(name), name[:2]
    pairs = {pair: (f"l_{pair}", f"r_{pair}") for pair in ("hip", "shoulder", "ear")}
    across = {
        pair: joints[left] - joints[right]
        for pair, (left, right) in pairs.items()
        if left in joints and right in joints
    }
    middle = {pair: 0.5 * (joints[f"l_{pair}"] + joints[f"r_{pair}"]) for pair in across}
    if not {"hip", "shoulder"} <= across.keys():
        return None
    if kind in ("hip", "shoulder"):
        return _frame(across[kind], middle["shoulder"] - middle["hip"])
    if kind in _LIMBS and side + _LIMBS[kind] in joints:
        up = joints[side + _LIMBS[kind]] - joints[name]
        left = across["hip" if kind in ("knee", "ankle") else "shoulder"]
        return _frame(left - (left * up).sum(-1, keepdims=True) * up / (up**2).sum(-1)[:, None], up)
    ends = [side + end for end in ("heel", "toe", "ankle")]
    if kind in ("heel", "toe") and all(end in joints for end in ends):
        heel, toe, ankle = (joints[end] for end in ends)
        return _frame(np.cross(ankle - heel, toe - heel), ankle - heel)
    if kind in ("nose", "eye", "ear") and "ear" in across:
        return _frame(across["ear"], middle["ear"] - middle["shoulder"])
    return None


def _frame(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    left = left / np.linalg.norm(left, axis=-1, keepdims=True)
    up = up - (up * left).sum(-1, keepdims=True) * left
    up = up / np.linalg.norm(up, axis=-1, keepdims=True)
    return np.stack([left, up, np.cross(left, up)], axis=-1)


def look(clip: Path) -> Iterator[tuple[str, Seen]]:
    """What a clip shows of each joint that has keypoints and a place."""
    camera = read_camera(clip / "cameras.json")
    places, names = read_reference(clip / "reference3d.npz")
    joints = dict(zip(names, np.moveaxis(places, 1, 0), strict=True))
    keypoints = read_keypoints(clip / "keypoints2d.npz", image_size_wh=camera.image_size_wh)
    num = min(len(places), len(keypoints.confidence))

    def project(points: np.ndarray) -> np.ndarray:
        return camera.project(torch.from_numpy(points)).uv.numpy()

    for column, name in enumerate(keypoints.names):
        frame = axes(joints, name) if name in joints else None
        if frame is None:
            continue
        frame = frame * (np.array([-1.0, 1, 1]) if name.startswith("r_") else 1.0)
        place, moved = joints[name], _STEP * np.moveaxis(frame, -1, 0)
        slope = np.stack([project(place + m) - project(place - m) for m in moved], -1) / (2 * _STEP)
        error = keypoints.positions[:num, column].numpy() - project(place)[:num]
        weight = keypoints.confidence[:num, column].numpy()
        metre = np.sqrt((slope[:num] ** 2).sum((1, 2)) / 2)  # pixels
        known = (weight > 0) & np.isfinite(error).all(1) & np.isfinite(metre) & (metre > 0)
        slope, metre = slope[:num][known], metre[known, None]
        yield (
            without_side(name),
            Seen(slope / metre[..., None], error[known] / metre, weight[known]),
        )


def offset(seen: Seen, scale: float) -> np.ndarray:
    """The offset that explains keypoints best, metres."""
    found = np.zeros(3)
    for _ in range(20):
        left = seen.error - seen.slope @ found
        weight = seen.weight / (1 + (left**2).sum(1) / scale**2)
        normal = np.einsum("n,nik,nil->kl", weight, seen.slope, seen.slope)
        found = np.linalg.solve(
            normal + 1e-9 * np.eye(3), np.einsum("n,nik,ni->k", weight, seen.slope, seen.error)
        )
    return found


def together(parts: list[Seen]) -> Seen:
    """Several as one."""
    return Seen(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    by_joint: dict[str, dict[str, list[Seen]]] = defaultdict(lambda: defaultdict(list))
    for clip in find_clips(config.data):
        for joint, seen in look(clip):
            by_joint[joint][clip.name].append(seen)
    rows = []
    for joint, clips in by_joint.items():
        each = [together(parts) for parts in clips.values()]
        every = together(each)
        if not len(every.error):
            continue
        found = offset(every, config.scale)
        own = [offset(seen, config.scale) for seen in each if len(seen.error) >= _FEWEST]
        apart = every.error, every.error - every.slope @ found
        rows.append(
            [joint, len(every.error), *(1e3 * found).tolist()]
            + [1e3 * float(np.std(own, 0).mean()) if len(own) > 1 else None]
            + [1e3 * float(np.median(np.linalg.norm(each, axis=1))) for each in apart]
        )
    table = Table("Offsets of keypoints from joints, mm", HEADS, rows)
    return finish(config.out, {"clips": len(find_clips(config.data)), "rows": rows}, table)


if __name__ == "__main__":
    start(main, Config, __doc__)
