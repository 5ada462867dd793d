"""The body of a track: as plain data for its file, and back.

A file holds everything that the body was built of (joints, parts with their fitted shapes,
landmarks, ties), and the limits, priors and neighbours that it has now, so that it needs neither
the catalogue of that day nor the robot's file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor

from torchcss.body.catalog import BodySpecification, MarkerSpecification, PartSpecification
from torchcss.body.kinematics import JointSpecification
from torchcss.body.model import BodyModel
from torchcss.errors import BodyError

PARAMETER_NUMBERS = ("lower", "upper", "sticky_mean", "sticky_deviation", "motion_rate")
"""Numbers of every parameter that may have changed since the body was built."""


def body_to_plain(body: BodyModel) -> dict[str, Any]:
    """What JSON holds of a body: its specification, and what has changed since."""
    shapes = body.part_shape.double().tolist()
    parts = tuple(
        replace(part, shape=tuple(shape))
        for part, shape in zip(body.specification.parts, shapes, strict=True)
    )
    built_of = replace(body.specification, parts=parts, neighbours=body.neighbours)
    numbers = {name: getattr(body, name).double().tolist() for name in PARAMETER_NUMBERS}
    return {**asdict(built_of), "parameters": numbers}


def body_from_plain(plain: Mapping[str, Any]) -> BodyModel:
    """The body again, on the world's origin.

    Args:
        plain: From `body_to_plain`; files of earlier versions have no `parameters`,
            and the size of a mesh.

    Raises:
        KeyError, TypeError, ValueError: If it is not such a body.
    """
    entries = dict(plain)
    numbers = entries.pop("parameters", {})
    for name in ("rings", "meridians"):
        entries.pop(name, None)
    kinds = {"joints": JointSpecification, "parts": PartSpecification,
             "markers": MarkerSpecification}  # fmt: skip
    rows = {
        name: tuple(kind(**_with_tuples(row)) for row in entries.pop(name))
        for name, kind in kinds.items()
    }
    described: dict[str, Any] = {**_with_tuples(entries), **rows}
    body = BodyModel(BodySpecification(**described))
    set_numbers(body, {key: torch.tensor(row, dtype=torch.float64) for key, row in numbers.items()})
    return body


def set_numbers(body: BodyModel, numbers: Mapping[str, Tensor]) -> None:
    """Give a body other limits and priors, in place.

    Args:
        body: The body.
        numbers: Some of `PARAMETER_NUMBERS`, one number a parameter.

    Raises:
        BodyError: If they cannot be such.
    """
    for key, row in numbers.items():
        if key not in PARAMETER_NUMBERS:
            raise BodyError(f"{key}: expected one of {', '.join(PARAMETER_NUMBERS)}")
        if row.shape != (body.num_parameters,) or bool(row.isnan().any()):
            raise BodyError(
                f"{key}: expected {body.num_parameters} numbers, got {list(row.shape)} or one "
                "that is none"
            )
        body.register_buffer(key, row.to(body.tie))
    positive = torch.cat([body.sticky_deviation, body.motion_rate]) > 0
    if bool((body.lower > body.upper).any()) or not bool(positive.all()):
        raise BodyError("expected lower <= upper, positive sticky_deviation and motion_rate")


def _with_tuples(value: Any) -> Any:
    """JSON's lists as the tuples that they were."""
    if isinstance(value, dict):
        return {name: _with_tuples(entry) for name, entry in value.items()}
    return tuple(_with_tuples(entry) for entry in value) if isinstance(value, list) else value
