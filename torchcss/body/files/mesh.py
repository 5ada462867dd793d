"""The box around a mesh: the triangles of an STL, binary or text, the corners of an OBJ or COLLADA.

Only corners are read, and only of files of a size that a robot's link has. COLLADA says its unit,
and where its scene puts a mesh; its up axis does not count, as in ROS.

Call `mesh_points`.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from torchcss.body.files.xml import parse_xml
from torchcss.body.rotations import from_axis_angle
from torchcss.errors import BodyError
from torchcss.files import read_bytes, refusing

_MOST_BYTES = 2**26
_FAR = 1e9
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEAD = 84
"""Bytes before the triangles of a binary file; the last four say how many there are."""

_VERTEX = re.compile(rb"^[ \t]*vertex[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)[ \t\r]*$", re.MULTILINE)
_CORNER = re.compile(rb"^v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)

MESH_SUFFIXES = (".stl", ".obj", ".dae")


def mesh_points(path: Path) -> Float[np.ndarray, "8 3"]:
    """The corners of the box around a mesh, in its own frame; in metres if it says its unit.

    Args:
        path: The file.

    Raises:
        BodyError: If it cannot be read, is larger than 64 MiB, or no mesh.
    """
    if path.is_file() and path.stat().st_size > _MOST_BYTES:
        raise BodyError(f"{path}: more than {_MOST_BYTES:,} bytes; not a link's mesh")
    suffix = path.suffix.lower()
    points = _collada(path) if suffix == ".dae" else _corners(read_bytes(path, BodyError), suffix)
    if not len(points) or not (np.abs(points) < _FAR).all():
        raise BodyError(
            f"{path}: not an {path.suffix[1:].upper()}, or without triangles; get a complete copy"
        )
    ends = np.stack([points.min(0), points.max(0)])
    return ends[np.indices((2, 2, 2)).reshape(3, -1).T, np.arange(3)]


def _corners(data: bytes, suffix: str) -> Float[np.ndarray, "p 3"]:
    """The corners in an STL or OBJ; none if it is damaged."""
    count = int.from_bytes(data[_HEAD - 4 : _HEAD], "little")
    points = np.zeros((0, 3))
    is_obj = suffix == ".obj"
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
    return points


def _collada(path: Path) -> Float[np.ndarray, "p 3"]:
    """The corners of all meshes of COLLADA's scene, metres; without a scene as they are."""
    root = parse_xml(path, "COLLADA's XML")
    with refusing(BodyError, f"{path}: not COLLADA"):
        meshes = {f"#{each.get('id')}": _positions(each) for each in root.iter("geometry")}
        unit = root.find("asset/unit")
        metres = 1.0 if unit is None else float(unit.get("meter", 1.0))
        nodes = [node for scene in root.iter("visual_scene") for node in scene.findall("node")]
        placed = [each for node in nodes for each in _placed(node, np.eye(4), meshes)]
        return metres * np.concatenate(placed or [*meshes.values(), np.zeros((0, 3))])


def _positions(geometry: ElementTree.Element) -> Float[np.ndarray, "p 3"]:
    """The corners of a mesh, which are its source of positions."""
    entry = geometry.find("mesh/vertices/input[@semantic='POSITION']")
    name = "" if entry is None else entry.get("source", "").removeprefix("#")
    numbers = geometry.findtext(f"mesh/source[@id='{name}']/float_array", "")
    return np.array(numbers.split(), dtype=np.float64).reshape(-1, 3)


def _placed(
    node: ElementTree.Element, pose: Float[np.ndarray, "4 4"], meshes: Mapping[str, np.ndarray]
) -> Iterator[Float[np.ndarray, "p 3"]]:
    """The corners of the meshes of a node and of those below it, in the scene."""
    for step in node:
        if step.tag in ("matrix", "translate", "rotate", "scale"):
            numbers, own = np.array((step.text or "").split(), dtype=np.float64), np.eye(4)
            if step.tag == "matrix":
                own = numbers.reshape(4, 4)
            elif step.tag == "translate":
                own[:3, 3] = numbers
            elif step.tag == "rotate":  # an axis, and degrees
                axis = numbers[:3] / np.linalg.norm(numbers[:3])
                own[:3, :3] = from_axis_angle(np.radians(numbers[3]) * axis)
            else:
                own[:3, :3] = np.diag(numbers)
            pose = pose @ own
        elif step.tag == "instance_geometry":
            yield meshes[step.get("url", "")] @ pose[:3, :3].T + pose[:3, 3]
        elif step.tag == "instance_node":
            raise ValueError("it places a node by reference, which is not read; save it as STL")
        elif step.tag == "node":
            yield from _placed(step, pose, meshes)
