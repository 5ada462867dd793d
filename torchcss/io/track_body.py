"""The body of a track: as plain data for its file, and back.

A file holds everything that the body was built of (joints, parts with their fitted shapes,
landmarks, ties), so that it needs neither the catalogue of that day nor the robot's file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from torchcss.body.catalog import BodySpecification, MarkerSpecification, PartSpecification
from torchcss.body.kinematics import JointSpecification
from torchcss.body.model import BodyModel


def body_to_plain(body: BodyModel) -> dict[str, Any]:
    """What JSON holds of a body: its specification with the shapes that it has, and its mesh."""
    shapes = body.part_shape.double().tolist()
    parts = tuple(
        replace(part, shape=tuple(shape))
        for part, shape in zip(body.specification.parts, shapes, strict=True)
    )
    rings, meridians = body.eta.shape
    plain = asdict(replace(body.specification, parts=parts))
    return {**plain, "rings": rings, "meridians": meridians}


def body_from_plain(plain: Mapping[str, Any]) -> BodyModel:
    """The body again, on the world's origin.

    Args:
        plain: From `body_to_plain`.

    Raises:
        KeyError, TypeError, ValueError: If it is not such a body.
    """
    entries = dict(plain)
    mesh = {name: int(entries.pop(name)) for name in ("rings", "meridians")}
    kinds = {"joints": JointSpecification, "parts": PartSpecification,
             "markers": MarkerSpecification}  # fmt: skip
    rows = {
        name: tuple(kind(**_with_tuples(row)) for row in entries.pop(name))
        for name, kind in kinds.items()
    }
    described: dict[str, Any] = {**_with_tuples(entries), **rows}
    return BodyModel(BodySpecification(**described), **mesh)


def _with_tuples(value: Any) -> Any:
    """JSON's lists as the tuples that they were."""
    if isinstance(value, dict):
        return {name: _with_tuples(entry) for name, entry in value.items()}
    return tuple(_with_tuples(entry) for entry in value) if isinstance(value, list) else value
