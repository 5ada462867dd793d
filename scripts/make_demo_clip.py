"""Film the clip that `torchcss demo` tracks: an arm before clutter, with exact truth.

    python scripts/make_demo_clip.py

What is written, by default into the package, is in `torchcss.studies.demo`. The same seed gives the
same clip, up to what the video encoder does.
"""

from __future__ import annotations

from pathlib import Path

import torch
from common import start

from torchcss.studies.demo import CLIP, write_clip
from torchcss.studies.render.sequences import arm_sequence
from torchcss.types import frozen


@frozen
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
    write_clip(config.out, sequence, generator=generator)
    size = sum(path.stat().st_size for path in config.out.iterdir())
    print(f"{config.out}: {config.frames} frames, {size / 1e6:.2f} MB")
    return config.out


if __name__ == "__main__":
    start(main, Config, __doc__)
