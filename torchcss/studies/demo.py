"""The demo: render an arm before clutter, track it, and compare with the truth.

The tracker gets the images, the camera, where the shoulder is, and noisy 2D joints of the first
frame only; from there on it sees edges. `run_demo` is what `torchcss demo` calls.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcss.app.overlay import write_overlays
from torchcss.app.recorder import Recorder
from torchcss.initialise.fit import initialise
from torchcss.initialise.options import InitialiseOptions
from torchcss.io.run import Run
from torchcss.io.tracks import load_track, prepare_output_folder, write_summary
from torchcss.io.video import VideoWriter
from torchcss.io.view_files import RecordedCamera, ViewFiles
from torchcss.studies.render.sequences import SyntheticSequence, arm_sequence
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import (
    Settings,
)
from torchcss.tracking.view import CameraView
from torchcss.types import Frame, Keypoints

KEYPOINT_NOISE_PX = 1.5
DEMO_SETTINGS = Settings(body="arm8", keypoints_use="first")


def run_demo(
    out: Path, *, settings: Settings | None = None, num_frames: int = 50
) -> dict[str, Any]:
    """Run the demo.

    Args:
        out: Folder for `track.npz`, `summary.json`, `overlay.mp4`, and the rendered `video.mp4`.
        settings: How to track; its body must be "arm8".
        num_frames: Number of frames, 25 per second.

    Returns:
        The summary, with `mpjpe_mm` (mean over frames and joints, best mode) and
        `mpjpe_best_of_modes_mm`.

    Raises:
        ConfigurationError: If there is to be no frame.
        OutputError: If the folder cannot be written.
    """
    settings = settings or DEMO_SETTINGS
    generator = torch.Generator().manual_seed(settings.seed)
    prepare_output_folder(out)
    sequence = arm_sequence(generator=generator, num_frames=num_frames)
    return track_sequence(sequence, out, settings, generator=generator)


def track_sequence(
    sequence: SyntheticSequence, out: Path, settings: Settings, *, generator: torch.Generator
) -> dict[str, Any]:
    """Track the body of a rendered sequence from noisy joints in its first frame.

    Args:
        sequence: The sequence and its truth.
        out: See `run_demo`.
        settings: How to track; `keypoints_use` is "first" whatever they say.
        generator: Source of the noise and of the samples.

    Returns:
        The summary, with the errors that `run_demo` names.

    Raises:
        OutputError: If the folder cannot be written.
    """
    prepare_output_folder(out)
    with VideoWriter(out / "video.mp4", sequence.frame_rate) as film:
        for image in sequence.frames:
            film.write(image)

    dtype, device = settings.torch_dtype, torch.device(settings.device)
    camera = sequence.camera
    truth = sequence.joints_world
    exact = camera.project(truth[0]).uv
    noise = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
    body = sequence.body.to(dtype=dtype, device=device)
    places = exact + KEYPOINT_NOISE_PX * noise
    keypoints = Keypoints(places[None], torch.ones_like(places[None, :, 0]), body.joint_names)
    camera_there = camera.to(dtype=dtype, device=device)
    options = InitialiseOptions(sigma=KEYPOINT_NOISE_PX, dtype=dtype, device=device)
    first = initialise(
        None, keypoints.at(0), camera_there, body, generator=generator, options=options
    )
    interval = 1 / sequence.frame_rate
    session = TrackingSession(
        replace(settings, keypoints_use="first"),
        first,
        [CameraView(camera_there, keypoints, KEYPOINT_NOISE_PX)],
        frame_interval=interval,
        generator=generator,
    )
    frames = (Frame(i, i * interval, image) for i, image in enumerate(sequence.frames))
    film = ViewFiles(video=out / "video.mp4", keypoints=None)
    recorder = Recorder(
        folder=out,
        session=session,
        recorded=[RecordedCamera(camera, film)],
        frame_interval=interval,
        notes=first.report,
    )
    summary = recorder.run(session.track(frames), len(sequence.frames))
    if settings.overlay:
        write_overlays(Run.open(out), sequence.frame_rate)
    track = load_track(out)
    reference = truth.cpu().numpy()[track.frames]
    error = np.linalg.norm(track.joints_world - reference[:, None], axis=-1).mean(-1)
    error = np.where(np.isfinite(track.log_weight), error, np.inf)
    summary["mpjpe_mm"] = 1000 * float(error[:, 0].mean())
    summary["mpjpe_best_of_modes_mm"] = 1000 * float(error.min(axis=1).mean())
    write_summary(out, summary)
    return summary
