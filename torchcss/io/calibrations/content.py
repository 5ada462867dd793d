"""The cameras in the content of a file, wherever they stand in it and whatever their words.

Call `cameras_of`; `one_camera` where a file has but one, or a pair.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import CameraError
from torchcss.files import unexpected
from torchcss.io.calibrations.entry import Entry, by_pictures, entry_of
from torchcss.io.calibrations.matrices import (
    FOCAL_WORDS,
    K_WORDS,
    P_WORDS,
    has_camera,
    nested_shape,
    projection_of,
    square_matrix,
)
from torchcss.io.keypoints.json_people import listed
from torchcss.io.keypoints.words import first_of
from torchcss.joint_names import names_in

_NAMES = names_in("name cameraname cameraid camid id serial serialnumber")

_FISHEYE_NUMBERS = re.compile("fish_?eye_?(param|model|coeff)", re.IGNORECASE)

_NUMBERED = re.compile(r"([A-Za-z]\w*?)_?([0-9]+|[LRlr]|(?<=_)left|(?<=_)right)")
"""The name of a number, and whose of several cameras it is."""

_OF_NERF = "transform_matrix"
"""Where a picture was taken, camera to world, with OpenGL's axes: y up, z backwards."""


def cameras_of(path: Path, content: Any, units: Any = None) -> dict[str, Entry]:
    """The only camera of a file, or cameras by name or in a list.

    Args:
        path: The file, for messages and as the name of an only camera.
        content: What it holds.
        units: Unit of the world of several cameras, if neither they nor the file say one.

    Raises:
        CameraError: If there is no camera, or two have one name.
    """
    if not isinstance(content, dict):
        raise unexpected(CameraError, path, "an object 'cameras' with one under each name", content)
    frames = listed(content.get("frames"))
    if pictures := [each for each in frames if isinstance(each, dict) and _OF_NERF in each]:
        return _nerf_entries(path, content, pictures)
    cameras = _stacked(content) or first_of(content, ("cameras",))
    if cameras is None and is_one_camera(content):
        return one_camera(path, content)
    if isinstance(cameras, list) and all(isinstance(each, dict) for each in cameras):
        names = [str(first_of({**each, "#": n}, (*_NAMES, "#"))) for n, each in enumerate(cameras)]
        if len(set(names)) < len(names):
            raise CameraError(f"{path}: two cameras of one name among {', '.join(names)}")
        cameras = dict(zip(names, cameras, strict=True))
    # Others are not calibrated.
    inside = content if cameras is None else cameras
    cameras = _cameras_in(inside) or _projections(inside) or cameras
    if not isinstance(cameras, dict):
        if {"keypoints", "annotations", "people"} & content.keys():
            raise CameraError(f"{path}: keypoints, not a calibration; give them with --keypoints")
        known = "'names' (EasyMocap), camera_matrix (OpenCV, ROS), cam0 (Kalibr) or cameras by name"
        raise unexpected(CameraError, path, known, list(content))
    for name, values in cameras.items():
        if not isinstance(values, Mapping):
            raise unexpected(CameraError, f"{path}: camera {name!r}", "an object", values)
    said = _unit(content)
    return {
        str(name): entry_of(each, units if said is None else said) for name, each in cameras.items()
    }


def is_one_camera(values: Mapping[str, Any]) -> bool:
    """Whether a mapping has what `one_camera` reads."""
    return has_camera(values) or bool(_numbered(values))


def one_camera(path: Path, values: Mapping[str, Any]) -> dict[str, Entry]:
    """The one camera of a file, or a numbered pair.

    Args:
        path: The file, for messages and as the camera's name if it has none.
        values: What it holds; the board's places are not the camera's.

    Raises:
        CameraError: If there is no camera.
    """
    if not is_one_camera(values):
        raise unexpected(CameraError, path, "a calibration with camera_matrix", list(values))
    pair = _numbered(values)
    alone = {str(values.get("camera_name", values.get("name", path.stem))): values}
    entries: dict[str, Entry] = {}
    for name, own in (pair or alone).items():
        entry = entry_of(own, _unit(values))
        # A pair's R and T lead from one to the other; several are those of the board.
        is_place = projection_of(own) is not None or (not pair and entry.has_one_place)
        entries[name] = entry if is_place else entry._replace(rotation=None, translation=None)
    return entries


def _unit(values: Mapping[str, Any]) -> Any:
    return first_of(values, ("units", "unit"))


def _stacked(values: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Cameras whose numbers are arrays of all of them."""
    shape = nested_shape(first_of(values, (*K_WORDS, *P_WORDS)))
    count = shape[0] if len(shape) == 3 else 0
    names = listed(first_of(values, names_in("names cameranames cameras ids")))
    each = [
        {
            word: value[i] if len(nested_shape(value)) > 1 and len(value) == count else value
            for word, value in values.items()
        }
        for i in range(count)
    ]
    return dict(zip(map(str, names if len(names) == count else range(count)), each, strict=True))


def _projections(values: object) -> dict[str, Mapping[str, Any]]:
    """Cameras that are 3 x 4 matrices by name, with what stands beside them."""
    entries = values.items() if isinstance(values, Mapping) else ()
    rest = {name: each for name, each in entries if nested_shape(each) != (3, 4)}
    return {str(name): {**rest, "P": each} for name, each in entries if name not in rest}


def _cameras_in(values: object, depth: int = 4) -> dict[str, Mapping[str, Any]]:
    """Cameras by name, whatever stands beside them or, some levels deep, above."""
    if not isinstance(values, Mapping) or not depth:
        return {}
    found = {str(name): each for name, each in values.items() if has_camera(each)}
    for name, each in found.items():
        if _FISHEYE_NUMBERS.match(name):
            found[name] = {**each, "fisheye": True}
    for name, each in values.items():
        if str(name) not in found:
            below = _cameras_in(each, depth - 1).items()
            found |= {f"{name}/{n}" if n in found else n: camera for n, camera in below}
    return found


def _numbered(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Cameras whose number or side ends the names of their numbers, as in `M1`, `distL`."""
    found: dict[str, dict[str, Any]] = {}
    for key, value in values.items():
        if match := _NUMBERED.fullmatch(str(key)):
            found.setdefault(match[2], {})[match[1]] = value
    # Beside K projections are of the rectified pictures; Bouguet's have focal lengths.
    for words in (K_WORDS, P_WORDS, FOCAL_WORDS):
        named = [n for n, own in found.items() if isinstance(first_of(own, words), (list, dict))]
        if named:
            return {n: {**values, **found[n]} for n in named}
    return {}


def _nerf_entries(
    path: Path, content: Mapping[str, Any], pictures: Sequence[Mapping[str, Any]]
) -> dict[str, Entry]:
    """Nerfstudio's camera and pictures, each of which may have numbers of its own."""
    rest = {word: each for word, each in content.items() if word != "frames"}
    cameras = one_camera(path, rest) if has_camera(rest) else {}
    own: dict[str, Entry] = {}
    for index, picture in enumerate(pictures):
        name, values = str(picture.get("file_path", index)), {**rest, **picture}
        pose = square_matrix(picture[_OF_NERF], 4)
        if pose is None or not has_camera(values):
            raise CameraError(
                f"{path}: {name}: expected fl_x, fl_y, cx, cy and a {_OF_NERF} of 4 x 4 numbers"
            )
        R = np.diag([1.0, -1.0, -1.0]) @ pose[:3, :3].T
        entry = entry_of(values, rest.get("units")).standing(R, pose[:3, 3])
        own[name] = entry._replace(is_picture=True)
    return by_pictures(cameras, dict.fromkeys(cameras, own) or {"": own})
