"""Film the clip that `torchcss demo` tracks: an arm before clutter, with exact truth.

    python scripts/make_demo_clip.py

What is written, by default into the package, is in `torchcss.studies.demo`. The same seed gives the
same clip, up to what the video encoder does.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from common import start

from torchcss.io.fitted_body import write_fitted_body
from torchcss.io.tracks import prepare_output_folder
from torchcss.io.video import VideoWriter
from torchcss.studies.demo import CLIP, first_pose
from torchcss.studies.render.sequences import SyntheticSequence, arm_sequence
from torchcss.studies.sequence_writer import write_arrays, write_camera


@dataclass(frozen=True, kw_only=True)
class Config:
    """What to film."""

    out: Path = CLIP
    """Folder to write."""
    seed: int = 0
    """Seed of scene, textures and noise."""
    frames: int = 50
    """Number of frames, 25 per second."""


def main(config: Config) -> Path:
    """Film, write, and say how large it is."""
    generator = torch.Generator().manual_seed(config.seed)
    sequence = arm_sequence(generator=generator, num_frames=config.frames)
    folder = write_clip(config.out, sequence, generator=generator)
    size = sum(path.stat().st_size for path in folder.iterdir())
    print(f"{folder}: {config.frames} frames, {size / 1e6:.2f} MB")
    return folder


def write_clip(
    folder: Path, sequence: SyntheticSequence, *, generator: torch.Generator, crf: int = 13
) -> Path:
    """Write a sequence as the demo's clip is, with noisy joints of the first frame.

    Args:
        folder: The folder; made if missing.
        sequence: The sequence and its truth.
        generator: Source of the noise, and of the search for the first pose.
        crf: Quality of the film, see `VideoWriter`.

    Returns:
        The folder.
    """
    prepare_output_folder(folder)
    with VideoWriter(folder / "video.mp4", sequence.frame_rate, crf=crf) as film:
        for image in sequence.frames:
            film.write(image)
    write_camera(folder / "cameras.json", sequence.camera)
    first, seen = first_pose(sequence, generator)
    # A keypoint file tells all frames; nothing is known of the later ones.
    later = (len(sequence.frames) - 1, *seen.positions.shape[1:])
    write_arrays(
        folder / "keypoints.npz",
        {
            "keypoints": torch.cat([seen.positions, torch.zeros(later)]).numpy(),
            "confidence": torch.cat([seen.confidence, torch.zeros(later[:2])]).numpy(),
            "joint_names": np.array(seen.names),
        },
    )
    write_fitted_body(folder / "body.npz", first, sequence.camera)
    write_arrays(
        folder / "reference3d.npz",
        {
            "joints": sequence.joints_world.numpy(),
            "joint_names": np.array(sequence.body.joint_names),
            "units": np.array("m"),
        },
    )
    return folder


if __name__ == "__main__":
    start(main, Config, __doc__)
