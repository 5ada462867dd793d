"""Joints of one picture: all formats of `torchcss.io.keypoints.read`, and CSV of a row a joint.

| format | recognised by |
|---|---|
| CSV | suffix `.csv`: rows `joint, u, v[, confidence]`, with or without a heading |
| other CSV | a first row that names the columns otherwise, as DeepLabCut's or `l_hip_x` |
| these, OpenPose, COCO, MediaPipe, clicked, NPZ | see `torchcss.io.keypoints.read` |

Missing joints are simply missing. Call `read_joints`.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import MappingProxyType

import torch

from torchcss.errors import KeypointError
from torchcss.files import StrPath, load_json
from torchcss.io.keypoints.frames import Film
from torchcss.io.keypoints.links import Links, joints_named
from torchcss.io.keypoints.one_person import Whom
from torchcss.io.keypoints.people import Size
from torchcss.io.keypoints.read import Scale, read_person
from torchcss.io.keypoints.tables import Row, table_rows
from torchcss.joint_names import JOINT_NAMES, canonical_joint_name
from torchcss.types import Keypoints


def read_joints(
    path: StrPath,
    *,
    image_size_wh: Size,
    layout: str | None = None,
    normalised: bool | Scale = False,
    frame: int = 0,
    links: Links = MappingProxyType({}),
) -> Keypoints:
    """Read the joints of one picture.

    Args:
        path: A file, or OpenPose's folder.
        image_size_wh: Size of the picture.
        layout: Layout of a file that does not name its joints.
        normalised: Whether coordinates are fractions of the image, and which, see
            `torchcss.io.keypoints.read.Scale` (MediaPipe's always are, rows of joints never).
        frame: Which frame of a file that has several; a file of one picture is of that picture.
        links: What the body's file calls its joints.

    Raises:
        KeypointError: If the file is missing, damaged or of unknown format.
    """
    path = Path(path)
    if path.suffix.lower() == ".csv":
        rows = table_rows(path)
        if _are_joints(rows, links):
            if normalised not in (False, "pixels"):
                raise KeypointError(
                    f"{path}: rows joint, u, v[, confidence] are in pixels; leave normalised out"
                )
            return _read_csv(path, rows, links)
    if path.suffix.lower() == ".json":
        frame = _frame_of_single_image(load_json(path, KeypointError), frame)
    whom = Whom(frame, "prominent", image_size_wh)
    return read_person(
        path, film=Film(None, None, None), whom=whom, layout=layout, normalised=normalised,
        links=links,
    ).at(frame)  # fmt: skip


def _frame_of_single_image(content: object, otherwise: int) -> int:
    """Where the joints of a file of one image are; COCO's number counts as a video's frame."""
    if isinstance(content, dict):
        return 0 if content.keys() & {"joints", "people", "landmarks"} else otherwise
    rows = content if isinstance(content, list) else []
    if rows and isinstance(rows[0], dict) and {"x", "y"} <= set(rows[0]):
        return 0
    images = {str(row.get("image_id")) if isinstance(row, dict) else "" for row in rows}
    only = images.pop() if len(images) == 1 else ""
    digits = re.findall(r"[0-9]+", Path(only).stem)
    return int(digits[-1]) if digits else otherwise


def _joint(name: str, links: Links) -> str | None:
    return joints_named((name,), links)[0] or canonical_joint_name(name)


def _is_heading(cells: list[str], links: Links) -> bool:
    """Whether a first row names the columns: it is of no joint, and holds words."""
    return _joint(cells[0], links) is None and _values(cells) is None


def _values(cells: list[str]) -> list[float] | None:
    """u, v and confidence of a row, as far as it has them; None: they are no numbers."""
    try:
        return [float(cell) for cell in cells[1:4] if cell]
    except ValueError:
        return None


def _are_joints(rows: list[Row], links: Links) -> bool:
    """Whether these are rows `joint, u, v[, confidence]` and not another table with a heading."""
    heading = rows[0][1]
    if len(rows) < 2 or not _is_heading(heading, links):
        return True
    # MediaPipe's landmarks are a row each too, with a depth or under their own word.
    names = [cell.lower() for cell in heading]
    if "z" in names or "landmark" in names[0]:
        return False
    return any(_joint(cells[0], links) for _, cells in rows[1:])


def _read_csv(path: Path, rows: list[Row], links: Links) -> Keypoints:
    table: dict[str, list[float]] = {}
    for number, cells in rows[_is_heading(rows[0][1], links) :]:
        where = f"{path}: row {number}"
        values = _values(cells)
        name = "" if values is None else _joint(cells[0], links)
        if name is None:
            known = ", ".join(dict.fromkeys(links.values()) or JOINT_NAMES)
            raise KeypointError(f"{where}: unknown joint {cells[0]!r}; the known ones are {known}")
        if values == []:
            continue  # a joint without a place is missing
        if not values or len(values) == 1 or not all(map(math.isfinite, values)):
            raise KeypointError(f"{where}: expected joint, u, v[, confidence], found {cells}")
        if name in table:
            raise KeypointError(f"{where}: {name} is marked twice; leave one of the rows out")
        table[name] = [*values, 1.0][:3]
    if not table:
        raise KeypointError(f"{path}: no joints; expected rows joint, u, v[, confidence]")
    numbers = torch.tensor(list(table.values()), dtype=torch.float64)
    report = (f"format: CSV, {len(table)} joints",)
    return Keypoints(numbers[:, :2], numbers[:, 2].clamp(0, 1), tuple(table), report=report)
