"""Names of version 0.1 that are kept for one version: each says what to call now."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchcss.app import smooth as smoothing
from torchcss.app.smooth import SmoothedTrack, smooth
from torchcss.body.model import BodyModel
from torchcss.files import StrPath
from torchcss.initialise.result import Initialisation
from torchcss.initialise.view import CameraView
from torchcss.io.export import Exported, ExportOptions, export
from torchcss.io.run import Given, GivenKeypoints, Run, body_of_track
from torchcss.io.tracks import Track
from torchcss.tracking.session import Images, Posterior, TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.tracking.smooth import Smoothing


def smooth_track(
    track: Track, body: BodyModel | None = None, *, choice: Smoothing | None = None
) -> SmoothedTrack:
    """As `torchcss.app.smooth.smooth_track`; a track of version 0.1 needs the body."""
    _say("smooth_track", "torchcss.smooth(run)")
    return smoothing.smooth_track(_with(track, body), choice)


def smooth_file(
    track: StrPath,
    *,
    out: StrPath | None = None,
    choice: Smoothing | None = None,
    body: BodyModel | None = None,
) -> dict[str, Any]:
    """As `torchcss.smooth`; returns the entry of the summary."""
    _say("smooth_file", "torchcss.smooth(run)")
    return dict(smooth(_opened(track, body), choice, out=out).summary["smoothed"])


def smooth_video(
    track: StrPath,
    *,
    video: Path,
    camera: Path,
    keypoints: Path,
    out: StrPath | None = None,
    choice: Smoothing | None = None,
    masks: Path | None = None,
    body: Path | None = None,
) -> dict[str, Any]:
    """As `torchcss.smooth` with images; returns the entry of the summary."""
    _say("smooth_video", "torchcss.smooth(run, images=True)")
    given = Given(video=video, camera=camera, body=body)
    run = Run.open(track, given, GivenKeypoints(keypoints=keypoints, masks=masks))
    return dict(smooth(run, choice, images=True, out=out).summary["smoothed"])


def export_track(
    track: Track | StrPath,
    *,
    to: str,
    out: StrPath | None = None,
    body: BodyModel | None = None,
    options: ExportOptions | None = None,
) -> Exported:
    """As `torchcss.export`; a track of version 0.1 needs the body."""
    _say("export_track", "torchcss.export(run, path)")
    known = _with(track, body) if isinstance(track, Track) else _opened(track, body)
    return export(known, out, to=to, options=options)


def track_frames(
    frames: Iterable[Images],
    *,
    settings: Settings,
    first: Initialisation,
    views: Sequence[CameraView],
    frame_interval: float,
) -> Iterator[Posterior]:
    """Track through a sequence: `TrackingSession(settings, first, views).track(frames)`."""
    _say("track_frames", "torchcss.TrackingSession(...).track(frames)")
    return TrackingSession(settings, first, views, frame_interval=frame_interval).track(frames)


def _say(old: str, new: str) -> None:
    text = f"torchcss.{old} goes with the next version: call {new}"
    warnings.warn(text, DeprecationWarning, stacklevel=3)


def _with(track: Track, body: BodyModel | None) -> Track:
    return track if body is None else track._replace(body=body_of_track(track, body))


def _opened(track: StrPath, body: BodyModel | None) -> Run:
    run = Run.open(track)
    return replace(run, track=_with(run.track, body))
