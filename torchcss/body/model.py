"""BodyModel: tree, parts and state layout in one object; the map from x to 3D of eq. 1 [IJRR].

A state x is a vector of named parameters. It drives the joints through a linear tie `q = q0 + E x`
(left-right symmetry, mimic joints). `pose(x)` gives link poses and joint centres, `surface(pose)`
the mesh nodes, and `lift` turns derivatives at 3D points into gradient and exact Hessian in x (see
`torchcss.body.lift`). `torchcss.load_body` makes one by name or from a URDF, MJCF or BVH file.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchcss.body.catalog import BODY_NAMES, BodySpecification, motion_rate
from torchcss.body.kinematics import KinematicTree, TreePose
from torchcss.body.lift import lift_to_joints
from torchcss.body.rotations import check_rotation
from torchcss.body.surface import SurfaceSample, angular_grid, surface_points
from torchcss.errors import BodyError, ShapeError, check_floating, check_shape
from torchcss.types import Bounds, Curvature, LocalModel, PointCost, Vector, Vectors


class BodyPose(NamedTuple):
    """A posed body, world frame.

    Attributes:
        x: The state.
        tree: Link poses and joint twists.
        joints: Positions of the named joint centres, metres.
    """

    x: Vectors
    tree: TreePose
    joints: Float[Tensor, "*batch j 3"]


class BodyModel(nn.Module):
    """An articulated body of superquadric parts, in the type and on the device of its buffers.

    Args:
        body: Rows of the catalogue, or a specification made from a file.

    Attributes:
        name: Name of the body, for a body from a file its path: `load_body(name)` makes it again.
        specification: What it was built of; `part_shape` may have changed since.
        notes: What was assumed when it was read from a file, one line each.
        state_names: Names of the parameters, the order of x.
        joint_names: Names of the joint centres, the order of `BodyPose.joints`.
        part_names: Names of the parts.
        lengths: Lengths that the body was built with, metres.
        base_rotation: Orientation of the root link in the world (decision "root").
        base_translation: Origin of the root link in the world, metres.
    """

    tie: Tensor
    offset: Tensor
    lower: Tensor
    upper: Tensor
    marker_link: Tensor
    marker_offset: Tensor
    part_link: Tensor
    part_rotation: Tensor
    part_translation: Tensor
    part_shape: Tensor
    sticky_mean: Tensor
    sticky_deviation: Tensor
    motion_rate: Tensor
    base_rotation: Tensor
    base_translation: Tensor

    def __init__(self, body: BodySpecification) -> None:
        super().__init__()
        self.name = body.name
        self.specification = body
        self.lengths = dict(body.lengths)
        self.tree = KinematicTree(body.joints)
        self.neighbours = body.neighbours
        self.notes = body.notes
        self._lay_out_state(body)
        self.joint_names = tuple(marker.name for marker in body.markers)
        self.part_names = tuple(part.name for part in body.parts)
        repeated = sorted({name for name in self.part_names if self.part_names.count(name) > 1})
        if repeated:
            raise BodyError(f"part names must be unique; repeated: {', '.join(repeated)}")
        for name, rows in (("marker_link", body.markers), ("part_link", body.parts)):
            links = [self.tree.link_index(row.link) for row in rows]
            self.register_buffer(name, torch.tensor(links).long())
        self._register("marker_offset", [marker.translation for marker in body.markers], 3)
        self._register("part_rotation", [part.rotation for part in body.parts], 3, 3)
        self._register("part_translation", [part.translation for part in body.parts], 3)
        self._register("part_shape", [part.shape for part in body.parts], 9)
        self.register_buffer("base_rotation", torch.eye(3, dtype=torch.float64))
        self.register_buffer("base_translation", torch.zeros(3, dtype=torch.float64))
        # By their sizes, with the shape that they are of: copies on other bases share them.
        self._meshes: dict[tuple[int, int], tuple[Tensor, SurfaceSample]] = {}

    def _register(self, name: str, rows: Sequence[Any], *shape: int) -> None:
        """Keep rows of numbers, of which there may be none, as a tensor."""
        values = torch.tensor(rows, dtype=torch.float64).reshape(-1, *shape)
        self.register_buffer(name, values)

    def _lay_out_state(self, body: BodySpecification) -> None:
        mimics = {j.name: j.mimic for j in body.joints if j.mimic is not None}
        names: list[str] = []
        rows: list[tuple[int, float, float]] = []
        for joint in self.tree.joint_names:
            driver, factor, offset = joint, 1.0, 0.0
            if joint in body.ties:
                driver, factor = body.ties[joint]
            elif joint in mimics:
                driver, factor, offset = _driver(joint, mimics)
                if driver not in self.tree.joint_names:
                    raise BodyError(
                        f"joint {joint!r} mimics {driver!r}, which does not move freely"
                    )
            if driver not in names:
                names.append(driver)
            rows.append((names.index(driver), factor, offset))
        self.state_names = tuple(names)
        size = len(names)
        tie = torch.zeros(len(rows), size, dtype=torch.float64)
        lower = torch.full((size,), -math.inf, dtype=torch.float64)
        upper = torch.full((size,), math.inf, dtype=torch.float64)
        for row, (column, factor, offset) in enumerate(rows):
            tie[row, column] = factor
            ends = [(float(b[row]) - offset) / factor for b in (self.tree.lower, self.tree.upper)]
            lower[column] = max(lower[column], min(ends))
            upper[column] = min(upper[column], max(ends))
            if lower[column] > upper[column]:
                raise BodyError(
                    f"parameter {names[column]!r} moves several joints whose limits exclude each "
                    "other: widen the limits or free a joint"
                )
        self.register_buffer("tie", tie)
        # Without ties the state is the joints, and the lift can skip two products with E.
        self.is_untied = tie.shape[0] == size and bool((tie == torch.eye(size)).all())
        self._register("offset", [offset for _, _, offset in rows])
        self.register_buffer("lower", lower)
        self.register_buffer("upper", upper)
        rest = [body.sticky.get(name, (0.0, math.inf)) for name in names]
        self._register("sticky_mean", [mean for mean, _ in rest])
        self._register("sticky_deviation", [deviation for _, deviation in rest])
        self._register("motion_rate", [motion_rate(name) for name in names])

    @property
    def num_parameters(self) -> int:
        """Number of state parameters n."""
        return len(self.state_names)

    @property
    def num_parts(self) -> int:
        """Number of superquadric parts."""
        return len(self.part_names)

    @property
    def touching(self) -> Bool[Tensor, "parts parts"]:
        """Which parts touch in every pose; none touches itself."""
        touching = [[False] * self.num_parts for _ in range(self.num_parts)]
        for pair in self.neighbours:
            i, j = map(self.part_names.index, pair)
            touching[i][j] = touching[j][i] = i != j
        rows = torch.tensor(touching, dtype=torch.bool, device=self.tie.device)
        return rows.reshape(self.num_parts, self.num_parts)

    @property
    def bounds(self) -> Bounds:
        """Joint limits on the state."""
        return Bounds(self.lower, self.upper)

    @property
    def dtype(self) -> torch.dtype:
        """Type of the buffers; states must have it too."""
        return self.tie.dtype

    @property
    def rest(self) -> Vector:
        """The rest pose: zero, moved inside the limits."""
        return self.bounds.project(torch.zeros_like(self.lower))

    @property
    def is_angle(self) -> Bool[Tensor, " n"]:
        """Which parameters turn joints; the others move along an axis or are lengths."""
        return ((self.tie == 0) | self.tree.is_revolute[:, None]).all(0)

    @property
    def comes_round(self) -> Bool[Tensor, " n"]:
        """Which parameters a whole turn brings back to the same pose."""
        return self.is_angle & (self.tie == self.tie.round()).all(0)

    @property
    def joint_of_name(self) -> dict[str, str]:
        """Joint centres by what the body's file calls the link at whose origin they are.

        A joint centre's own name is never another's. Empty for a body that ships.
        """
        if self.name in BODY_NAMES:
            return {}
        markers = self.specification.markers
        links = {mark.link: mark.name for mark in markers if not any(mark.translation)}
        return links | {name: name for name in self.joint_names}

    def joint_index(self, name: str) -> int:
        """Position of a joint centre on axis `j`.

        Raises:
            BodyError: If the body has no such joint centre.
        """
        return self._place("joint", name, self.joint_names)

    def state_index(self, name: str) -> int:
        """Position of a state parameter on axis `n`.

        Raises:
            BodyError: If the body has no such parameter.
        """
        return self._place("parameter", name, self.state_names)

    def joint_columns(self, names: Iterable[str]) -> list[int]:
        """Positions of joint centres, see `joint_index`."""
        return [self.joint_index(name) for name in names]

    def state_columns(self, names: Iterable[str]) -> list[int]:
        """Positions of state parameters, see `state_index`."""
        return [self.state_index(name) for name in names]

    def _place(self, kind: str, name: str, names: tuple[str, ...]) -> int:
        if name not in names:
            raise BodyError(f"{self.name} has no {kind} {name!r}; it has {list(names)}")
        return names.index(name)

    def check_state(self, x: Vectors) -> None:
        """Check that states are this body's.

        Args:
            x: State, radians and metres.

        Raises:
            ShapeError: If the state has another size or type than the body.
        """
        check_shape("x", x, self.num_parameters)
        if x.dtype != self.dtype:
            raise ShapeError(
                f"x: the state is {x.dtype} and the body {self.dtype}; convert one, for example "
                "with body.to(x.dtype)"
            )

    @property
    def base_transform(self) -> Float[Tensor, "4 4"]:
        """World from the root link's frame."""
        base = torch.eye(4).to(self.base_rotation)
        base[:3, :3], base[:3, 3] = self.base_rotation, self.base_translation
        return base

    def with_base(
        self, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]
    ) -> BodyModel:
        """The same body hung on another base transform; everything else is shared.

        Args:
            rotation: Orientation of the root link's frame in the world.
            translation: Its origin in the world, metres.

        Raises:
            ConfigurationError: If the orientation is no rotation.
        """
        check_rotation("rotation", rotation)
        check_shape("translation", translation, 3)
        other, tree = copy.copy(self), copy.copy(self.tree)
        # Own tables of tensors, so that converting one body leaves the other as it is.
        other._buffers, tree._buffers = dict(self._buffers), dict(self.tree._buffers)
        other._modules = {**self._modules, "tree": tree}
        other._buffers["base_rotation"] = rotation.to(self.tie)
        other._buffers["base_translation"] = translation.to(self.tie)
        return other

    def forward_kinematics(self, x: Vectors) -> Float[Tensor, "*batch l 4 4"]:
        """Pose of every link in the world, by pytorch-kinematics; in the order `tree.link_names`.

        Args:
            x: State, radians and metres, of any floating type: the poses have it too.

        Raises:
            ShapeError: If the state has another size than the body's, or no floating type.
        """
        check_shape("x", x, self.num_parameters)
        check_floating("x", x)
        poses = self.tree.link_poses(x @ self.tie.T.to(x) + self.offset.to(x))
        return self.base_transform.to(x) @ poses

    def pose(self, x: Vectors) -> BodyPose:
        """Pose the body for the evaluation of a cost: the map A of eq. 1 [IJRR].

        The poses are those of `forward_kinematics`; the twists say how they move.

        Args:
            x: State, radians and metres.

        Returns:
            Link poses, twists and joint centres in the world.

        Raises:
            ShapeError: If the state has another size or type than the body.
        """
        self.check_state(x)
        base = torch.cat([self.base_rotation, self.base_translation[..., None]], dim=-1)
        tree = self.tree(x @ self.tie.T + self.offset, base)
        return BodyPose(x, tree, self.points_on_links(tree, self.marker_link, self.marker_offset))

    def points_on_links(
        self, tree: TreePose, link: Int[Tensor, " p"], offset: Float[Tensor, "*#batch p 3"]
    ) -> Float[Tensor, "*batch p 3"]:
        """World positions of points that are fixed in links.

        Args:
            tree: Link poses.
            link: Link of each point.
            offset: Position in that link's frame, metres.
        """
        turned = _turned(tree.rotation.index_select(-3, link), offset)
        return turned + tree.translation.index_select(-2, link)

    def part_poses(
        self, pose: BodyPose
    ) -> tuple[Float[Tensor, "*batch parts 3 3"], Float[Tensor, "*batch parts 3"]]:
        """World orientation and centre of every part."""
        rotation = pose.tree.rotation.index_select(-3, self.part_link)
        centre = _turned(rotation, self.part_translation)
        base = pose.tree.translation.index_select(-2, self.part_link)
        return rotation @ self.part_rotation, centre + base

    def mesh(self, rings: int = 8, meridians: int = 12) -> SurfaceSample:
        """Nodes and normals of all parts in their own frames, `[parts rings meridians 3]`.

        Args:
            rings: Latitudes.
            meridians: Longitudes.
        """
        size, shape = (rings, meridians), self.part_shape
        known = self._meshes.get(size)
        if known is not None and known[0] is shape:
            return known[1]
        eta, omega = angular_grid(rings, meridians, dtype=self.dtype, device=shape.device)
        full = (self.num_parts, *eta.shape)
        mesh = surface_points(shape[:, None, None, :], eta.expand(full), omega.expand(full))
        # Dynamo cannot trace the question whether it is of inference mode.
        if not (shape.requires_grad or torch.compiler.is_compiling() or mesh.points.is_inference()):
            self._meshes[size] = shape, mesh
        return mesh

    def surface(self, pose: BodyPose) -> SurfaceSample:
        """World positions and unit outward normals of the mesh nodes.

        Args:
            pose: A posed body.

        Returns:
            Points and normals of shape `[*batch p 3]`, part by part, ring by ring.
        """
        mesh = self.mesh()
        return self.in_world(pose, mesh.points.flatten(1, 2), mesh.normals.flatten(1, 2))

    def in_world(
        self,
        pose: BodyPose,
        points: Float[Tensor, "parts c 3"],
        normals: Float[Tensor, "parts c 3"],
    ) -> SurfaceSample:
        """World positions and unit outward normals of nodes that are given in their parts' frames.

        Args:
            pose: A posed body.
            points: The nodes, metres, `[parts c 3]`.
            normals: Their unit outward normals.
        """
        rotation, centre = self.part_poses(pose)
        turn = rotation.transpose(-1, -2)
        points, normals = points @ turn + centre[..., None, :], normals @ turn
        return SurfaceSample(points.flatten(-3, -2), normals.flatten(-3, -2))

    def lift(
        self,
        pose: BodyPose,
        points: Float[Tensor, "*batch p 3"],
        point_link: Int[Tensor, " p"],
        cost: PointCost,
        *,
        curvature: Curvature = Curvature.EXACT,
    ) -> LocalModel:
        """Sum a cost over 3D points and differentiate it with respect to the state.

        Args:
            pose: The posed body at which the cost was evaluated.
            points: World positions of the points, metres.
            point_link: The link that carries each point.
            cost: Value, gradient and Hessian of each point's cost in its position.
            curvature: Gauss-Newton leaves the second-order kinematics out; else it is exact.

        Returns:
            Value, gradient and Hessian in x.
        """
        joints = lift_to_joints(
            self.tree,
            pose.tree,
            points,
            point_link,
            cost,
            second_order_kinematics=curvature is not Curvature.GAUSS_NEWTON,
        )
        return self.tied(joints)

    def tied(self, joints: LocalModel) -> LocalModel:
        """A cost with its derivatives in the joints, and the same in x."""
        if self.is_untied:
            return joints
        return LocalModel(
            joints.value, joints.gradient @ self.tie, self.tie.T @ joints.hessian @ self.tie
        )


def _turned(
    rotation: Float[Tensor, "*batch p 3 3"], vector: Float[Tensor, "*#batch p 3"]
) -> Float[Tensor, "*batch p 3"]:
    """Vectors turned one by one; on a CPU several times faster than sums over products of three."""
    x, y, z = rotation.unbind(-1)
    a, b, c = vector[..., None].unbind(-2)
    return x * a + y * b + z * c


def _driver(joint: str, mimics: Mapping[str, tuple[str, float, float]]) -> tuple[str, float, float]:
    """Which free joint a joint follows in the end, by which factor, from which offset."""
    driver, factor, offset = mimics[joint]
    for _ in mimics:
        if driver not in mimics:
            return driver, factor, offset
        driver, step, shift = mimics[driver]
        factor, offset = factor * step, offset + factor * shift
    raise BodyError(f"joint {joint!r} mimics {driver!r}, which mimics it in turn")
