"""The frames of a run with its modes drawn over them.

`pictures_of` yields the picture of every frame: from the video, with the modes drawn anew, or else
from the `overlay.mp4` that the tracker left.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from torchcss.errors import TrackFileError, VideoError
from torchcss.io.cameras import check_image_size
from torchcss.io.run import Run
from torchcss.io.tracks import TRACK_NAME
from torchcss.io.video import VideoReader
from torchcss.show.overlay import draw_poses

OVERLAY_NAME = "overlay.mp4"


def known_video(run: Run) -> Path | None:
    """The first camera's video, if the run knows it and it is still there."""
    video = run.cameras[0].files.video if run.cameras and run.cameras[0].files else None
    return video if video is not None and video.exists() else None


def overlay_of(run: Run) -> Path | None:
    """The film that the tracker drew of these very modes, if it is there."""
    overlay = run.folder / OVERLAY_NAME
    # What the tracker drew is not what, say, a smoothed track says.
    return overlay if run.path.name == TRACK_NAME and overlay.is_file() else None


def has_pictures(run: Run) -> bool:
    """Whether there is an overlay or a video."""
    return overlay_of(run) is not None or known_video(run) is not None


def pictures_of(
    run: Run, rows: Iterable[int], *, anew: bool = False
) -> Iterator[tuple[int, UInt8[np.ndarray, "h w 3"]]]:
    """Yield the pictures of some frames of a track, with its modes drawn over them.

    Args:
        run: The run.
        rows: Which of its frames, counted in the track, rising.
        anew: Whether to draw over the video even where the tracker left an overlay.

    Yields:
        Row and picture; nothing if there is neither video nor overlay.

    Raises:
        VideoError: If the video lacks a frame.
        CameraError: If the camera is of another image size.
        TrackFileError: If the body or the camera is not known.
    """
    overlay, video = overlay_of(run), known_video(run)
    if video is not None and (anew or overlay is None):
        place = {int(run.track.frames[row]): int(row) for row in rows}
        reader = VideoReader(video, stop=max(place, default=0) + 1)
        check_image_size(run.camera, reader.info.width, reader.info.height)
    elif overlay is not None:
        place, video = {int(row): int(row) for row in rows}, None
        reader = VideoReader(overlay, stop=max(place, default=0) + 1)
    else:
        return
    found = 0
    for frame in reader:
        row = place.get(frame.index)
        if row is not None:
            found += 1
            yield row, frame.image if video is None else _draw_row(run, row, frame.image)
    if found < len(place):
        raise VideoError(
            f"{reader.path}: {len(place) - found} frames of the track are missing; give the video "
            "that was tracked"
        )


def rows_with_modes(run: Run) -> np.ndarray:
    """Rows of the track that have modes.

    Raises:
        TrackFileError: If there are none.
    """
    rows = np.flatnonzero(run.track.num_modes > 0)
    if not rows.size:
        raise TrackFileError(f"{run.path}: the track has no frames; there is nothing to show")
    return rows


def _draw_row(run: Run, row: int, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the modes of a frame, counted in the track, over its image."""
    track = run.track
    count = int(track.num_modes[row])
    base = torch.from_numpy(track.base_transform[row])
    body = run.body.with_base(base[:3, :3], base[:3, 3])
    state = torch.from_numpy(track.state[row, :count])
    cost = f"   cost {track.cost[row, 0]:.1f}" if np.isfinite(track.cost[row, 0]) else ""
    return draw_poses(
        image,
        body,
        state,
        run.camera.double(),
        weights=torch.from_numpy(np.exp(track.log_weight[row, :count])),
        text=f"frame {track.frames[row]}   {count} mode{'s' if count > 1 else ''}{cost}",
    )
