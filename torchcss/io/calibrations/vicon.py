"""Cameras of Vicon, `.xcp`.

It has millimetres; a camera's axes are ours, its orientation `x y z w` turns the world's into them,
its position is in the world. Its lens is a polynomial that undoes the distortion.

Call `read_vicon`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from torchcss.body.files.xml import parse_xml
from torchcss.body.rotations import from_quaternion
from torchcss.errors import CameraError
from torchcss.files import refusing
from torchcss.io.calibrations.entry import Entry
from torchcss.joint_names import names_in

_KINDS = names_in("TYPE DISPLAY_TYPE SYSTEM")
"""Where it says whether a camera films or sees markers alone."""

_MOST_OFF = 1.0
"""Pixels by which the distortion, as ours, may be off in a corner."""


def read_vicon(path: Path) -> dict[str, Entry]:
    """Cameras by device number, the video cameras if there are some.

    Raises:
        CameraError: If no camera is calibrated, or one cannot be read.
    """
    cameras = parse_xml(path, "Vicon's XML", CameraError).findall("Camera")
    found = [each for each in cameras if each.find("KeyFrames/KeyFrame") is not None]
    kinds = [" ".join(each.get(word, "") for word in _KINDS).lower() for each in found]
    films = [each for each, kind in zip(found, kinds, strict=True) if re.search("video|vue", kind)]
    entries: dict[str, Entry] = {}
    for camera in films or found:
        name = camera.get("DEVICEID", str(len(entries)))
        frame = camera.find("KeyFrames/KeyFrame")
        assert frame is not None
        with refusing(CameraError, f"{path}: camera {name!r}: not Vicon's"):
            size, centre, place, turn = (
                np.array([float(number) for number in given.attrib[word].split()])
                for given, word in (
                    (camera, "SENSOR_SIZE"), (frame, "PRINCIPAL_POINT"), (frame, "POSITION"),
                    (frame, "ORIENTATION"),
                )
            )  # fmt: skip
            fx = float(frame.attrib["FOCAL_LENGTH"])
            focal = np.array([fx, fx / float(camera.get("PIXEL_ASPECT_RATIO", 1))])
            R = from_quaternion(turn[[3, 0, 1, 2]] / np.linalg.norm(turn))
            lens = _lens(frame.attrib, focal, centre, size)
            K = [*focal.tolist(), *centre.tolist()]
            entries[name] = Entry(K, size.tolist(), lens, units="mm").standing(R, place)
    if not entries:
        raise CameraError(f"{path}: no camera of these is calibrated; calibrate in Vicon's program")
    return entries


def _lens(
    frame: Mapping[str, str], focal: np.ndarray, centre: np.ndarray, size: np.ndarray
) -> list[float]:
    """The polynomial, which undoes a distortion, as the coefficients that make it.

    In pixels from its middle a point at d is straight at `d (1 + k1 d^2 + k2 d^4 + k3 d^6)`.
    """
    given = frame.get("VICON_RADIAL2", "").split()[1:]
    middle, undoing = given[:2] or centre, given[2:] or frame.get("VICON_RADIAL", "0").split()
    middle, undoing = (np.array([*map(float, numbers)]) for numbers in (middle, undoing))
    steps = (np.linspace(0.0, side - 1, 41) for side in size)
    seen = np.stack(np.meshgrid(*steps), -1).reshape(-1, 2)
    away = seen - middle
    r2 = (away * away).sum(-1, keepdims=True)
    straight = middle + away * (1 + sum(k * r2 ** (n + 1) for n, k in enumerate(undoing)))
    a, b = np.moveaxis((straight - centre) / focal, -1, 0)
    r2 = a * a + b * b
    columns = [
        [a * r2, b * r2], [a * r2**2, b * r2**2], [2 * a * b, r2 + 2 * b * b],
        [r2 + 2 * a * a, 2 * a * b], [a * r2**3, b * r2**3],
    ]  # fmt: skip
    made = np.stack([np.stack(each, -1) for each in columns], -1) * focal[:, None]
    lens = np.linalg.lstsq(made.reshape(-1, 5), (seen - straight).reshape(-1), rcond=None)[0]
    off = float(np.abs(made @ lens - (seen - straight)).max())
    if off > _MOST_OFF:
        raise CameraError(f"its distortion is no lens's that is known ({off:.1f} pixels off)")
    return lens.tolist()
