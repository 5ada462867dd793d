"""Kinematic trees: link poses and world twists for the evaluation of costs.

A tree is a set of links joined by joints of one degree of freedom. `KinematicTree.forward(q)` gives
the pose of every link, eq. 1 [IJRR] (the map A), and the world twist `(omega_j, v_j)` of every
joint: a point p carried by a link below joint j moves with `dp/dq_j = omega_j x p + v_j`.

pytorch-kinematics owns the chain (`torchcss.body.chain`): joints and links are in its order, and
`KinematicTree.link_poses` and `BodyModel.forward_kinematics` are its forward kinematics. `forward`
is the faster twin that the cost is evaluated with, tested against it on every body. Joints at the
same depth of the tree are turned together, in frames whose z axis is the joint's, so that a turn
mixes two columns. Numbers are laid out with the batch innermost, as runs that a processor streams
through; what is returned are views of that memory. Where no derivative is wanted, on a CPU, it is
one compiled call (`torchcss.body.kinematics_kernels`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.forward_ad import unpack_dual

from torchcss.body.chain import (
    JointSpecification,
    check_joints,
    joint_order,
    link_order,
    link_poses,
    make_chain,
    offset_matrix,
)
from torchcss.body.rotations import frame_along, frame_at
from torchcss.errors import BodyError, check_shape
from torchcss.kernels import compiler
from torchcss.kernels.checked import run

if TYPE_CHECKING:
    from torchcss.body.chain import Chain


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
        specifications: The joints that it was made of.
        joint_names: Names of the moving joints, depth first; the order of `q`.
        link_names: Names of the links; the order of axis `l`.
        ancestors: `[q l]`, True where the joint moves the link.
        joint_ancestors: `[q q]`, True at (i, j) where joint i moves joint j or i is j.
    """

    is_revolute: Tensor
    lower: Tensor
    upper: Tensor
    ancestors: Tensor
    joint_ancestors: Tensor
    joint_constant: Tensor
    joint_order: Tensor
    joint_place: Tensor
    parent_place: Tensor
    joint_above: Tensor
    link_constant: Tensor
    link_place: Tensor

    def __init__(self, joints: Sequence[JointSpecification]) -> None:
        super().__init__()
        check_joints(joints)
        self.specifications = tuple(joints)
        by_name = {joint.name: joint for joint in joints}
        self.joint_names = tuple(joint_order(joints))
        moving = [by_name[name] for name in self.joint_names]
        self.link_names = tuple(link_order(joints))
        parents = {joint.link: joint.parent for joint in joints}
        row_of = {joint.link: row for row, joint in enumerate(moving)}
        ancestors = torch.zeros(len(moving), len(self.link_names), dtype=torch.bool)
        for column, link in enumerate(self.link_names):
            above: str | None = link
            while above is not None:
                if above in row_of:
                    ancestors[row_of[above], column] = True
                above = parents[above]
        links = torch.tensor([self.link_names.index(joint.link) for joint in moving]).long()
        revolute = [joint.kind == "revolute" for joint in moving]
        self.register_buffer("is_revolute", torch.tensor(revolute, dtype=torch.bool))
        self.register_buffer("lower", torch.tensor([j.lower for j in moving], dtype=torch.float64))
        self.register_buffer("upper", torch.tensor([j.upper for j in moving], dtype=torch.float64))
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
            offset = offset_matrix(joint)
            if joint.parent is not None:
                offset = fixed[joint.parent] @ offset
            if joint.kind == "fixed":
                carrier[joint.link], fixed[joint.link] = above, offset
                continue
            aligned = frame_at(frame_along(joint.axis), np.zeros(3))
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
            found = [kinds[name] for name in names]
            self._levels.append(_Level(len(names), "revolute" in found, "prismatic" in found))
            within |= {name: position for position, name in enumerate(names)}

        def matrices(items: list[np.ndarray]) -> Tensor:
            return torch.from_numpy(np.stack(items) if items else np.zeros((0, 4, 4)))

        def indices(items: list[int]) -> Tensor:
            return torch.tensor(items, dtype=torch.long)

        self.register_buffer("joint_constant", matrices([constant[name] for name in order]))
        self.register_buffer("joint_order", indices([self.joint_names.index(n) for n in order]))
        self.register_buffer("joint_place", indices([place[name] for name in self.joint_names]))
        self.register_buffer("parent_place", indices([within[parent[name]] for name in order]))
        above = indices([place[parent[name]] for name in order])
        self.register_buffer("joint_above", above, persistent=False)
        self.register_buffer("link_constant", matrices([fixed[name] for name in self.link_names]))
        self.register_buffer(
            "link_place", indices([place[carrier[name]] for name in self.link_names])
        )

    @cached_property
    def chain(self) -> Chain:
        """The library's chain, for forward kinematics."""
        return make_chain(self.specifications)

    @property
    def num_joints(self) -> int:
        """Number of moving joints."""
        return len(self.joint_names)

    def link_index(self, name: str) -> int:
        """Position of a link on axis `l`.

        Raises:
            BodyError: If there is no such link.
        """
        if name not in self.link_names:
            raise BodyError(f"no link {name!r}; the links are {', '.join(self.link_names)}")
        return self.link_names.index(name)

    def link_poses(self, q: Float[Tensor, "*batch q"]) -> Float[Tensor, "*batch l 4 4"]:
        """Pose of every link in the tree's base frame, by pytorch-kinematics.

        Args:
            q: Joint values, radians and metres.
        """
        check_shape("q", q, self.num_joints)
        return link_poses(self.chain, q)

    def forward(
        self,
        q: Float[Tensor, "*batch q"],
        base: Float[Tensor, "3 4"] | None = None,
    ) -> TreePose:
        """Pose the tree.

        Args:
            q: Joint values, radians and metres.
            base: Axes and origin of the root link's frame in the world; None: the world's own.

        Returns:
            Link poses and joint twists in the world frame.
        """
        check_shape("q", q, self.num_joints)
        batch = q.shape[:-1]
        flat = q.reshape(batch.numel(), self.num_joints)
        base = torch.eye(3, 4).to(q) if base is None else base
        plain = base.dim() == 2 and _plain(base) is not None
        if plain and (values := _plain(flat)) is not None:
            posed = self._pose_links(values, base)
            return TreePose(*(torch.from_numpy(p.reshape(*batch, *p.shape[1:])) for p in posed))
        frames = self.frames(flat, base)
        links = _followed_by(frames[self.link_place], _innermost(self.link_constant, 3, len(flat)))
        parts = (links[:, :, :3], links[:, :, 3], *self.twists(frames))
        return TreePose(
            *(p.movedim(-1, 0).unflatten(0, batch) if batch else p[..., 0] for p in parts)
        )

    def _pose_links(self, q: np.ndarray, base: Tensor) -> tuple[np.ndarray, ...]:
        """What `TreePose` holds, by the compiled twin."""
        from torchcss.body.kinematics_kernels import Joints, pose_links

        turns = self.is_revolute[self.joint_order]
        constants = base, self.joint_constant, self.joint_above, self.joint_order, turns
        joints = (*constants, self.link_place, self.link_constant)
        (b, n), num_links = q.shape, len(self.link_names)
        shapes = (b, num_links, 3, 3), (b, num_links, 3), (b, n, 3), (b, n, 3)
        parts = tuple(np.empty(shape, q.dtype) for shape in shapes)
        arrays = Joints(*(part.contiguous().numpy() for part in joints))
        run(pose_links, q, arrays, np.empty((1 + n, 3, 4), q.dtype), *parts)
        return parts

    def frames(
        self,
        q: Float[Tensor, "b q"],
        base: Float[Tensor, "3 4"],
    ) -> Float[Tensor, "frames 3 4 b"]:
        """Axes and origin (the columns) of the base and of all moving joints, by depth.

        With `twists` and `points` this is what a cost of few points needs, without the poses of all
        links; the batch is innermost. For the arguments see `forward`.
        """
        constants = _innermost(self.joint_constant, 3, len(q))
        q = q.T[self.joint_order].contiguous()
        revolute = self.is_revolute[self.joint_order, None]
        angle, slide = torch.where(revolute, q, 0.0), torch.where(revolute, 0.0, q)[:, None, None]
        cosine, sine = angle.cos()[:, None, None], angle.sin()[:, None, None]
        sizes = [level.size for level in self._levels]
        parts = (self.parent_place, constants, cosine, sine, slide)
        frames = _innermost(base, 2, q.shape[1])[None].expand(1, 3, 4, q.shape[1])
        levels = [frames]
        for level, place, constant, c, s, d in zip(
            self._levels, *(part.split(sizes) for part in parts), strict=True
        ):
            x, y, z, t = _followed_by(frames[place], constant).chunk(4, dim=2)
            if level.turns:
                x, y = torch.addcmul(c * x, s, y), torch.addcmul(c * y, s, x, value=-1)
            if level.slides:
                t = torch.addcmul(t, d, z)
            frames = torch.cat([x, y, z, t], dim=2)
            levels.append(frames)
        return torch.cat(levels)

    def at_base(self, frames: Float[Tensor, "frames 3 4 b"]) -> TreePose:
        """The tree with the base in place of all links, from `frames`: enough for the lift."""
        # The lift needs no more of the links than a place near the body.
        parts = (frames[:1, :, :3], frames[:1, :, 3], *self.twists(frames))
        return TreePose(*(part.movedim(-1, 0) for part in parts))

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
        return _followed_by(frames[self.link_place[link]], place[:, :, None, None])[:, :, 0]


def _plain(q: Tensor) -> np.ndarray | None:
    """The numbers of a tensor for compiled code; None where its operations are to be followed."""
    if not compiler.AVAILABLE or q.device.type != "cpu" or torch.compiler.is_compiling():
        return None
    if (q.requires_grad and torch.is_grad_enabled()) or unpack_dual(q).tangent is not None:
        return None
    try:
        return q.detach().contiguous().numpy()
    except RuntimeError:  # a tensor inside a transform of torch.func has no memory
        return None


class _Level(NamedTuple):
    """Joints at the same depth: how many, and how they move."""

    size: int
    turns: bool
    slides: bool


def _innermost(constant: Tensor, axes: int, count: int) -> Float[Tensor, "*rest #b"]:
    """A constant as of a batch of so many; several trees, `[S 1 ...]`, have as many each."""
    if constant.dim() == axes:
        return constant[..., None]
    each = constant.flatten(0, -1 - axes)
    return each.repeat_interleave(count // len(each), 0).movedim(0, -1)


def _followed_by(
    frames: Float[Tensor, "m 3 4 b"], constant: Float[Tensor, "m 4 c #b"]
) -> Float[Tensor, "m 3 c b"]:
    """Frames times constant matrices, entry by entry.

    A matrix product would take as long, and round the same item differently in other batches.
    """
    rows, (first, *columns) = constant[:, None].unbind(2), frames.chunk(4, dim=2)
    product = first * rows[0]
    for column, row in zip(columns, rows[1:], strict=True):
        product = torch.addcmul(product, column, row)
    return product
