"""The text of a BVH file: the segments of its skeleton, and the numbers that move them.

What is not as it should be ends in a `MotionCaptureError` that names the line, before which callers
put the file: a damaged file never yields a motion. `torchcss.body.files.bvh` makes a body of what
is parsed here, and `torchcss.io.motion.positions` positions.

Call `parse_bvh`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from torchcss.errors import MotionCaptureError
from torchcss.files import Line, read_lines, shortened


class Channel(NamedTuple):
    """One number per frame that moves a segment: which column, and what it does."""

    column: int
    axis: int
    is_rotation: bool


class Segment(NamedTuple):
    """A joint of the tree as both formats see it.

    Attributes:
        name: Its name.
        parent: Position of its parent; -1 for the root.
        offset: From its parent in the zero pose, in the file's unit.
        axes: Its own axes in the zero pose.
        turns: What moves it, leftmost factor first.
        turns_itself: Its rotation turns `offset` too (Acclaim), or only what hangs on it (BVH).
    """

    name: str
    parent: int
    offset: tuple[float, float, float]
    axes: Float[np.ndarray, "3 3"]
    turns: tuple[Channel, ...]
    turns_itself: bool


# Numbers and places.


_DEFAULT_RATE = 30.0
"""Frames per second of a motion that has none, or one without a time."""

MOST_LINKS = 2000
"""Links of a body: time and memory grow with their square."""

_HUGE = 1e12
"""No length or angle of a body is so large, in any unit."""


def bad(line: int, expected: str, found: object) -> MotionCaptureError:
    """The error for a line that is not as it should be."""
    return MotionCaptureError(
        f"line {line}: expected {expected}, found {shortened(found)}; get a complete copy"
    )


def finite_numbers(line: int, words: Sequence[str], expected: str) -> list[float]:
    """Finite numbers, as any program writes them: with a decimal comma, but not as 1_000."""
    try:
        values = [math.nan if "_" in word else float(word.replace(",", ".")) for word in words]
    except ValueError:
        values = [math.nan]
    if not all(abs(value) < _HUGE for value in values):
        raise bad(line, expected, " ".join(words))
    return values


def whole_number(line: int, word: str, expected: str) -> int:
    """A whole number of few digits: the interpreter refuses thousands of them in its own way."""
    if not re.fullmatch(r"[0-9]{1,9}", word):
        raise bad(line, expected, word)
    return int(word)


def axis_of(letter: str) -> int:
    """Which axis a letter names; -1: none."""
    return "xyz".find(letter.lower())


# BVH.


class _Words:
    """The words of a hierarchy, one after the other."""

    def __init__(self, lines: Sequence[Line]) -> None:
        self.words = [(line.number, word) for line in lines for word in line.words]
        self.next = 0

    @property
    def line(self) -> int:
        """Line of the next word, or of the last one."""
        return self.words[min(self.next, len(self.words) - 1)][0]

    def take(self, expected: str) -> str:
        if self.next >= len(self.words):
            raise bad(self.line, expected, "the end of the file")
        self.next += 1
        return self.words[self.next - 1][1]

    def keyword(self, *wanted: str) -> str:
        line = self.line
        word = self.take(" or ".join(wanted))
        if word.upper() not in wanted:
            raise bad(line, " or ".join(wanted), word)
        return word.upper()

    def name(self) -> str:
        """All words up to the brace: some programs write names with spaces."""
        line, words = self.line, []
        while (word := self.take("a name and {")) != "{":
            words.append(word)
        if not words:
            raise bad(line, "a name", "{")
        return " ".join(words)

    def offset(self) -> tuple[float, float, float]:
        self.keyword("OFFSET")
        line = self.line
        words = [self.take("three numbers") for _ in range(3)]
        x, y, z = finite_numbers(line, words, "three numbers")
        return x, y, z


_CHANNEL = re.compile(r"([XYZ])(POSITION|ROTATION)", re.IGNORECASE)


def parse_bvh(path: Path) -> tuple[list[Segment], Float[np.ndarray, "t c"], float]:
    """Segments, their numbers frame by frame (angles in radians), and frames per second.

    A file that holds a skeleton alone has no frames.

    Raises:
        MotionCaptureError: For any bad file.
    """
    lines = read_lines(path, MotionCaptureError)
    if lines[0].words[0].upper() != "HIERARCHY":
        raise bad(lines[0].number, "HIERARCHY, as every BVH begins", lines[0].words[0])
    firsts = [line.words[0].upper() for line in lines]
    motion = firsts.index("MOTION") if "MOTION" in firsts else len(lines) - 1
    words = _Words(lines[: motion + 1])
    words.keyword("HIERARCHY")
    segments: list[Segment] = []
    names: set[str] = set()
    stack: list[int] = []
    columns: list[bool] = []  # whether it is an angle
    allowed: tuple[str, ...] = ("ROOT",)
    while True:
        line = words.line
        if allowed == ("MOTION",) and words.next == len(words.words):
            return segments, np.zeros((0, len(columns))), _DEFAULT_RATE
        kind = words.keyword(*allowed, *(("ROOT",) if segments else ()))
        if kind == "ROOT" and segments:
            raise MotionCaptureError(
                f"line {line}: a second ROOT; save every skeleton in a file of its own"
            )
        if kind == "MOTION":
            break
        if kind == "}":
            stack.pop()
            allowed = ("JOINT", "END", "}") if stack else ("MOTION",)
            continue
        parent = stack[-1] if stack else -1
        if kind == "END":
            words.name()  # Site, and what some programs call it
            name = f"{segments[parent].name}_end"
            name = f"{name}{len(segments)}" if name in names else name
            names.add(name)
            segments.append(Segment(name, parent, words.offset(), np.eye(3), (), False))
            words.keyword("}")
            continue
        name = words.name()
        if name in names:
            raise bad(line, "a name of its own for every joint", name)
        names.add(name)
        offset = words.offset()
        turns = _channels(words, len(columns))
        columns += [turn.is_rotation for turn in turns]
        segments.append(Segment(name, parent, offset, np.eye(3), turns, False))
        stack.append(len(segments) - 1)
        allowed = ("JOINT", "END", "}")
    if (number := len(segments)) > MOST_LINKS:
        raise MotionCaptureError(f"{number:,} links; expected {MOST_LINKS:,} at most")
    return segments, *_bvh_frames(lines[motion:], np.array(columns, dtype=bool))


def without_empty_positions(
    segments: Sequence[Segment], values: Float[np.ndarray, "t c"]
) -> tuple[list[Segment], list[str]]:
    """The same without position channels that hold nothing, and a line that says so.

    Some programs write six channels for every joint, and zeros for the positions of all but the
    root: then the offsets hold, which positions would take the place of.
    """
    columns = {
        index: [turn.column for turn in segment.turns if not turn.is_rotation]
        for index, segment in enumerate(segments)
        if index and any(segment.offset)
    }
    used = [column for own in columns.values() for column in own]
    if not used or values[:, used].any():
        return list(segments), []
    kept = [
        segment._replace(turns=tuple(turn for turn in segment.turns if turn.is_rotation))
        if columns.get(index)
        else segment
        for index, segment in enumerate(segments)
    ]
    return kept, ["positions of joints are all zero in the file: their offsets are used"]


def _channels(words: _Words, first_column: int) -> tuple[Channel, ...]:
    words.keyword("CHANNELS")
    line = words.line
    expected = "a number of channels"
    number = whole_number(line, words.take(expected), expected)
    turns: list[Channel] = []
    for column in range(first_column, first_column + min(number, 7)):
        word = words.take("a channel")
        match = _CHANNEL.fullmatch(word)
        if match is None:
            raise bad(line, "Xposition, ..., Zrotation", word)
        turn = Channel(column, axis_of(match[1]), match[2].lower() == "rotation")
        if any(turn[1:] == other[1:] for other in turns):
            raise bad(line, "every channel once", word)
        turns.append(turn)
    return tuple(turns)


def _bvh_frames(lines: list[Line], is_angle: np.ndarray) -> tuple[Float[np.ndarray, "t c"], float]:
    """From MOTION on: the rows of numbers, angles in radians, and the frame rate."""
    if len(lines) < 2:
        raise bad(lines[0].number, "Frames: and Frame Time: after it", "the end of the file")
    number = whole_number(lines[1].number, _said(lines[1], "Frames"), "a number of frames")
    if number == 0 and len(lines) == 2:
        return _table([], is_angle), _DEFAULT_RATE
    if len(lines) < 3:
        raise bad(lines[1].number, "Frame Time: after it", "the end of the file")
    second, rows = lines[2], lines[3:]
    digits = _said(second, "Frame Time").replace(",", ".")
    (interval,) = finite_numbers(second.number, [digits], "the seconds of a frame")
    if interval == 0 and number < 2:
        interval = 1 / _DEFAULT_RATE
    if not 1e-6 < interval < 1e3:
        raise bad(second.number, "the seconds of a frame", digits)
    if number != len(rows):
        found = f"{len(rows)} lines of numbers"
        raise bad(lines[-1].number, f"{number} frames, as Frames: says", found)
    return _table(rows, is_angle), _rate(interval, digits)


def _said(line: Line, title: str) -> str:
    """What stands after a title and a colon."""
    text = " ".join(line.words)
    found, colon, value = text.partition(":")
    if not colon or found.strip().lower() != title.lower():
        raise bad(line.number, f"{title}: and a number", text)
    return value.strip()


def _rate(interval: float, digits: str) -> float:
    """Frames per second; a whole number where the digits written cannot tell it from one."""
    _, _, decimals = digits.partition(".")
    known_to = 0.5 * 10.0 ** -len(decimals) if decimals.isdigit() else 0.0
    whole = round(1 / interval)
    if whole and abs(1 / whole - interval) <= known_to * (1 + 1e-9):
        return float(whole)
    return 1 / interval


def _table(rows: Sequence[Line], is_angle: np.ndarray) -> np.ndarray:
    """Rows of numbers, angles from degrees to radians."""
    values = np.empty((len(rows), len(is_angle)))
    for out, (line, words) in zip(values, rows, strict=True):
        if len(words) != len(is_angle):
            raise bad(line, f"{len(is_angle)} numbers, one for every channel", len(words))
        out[:] = finite_numbers(line, words, "numbers")
    return np.where(is_angle, np.radians(values), values)
