"""`Run`: what a tracker left in a folder, as an object that knows all about it.

    run = Run.open("out/mine")
    run.track, run.body, run.cameras, run.settings, run.checkpoint

A track's file holds its body, cameras and settings (`torchcss.io.tracks`). Folders of version 0.1
hold what they hold: the body in `body.npz`, cameras and settings in `summary.json`. What a folder
lacks is given in `Given`; asking a `Run` for what neither says is an error of one line.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from torchcss.body.bases import on_origin, pose_track
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES
from torchcss.errors import TorchcssError, TrackFileError
from torchcss.files import StrPath, make_paths
from torchcss.io.cameras import read_camera
from torchcss.io.checkpoint import Checkpoint, read_checkpoint
from torchcss.io.fitted_body import FITTED_BODY_NAME, read_fitted_body
from torchcss.io.keypoints.read import Scale
from torchcss.io.tracks import SUMMARY_NAME, TRACK_NAME, Track, load_track, read_summary
from torchcss.io.view_files import RecordedCamera, ViewFiles
from torchcss.types import frozen
from torchcss.vision.camera import Camera

TOLERANCE = 1e-4
"""Metres by which a body that is given may miss the joints of the track: far above float32's
rounding."""


@frozen
class Given:
    """What a run lacks, or has moved; what is given here counts before what the folder says.

    Attributes:
        body: The body that was tracked: a `body.npz`, a robot's file, or the name of a body.
        camera: Calibration file of the first camera.
        camera_name: Which camera of the file, or of the run; by default the one of the video, or
            the one that was tracked with.
        video: What that camera took.
    """

    body: Path | None = None
    camera: Path | None = None
    camera_name: str | None = None
    video: Path | None = None

    def __post_init__(self) -> None:
        make_paths(self)


@frozen
class GivenKeypoints:
    """The same of what belongs to the first camera's video.

    Attributes:
        keypoints: 2D joints in it, as for track.
        layout: Layout of a keypoint file that does not name its joints, e.g. BODY_25.
        normalised: Whether keypoints are pixels, or fractions of the image from 0 to 1 or from -1
            to 1.
        masks: Foreground of every frame: a video or a folder of images of the video's size.
    """

    keypoints: Path | None = None
    layout: str | None = None
    normalised: Scale | None = None
    masks: Path | None = None

    def __post_init__(self) -> None:
        make_paths(self)


@frozen
class Run:
    """A finished, or interrupted, run.

    Attributes:
        path: The track's file.
        track: The track.
        summary: Its `summary.json`; empty where there is none.
    """

    path: Path
    track: Track = field(repr=False)
    summary: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @classmethod
    def open(
        cls, folder: StrPath, given: Given | None = None, keypoints: GivenKeypoints | None = None
    ) -> Run:
        """Open a run.

        Args:
            folder: The folder, or a track's file in it (`track.npz`, `smooth.npz`).
            given: What the folder lacks.
            keypoints: What it lacks of the first camera's video.

        Raises:
            TorchcssError: If a file is missing or damaged, or what is given does not fit.
        """
        given, keypoints, path = given or Given(), keypoints or GivenKeypoints(), Path(folder)
        path = path / TRACK_NAME if path.is_dir() else path
        track = load_track(path)
        own = path.parent / SUMMARY_NAME
        summary = read_summary(own) if own.is_file() else {}
        return cls(
            path=path,
            track=track._replace(
                body=_body(track, path.parent, given),
                cameras=_cameras(track, own, summary, given, keypoints),
                settings=track.settings or summary.get("settings", {}),
            ),
            summary=summary,
        )

    @property
    def folder(self) -> Path:
        """The folder that the track is in."""
        return self.path.parent

    @property
    def body(self) -> BodyModel:
        """The body that was tracked, float64 on the world's origin.

        Raises:
            TrackFileError: If it is not known.
        """
        return body_of_track(self.track)

    @property
    def cameras(self) -> tuple[RecordedCamera, ...]:
        """The cameras with their files, as far as known; the first one's pixels count."""
        return self.track.cameras

    @property
    def camera(self) -> Camera:
        """The first camera.

        Raises:
            TrackFileError: If it is not known.
        """
        if not self.cameras:
            raise TrackFileError(
                f"{self.path}: neither it nor {SUMMARY_NAME} says which camera it was; give the "
                "calibration with --camera (Given.camera)"
            )
        return self.cameras[0].camera

    @property
    def settings(self) -> Mapping[str, Any]:
        """What the tracker was told, as plain data; empty where it is not known."""
        return self.track.settings

    @cached_property
    def checkpoint(self) -> Checkpoint | None:
        """Where the run can go on, read when asked for; None if it left nothing.

        Raises:
            TrackFileError: If the file is damaged.
        """
        return read_checkpoint(self.folder)


def as_run(run: Run | StrPath) -> Run:
    """A run, or the one in a folder."""
    return run if isinstance(run, Run) else Run.open(run)


def body_of_track(track: Track, body: BodyModel | None = None) -> BodyModel:
    """The body of a track, float64 on the world's origin.

    Args:
        track: The track.
        body: The body, for a track that does not hold it; it is checked.

    Raises:
        TrackFileError: If neither says it, or the parameters or joints of the body that is given
            are others than the track's, or lie elsewhere.
    """
    if body is None:
        if track.body is None:
            raise TrackFileError(
                "the track does not say which body was tracked; give it with --body (Given.body)"
            )
        return track.body
    if (body.state_names, body.joint_names) != (track.state_names, track.joint_names):
        raise TrackFileError(
            f"the body {body.name} has other parameters or joints than the track; expected the "
            f"parameters {', '.join(track.state_names)}"
        )
    body = on_origin(body)
    state, base, target = (
        torch.from_numpy(array)
        for array in (track.state[:, 0], track.base_transform, track.joints_world[:, 0])
    )
    gap = (pose_track(body, state, base).joints - target).abs()
    if gap.numel() and float(gap.max()) > TOLERANCE:
        raise TrackFileError(
            f"the body {body.name} misses the joints of the track by "
            f"{1000 * float(gap.max()):.1f} mm; give the body that was tracked"
        )
    return body


def _body(track: Track, folder: Path, given: Given) -> BodyModel | None:
    """The body that is given, else the track's own, else that of version 0.1's `body.npz`."""
    path = given.body
    if path is None:
        if track.body is not None or not (folder / FITTED_BODY_NAME).is_file():
            return track.body
        path = folder
    if path.is_dir() or path.suffix.lower() == ".npz":
        return body_of_track(track, read_fitted_body(path).body)
    rooted = set(ROOT_NAMES) <= set(track.state_names)
    return body_of_track(track, load_body(str(path), free_root=rooted))


def _cameras(
    track: Track, own: Path, summary: Mapping[str, Any], given: Given, keypoints: GivenKeypoints
) -> tuple[RecordedCamera, ...]:
    """The cameras, the one that is given first, with what is given of its files."""
    known = track.cameras or _cameras_of_summary(own, summary)
    wanted = None if given.video is None else given.video.name
    if given.camera is not None:
        source, name, video = given.camera, given.camera_name, given.video
        camera = read_camera(source, name, video=video)
        first, *others = known or (RecordedCamera(camera),)
        known = (first._replace(camera=camera), *others)
    elif given.camera_name is not None or wanted is not None:
        chosen = [
            each
            for each in known
            if each.camera.name == given.camera_name
            or (given.camera_name is None and each.files and each.files.video.name == wanted)
        ]
        if given.camera_name is not None and not chosen:
            raise TrackFileError(
                f"{own.parent}: the run has no camera {given.camera_name!r}; it has "
                f"{', '.join(each.camera.name for each in known) or 'none that is known'}"
            )
        known = (*chosen, *(each for each in known if each not in chosen))
    told: dict[str, Any] = {name: value for name, value in asdict(keypoints).items() if value}
    if given.video is not None:
        if not known:
            raise TrackFileError(
                f"{own.parent}: --video: the run does not say which camera took it; give --camera"
            )
        told["video"] = given.video
        known = (known[0]._replace(files=known[0].files or _files_of(given.video)), *known[1:])
    if not told or not known or known[0].files is None:
        return known
    return (known[0]._replace(files=replace(known[0].files, **told)), *known[1:])


def _files_of(video: Path) -> ViewFiles:
    return ViewFiles(video=video, keypoints=None)


def _cameras_of_summary(own: Path, summary: Mapping[str, Any]) -> tuple[RecordedCamera, ...]:
    """The cameras that version 0.1 put into `summary.json`, with their videos."""
    found = []
    for view in (summary, *summary.get("other_views", [])) if summary.get("cameras") else ():
        name = view.get("camera") or next(iter(summary["cameras"]))
        video = view.get("video")
        files = None if video is None else _files_of(Path(video))
        with suppress(TorchcssError):  # a summary that somebody edited: as if it had none
            found.append(RecordedCamera(read_camera(own, name), files))
    return tuple(found)
