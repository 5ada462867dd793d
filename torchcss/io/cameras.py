"""Cameras from calibration files: our own `cameras.json` and those of `torchcss.io.calibrations`.

`cameras.json` holds `{"units": "metre, pixel", "cameras": {name: {...}}}`; each camera has `K`
(3 x 3, pixels), `image_size_wh`, optionally `distortion` (k1 k2 p1 p2 k3), the world-to-camera `R`
and `t`, and `video`, the name of the file that it took. Where a file lacks the image size, it is
the video's.

Units are metres inside (decision "units"). Where the extrinsics are in a unit that is not known, or
absent, the camera is used in its own frame, x right, y down, z forward: one view needs no more than
the intrinsics, and a made-up scale would be worse. `LoadedCamera.units_note` says so.

By default: `read_camera(path, name)` or `read_cameras(path)`; for a video
`load_camera(path, video=video_path)`, then `check_image_size(camera, width, height)`.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
import torch

from torchcss.body.rotations import from_axis_angle
from torchcss.errors import CameraError
from torchcss.files import StrPath, real_numbers, shortened, unexpected
from torchcss.io.calibrations.entry import Entry
from torchcss.io.calibrations.read import read_entries
from torchcss.io.lenses import MOST_COEFFICIENTS, Lens, Mirror
from torchcss.io.video import VideoReader
from torchcss.vision.camera import Camera

_METRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("cm", "centimetre", "centimetres", "centimeter", "centimeters"), 0.01),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), 0.001),
}
"""Metres per unit of a file's world."""
_NUMBERS = ("K", "image size", "distortion", "rotation", "translation")
"""What messages call the first fields of an `Entry`."""

_NARROWEST, _WIDEST = 2.0, 140.0
"""Fields of view of lenses that follow the pinhole model, degrees."""

_REACHED = 0.9
"""Share of the image that the distortion of a usable calibration can be undone in."""

_TANGENTIAL = 0.02
"""Tangential coefficients of lenses are smaller; k3 and those of fisheye lenses are larger."""

_FAR = 1000.0
"""No camera sees a person from so many metres away."""


class LoadedCamera(NamedTuple):
    """A camera and what its file said about it.

    Attributes:
        camera: The camera; in its own frame unless `metric`.
        metric: Whether the world frame is the file's, in metres.
        units_note: Why the camera is in its own frame, or which unit was assumed, for the user.
        focal_deviation: Standard deviation of the logarithm of the focal length; 0: it is known.
    """

    camera: Camera
    metric: bool
    units_note: str | None
    focal_deviation: float = 0.0


def read_camera(path: StrPath, name: str | None = None, *, video: StrPath | None = None) -> Camera:
    """Read one camera of a calibration file; see `load_camera`."""
    return load_camera(path, name, video=video).camera


def read_cameras(path: StrPath) -> dict[str, Camera]:
    """Read all cameras of a calibration file, by name; see `load_camera`."""
    return {name: load_camera(path, name).camera for name in read_entries(Path(path))}


def load_camera(
    path: StrPath, name: str | None = None, *, video: StrPath | None = None
) -> LoadedCamera:
    """Read one camera of a calibration file, and what the file says about it.

    Args:
        path: A file of any of the formats, or the folder of EasyMocap's `intri.yml` or COLMAP's
            `cameras.txt`.
        name: Which camera. None: the one of `video`, or the only one.
        video: The video to be tracked; the camera whose `video`, or else whose name, is the name of
            this file is taken.

    Returns:
        The camera, in float64.

    Raises:
        CameraError: If the file is missing or malformed, or which camera is meant is not clear.
    """
    where, name, entry = _chosen(Path(path), name, video)
    if (why := _unlike_a_pinhole(entry.distortion, entry.fisheye)) is not None:
        given, lens = (shlex.quote(str(each)) for each in (video or "VIDEO", path))
        raise CameraError(
            f"{where}: {why} is not supported: torchcss undistort {given} --camera {lens} "
            "--out FOLDER makes straight pictures, and their camera and keypoints"
        )
    return _loaded(name, entry._replace(distortion=entry.distortion[:5]), path)


def load_lens(
    path: StrPath,
    name: str | None = None,
    *,
    video: StrPath | None = None,
    fov: float | None = None,
) -> tuple[LoadedCamera, Lens]:
    """Read a camera's lens, of whatever model, and the camera of the pictures made straight.

    Args:
        path: As for `load_camera`.
        name: The same.
        video: The same.
        fov: Degrees that the straight pictures show from left to right; None: as
            `Lens.straightened_K` says.

    Raises:
        CameraError: As for `load_camera`, or the lens is of a model that is not known.
    """
    where, name, entry = _chosen(Path(path), name, video)
    is_fisheye = entry.fisheye == "equidistant"
    most = MOST_COEFFICIENTS[is_fisheye]
    coefficients = entry.distortion
    if coefficients[most:].any() or not np.isfinite(coefficients).all():
        raise unexpected(
            CameraError, f"{where}: distortion", f"at most {most} numbers", coefficients.tolist()
        )
    coefficients = coefficients[:most]
    entry = entry._replace(distortion=np.zeros(4))
    _loaded(name, entry, path)  # which checks K
    mirror = entry.fisheye if isinstance(entry.fisheye, Mirror) else None
    lens = Lens(entry.K, tuple(coefficients.tolist()), is_fisheye, mirror)
    straight = entry._replace(K=lens.straightened_K(entry.image_size_wh, fov))
    return _loaded(name, straight, path), lens


def _chosen(path: Path, name: str | None, video: StrPath | None) -> tuple[str, str, Entry]:
    """The camera that is meant: what messages call it, its name, and its numbers, checked.

    It has the size of the video if it has none of its own.
    """
    entries = read_entries(path)
    name = _choose(path, entries, name, None if video is None else Path(video))
    entry, where = entries[name], f"{path}: camera {name!r}"
    if entry.fisheye not in (False, "equidistant") and not isinstance(entry.fisheye, Mirror):
        what = "an inverse model of a" if entry.fisheye == "inverse" else "this model of a fisheye"
        raise CameraError(
            f"{where}: {what} lens is not supported; undistort the video by the "
            "program that calibrated it, and give the camera of the undistorted images"
        )
    if entry.image_size_wh is None and video is not None and Path(video).exists():
        info = VideoReader(video).info
        entry = entry._replace(image_size_wh=[info.width, info.height])
    return where, name, _checked(entry, where)


def _loaded(name: str, entry: Entry, path: StrPath) -> LoadedCamera:
    """The camera in the frame that its file allows, and what is said of it."""
    try:
        camera = Camera(
            entry.K,
            entry.image_size_wh,
            distortion=entry.distortion,
            R_camera_world=entry.rotation,
            t_camera_world=entry.translation,
            name=name,
        )
    except CameraError as error:
        raise CameraError(f"{path}: camera {error}") from error
    note, unit = _own_frame_note(name, entry), _metres(entry.units)
    if note is not None:
        camera = camera.in_own_frame()
    elif unit is not None and unit != 1.0:
        camera = camera.in_world_times(unit)
    said = "; ".join(each for each in (note, entry.note) if each)
    return LoadedCamera(camera, note is None, said or None)


def _checked(entry: Entry, where: str) -> Entry:
    """An entry with arrays, K and rotation as matrices, the distortion in a row of four or more.

    Raises:
        CameraError: If something is missing or no number.
    """
    if entry.K is None:
        raise CameraError(f"{where}: K (matrix) is missing")
    if entry.image_size_wh is None:
        raise CameraError(
            f"{where}: the file does not say the image size; give the video, or image_size_wh"
        )
    K, size, distortion, rotation, translation = (
        None if value is None else real_numbers(value, f"{where}: {key}", CameraError)
        for key, value in zip(_NUMBERS, entry, strict=False)
    )
    assert K is not None
    assert size is not None
    if size.shape != (2,) or not (np.isfinite(size) & (size == np.round(size))).all():
        raise CameraError(
            f"{where}: image size: expected whole numbers [width, height], "
            f"found {shortened(entry.image_size_wh)}"
        )
    if K.shape == (4,):
        K = np.array([[K[0], 0.0, K[2]], [0.0, K[1], K[3]], [0.0, 0.0, 1.0]])
    if rotation is not None and rotation.shape != (3, 3):
        # OpenCV writes vectors in rows or columns, and some write matrices in a row.
        rotation = rotation.ravel()
        is_matrix = rotation.size == 9
        rotation = rotation.reshape(3, 3) if is_matrix else rotation_matrix(rotation, where)
    distortion = np.zeros(4) if distortion is None else distortion.ravel()
    if len(distortion) == 3 and not entry.fisheye:
        raise CameraError(f"{where}: distortion: expected k1 k2 p1 p2 [k3], found 3 numbers")
    # Simpler models have k1 and k2 alone.
    distortion = np.pad(distortion, (0, max(0, 4 - len(distortion))))
    return entry._replace(
        K=K,
        image_size_wh=(int(size[0]), int(size[1])),
        distortion=distortion,
        rotation=rotation,
        translation=None if translation is None else translation.ravel(),
    )


def _unlike_a_pinhole(distortion: np.ndarray, fisheye: object) -> str | None:
    """What a lens is that a camera does not follow; None: it does."""
    if isinstance(fisheye, Mirror):
        return f"an omnidirectional lens ({fisheye.model})"
    if fisheye:
        return "a fisheye lens"
    if distortion[5:].any():
        return f"distortion of {len(distortion)} coefficients (OpenCV's rational model)"
    return None


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


def calibration(*cameras: tuple[Camera, StrPath | None]) -> dict[str, Any]:
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
        factor = max(width, height) / max(expected)
        why = (
            "the same shape at another scale; if the images were only resized, scale the "
            f"calibration: camera.resized({width}, {height}), or in the file multiply K's first "
            f"two rows by {factor:.6g} and give the new size"
        )
    elif (height, width) == expected:
        why = "turned by a right angle; calibrate the video as it is shown upright"
    raise CameraError(
        f"camera {camera.name!r} belongs to images of {expected[0]} x {expected[1]} pixels, "
        f"these have {width} x {height}: {why}"
    )


def camera_findings(camera: Camera) -> list[str]:
    """Lines about what looks odd of a camera; nothing is refused, all of it can be right.

    Args:
        camera: The camera.
    """
    size = camera.K.new_tensor(camera.image_size_wh)
    (fx, fy), (cx, cy) = camera.K.diagonal()[:2].tolist(), camera.K[:2, 2].tolist()
    wide = 2 * math.degrees(math.atan(0.5 * max(size[0].item() / fx, size[1].item() / fy)))
    lines = []
    if not _NARROWEST <= wide <= _WIDEST:
        lines.append(f"it sees {wide:.3g} degrees: is its focal length in pixels of this video?")
    if not (0 <= cx <= size[0] and 0 <= cy <= size[1]):
        lines.append(f"its principal point ({cx:.0f}, {cy:.0f}) lies outside the image")
    share = torch.linspace(0.0, 1.0, 9).to(camera.K)
    _, reached = camera.undistort(torch.cartesian_prod(share, share) * (size - 1))
    if reached.double().mean() < _REACHED:  # the utmost corners often are beyond
        lines.append(
            f"its distortion reaches {int(100 * reached.double().mean())} % of the image; nothing "
            "is seen elsewhere: calibrate with views up to the borders"
        )
    tangential = float(camera.distortion[2:4].abs().max())
    if tangential > _TANGENTIAL:
        lines.append(
            f"its tangential distortion (p1, p2) is {tangential:.2g}, more than lenses have: are "
            "its coefficients a fisheye lens's, or in another order?"
        )
    if (away := float(camera.centre_world.norm())) > _FAR:
        lines.append(f"it stands {away:.0f} m from the world's origin: is t in metres?")
    return [f"camera {camera.name!r} looks odd: {line}" for line in lines]


def _metres(units: Any) -> float | None:
    """Metres per unit of the world that a file names, by word or number; None: not known."""
    if isinstance(units, str):
        return _METRES.get(units.split(",")[0].strip().lower())
    is_number = isinstance(units, (int, float)) and not isinstance(units, bool)
    return float(units) if is_number and 0 < units < math.inf else None


def _own_frame_note(name: str, entry: Entry) -> str | None:
    """Say why the file's world frame cannot be used, or None if it can."""
    if entry.rotation is None or entry.translation is None:
        why = "has no extrinsics"
    elif _metres(entry.units) is not None:
        return None
    elif not isinstance(entry.units, str):
        why = 'has extrinsics of unknown unit (the file may say units: "mm", or metres per unit)'
    else:
        why = f"has its extrinsics in the unit {entry.units.split(',')[0].strip()!r}"
    return f"camera {name!r} {why}: tracking in the camera's own frame (x right, y down, z forward)"


def _choose(path: Path, entries: Mapping[str, Entry], name: str | None, video: Path | None) -> str:
    cameras = [each for each, entry in entries.items() if not entry.is_picture]
    names = ", ".join(cameras) if cameras else shortened(", ".join(entries))
    if not entries:
        raise CameraError(f"{path}: no cameras in the file")
    if name is not None:
        if name not in entries:
            found = [each for each in entries if _letters(each) == _letters(name)]
            if len(found) == 1:
                return found[0]
            raise CameraError(f"{path}: no camera {name!r}; the file has {names}")
        return name
    known = cameras or [*entries]
    if len(known) == 1 and (video is None or len(entries) == 1):
        return known[0]
    if video is None:
        raise CameraError(f"{path}: several cameras, {names}: say which (--camera-name)")
    exact = [name for name, entry in entries.items() if entry.video == video.name]
    alike = [name for name in cameras if _letters(name) == _letters(video.stem)]
    pictures = [
        name
        for name, entry in entries.items()
        if entry.is_picture and _letters(video.stem) in map(_letters, _stems(name))
    ]
    # Motion capture systems call a film by its camera's serial number, among other things.
    numbers = re.findall("[0-9]{5,}", video.stem)
    serial = [name for name in cameras if name in numbers]
    for found in (exact, alike, serial, pictures, known):
        if len(found) == 1:
            return found[0]
    raise CameraError(
        f"{path}: no single camera of {video.name}; say which of {names} it is (--camera-name, "
        "or --other-cameras for a further video)"
    )


def _stems(picture: str) -> tuple[str, str]:
    """A picture's name without its suffix, and the name of its folder."""
    path = PurePosixPath(picture.replace("\\", "/"))
    return path.stem, path.parent.name


def _letters(name: str) -> str:
    """A name without case, separators and leading word: `cam_01` is `Cam01` and `01`."""
    return re.sub(r"^(cam|camera|port)(?=[0-9])", "", re.sub(r"[^a-z0-9]", "", name.lower()))


def rotation_matrix(vector: np.ndarray, where: str = "rotation") -> np.ndarray:
    """Return the rotation about `vector` by its length in radians (Rodrigues' formula).

    Args:
        vector: Axis times angle, `[3]`.
        where: The place in the file, for the message.

    Raises:
        CameraError: If it has another shape, is not finite, or seems to be in degrees.
    """
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise unexpected(CameraError, where, "a rotation vector of 3 numbers", vector.tolist())
    if np.hypot.reduce(vector) > 2 * np.pi:
        raise CameraError(
            f"{where}: a rotation vector of {shortened(vector.tolist())} turns more than once "
            "around; expected axis times angle in radians"
        )
    return from_axis_angle(vector)
