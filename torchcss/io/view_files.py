"""What the cameras of a run recorded: the files of each, and how a track's file holds them.

`ViewFiles` are the files of one camera as a user gives them, `RecordedCamera` the calibrated camera
with its files.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

from torchcss.errors import ConfigurationError
from torchcss.files import make_paths
from torchcss.io.cameras import camera_entry
from torchcss.io.keypoints.read import Scale
from torchcss.types import frozen
from torchcss.vision.camera import Camera

PATHS = ("video", "keypoints", "masks")


@frozen
class ViewFiles:
    """What one camera recorded.

    Attributes:
        video: A video, or a folder of images.
        keypoints: 2D joints, see `torchcss.io.keypoints.read`; None only for a further camera,
            whose pictures then speak alone.
        camera_name: Which camera of the calibration file; by default the one of this video.
        masks: Foreground of every frame, white or in shades of belief: a video or a folder of
            images, of the size and number of the video's frames.
        layout: Layout of a keypoint file that does not name its joints.
        normalised: Whether keypoints are fractions of the image, and which, see
            `torchcss.io.keypoints.read.Scale`.
        offset: This video's frame at the time of the first camera's frame 0.
        frame_rate: Frames per second of a folder of images, which does not say it; None: 30.
        person: Who of several people is followed: `prominent`, `largest`, `leftmost` or `centre` in
            the first frame, or the keypoint file's number of a person.
        sigma: Noise of a wrist's keypoint, pixels; None: learnt from the first frame's.
    """

    video: Path
    keypoints: Path | None
    camera_name: str | None = None
    masks: Path | None = None
    layout: str | None = None
    normalised: bool | Scale = "pixels"
    offset: int = 0
    frame_rate: float | None = None
    person: str = "prominent"
    sigma: float | None = None

    def __post_init__(self) -> None:
        make_paths(self)

    def fingerprints(self) -> dict[str, str]:
        """What tells each of its files from others, wherever it lies."""
        paths = {name: getattr(self, name) for name in PATHS}
        return {name: fingerprint(path) for name, path in paths.items() if path is not None}

    def moved(self, given: ViewFiles, fingerprints: Mapping[str, str]) -> ViewFiles:
        """The same files where they are now.

        Args:
            given: Where they are said to be.
            fingerprints: From `fingerprints`, when they were read; empty: they have not moved.

        Raises:
            ConfigurationError: If one of them is another file.
        """
        now: dict[str, Path] = {}
        for name in PATHS:
            path, known = getattr(given, name), getattr(self, name)
            if None in (path, known) or path.resolve() == known.resolve():
                continue
            if name not in fingerprints or fingerprint(path) != fingerprints[name]:
                raise ConfigurationError(
                    f"the run was begun with the {name} {known}, now {path} is another one; give "
                    "the same, choose another folder with --out, or leave --resume out to start "
                    "anew"
                )
            now[name] = path
        return replace(self, **now)


_MOST_READ = 2**25
"""Bytes of a file, or of all files of a folder, that tell it from others."""


def fingerprint(path: Path) -> str:
    """A hash of a file's size, beginning and end; of a folder's files with their names.

    Args:
        path: The file or folder, or FILE#SELECTION; one that is not there has a hash of its own.
    """
    archive, _, selection = str(path).rpartition("#")
    if archive and not path.exists():
        path = Path(archive)
    found = hashlib.sha256((selection if str(path) == archive else "").encode())
    with suppress(OSError):  # whoever reads it says so
        files = sorted(each for each in path.rglob("*") if each.is_file()) or [path]
        share = _MOST_READ // (2 * len(files))
        for file in files:
            size = file.stat().st_size
            found.update(f"{file.relative_to(path)}\0{size}\0".encode())
            with file.open("rb") as stream:
                found.update(stream.read(share))
                stream.seek(max(stream.tell(), size - share))
                found.update(stream.read(share))
    return found.hexdigest()


class RecordedCamera(NamedTuple):
    """A camera of a run.

    Attributes:
        camera: The camera, of the size of its video.
        files: What it recorded; None where that was not read from files, or is not known.
        focal_deviation: Standard deviation of the logarithm of its focal length; 0: it is known.
    """

    camera: Camera
    files: ViewFiles | None = None
    focal_deviation: float = 0.0


def camera_to_plain(recorded: RecordedCamera) -> dict[str, Any]:
    """What JSON holds of a camera and its files, whose paths are made absolute."""
    camera, files, focal = recorded
    entry = {"name": camera.name, "near": camera.near, **camera_entry(camera)}
    entry["focal_deviation"] = focal
    if files is None:
        return entry
    plain = asdict(files)
    for name in PATHS:
        plain[name] = None if plain[name] is None else os.path.abspath(plain[name])
    return {**entry, "files": plain}


def camera_from_plain(entry: Mapping[str, Any], folder: Path) -> RecordedCamera:
    """The camera and its files again.

    Args:
        entry: From `camera_to_plain`.
        folder: Where the run lies: files that are no longer where they were are looked for in it.

    Raises:
        KeyError, TypeError, ValueError: If it is not such an entry.
    """
    camera = Camera(
        entry["K"],
        tuple(entry["image_size_wh"]),
        distortion=entry["distortion"],
        R_camera_world=entry["R"],
        t_camera_world=entry["t"],
        name=entry["name"],
        near=entry["near"],
    )
    # Made orthonormal once more it would differ in its last bits, and a resumed run with it.
    camera.R_camera_world = camera.R_camera_world.new_tensor(entry["R"])
    focal = float(entry.get("focal_deviation", 0.0))
    if entry.get("files") is None:
        return RecordedCamera(camera, focal_deviation=focal)
    files = ViewFiles(**entry["files"])
    places = {name: _place(getattr(files, name), folder) for name in PATHS}
    return RecordedCamera(camera, replace(files, **places), focal)


def _place(path: str | None, folder: Path) -> Path | None:
    """Where a file is now: where it was, or in the run's folder; else where it was."""
    if path is None:
        return None
    beside = folder / Path(path).name
    return beside if not os.path.exists(path) and beside.exists() else Path(path)
