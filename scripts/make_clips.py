"""Render clips of captured motions with exact truth: many people, cameras and rooms, to judge by.

    python scripts/make_clips.py --motions DIR --out clips --num 30

DIR holds motions (.bvh) named `SUBJECT_TRIAL`; those of the subjects that `--subjects` names are
filmed, each trial once before one is filmed again. Of every clip the part of the motion, the
person's lengths, clothes, room, light, and the camera's place and focal length are drawn from
`--seed` and the clip's number: the same clip, however many are made. A clip is a folder as
`scripts/make_sequence.py` writes it, whose keypoints err as a detector's do:

* a joint lies off its centre by so much in all of the clip, since annotators mark what they see;
* its error in one frame is nearly that in the frame before;
* what is hidden errs more, and has a low confidence.

`clips.json` lists them with what was drawn.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import start
from jaxtyping import Float
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.errors import ConfigurationError
from torchcss.files import prepare_output_folder, save_arrays
from torchcss.io.motion.positions import read_motion_capture, resample_motion
from torchcss.io.tracks import write_summary
from torchcss.solve.retarget import retarget
from torchcss.studies.random_person import random_lengths
from torchcss.studies.render.motions import Motion
from torchcss.studies.render.scene import lamp
from torchcss.studies.render.sequences import (
    CLUTTER_CLOTHING,
    DARK_CLOTHING,
    STYLES,
    Shot,
    camera_in_front,
    shot_of_motion,
)
from torchcss.studies.sequence_writer import write_sequence
from torchcss.types import frozen

PATTERNS = ("plaid", "stripes", "plain")


@frozen
class Config:
    """Which clips."""

    motions: Path
    """Folder with the motions."""
    out: Path
    """Folder to write; clips that are there already stay."""
    subjects: tuple[str, ...] = ("05", "14")
    """Whose motions are filmed: of these no prior was learnt."""
    num: int = 30
    """Number of clips."""
    first: int = 0
    """Number of the first one."""
    seconds: float = 3.0
    """Length of a clip."""
    rate: float = 30.0
    """Frames per second."""
    seed: int = 0
    """Seed of all that is drawn."""
    dark: float = 0.2
    """Share of clips before a dark wall instead of clutter."""
    focal: tuple[float, float] = (520.0, 1000.0)
    """Range of focal lengths, pixels of pictures of 640 x 480."""
    height: tuple[float, float] = (-0.1, 0.35)
    """Range of the camera's height above the middle of the motion, in distances from it."""
    offset: float = 0.012
    """Deviation of a joint's mark from its centre in all of the clip, in heights of the person."""
    jitter: float = 0.010
    """Deviation of its mark in one frame besides."""
    persistence: float = 0.8
    """Share of that deviation that stays in the next frame."""
    hidden: float = 2.5
    """Factor on both where the joint is hidden."""
    small: bool = False
    """A quarter of the picture's width and height."""


class PlannedClip(NamedTuple):
    """A clip that is to be filmed.

    Attributes:
        name: Name of its folder.
        source: File of the motion.
        begin: Where the part begins, seconds.
        shot: What is rendered.
    """

    name: str
    source: Path
    begin: float
    shot: Shot


def uniform(generator: torch.Generator, low: float, high: float) -> float:
    """A number from a range."""
    return low + (high - low) * float(torch.rand((), generator=generator, dtype=torch.float64))


def find_motions(config: Config) -> list[Path]:
    """The subjects' motions, in an order that the seed draws."""
    files = sorted(
        path for path in config.motions.glob("*.bvh") if path.stem.split("_")[0] in config.subjects
    )
    if not files:
        raise ConfigurationError(
            f"{config.motions}: no motion of subjects {', '.join(config.subjects)} (NAME_TRIAL.bvh)"
        )
    generator = torch.Generator().manual_seed(config.seed)
    return [files[i] for i in torch.randperm(len(files), generator=generator).tolist()]


def make_clips(config: Config) -> Iterator[PlannedClip]:
    """What is filmed, clip by clip."""
    files = find_motions(config)
    for number in range(config.first, config.first + config.num):
        generator = torch.Generator().manual_seed(1000 * config.seed + number)
        source = files[number % len(files)]
        whole = read_motion_capture(source)
        # The first frame of a converted motion is a T-pose, from which splines swing for a moment.
        latest = max(0.5, whole.duration - config.seconds)
        begin = uniform(generator, 0.5, latest) if latest > 0.5 else 0.5
        part = resample_motion(whole, rate=config.rate, start=begin, stop=begin + config.seconds)
        moved = retarget(part, generator=generator)
        lengths = random_lengths(generator=generator)
        body = load_body(moved.body.name, lengths=lengths).with_base(
            moved.body.base_rotation, moved.body.base_translation
        )
        motion = Motion(body, moved.states, config.rate, f"{source.stem} from {begin:.2f} s")
        yield PlannedClip(
            f"clip{number:03d}", source, begin, film(config, motion, number, generator)
        )


def film(config: Config, motion: Motion, number: int, generator: torch.Generator) -> Shot:
    """Room, clothes, light and camera for a motion."""
    dark = uniform(generator, 0, 1) < config.dark
    style = replace(
        STYLES["dark" if dark else "clutter"],
        lamps=tuple(
            lamp((uniform(generator, -2.4, 2.4), uniform(generator, 1.0, 2.2), 2.0), strength=power)
            for power in (1.2, 0.4)
        ),
        pillar=uniform(generator, 0.1, 0.9),
    )
    pattern = PATTERNS[int(torch.randint(len(PATTERNS), (), generator=generator))]
    clothing = replace(
        DARK_CLOTHING if dark else CLUTTER_CLOTHING,
        sleeve=uniform(generator, 0.5, 2.0),
        trouser_leg=uniform(generator, 1.0, 2.1),
        pattern=pattern,
        shirt=drawn_colour(generator),
        trousers=drawn_colour(generator),
    )
    camera = camera_in_front(
        motion.body,
        motion.states,
        focal_px=uniform(generator, *config.focal),
        azimuth=uniform(generator, -math.pi, math.pi),
        height=uniform(generator, *config.height),
    )
    return shot_of_motion(
        motion,
        name=f"clip{number:03d}",
        style=style,
        clothing=clothing,
        camera=camera,
        seed=1000 * config.seed + number,
        small=config.small,
    )


def drawn_colour(generator: torch.Generator) -> tuple[float, float, float]:
    """A colour of cloth, not too bright."""
    r, g, b = (uniform(generator, 0.1, 0.7) for _ in range(3))
    return r, g, b


def detected(config: Config, folder: Path, seed: int) -> None:
    """Replace the keypoints of a clip by what a detector might have found."""
    with np.load(folder / "keypoints2d.npz") as file:
        arrays = dict(file)
    exact = torch.from_numpy(arrays["keypoints_exact"])
    hidden = torch.from_numpy(~arrays["visible"])
    height = float((exact.amax(1) - exact.amin(1)).amax(-1).median())
    generator = torch.Generator().manual_seed(seed)
    noise = detector_noise(config, hidden, generator=generator) * height
    arrays["keypoints"] = (exact + noise).numpy()
    arrays["noise_px"] = np.array(height * math.hypot(config.offset, config.jitter))
    save_arrays(folder / "keypoints2d.npz", arrays)


def detector_noise(
    config: Config, hidden: Tensor, *, generator: torch.Generator
) -> Float[Tensor, "t j 2"]:
    """Errors of the keypoints of all joints in all frames, in heights of the person."""
    num_frames, num_joints = hidden.shape
    offset, first, *later = torch.randn(
        1 + num_frames, num_joints, 2, generator=generator, dtype=torch.float64
    )
    walk = [first]
    fresh = math.sqrt(1 - config.persistence**2)
    for step in later:
        walk.append(config.persistence * walk[-1] + fresh * step)
    factor = torch.where(hidden, config.hidden, 1.0)[..., None]
    return factor * (config.offset * offset + config.jitter * torch.stack(walk))


def main(config: Config) -> list[dict[str, Any]]:
    """Render what is not there yet, and list what is."""
    out, listed = prepare_output_folder(config.out), []
    for clip in make_clips(config):
        folder = out / clip.name
        if not (folder / "done").exists():
            write_sequence(folder, clip.shot, progress=True)
            detected(config, folder, clip.shot.seed + 1)
            (folder / "done").touch()
        listed.append(
            {
                "clip": clip.name,
                "motion": clip.source.name,
                "begin_s": clip.begin,
                "scene": clip.shot.style.scene,
                "focal_px": float(clip.shot.camera.K[0, 0]),
                "lengths": dict(clip.shot.body.lengths),
            }
        )
    write_summary(out / "clips.json", {"clips": listed})
    print(json.dumps({"out": str(out), "clips": len(listed)}))
    return listed


if __name__ == "__main__":
    start(main, Config, __doc__)
