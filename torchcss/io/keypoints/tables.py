"""2D joints in CSV: DeepLabCut's, SLEAP's, MediaPipe's as people save them, any with a heading.

*DeepLabCut.* Headings `scorer`, `individuals` (with several animals), `bodyparts` and `coords`; one
row for every frame, `x, y, likelihood` for every body part, and what else smoothers put there,
which is left out. What was not found is empty.

*Wide.* One row for every person in every frame, columns named by joint and number: `x1 y1 z1 v1`,
`landmark_0_x`, `left_hip_x`, `nose.visibility`, `LWrist_c`. A column may number the frames, or say
their times; another one says who it is (SLEAP's `track`).

*Long.* One row for every joint of every frame: `frame, landmark, x, y, visibility`.

*In a cell.* One row for every person, whose joints a cell holds as JSON (`json_of_rows`).

Joints that are only numbered are MediaPipe's if there are 33. Each of the three says by its heading
what its columns are (`_Columns`); the rows are then read alike.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import read_text, refusing, shortened, unexpected
from torchcss.io.keypoints import words
from torchcss.io.keypoints.annotated import VIA_SHAPE, read_via_table
from torchcss.io.keypoints.frames import check_one_video, in_seconds
from torchcss.io.keypoints.json_people import JOINTS
from torchcss.io.keypoints.mediapipe import LAYOUT, NUM_LANDMARKS, reordered
from torchcss.io.keypoints.people import (
    LAYOUT_SIZES,
    Frames,
    Key,
    People,
    Person,
    joint_counts,
    screened,
    with_joints,
)
from torchcss.joint_names import CASE, names_in

_PARTS = {
    **dict.fromkeys(("x", "u"), 0),
    "y": 1,
    **dict.fromkeys(words.CONFIDENCES, 2),
    **dict.fromkeys(("z", "presence"), 3),
}
"""What a column's name says that it is: 0, 1 coordinates, 2 confidence, 3 not used."""

_UNITS = frozenset(
    names_in("px pixel pixels norm normalised normalized pos position coord loc img image color 2d")
)
_PIXELS = re.compile("(?i)(^|_)(px|pixels?)(_|$)")
_FRACTIONS = re.compile("(?i)(^|_)norm(ali[sz]ed)?(_|$)")
_IN_SPACE = frozenset(names_in("obj world 3d"))
_POINTS = r"((landmark|lm|joint|keypoint|kpt|kp|point|pose)s?(_|(?=[0-9])))+"
_OF_BODY_PARTS = re.compile("hand|face|finger")
"""What points beside those of a numbered body are called."""

_BODY = re.compile("pose|body")
"""How what the body is called among them begins."""

_ABSENT = names_in("nan none null na n/a #n/a <na> -")

_NUMBER = re.compile(r"([-+]?[0-9.,]+([eE][-+]?[0-9]+)?|nan)$")
_DECIMAL = re.compile(r"^(-?[0-9]*),([0-9]+(?:[eE][-+]?[0-9]+)?)$")

_HAND = ("joint", "u", "v", "confidence")
"""The columns of a table that somebody typed."""

_MOST_COLUMNS = 10_000
"""Of MediaPipe's 543 landmarks of everything there are some 2000, of herds of animals more."""

_WHEN = (*words.FRAMES, *words.TIMES, *words.PICTURES)

Row = tuple[int, list[str]]
"""A row's number in the file, from 1, and its cells."""


class _Columns(NamedTuple):
    """What the columns of a table are.

    Attributes:
        parts: Column of each of u, v and confidence, by person and joint.
        frame: The column that numbers the frames; None: a frame is a row.
        joint: The column that names the joint, if the heading does not.
        track: The column that says who it is.
        time: What the column `frame` is called, if it holds times.
    """

    parts: Mapping[tuple[str, str], Mapping[int, int]]
    frame: int | None
    joint: int | None = None
    track: int | None = None
    time: str | None = None


def people_of_rows(rows: list[Row]) -> People:
    """The people of a table's rows, the first of which is its heading.

    Raises:
        KeypointError: If it is none of those above; the message names the row.
    """
    firsts = [row[0].lower() for _, row in rows[:4]]
    if "bodyparts" in firsts and "coords" in firsts:
        columns, body, report = _deeplabcut(rows)
        joints, frames = _read_rows(columns, body)
        return People(frames, tuple(joints), report, first=0)
    rows = _by_hand(_with_one_heading(rows) if len(rows) > 1 else rows)
    if len(rows) == 1:
        raise KeypointError("row 1: a heading and nothing below it; get a complete copy")
    heading = rows[0][1]
    if VIA_SHAPE in heading:
        return read_via_table(heading, rows[1:])
    columns, report = _headed(heading), []
    body = _even(rows[1:], len(heading))
    body = body if columns.joint is None else _of_the_body(body, columns.joint, report)
    video = words.first_of({cell: n for n, cell in enumerate(heading)}, words.VIDEOS)
    if video is not None:
        check_one_video({row[video] for _, row in body} - {""})
    if columns.time is not None and columns.frame is not None:
        first = body[0][1][columns.frame]
        if words.seconds_in(first) is not None:
            columns = columns._replace(time="seconds")
        elif ":" in first:  # it counts frames in a second
            columns = columns._replace(frame=None, time=None)
    said = [n for n in (columns.frame, columns.track) if n is not None]
    who = {tuple(row[n] for n in said) for _, row in body}
    if not said and columns.joint is None and _counts(heading[0], body):
        columns = columns._replace(frame=0)
    elif len(who) == 1 < len(body) and said and not "".join(*who)[:1].isdecimal():
        columns = columns._replace(frame=None, time=None)  # the name of the video
    report += _told(columns, heading)
    joints, frames = _read_rows(columns, body)
    if columns.time is not None:
        frames = in_seconds(columns.time, frames)
    frames, joints = _without_hands(frames, joints, report)
    frames, names = reordered(frames, joints)
    people = People(frames, names, report, in_order=columns.frame is None and columns.joint is None)
    if names is None and joint_counts(frames) == {NUM_LANDMARKS}:
        report.insert(0, "format: CSV of MediaPipe's landmarks")
        return people._replace(layout=LAYOUT, corner_fractions=True)
    report.insert(0, "format: CSV, a heading per column")
    first = 0 if any(cell.lower() == "frame_idx" for cell in heading) else None  # SLEAP's
    size = _said_size(heading, body)
    return people._replace(first=first, by_hand=heading == [*_HAND], size_wh=size)


def _even(rows: Sequence[Row], size: int) -> list[Row]:
    """Rows of so many cells, without empty ones behind them.

    Raises:
        KeypointError: If one has fewer, or more.
    """
    even = [(n, cells if any(cells[size:]) else cells[:size]) for n, cells in rows]
    for number, cells in even:
        if len(cells) != size:
            raise KeypointError(
                f"row {number}: expected {size} columns, as the heading has, found {len(cells)}; "
                "get a complete copy"
            )
    return even


def _of_the_body(rows: list[Row], joint: int, report: list[str]) -> list[Row]:
    """Those of the body, where a column says of which of Holistic's parts a landmark is."""
    for column in {*range(len(rows[0][1]))} - {joint}:
        parts = [words.plain_word(row[column]) for _, row in rows]
        others = sorted(part for part in {*parts} if not _BODY.match(part))
        if 0 < len(others) < len({*parts}) and all(map(_OF_BODY_PARTS.search, others)):
            report.append(f"rows left out: {', '.join(others)}")
            return [row for row, part in zip(rows, parts, strict=True) if _BODY.match(part)]
    return rows


def _said_size(heading: Sequence[str], rows: Sequence[Row]) -> tuple[float, float] | None:
    """The size of the pictures, where all rows say the same; a bare width may be a person's."""
    places = {cell: n for n, cell in enumerate(heading)}
    for pair in words.SIDES[:-1]:
        columns = [words.first_of(places, (side,)) for side in pair]
        said = {tuple(row[n] for n in columns if n is not None) for _, row in rows}
        if None not in columns and len(said) == 1:
            with suppress(ValueError):
                width, height = map(float, *said)
                return (width, height) if min(width, height) > 0 else None
    return None


def _without_hands(
    frames: Frames, joints: list[str], report: list[str]
) -> tuple[Frames, list[str]]:
    """The same without what Caliscope numbers from 100 on beside MediaPipe's landmarks."""
    is_body = [name.isdecimal() and int(name) < NUM_LANDMARKS for name in joints]
    others = [name for name, own in zip(joints, is_body, strict=True) if not own]
    if not any(is_body) or not others or not all(re.fullmatch("[1-9][0-9]{2}", n) for n in others):
        return frames, joints
    report.append("points numbered from 100 on, of hands and face, are left out")
    own_joints = [name for name, own in zip(joints, is_body, strict=True) if own]
    return with_joints(frames, lambda all_joints: all_joints[is_body]), own_joints


def _told(columns: _Columns, heading: Sequence[str]) -> list[str]:
    """What to report of the columns."""
    used = {each for parts in columns.parts.values() for each in parts.values()}
    found = [heading[parts[2]] for parts in columns.parts.values() if 2 in parts]
    report = ["no confidence in the file: 1 for every joint that has a place other than (0, 0)"]
    if found:
        report = [f"confidence: columns such as {found[0]}"]
    others = {*range(len(heading))} - used - {columns.frame, columns.joint, columns.track}
    if left := [heading[index] for index in sorted(others) if heading[index]]:
        report.append(f"columns left out: {shortened(', '.join(left))}")
    return report


def rows_of_json(content: object) -> list[Row] | None:
    """The rows of a table that pandas wrote as JSON, in any of its forms; None: it is none."""
    heading: Any = None
    if isinstance(content, dict):
        heading, index = content.get("columns"), content.get("index")
        if isinstance(index, list) and isinstance(content.get("data"), list):  # split
            heading = ["", *heading] if isinstance(heading, list) else None
            content = [[i, *row] for i, row in zip(index, content["data"], strict=False)]
        elif "schema" in content:
            content = content.get("data")
        elif all(isinstance(each, dict) for each in content.values()):  # by index or by column
            if _heads_a_table(content):
                keys = next(iter(content.values()))
                content = {k: {n: each.get(k) for n, each in content.items()} for k in keys}
            content = [{"": key, **each} for key, each in content.items()]
    if not isinstance(content, list) or not content:
        return None
    if heading is None and isinstance(content[0], dict) and _heads_a_table(content[0]):
        heading = list(content[0])
        content = [each.values() if isinstance(each, dict) else [each] for each in content]
    if not heading or not all(isinstance(cell, (str, float, int, NoneType)) for cell in content[0]):
        return None
    rows = [["" if cell is None else f"{cell}" for cell in row] for row in content]
    return [*enumerate([[_head(each) for each in heading], *rows], start=1)]


def json_of_rows(rows: Sequence[Row]) -> list[dict[str, Any]] | None:
    """The same rows as objects, if a cell holds all joints (Ultralytics); None: none does."""
    (_, heading), *body = rows
    column = next((n for n, cell in enumerate(heading) if words.plain_word(cell) in JOINTS), None)
    if column is None or not body:
        return None
    if not all("".join(row[column : column + 1])[:1] in ("", "[", "{") for _, row in body):
        return None
    return [dict(zip(heading, map(_value, row), strict=False)) for _, row in body]


def _value(cell: str) -> Any:
    """What a cell holds in JSON, or in Python's like of it, or else its text."""
    text = re.sub(r"\bnan\b", "NaN", cell.replace("'", '"').replace("None", "null")) or "null"
    with suppress(ValueError, RecursionError):
        return json.loads(text)
    return cell


def _head(head: object) -> str:
    """A column's name; of pandas' names in several levels the last two."""
    if isinstance(head, str) and head.startswith("("):
        head = re.findall("'([^']*)'", head)
    return " ".join(map(str, head[-2:])) if isinstance(head, list) else f"{head}"


def _heads_a_table(names: Iterable[str]) -> bool:
    """Whether these are columns: x and y of a named joint, or of one that a column names."""
    split = [_split(_head(name)) for name in names]
    named = words.key_of(names, words.JOINT_WORDS) and words.key_of(names, _WHEN)
    own = [each[:2] for each in split if each is not None and (each[0] or named)]
    return any((joint, 0) in own and (joint, 1) in own for joint, _ in own)


def table_rows(path: Path) -> list[Row]:
    """The rows of a CSV that hold anything, whatever separates their cells.

    Raises:
        KeypointError: If there are none, or it is none.
    """
    text = read_text(path, KeypointError)
    text = re.sub(r"^sep=.\r?\n", "", text)  # for Excel
    line = (re.sub(r"\A(\s*#.*\n)*", "", text) or text).lstrip().partition("\n")[0]
    comma = max(",;\t", key=line.count)
    with refusing(KeypointError, f"{path}: cannot be read as CSV"):
        lines = (
            list(csv.reader(io.StringIO(text, newline=""), delimiter=comma))
            if comma in line
            else [re.sub("^# *", "#", line).split() for line in text.splitlines()]  # by spaces
        )
    rows = _without_comments(
        [(n, [c.strip() for c in row]) for n, row in enumerate(lines, start=1) if any(row)]
    )
    if not rows:
        raise KeypointError(f"{path}: the file is empty")
    if (most := max(len(row) for _, row in rows)) > _MOST_COLUMNS:
        raise KeypointError(
            f"{path}: {most} columns, expected at most {_MOST_COLUMNS}: a row for every person of "
            "every frame, x, y and confidence of the joints in columns"
        )
    if comma == ",":
        return rows
    # Whoever separates cells by something else may write decimals with a comma.
    return [(n, [_DECIMAL.sub(r"\1.\2", cell) for cell in row]) for n, row in rows]


def _without_comments(rows: list[Row]) -> list[Row]:
    """Rows that no `#` begins, but for the heading of numbers: NumPy and others put one before."""
    first = next((index for index, (_, row) in enumerate(rows) if row[0][:1] != "#"), 0)
    body = [each for each in rows[first:] if not each[1][0].startswith("# ")]
    if first and body and any(map(_NUMBER.match, body[0][1])):
        number, (cell, *rest) = rows[first - 1]
        if len("".join(rest).split()) and len(_ended(rows[first - 1])) == len(_ended(body[0])):
            body.insert(0, (number, [cell.removeprefix("#").strip() or cell, *rest]))
    return body


def _ended(row: Row) -> list[str]:
    """The cells of a row without empty ones at its end."""
    cells = row[1]
    return cells[: max((n for n, cell in enumerate(cells, start=1) if cell), default=0)]


def _by_hand(rows: list[Row]) -> list[Row]:
    """The same with a heading where rows are a joint, u, v and maybe its confidence."""
    number, above = rows[0]
    lengths = {len(_ended(row)) for row in rows}
    if not lengths <= {1, 3, 4} or lengths == {1} or _NUMBER.match(above[0] or "0"):
        return rows
    headed = above[0].lower() == "joint" and _PARTS.get(above[1].lower()) == 0
    if not headed and not all(not cell or _NUMBER.match(cell) for cell in above[1:]):
        return rows
    full = [(n, [*cells, "", ""][:4]) for n, cells in rows[headed:]]
    return [(number, [*_HAND]), *full]


def _with_one_heading(rows: list[Row]) -> list[Row]:
    """The same where joints stand above x and y in a row of their own, maybe once for both."""
    (number, above), (_, below) = rows[:2]
    kinds = {_PARTS.get(cell.lower()) for cell in below}
    if not {0, 1} <= kinds or {0, 1} <= {_PARTS.get(cell.lower()) for cell in above}:
        return rows
    heading, joint = [], ""
    for cell, kind in itertools.zip_longest(above, below, fillvalue=""):
        joint = cell or joint
        heading.append(f"{joint} {kind}" if kind.lower() in _PARTS else cell or kind)
    rest = rows[2:]
    # What pandas calls the index.
    if rest and len(_ended(rest[0])) == 1 and not _NUMBER.match(rest[0][1][0] or "0"):
        heading[0], rest = rest[0][1][0], rest[1:]
    return [(number, heading), *rest]


def _counts(head: str, rows: Sequence[Row]) -> bool:
    """Whether the first column has no name and counts the rows, as pandas writes it."""
    cells = [row[0] for _, row in rows]
    if words.plain_word(head) not in ("", "unnamed0", "index") or not all(
        re.fullmatch("[0-9]{1,9}", cell) for cell in cells
    ):
        return False
    numbers = [int(cell) for cell in cells]
    return all(one < other for one, other in itertools.pairwise(numbers))


def _headed(heading: Sequence[str]) -> _Columns:
    """The columns of a table with one heading, long or wide."""
    places = {cell: index for index, cell in reversed([*enumerate(heading)])}
    frame, time = words.first_of(places, words.FRAMES), None
    if frame is None:
        time = words.time_word(heading)
        frame = words.first_of(places, words.PICTURES if time is None else (time,))
    joint, track = words.first_of(places, words.JOINT_WORDS), words.first_of(places, words.TRACKS)
    split = [_split(cell) for cell in heading]
    if not any(each is not None and each[1] == 1 for each in split):  # u and v
        split = [_split(cell, {**_PARTS, "v": 1}) for cell in heading]
    columns: dict[tuple[str, str], dict[int, int]] = {}
    # Pixels before fractions, points before a box, and the better of two confidences.
    there = {index: each for index, each in enumerate(split) if each is not None}
    ranks = [
        1 - bool(_PIXELS.search(c)) + bool(_FRACTIONS.search(c)) - 3 * bool(re.match(_POINTS, c))
        for c in map(str.lower, heading)
    ]
    rank = {index: (ranks[index], each[2]) for index, each in there.items()}
    for index in sorted(there, key=rank.__getitem__):
        name, part, _ = there[index]
        own = columns.setdefault(("", name), {})
        if part in own and rank[index] == rank[own[part]] and part != 3 and name:
            raise KeypointError(f"row 1: column {heading[index]!r} is there twice")
        own.setdefault(part, index)
    if joint is not None:  # of the joint that the row names; x and y alone are maybe a box's
        for person, word in [each for each in columns if re.fullmatch(_POINTS, f"{each[1]}_")]:
            columns["", ""] = {**columns.get(("", ""), {}), **columns.pop((person, word))}
    half = [joint for (_, joint), parts in columns.items() if len({0, 1} & set(parts)) == 1]
    if numbers := [joint for joint in half if joint.isdecimal()]:
        raise KeypointError(f"row 1: joint {numbers[0]} has x or y, not both")
    columns = {joint: parts for joint, parts in columns.items() if {0, 1} <= set(parts)}
    numbered = {joint: parts for joint, parts in columns.items() if joint[1].isdecimal()}
    named = [joint for _, joint in columns if joint.strip("0123456789")]
    if len(numbered) in LAYOUT_SIZES and all(map(_OF_BODY_PARTS.search, named)):
        columns = numbered
    elif named:  # numbers beside names are a box's
        columns = {joint: parts for joint, parts in columns.items() if joint not in numbered}
    if joint is not None and set(columns) == {("", "")}:
        track = None if track == joint else track
        return _Columns({("", ""): columns["", ""]}, frame, joint, track, time)
    columns.pop(("", ""), None)
    if not columns:
        raise KeypointError(
            f"row 1: expected DeepLabCut's headings, or columns such as nose_x and nose_y, "
            f"found {shortened(', '.join(heading))}"
        )
    return _Columns(columns, frame, None, track, time)


def _split(cell: str, kinds: Mapping[str, int] = _PARTS) -> tuple[str, int, int] | None:
    """Joint, kind of number and rank as a confidence of a column; either may begin its name."""
    parted = [word for word in re.split(r"[\W_]+", re.sub(CASE, " ", cell).lower()) if word]
    if not _IN_SPACE.isdisjoint(parted):
        return None
    parted = [word for word in parted if word not in _UNITS]
    if match := re.fullmatch(r"([a-z]+)_?([0-9]+)", "_".join(parted)):  # x1, v33
        return (match[2], *_kind(match[1], kinds)) if match[1] in kinds else None
    for part, joint in (
        (parted[-2:], parted[:-2]), (parted[-1:], parted[:-1]), (parted[:1], parted[1:])
    ):  # fmt: skip
        if "".join(part) in kinds:
            name = re.sub(f"^{_POINTS}(?=.)", "", "_".join(joint))
            return name, *_kind("".join(part), kinds)
    return None


def _kind(word: str, kinds: Mapping[str, int]) -> tuple[int, int]:
    return kinds[word], words.CONFIDENCES.index(word) if kinds[word] == 2 else 0


def _deeplabcut(rows: Sequence[Row]) -> tuple[_Columns, Sequence[Row], list[str]]:
    """The columns of DeepLabCut's headings, the rows below, and what to report."""
    headings = {row[0].lower(): row for _, row in rows[:4]}
    coords, joints = headings["coords"], headings["bodyparts"]
    if "z" in coords:
        raise KeypointError("coords: x, y, z are points in space; expected a camera's pixels")
    kinds = ("x", "y", "likelihood")
    start = next((index for index, cell in enumerate(joints) if index and cell), None)
    size = len(coords)
    animals = headings.get("individuals", ["one"] * size)
    if start is None or not len(joints) == len(animals) == size or not {*kinds} & {*coords}:
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
    return _Columns(parts, start - 1 if start else None), _even(body, size), report


def _read_rows(columns: _Columns, body: Sequence[Row]) -> tuple[list[str], Frames]:
    """Names of the joints, and the people in every frame."""
    joints: dict[str, None] = {}
    found: dict[Key, dict[str, dict[str, list[float]]]] = {}
    for index, (row, cells) in enumerate(body):
        where = f"row {row}"
        place = _place(where, columns, cells, index)
        track = "" if columns.track is None else words.track_text(cells[columns.track]) or ""
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
    if columns.time is not None:
        seconds = words.seconds_in(cell)
        return _number(where, cell) if seconds is None else seconds
    if not re.fullmatch(r"[0-9.-]*|[0-9.]+[eE][-+]?[0-9]+", cell):
        return cell  # of labelled frames the picture's name
    with suppress(ValueError):
        number = float(cell)
        if 0 <= number < 1e9 and number.is_integer():
            return int(number)
    raise unexpected(KeypointError, where, "a frame number", cell)


def _number(where: str, cell: str) -> float:
    """A number; what is not there is NaN."""
    if not cell or cell.lower() in _ABSENT:
        return np.nan
    if cell.lower() in ("true", "false"):
        return float(cell.lower() == "true")
    try:
        if "_" not in cell:
            return float(cell.removesuffix("%"))
    except ValueError:
        pass
    raise unexpected(KeypointError, where, "a number", cell)
