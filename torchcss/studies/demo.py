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
from jaxtyping import Float

from torchcss.app.overlay import write_overlays
from torchcss.app.recorder import Recorder
from torchcss.app.track import TrackOptions, track_video
from torchcss.errors import ConfigurationError
from torchcss.initialise.fit import initialise
from torchcss.initialise.options import InitialiseOptions
from torchcss.initialise.result import Initialisation
from torchcss.io.run import Run
from torchcss.io.tracks import load_track, prepare_output_folder, write_summary
from torchcss.io.video import VideoWriter
from torchcss.io.view_files import RecordedCamera, ViewFiles
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.studies.sequences import read_reference
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.tracking.view import CameraView
from torchcss.types import Frame, Keypoints

KEYPOINT_NOISE_PX = 1.5
DEMO_SETTINGS = Settings(body="arm8", keypoints_use="first")


CLIP = Path(__file__).parent / "demo_clip"
"""The folder of the shipped clip."""


def run_demo(
    out: Path, *, settings: Settings | None = None, num_frames: int | None = None
) -> dict[str, Any]:
    """Run the demo.

    Args:
        out: Folder for `track.npz`, `summary.json` and `overlay.mp4`.
        settings: How to track; its body must be "arm8".
        num_frames: Only the first frames.

    Returns:
        The summary, with `mpjpe_mm` (mean over frames and joints, best mode) and
        `mpjpe_best_of_modes_mm`.

    Raises:
        ConfigurationError: If there is to be no frame.
        OutputError: If the folder cannot be written.
    """
    settings = settings or DEMO_SETTINGS
    if num_frames is not None and num_frames < 1:
        raise ConfigurationError(f"num_frames must be at least 1, got {num_frames}")
    run = track_video(
        CLIP / "video.mp4", camera=CLIP / "cameras.json", keypoints=CLIP / "keypoints.npz", out=out,
        settings=settings, stop=num_frames, options=TrackOptions(init=CLIP / "body.npz"),
    )  # fmt: skip
    positions, _ = read_reference(CLIP / "reference3d.npz")
    return _with_errors(out, dict(run.summary), positions)


def first_pose(
    sequence: SyntheticSequence, generator: torch.Generator
) -> tuple[Initialisation, Keypoints]:
    """The pose that fits noisy 2D joints of the first frame, and these; the base is known.

    Args:
        sequence: The sequence and its truth; its body says type and device.
        generator: Source of the noise and of the search.
    """
    camera, body = sequence.camera, sequence.body
    exact = camera.project(sequence.joints_world[0]).uv.double().cpu()
    noise = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
    places = exact + KEYPOINT_NOISE_PX * noise
    seen = Keypoints(places[None], torch.ones_like(places[None, :, 0]), body.joint_names)
    options = InitialiseOptions(sigma=KEYPOINT_NOISE_PX, dtype=body.dtype, device=body.tie.device)
    return initialise(None, seen.at(0), camera, body, generator=generator, options=options), seen


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
    body = sequence.body.to(dtype=dtype, device=device)
    camera_there = sequence.camera.to(dtype=dtype, device=device)
    there = replace(sequence, body=body, camera=camera_there, states=sequence.states.to(body.tie))
    first, seen = first_pose(there, generator)
    interval = 1 / sequence.frame_rate
    session = TrackingSession(
        replace(settings, keypoints_use="first"),
        first,
        [CameraView(camera_there, seen, KEYPOINT_NOISE_PX)],
        frame_interval=interval,
        generator=generator,
    )
    frames = (Frame(i, i * interval, image) for i, image in enumerate(sequence.frames))
    film = ViewFiles(video=out / "video.mp4", keypoints=None)
    recorder = Recorder(
        folder=out,
        session=session,
        recorded=[RecordedCamera(sequence.camera, film)],
        frame_interval=interval,
        notes=first.report,
    )
    summary = recorder.run(session.track(frames), len(sequence.frames))
    if settings.overlay:
        write_overlays(Run.open(out), sequence.frame_rate)
    return _with_errors(out, summary, sequence.joints_world.cpu().numpy())


def _with_errors(
    out: Path, summary: dict[str, Any], truth: Float[np.ndarray, "t j 3"]
) -> dict[str, Any]:
    """A track's summary with its errors, which is written again."""
    track = load_track(out)
    error = np.linalg.norm(track.joints_world - truth[track.frames][:, None], axis=-1).mean(-1)
    error = np.where(np.isfinite(track.log_weight), error, np.inf)
    summary["mpjpe_mm"] = 1000 * float(error[:, 0].mean())
    summary["mpjpe_best_of_modes_mm"] = 1000 * float(error.min(axis=1).mean())
    write_summary(out, summary)
    return summary
