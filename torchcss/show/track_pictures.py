"""The frames of a run with its modes drawn over them: the overlay films, and single pictures.

`write_overlays` makes `overlay.mp4`, and one for every further camera. `pictures_of` yields the
picture of every frame: from the video, with the modes drawn anew, or else from the `overlay.mp4`
that the tracker left. One that went on is drawn from the video where that film ends.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch

from torchcss.body.model import BodyModel
from torchcss.errors import VideoError
from torchcss.io.cameras import check_image_size
from torchcss.io.run import Run
from torchcss.io.tracks import TRACK_NAME, FrameModes
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.io.view_files import RecordedCamera
from torchcss.show.overlay import draw_poses
from torchcss.types import ColourImage
from torchcss.vision.camera import Camera

OVERLAY_NAME = "overlay.mp4"


def caption(frame: int, num_modes: int, cost: float) -> str:
    """The line in the corner of a frame.

    Args:
        frame: Its index in the video.
        num_modes: How many modes it has.
        cost: Cost of the best, nats; infinite where the frame said nothing.
    """
    told = f"   cost {cost:.1f}" if np.isfinite(cost) else ""
    return f"frame {frame}   {num_modes} mode{'s' if num_modes > 1 else ''}{told}"


def write_overlays(run: Run, frame_rate: float) -> list[Path]:
    """Draw the films of a run: `overlay.mp4`, `overlay_2.mp4` and so on, one a camera.

    Frames are shown when the first camera took them. A further camera's film is black where its
    video has ended.

    Args:
        run: The run.
        frame_rate: Mean frames per second of the films.

    Returns:
        The files.

    Raises:
        TorchcssError: If a video cannot be read, or a film not be written.
    """
    films, times = [], run.track.times
    for place, recorded in enumerate(run.cameras):
        if recorded.files is None:
            continue
        name = OVERLAY_NAME if place == 0 else f"overlay_{place + 1}.mp4"
        width, height = recorded.camera.image_size_wh
        with VideoWriter(run.folder / name, frame_rate) as film:
            for row, image in _frames_of(run, recorded, range(len(run.track.frames))):
                image = np.zeros((height, width, 3), np.uint8) if image is None else image
                drawn = draw_modes(image, run.body, run.track.modes(row), recorded.camera)
                film.write(drawn, times[row] - times[0])
        films.append(run.folder / name)
    return films


def known_video(run: Run) -> Path | None:
    """The first camera's video, if the run knows it and it is still there."""
    files = run.track.first_files
    return files.video if files is not None and files.video.exists() else None


def overlay_of(run: Run) -> tuple[Path, int]:
    """The film that the tracker drew of these very modes, and how many of its frames are whole."""
    overlay = run.folder / OVERLAY_NAME
    # What the tracker drew is not what, say, a smoothed track says.
    if run.path.name == TRACK_NAME and overlay.is_file():
        with suppress(VideoError):
            return overlay, VideoReader(overlay).count_frames()
    return overlay, 0


def has_pictures(run: Run) -> bool:
    """Whether there is an overlay or a video."""
    return overlay_of(run)[1] > 0 or known_video(run) is not None


def without_pictures(run: Run) -> str | None:
    """A line about an overlay that is damaged, or frames that nothing shows; None: all is there."""
    (overlay, whole), video = overlay_of(run), known_video(run)
    damaged = f"{overlay}: damaged, " * (run.path.name == TRACK_NAME and overlay.is_file())
    if video is not None:
        return f"{damaged}drawn anew from the video" if damaged and not whole else None
    if not whole:
        told = "without pictures: give --video (and --camera) to see what the modes explain"
        return damaged + told
    left = len(run.track.frames) - whole
    told = f"{overlay}: {left} frames of the track are missing; give the video that was tracked"
    return told if left > 0 else None


def pictures_of(
    run: Run, rows: Iterable[int], *, anew: bool = False
) -> Iterator[tuple[int, ColourImage]]:
    """Yield the pictures of some frames of a track, with its modes drawn over them.

    Args:
        run: The run.
        rows: Which of its frames, counted in the track, rising.
        anew: Whether to draw over the video even where the tracker left an overlay.

    Yields:
        Row and picture; nothing of frames that neither video nor overlay has (`without_pictures`).

    Raises:
        VideoError: If there is a video and it lacks a frame.
        CameraError: If the camera is of another image size.
        TrackFileError: If the body or the camera is not known.
    """
    (overlay, whole), video, left = overlay_of(run), known_video(run), list(rows)
    if left and whole and (video is None or not anew):
        with suppress(VideoError):  # what follows its damage is drawn from the video
            for frame in VideoReader(overlay, stop=left[-1] + 1):
                if frame.index in left:
                    left.remove(frame.index)
                    yield frame.index, frame.image
    if left and video is not None:
        first = run.cameras[0]
        for row, image in _frames_of(run, first, tuple(left)):
            if image is not None:
                left.remove(row)
                yield row, draw_modes(image, run.body, run.track.modes(row), first.camera)
    if left and video is not None:
        raise VideoError(
            f"{video}: {len(left)} frames of the track are missing; give the video that was tracked"
        )


def _frames_of(
    run: Run, recorded: RecordedCamera, rows: Iterable[int]
) -> Iterator[tuple[int, ColourImage | None]]:
    """What a camera saw in some frames of the track; None where its video has none."""
    assert recorded.files is not None
    wanted = {int(run.track.frames[row]) + recorded.files.offset: int(row) for row in rows}
    start, stop = min(wanted, default=0), max(wanted, default=0) + 1
    reader = VideoReader(recorded.files.video, start=start, stop=stop)
    check_image_size(recorded.camera, reader.info.width, reader.info.height)
    frames = iter(reader)
    for index, row in wanted.items():
        frame = next((frame for frame in frames if frame.index >= index), None)
        yield row, frame.image if frame is not None and frame.index == index else None


def draw_modes(
    image: ColourImage, body: BodyModel, modes: FrameModes, camera: Camera
) -> ColourImage:
    """Draw the modes of a frame over its image.

    Args:
        image: The image.
        body: The body, on any base.
        modes: The modes, the best first.
        camera: The image's camera.
    """
    base = modes.base_transform
    return draw_poses(
        image,
        body.with_base(base[:3, :3], base[:3, 3]).to(dtype=torch.float64, device="cpu"),
        modes.state,
        camera.to(dtype=torch.float64, device="cpu"),
        weights=modes.log_weight.exp(),
        text=caption(modes.frame, len(modes.cost), float(modes.cost[0])),
    )
