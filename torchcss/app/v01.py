"""Names of version 0.1 that are kept for one version: each says what to call now."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchcss.app.smooth import smooth
from torchcss.body.model import BodyModel
from torchcss.initialise.result import Initialisation
from torchcss.io.export import Export, ExportOptions, export
from torchcss.io.run import Given, GivenKeypoints, Run, body_of_track
from torchcss.io.tracks import Track
from torchcss.tracking import smooth as smoothing
from torchcss.tracking.session import Images, Posterior, TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.tracking.smooth import SmoothedTrack, Smoothing
from torchcss.tracking.view import CameraView


def smooth_track(
    track: Track, body: BodyModel | None = None, *, choice: Smoothing | None = None
) -> SmoothedTrack:
    """As `torchcss.tracking.smooth.smooth_track`; a track of version 0.1 needs the body."""
    _say("smooth_track", "torchcss.smooth(run)")
    track = track._replace(body=body_of_track(track, body))
    return smoothing.smooth_track(track, choice=choice)


def smooth_file(
    track: str | os.PathLike[str],
    *,
    out: str | os.PathLike[str] | None = None,
    choice: Smoothing | None = None,
    body: BodyModel | None = None,
) -> dict[str, Any]:
    """As `torchcss.smooth`; returns the entry of the summary."""
    _say("smooth_file", "torchcss.smooth(run)")
    done = smooth(_opened(track, body), choice, out=out)
    return dict(done.summary["smoothed"])


def smooth_video(
    track: str | os.PathLike[str],
    *,
    video: Path,
    camera: Path,
    keypoints: Path,
    out: str | os.PathLike[str] | None = None,
    choice: Smoothing | None = None,
    masks: Path | None = None,
    body: Path | None = None,
) -> dict[str, Any]:
    """As `torchcss.smooth` with images; returns the entry of the summary."""
    _say("smooth_video", "torchcss.smooth(run, images=True)")
    given = Given(video=video, camera=camera, body=body)
    marked = GivenKeypoints(keypoints=keypoints, masks=masks)
    done = smooth(Run.open(track, given, marked), choice, images=True, out=out)
    return dict(done.summary["smoothed"])


def export_track(
    track: Track | str | os.PathLike[str],
    *,
    to: str,
    out: str | os.PathLike[str] | None = None,
    body: BodyModel | None = None,
    options: ExportOptions | None = None,
) -> Export:
    """As `torchcss.export`; a track of version 0.1 needs the body."""
    _say("export_track", "torchcss.export(run, path)")
    if not isinstance(track, Track):
        return export(_opened(track, body), out, to=to, options=options)
    if body is not None:
        track = track._replace(body=body_of_track(track, body))
    return export(track, out, to=to, options=options)


def track_frames(
    frames: Iterable[Images],
    *,
    settings: Settings,
    first: Initialisation,
    views: Sequence[CameraView],
    frame_interval: float,
) -> Iterator[Posterior]:
    """Track through a sequence: `TrackingSession(settings, first, views).track(frames)`.

    Args:
        frames: The images of one moment after another.
        settings: How to track.
        first: Where the body may be in the first frame.
        views: The cameras that look on.
        frame_interval: Seconds between frames.
    """
    _say("track_frames", "torchcss.TrackingSession(...).track(frames)")
    return TrackingSession(settings, first, views, frame_interval=frame_interval).track(frames)


def _say(old: str, new: str) -> None:
    warnings.warn(
        f"torchcss.{old} goes with the next version: call {new}", DeprecationWarning, stacklevel=3
    )


def _opened(track: str | os.PathLike[str], body: BodyModel | None) -> Run:
    run = Run.open(track)
    if body is None:
        return run
    return replace(run, track=run.track._replace(body=body_of_track(run.track, body)))
