"""What every reader of 2D joints returns: all detections of a file; and checks that all need."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import real_numbers


class People(NamedTuple):
    """All detections of a file: per frame `[people, joints, 3]` with u, v, confidence."""

    frames: list[np.ndarray]
    names: tuple[str, ...] | None
    """The file's own joint names, or None where it has only an order."""
    report: list[str]
    layout: str | None = None
    """The layout, where the format says it."""
    in_pixels: bool = False
    """The format says what its numbers count, and they are pixels already."""


def triples(value: object, where: str) -> np.ndarray:
    """Return `[joints, 3]` from x, y, confidence in a row."""
    numbers = real_numbers(value, where, KeypointError)
    if numbers.ndim != 1 or not numbers.size or numbers.size % 3:
        raise KeypointError(
            f"{where}: expected x, y, confidence for every joint in one list, "
            f"found {numbers.size} numbers"
        )
    return numbers.reshape(-1, 3)


def stack(path: Path, people: list[np.ndarray]) -> np.ndarray:
    """The people of one frame, all of one layout."""
    if len({person.shape for person in people}) > 1:
        raise KeypointError(
            f"{path}: people with {' and '.join(sorted({str(len(person)) for person in people}))} "
            "joints; expected one layout in the whole file"
        )
    return np.stack(people) if people else np.zeros((0, 0, 3))


def check_counts(path: Path, frames: list[np.ndarray]) -> None:
    """Refuse a change of layout between frames; give empty frames the layout of the others."""
    counts = sorted({frame.shape[1] for frame in frames if len(frame)})
    if len(counts) > 1:
        raise KeypointError(
            f"{path}: people with {' and '.join(map(str, counts))} joints; "
            "expected one layout in the whole file"
        )
    for index, frame in enumerate(frames):
        if not len(frame):
            frames[index] = np.zeros((0, counts[0] if counts else 0, 3))
