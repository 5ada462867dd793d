"""The text of motion capture files: segments, and the numbers that move them.

What is not as it should be ends in a `MotionCaptureError` that names file and line: a damaged file
never yields a motion. `torchcss.io.motion_capture` makes positions of what is parsed here.

Call `parse_bvh` or `parse_acclaim`.
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
from torchcss.io.export.rotations import about
from torchcss.io.safe_load import one_line, shortened


class Turn(NamedTuple):
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
    turns: tuple[Turn, ...]
    turns_itself: bool


# Text, numbers and places.


class _Line(NamedTuple):
    """A line that is not empty, and where it stands."""

    number: int
    words: list[str]


def _read_lines(path: Path) -> list[_Line]:
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise MotionCaptureError(f"{path}: there is no such file; check the path") from error
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        raise MotionCaptureError(f"{str(path)!r}: cannot be read: {one_line(error)}") from error
    bad = data.find(b"\0")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        bad, text = error.start, ""
    if bad >= 0:
        line = data.count(b"\n", 0, bad) + 1
        raise MotionCaptureError(
            f"{path}: line {line}: not text in UTF-8; save the file in that encoding"
        )
    # Not splitlines: it breaks at signs that editors do not count as lines.
    rows = enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), start=1)
    lines = [_Line(number, words) for number, row in rows if (words := row.split())]
    if not lines:
        raise MotionCaptureError(f"{path}: the file is empty")
    return lines


def _bad(path: Path, line: int, expected: str, found: object) -> MotionCaptureError:
    return MotionCaptureError(
        f"{path}: line {line}: expected {expected}, found {shortened(found)}; get a complete copy"
    )


def _numbers(path: Path, line: int, words: Sequence[str], expected: str) -> list[float]:
    """Finite numbers, as any program writes them (float() takes 1_000, too)."""
    try:
        values = [math.nan if "_" in word else float(word) for word in words]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values):
        raise _bad(path, line, expected, " ".join(words))
    return values


def _count(path: Path, line: int, word: str, expected: str) -> int:
    # Few digits, because the interpreter refuses thousands of them in its own way.
    if not re.fullmatch(r"[0-9]{1,9}", word):
        raise _bad(path, line, expected, word)
    return int(word)


def _axis(letter: str) -> int:
    return "xyz".find(letter.lower())


# BVH.


class _Words:
    """The words of a hierarchy, one after the other."""

    def __init__(self, path: Path, lines: Sequence[_Line]) -> None:
        self.path = path
        self.words = [(line.number, word) for line in lines for word in line.words]
        self.next = 0

    @property
    def line(self) -> int:
        """Line of the next word, or of the last one."""
        return self.words[min(self.next, len(self.words) - 1)][0]

    def take(self, expected: str) -> str:
        if self.next >= len(self.words):
            raise _bad(self.path, self.line, expected, "the end of the file")
        self.next += 1
        return self.words[self.next - 1][1]

    def keyword(self, *wanted: str) -> str:
        line = self.line
        word = self.take(" or ".join(wanted))
        if word.upper() not in wanted:
            raise _bad(self.path, line, " or ".join(wanted), word)
        return word.upper()

    def name(self) -> str:
        """All words up to the brace: some programs write names with spaces."""
        line, words = self.line, []
        while (word := self.take("a name and {")) != "{":
            words.append(word)
        if not words:
            raise _bad(self.path, line, "a name", "{")
        return " ".join(words)

    def offset(self) -> tuple[float, float, float]:
        self.keyword("OFFSET")
        line = self.line
        words = [self.take("three numbers") for _ in range(3)]
        x, y, z = _numbers(self.path, line, words, "three numbers")
        return x, y, z


_CHANNEL = re.compile(r"([XYZ])(POSITION|ROTATION)", re.IGNORECASE)


def parse_bvh(path: Path) -> tuple[list[Segment], Float[np.ndarray, "t c"], float]:
    """Segments, their numbers frame by frame (angles in radians), and frames per second.

    Raises:
        MotionCaptureError: For any bad file.
    """
    lines = _read_lines(path)
    if lines[0].words[0].upper() != "HIERARCHY":
        raise _bad(path, lines[0].number, "HIERARCHY, as every BVH begins", lines[0].words[0])
    firsts = [line.words[0].upper() for line in lines]
    motion = firsts.index("MOTION") if "MOTION" in firsts else len(lines) - 1
    words = _Words(path, lines[: motion + 1])
    words.keyword("HIERARCHY")
    segments: list[Segment] = []
    names: set[str] = set()
    stack: list[int] = []
    columns: list[bool] = []  # whether it is an angle
    allowed: tuple[str, ...] = ("ROOT",)
    while True:
        line = words.line
        kind = words.keyword(*allowed)
        if kind == "MOTION":
            break
        if kind == "}":
            stack.pop()
            allowed = ("JOINT", "END", "}") if stack else ("MOTION",)
            continue
        parent = stack[-1] if stack else -1
        if kind == "END":
            words.keyword("SITE")
            words.keyword("{")
            name = f"{segments[parent].name}_end"
            name = f"{name}{len(segments)}" if name in names else name
            names.add(name)
            segments.append(Segment(name, parent, words.offset(), np.eye(3), (), False))
            words.keyword("}")
            continue
        name = words.name()
        if name in names:
            raise _bad(path, line, "a name of its own for every joint", name)
        names.add(name)
        offset = words.offset()
        turns = _channels(words, len(columns))
        columns += [turn.is_rotation for turn in turns]
        segments.append(Segment(name, parent, offset, np.eye(3), turns, False))
        stack.append(len(segments) - 1)
        allowed = ("JOINT", "END", "}")
    values, rate = _bvh_frames(path, lines[motion:], np.array(columns, dtype=bool))
    return segments, values, rate


def _channels(words: _Words, first_column: int) -> tuple[Turn, ...]:
    words.keyword("CHANNELS")
    line = words.line
    number = _count(words.path, line, words.take("a number of channels"), "a number of channels")
    turns: list[Turn] = []
    for column in range(first_column, first_column + min(number, 7)):
        word = words.take("a channel")
        match = _CHANNEL.fullmatch(word)
        if match is None:
            raise _bad(words.path, line, "Xposition, ..., Zrotation", word)
        turn = Turn(column, _axis(match[1]), match[2].lower() == "rotation")
        if any(turn[1:] == other[1:] for other in turns):
            raise _bad(words.path, line, "every channel once", word)
        turns.append(turn)
    return tuple(turns)


def _bvh_frames(
    path: Path, lines: list[_Line], is_angle: np.ndarray
) -> tuple[Float[np.ndarray, "t c"], float]:
    """From MOTION on: the rows of numbers, angles in radians, and the frame rate."""
    if len(lines) < 3:
        raise _bad(path, lines[0].number, "Frames: and Frame Time: after it", "the end of the file")
    (first, head), (second, time), rows = lines[1], lines[2], lines[3:]
    title = " ".join(head).split(":")
    if len(title) != 2 or title[0].strip().lower() != "frames":
        raise _bad(path, first, "Frames: and a number", " ".join(head))
    number = _count(path, first, title[1].strip(), "a number of frames")
    title = " ".join(time).split(":")
    if len(title) != 2 or title[0].strip().lower() != "frame time":
        raise _bad(path, second, "Frame Time: and seconds", " ".join(time))
    digits = title[1].strip()
    (interval,) = _numbers(path, second, [digits], "the seconds of a frame")
    if not 1e-6 < interval < 1e3:
        raise _bad(path, second, "the seconds of a frame", digits)
    if number != len(rows):
        last = rows[-1].number if rows else second
        raise _bad(path, last, f"{number} frames, as Frames: says", f"{len(rows)} lines of numbers")
    if not number:
        raise _bad(path, first, "at least one frame", "none")
    return _table(path, rows, is_angle), _rate(interval, digits)


def _rate(interval: float, digits: str) -> float:
    """Frames per second; a whole number where the digits written cannot tell it from one."""
    _, _, decimals = digits.partition(".")
    known_to = 0.5 * 10.0 ** -len(decimals) if decimals.isdigit() else 0.0
    whole = round(1 / interval)
    if whole and abs(1 / whole - interval) <= known_to * (1 + 1e-9):
        return float(whole)
    return 1 / interval


def _table(path: Path, rows: Sequence[_Line], is_angle: np.ndarray) -> np.ndarray:
    """Rows of numbers, angles from degrees to radians."""
    values = np.empty((len(rows), len(is_angle)))
    for out, (line, row) in zip(values, rows, strict=True):
        if len(row) != len(is_angle):
            raise _bad(path, line, f"{len(is_angle)} numbers, one for every channel", len(row))
        out[:] = _numbers(path, line, row, "numbers")
    return np.where(is_angle, np.radians(values), values)


# Acclaim.


class _Acclaim(NamedTuple):
    """An ASF file: the tree, the columns of every bone with freedom, and what it says of units."""

    segments: list[Segment]
    columns: dict[str, list[int]]
    is_angle: list[bool]
    radians: bool
    metres_per_unit: float | None


def _sections(lines: Sequence[_Line]) -> list[tuple[_Line, list[_Line]]]:
    """The parts of a file that start with `:keyword`, without comments."""
    found: list[tuple[_Line, list[_Line]]] = []
    for line in lines:
        if line.words[0].startswith("#"):
            continue
        if line.words[0].startswith(":"):
            found.append((line, []))
        elif found:
            found[-1][1].append(line)
    return found


def parse_acclaim(
    skeleton: Path, motion: Path
) -> tuple[list[Segment], Float[np.ndarray, "t c"], float | None]:
    """Segments, their numbers frame by frame (angles in radians), and the metres per unit stated.

    Args:
        skeleton: The ASF file.
        motion: The AMC file.

    Raises:
        MotionCaptureError: For any bad file.
    """
    found = _parse_asf(skeleton, _read_lines(skeleton))
    values = _parse_amc(motion, _read_lines(motion), found)
    return found.segments, values, found.metres_per_unit


def _parse_asf(path: Path, lines: list[_Line]) -> _Acclaim:
    sections = {head.words[0].lower(): (head, body) for head, body in _sections(lines)}
    for name in (":root", ":bonedata", ":hierarchy"):
        if name not in sections:
            raise _bad(path, lines[-1].number, f"a section {name}", ", ".join(sections) or "none")
    radians, metres = _units(path, sections[":units"][1] if ":units" in sections else [])
    bones = _bones(path, sections[":bonedata"][1], radians)
    root = _entries(sections[":root"][1])
    parents = _hierarchy(path, sections[":hierarchy"], set(bones))

    is_angle: list[bool] = []
    columns: dict[str, list[int]] = {}

    def turns_of(name: str, line: int, freedom: Sequence[str]) -> tuple[Turn, ...]:
        first = len(is_angle)
        turns = []
        for word in freedom:
            kind, axis = word[:1].lower(), _axis(word[1:] or "?")
            if len(word) != 2 or kind not in "rt" or axis < 0 or (kind == "t" and name != "root"):
                raise _bad(path, line, "degrees of freedom rx, ry, rz", word)
            turns.append(Turn(first + len(turns), axis, kind == "r"))
        if len({turn[1:] for turn in turns}) < len(turns):
            raise _bad(path, line, "every degree of freedom once", " ".join(freedom))
        is_angle.extend(turn.is_rotation for turn in turns)
        if turns:
            columns[name] = [turn.column for turn in turns]
        return tuple(reversed(turns))  # about fixed axes, the last factor acts first

    if "order" not in root:
        raise _bad(path, sections[":root"][0].number, "an order in :root", "none")

    def vector(key: str) -> tuple[float, float, float]:
        if key not in root:
            return 0.0, 0.0, 0.0
        words = root[key].words[1:4]
        values = _numbers(path, root[key].number, words, "three numbers")
        if len(values) != 3:
            raise _bad(path, root[key].number, "three numbers", " ".join(words))
        return values[0], values[1], values[2]

    order, axes = root["order"], _euler(vector("orientation"), "XYZ", radians)
    turns = turns_of("root", order.number, order.words[1:])
    segments = [Segment("root", -1, vector("position"), axes, turns, False)]
    index = {"root": 0}
    for name, parent in parents.items():
        bone = bones[name]
        turns = turns_of(name, bone.line, bone.freedom)
        segments.append(Segment(name, index[parent], bone.offset, bone.axes, turns, True))
        index[name] = len(segments) - 1
    return _Acclaim(segments, columns, is_angle, radians, metres)


def _units(path: Path, lines: Sequence[_Line]) -> tuple[bool, float | None]:
    """Whether angles are in radians, and the metres per unit of length, where stated."""
    units = _entries(lines)
    radians = "angle" in units and units["angle"].words[-1].lower().startswith("rad")
    if "length" not in units:
        return radians, None
    line = units["length"]
    fraction, *_ = _numbers(path, line.number, line.words[1:2] or ["nothing"], "a length")
    return radians, 0.0254 / fraction if fraction > 1e-9 else None


def _entries(lines: Sequence[_Line]) -> dict[str, _Line]:
    """Lines by their first word."""
    return {line.words[0].lower(): line for line in lines}


class _Bone(NamedTuple):
    line: int
    offset: tuple[float, float, float]
    axes: Float[np.ndarray, "3 3"]
    freedom: tuple[str, ...]


def _bones(path: Path, lines: Sequence[_Line], radians: bool) -> dict[str, _Bone]:
    bones: dict[str, _Bone] = {}
    block: list[_Line] | None = None
    for line in lines:
        word = line.words[0].lower()
        if word == "begin" and block is None:
            block = [line]
        elif word == "end" and block is not None:
            name, bone = _bone(path, block, radians)
            if name in bones or name == "root":
                raise _bad(path, block[0].number, "a name of its own for every bone", name)
            bones[name] = bone
            block = None
        elif block is not None and word != "begin":
            block.append(line)
        else:
            raise _bad(path, line.number, "begin ... end for every bone", " ".join(line.words))
    if block is not None:
        raise _bad(path, block[-1].number, "end of a bone", "the end of the section")
    return bones


def _bone(path: Path, block: Sequence[_Line], radians: bool) -> tuple[str, _Bone]:
    entries = _entries(block)
    first = block[0].number
    for key, size in (("name", 1), ("direction", 3), ("length", 1), ("axis", 3)):
        if key not in entries or len(entries[key].words) < 1 + size:
            raise _bad(path, first, f"{key} of a bone", ", ".join(entries))

    def numbers(key: str, size: int) -> list[float]:
        line = entries[key]
        return _numbers(path, line.number, line.words[1 : 1 + size], f"{size} numbers")

    direction, axis = numbers("direction", 3), numbers("axis", 3)
    (length,) = numbers("length", 1)
    order = (entries["axis"].words[4:5] or ["XYZ"])[0].upper()
    if sorted(order) != ["X", "Y", "Z"]:
        raise _bad(path, entries["axis"].number, "an order of X, Y and Z", order)
    x, y, z = (length * value for value in direction)
    freedom = tuple(entries["dof"].words[1:]) if "dof" in entries else ()
    return entries["name"].words[1], _Bone(
        entries.get("dof", block[0]).number, (x, y, z), _euler(axis, order, radians), freedom
    )


def _euler(angles: Sequence[float], order: str, radians: bool) -> Float[np.ndarray, "3 3"]:
    """Rotations about fixed axes, in the order of the letters."""
    matrix = np.eye(3)
    for angle, letter in zip(angles, order, strict=True):
        matrix = about(_axis(letter), np.array(angle if radians else math.radians(angle))) @ matrix
    return matrix


def _hierarchy(path: Path, section: tuple[_Line, list[_Line]], bones: set[str]) -> dict[str, str]:
    """Parent of every bone, parents first."""
    parents: dict[str, str] = {}
    for line in section[1]:
        above, *below = line.words
        if above.lower() in ("begin", "end") and not below:
            continue
        if above != "root" and above not in parents:
            raise _bad(path, line.number, "bones after their parents, from root on", above)
        for name in below:
            if name not in bones or name in parents:
                raise _bad(path, line.number, "bones of :bonedata, each once", name)
            parents[name] = above
    if set(parents) != bones:
        missing = ", ".join(sorted(bones - set(parents)))
        raise _bad(path, section[0].number, "a parent for every bone", f"none for {missing}")
    return parents


def _parse_amc(path: Path, lines: list[_Line], skeleton: _Acclaim) -> Float[np.ndarray, "t c"]:
    radians = skeleton.radians
    frames: list[_Line] = []
    values: list[list[float]] = []
    filled: set[str] = set()
    for line in lines:
        first = line.words[0]
        if first.startswith("#"):
            continue
        if first.startswith(":"):
            radians = {":radians": True, ":degrees": False}.get(first.lower(), radians)
            continue
        if len(line.words) == 1 and first.isdigit():
            _check_frame(path, line.number, skeleton, filled if frames else None)
            if frames and _count(path, line.number, first, "a frame number") != (
                _count(path, line.number, frames[-1].words[0], "a frame number") + 1
            ):
                raise _bad(path, line.number, f"the frame after {frames[-1].words[0]}", first)
            frames.append(line)
            values.append([0.0] * len(skeleton.is_angle))
            filled = set()
            continue
        if not frames:
            raise _bad(path, line.number, "the number of the first frame, as in an AMC", first)
        columns = skeleton.columns.get(first)
        if columns is None:
            raise _bad(path, line.number, "a bone of the skeleton with freedom", first)
        if first in filled:
            raise _bad(path, line.number, "every bone once in a frame", first)
        filled.add(first)
        row = _numbers(path, line.number, line.words[1:], "numbers")
        if len(row) != len(columns):
            raise _bad(path, line.number, f"{len(columns)} numbers for {first}", len(row))
        for column, value in zip(columns, row, strict=True):
            values[-1][column] = value
    if not frames:
        raise _bad(path, lines[-1].number, "frames, as in an AMC", "none")
    _check_frame(path, lines[-1].number, skeleton, filled)
    table = np.array(values).reshape(len(values), len(skeleton.is_angle))
    if radians:
        return table
    return np.where(np.array(skeleton.is_angle, dtype=bool), np.radians(table), table)


def _check_frame(path: Path, line: int, skeleton: _Acclaim, filled: set[str] | None) -> None:
    """A frame is over: it must have told of every bone."""
    if filled is not None and (missing := sorted(set(skeleton.columns) - filled)):
        raise _bad(path, line, "all bones in the frame before", f"none for {', '.join(missing)}")
