"""The chain of a body: its joints in order, and forward kinematics, by pytorch-kinematics.

This is the only module that knows the library, which is imported where it is first used: it takes
a second. `make_chain` builds its `Chain` from a list of `JointSpecification`; `link_poses` is
forward kinematics for any leading shape. The evaluation of costs has kinematics of its own, the
faster twin of these: `torchcss.body.kinematics`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.rotations import frame_at
from torchcss.errors import BodyError
from torchcss.types import frozen

if TYPE_CHECKING:
    from pytorch_kinematics import Chain

_FAR = 1e6
"""Metres beyond which nothing is a body's, and squares would overflow."""


@frozen
class JointSpecification:
    """One joint and the link below it.

    Attributes:
        name: Name of the joint.
        link: Name of the link that the joint carries.
        parent: Name of the link above, or None for the root link's own entry.
        kind: "revolute", "prismatic" or "fixed".
        translation: Origin of the joint in the parent link's frame, metres.
        rotation: Orientation of the joint frame in the parent link's frame, 3 x 3.
        axis: Joint axis in the joint frame.
        lower: Least value (radians or metres); `-inf` if there is none.
        upper: Greatest value; `inf` if there is none.
        mimic: `(joint, multiplier, offset)` when the joint only follows another one.
    """

    name: str
    link: str
    parent: str | None
    kind: str = "fixed"
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[tuple[float, ...], ...] = ((1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0))
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    lower: float = -math.inf
    upper: float = math.inf
    mimic: tuple[str, float, float] | None = None


def make_chain(joints: Sequence[JointSpecification]) -> Chain:
    """The library's chain of some joints, in double precision.

    Args:
        joints: Joints that `check_joints` accepts.

    Raises:
        BodyError: If the links hang on each other hundreds deep.
    """
    import pytorch_kinematics as pk

    frames: dict[str | None, pk.Frame] = {}
    for joint in joints:
        matrix = torch.from_numpy(offset_matrix(joint))
        axis = np.array(joint.axis)
        frame = pk.Frame(
            joint.link,
            link=pk.frame.Link(joint.link),
            joint=pk.frame.Joint(
                joint.name,
                offset=pk.Transform3d(matrix=matrix[None], dtype=torch.float64),
                joint_type=joint.kind,
                axis=axis / max(np.linalg.norm(axis), 1 / _FAR),
                dtype=torch.float64,
            ),
        )
        frames[joint.link] = frame
        if joint.parent is None:
            frames[None] = frame
        else:
            frames[joint.parent].add_child(frame)
    try:
        return pk.Chain(frames[None], dtype=torch.float64)
    except RecursionError as error:
        raise BodyError("links hundreds deep; expected a body or a robot") from error


def link_order(joints: Sequence[JointSpecification]) -> list[str]:
    """The links breadth first: the order of the chain's frames."""
    order = [joint.link for joint in joints if joint.parent is None]
    for link in order:
        order += [joint.link for joint in joints if joint.parent == link]
    return order


def joint_order(joints: Sequence[JointSpecification]) -> list[str]:
    """The moving joints depth first: the order of the chain's parameters."""
    order: list[JointSpecification] = []
    ahead = [joint for joint in joints if joint.parent is None]
    while ahead:
        order.append(ahead.pop(0))
        ahead = [joint for joint in joints if joint.parent == order[-1].link] + ahead
    return [joint.name for joint in order if joint.kind != "fixed"]


def link_poses(chain: Chain, q: Float[Tensor, "*batch q"]) -> Float[Tensor, "*batch l 4 4"]:
    """Pose of every link in the frame of the root, in the order of the chain's frames.

    Args:
        chain: From `make_chain`.
        q: Joint values, radians and metres, in the order of the chain's parameters.
    """
    if chain.device != q.device:
        chain.to(device=q.device)
    batch = q.shape[:-1]
    flat = q.reshape(batch.numel(), q.shape[-1]).double()
    # The library's quicker backward pass, its default, drops the second-order terms.
    poses = chain.forward_kinematics_tensor(flat, analytical_grad=False)
    return poses.movedim(1, 0).unflatten(0, batch).to(q) if batch else poses[:, 0].to(q)


def offset_matrix(joint: JointSpecification) -> Float[np.ndarray, "4 4"]:
    """Where a joint sits in the link above, its rotation made orthonormal."""
    left, _, right = np.linalg.svd(np.asarray(joint.rotation, dtype=np.float64))
    return frame_at(left @ right, joint.translation)


def check_joints(joints: Sequence[JointSpecification]) -> None:
    """Check that joints make one tree that can be computed with.

    Args:
        joints: The joints, parents before children; exactly one entry has no parent (the root).

    Raises:
        BodyError: On duplicate names, unknown parents or kinds, loops, or zero axes.
    """
    names = [joint.name for joint in joints if joint.parent is not None]
    links = [joint.link for joint in joints]
    for what, values in (("joint", names), ("link", links)):
        duplicates = sorted({value for value in values if values.count(value) > 1})
        if duplicates:
            raise BodyError(f"{what} names must be unique; repeated: {', '.join(duplicates)}")
    roots = [joint.link for joint in joints if joint.parent is None]
    if len(roots) != 1:
        raise BodyError(f"expected exactly one root link, found {len(roots)}: {', '.join(roots)}")
    seen: set[str] = set()
    for joint in joints:
        if joint.parent is not None and joint.parent not in seen:
            raise BodyError(
                f"joint {joint.name!r} hangs on link {joint.parent!r}, which does not come before "
                "it: the links must form one tree"
            )
        if joint.kind not in ("revolute", "prismatic", "fixed"):
            raise BodyError(
                f"joint {joint.name!r} is of type {joint.kind!r}; supported are revolute, "
                "continuous, prismatic, fixed, and floating at the root (split others into joints "
                "of one axis)"
            )
        numbers = np.concatenate([np.ravel(joint.rotation), joint.translation, joint.axis])
        far = not (np.abs(numbers) < _FAR).all()
        if far or (joint.kind != "fixed" and np.linalg.norm(joint.axis) < 1 / _FAR):
            raise BodyError(
                f"joint {joint.name!r}: origin and axis must be finite, below {_FAR:g} metres, and "
                "the axis not zero"
            )
        if not joint.lower <= joint.upper:
            raise BodyError(f"joint {joint.name!r}: lower limit {joint.lower} > {joint.upper}")
        seen.add(joint.link)
