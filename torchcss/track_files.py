"""From files to files: video, camera and keypoints in, a first pose found, the track written.

`track_video` is what `torchcss track` calls. The loop itself is `torchcss.pipeline.track_frames`,
which takes any images; `torchcss.recorder.Recorder` writes what comes out as it goes, so that a
stopped run keeps what it has.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from torchcss.cost.joints import JointObservation
from torchcss.errors import ConfigurationError, VideoError
from torchcss.first_frame import initialise_video
from torchcss.hypotheses import Initialisation
from torchcss.io.cameras import check_image_size, read_camera
from torchcss.io.fitted_body import FITTED_BODY_NAME, read_fitted_body, write_fitted_body
from torchcss.io.keypoints import read_keypoints
from torchcss.io.tracks import prepare_output_folder
from torchcss.io.video import VideoReader
from torchcss.marks import typical_sigma
from torchcss.pipeline import scale_keypoints, track_frames
from torchcss.presets import PRESETS
from torchcss.recorder import Recorder
from torchcss.recovery import Recovery
from torchcss.settings import (
    Settings,
    boundary_emphasis,
    make_choice,
    make_extractor,
    make_settings_tracker,
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
    normalised: bool = False,
    masks: Path | None = None,
    init: Path | None = None,
) -> dict[str, Any]:
    """Track a body through a video file.

    Args:
        video: A video, or a folder of images.
        camera: Calibration file, see `torchcss.io.cameras`.
        keypoints: 2D joints, see `torchcss.io.keypoints`.
        out: Folder for `track.npz`, `summary.json`, `overlay.mp4`, and the body at its first pose,
            `body.npz`, by which `torchcss.smooth_video` knows its flesh.
        settings: How to track.
        camera_name: Which camera of the file; by default the one of this video.
        start: First frame.
        stop: Frame before which to end.
        stride: Every how many frames to track.
        layout: Layout of a keypoint file that does not name its joints.
        normalised: Whether keypoints are fractions of the image.
        masks: Foreground of every frame, white or in shades of belief: a video or a folder of
            images, of the size and number of the video's frames.
        init: A body that `torchcss init` fitted to the first frame, to start from.

    Returns:
        The summary.

    Raises:
        TorchcssError: With one line that says what was wrong, for any bad input.
    """
    settings = settings or Settings()
    out = Path(out)
    prepare_output_folder(out)
    fitted_path = out / FITTED_BODY_NAME
    part = {"start": start, "stop": stop, "stride": stride}
    reader = VideoReader(video, **part)
    width, height = reader.info.width, reader.info.height
    foreground = None if masks is None else VideoReader(masks, **part)
    if foreground is not None and (foreground.info.width, foreground.info.height) != (
        width,
        height,
    ):
        raise VideoError(
            f"{masks}: masks must have the video's size {width} x {height}, these have "
            f"{foreground.info.width} x {foreground.info.height}"
        )
    loaded = read_camera(camera, camera_name=camera_name, video=video)
    check_image_size(loaded.camera, width, height)
    num_frames = reader.info.num_frames or reader.count_frames()
    marks = read_keypoints(
        keypoints,
        image_size_wh=(width, height),
        num_frames=num_frames,
        layout=layout,
        normalised=normalised,
        first_frame=start,
    )
    notes = [note for note in (loaded.units_note, *marks.report) if note]
    generator = torch.Generator().manual_seed(settings.seed)
    dtype, device = settings.torch_dtype, settings.device
    eye = loaded.camera.to(dtype=dtype, device=device)
    sigma = typical_sigma(marks.keypoints, marks.confidence)
    if init is not None:
        first = _first_pose_from_file(init, eye, settings)
    else:
        first = initialise_video(
            video, marks, eye, settings, start=start, sigma=sigma, generator=generator
        )
    notes += first.report
    for note in notes:
        tqdm.write(note)
    # What it was read from stays as it is, be it in the same folder.
    if init is None or Path(init).resolve() not in (out.resolve(), fitted_path.resolve()):
        write_fitted_body(fitted_path, first, eye)

    extractor = make_extractor(settings)
    working = extractor.working_shape(width, height)
    scaled = scale_keypoints(marks.keypoints, (width, height), working).to(dtype).to(device)
    confidence = marks.confidence.to(dtype).to(device)

    def observe(index: int) -> JointObservation | None:
        if settings.keypoints_use == "first" and index != start:
            return None
        return JointObservation(
            first.body.joint_names, scaled[index], confidence[index], marks.joint_names
        )

    interval = stride / float(reader.info.frame_rate)
    tracker = make_settings_tracker(settings, first.body.motion_rate * interval)
    recorder = Recorder(
        folder=out,
        settings=settings,
        tracker=tracker,
        camera=eye,
        frame_rate=1 / interval,
        notes=notes,
        extra={
            "video": str(video),
            "camera": loaded.camera.name,
            "world_is_metric": loaded.metric,
            "body_lengths_m": first.body.lengths,
        },
    )
    tracked = track_frames(
        reader,
        body=first.body,
        mixture=first.mixture,
        camera=loaded.camera,
        extractor=extractor,
        tracker=tracker,
        choice=make_choice(settings, sigma * working[0] / width),
        observe=observe,
        frame_interval=interval,
        generator=generator,
        boundary_emphasis=boundary_emphasis(settings),
        limits=PRESETS[settings.preset].limits,
        jumps_every=PRESETS[settings.preset].jumps_every,
        recovery=Recovery() if settings.recovery else None,
        masks=None if foreground is None else (mask.image for mask in foreground),
    )
    return recorder.run(tracked, first.body, reader.num_selected)


def _first_pose_from_file(path: Path, camera: Camera, settings: Settings) -> Initialisation:
    """A fitted body, hung before the video's camera as it was before the picture's."""
    fitted = read_fitted_body(
        path, camera=camera, dtype=settings.torch_dtype, device=settings.device
    )
    if fitted.body.name != settings.body:
        raise ConfigurationError(
            f"{path}: the fitted body is {fitted.body.name}, to be tracked is {settings.body}; "
            f"give the body {fitted.body.name}"
        )
    note = f"first pose: {len(fitted.cost)} hypotheses from {path}"
    return Initialisation(
        fitted.body, fitted.mixture, fitted.cost, (note,), fitted.lengths, fitted.scale
    )
