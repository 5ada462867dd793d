"""Calibrations in XML of OpenCV, OpenPose and Metashape.

Call `read_calibration_xml`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchcss.body.files.xml import parse_xml
from torchcss.errors import CameraError
from torchcss.files import refusing
from torchcss.io.calibrations.content import one_camera
from torchcss.io.calibrations.entry import Entry
from torchcss.io.calibrations.matrices import as_lists
from torchcss.joint_names import names_in


def read_calibration_xml(path: Path) -> dict[str, Entry]:
    """What OpenCV and OpenPose store as XML, or Metashape as Agisoft's.

    Raises:
        CameraError: If it is no such XML.
    """
    root = parse_xml(path, "OpenCV's XML", CameraError)
    found: dict[str, Any] = {}
    for element in root:
        parts = {part.tag: (part.text or "").split() for part in element}
        try:
            if parts.get("data"):
                sides = {side: int(parts[side][0]) for side in ("rows", "cols") if side in parts}
                data = [float(word) for word in parts["data"]]
                found[element.tag] = as_lists({**sides, "data": data})
            else:
                found[element.tag] = json.loads((element.text or "").strip() or "null")
        except (ValueError, IndexError):
            found[element.tag] = (element.text or "").strip()
    return one_camera(path, _from_the_middle(found) if root.tag == "calibration" else found)


def _from_the_middle(found: Mapping[str, Any]) -> dict[str, Any]:
    """Metashape's numbers in OpenCV's words: it has p2 before p1, and a middle where we have 0."""
    words = names_in("f cx cy b1 b2 width height p1 p2")
    f, cx, cy, b1, b2, width, height, p2, p1 = (found.get(word) or 0 for word in words)
    with refusing(CameraError, "not Metashape's calibration"):
        K = [[f + b1, b2, cx + 0.5 * (width - 1)], [0, f, cy + 0.5 * (height - 1)], [0, 0, 1]]
    rest = {word: each or 0 for word, each in found.items()}
    return {**rest, "K": K, "p1": p1, "p2": p2, "image_size_wh": [width, height]}
