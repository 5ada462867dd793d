"""The text of Acclaim's files: the segments of an ASF, and the numbers of an AMC that move them.

What is not as it should be ends in a `MotionCaptureError` that names file and line: a damaged file
never yields a motion. `torchcss.io.motion.positions` makes positions of what is parsed here.

Call `parse_acclaim`; BVH, the other format, is parsed in `torchcss.body.files.bvh_parser`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from torchcss.body.files.bvh_parser import (
    Channel,
    Segment,
    axis_of,
    bad,
    finite_numbers,
    whole_number,
)
from torchcss.body.rotations import about_fixed_axes
from torchcss.errors import MotionCaptureError
from torchcss.files import Line, naming, read_lines


class _Acclaim(NamedTuple):
    """An ASF file: the tree, how many numbers move each of its bones, and what it says of units."""

    segments: list[Segment]
    counts: dict[str, int]
    is_angle: list[bool]
    radians: bool
    metres_per_unit: float | None


def _sections(lines: Sequence[Line]) -> dict[str, tuple[Line, list[Line]]]:
    """The parts of a file that start with `:keyword`, without comments."""
    found: dict[str, tuple[Line, list[Line]]] = {}
    part: list[Line] = []
    for line in lines:
        first = line.words[0].lower()
        if first.startswith(":"):
            part = []
            found[first] = line, part
        elif not first.startswith("#"):
            part.append(line)
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
    with naming(skeleton, MotionCaptureError):
        found = _parse_asf(read_lines(skeleton, MotionCaptureError))
    with naming(motion, MotionCaptureError):
        values = _parse_amc(read_lines(motion, MotionCaptureError), found)
    return found.segments, values, found.metres_per_unit


def _parse_asf(lines: list[Line]) -> _Acclaim:
    sections = _sections(lines)
    for name in (":root", ":bonedata", ":hierarchy"):
        if name not in sections:
            raise bad(lines[-1].number, f"a section {name}", ", ".join(sections) or "none")
    radians, metres = _units(sections[":units"][1] if ":units" in sections else [])
    bones = _bones(sections[":bonedata"][1], radians)
    root = _entries(sections[":root"][1])
    parents = _hierarchy(sections[":hierarchy"], set(bones))
    if "order" not in root:
        raise bad(sections[":root"][0].number, "an order in :root", "none")

    def vector(key: str) -> tuple[float, float, float]:
        return _vector(root[key]) if key in root else (0.0, 0.0, 0.0)

    order, axes = root["order"], _turned(vector("orientation"), "XYZ", radians)
    bones["root"] = _Bone(order.number, vector("position"), axes, tuple(order.words[1:]))
    index = {name: number for number, name in enumerate(("root", *parents))}
    is_angle: list[bool] = []
    counts: dict[str, int] = {}
    segments: list[Segment] = []
    for name in index:
        bone = bones[name]
        turns = _turns(bone, len(is_angle), may_travel=name == "root")
        is_angle += [turn.is_rotation for turn in turns]
        if turns:
            counts[name] = len(turns)
        above = index.get(parents.get(name, ""), -1)
        # About fixed axes, the last factor acts first.
        segments.append(Segment(name, above, bone.offset, bone.axes, turns[::-1], name != "root"))
    return _Acclaim(segments, counts, is_angle, radians, metres)


def _turns(bone: _Bone, first: int, *, may_travel: bool) -> tuple[Channel, ...]:
    """What moves a bone, by columns from the first one on."""
    turns = []
    for column, word in enumerate(bone.freedom, first):
        kind, axis = word[:1].lower(), axis_of(word[1:] or "?")
        if len(word) != 2 or axis < 0 or kind not in ("rt" if may_travel else "r"):
            raise bad(bone.line, "degrees of freedom rx, ry, rz", word)
        turns.append(Channel(column, axis, kind == "r"))
    if len({turn[1:] for turn in turns}) < len(turns):
        raise bad(bone.line, "every degree of freedom once", " ".join(bone.freedom))
    return tuple(turns)


def _vector(line: Line) -> tuple[float, float, float]:
    """The three numbers of a line."""
    words, expected = line.words[1:4], "three numbers"
    values = finite_numbers(line.number, words, expected)
    if len(values) != 3:
        raise bad(line.number, expected, " ".join(words))
    return values[0], values[1], values[2]


def _units(lines: Sequence[Line]) -> tuple[bool, float | None]:
    """Whether angles are in radians, and the metres per unit of length, where stated."""
    units = _entries(lines)
    radians = "angle" in units and units["angle"].words[-1].lower().startswith("rad")
    if "length" not in units:
        return radians, None
    line = units["length"]
    fraction, *_ = finite_numbers(line.number, line.words[1:2] or ["nothing"], "a length")
    return radians, 0.0254 / fraction if fraction > 1e-9 else None


def _entries(lines: Sequence[Line]) -> dict[str, Line]:
    """Lines by their first word."""
    return {line.words[0].lower(): line for line in lines}


class _Bone(NamedTuple):
    line: int
    offset: tuple[float, float, float]
    axes: Float[np.ndarray, "3 3"]
    freedom: tuple[str, ...]


def _bones(lines: Sequence[Line], radians: bool) -> dict[str, _Bone]:
    bones: dict[str, _Bone] = {}
    block: list[Line] | None = None
    for line in lines:
        word = line.words[0].lower()
        if word == "begin" and block is None:
            block = [line]
        elif word == "end" and block is not None:
            name, bone = _bone(block, radians)
            if name in bones or name == "root":
                raise bad(block[0].number, "a name of its own for every bone", name)
            bones[name] = bone
            block = None
        elif block is not None and word != "begin":
            block.append(line)
        else:
            raise bad(line.number, "begin ... end for every bone", " ".join(line.words))
    if block is not None:
        raise bad(block[-1].number, "end of a bone", "the end of the section")
    return bones


def _bone(block: Sequence[Line], radians: bool) -> tuple[str, _Bone]:
    entries = _entries(block)
    first = block[0].number
    for key, size in (("name", 1), ("direction", 3), ("length", 1), ("axis", 3)):
        if key not in entries or len(entries[key].words) < 1 + size:
            raise bad(first, f"{key} of a bone", ", ".join(entries))

    axis, line = _vector(entries["axis"]), entries["length"]
    (length,) = finite_numbers(line.number, line.words[1:2], "1 numbers")
    order = (entries["axis"].words[4:5] or ["XYZ"])[0].upper()
    if sorted(order) != ["X", "Y", "Z"]:
        raise bad(entries["axis"].number, "an order of X, Y and Z", order)
    x, y, z = (length * value for value in _vector(entries["direction"]))
    freedom = entries.get("dof", Line(first, ["dof"]))
    return entries["name"].words[1], _Bone(
        freedom.number, (x, y, z), _turned(axis, order, radians), tuple(freedom.words[1:])
    )


def _turned(angles: Sequence[float], order: str, radians: bool) -> Float[np.ndarray, "3 3"]:
    """Rotations about fixed axes, in the order of the letters."""
    return about_fixed_axes(angles if radians else np.radians(angles).tolist(), order.upper())


def _hierarchy(section: tuple[Line, list[Line]], bones: set[str]) -> dict[str, str]:
    """Parent of every bone, parents first."""
    parents: dict[str, str] = {}
    for line in section[1]:
        above, *below = line.words
        if above.lower() in ("begin", "end") and not below:
            continue
        if above != "root" and above not in parents:
            raise bad(line.number, "bones after their parents, from root on", above)
        for name in below:
            if name not in bones or name in parents:
                raise bad(line.number, "bones of :bonedata, each once", name)
            parents[name] = above
    if set(parents) != bones:
        missing = ", ".join(sorted(bones - set(parents)))
        raise bad(section[0].number, "a parent for every bone", f"none for {missing}")
    return parents


def _parse_amc(lines: list[Line], skeleton: _Acclaim) -> Float[np.ndarray, "t c"]:
    radians = skeleton.radians
    frames: list[str] = []
    rows: list[dict[str, list[float]]] = []
    for line in lines:
        first, *words = line.words
        if first.startswith("#"):
            continue
        if first.startswith(":"):
            radians = {":radians": True, ":degrees": False}.get(first.lower(), radians)
            continue
        if not words and first.isdigit():
            if frames:
                _check_frame(line.number, skeleton, rows[-1])
                number, before = (
                    whole_number(line.number, word, "a frame number")
                    for word in (first, frames[-1])
                )
                if number != before + 1:
                    raise bad(line.number, f"the frame after {frames[-1]}", first)
            frames.append(first)
            rows.append({})
            continue
        if not frames:
            raise bad(line.number, "the number of the first frame, as in an AMC", first)
        if first not in skeleton.counts:
            raise bad(line.number, "a bone of the skeleton with freedom", first)
        if first in rows[-1]:
            raise bad(line.number, "every bone once in a frame", first)
        row = rows[-1][first] = finite_numbers(line.number, words, "numbers")
        if len(row) != (size := skeleton.counts[first]):
            raise bad(line.number, f"{size} numbers for {first}", len(row))
    if not frames:
        raise bad(lines[-1].number, "frames, as in an AMC", "none")
    _check_frame(lines[-1].number, skeleton, rows[-1])
    values = [number for row in rows for bone in skeleton.counts for number in row[bone]]
    table = np.array(values).reshape(len(rows), len(skeleton.is_angle))
    if radians:
        return table
    return np.where(np.array(skeleton.is_angle, dtype=bool), np.radians(table), table)


def _check_frame(line: int, skeleton: _Acclaim, filled: Collection[str]) -> None:
    """A frame is over: it must have told of every bone."""
    if missing := sorted({*skeleton.counts} - {*filled}):
        raise bad(line, "all bones in the frame before", f"none for {', '.join(missing)}")
