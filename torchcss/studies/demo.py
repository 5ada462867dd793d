"""The demo: track a short film of an arm before clutter, and compare with the truth.

The clip lies in the package (`CLIP`); `scripts/make_demo_clip.py` films it:

| file | content |
|---|---|
| `video.mp4` | the frames |
| `cameras.json` | the camera, world to camera, metres |
| `keypoints.npz` | noisy 2D joints of the first frame |
| `body.npz` | the body at the first pose that was found from these |
| `reference3d.npz` | the true joints of all frames, metres |

The tracker gets images, camera, where the shoulder is, and the 2D joints of the first frame; from
there on it sees edges and colours. `run_demo` is what `torchcss demo` calls; it tracks the clip as
`torchcss track` tracks a user's video.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcss.app.track import TrackOptions, track_video
from torchcss.errors import ConfigurationError
from torchcss.files import prepare_output_folder, save_arrays
from torchcss.initialise.fit import initialise
from torchcss.initialise.options import InitialiseOptions
from torchcss.initialise.result import Initialisation
from torchcss.io.fitted_body import write_fitted_body
from torchcss.io.keypoints.read import OWN_NAMES
from torchcss.io.tracks import load_track, write_summary
from torchcss.io.video import VideoWriter
from torchcss.studies.metrics import mpjpe_mm
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.studies.sequence_writer import write_camera
from torchcss.studies.sequences import read_reference
from torchcss.tracking.settings import Settings
from torchcss.types import Keypoints

KEYPOINT_NOISE_PX = 1.5
DEMO_SETTINGS = Settings(body="arm8", keypoints_use="first")


CLIP = Path(__file__).parent / "demo_clip"
"""The folder of the shipped clip."""


def run_demo(
    out: Path, *, settings: Settings | None = None, num_frames: int | None = None
) -> dict[str, Any]:
    """Run the demo.

    Args:
        out: Folder for what `track_video` writes.
        settings: How to track; its body must be "arm8".
        num_frames: Only the first frames.

    Returns:
        The summary, with `mpjpe_mm` (mean over frames and joints, best mode) and
        `mpjpe_best_of_modes_mm`.

    Raises:
        ConfigurationError: If there is to be no frame.
        OutputError: If the folder cannot be written.
    """
    if num_frames is not None and num_frames < 1:
        raise ConfigurationError(f"num_frames must be at least 1, got {num_frames}")
    return _track_clip(CLIP, out, settings or DEMO_SETTINGS, None, num_frames)


def track_sequence(
    sequence: SyntheticSequence, out: Path, settings: Settings, *, generator: torch.Generator
) -> dict[str, Any]:
    """Track the body of a rendered sequence as the demo does its arm.

    Args:
        sequence: The sequence and its truth.
        out: See `run_demo`; the clip is written there as well.
        settings: How to track. There are keypoints of the first frame alone.
        generator: Source of the noise and of the search for the first pose.

    Returns:
        The summary, with the errors that `run_demo` names.

    Raises:
        OutputError: If the folder cannot be written.
    """
    dtype, device = settings.torch_dtype, torch.device(settings.device)
    body = sequence.body.to(dtype=dtype, device=device)
    camera = sequence.camera.to(dtype=dtype, device=device)
    there = replace(sequence, body=body, camera=camera, states=sequence.states.to(body.tie))
    first = write_clip(out, there, generator=generator)
    return _track_clip(out, out, settings, first)


def write_clip(
    folder: Path, sequence: SyntheticSequence, *, generator: torch.Generator
) -> Initialisation:
    """Write a sequence as the demo's clip is, with noisy joints of the first frame.

    Args:
        folder: The folder; made if missing.
        sequence: The sequence and its truth.
        generator: Source of the noise, and of the search for the first pose.

    Returns:
        The first pose that was found.

    Raises:
        OutputError: If the folder cannot be written.
    """
    prepare_output_folder(folder)
    with VideoWriter(folder / "video.mp4", sequence.frame_rate, crf=13) as film:
        for image in sequence.frames:
            film.write(image)
    write_camera(folder / "cameras.json", sequence.camera)
    first, seen = _first_pose(sequence, generator)
    # A keypoint file tells all frames; nothing is known of the later ones.
    later = (len(sequence.frames) - 1, *seen.positions.shape[1:])
    save_arrays(
        folder / "keypoints.npz",
        {
            "keypoints": torch.cat([seen.positions, torch.zeros(later)]),
            "confidence": torch.cat([seen.confidence, torch.zeros(later[:2])]),
            "joint_names": seen.names,
        },
    )
    write_fitted_body(folder / "body.npz", first, sequence.camera)
    save_arrays(
        folder / "reference3d.npz",
        {
            "joints": sequence.joints_world.double().cpu(),
            "joint_names": sequence.body.joint_names,
            "units": "m",
        },
    )
    return first


def _first_pose(
    sequence: SyntheticSequence, generator: torch.Generator
) -> tuple[Initialisation, Keypoints]:
    """The pose that fits noisy 2D joints of the first frame, and these; the base is known."""
    camera, body = sequence.camera, sequence.body
    exact = camera.project(sequence.joints_world[0]).uv.double().cpu()
    noise = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
    places = exact + KEYPOINT_NOISE_PX * noise
    seen = Keypoints(places[None], torch.ones_like(places[None, :, 0]), body.joint_names)
    options = InitialiseOptions(sigma=KEYPOINT_NOISE_PX, dtype=body.dtype, device=body.tie.device)
    return initialise(None, seen.at(0), camera, body, generator=generator, options=options), seen


def _track_clip(
    clip: Path,
    out: Path,
    settings: Settings,
    first: Initialisation | None,
    num_frames: int | None = None,
) -> dict[str, Any]:
    """Track a clip from its first pose; its summary with the errors, which is written again.

    The first pose is that of the clip's `body.npz`, if it is not given.
    """
    init = clip / "body.npz" if first is None else None
    options = TrackOptions(first=first, init=init, layout=OWN_NAMES)
    run = track_video(
        clip / "video.mp4", camera=clip / "cameras.json", keypoints=clip / "keypoints.npz", out=out,
        settings=settings, stop=num_frames, options=options,
    )  # fmt: skip
    summary, truth = dict(run.summary), read_reference(clip / "reference3d.npz")[0]
    track = load_track(out)
    error = mpjpe_mm(track.joints_world, truth[track.frames][:, None])
    error = np.where(np.isfinite(track.log_weight), error, np.inf)
    summary["mpjpe_mm"] = float(error[:, 0].mean())
    summary["mpjpe_best_of_modes_mm"] = float(error.min(axis=1).mean())
    write_summary(out, summary)
    return summary
