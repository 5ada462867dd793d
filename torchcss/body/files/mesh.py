"""The box around a mesh: the triangles of an STL, binary or text, or the corners of an OBJ.

Only corners are read, and only of files of a size that a robot's link has.

Call `mesh_points`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from torchcss.errors import BodyError
from torchcss.files import read_bytes

_MOST_BYTES = 2**26
_FAR = 1e9
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEAD = 84
"""Bytes before the triangles of a binary file; the last four say how many there are."""

_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t\r]*$", re.MULTILINE)
_CORNER = re.compile(rb"^v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)

MESH_SUFFIXES = (".stl", ".obj")


def mesh_points(path: Path) -> Float[np.ndarray, "8 3"]:
    """The corners of the box around a mesh, in its own frame and unit.

    Args:
        path: The file.

    Raises:
        BodyError: If it cannot be read, is larger than 64 MiB, or no mesh.
    """
    if path.is_file() and path.stat().st_size > _MOST_BYTES:
        raise BodyError(f"{path}: more than {_MOST_BYTES:,} bytes; not a link's mesh")
    data = read_bytes(path, BodyError)
    count = int.from_bytes(data[_HEAD - 4 : _HEAD], "little")
    points = np.zeros((0, 3))
    is_obj = path.suffix.lower() == ".obj"
    if (
        not is_obj and 0 < count <= (len(data) - _HEAD) // _TRIANGLE.itemsize
    ):  # some programs add bytes
        triangles = np.frombuffer(data, _TRIANGLE, count, _HEAD)
        points = triangles["corners"].reshape(-1, 3).astype(np.float64)
    elif is_obj or data.lstrip().startswith(b"solid"):
        vertex = _CORNER if is_obj else _VERTEX
        try:
            points = np.array(vertex.findall(data)).astype(np.float64).reshape(-1, 3)
        except ValueError:  # a corner that is no number
            points = points[:0]
    if not len(points) or not (np.abs(points) < _FAR).all():
        raise BodyError(
            f"{path}: not an {path.suffix[1:].upper()}, or without triangles; get a complete copy"
        )
    ends = np.stack([points.min(0), points.max(0)])
    return ends[np.indices((2, 2, 2)).reshape(3, -1).T, np.arange(3)]
