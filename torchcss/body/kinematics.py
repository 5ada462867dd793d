"""Kinematic trees: link poses and world twists, the only user of pytorch-kinematics.

A tree is a set of links joined by joints of one degree of freedom. `KinematicTree.forward(q)` gives
the pose of every link, eq. 1 [IJRR] (the map A), and the world twist `(omega_j, v_j)` of every
joint: a point p carried by a link below joint j moves with `dp/dq_j = omega_j x p + v_j`.

Trees come from a list of `JointSpecification` (the catalogue of bodies does that) or from any URDF
file. pytorch-kinematics reads the files and puts joints and links in order; nobody else calls it.
The poses are computed here: it takes one joint after the other, and its default backward pass drops
the second-order terms. Joints at the same depth of the tree are turned together instead, in frames
whose z axis is the joint's, so that a turn mixes two columns. Numbers are laid out with the batch
innermost, as runs that a processor streams through; what is returned are views of that memory.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytorch_kinematics as pk
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchcss.errors import BodyError, ShapeError, check_shape
from torchcss.files import read_bytes
from torchcss.types import Bounds

_MOVING = ("revolute", "prismatic")
_FAR = 1e6
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
    joint_constant: Tensor
    joint_order: Tensor
    joint_place: Tensor
    parent_place: Tensor
    link_constant: Tensor
    link_place: Tensor

    def __init__(self, joints: Sequence[JointSpecification]) -> None:
        super().__init__()
        _check_specifications(joints)
        self.specifications = tuple(joints)
        chain = pk.Chain(_build_frames(joints), dtype=torch.float64)
        by_name = {joint.name: joint for joint in joints}
        self.joint_names = tuple(chain.get_joint_parameter_names())
        moving = [by_name[name] for name in self.joint_names]
        index = chain.frame_to_idx
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
        self._lay_out_levels()

    def _lay_out_levels(self) -> None:
        """Sort the moving joints by depth, and fold what is fixed between them into constants.

        The frame of a moving joint is that of the joint above times a constant, turned about its z
        axis or shifted along it. A link's frame is that of the nearest moving joint above it times
        a constant. Place 0 of the frames is the base.
        """
        # Per link: the moving joint that carries it (None: the base) and its frame in that joint's.
        carrier: dict[str, str | None] = {}
        fixed: dict[str, np.ndarray] = {}
        parent: dict[str, str | None] = {}
        depth: dict[str, int] = {}
        constant: dict[str, np.ndarray] = {}
        for joint in self.specifications:
            above = None if joint.parent is None else carrier[joint.parent]
            offset = _offset_matrix(joint)
            if joint.parent is not None:
                offset = fixed[joint.parent] @ offset
            if joint.kind == "fixed":
                carrier[joint.link], fixed[joint.link] = above, offset
                continue
            aligned = _frame_along(joint.axis)
            carrier[joint.link], fixed[joint.link] = joint.name, aligned.T
            parent[joint.name], constant[joint.name] = above, offset @ aligned
            depth[joint.name] = 1 if above is None else depth[above] + 1
        order = sorted(self.joint_names, key=lambda name: depth[name])
        place: dict[str | None, int] = {None: 0}
        place |= {name: 1 + position for position, name in enumerate(order)}
        within: dict[str | None, int] = {None: 0}  # place within the joint's own depth
        kinds = {joint.name: joint.kind for joint in self.specifications}
        self._levels: list[_Level] = []
        for level in range(1, 1 + max(depth.values(), default=0)):
            names = [name for name in order if depth[name] == level]
            self._levels.append(
                _Level(
                    size=len(names),
                    turns=any(kinds[name] == "revolute" for name in names),
                    slides=any(kinds[name] == "prismatic" for name in names),
                )
            )
            within |= {name: position for position, name in enumerate(names)}

        def matrices(items: list[np.ndarray]) -> Tensor:
            return torch.from_numpy(np.stack(items) if items else np.zeros((0, 4, 4)))

        def indices(items: list[int]) -> Tensor:
            return torch.tensor(items, dtype=torch.long)

        self.register_buffer("joint_constant", matrices([constant[name] for name in order]))
        self.register_buffer("joint_order", indices([self.joint_names.index(n) for n in order]))
        self.register_buffer("joint_place", indices([place[name] for name in self.joint_names]))
        self.register_buffer("parent_place", indices([within[parent[name]] for name in order]))
        self.register_buffer("link_constant", matrices([fixed[name] for name in self.link_names]))
        self.register_buffer(
            "link_place", indices([place[carrier[name]] for name in self.link_names])
        )

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
        data = read_bytes(path, BodyError)
        specifications = _read_urdf(data, str(path))
        try:
            return cls(specifications)
        except BodyError as error:
            raise BodyError(f"{path}: {error}") from error

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
        rotation, translation, _, _ = self.forward(q)
        return rotation, translation

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
        check_shape("q", q, self.num_joints)
        batch = q.shape[:-1]
        flat = q.reshape(batch.numel(), self.num_joints)
        frames = self.frames(flat, base_rotation, base_translation)
        links = _followed_by(frames[self.link_place], self.link_constant)
        parts = (links[:, :, :3], links[:, :, 3], *self.twists(frames))
        return TreePose(
            *(p.movedim(-1, 0).unflatten(0, batch) if batch else p[..., 0] for p in parts)
        )

    def frames(
        self,
        q: Float[Tensor, "b q"],
        base_rotation: Float[Tensor, "3 3"] | None = None,
        base_translation: Float[Tensor, "3"] | None = None,
    ) -> Float[Tensor, "frames 3 4 b"]:
        """Axes and origin (the columns) of the base and of all moving joints, by depth.

        With `twists` and `points` this is what a cost of few points needs, without the poses of all
        links; the batch is innermost. For the arguments see `forward`.
        """
        if q.dtype != self.axes.dtype:
            raise ShapeError(
                f"the state is {q.dtype} and the body {self.axes.dtype}: convert one, "
                "for example with body.to(x.dtype)"
            )
        base = torch.eye(3, 4, dtype=q.dtype, device=q.device)
        if base_rotation is not None:
            base = torch.cat([base_rotation.to(q), base[:, 3:]], dim=1)
        if base_translation is not None:
            base = torch.cat([base[:, :3], base_translation.to(q)[:, None]], dim=1)
        q = q.T[self.joint_order].contiguous()
        revolute = self.is_revolute[self.joint_order, None]
        angle, slide = torch.where(revolute, q, 0.0), torch.where(revolute, 0.0, q)[:, None, None]
        cosine, sine = angle.cos()[:, None, None], angle.sin()[:, None, None]
        sizes = [level.size for level in self._levels]
        parts = (self.parent_place, self.joint_constant, cosine, sine, slide)
        frames = base[None, :, :, None].expand(1, 3, 4, q.shape[1])
        levels = [frames]
        for level, place, constant, c, s, d in zip(
            self._levels, *(part.split(sizes) for part in parts), strict=True
        ):
            x, y, z, t = _followed_by(frames[place], constant).split(1, dim=2)
            if level.turns:
                x, y = torch.addcmul(c * x, s, y), torch.addcmul(c * y, s, x, value=-1)
            if level.slides:
                t = torch.addcmul(t, d, z)
            frames = torch.cat([x, y, z, t], dim=2)
            levels.append(frames)
        return torch.cat(levels)

    def twists(
        self, frames: Float[Tensor, "frames 3 4 b"]
    ) -> tuple[Float[Tensor, "q 3 b"], Float[Tensor, "q 3 b"]]:
        """Angular and linear parts of the joints' twists in the world, from `frames`."""
        joints = frames[self.joint_place]
        axis, origin = joints[:, :, 2], joints[:, :, 3]
        x, y, z = axis.unbind(1)
        a, b, c = origin.unbind(1)
        moment = torch.stack([b * z - c * y, c * x - a * z, a * y - b * x], dim=1)
        revolute = self.is_revolute[:, None, None]
        return torch.where(revolute, axis, 0.0), torch.where(revolute, moment, axis)

    def points(
        self,
        frames: Float[Tensor, "frames 3 4 b"],
        link: Int[Tensor, " p"],
        offset: Float[Tensor, "p 3"],
    ) -> Float[Tensor, "p 3 b"]:
        """World positions of points that are fixed in links, from `frames`.

        Args:
            frames: From `frames`.
            link: Link of each point.
            offset: Position in that link's frame, metres.
        """
        constant = self.link_constant[link]
        place = (constant[:, :, :3] * offset[:, None, :]).sum(-1) + constant[:, :, 3]
        return _followed_by(frames[self.link_place[link]], place[:, :, None])[:, :, 0]


class _Level(NamedTuple):
    """Joints at the same depth: how many, and how they move."""

    size: int
    turns: bool
    slides: bool


def _followed_by(
    frames: Float[Tensor, "m 3 4 b"], constant: Float[Tensor, "m 4 c"]
) -> Float[Tensor, "m 3 c b"]:
    """Frames times constant matrices, entry by entry.

    A matrix product would take as long, and round the same item differently in other batches.
    """
    rows = constant[:, None, :, :, None].unbind(2)
    product = frames[:, :, :1] * rows[0]
    for column, row in zip(frames[:, :, 1:].split(1, dim=2), rows[1:], strict=True):
        product = torch.addcmul(product, column, row)
    return product


def _offset_matrix(joint: JointSpecification) -> np.ndarray:
    """Where a joint sits in the link above, 4 x 4, its rotation made orthonormal."""
    left, _, right = np.linalg.svd(np.asarray(joint.rotation, dtype=np.float64))
    matrix = np.eye(4)
    matrix[:3, :3] = left @ right
    matrix[:3, 3] = joint.translation
    return matrix


def _frame_along(axis: Sequence[float]) -> np.ndarray:
    """A rotation, 4 x 4, whose third column is the direction of an axis."""
    z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return matrix


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
        # Beyond this nothing is a body's, and squares would overflow.
        far = not (np.abs(numbers) < _FAR).all()
        if far or (joint.kind != "fixed" and np.linalg.norm(joint.axis) < 1 / _FAR):
            raise BodyError(
                f"joint {joint.name!r}: origin and axis must be finite, below {_FAR:g} metres, and "
                "the axis not zero"
            )
        if not joint.lower <= joint.upper:
            raise BodyError(f"joint {joint.name!r}: lower limit {joint.lower} > {joint.upper}")
        seen.add(joint.link)


def _build_frames(joints: Sequence[JointSpecification]) -> pk.Frame:
    frames: dict[str, pk.Frame] = {}
    root = None
    for joint in joints:
        matrix = torch.from_numpy(_offset_matrix(joint))
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
