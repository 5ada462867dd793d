"""2D joints in CSV: DeepLabCut's, MediaPipe's as people save them, and any table with a heading.

*DeepLabCut.* Headings `scorer`, `individuals` (with several animals), `bodyparts` and `coords`; one
row for every frame, `x, y, likelihood` for every body part. What was not found is empty.

*Wide.* One row for every frame, columns named by joint and number: `x1 y1 z1 v1 ...`,
`landmark_0_x`, `left_hip_x`, `nose.visibility`; a column `frame` may number the rows.

*Long.* One row for every joint of every frame: `frame, landmark, x, y, visibility`.

Joints that are only numbered are MediaPipe's if there are 33.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from torchcss.errors import KeypointError
from torchcss.files import read_text, shortened
from torchcss.io.keypoints.mediapipe import NAMES, in_pixels
from torchcss.io.keypoints.people import FRAME_NAMES, People, frame_number, in_order, screened

_PARTS = {
    **dict.fromkeys(("x", "u"), 0),
    **dict.fromkeys(("y", "v_px"), 1),
    **dict.fromkeys(
        ("v", "vis", "visibility", "conf", "confidence", "score", "likelihood", "p"), 2
    ),
    **dict.fromkeys(("z", "presence"), 3),
}
"""What a column's name says that it is: 0, 1 coordinates, 2 confidence, 3 not used."""

_JOINTS = ("landmark", "landmark_id", "landmark_name", "landmark_index", "joint", "joint_name",
           "joint_id", "bodypart", "keypoint", "name", "id", "index")  # fmt: skip


def read_table(path: Path, num_frames: int | None, image_size_wh: tuple[int, int]) -> People:
    """Read a CSV.

    Raises:
        KeypointError: If it is none of those above; the message names the row.
    """
    try:
        text = read_text(path, KeypointError)
        sample = text[:4096]
        comma = max(",;\t", key=sample.count)
        rows = [
            [cell.strip() for cell in row]
            for row in csv.reader(io.StringIO(text, newline=""), delimiter=comma)
        ]
    except csv.Error as error:
        raise KeypointError(f"{path}: cannot be read as CSV: {error}") from error
    numbered = [(number, row) for number, row in enumerate(rows, start=1) if any(row)]
    if not numbered:
        raise KeypointError(f"{path}: the file is empty")
    firsts = [row[0].lower() for _, row in numbered[:4]]
    if "bodyparts" in firsts and "coords" in firsts:
        return _read_deeplabcut(path, numbered, num_frames)
    heading, body = numbered[0][1], numbered[1:]
    names = [re.sub(r"[\s.\-]+", "_", cell.lower()) for cell in heading]
    if not body:
        raise KeypointError(f"{path}: row 1: a heading and nothing below it; get a complete copy")
    joint = _first_of(_JOINTS, names)
    if joint is not None and {"x", "y"} <= set(names):
        joints, found = _long(path, names, joint, body)
    else:
        joints, found = _wide(path, names, heading, body)
    people, _ = in_order(path, found, num_frames)
    lower = [re.sub(r"[^a-z0-9]+", "_", name.lower()) for name in joints]
    if len(joints) == len(NAMES) and (set(lower) == set(NAMES) or all(map(str.isdigit, lower))):
        order = [lower.index(name) for name in NAMES] if lower[0] in NAMES else _by_number(lower)
        people = [frame[:, order] for frame in people]
        return in_pixels(path, people, image_size_wh, ["format: CSV of MediaPipe's landmarks"])
    named = not all(map(str.isdigit, lower))
    return People(people, tuple(joints) if named else None, ["format: CSV, a heading per column"])


def _by_number(names: Sequence[str]) -> list[int]:
    return sorted(range(len(names)), key=lambda index: int(names[index]))


def _number(path: Path, row: int, cell: str) -> float:
    """A number; what is not there is NaN."""
    if not cell or cell.lower() in ("nan", "none", "null", "na"):
        return np.nan
    try:
        if "_" not in cell:
            return float(cell)
    except ValueError:
        pass
    raise KeypointError(f"{path}: row {row}: expected a number, found {shortened(cell)}")


def _first_of(wanted: Sequence[str], names: Sequence[str]) -> int | None:
    """Where the first of some words stands among the columns."""
    return next((names.index(name) for name in wanted if name in names), None)


def _checked(path: Path, row: int, cells: Sequence[str], size: int) -> None:
    if len(cells) != size:
        raise KeypointError(
            f"{path}: row {row}: expected {size} columns, as the heading has, found {len(cells)}; "
            "get a complete copy"
        )


def _with_confidence(values: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
    """Joints without a place have confidence 0, joints without confidence 1."""
    confidence = np.where(np.isnan(values[..., 2]), 1.0, values[..., 2])
    return screened(values[..., :2], confidence)


Frames = dict[int, Float[np.ndarray, "p j 3"]]


def _wide(
    path: Path, names: Sequence[str], heading: Sequence[str], body: Sequence[tuple[int, list[str]]]
) -> tuple[list[str], Frames]:
    columns: dict[str, dict[int, int]] = {}
    for index, name in enumerate(names):
        split = _split(name)
        if split is not None:
            joint, part = split
            if part in columns.setdefault(joint, {}) and part != 3:
                raise KeypointError(f"{path}: row 1: column {heading[index]!r} is there twice")
            columns[joint][part] = index
    joints = [joint for joint, parts in columns.items() if {0, 1} <= set(parts)]
    if not joints:
        raise KeypointError(
            f"{path}: row 1: expected DeepLabCut's headings, or columns such as nose_x and nose_y, "
            f"found {shortened(', '.join(heading))}"
        )
    frame_column = _first_of(FRAME_NAMES, names)
    frames: Frames = {}
    for place, (row, cells) in enumerate(body):
        _checked(path, row, cells, len(names))
        if frame_column is not None:
            place = frame_number(f"{path}: row {row}", cells[frame_column])
        values = np.full((1, len(joints), 3), np.nan)
        for index, joint in enumerate(joints):
            for part, column in columns[joint].items():
                if part < 3:
                    values[0, index, part] = _number(path, row, cells[column])
        values = _with_confidence(values)
        frames[place] = np.concatenate([frames[place], values]) if place in frames else values
    return joints, frames


def _split(name: str) -> tuple[str, int] | None:
    """Joint and kind of number of a column, whichever comes first in its name."""
    if match := re.fullmatch(r"([a-z]+)_?([0-9]+)", name):  # x1, v33
        if match[1] in _PARTS:
            return match[2], _PARTS[match[1]]
        return None
    for joint, part in (name.rpartition("_")[::2], name.partition("_")[::-2]):
        if part in _PARTS and joint:
            number = re.fullmatch(r"(?:landmark|lm|joint|keypoint|kp|point|pose)_?([0-9]+)", joint)
            return (number[1] if number else joint), _PARTS[part]
    return None


def _long(
    path: Path, names: Sequence[str], joint: int, body: Sequence[tuple[int, list[str]]]
) -> tuple[list[str], Frames]:
    parts = {_PARTS[name]: index for index, name in enumerate(names) if name in _PARTS}
    frame_column = _first_of(FRAME_NAMES, names)
    found: dict[int, dict[str, np.ndarray]] = {}
    joints: dict[str, None] = {}
    for row, cells in body:
        _checked(path, row, cells, len(names))
        where = f"{path}: row {row}"
        place = 0 if frame_column is None else frame_number(where, cells[frame_column])
        name = cells[joint]
        joints[name] = None
        if name in found.setdefault(place, {}):
            raise KeypointError(f"{where}: {name!r} is there twice in frame {place}")
        values = np.full(3, np.nan)
        for part, column in parts.items():
            if part < 3:
                values[part] = _number(path, row, cells[column])
        found[place][name] = _with_confidence(values)
    order = list(joints)
    frames: Frames = {}
    for place, rows in found.items():
        frames[place] = np.zeros((1, len(order), 3))
        for name, values in rows.items():
            frames[place][0, order.index(name)] = values
    return order, frames


def _read_deeplabcut(
    path: Path, rows: Sequence[tuple[int, list[str]]], num_frames: int | None
) -> People:
    headings = {row[0].lower(): row for _, row in rows[:4]}
    coords, parts = headings["coords"], headings["bodyparts"]
    start = next((i for i, cell in enumerate(coords) if cell in ("x", "y", "likelihood")), None)
    size = len(coords)
    if start is None or len(parts) != size or size != len(headings.get("individuals", coords)):
        raise KeypointError(
            f"{path}: expected x, y, likelihood under every body part, found "
            f"{shortened(', '.join(coords))}"
        )
    animals = headings.get("individuals", ["one"] * size)
    joints = list(dict.fromkeys(parts[start:]))
    people = list(dict.fromkeys(animals[start:]))
    first = 1 + max(i for i, (_, row) in enumerate(rows[:4]) if row[0].lower() == "coords")
    if len(rows) <= first:
        raise KeypointError(f"{path}: no frames below the headings; get a complete copy")
    frames: Frames = {}
    kinds = {"x": 0, "y": 1, "likelihood": 2}
    for place, (row, cells) in enumerate(rows[first:]):
        _checked(path, row, cells, size)
        values = np.full((len(people), len(joints), 3), np.nan)
        for column in range(start, size):
            if coords[column] not in kinds:
                raise KeypointError(
                    f"{path}: coords: expected x, y, likelihood, found {shortened(coords[column])}"
                )
            person, joint = people.index(animals[column]), joints.index(parts[column])
            values[person, joint, kinds[coords[column]]] = _number(path, row, cells[column])
        # Of labelled frames the picture's name is the index; of a video's its number.
        label = cells[start - 1] if start else str(place)
        place = frame_number(f"{path}: row {row}", label)
        if place in frames:
            raise KeypointError(f"{path}: row {row}: frame {place} is there twice")
        values = _with_confidence(values)
        frames[place] = values[(values[..., 2] > 0).any(-1)]
    report = [f"format: DeepLabCut, {len(people)} individual{'s' * (len(people) > 1)}"]
    return People(in_order(path, frames, num_frames)[0], tuple(joints), report)
