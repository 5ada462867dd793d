"""From files to files: video, camera and keypoints in, a first pose found, the track written.

`track_video` is what `torchcss track` calls. The loop itself is
`torchcss.tracking.session.track_frames`, which takes any images; `torchcss.app.recorder.Recorder`
writes what comes out as it goes, so that a stopped run keeps what it has.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from torchcss.app.init import initialise_video
from torchcss.app.recorder import OtherFilm, Recorder, Sink
from torchcss.app.view_files import OpenView, moments, open_view
from torchcss.cost.view import View
from torchcss.errors import CameraError, ConfigurationError
from torchcss.initialise.result import Initialisation
from torchcss.io.fitted_body import FITTED_BODY_NAME, read_fitted_body, write_fitted_body
from torchcss.io.keypoints.read import Scale
from torchcss.io.tracks import prepare_output_folder
from torchcss.io.view_files import RecordedCamera, ViewFiles
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import (
    Settings,
)
from torchcss.vision.camera import Camera


def track_video(
    video: Path,
    *,
    camera: Path,
    keypoints: Path,
    out: Path,
    settings: Settings | None = None,
    camera_name: str | None = None,
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
    layout: str | None = None,
    normalised: bool | Scale = False,
    masks: Path | None = None,
    init: Path | None = None,
    others: Sequence[ViewFiles] = (),
    live: Sink | None = None,
) -> dict[str, Any]:
    """Track a body through a video file.

    Args:
        video: A video, or a folder of images.
        camera: Calibration file, see `torchcss.io.cameras`.
        keypoints: 2D joints, see `torchcss.io.keypoints.read`.
        out: Folder for `track.npz`, `summary.json`, `overlay.mp4`, and the body at its first pose,
            `body.npz`, by which `torchcss.tracking.smooth_images` knows its flesh.
        settings: How to track.
        camera_name: Which camera of the file; by default the one of this video.
        start: First frame.
        stop: Frame before which to end.
        stride: Every how many frames to track.
        layout: Layout of a keypoint file that does not name its joints.
        normalised: Whether keypoints are fractions of the image, and which, see
            `torchcss.io.keypoints.read.Scale`.
        masks: Foreground of every frame, white or in shades of belief: a video or a folder of
            images, of the size and number of the video's frames.
        init: A body that `torchcss init` fitted to the first frame, to start from.
        others: What further synchronised cameras of the same calibration recorded. Their videos may
            be of another size; one that ends, or shows a single colour for a while, is left out as
            long. Their overlays are `overlay_2.mp4` and so on.
        live: What wants to see the frames while they are tracked, such as a
            `torchcss.app.live.LiveViewer`; closed at the end.

    Returns:
        The summary.

    Raises:
        TorchcssError: With one line that says what was wrong, for any bad input.
    """
    settings = settings or Settings()
    out = Path(out)
    prepare_output_folder(out)
    fitted_path = out / FITTED_BODY_NAME
    files = ViewFiles(
        video=Path(video),
        keypoints=Path(keypoints),
        camera_name=camera_name,
        masks=masks,
        layout=layout,
        normalised=normalised,
    )
    view, *beside = (
        open_view(each, camera, start=start, stop=stop, stride=stride) for each in (files, *others)
    )
    for each, opened in zip((files, *others), (view, *beside), strict=True):
        if others and not opened.camera.metric:
            raise CameraError(
                f"{camera}: several cameras need their places in one world, in metres; that of "
                f"{each.video} is not known so: give R and t"
            )
    reader, sigma, seen = view.reader, view.sigma, view.keypoints
    assert seen is not None
    generator = torch.Generator().manual_seed(settings.seed)
    dtype, device = settings.torch_dtype, settings.device
    notes = [note for opened in (view, *beside) for note in opened.notes]
    eye = view.camera.camera.to(dtype=dtype, device=device)
    if init is not None:
        first = _first_pose_from_file(init, eye, settings)
    else:
        first = initialise_video(
            video,
            seen,
            eye,
            settings,
            start=start,
            sigma=sigma,
            generator=generator,
            others=[_first_view(each, start, sigma, settings) for each in beside],
        )
    notes += first.report
    for note in notes:
        tqdm.write(note)
    # What it was read from stays as it is, be it in the same folder.
    own = init is None or Path(init).resolve() not in (out.resolve(), fitted_path.resolve())

    interval = stride / float(reader.info.frame_rate)
    session = TrackingSession(
        settings,
        first,
        [opened.view(first.body.tie) for opened in (view, *beside)],
        frame_interval=interval,
        generator=generator,
    )
    films = [
        OtherFilm(out / f"overlay_{place + 2}.mp4", 1 / interval, opened.camera.camera, place)
        for place, opened in enumerate(beside)
        if settings.overlay
    ]
    recorder = Recorder(
        folder=out,
        settings=settings,
        tracker=session.plan.tracker,
        camera=eye,
        frame_rate=1 / interval,
        video=video,
        recorded=[
            RecordedCamera(opened.camera.camera, each)
            for each, opened in zip((files, *others), (view, *beside), strict=True)
        ],
        others=[
            (opened.camera.camera, each.video) for each, opened in zip(others, beside, strict=True)
        ],
        notes=notes,
        extra={
            "video": str(video),
            "camera": eye.name,
            "other_views": [
                {"video": str(each.video), "camera": opened.camera.camera.name}
                for each, opened in zip(others, beside, strict=True)
            ],
            "world_is_metric": view.camera.metric,
            "body_lengths_m": first.body.lengths,
        },
        sinks=films if live is None else [*films, live],
        on_first_frame=partial(write_fitted_body, fitted_path, first, eye) if own else None,
    )
    return recorder.run(session.track(moments((view, *beside))), first.body, reader.num_selected)


def _first_view(opened: OpenView, start: int, sigma: float, settings: Settings) -> View:
    """What a further camera sees of the first frame, in the pixels of its video."""
    camera = opened.camera.camera.to(dtype=settings.torch_dtype, device=settings.device)
    keypoints, frame = opened.keypoints, start + opened.offset
    if keypoints is None or not 0 <= frame < len(keypoints.confidence):
        return View(camera=camera)
    keypoints = keypoints.at(frame).to(camera.K)
    return View(camera=camera, keypoints=keypoints._replace(relative_noise=opened.sigma / sigma))


def _first_pose_from_file(path: Path, camera: Camera, settings: Settings) -> Initialisation:
    """A fitted body, hung before the video's camera as it was before the picture's."""
    fitted = read_fitted_body(
        path, camera=camera, dtype=settings.torch_dtype, device=settings.device
    )
    # A body from a file is named by its path, which can be written in several ways.
    if Path(fitted.body.name).resolve() != Path(settings.body).resolve():
        raise ConfigurationError(
            f"{path}: the fitted body is {fitted.body.name}, to be tracked is {settings.body}; "
            f"give the body {fitted.body.name}"
        )
    note = f"first pose: {len(fitted.cost)} hypotheses from {path}"
    return Initialisation(
        fitted.body, fitted.mixture, fitted.cost, (note,), fitted.lengths, fitted.scale
    )
