"""Cameras of Qualisys' QTM, `.qca.txt`.

It counts 64ths of pixels of the whole sensor and millimetres, and a camera's y is up, its z
backwards (as Pose2Sim converts it). The coefficients are not in 64ths.

Call `read_qualisys`.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from torchcss.body.files.xml import parse_xml
from torchcss.errors import CameraError
from torchcss.files import refusing
from torchcss.io.calibrations.entry import Entry, turned_note
from torchcss.joint_names import names_in

_COEFFICIENTS = names_in("radialDistortion1 radialDistortion2 tangentalDistortion1 "
                         "tangentalDistortion2 radialDistortion3")  # fmt: skip


def read_qualisys(path: Path) -> dict[str, Entry]:
    """Cameras by serial number, the video cameras if there are some.

    Raises:
        CameraError: If it is no calibration of Qualisys'.
    """
    cameras = parse_xml(path, "Qualisys' XML", CameraError).findall("cameras/camera")
    films = [each for each in cameras if "video" in each.get("model", "").lower()]
    entries: dict[str, Entry] = {}
    for camera in films or cameras:
        name = camera.get("serial", str(len(entries)))
        with refusing(CameraError, f"{path}: camera {name!r}: not Qualisys'"):
            entries[name] = _camera(camera)
    if not entries:
        raise CameraError(
            f"{path}: the calibration of a motion capture system; save it as Pose2Sim's Calib.toml"
        )
    return entries


def _camera(camera: Element) -> Entry:
    parts = {part.tag: part.attrib for part in camera}
    lens, place, shown = parts["intrinsic"], parts["transform"], parts.get("fov_video")
    if shown is None:
        left = top = 0.0
        size = [(float(lens[f"sensorMax{axis}"]) + 1) / 64 for axis in "UV"]
    else:
        left, top, right, bottom = (
            float(shown[side]) for side in names_in("left top right bottom")
        )
        size = [right - left + 1, bottom - top + 1]
    fx, fy, cx, cy = (
        float(lens[f"{word}{axis}"]) / 64
        for word in ("focalLength", "centerPoint")
        for axis in "UV"
    )
    R = np.array([float(place[f"r{i}{j}"]) for i in "123" for j in "123"]).reshape(3, 3)
    turned = camera.get("viewrotation", "0")
    entry = Entry(
        [fx, fy, cx - left, cy - top],
        size,
        [float(lens.get(word, 0)) for word in _COEFFICIENTS],
        units="mm",
        note=None if float(turned) == 0 else turned_note("viewrotation", turned),
    )
    return entry.standing(np.diag([1.0, -1.0, -1.0]) @ R, [float(place[axis]) for axis in "xyz"])
