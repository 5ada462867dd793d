"""How well left and right that change places are put back (`torchcss.io.keypoints.sides`).

    python scripts/evaluate_sides.py --motions DIR --out sides.json

DIR holds captured motions (.bvh). Each is filmed from a random side by a distant camera, with noise
on the joints. Then the legs change places in runs of one to three frames. Frames count in which
the legs stand apart by 0.06 of the person's size (the median of hips, knees and ankles): where they
are in one place it makes no difference which is which.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from common import Table, finish, start

from torchcss import read_motion_capture
from torchcss.errors import ConfigurationError
from torchcss.io.keypoints.one_person import size_of
from torchcss.io.keypoints.sides import with_sides_put_back
from torchcss.io.motion.positions import resample_motion
from torchcss.joint_names import skeleton_joint_names
from torchcss.types import frozen

LEGS = ("hip", "knee", "ankle")
FAR = 0.06
HEADS = ("frames a second", "right frames", "of these exchanged", "exchanged frames", "put back, %")


@frozen
class Config:
    """Which motions, seen how."""

    motions: Path
    """Folder of the motions."""
    out: Path | None = None
    """JSON file to write."""
    rates: tuple[float, ...] = (30.0, 15.0, 10.0, 5.0)
    """Frames per second; motions are interpolated to them."""
    seconds: float = 4.0
    """How much of each motion."""
    pixels: float = 300.0
    """Pixels a metre."""
    noise: float = 2.0
    """Standard deviation of a joint's place, pixels."""
    begins: float = 0.03
    """Probability that a run of exchanged frames begins."""
    seed: int = 0
    """Of views, noise and exchanges."""


def film(path: Path, rate: float, config: Config, draw: np.random.Generator) -> tuple[Any, Any]:
    """A motion's joints in pixels with their confidence `[t j 3]`, and their names."""
    motion = read_motion_capture(path)
    motion = resample_motion(motion, rate=rate, stop=min(config.seconds, motion.duration))
    found = skeleton_joint_names(motion.joint_names)
    columns = [column for column, name in enumerate(found) if name]
    turn, tilt = draw.uniform(0, 2 * math.pi), draw.uniform(-0.2, 0.4)
    x, y, z = np.moveaxis(motion.joints[:, columns], -1, 0)
    across, away = x * math.cos(turn) + z * math.sin(turn), z * math.cos(turn) - x * math.sin(turn)
    places = np.stack([across, -(y * math.cos(tilt) + away * math.sin(tilt))], -1) * config.pixels
    places = places + config.noise * draw.normal(size=places.shape)
    seen = np.ones((*places.shape[:-1], 1))
    return np.concatenate([places, seen], -1), [found[column] for column in columns]


def measure(rate: float, config: Config, files: list[Path]) -> list[float]:
    """A row: the rate, right frames and those exchanged, exchanged ones and the share put back."""
    draw, counts = np.random.default_rng(config.seed), np.zeros(4)
    for path in files:
        truth, names = film(path, rate, config, draw)
        left, right = ([names.index(f"{side}_{place}") for place in LEGS] for side in "lr")
        given, exchanged = truth.copy(), np.zeros(len(truth), dtype=bool)
        for t in range(1, len(truth) - 1):
            if draw.random() < config.begins:
                exchanged[t : t + draw.integers(1, 4)] = True
        rows = np.flatnonzero(exchanged)
        given[np.ix_(rows, left + right)] = truth[np.ix_(rows, right + left)]
        gap = np.linalg.norm(truth[:, left, :2] - truth[:, right, :2], axis=-1)
        apart = np.median(gap, axis=1) > FAR * np.array([size_of(person) for person in truth])
        whole = with_sides_put_back(truth, names, [])
        mended = with_sides_put_back(given, names, [])
        spoilt = (whole != truth).any((1, 2))
        found = (mended[:, left + right] == truth[:, left + right]).all((1, 2))
        counts += [
            len(truth),
            spoilt.sum(),
            (exchanged & apart).sum(),
            (exchanged & apart & found).sum(),
        ]
    frames, spoilt, changed, back = counts.tolist()
    return [rate, frames, spoilt, changed, 100 * back / max(changed, 1)]


def main(config: Config) -> dict[str, Any]:
    """Film, exchange, measure, print, write; return what is written."""
    files = sorted(config.motions.glob("*.bvh"))
    if not files:
        raise ConfigurationError(f"{config.motions}: no motion (.bvh) in it")
    rows = [measure(rate, config, files) for rate in config.rates]
    cells = [[f"{row[0]:g}", *(f"{n:.0f}" for n in row[1:])] for row in rows]
    table = Table("Sides that are put back", HEADS, cells)
    return finish(config.out, {"motions": len(files), "rows": rows}, table)


if __name__ == "__main__":
    start(main, Config, __doc__)
