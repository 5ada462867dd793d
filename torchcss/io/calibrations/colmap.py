"""COLMAP's cameras, in text and in binary, and the places of its pictures in the file beside.

Its pixels are squares from (0, 0) on, as Nerfstudio's, in whose words its numbers are put; a binary
file is put in the words of the text.

Call `read_colmap`, for text `colmap_cameras`.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.body.rotations import from_quaternion
from torchcss.errors import CameraError
from torchcss.files import read_bytes, read_text, real_numbers, refusing, shortened
from torchcss.io.calibrations.entry import Entry, by_pictures, entry_of

COLMAP_NAMES = "cameras.txt", "cameras.bin"
"""Its files of cameras."""

_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "FOV": "fl_x fl_y cx cy omega",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "THIN_PRISM_FISHEYE": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
}
"""The parameters of the models, in the order of their numbers in a binary file; f is both focal
lengths."""

_UNREAD = ("FOV", "THIN_PRISM_FISHEYE")
"""Those whose lenses are not read; nor are others of fisheye lenses, which COLMAP may have."""

_NUMBERS = re.compile(r"[-+0-9.eE\s]+")


def read_colmap(path: Path) -> dict[str, Entry]:
    """The cameras of a binary file and the places of the pictures beside it.

    Raises:
        CameraError: If it is damaged, or has a model that is not known.
    """
    data, at, models = read_bytes(path, CameraError), 8, [*_MODELS]
    rows: dict[str, list[str]] = {}
    with refusing(CameraError, f"{path}: expected COLMAP's cameras.bin"):
        (count,) = struct.unpack_from("<Q", data)
        for _ in range(count):
            number, model, *size = struct.unpack_from("<iiQQ", data, at)
            if not 0 <= model < len(models):
                raise CameraError(
                    f"{path}: camera {number} has COLMAP's model {model}, which is not read; "
                    "undistort the pictures by colmap image_undistorter"
                )
            length = len(_MODELS[models[model]].split())
            values = struct.unpack_from(f"<{length}d", data, at + 24)
            words = [str(number), models[model], *map(str, size), *map(repr, values)]
            rows[f"{path}: camera {number}"] = words
            at += 24 + 8 * length
    return colmap_cameras(path, rows)


def colmap_cameras(
    path: Path, rows: Mapping[str, Sequence[str]], text: str = ""
) -> dict[str, Entry]:
    """Cameras, and the pictures of `images.txt` or `images.bin` beside their file.

    Args:
        path: The file.
        rows: The words of its lines, by where they stand.
        text: The whole of it, for the unit that a comment says.

    Raises:
        CameraError: If a row is not a camera's, or a picture not COLMAP's.
    """
    return _with_places(path, {row[0]: _camera(where, row) for where, row in rows.items()}, text)


def _camera(where: str, row: Sequence[str]) -> Entry:
    model = row[1] if len(row) > 1 else ""
    try:
        size, values = [int(each) for each in row[2:4]], [float(each) for each in row[4:]]
    except ValueError:
        size = values = []
    names = _MODELS.get(model, "").split()
    if model in _UNREAD or (not names and "FISHEYE" in model):  # the other cameras are read
        return Entry([], size, fisheye=True)
    if not names or len(values) != len(names) or len(size) != 2:
        known = ", ".join(each for each in _MODELS if each not in _UNREAD)
        raise CameraError(
            f"{where}: expected COLMAP's camera, CAMERA_ID MODEL WIDTH HEIGHT and the parameters "
            f"of {known} (of others colmap image_undistorter makes straight pictures); "
            f"found {shortened(' '.join(row))}"
        )
    given = dict(zip(names, values, strict=True))
    focal = {word: given["f"] for word in ("fl_x", "fl_y") if "f" in given}
    return entry_of({**given, **focal, "image_size_wh": size, "model": model})


def _with_places(path: Path, entries: dict[str, Entry], text: str) -> dict[str, Entry]:
    """The cameras with their pictures; one that took all from one place stands there."""
    beside = [path.with_name(f"images{suffix}") for suffix in (path.suffix, ".bin", ".txt")]
    images = next((each for each in beside if each.exists()), None)
    if images is None:
        return entries
    unit = _said_unit(text)
    if images.suffix == ".bin":
        found = _binary_images(images)
    else:
        text = read_text(images, CameraError)
        unit = _said_unit(text) if unit is None else unit
        # The lines between are of points: numbers alone.
        rows = [line.split(maxsplit=9) for line in text.splitlines() if line.strip()[:1] != "#"]
        found = [row for row in rows if len(row) == 10 and not _NUMBERS.fullmatch(row[9])]
    placed: dict[str, dict[str, Entry]] = {}
    for row in found:
        with refusing(CameraError, f"{images}: picture {shortened(row[0])}: not COLMAP's"):
            *pose, camera, picture = row[1:]
            numbers = real_numbers([*map(float, pose)], picture, CameraError)
            R = from_quaternion(numbers[:4] / np.linalg.norm(numbers[:4]))
            placed.setdefault(str(camera), {})[str(picture)] = entries[str(camera)]._replace(
                rotation=R.tolist(),
                translation=numbers[4:7].tolist(),
                units=unit,
                is_picture=True,
                note=None if unit is None else "its world need not have an axis upwards (COLMAP)",
            )
    return by_pictures(entries, placed)


def _said_unit(text: str) -> Any:
    """The unit that a comment says, `# units: mm` or metres per unit: COLMAP has no word for it."""
    if (match := re.search(r"(?im)^#\s*units?\s*[:=]\s*(\S+)", text)) is None:
        return None
    with suppress(ValueError):
        return float(match[1])
    return match[1]


def _binary_images(path: Path) -> list[list[Any]]:
    """The rows of binary images, as the text has them."""
    data, at = read_bytes(path, CameraError), 8
    rows: list[list[Any]] = []
    with refusing(CameraError, f"{path}: expected COLMAP's images.bin"):
        (count,) = struct.unpack_from("<Q", data)
        for _ in range(count):
            number, *pose, camera = struct.unpack_from("<I7dI", data, at)
            end = data.index(0, at + 64)
            name = data[at + 64 : end].decode()
            rows.append([number, *pose, camera, name])
            (points,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + 24 * points
    return rows
