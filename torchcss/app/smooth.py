"""Smooth what lies on disk: `smooth.npz`, and an entry in `summary.json`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch

from torchcss.app.view_files import moments, open_view
from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError, TrackFileError
from torchcss.io.fitted_body import body_beside, read_fitted_body
from torchcss.io.keypoints.read import Scale
from torchcss.io.run import body_of_track
from torchcss.io.tracks import (
    SUMMARY_NAME,
    Track,
    load_track,
    prepare_output_folder,
    read_summary,
    save_track,
    write_summary,
)
from torchcss.io.view_files import ViewFiles
from torchcss.tracking.settings import Settings
from torchcss.tracking.smooth import SmoothedTrack, Smoothing, smooth_track
from torchcss.tracking.smooth_images import smooth_frames

SMOOTH_NAME = "smooth.npz"


def smooth_file(
    track: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str] | None = None,
    choice: Smoothing | None = None,
    body: BodyModel | None = None,
) -> dict[str, Any]:
    """Smooth a track on disk: `smooth.npz`, and an entry `smoothed` in `summary.json`.

    Args:
        track: `track.npz`, or the folder that it is in.
        out: Output folder; by default that of the track.
        choice: How to smooth.
        body: The body; by default that of the `body.npz` beside the track, if there is one, else
            one of the catalogue's.

    Returns:
        The entry of the summary.

    Raises:
        TorchcssError: With one line that says what was wrong.
    """
    found, folder, into = open_track(track, out)
    body = body_beside(folder) if body is None else body
    return write_smoothed(smooth_track(found, body, choice=choice), into, folder)


def open_track(
    track: str | os.PathLike[str], out: str | os.PathLike[str] | None
) -> tuple[Track, Path, Path]:
    """Load a track, and prepare the folder for what is made of it.

    Args:
        track: `track.npz`, or the folder that it is in.
        out: Output folder; None: that of the track.

    Returns:
        The track, its folder, and the output folder.

    Raises:
        TorchcssError: If the track cannot be read, the folder not be written, or the track is the
            file that would be replaced.
    """
    path = Path(track)
    folder = path if path.is_dir() else path.parent
    found = load_track(path)
    into = prepare_output_folder(folder if out is None else out)
    if path.is_file() and path.resolve() == (into / SMOOTH_NAME).resolve():
        raise ConfigurationError(
            f"{path}: the smoothed track would replace it; give the track that it came from, or "
            "another folder with --out"
        )
    return found, folder, into


def write_smoothed(done: SmoothedTrack, into: Path, source: Path) -> dict[str, Any]:
    """Write `smooth.npz`, and the source's summary with an entry `smoothed`.

    Args:
        done: What was smoothed.
        into: Output folder.
        source: Folder of the track.

    Returns:
        The entry.

    Raises:
        OutputError: If the folder cannot be written.
    """
    save_track(into / SMOOTH_NAME, done.track)
    summary = read_summary(source) if (source / SUMMARY_NAME).is_file() else {}
    entry = {"file": into / SMOOTH_NAME, **done.effect, "modes": done.modes}
    write_summary(into, {**summary, "smoothed": entry})
    return entry


def smooth_video(
    track: str | os.PathLike[str],
    *,
    video: Path,
    camera: Path,
    keypoints: Path,
    out: str | os.PathLike[str] | None = None,
    choice: Smoothing | None = None,
    camera_name: str | None = None,
    layout: str | None = None,
    normalised: bool | Scale = False,
    masks: Path | None = None,
    body: Path | None = None,
    others: Sequence[ViewFiles] = (),
) -> dict[str, Any]:
    """Smooth a track on disk with its video: `smooth.npz` and an entry in `summary.json`.

    Args:
        track: `track.npz`, or the folder that it is in; its `summary.json` has the settings.
        video: The video that was tracked, or a folder of images.
        camera: Calibration file, see `torchcss.io.cameras`.
        keypoints: 2D joints, see `torchcss.io.keypoints.read`.
        out: Output folder; by default that of the track.
        choice: How to smooth; `IMAGES` by default.
        camera_name: Which camera of the file; by default the one of this video.
        layout: Layout of a keypoint file that does not name its joints.
        normalised: Whether keypoints are fractions of the image, and which, see
            `torchcss.io.keypoints.read.Scale`.
        masks: Foreground of every frame.
        body: The fitted body; by default `body.npz` beside the track if there is one, else the
            flesh of the standard humanoid on the lengths of the track.
        others: What further cameras recorded, see `torchcss.track_video`.

    Returns:
        The entry of the summary.

    Raises:
        TorchcssError: With one line that says what was wrong, for any bad input.
    """
    found, folder, into = open_track(track, out)
    settings = settings_of(folder, found)
    flesh = body_beside(folder) if body is None else read_fitted_body(body).body
    if not len(found.frames):
        raise TrackFileError(f"{track}: the track has no frames, of which the video could show any")
    first, stop = int(found.frames[0]), int(found.frames[-1]) + 1
    files = ViewFiles(
        video=Path(video),
        keypoints=Path(keypoints),
        camera_name=camera_name,
        masks=masks,
        layout=layout,
        normalised=normalised,
    )
    views = [open_view(each, camera, start=first, stop=stop) for each in (files, *others)]
    done = smooth_frames(
        found,
        moments(views, set(found.frames.tolist())),
        settings=settings,
        views=[view.view(torch.zeros((), dtype=torch.float64)) for view in views],
        body=flesh,
        choice=choice,
    )
    return write_smoothed(done, into, folder)


def settings_of(folder: Path, track: Track) -> Settings:
    """The settings that a track was made with, for evaluation on the processor in float64.

    Args:
        folder: Where its `summary.json` is; without one, the defaults.
        track: The track, which tells its body then.

    Raises:
        ConfigurationError: If the summary's settings are not those of this version.
    """
    entries: dict[str, Any] = {}
    if (folder / SUMMARY_NAME).is_file():
        entries = read_summary(folder).get("settings", {})
    known = {field.name for field in fields(Settings)}
    try:
        entries = {name: value for name, value in entries.items() if name in known}
        if "terms" in entries:
            entries["terms"] = tuple(entries["terms"])
        settings = Settings(**{"body": "", **entries, "device": "cpu", "dtype": "float64"})
    except (TypeError, AttributeError) as error:
        raise ConfigurationError(
            f"{folder / SUMMARY_NAME}: its settings are not those of torchcss: {error}"
        ) from error
    return settings if settings.body else replace(settings, body=body_of_track(track).name)
