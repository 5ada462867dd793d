"""The film of a run: its modes over the video, `overlay.mp4`, and one for every further camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.inference.mixture import GaussianMixture
from torchcss.io.run import Run
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.io.view_files import RecordedCamera
from torchcss.show.overlay import draw_overlay, project_body
from torchcss.vision.camera import Camera

_RINGS, _MERIDIANS = 16, 20


def draw_modes(
    image: UInt8[np.ndarray, "h w 3"],
    body: BodyModel,
    mixture: GaussianMixture,
    camera: Camera,
    text: str,
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the best mode as a shaded body and the others as outlines over an image.

    Args:
        image: The full-size image.
        body: The body on its base.
        mixture: The modes, best first.
        camera: Camera of the image.
        text: A line in the corner.
    """
    modes = project_body(body, mixture.mean, camera, rings=_RINGS, meridians=_MERIDIANS)
    pixels = torch.from_numpy(np.ascontiguousarray(image))
    return draw_overlay(pixels, modes, weights=mixture.weight, text=text).numpy()


def caption(frame: int, cost: Float[Tensor, " k"]) -> str:
    """The line in the corner of a frame.

    Args:
        frame: Its index in the video.
        cost: Cost of its modes, nats.
    """
    return f"frame {frame}   {len(cost)} modes   cost {float(cost[0]):.1f}"


def write_overlays(run: Run, frame_rate: float) -> list[Path]:
    """Draw the films of a run: `overlay.mp4`, `overlay_2.mp4` and so on, one a camera.

    A further camera's film is black where its video has ended.

    Args:
        run: The run.
        frame_rate: Frames per second of the films.

    Returns:
        The files.

    Raises:
        TorchcssError: If a video cannot be read, or a film not be written.
    """
    films = []
    for place, recorded in enumerate(run.cameras):
        if recorded.files is None:
            continue
        name = "overlay.mp4" if place == 0 else f"overlay_{place + 1}.mp4"
        with VideoWriter(run.folder / name, frame_rate) as film:
            for picture in _pictures(run, recorded):
                film.write(picture)
        films.append(run.folder / name)
    return films


def _pictures(run: Run, recorded: RecordedCamera) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    track, body, (camera, files) = run.track, run.body, recorded
    assert files is not None
    first, last = (int(track.frames[end]) + files.offset for end in (0, -1))
    reader = iter(VideoReader(files.video, start=first, stop=last + 1))
    width, height = camera.image_size_wh
    for row, index in enumerate(track.frames.tolist()):
        wanted = index + files.offset
        frame = next((frame for frame in reader if frame.index >= wanted), None)
        if frame is not None and frame.index == wanted:
            image = frame.image
        else:
            image = np.zeros((height, width, 3), np.uint8)
        k = int(track.num_modes[row])
        base, state, covariance, log_weight, cost = (
            torch.from_numpy(array)
            for array in (
                track.base_transform[row],
                track.state[row, :k],
                track.covariance[row, :k],
                track.log_weight[row, :k],
                track.cost[row, :k],
            )
        )
        mixture = GaussianMixture(state, covariance, log_weight)
        hung = body.with_base(base[:3, :3], base[:3, 3])
        yield draw_modes(image, hung, mixture, camera, caption(index, cost))
