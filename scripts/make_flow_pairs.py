"""Pairs of pictures with known flow, for `scripts/evaluate_flow.py`.

    python scripts/make_flow_pairs.py --out pairs
    python scripts/evaluate_flow.py --data pairs --out flow.json

A picture is a sum of plane waves, known between the pixels too: nothing is resampled. Of each of
three textures (`fine`, short waves with some longer ones; `natural`, whose amplitudes fall with
frequency, with edges; `smooth`, long waves; the last two with a little of the fine) there is a pair
for each motion:

| motion | what moves |
|---|---|
| shift | all, by (0.3, -0.7) pixels |
| leap | all, by (6.4, -3.7) pixels |
| turn | all, by two degrees about the centre |
| spin | all, by six degrees |
| nearer | all grows by three per cent |
| further | all shrinks by six per cent |
| bend | waves of three pixels' amplitude, 150 pixels long |
| two | a disc moves to the right, what is behind it to the left |
| noise | as `bend`, with noise of three grey values in each picture |
| light | as `bend`, and the second picture is brighter, more so on one side |
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from common import start
from common.flow_files import write_flow
from jaxtyping import Bool, Float
from PIL import Image

from torchcss.files import prepare_output_folder
from torchcss.types import frozen

Places = Float[np.ndarray, "h w 2"]

TEXTURES = {"fine": (4.0, 60.0, 0.5), "natural": (4.0, 200.0, 1.0), "smooth": (30.0, 200.0, 0.5)}
"""Shortest and longest waves, pixels, and the power of their length in their amplitudes."""

WAVES, CONTRAST, LITTLE, NOISE, BRIGHTER = 150, 45.0, 0.15, 3.0, (1.08, 12.0)


@frozen
class Config:
    """What to make."""

    out: Path
    """Folder for the pairs, each in one of its own."""
    width: int = 320
    """Pixels."""
    height: int = 240
    """Pixels."""
    seed: int = 0
    """Seed of waves and noise."""
    small: bool = False
    """Two motions of one texture: for tests."""


def texture(kind: str, random: np.random.Generator) -> Callable[[Places], np.ndarray]:
    """Grey levels of 0..255, not rounded, at any places."""

    def waves(shortest: float, longest: float, power: float) -> tuple[np.ndarray, ...]:
        length = np.exp(random.uniform(math.log(shortest), math.log(longest), WAVES))
        angle, phase = random.uniform(0, 2 * math.pi, (2, WAVES))
        way = 2 * math.pi / length * np.stack([np.cos(angle), np.sin(angle)])
        amplitude = length**power
        return way, phase, amplitude / math.sqrt(0.5 * np.square(amplitude).sum())

    large, little = waves(*TEXTURES[kind]), waves(*TEXTURES["fine"])

    def look(places: Places) -> np.ndarray:
        total, more = (
            np.einsum("...w,w->...", np.cos(places @ way + phase), amplitude)
            for way, phase, amplitude in (large, little)
        )
        # Edges: what is far from the mean is cut off.
        total = np.tanh(2 * total) if kind == "natural" else total
        total = total if kind == "fine" else total + LITTLE * more
        return np.clip(128 + CONTRAST * total, 0, 255)

    return look


def linear(factor: float, degrees: float, centre: np.ndarray) -> Callable[[Places], Places]:
    """Where places go when all grows and turns about a centre."""
    c, s = factor * math.cos(math.radians(degrees)), factor * math.sin(math.radians(degrees))
    matrix = np.array([[c, -s], [s, c]])
    return lambda places: (places - centre) @ matrix.T + centre


def bend(places: Places) -> Places:
    """Where places go in waves."""
    u, v = np.moveaxis(places, -1, 0) * (2 * math.pi / 150)
    return places + 3 * np.stack([np.sin(u + 0.7 * v), np.cos(v - 0.4 * u)], axis=-1)


def came_from(motion: Callable[[Places], Places], places: Places) -> Places:
    """Which places a motion takes to some, by fixed-point steps."""
    found = places.copy()
    for _ in range(60):
        found = found + (places - motion(found))
    return found


def motions(centre: np.ndarray) -> dict[str, Callable[[Places], Places]]:
    """The motions of one surface, by name."""
    return {
        "shift": lambda places: places + np.array([0.3, -0.7]),
        "leap": lambda places: places + np.array([6.4, -3.7]),
        "turn": linear(1.0, 2.0, centre),
        "spin": linear(1.0, 6.0, centre),
        "nearer": linear(1.03, 0.0, centre),
        "further": linear(0.94, 0.0, centre),
        "bend": bend,
        "noise": bend,
        "light": bend,
    }


def two_surfaces(
    looks: tuple[Callable[[Places], np.ndarray], ...], places: Places, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Places, Bool[np.ndarray, "h w"]]:
    """A disc before a ground: both pictures, the flow, and where it is known."""
    disc, ground = np.array([3.3, 1.2]), np.array([-2.1, 0.4])

    def inside(where: Places) -> np.ndarray:
        return np.square(where - centre).sum(-1) < (0.3 * 2 * centre.min()) ** 2

    first = np.where(inside(places), looks[0](places), looks[1](places))
    second = np.where(inside(places - disc), looks[0](places - disc), looks[1](places - ground))
    known = inside(places) | ~inside(places + ground - disc)
    return first, second, np.where(inside(places)[..., None], disc, ground), known


def main(config: Config) -> None:
    """Make the pairs."""
    prepare_output_folder(config.out)
    size = np.array([config.width, config.height])
    rows, columns = np.mgrid[: config.height, : config.width]
    places, centre = np.stack([columns, rows], axis=-1).astype(float), (size - 1) / 2
    moved = motions(centre)
    names = ("shift", "two") if config.small else (*moved, "two")
    for kind in ("natural",) if config.small else TEXTURES:
        random = np.random.default_rng(config.seed)
        looks = texture(kind, random), texture(kind, random)
        for name in names:
            if name == "two":
                first, second, flow, known = two_surfaces(looks, places, centre)
            else:
                first, second = looks[0](places), looks[0](came_from(moved[name], places))
                flow = moved[name](places) - places
                known = ((places + flow >= 0) & (places + flow <= size - 1)).all(-1)
            if name == "light":
                gain, slope = BRIGHTER
                second = gain * (second - 128) + 128 + slope * columns / config.width
            noise = NOISE if name == "noise" else 0.0
            folder = config.out / f"{kind}-{name}"
            folder.mkdir(exist_ok=True)
            for number, picture in ((10, first), (11, second)):
                picture = picture + noise * random.standard_normal(picture.shape)
                levels = np.clip(picture.round(), 0, 255).astype(np.uint8)
                Image.fromarray(levels).save(folder / f"frame{number}.png")
            write_flow(
                folder / "flow10.flo",
                torch.from_numpy(flow).movedim(-1, 0),
                torch.from_numpy(known),
            )


if __name__ == "__main__":
    start(main, Config, __doc__)
