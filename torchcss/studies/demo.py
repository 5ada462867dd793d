"""The demo: render an arm before clutter, track it, and compare with the truth.

The tracker gets the images, the camera, where the shoulder is, and noisy 2D joints of the first
frame only; from there on it sees edges. `run_demo` is what `torchcss demo` calls.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcss.app.recorder import Recorder
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.initialise.fit import initialise_from_joints
from torchcss.io.tracks import load_track, prepare_output_folder, write_summary
from torchcss.io.video import VideoWriter
from torchcss.studies.render.sequences import SyntheticSequence, arm_sequence
from torchcss.tracking.presets import PRESETS
from torchcss.tracking.recovery import Recovery
from torchcss.tracking.session import track_frames
from torchcss.tracking.settings import (
    Settings,
    boundary_emphasis,
    make_choice,
    make_extractor,
    make_settings_tracker,
)
from torchcss.types import Frame

KEYPOINT_NOISE_PX = 1.5


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
    settings = settings or Settings(body="arm8", keypoints_use="first")
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
    keypoints = exact + KEYPOINT_NOISE_PX * noise
    confidence = torch.ones_like(keypoints[:, 0])
    body = sequence.body.to(dtype=dtype, device=device)
    camera_there = camera.to(dtype=dtype, device=device)
    joints = JointTerm(sigma=KEYPOINT_NOISE_PX)
    first = initialise_from_joints(
        settings.body,
        camera_there,
        keypoints,
        confidence,
        body.joint_names,
        generator=generator,
        joints=joints,
        placed=body,
        dtype=dtype,
        device=device,
    )
    marks = JointObservation(
        body.joint_names, keypoints.to(dtype=dtype, device=device), confidence.to(dtype).to(device),
        body.joint_names,
    )  # fmt: skip
    interval = 1 / sequence.frame_rate
    tracker = make_settings_tracker(settings, body.motion_rate * interval)
    tracked = track_frames(
        (Frame(i, i * interval, image) for i, image in enumerate(sequence.frames)),
        body=first.body,
        mixture=first.mixture,
        camera=camera_there,
        extractor=make_extractor(settings),
        tracker=tracker,
        choice=make_choice(settings, KEYPOINT_NOISE_PX),
        observe=lambda index: marks if index == 0 else None,
        frame_interval=interval,
        generator=generator,
        boundary_emphasis=boundary_emphasis(settings),
        limits=PRESETS[settings.preset].limits,
        recovery=Recovery() if settings.recovery else None,
        jumps_every=PRESETS[settings.preset].jumps_every,
        limb_jumps=settings.limb_jumps,
        carries=settings.prediction == "surface",
    )
    recorder = Recorder(
        folder=out,
        settings=settings,
        tracker=tracker,
        camera=camera_there,
        frame_rate=sequence.frame_rate,
        notes=list(first.report),
    )
    summary = recorder.run(tracked, first.body, len(sequence.frames))
    track = load_track(out)
    reference = truth.cpu().numpy()[track.frames]
    error = np.linalg.norm(track.joints_world - reference[:, None], axis=-1).mean(-1)
    error = np.where(np.isfinite(track.log_weight), error, np.inf)
    summary["mpjpe_mm"] = 1000 * float(error[:, 0].mean())
    summary["mpjpe_best_of_modes_mm"] = 1000 * float(error.min(axis=1).mean())
    write_summary(out, summary)
    return summary
