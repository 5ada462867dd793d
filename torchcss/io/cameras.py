"""Cameras from calibration files: `cameras.json`, Pose2Sim's `Calib.toml`, EasyMocap's pair.

`cameras.json` holds `{"units": "metre, pixel", "cameras": {name: {...}}}`; each camera has `K`
(3 x 3, pixels), `image_size_wh`, optionally `distortion` (k1 k2 p1 p2 k3), the world-to-camera `R`
and `t`, and `video`, the name of the file that it took. Pose2Sim's file has one table per camera
with `name`, `size`, `matrix`, `distortions`, `rotation` (Rodrigues vector) and `translation` in
metres. EasyMocap's `intri.yml` and `extri.yml` often lack the image size,
which is then the video's.

Units are metres inside (decision "units"). Where the extrinsics are in another unit, or absent,
the camera is used in its own frame, x right, y down, z forward: one view needs no more than the
intrinsics, and a made-up scale would be worse. `LoadedCamera.units_note` says so.

By default: `read_camera(path, name)` or `read_cameras(path)`; for a video
`load_camera(path, video=video_path)`, then `check_image_size(camera, width, height)`.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from torchcss.body.rotations import from_axis_angle
from torchcss.errors import CameraError
from torchcss.files import load_json, one_line, read_text, real_numbers, shortened
from torchcss.io.video import VideoReader
from torchcss.vision.camera import Camera

_METRES = frozenset({"m", "metre", "metres", "meter", "meters"})


class LoadedCamera(NamedTuple):
    """A camera and what its file said about it.

    Attributes:
        camera: The camera; in its own frame unless `metric`.
        metric: Whether the world frame is the file's, in metres.
        units_note: Why the camera is in its own frame, for the user; None if `metric`.
        video: Name of the video file that the camera took, where the calibration says it.
    """

    camera: Camera
    metric: bool
    units_note: str | None
    video: str | None


class _Entry(NamedTuple):
    """One camera of a file, whatever the format; `None` for what the file does not have."""

    K: Any
    image_size_wh: Any
    distortion: Any
    rotation: Any
    translation: Any
    units: Any = "metre"
    video: Any = None
    fisheye: Any = False
    from_easymocap: bool = False


def read_camera(
    path: str | os.PathLike[str],
    name: str | None = None,
    *,
    video: str | os.PathLike[str] | None = None,
) -> Camera:
    """Read one camera of a calibration file; see `load_camera`."""
    return load_camera(path, name, video=video).camera


def read_cameras(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """Read all cameras of a calibration file, by name; see `load_camera`."""
    return {name: load_camera(path, name).camera for name in _read_entries(Path(path))}


def load_camera(
    path: str | os.PathLike[str],
    name: str | None = None,
    *,
    video: str | os.PathLike[str] | None = None,
) -> LoadedCamera:
    """Read one camera of a calibration file, and what the file says about it.

    Args:
        path: A `.json` or Pose2Sim `.toml` file, EasyMocap's `intri.yml` or the folder that it is
            in.
        name: Which camera. None: the one of `video`, or the only one.
        video: The video to be tracked; the camera whose `video`, or else whose name, is the name of
            this file is taken.

    Returns:
        The camera, in float64.

    Raises:
        CameraError: If the file is missing or malformed, or which camera is meant is not clear.
    """
    path = Path(path)
    entries = _read_entries(path)
    name = _choose(path, entries, name, None if video is None else Path(video))
    entry, where = entries[name], f"{path}: camera {name!r}"
    if entry.fisheye:
        raise CameraError(
            f"{where}: a fisheye lens is not supported; undistort the video first and give the "
            "camera of the undistorted images"
        )
    if entry.image_size_wh is None and entry.from_easymocap:
        if video is None:
            raise CameraError(f"{where}: EasyMocap does not say the image size; give the video")
        info = VideoReader(video).info
        entry = entry._replace(image_size_wh=[info.width, info.height])
    camera = _make_camera(entry, name, path)
    note = _own_frame_note(name, entry)
    video_name = entry.video if isinstance(entry.video, str) else None
    if note is not None:
        camera = camera.in_own_frame()
    return LoadedCamera(camera, note is None, note, video_name)


def _make_camera(entry: _Entry, name: str, path: Path) -> Camera:
    """The camera of an entry, in the file's world, after its numbers are checked."""
    where = f"{path}: camera {name!r}"
    given = {
        "K": entry.K,
        "image size": entry.image_size_wh,
        "distortion": entry.distortion,
        "rotation": entry.rotation,
        "translation": entry.translation,
    }
    for key, value in (("K (matrix)", entry.K), ("image_size_wh (size)", entry.image_size_wh)):
        if value is None:
            raise CameraError(f"{where}: {key} is missing")
    intrinsics, size, distortion, rotation, translation = (
        None if value is None else real_numbers(value, f"{where}: {key}", CameraError)
        for key, value in given.items()
    )
    assert intrinsics is not None
    assert size is not None
    if size.shape != (2,) or not (np.isfinite(size) & (size == np.round(size))).all():
        raise CameraError(
            f"{where}: image size: expected whole numbers [width, height], "
            f"found {shortened(entry.image_size_wh)}"
        )
    if rotation is not None and rotation.shape == (3,):
        rotation = rotation_matrix(rotation, where)
    try:
        return Camera(
            intrinsics,
            (int(size[0]), int(size[1])),
            distortion=distortion,
            R_camera_world=rotation,
            t_camera_world=translation,
            name=name,
        )
    except CameraError as error:
        raise CameraError(f"{path}: camera {error}") from error


def camera_entry(camera: Camera) -> dict[str, Any]:
    """Return what a camera file in JSON has under the camera's name.

    Args:
        camera: The camera; its world is in metres.
    """
    return {
        "image_size_wh": list(camera.image_size_wh),
        "K": camera.K.tolist(),
        "distortion": camera.distortion.tolist(),
        "R": camera.R_camera_world.tolist(),
        "t": camera.t_camera_world.tolist(),
    }


def calibration(*cameras: tuple[Camera, str | os.PathLike[str] | None]) -> dict[str, Any]:
    """Return what a camera file in JSON holds.

    Args:
        cameras: Cameras, their world in metres, and the video of each, if known.
    """
    entries = {}
    for camera, video in cameras:
        entries[camera.name] = camera_entry(camera)
        if video is not None:
            entries[camera.name]["video"] = Path(video).name
    return {"units": "metre, pixel", "cameras": entries}


def check_image_size(camera: Camera, width: int, height: int) -> None:
    """Make sure that a camera belongs to images of this size.

    Args:
        camera: The camera.
        width: Columns of the images.
        height: Rows of the images.

    Raises:
        CameraError: If the sizes differ; where only the scale does, with the way to rescale.
    """
    expected = camera.image_size_wh
    if (width, height) == expected:
        return
    why = (
        "another shape, so they were cropped or come from another camera; use the calibration of "
        "this video"
    )
    # Half a pixel of rounding in either side is what resizing to whole pixels leaves.
    if abs(width * expected[1] - height * expected[0]) <= max(expected):
        why = (
            "the same shape at another scale; if the images were only resized, scale the "
            f"calibration: camera.resized({width}, {height})"
        )
    elif (height, width) == expected:
        why = "turned by a right angle; calibrate the video as it is shown upright"
    raise CameraError(
        f"camera {camera.name!r} belongs to images of {expected[0]} x {expected[1]} pixels, "
        f"these have {width} x {height}: {why}"
    )


def _own_frame_note(name: str, entry: _Entry) -> str | None:
    """Say why the file's world frame cannot be used, or None if it can."""
    if entry.rotation is None or entry.translation is None:
        why = "has no extrinsics"
    elif not isinstance(entry.units, str):
        why = "has extrinsics of unknown unit"
    else:
        unit = entry.units.split(",")[0].strip()
        if unit.lower() in _METRES:
            return None
        why = f"has its extrinsics in the unit {unit!r}"
    return f"camera {name!r} {why}: tracking in the camera's own frame (x right, y down, z forward)"


def _choose(path: Path, entries: Mapping[str, _Entry], name: str | None, video: Path | None) -> str:
    names = ", ".join(entries)
    if not entries:
        raise CameraError(f"{path}: no cameras in the file")
    if name is not None:
        if name not in entries:
            raise CameraError(f"{path}: no camera {name!r}; the file has {names}")
        return name
    if len(entries) == 1:
        return next(iter(entries))
    if video is None:
        raise CameraError(f"{path}: several cameras, {names}: say which (--camera-name)")
    exact = [name for name, entry in entries.items() if entry.video == video.name]
    alike = [name for name in entries if _letters(name) == _letters(video.stem)]
    for found in (exact, alike):
        if len(found) == 1:
            return found[0]
    raise CameraError(
        f"{path}: no single camera of {video.name}; say which of {names} it is (--camera-name)"
    )


def _letters(name: str) -> str:
    """A name without case and separators: `cam_01` is `cam01`."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _read_entries(path: Path) -> dict[str, _Entry]:
    suffix = path.suffix.lower()
    if suffix in (".yml", ".yaml") or (path.is_dir() and (path / INTRINSICS).is_file()):
        return _read_easymocap(path)
    return _read_pose2sim(path) if suffix == ".toml" else _read_json(path)


def _read_json(path: Path) -> dict[str, _Entry]:
    content = load_json(path, CameraError)
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(cameras, dict):
        raise CameraError(
            f"{path}: expected an object 'cameras' with a camera under each name, "
            f"found {shortened(content)}"
        )
    entries = {}
    for name, values in cameras.items():
        if not isinstance(values, dict):
            raise CameraError(
                f"{path}: camera {name!r}: expected an object, found {shortened(values)}"
            )
        found = map(values.get, ("K", "image_size_wh", "distortion", "R", "t"))
        entries[name] = _Entry._make(
            (*found, content.get("units"), values.get("video"), False, False)
        )
    return entries


def _read_pose2sim(path: Path) -> dict[str, _Entry]:
    text = read_text(path, CameraError)
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise CameraError(f"{path}: cannot be read as TOML: {one_line(error)}") from error
    entries = {}
    for table, values in content.items():
        if not isinstance(values, dict) or table == "metadata":
            continue
        name = values.get("name", table)
        if not isinstance(name, str) or name in entries:
            raise CameraError(
                f"{path}: table {table!r}: expected a name of its own, found {shortened(name)}"
            )
        keys = ("matrix", "size", "distortions", "rotation", "translation")
        entries[name] = _Entry._make(
            (*map(values.get, keys), "metre", None, values.get("fisheye"), False)
        )
    return entries


def rotation_matrix(vector: np.ndarray, where: str = "rotation") -> np.ndarray:
    """Return the rotation about `vector` by its length in radians (Rodrigues' formula).

    Args:
        vector: Axis times angle, `[3]`.
        where: The place in the file, for the message.

    Raises:
        CameraError: If it has another shape, is not finite, or seems to be in degrees.
    """
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise CameraError(
            f"{where}: expected a rotation vector of 3 numbers, found {shortened(vector.tolist())}"
        )
    if np.abs(vector).max() > 4 * np.pi:
        raise CameraError(
            f"{where}: a rotation vector of {shortened(vector.tolist())} turns more than twice "
            "around; expected radians"
        )
    return from_axis_angle(vector)


INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"


class _Loader(yaml.SafeLoader):
    """Plain values and OpenCV's matrices."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> list[Any]:
    """A matrix as nested lists; one of a single row or column as a list."""
    values = loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else {}
    rows, columns, data = (values.get(key) for key in ("rows", "cols", "data"))
    if not (isinstance(rows, int) and isinstance(columns, int) and isinstance(data, list)):
        raise yaml.YAMLError("an opencv-matrix has rows, cols and data")
    if rows < 1 or columns < 1 or rows * columns != len(data):
        raise yaml.YAMLError(
            f"line {node.start_mark.line + 1}: an opencv-matrix of {rows} rows and {columns} "
            f"columns has other than as many numbers"
        )
    if 1 in (rows, columns):
        return data
    return [data[row * columns : (row + 1) * columns] for row in range(rows)]


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _read_easymocap(path: Path) -> dict[str, _Entry]:
    """EasyMocap's cameras: `path` is the folder, or either file; the other is beside it."""
    folder = path if path.is_dir() else path.parent
    intrinsics = path if path.name != EXTRINSICS and not path.is_dir() else folder / INTRINSICS
    extrinsics = folder / EXTRINSICS
    first = _load(intrinsics)
    second = _load(extrinsics) if extrinsics.is_file() else {}
    names = first.get("names")
    if not isinstance(names, list) or not all(isinstance(name, (str, int)) for name in names):
        raise CameraError(
            f"{intrinsics}: expected 'names', as EasyMocap writes them, found {shortened(names)}"
        )
    cameras = {}
    for name in map(str, names):
        size = [first.get(f"W_{name}"), first.get(f"H_{name}")]
        cameras[name] = _Entry(
            first.get(f"K_{name}"),
            None if None in size else size,
            first.get(f"dist_{name}", first.get(f"D_{name}")),
            second.get(f"Rot_{name}", second.get(f"R_{name}")),
            second.get(f"T_{name}"),
            from_easymocap=True,
        )
    return cameras


def _load(path: Path) -> dict[str, Any]:
    text = read_text(path, CameraError)
    if text.startswith("%YAML:1.0"):
        text = text.partition("\n")[2]
    try:
        content = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise CameraError(f"{path}: cannot be read as YAML: {one_line(error)}") from error
    if not isinstance(content, dict):
        raise CameraError(f"{path}: not EasyMocap's; expected names, found {shortened(content)}")
    return content
