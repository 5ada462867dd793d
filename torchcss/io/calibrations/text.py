"""Calibrations in plain text: KITTI, ROS, INI, a matrix alone, and COLMAP's `cameras.txt`.

Call `read_calibration_text`.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

from torchcss.errors import CameraError
from torchcss.files import read_text, shortened
from torchcss.io.calibrations.colmap import colmap_cameras
from torchcss.io.calibrations.content import is_one_camera, one_camera
from torchcss.io.calibrations.entry import Entry

BY_HAND = "give K, image_size_wh and distortion in a cameras.json, or COLMAP's cameras.txt"
"""What to do with a calibration that no reader knows."""

_DLT = 11
"""Coefficients of a camera in the direct linear transformation."""


def read_calibration_text(path: Path) -> dict[str, Entry]:
    """A matrix alone, numbers below or behind what they are, or COLMAP's cameras.

    Raises:
        CameraError: If it is none of them.
    """
    text = read_text(path, CameraError)
    lines = {
        f"{path}: line {number}": line.strip(" \t,;[]")
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    }
    found: dict[str, list[float]] = {}
    word = ""
    for line in lines.values():
        if match := re.fullmatch(r"([A-Za-z]\w*+(?: \w++)*+)?+:?([-+0-9.eE\s,;]*)", line):
            word = match[1] or word
            with suppress(ValueError):
                numbers = map(float, re.split(r"[\s,;]+", match[2].strip(" \t,;")))
                found.setdefault(word, []).extend(numbers)
    values: dict[str, Any] = {w: n[0] if len(n) == 1 else n for w, n in found.items()}
    if len(found) == 1 and len(*found.values()) in (9, 12):
        values = {"K": next(iter(found.values()))}
    if is_one_camera(values):
        return one_camera(path, values)
    rows = {w: re.split(r"[\s,;]+", line) for w, line in lines.items()}
    if not any(re.search("[A-Z]{3}", row[1]) for row in rows.values() if len(row) > 3):
        what = f"found {len(rows)} rows such as {shortened(next(iter(lines.values()), ''))}"
        numbers = re.fullmatch(r"[-+0-9.eE\s,;]+", "".join(lines.values()))
        if numbers and _DLT in (len(rows), *map(len, rows.values())):
            what = "it looks like the 11 coefficients of a DLT, which tell of no image size"
        known = "K, P (3 x 4), numbers below their names (KITTI) or COLMAP's cameras"
        raise CameraError(f"{path}: expected {known}; {what}; {BY_HAND}")
    return colmap_cameras(path, rows, text)
