"""What every reader of 2D joints returns, all detections of a file; and what all readers need."""

from __future__ import annotations

import re
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

Person = Float[np.ndarray, "j 3"]
"""u, v and confidence of every joint."""


class People(NamedTuple):
    """All detections of a file.

    Attributes:
        frames: The people of every frame in order; or by number, where the file may leave out
            frames in which nobody is seen.
        names: The file's own joint names, or None where it has only an order.
        report: Lines for the user.
        layout: The layout, where the format says it.
        corner_fractions: Coordinates are pixels, or fractions of the image from its corner.
        from_zero: Frames that have numbers are known to be counted from 0.
    """

    frames: list[list[Person]] | dict[int, list[Person]]
    names: tuple[str, ...] | None
    report: list[str]
    layout: str | None = None
    corner_fractions: bool = False
    from_zero: bool = False


def triples(value: object, where: str) -> Person:
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


def in_order(
    path: Path, people: People, num_frames: int | None, report: list[str]
) -> list[Float[np.ndarray, "p j 3"]]:
    """All people of every frame; frames that the file leaves out are empty.

    Some programs count from 1, which shows where the last number is that of all frames.

    Args:
        path: The file.
        people: What was found in it.
        num_frames: Number of frames of the video; None: as many as the file has.
        report: Gets a line that says from where frames are counted.

    Raises:
        KeypointError: If a number is none of a frame, or the layout changes.
    """
    frames = people.frames
    if isinstance(frames, dict):
        last = max(frames, default=-1)
        from_one = not people.from_zero and 0 not in frames and last == num_frames
        origin = int(bool(frames) and from_one)
        # Frames at the end in which nobody is seen are often left out.
        total = max(last + 1 - origin, num_frames or 0)
        if total > _MOST_FRAMES:
            raise KeypointError(f"{path}: {last} is not a frame number; number the frames from 0")
        report.append(f"frame {origin} is the first frame")
        frames = [frames.get(index + origin, []) for index in range(total)]
    counts = sorted({len(person) for frame in frames for person in frame})
    if len(counts) > 1:
        raise KeypointError(
            f"{path}: people with {' and '.join(map(str, counts))} joints; "
            "expected one layout in the whole file"
        )
    nobody = np.zeros((0, *counts, 3) if counts else (0, 0, 3))
    return [np.stack(frame) if len(frame) else nobody for frame in frames]


def frame_number(where: object, text: str) -> int:
    """The number of a frame, alone or at the end of a picture's name."""
    match = re.fullmatch(r"(?:.*[^0-9-])?([0-9]{1,7})(?:\.0*|\.[A-Za-z]+)?", text)
    if match is None:
        raise KeypointError(f"{where}: expected a frame number, found {shortened(text)}")
    return int(match[1])
