"""Render a sequence with exact truth into a folder: those of the papers' section 6, or a motion.

    python scripts/make_sequence.py --sequence arm --out sequences/arm
    python scripts/make_sequence.py --sequence mocap --motion clip.npz --out sequences/mocap-clip

A motion file holds `body` (a name), `state_names [n]`, `states [T n]` and `frame_rate`, and maybe
`base_transform [4 4]`, `lengths` (JSON, metres) and `description`. What is written is in
`torchcss.studies.sequence_writer`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from common import start

from torchcss.errors import ConfigurationError
from torchcss.studies.render.sequences import STYLES, Shot, shot, shot_of_motion
from torchcss.studies.sequence_writer import write_sequence
from torchcss.studies.sequences import read_motion
from torchcss.types import frozen


@frozen
class Config:
    """What to render."""

    sequence: Literal["arm", "body-clutter", "body-dark", "mocap"]
    """One of the papers' three, or a motion of your own (--motion)."""
    out: Path
    """Folder to write."""
    motion: Path | None = None
    """NPZ file with the motion of --sequence mocap."""
    seed: int = 0
    """Seed of the person, the scene and the noise."""
    frames: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Only the first frames."""
    small: bool = False
    """A quarter of the picture's width and height."""
    scene: Annotated[Literal["clutter", "dark"], tyro.conf.arg(aliases=("--room",))] = "clutter"
    """Scene of --sequence mocap."""
    noise_px: float = 2.0
    """Standard deviation of the noise of the 2D joints."""


def make_shot(config: Config) -> Shot:
    """What the options ask for."""
    if config.frames is not None and config.frames < 1:
        raise ConfigurationError(f"--frames {config.frames}: expected at least 1")
    if (config.sequence == "mocap") != (config.motion is not None):
        raise ConfigurationError("--sequence mocap and --motion FILE.npz go together")
    if config.motion is None:
        return shot(config.sequence, seed=config.seed, num_frames=config.frames, small=config.small)
    motion = read_motion(config.motion)
    return shot_of_motion(
        motion,
        name=f"mocap-{config.motion.stem}",
        style=STYLES[config.scene],
        seed=config.seed,
        num_frames=config.frames,
        small=config.small,
    )


def main(config: Config) -> dict[str, Any]:
    """Render, write, and say what was written."""
    chosen = make_shot(config)
    folder = write_sequence(config.out, chosen, noise_px=config.noise_px, progress=True)
    made = {
        "folder": str(folder),
        "name": chosen.name,
        "body": chosen.body.name,
        "frames": len(chosen.states),
        "frame_rate": chosen.frame_rate,
        "image_size_wh": list(chosen.camera.image_size_wh),
    }
    print(json.dumps(made, indent=1))
    return made


if __name__ == "__main__":
    start(main, Config, __doc__)
