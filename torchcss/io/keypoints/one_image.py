"""Joints of one picture, from all formats of `torchcss.io.keypoints.read`.

Rows `joint, u, v[, confidence]` are the usual CSV of one. Missing joints have confidence 0. Call
`read_joints`.
"""

from __future__ import annotations

from functools import partial
from types import MappingProxyType

from torchcss.errors import KeypointError
from torchcss.files import StrPath
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
    read = partial(read_person, path, layout=layout, normalised=normalised, links=links)
    try:
        return read(film=Film(1), whom=Whom(0, "prominent", image_size_wh)).at(0)
    except KeypointError:  # not of one picture
        return read(film=Film(), whom=Whom(frame, "prominent", image_size_wh)).at(frame)
