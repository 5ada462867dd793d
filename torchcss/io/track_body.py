"""The body of a track: as plain data for its file, and posed on the bases of its frames.

A file holds everything that the body was built of (joints, parts with their fitted shapes,
landmarks, ties), so that it needs neither the catalogue of that day nor the robot's file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.catalog import BodySpecification, MarkerSpecification, PartSpecification
from torchcss.body.kinematics import JointSpecification, TreePose
from torchcss.body.model import BodyModel, BodyPose


def on_origin(body: BodyModel) -> BodyModel:
    """The same body on the world's origin, float64 on the processor; the given one stays."""
    return body.with_base(torch.eye(3), torch.zeros(3)).to(dtype=torch.float64, device="cpu")


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


def pose_track(
    body: BodyModel, state: Float[Tensor, "*batch n"], base: Float[Tensor, "*batch 4 4"]
) -> BodyPose:
    """Pose a body on a base of its own in every item.

    Args:
        body: A body on the origin, as that of a `Track` is.
        state: States.
        base: Base transforms, in any frame.

    Returns:
        The poses in the frame of the base transforms.
    """
    pose = body.pose(state)
    turn, shift = base[..., None, :3, :3], base[..., None, :3, 3]
    omega = (turn @ pose.tree.omega[..., None])[..., 0]
    velocity = (turn @ pose.tree.velocity[..., None])[..., 0]
    tree = TreePose(
        turn @ pose.tree.rotation,
        (turn @ pose.tree.translation[..., None])[..., 0] + shift,
        omega,
        # The twist is taken at the origin, which moved away from the base by -shift.
        velocity + torch.linalg.cross(shift.expand_as(omega), omega),
    )
    return BodyPose(state, tree, (turn @ pose.joints[..., None])[..., 0] + shift)
