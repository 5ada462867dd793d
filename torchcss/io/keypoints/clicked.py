"""2D joints that somebody clicked, by name, in one frame or some: our own JSON."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import real_numbers, shortened
from torchcss.io.keypoints.people import People
from torchcss.joint_names import JOINT_NAMES, canonical_joint_name


def read_clicked(
    path: Path, content: Mapping[str, Any], num_frames: int | None, image_size_wh: tuple[int, int]
) -> People:
    """Read joints by name, for one frame or for some."""
    size = content.get("image_size_wh")
    if size is not None and size != list(image_size_wh):
        raise KeypointError(
            f"{path}: clicked in images of {shortened(size)} pixels, "
            f"the video has {list(image_size_wh)}; click in this video"
        )
    frames = content.get("frames", {"0": content.get("joints")})
    if not isinstance(frames, dict) or not frames:
        raise KeypointError(f"{path}: expected 'frames' to name frames, found {shortened(frames)}")
    clicked: dict[int, Mapping[str, Any]] = {}
    for key, joints in frames.items():
        if not re.fullmatch(r"[0-9]{1,6}", key):
            raise KeypointError(f"{path}: expected a frame number, found {shortened(key)}")
        if isinstance(joints, dict) and isinstance(joints.get("joints"), dict):
            joints = joints["joints"]
        if not isinstance(joints, dict):
            raise KeypointError(
                f"{path}: frame {key}: expected joints by name, found {shortened(joints)}"
            )
        clicked[int(key)] = joints
    total = max(clicked) + 1 if num_frames is None else num_frames
    if max(clicked) >= total:
        raise KeypointError(
            f"{path}: frame {max(clicked)} is beyond the video, which has {total} frames"
        )
    names = tuple(dict.fromkeys(name for joints in clicked.values() for name in joints))
    triples = np.zeros((total, len(names), 3))
    for frame, joints in clicked.items():
        for name, place in joints.items():
            where = f"{path}: frame {frame}: {name}"
            numbers = real_numbers(place, where, KeypointError)
            if numbers.shape not in ((2,), (3,)):
                raise KeypointError(
                    f"{where}: expected [u, v] or [u, v, confidence], found {shortened(place)}"
                )
            triples[frame, names.index(name)] = [*numbers, 1.0][:3]
    unknown = [name for name in names if canonical_joint_name(name) is None]
    if unknown:
        raise KeypointError(
            f"{path}: unknown joint {unknown[0]!r}; the known ones are {', '.join(JOINT_NAMES)}"
        )
    return People([frame[None] for frame in triples], names, ["format: clicked joints"])
