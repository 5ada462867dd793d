"""Kinematic trees: link poses and world twists, the only user of pytorch-kinematics.

A tree is a set of links joined by joints of one degree of freedom. `KinematicTree.forward(q)` gives
the pose of every link, eq. 1 [IJRR] (the map A), and the world twist `(omega_j, v_j)` of every
joint: a point p carried by a link below joint j moves with `dp/dq_j = omega_j x p + v_j`.

Trees come from a list of `JointSpecification` (the catalogue of bodies does that) or from any URDF
file. pytorch-kinematics reads URDF numbers through float32, and its default backward pass drops the
second-order terms; both are mended here, once, and nobody else calls it.
"""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytorch_kinematics as pk
import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchcss.errors import BodyError, ShapeError, check_shape
from torchcss.types import Bounds

_MOVING = ("revolute", "prismatic")
_URDF_TYPES = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
    "fixed": "fixed",
}


@dataclass(frozen=True, kw_only=True)
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


class TreePose(NamedTuple):
    """Poses of all links and twists of all joints for a batch of joint values, world frame.

    Attributes:
        rotation: Orientation of each link.
        translation: Origin of each link, metres.
        omega: Angular part of the joints' twists (zero for prismatic joints).
        velocity: Linear part, the velocity of the point at the world origin.
    """

    rotation: Float[Tensor, "*batch l 3 3"]
    translation: Float[Tensor, "*batch l 3"]
    omega: Float[Tensor, "*batch q 3"]
    velocity: Float[Tensor, "*batch q 3"]


class KinematicTree(nn.Module):
    """A tree of links; constant tensors are buffers, verbs are pure.

    Args:
        joints: The joints, parents before children; exactly one entry has no parent (the root).

    Raises:
        BodyError: On duplicate names, unknown parents or kinds, loops, or zero axes.

    Attributes:
        joint_names: Names of the moving joints, depth first; the order of `q`.
        link_names: Names of the links; the order of axis `l`.
        ancestors: `[q l]`, True where the joint moves the link.
        joint_ancestors: `[q q]`, True at (i, j) where joint i moves joint j or i is j.
    """

    axes: Tensor
    is_revolute: Tensor
    lower: Tensor
    upper: Tensor
    joint_link: Tensor
    ancestors: Tensor
    joint_ancestors: Tensor

    def __init__(self, joints: Sequence[JointSpecification]) -> None:
        super().__init__()
        _check_specifications(joints)
        self.specifications = tuple(joints)
        self._master = pk.Chain(_build_frames(joints), dtype=torch.float64)
        self._chains: dict[tuple[torch.dtype, torch.device], pk.Chain] = {}
        by_name = {joint.name: joint for joint in joints}
        self.joint_names = tuple(self._master.get_joint_parameter_names())
        moving = [by_name[name] for name in self.joint_names]
        index = self._master.frame_to_idx
        self.link_names = tuple(sorted(index, key=lambda name: index[name]))
        parents = {joint.link: joint.parent for joint in joints}
        ancestors = torch.zeros(len(moving), len(self.link_names), dtype=torch.bool)
        for column, link in enumerate(self.link_names):
            above: str | None = link
            while above is not None:
                for row, joint in enumerate(moving):
                    ancestors[row, column] |= joint.link == above
                above = parents[above]
        links = torch.tensor([self.link_names.index(joint.link) for joint in moving]).long()
        axes = torch.tensor([joint.axis for joint in moving], dtype=torch.float64).reshape(-1, 3)
        self.register_buffer("axes", axes / axes.norm(dim=-1, keepdim=True))
        revolute = [joint.kind == "revolute" for joint in moving]
        self.register_buffer("is_revolute", torch.tensor(revolute, dtype=torch.bool))
        self.register_buffer("lower", torch.tensor([j.lower for j in moving], dtype=torch.float64))
        self.register_buffer("upper", torch.tensor([j.upper for j in moving], dtype=torch.float64))
        self.register_buffer("joint_link", links)
        self.register_buffer("ancestors", ancestors)
        self.register_buffer("joint_ancestors", ancestors[:, links])

    @classmethod
    def from_urdf(cls, source: str | Path) -> KinematicTree:
        """Load the kinematics of a URDF file; meshes and inertias are ignored.

        Args:
            source: Path of the file.

        Raises:
            BodyError: If the file cannot be read, is no URDF, has joints of more than one degree of
                freedom, duplicate names, or more than one root link.
        """
        path = Path(source)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise BodyError(f"{path}: cannot read the URDF ({error.strerror})") from error
        return cls(_read_urdf(data, str(path)))

    @property
    def num_joints(self) -> int:
        """Number of moving joints."""
        return len(self.joint_names)

    @property
    def bounds(self) -> Bounds:
        """Joint limits; infinite where a joint has none."""
        return Bounds(self.lower, self.upper)

    def link_index(self, name: str) -> int:
        """Position of a link on axis `l`.

        Raises:
            BodyError: If there is no such link.
        """
        if name not in self.link_names:
            raise BodyError(f"no link {name!r}; the links are {', '.join(self.link_names)}")
        return self.link_names.index(name)

    def link_poses(
        self, q: Float[Tensor, "*batch q"]
    ) -> tuple[Float[Tensor, "*batch l 3 3"], Float[Tensor, "*batch l 3"]]:
        """Orientation and origin of every link in the tree's base frame; twice differentiable."""
        check_shape("q", q, self.num_joints)
        batch = q.shape[:-1]
        chain = self._chain(q)
        # The analytical backward of pytorch-kinematics treats the poses as constants in a second
        # derivative; plain autograd through its forward pass does not.
        transforms = chain.forward_kinematics_tensor(
            q.reshape(batch.numel(), self.num_joints), analytical_grad=False
        )
        transforms = transforms.movedim(0, 1).reshape(*batch, len(self.link_names), 4, 4)
        return transforms[..., :3, :3], transforms[..., :3, 3]

    def forward(
        self,
        q: Float[Tensor, "*batch q"],
        base_rotation: Float[Tensor, "3 3"] | None = None,
        base_translation: Float[Tensor, "3"] | None = None,
    ) -> TreePose:
        """Pose the tree.

        Args:
            q: Joint values, radians and metres.
            base_rotation: Orientation of the root link's frame in the world.
            base_translation: Origin of the root link's frame in the world, metres.

        Returns:
            Link poses and joint twists in the world frame.
        """
        rotation, translation = self.link_poses(q)
        if base_rotation is not None:
            rotation = base_rotation @ rotation
            translation = translation @ base_rotation.T
        if base_translation is not None:
            translation = translation + base_translation
        axis = torch.einsum("...qab,qb->...qa", rotation[..., self.joint_link, :, :], self.axes)
        origin = translation[..., self.joint_link, :]
        revolute = self.is_revolute[:, None]
        velocity = torch.where(revolute, torch.linalg.cross(origin, axis), axis)
        omega = torch.where(revolute, axis, torch.zeros_like(axis))
        return TreePose(rotation, translation, omega, velocity)

    def _chain(self, q: Tensor) -> pk.Chain:
        if q.dtype != self.axes.dtype:
            raise ShapeError(
                f"the state is {q.dtype} and the body {self.axes.dtype}: convert one, "
                "for example with body.to(x.dtype)"
            )
        key = (q.dtype, q.device)
        if key not in self._chains:
            self._chains[key] = copy.deepcopy(self._master).to(dtype=q.dtype, device=q.device)
        return self._chains[key]


def _check_specifications(joints: Sequence[JointSpecification]) -> None:
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
        if joint.kind not in (*_MOVING, "fixed"):
            raise BodyError(
                f"joint {joint.name!r} is of type {joint.kind!r}; supported are revolute, "
                "continuous, prismatic and fixed (split others into joints of one axis)"
            )
        numbers = np.concatenate([np.ravel(joint.rotation), joint.translation, joint.axis])
        if not np.isfinite(numbers).all() or (joint.kind != "fixed" and not np.any(joint.axis)):
            raise BodyError(
                f"joint {joint.name!r}: origin and axis must be finite and the axis not zero"
            )
        if not joint.lower <= joint.upper:
            raise BodyError(f"joint {joint.name!r}: lower limit {joint.lower} > {joint.upper}")
        seen.add(joint.link)


def _build_frames(joints: Sequence[JointSpecification]) -> pk.Frame:
    frames: dict[str, pk.Frame] = {}
    root = None
    for joint in joints:
        left, _, right = np.linalg.svd(np.asarray(joint.rotation, dtype=np.float64))
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] = torch.from_numpy(left @ right)
        matrix[:3, 3] = torch.tensor(joint.translation, dtype=torch.float64)
        frame = pk.Frame(
            joint.link,
            link=pk.frame.Link(joint.link),
            joint=pk.frame.Joint(
                joint.name,
                offset=pk.Transform3d(matrix=matrix[None], dtype=torch.float64),
                joint_type=joint.kind,
                axis=joint.axis,
                dtype=torch.float64,
            ),
        )
        frames[joint.link] = frame
        if joint.parent is None:
            root = frame
        else:
            frames[joint.parent].add_child(frame)
    assert root is not None
    return root


def _read_urdf(data: bytes, name: str) -> list[JointSpecification]:
    try:
        xml = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise BodyError(f"{name}: not a URDF, the XML does not parse ({error})") from error
    if xml.tag != "robot" or xml.find("link") is None:
        raise BodyError(f"{name}: not a URDF, expected <robot> with links, found <{xml.tag}>")
    elements = {element.get("name", ""): element for element in xml.findall("joint")}
    if len(elements) != len(xml.findall("joint")):
        raise BodyError(f"{name}: two joints have the same name, or one has none")
    for joint_name, element in elements.items():
        if element.get("type") not in _URDF_TYPES:
            raise BodyError(
                f"{name}: joint {joint_name!r} is of type {element.get('type')!r}; supported are "
                f"{', '.join(_URDF_TYPES)} (split others into joints of one axis)"
            )
    children = [_child(element, "child", name) for element in elements.values()]
    parents = [_child(element, "parent", name) for element in elements.values()]
    links = [link.get("name", "") for link in xml.findall("link")]
    unknown = {*children, *parents} - set(links)
    if unknown:
        raise BodyError(f"{name}: joints name links that do not exist: {sorted(unknown)}")
    if len(set(children)) != len(children) or len(set(links)) != len(links):
        raise BodyError(f"{name}: a link occurs twice, or hangs on two joints")
    reached = [link for link in links if link not in children]
    if len(reached) != 1:
        raise BodyError(f"{name}: expected exactly one root link, found {sorted(reached)}")
    for link in reached:  # grows while it is walked: breadth first
        reached += [below for below, above in zip(children, parents, strict=True) if above == link]
    if len(reached) != len(links):
        raise BodyError(f"{name}: the links {sorted(set(links) - set(reached))} form a loop")
    if not elements:
        return [JointSpecification(name="root", link=links[0], parent=None)]
    try:
        chain = pk.build_chain_from_urdf(ElementTree.tostring(_kinematics_only(xml)))
    except Exception as error:  # the parser raises many kinds, all of them mean a bad file
        reason = " ".join(str(error).split())
        raise BodyError(f"{name}: pytorch-kinematics cannot read this URDF ({reason})") from error

    specifications: list[JointSpecification] = []

    def visit(frame: pk.Frame, parent: str | None) -> None:
        element = elements.get(frame.joint.name or "")
        link_offset, joint_offset = frame.link.offset, frame.joint.offset
        matrix = torch.eye(4, dtype=torch.float64)
        for offset in (link_offset, joint_offset):
            if offset is not None:
                matrix = matrix @ offset.get_matrix()[0].double()
        axis = tuple(frame.joint.axis.double().tolist())
        if element is not None and element.find("axis") is None:
            axis = (1.0, 0.0, 0.0)  # the URDF's default; pytorch-kinematics takes z
        lower, upper = _limits(element, name)
        specifications.append(
            JointSpecification(
                name=frame.joint.name or "root",
                link=frame.name,
                parent=parent,
                kind=frame.joint.joint_type,
                translation=tuple(matrix[:3, 3].tolist()),
                rotation=tuple(tuple(row) for row in matrix[:3, :3].tolist()),
                axis=axis,
                lower=lower,
                upper=upper,
                mimic=_mimic(element, name),
            )
        )
        for child in frame.children:
            visit(child, frame.name)

    visit(chain._root, None)
    return specifications


def _kinematics_only(xml: ElementTree.Element) -> ElementTree.Element:
    """The robot without meshes, inertias and limits, which the parser would only stumble over."""
    robot = ElementTree.Element("robot", name="robot")
    for link in xml.findall("link"):
        ElementTree.SubElement(robot, "link", name=link.get("name", ""))
    for joint in xml.findall("joint"):
        bare = ElementTree.SubElement(robot, "joint", dict(joint.attrib))
        # Files often give fixed joints the axis 0 0 0.
        wanted = ("parent", "child", "origin", "axis")[: 3 if joint.get("type") == "fixed" else 4]
        bare.extend(part for part in joint if part.tag in wanted)
    return robot


def _child(element: ElementTree.Element, tag: str, name: str) -> str:
    child = element.find(tag)
    if child is None or not child.get("link"):
        raise BodyError(f"{name}: joint {element.get('name')!r} has no <{tag} link=...>")
    return child.get("link", "")


def _limits(element: ElementTree.Element | None, name: str) -> tuple[float, float]:
    limit = None if element is None else element.find("limit")
    if element is None or limit is None or element.get("type") == "continuous":
        return -math.inf, math.inf
    if limit.get("lower") is None and limit.get("upper") is None:
        return -math.inf, math.inf
    try:
        return float(limit.get("lower", 0.0)), float(limit.get("upper", 0.0))
    except ValueError as error:
        raise BodyError(f"{name}: joint {element.get('name')!r}: {error}") from error


def _mimic(element: ElementTree.Element | None, name: str) -> tuple[str, float, float] | None:
    mimic = None if element is None else element.find("mimic")
    if element is None or mimic is None:
        return None
    try:
        multiplier = float(mimic.get("multiplier", 1.0))
        offset = float(mimic.get("offset", 0.0))
    except ValueError as error:
        raise BodyError(f"{name}: joint {element.get('name')!r}: {error}") from error
    if not (math.isfinite(multiplier) and math.isfinite(offset) and multiplier != 0):
        raise BodyError(
            f"{name}: joint {element.get('name')!r} mimics with multiplier {multiplier} and offset "
            f"{offset}; expected finite numbers and a multiplier that is not zero"
        )
    return mimic.get("joint", ""), multiplier, offset
