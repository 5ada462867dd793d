"""The frames of a video with a track's modes drawn over them, and where a finished track lies.

`TrackFiles.find` gathers what is beside a track: its summary, its body with its flesh, its camera,
its overlay. `pictures_of` yields the picture of every frame: from the video, with the modes drawn
anew, or else from the `overlay.mp4` that the tracker left.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import UInt8

from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError, TrackFileError, VideoError
from torchcss.io.cameras import check_image_size, read_camera
from torchcss.io.fitted_body import body_beside, read_fitted_body
from torchcss.io.run import body_of_track
from torchcss.io.tracks import SUMMARY_NAME, TRACK_NAME, Track, load_track, read_summary
from torchcss.io.video import VideoReader
from torchcss.show.overlay import draw_overlay, project_body
from torchcss.vision.camera import Camera

OVERLAY_NAME = "overlay.mp4"

_RINGS, _MERIDIANS = 16, 20


class TrackFiles(NamedTuple):
    """A finished track and what belongs to it.

    Attributes:
        path: The track's file.
        track: The track.
        body: Its body on the world's origin, with the flesh that was fitted where that is known.
        summary: Its `summary.json`; empty where there is none.
        camera: Its camera, or None where it is not known.
        video: The video to draw over, or None.
        overlay: The film that the tracker drew of these very modes, or None.
    """

    path: Path
    track: Track
    body: BodyModel
    summary: dict[str, Any]
    camera: Camera | None
    video: Path | None
    overlay: Path | None

    @classmethod
    def find(
        cls,
        path: Path,
        *,
        video: Path | None = None,
        camera: Path | None = None,
        camera_name: str | None = None,
        body: Path | None = None,
    ) -> TrackFiles:
        """Read a track and what is beside it.

        Args:
            path: `track.npz`, `smooth.npz`, or the folder of the former.
            video: The video that was tracked; it needs a camera.
            camera: Its calibration; by default the one in `summary.json`.
            camera_name: Which camera of the file; by default the one of the video, or the one that
                was tracked with.
            body: The fitted body; by default the `body.npz` beside the track, if any, else the
                standard humanoid's flesh on the track's lengths.

        Raises:
            TorchcssError: If a file cannot be used, or a video is given and no camera is known.
        """
        path = Path(path)
        file = path / TRACK_NAME if path.is_dir() else path
        track, folder = load_track(file), file.parent
        if not len(track.frames):
            raise TrackFileError(f"{file}: the track has no frames; there is nothing to show")
        known = body_beside(folder) if body is None else read_fitted_body(body).body
        own = folder / SUMMARY_NAME
        summary = read_summary(own) if own.is_file() else {}
        eye = None
        if camera is not None:
            eye = read_camera(camera, camera_name=camera_name, video=video).camera
        elif "cameras" in summary:
            if camera_name is None and video is None:
                camera_name = summary.get("camera")  # the one that was tracked with
            eye = read_camera(own, camera_name=camera_name, video=video).camera
        if video is not None and eye is None:
            raise ConfigurationError(
                "--video: the modes can be drawn only where its camera is known; give --camera"
            )
        overlay = folder / OVERLAY_NAME
        return cls(
            path=file,
            track=track,
            body=body_of_track(track, known),
            summary=summary,
            camera=eye,
            video=video,
            # What the tracker drew is not what, say, a smoothed track says.
            overlay=overlay if file.name == TRACK_NAME and overlay.is_file() else None,
        )

    @property
    def has_pictures(self) -> bool:
        """Whether there is a video or an overlay."""
        return self.video is not None or self.overlay is not None


def pictures_of(
    files: TrackFiles, rows: Iterator[int] | range | list[int] | np.ndarray
) -> Iterator[tuple[int, UInt8[np.ndarray, "h w 3"]]]:
    """Yield the pictures of some frames of a track, with its modes drawn over them.

    Args:
        files: The track.
        rows: Which of its frames, counted in the track, rising.

    Yields:
        Row and picture; nothing if there is neither video nor overlay.

    Raises:
        VideoError: If the video lacks a frame.
        CameraError: If the camera is of another image size.
    """
    track = files.track
    if files.video is not None and files.camera is not None:
        place = {int(track.frames[row]): int(row) for row in rows}
        reader = VideoReader(files.video, stop=max(place, default=0) + 1)
        check_image_size(files.camera, reader.info.width, reader.info.height)
    elif files.overlay is not None:
        place = {int(row): int(row) for row in rows}
        reader = VideoReader(files.overlay, stop=max(place, default=0) + 1)
    else:
        return
    found = 0
    for frame in reader:
        row = place.get(frame.index)
        if row is not None:
            found += 1
            image = np.ascontiguousarray(frame.image)
            yield row, image if files.video is None else draw_row(files, row, image)
    if found < len(place):
        raise VideoError(
            f"{reader.path}: {len(place) - found} frames of the track are missing; give the video "
            "that was tracked"
        )


def draw_row(
    files: TrackFiles, row: int, image: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the modes of a frame over its image.

    Args:
        files: The track; its camera is known.
        row: Which of its frames, counted in the track.
        image: The image.
    """
    track, camera = files.track, files.camera
    assert camera is not None
    count = int(track.num_modes[row])
    base = torch.from_numpy(track.base_transform[row])
    body = files.body.with_base(base[:3, :3], base[:3, 3])
    state = torch.from_numpy(track.state[row, :count])
    modes = project_body(body, state, camera.double(), rings=_RINGS, meridians=_MERIDIANS)
    cost = f"   cost {track.cost[row, 0]:.1f}" if np.isfinite(track.cost[row, 0]) else ""
    picture = draw_overlay(
        torch.from_numpy(image),
        modes,
        weights=torch.from_numpy(np.exp(track.log_weight[row, :count])),
        text=f"frame {track.frames[row]}   {count} mode{'s' if count > 1 else ''}{cost}",
    )
    return picture.numpy()
