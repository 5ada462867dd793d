"""What every reader of 2D joints returns: all detections of a file; and what all readers need."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from torchcss.errors import KeypointError
from torchcss.files import real_numbers, shortened

FRAME_NAMES = (
    "frame", "frame_number", "frame_index", "frame_id", "frame_no", "frame_num", "image_id",
)  # fmt: skip
"""What files call the number of a frame."""

_MOST_FRAMES = 1_000_000


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


def triples(value: object, where: str) -> Float[np.ndarray, "j 3"]:
    """Return x, y, confidence of every joint from a list of them in a row."""
    numbers = real_numbers(value, where, KeypointError)
    if numbers.ndim != 1 or not numbers.size or numbers.size % 3:
        raise KeypointError(
            f"{where}: expected x, y, confidence for every joint in one list, "
            f"found {numbers.size} numbers"
        )
    return numbers.reshape(-1, 3)


def screened(
    places: Float[np.ndarray, "*b 2"], confidence: Float[np.ndarray, "*b"] | float = 1.0
) -> Float[np.ndarray, "*b 3"]:
    """Places with their confidence, which is 0 where the place is NaN."""
    seen = ~np.isnan(places).any(-1, keepdims=True)
    given = np.broadcast_to(confidence, places.shape[:-1])[..., None]
    return np.where(seen, np.concatenate([places, given], axis=-1), 0.0)


def stack(path: Path, people: list[np.ndarray]) -> Float[np.ndarray, "p j 3"]:
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


def in_order(
    path: Path, found: Mapping[int, np.ndarray], num_frames: int | None
) -> tuple[list[np.ndarray], int]:
    """All frames from people by frame number; those that the file leaves out are empty.

    Some programs count from 1, which shows where the last number is that of all frames.

    Returns:
        The frames, and the number of the first.
    """
    last = max(found, default=-1)
    origin = 1 if found and 0 not in found and last == num_frames else 0
    # Frames at the end in which nobody is seen are often left out.
    total = max(last + 1 - origin, num_frames or 0)
    if total > _MOST_FRAMES:
        raise KeypointError(f"{path}: {last} is not a frame number; number the frames from 0")
    frames = [found.get(index + origin, np.zeros((0, 0, 3))) for index in range(total)]
    check_counts(path, frames)
    return frames, origin


def frame_number(where: object, text: str) -> int:
    """The number of a frame, alone or at the end of a picture's name."""
    match = re.fullmatch(r"(?:.*[^0-9-])?([0-9]{1,7})(?:\.0*|\.[A-Za-z]+)?", text)
    if match is None:
        raise KeypointError(f"{where}: expected a frame number, found {shortened(text)}")
    return int(match[1])
