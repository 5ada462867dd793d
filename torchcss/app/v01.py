"""Names of version 0.1 that have been replaced; they go with the next version."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence

from torchcss.initialise.result import Initialisation
from torchcss.tracking.session import Images, Posterior, TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.tracking.view import CameraView


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
    warnings.warn(
        "torchcss.track_frames: use torchcss.TrackingSession(...).track(frames)",
        DeprecationWarning,
        stacklevel=2,
    )
    return TrackingSession(settings, first, views, frame_interval=frame_interval).track(frames)
