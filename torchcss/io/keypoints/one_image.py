"""Joints of one picture, from all formats of `torchcss.io.keypoints.read`.

Rows `joint, u, v[, confidence]` are the usual CSV of one. Missing joints have confidence 0. Call
`read_joints`.
"""

from __future__ import annotations

import re
from pathlib import Path
from types import MappingProxyType

from torchcss.errors import KeypointError
from torchcss.files import StrPath, load_json
from torchcss.io.keypoints.frames import Film
from torchcss.io.keypoints.links import Links
from torchcss.io.keypoints.one_person import Whom
from torchcss.io.keypoints.people import Size
from torchcss.io.keypoints.read import Scale, read_person
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
            `torchcss.io.keypoints.read.Scale` (MediaPipe's always are).
        frame: Which frame of a file that has several; a file of one picture is of that picture.
        links: What the body's file calls its joints.

    Raises:
        KeypointError: If the file is missing, damaged or of unknown format.
    """
    path = Path(path)
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
