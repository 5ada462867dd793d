"""2D joints in CSV: DeepLabCut's, SLEAP's, MediaPipe's as people save them, any with a heading.

*DeepLabCut.* Headings `scorer`, `individuals` (with several animals), `bodyparts` and `coords`; one
row for every frame, `x, y, likelihood` for every body part, and what else smoothers put there,
which is left out. What was not found is empty.

*Wide.* One row for every person in every frame, columns named by joint and number: `x1 y1 z1 v1`,
`landmark_0_x`, `left_hip_x`, `nose.visibility`, `LWrist_c`. A column may number the frames, or say
their times; another one says who it is (SLEAP's `track`).

*Long.* One row for every joint of every frame: `frame, landmark, x, y, visibility`.

Joints that are only numbered are MediaPipe's if there are 33. Each of the three says by its heading
what its columns are (`_Columns`); the rows are then read alike.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import read_text, shortened
from torchcss.io.keypoints.mediapipe import LAYOUT, NUM_LANDMARKS, landmark_order, reordered
from torchcss.io.keypoints.people import (
    CONFIDENCE_NAMES,
    FRAME_NAMES,
    Frames,
    Key,
    People,
    Person,
    screened,
)
from torchcss.joint_names import names_in

_PARTS = {
    **dict.fromkeys(("x", "u"), 0),
    **dict.fromkeys(("y", "v_px"), 1),
    **dict.fromkeys(CONFIDENCE_NAMES, 2),
    **dict.fromkeys(("z", "presence"), 3),
}
"""What a column's name says that it is: 0, 1 coordinates, 2 confidence, 3 not used."""

_JOINTS = names_in(
    "landmark landmark_id landmark_name landmark_index joint joint_name joint_id bodypart keypoint "
    "name id index"
)
_TRACKS = names_in("track track_id track_name person person_id individual individuals")
_TIMES = {"timestamp_ms": 1e-3, "time_ms": 1e-3, "timestamp_s": 1.0, "time_s": 1.0, "time": 1.0,
          "timestamp": 1.0}  # fmt: skip
"""Columns of times, in seconds unless the name says otherwise."""

_DECIMAL = re.compile(r"^(-?[0-9]*),([0-9]+(?:[eE][-+]?[0-9]+)?)$")

Row = tuple[int, list[str]]
"""A row's number in the file, from 1, and its cells."""


class _Columns(NamedTuple):
    """What the columns of a table are.

    Attributes:
        parts: Column of each of u, v and confidence, by person and joint.
        size: How many columns there are.
        frame: The column that numbers the frames; None: a frame is a row.
        joint: The column that names the joint, if the heading does not.
        track: The column that says who it is.
        unit: Seconds, if the column `frame` holds times in that unit.
    """

    parts: Mapping[tuple[str, str], Mapping[int, int]]
    size: int
    frame: int | None
    joint: int | None = None
    track: int | None = None
    unit: float | None = None


def read_table(path: Path) -> People:
    """Read a CSV.

    Raises:
        KeypointError: If it is none of those above; the message names the row.
    """
    rows = table_rows(path)
    firsts = [row[0].lower() for _, row in rows[:4]]
    if "bodyparts" in firsts and "coords" in firsts:
        columns, body, report = _deeplabcut(rows)
        joints, frames = _read_rows(columns, body)
        return People(frames, tuple(joints), report, first=0)
    if len(rows) == 1:
        raise KeypointError("row 1: a heading and nothing below it; get a complete copy")
    columns = _headed(rows[0][1])
    found = [rows[0][1][parts[2]] for parts in columns.parts.values() if 2 in parts]
    report = ["no confidence in the file: 1 for every joint that has a place other than (0, 0)"]
    if found:
        report = [f"confidence: columns such as {found[0]}"]
    joints, frames = _read_rows(columns, rows[1:])
    order = landmark_order(joints)
    if order is not None and len(joints) == NUM_LANDMARKS:
        report.insert(0, "format: CSV of MediaPipe's landmarks")
        return People(reordered(frames, order), None, report, LAYOUT, corner_fractions=True)
    report.insert(0, "format: CSV, a heading per column")
    first = 0 if any(cell.lower() == "frame_idx" for cell in rows[0][1]) else None  # SLEAP's
    return People(frames, None if order is not None else tuple(joints), report, first=first)


def table_rows(path: Path) -> list[Row]:
    """The rows of a CSV that hold anything, whatever separates their cells.

    Raises:
        KeypointError: If there are none, or it is none.
    """
    text = read_text(path, KeypointError)
    comma = max(",;\t", key=text.lstrip().partition("\n")[0].count)
    try:
        lines = list(csv.reader(io.StringIO(text, newline=""), delimiter=comma))
    except csv.Error as error:
        raise KeypointError(f"{path}: cannot be read as CSV: {error}") from error
    rows = [(n, [cell.strip() for cell in row]) for n, row in enumerate(lines, 1) if any(row)]
    if not rows:
        raise KeypointError(f"{path}: the file is empty")
    if comma == ",":
        return rows
    # Whoever separates cells by something else may write decimals with a comma.
    return [(n, [_DECIMAL.sub(r"\1.\2", cell) for cell in row]) for n, row in rows]


def _headed(heading: Sequence[str]) -> _Columns:
    """The columns of a table with one heading, long or wide."""
    names = [re.sub(r"[\s.\-]+", "_", cell.lower()) for cell in heading]
    frame, unit = _first_of(FRAME_NAMES, names), None
    if frame is None and (frame := _first_of(tuple(_TIMES), names)) is not None:
        unit = _TIMES[names[frame]]
    joint, track = _first_of(_JOINTS, names), _first_of(_TRACKS, names)
    if joint is not None and {"x", "y"} <= set(names):
        parts = {_PARTS[name]: index for index, name in enumerate(names) if name in _PARTS}
        return _Columns({("", ""): parts}, len(names), frame, joint, track, unit)
    columns: dict[tuple[str, str], dict[int, int]] = {}
    for index, name in enumerate(names):
        if (split := _split(name)) is not None:
            own = columns.setdefault(("", split[0]), {})
            if split[1] in own and split[1] != 3:
                raise KeypointError(f"row 1: column {heading[index]!r} is there twice")
            own[split[1]] = index
    columns = {joint: parts for joint, parts in columns.items() if {0, 1} <= set(parts)}
    if not columns:
        raise KeypointError(
            f"row 1: expected DeepLabCut's headings, or columns such as nose_x and nose_y, "
            f"found {shortened(', '.join(heading))}"
        )
    return _Columns(columns, len(names), frame, None, track, unit)


def _split(name: str) -> tuple[str, int] | None:
    """Joint and kind of number of a column, whichever comes first in its name."""
    if match := re.fullmatch(r"([a-z]+)_?([0-9]+)", name):  # x1, v33
        return (match[2], _PARTS[match[1]]) if match[1] in _PARTS else None
    for joint, part in (name.rpartition("_")[::2], name.partition("_")[::-2]):
        if part in _PARTS and joint:
            number = re.fullmatch(r"(?:landmark|lm|joint|keypoint|kp|point|pose)_?([0-9]+)", joint)
            return (number[1] if number else joint), _PARTS[part]
    return None


def _deeplabcut(rows: Sequence[Row]) -> tuple[_Columns, Sequence[Row], list[str]]:
    """The columns of DeepLabCut's headings, the rows below, and what to report."""
    headings = {row[0].lower(): row for _, row in rows[:4]}
    coords, joints = headings["coords"], headings["bodyparts"]
    kinds = ("x", "y", "likelihood")
    start = next((index for index, cell in enumerate(coords) if cell in kinds), None)
    size = len(coords)
    animals = headings.get("individuals", ["one"] * size)
    if start is None or not len(joints) == len(animals) == size:
        raise KeypointError(
            f"expected x, y, likelihood under every body part, found {shortened(', '.join(coords))}"
        )
    parts: dict[tuple[str, str], dict[int, int]] = {}
    for column in range(start, size):
        if coords[column] in kinds:
            own = parts.setdefault((animals[column], joints[column]), {})
            own.setdefault(kinds.index(coords[column]), column)
    for (_, joint), own in parts.items():
        if not {0, 1} <= own.keys():
            raise KeypointError(f"coords: expected x and y of {joint!r}")
    people = len({person for person, _ in parts})
    report = [f"format: DeepLabCut, {people} individual{'s' * (people > 1)}"]
    if others := sorted({kind for kind in coords[start:] if kind not in kinds}):
        report.append(f"columns left out: {shortened(', '.join(others))}")
    body = rows[1 + [row[0].lower() for _, row in rows[:4]].index("coords") :]
    if not body:
        raise KeypointError("no frames below the headings; get a complete copy")
    # Of labelled frames the picture's name is the index; of a video's its number.
    return _Columns(parts, size, start - 1 if start else None), body, report


def _read_rows(columns: _Columns, body: Sequence[Row]) -> tuple[list[str], Frames]:
    """Names of the joints, and the people in every frame."""
    joints: dict[str, None] = {}
    found: dict[Key, dict[str, dict[str, list[float]]]] = {}
    for index, (row, cells) in enumerate(body):
        where = f"row {row}"
        if len(cells) != columns.size:
            raise KeypointError(
                f"{where}: expected {columns.size} columns, as the heading has, found "
                f"{len(cells)}; get a complete copy"
            )
        place = _place(where, columns, cells, index)
        track = "" if columns.track is None else cells[columns.track]
        for (person, joint), parts in columns.parts.items():
            # Of a wide table every row is a person of its own.
            person = person or track or ("" if columns.joint is not None else f"row {row}")
            name = joint if columns.joint is None else cells[columns.joint]
            joints[name] = None
            marked = found.setdefault(place, {}).setdefault(person, {})
            if name in marked:
                raise KeypointError(f"{where}: {name!r} is there twice in frame {place}")
            marked[name] = [
                _number(where, cells[parts[part]]) if part in parts else np.nan for part in range(3)
            ]
    names, frames = list(joints), {}
    for place, people in found.items():
        values = np.array(
            [[marked.get(name, [np.nan] * 3) for name in names] for marked in people.values()]
        )
        frames[place] = [
            Person(joints, None if who.startswith("row ") else who)
            for who, joints in zip(people, screened(values[..., :2], values[..., 2]), strict=True)
            if (joints[:, 2] > 0).any()
        ]
    return names, frames


def _place(where: str, columns: _Columns, cells: Sequence[str], index: int) -> Key:
    """The frame of a row: its number, its time, or which row it is."""
    if columns.frame is None:
        return index if columns.joint is None else 0
    cell = cells[columns.frame]
    if columns.unit is not None:
        return columns.unit * _number(where, cell)
    if not re.fullmatch(r"[0-9.-]*", cell):
        return cell  # of labelled frames the picture's name
    match = re.fullmatch(r"(?:.*\.)?([0-9]{1,9})(?:\.0*)?", cell)
    if match is None:
        raise KeypointError(f"{where}: expected a frame number, found {shortened(cell)}")
    return int(match[1])


def _number(where: str, cell: str) -> float:
    """A number; what is not there is NaN."""
    if not cell or cell.lower() in ("nan", "none", "null", "na"):
        return np.nan
    try:
        if "_" not in cell:
            return float(cell)
    except ValueError:
        pass
    raise KeypointError(f"{where}: expected a number, found {shortened(cell)}")


def _first_of(wanted: Sequence[str], names: Sequence[str]) -> int | None:
    """Where the first of some words stands among the columns."""
    return next((names.index(name) for name in wanted if name in names), None)
