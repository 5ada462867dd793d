"""2D joints as arrays: our own NPZ `keypoints [T J 2]`, `confidence [T J]`, `joint_names [J]`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchcss.errors import KeypointError
from torchcss.io.keypoints.people import People


def read_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> People:
    """Read our own layout of arrays."""
    if "keypoints" not in arrays:
        raise KeypointError(
            f"{path}: expected the arrays keypoints, confidence and joint_names, "
            f"found {', '.join(arrays) or 'none'}"
        )
    keypoints = arrays["keypoints"]
    if keypoints.ndim != 3 or keypoints.shape[2] != 2 or keypoints.dtype.kind not in "iuf":
        raise KeypointError(
            f"{path}: keypoints: expected numbers [frames, joints, 2], "
            f"got {keypoints.dtype} {list(keypoints.shape)}"
        )
    shape = keypoints.shape[:2]
    if 0 in shape:
        raise KeypointError(f"{path}: keypoints: expected frames and joints, got {list(shape)}")
    finite = np.isfinite(keypoints[..., 0]) & np.isfinite(keypoints[..., 1])
    confidence = arrays.get("confidence", finite.astype(np.float64))
    if confidence.shape != shape or confidence.dtype.kind not in "biuf":
        raise KeypointError(
            f"{path}: confidence: expected numbers {list(shape)}, "
            f"got {confidence.dtype} {list(confidence.shape)}"
        )
    names = arrays.get("joint_names")
    if names is not None and (names.shape != shape[1:] or names.dtype.kind != "U"):
        raise KeypointError(
            f"{path}: joint_names: expected {shape[1]} names, got {names.dtype} {list(names.shape)}"
        )
    found = np.dstack([keypoints, confidence]).astype(np.float64)
    report = ["format: NPZ"]
    if "confidence" not in arrays:
        report.append("no confidence in the file: 1 for every joint that is a number")
    known = None if names is None else tuple(map(str, names))
    return People([[person] for person in found], known, report)
