"""Simple solids of a URDF as parts: boxes, cylinders, spheres (and capsules, which some write).

The visual solids of a link, or where it has none those for collisions; meshes are left out. The
tree itself is read by `torchcss.body.kinematics`. Call `read_urdf_solids`.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from itertools import count
from pathlib import Path

import numpy as np

from torchcss.body.catalog import PartSpecification
from torchcss.body.files.default_shape import as_rows, solid_shape
from torchcss.errors import BodyError
from torchcss.files import shortened

_SIZES = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
}


def read_urdf_solids(path: Path, data: bytes) -> tuple[PartSpecification, ...]:
    """Parts of a URDF that has been read as a tree already.

    Args:
        path: The file, for messages.
        data: Its content.

    Raises:
        BodyError: If a size or place is not of numbers.
    """
    parts: list[PartSpecification] = []
    links = ElementTree.fromstring(data).findall("link")
    # A link's first solid has its name, also that of a link further on.
    names = {link.get("name", "") for link in links}
    for link in links:
        name = link.get("name", "")
        free = (other for n in count(2) if (other := f"{name}_{n}") not in names)
        solids = [found for tag in ("visual", "collision") if (found := _solids(link, tag))]
        for number, (element, solid) in enumerate(solids[0] if solids else [], start=1):
            where = f"{path}: link {name!r}: <{solid.tag}>"
            size: list[float] = []
            for key in _SIZES[solid.tag]:
                size += _numbers(where, key, solid.get(key, ""), 3 if key == "size" else 1)
            if not all(number > 1e-6 for number in size):
                raise BodyError(f"{where}: expected positive sizes, found {size}")
            if solid.tag == "box":
                size = [0.5 * side for side in size]
            elif len(size) == 2:
                size[1] *= 0.5
            origin = element.find("origin")
            values = {} if origin is None else origin.attrib
            x, y, z = _numbers(where, "xyz", values.get("xyz", "0 0 0"), 3)
            turn = _turn(_numbers(where, "rpy", values.get("rpy", "0 0 0"), 3))
            parts.append(
                PartSpecification(
                    name=name if number == 1 else next(free),
                    link=name,
                    translation=(x, y, z),
                    rotation=as_rows(turn),
                    shape=solid_shape(solid.tag, size),
                )
            )
    return tuple(parts)


def _solids(
    link: ElementTree.Element, tag: str
) -> list[tuple[ElementTree.Element, ElementTree.Element]]:
    """Elements of a link that have a simple solid, with it."""
    return [
        (element, solid)
        for element in link.findall(tag)
        for geometry in element.findall("geometry")
        for solid in geometry
        if solid.tag in _SIZES
    ]


def _numbers(where: str, key: str, text: str, size: int) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != size or not all(abs(value) < 1e9 for value in values):
        raise BodyError(f"{where}: {key}: expected {size} numbers, found {shortened(text)}")
    return values


def _turn(rpy: list[float]) -> np.ndarray:
    """Roll, pitch, yaw about fixed axes."""
    (cr, cp, cy), (sr, sp, sy) = ([f(angle) for angle in rpy] for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
