"""What the camera sees of a posed body: facing, occluding contours, self-occlusion (3.1 [IJRR]).

**Back-facing.** A surface node p faces a camera at c where `n . (c - p) > 0`, see `facing_nodes`.

**Occluding contours.** The occluding contour of a part is where its normals are perpendicular to
the line of sight. On the part's mesh it crosses every ring (a closed curve around the part) and
every meridian (pole to pole) at most twice, once from back to front and once from front to back;
the crossings are found by linear interpolation of `n . (c - p)` between neighbouring nodes and are
the contour nodes, a fixed number per part. Rings serve limbs seen from the side, meridians limbs
that point at the camera. A crossing fades in where a curve begins to turn through the line of
sight, so that the cost has no jump where a contour is born. (A curve of a strongly bent part may
cross more often; the first crossing of either kind is taken.)

**Self-occlusion.** A node is hidden where the stretch of its line of sight from the camera to the
node enters another part. With R the part's radial function (`torchcss.body.superquadric`), the
depth of the entry is the signed distance, to first order,

    gap = min over the stretch of (R - 1) / |grad R|

which is exact in sign for the true superquadric. A node's visibility is a ramp in the gap, some
millimetres wide and one half where the line of sight touches the nearest part.

A part does not hide itself but by facing away, which is exact unless it is bent.

A contour node lies on no image contour where a neighbouring part is just behind it (the end of the
upper arm over the forearm). This is the same test, a little outside the contour and with a stretch
that goes on behind the node, over neighbouring parts only.

Make a `ContourPredictor` for a body once, and call it with poses; `visible_nodes` serves any other
nodes.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import compress
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.superquadric import EXPONENTS, Superquadrics, radial_square
from torchcss.body.surface import SurfaceSample, surface_points
from torchcss.cost.term import Points, Posed, Values

Place = Float[Tensor, "3"]

_TINY = 1e-12
_FAR = 1e6
"""Metres beyond which squares could overflow in single precision; nothing is seen there."""

_GRAZING = 0.15
"""Sine of the angle by which a curve must turn through the line of sight to count fully."""

RAMP, CLEARANCE = 0.010, 0.005
"""Width of the transition between visible and hidden, and how far outside the surface a contour
node must be free of neighbouring parts, metres."""

BEHIND = 3.5
"""How far behind a contour a neighbouring part suppresses it, in mean radii of that part."""

_PAIRS_AT_ONCE = 2**20
"""Pairs of node and part tested together on a CPU, so that memory does not grow with the batch."""

_ROUND = (0.65, 1.2)
"""Exponents with which a part is round enough for the few steps: the share that is seen errs by
less than 0.01 for 99 of 100 lines of sight that graze a part. The samples take five times as
long."""

_STEPS, _SAMPLED_STEPS, _SAMPLES = 3, 4, 12
"""Steps to the nearest point of a plain part and of any other, and samples before the latter."""

_MICRO = 1e-10
"""Square of a step too short to tell the curvature from, square metres."""

_ROUNDING = 1e-6
"""Relative error of a squared distance in single precision, with a margin."""

_LEAST_BEND = 1e-6
"""Curvature, per metre, below which the axis counts as straight."""


class SeenNodes(NamedTuple):
    """Nodes on the surface with what the camera sees of them, world frame.

    Attributes:
        points: Positions, metres.
        normals: Unit outward normals; those of contour nodes are the contour's in the image too.
        exists: Of a contour node 0 where its ring or meridian has no contour (wholly back-facing or
            front-facing) or runs in front of a neighbouring part; of any other node 0 where it
            faces away. 1 where it is clear, between where it fades.
        visible: 1 where nothing is in front, 0 where another part is, between on the ramp. Also 1
            where a node does not exist: nothing depends on it there.
    """

    points: Points
    normals: Points
    exists: Values
    visible: Values

    def cost(self, matched: Values, back_facing: float, occlusion_factor: float) -> Values:
        """Cost of every node, whether it is seen or not (eq. 5 [IJRR]).

        Args:
            matched: Cost of what the image has where the node is seen.
            back_facing: `nu_bf`, cost of a node where there is no contour.
            occlusion_factor: k of the cost `nu_occ = k nu_bf` of a node that is hidden.
        """
        seen = self.visible * matched + (1 - self.visible) * (occlusion_factor * back_facing)
        return self.exists * seen + (1 - self.exists) * back_facing


class ContourPredictor(nn.Module):
    """Finds the contour nodes of a body for any number of poses at once.

    Args:
        body: The body whose parts are predicted.
        rings: Closed curves per part, each with two nodes; by default 7, and more for a body of few
            parts, so that its contour is as finely sampled as a large one's.
        meridians: Pole-to-pole curves per part, each with two nodes, of which one exists unless the
            part is seen from the side; by default about half as many.

    Attributes:
        num_rings: Rings per part; a part's nodes are those of its rings, then of its meridians.
        node_part: The part of each node.
        node_link: The link of each node.
        other: Row of each node: 1 for the other parts, which can hide it, 0 for its own.
        touching: Row of each node: 1 for the parts that touch its own.
    """

    node_part: Tensor
    node_link: Tensor
    rings: Tensor
    meridians: Tensor
    other: Tensor
    touching: Tensor

    _RING_STEPS = 16
    _MERIDIAN_STEPS = 12

    def __init__(
        self, body: BodyModel, *, rings: int | None = None, meridians: int | None = None
    ) -> None:
        super().__init__()
        self.num_rings = rings = rings or max(7, min(18, 126 // max(body.num_parts, 1)))
        meridians = meridians or (rings + 1) // 2
        real, device = torch.float64, body.tie.device
        heights = (torch.arange(rings, dtype=real, device=device) + 0.5) * (1.9 / rings) - 0.95
        around = torch.arange(self._RING_STEPS + 1, dtype=real, device=device)
        eta, omega = torch.meshgrid(
            heights.asin(), around * (2 * torch.pi / self._RING_STEPS) - torch.pi, indexing="ij"
        )
        ring_curves = _curves(body, eta, omega)
        pole = torch.linspace(-1, 1, self._MERIDIAN_STEPS + 1, dtype=real, device=device)
        sides = torch.arange(meridians, dtype=real, device=device)
        omega, eta = torch.meshgrid(
            sides * (2 * torch.pi / meridians) + 0.1, pole * torch.pi / 2, indexing="ij"
        )
        meridian_curves = _curves(body, eta, omega)
        per_part = 2 * (rings + meridians)
        node_part = torch.arange(body.num_parts, device=device).repeat_interleave(per_part)
        own = torch.eye(body.num_parts, device=device)
        for name, value in (
            ("node_part", node_part),
            ("node_link", body.part_link.repeat_interleave(per_part)),
            ("rings", ring_curves),
            ("meridians", meridian_curves),
            ("other", (1 - own)[node_part]),
            ("touching", body.touching.to(own)[node_part]),
        ):
            self.register_buffer(name, value, persistent=False)

    @property
    def num_nodes(self) -> int:
        """Number of contour nodes."""
        return len(self.node_part)

    def forward(self, body: BodyModel, pose: BodyPose, centre_world: Place) -> SeenNodes:
        """Predict the occluding contours.

        Args:
            body: The body that this predictor was made for (its base may have moved).
            pose: Any number of posed bodies.
            centre_world: The camera's centre, metres.

        Returns:
            Nodes in the order of `node_part`.
        """
        rotation, centre, centre_world, eye = _seen_from(body, pose, centre_world)
        found = (
            _crossings(self.rings, eye, closed=True),
            _crossings(self.meridians, eye, closed=False),
        )
        points, normals, exists = (
            torch.cat(pair, dim=eye.dim() - 1) for pair in zip(*found, strict=True)
        )
        normals = normals / normals.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        turn = rotation.transpose(-1, -2)
        points = (points @ turn + centre[..., None, :]).flatten(-3, -2)
        normals = (normals @ turn).flatten(-3, -2)
        exists, rays = exists.flatten(-2), points - centre_world
        # Past the others to the nodes; and past the neighbours beside them and on behind them.
        reach = BEHIND * body.part_shape.to(rays)[..., :2].mean(-1)
        beside = torch.arange(2, dtype=reach.dtype, device=reach.device)
        visible, free = line_of_sight(
            body.part_shape,
            rotation,
            eye,
            torch.cat([rays, rays + CLEARANCE * normals], dim=-2),
            torch.cat([self.other, self.touching]) > 0,
            behind=beside.repeat_interleave(self.num_nodes)[:, None] * reach[..., None, :],
            wanted=torch.cat([exists, exists], dim=-1),
        ).chunk(2, dim=-1)
        return SeenNodes(points, normals, exists * free, visible)


def _seen_from(
    body: BodyModel, pose: BodyPose, centre_world: Place
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Orientations and centres of the parts, and the camera's centre in the world and in them."""
    rotation, centre = body.part_poses(pose)
    centre_world = centre_world.to(centre)
    eye = ((centre_world - centre)[..., None, :] @ rotation)[..., 0, :]
    return rotation, centre, centre_world, eye


def contour_nodes(posed: Posed) -> SeenNodes:
    """The contour nodes of posed bodies."""
    predictor = posed.context.tables.of(ContourPredictor)
    return predictor(posed.body, posed.pose, posed.camera.centre_world)


def visible_nodes(
    body: BodyModel,
    pose: BodyPose,
    centre_world: Place,
    points: Points,
    node_part: Int[Tensor, " p"],
    *,
    wanted: Values | None = None,
) -> Values:
    """Visibility of surface nodes past the other parts: 1 where seen, 0 where hidden.

    A node that faces away is hidden by its own part besides, see `facing_nodes`.

    Args:
        body: The body.
        pose: Its poses.
        centre_world: The camera's centre, metres.
        points: Nodes, world frame, metres.
        node_part: The part of each node.
        wanted: 0 where a node is not looked at, as it faces away, say; it counts as seen.
    """
    rotation, _, centre_world, eye = _seen_from(body, pose, centre_world)
    other = ~torch.eye(body.num_parts, dtype=torch.bool, device=points.device)[node_part]
    rays = points - centre_world
    return line_of_sight(body.part_shape, rotation, eye, rays, other, wanted=wanted)


def facing_nodes(points: Points, normals: Points, centre_world: Place) -> SeenNodes:
    """Surface nodes with which of them face the camera, as if nothing were in front of them.

    0 where they face away, 1 where clearly towards it; the ramp between starts where the line of
    sight grazes the surface.

    Args:
        points: Nodes, world frame, metres.
        normals: Their unit outward normals.
        centre_world: The camera's centre, metres.
    """
    towards = centre_world.to(points) - points
    distance = towards.norm(dim=-1)
    along = (normals * towards).sum(-1)
    facing = (along / (_GRAZING * torch.where(distance > 0, distance, 1.0))).clamp(0, 1)
    return SeenNodes(points, normals, facing, torch.ones_like(facing))


def seen_nodes(
    body: BodyModel,
    pose: BodyPose,
    centre_world: Place,
    points: Points,
    normals: Points,
    node_part: Int[Tensor, " p"],
) -> SeenNodes:
    """The same with which of them no other part hides.

    Args:
        body: The body.
        pose: Its poses.
        centre_world: The camera's centre, metres.
        points: Nodes, world frame, metres.
        normals: Their unit outward normals.
        node_part: The part of each node.
    """
    nodes = facing_nodes(points, normals, centre_world)
    wanted = nodes.exists
    visible = visible_nodes(body, pose, centre_world, points, node_part, wanted=wanted)
    return nodes._replace(visible=visible)


def line_of_sight(
    shape: Float[Tensor, "parts 9"],
    rotation: Float[Tensor, "*batch parts 3 3"],
    eye: Float[Tensor, "*batch parts 3"],
    rays: Points,
    others: Bool[Tensor, "p parts"],
    *,
    behind: Float[Tensor, "p parts"] | None = None,
    wanted: Values | None = None,
) -> Values:
    """Visibility of points past parts: 1 where nothing is in front, 0 where a part is.

    Args:
        shape: The parts' shape numbers.
        rotation: World orientations of the parts.
        eye: The camera's centre in the frames of the parts, metres.
        rays: From the camera's centre to the points, world axes, metres.
        others: Which parts can hide a point.
        behind: How far behind the points a part still hides them, metres; None: not at all.
        wanted: 0 where a point is not looked at, as nothing depends on it, and gets 1.
    """
    if others.numel() == 0:
        return eye.new_ones(rays.shape[:-1])
    parts = _known_parts(shape, eye)
    views = _Views.of(rotation, eye, rays, len(parts.radius))
    if wanted is not None:  # what is not wanted ends before it begins
        wanted = wanted.reshape(views.length.shape)
        views = views._replace(length=torch.where(wanted > 0, views.length, -torch.inf))
    behind = torch.zeros_like(others, dtype=eye.dtype) if behind is None else behind
    behind = behind.to(eye).mT.expand(*shape.shape[:-2], *([-1] * 2)).reshape(-1, *others.T.shape)
    gaps = _sight_gaps(parts, views, others.T, behind.contiguous())
    return (0.5 + gaps.reshape(rays.shape[:-1]) / RAMP).clamp(0, 1)


class _Views(NamedTuple):
    """Lines of sight of poses, nodes along the last axis in memory: long rows to work on.

    Attributes:
        frames: World axes in the frame of each part, one after the other, then the camera's centre.
        centre: Centre of each part from the camera's, world axes, metres.
        direction: Unit directions of the lines, world axes.
        length: Distance of the nodes, metres.
        body: Which of several bodies each pose is of; None: there is one.
    """

    frames: Float[Tensor, "b parts 12"]
    centre: Float[Tensor, "b parts 3"]
    direction: Float[Tensor, "b 3 p"]
    length: Float[Tensor, "b p"]
    body: Int[Tensor, " b"] | None = None

    @classmethod
    def of(cls, rotation: Tensor, eye: Tensor, rays: Tensor, rows: int) -> _Views:
        """From the parts' orientations, the camera in their frames, and rays to the nodes."""
        bodies = torch.arange(rows // rotation.shape[-3], device=eye.device)
        rotation = rotation.reshape(-1, *rotation.shape[-3:])
        body = bodies.repeat_interleave(len(rotation) // len(bodies)) if len(bodies) > 1 else None
        eye = eye.clamp(-_FAR, _FAR).reshape(rotation.shape[:-1])
        centre = -(rotation @ eye[..., None])[..., 0]
        frames = torch.cat([rotation.flatten(-2), eye], dim=-1)
        rays = rays.clamp(-_FAR, _FAR).reshape(-1, *rays.shape[-2:]).mT.contiguous()
        length = rays.square().sum(1).sqrt()
        return cls(frames, centre, rays / length.clamp(min=_TINY)[:, None], length, body)

    def take(self, some: slice) -> _Views:
        """Some of the poses."""
        return _Views(*(None if part is None else part[some] for part in self))  # type: ignore[arg-type]

    def own(self, rows: Float[Tensor, "bodies *rest"]) -> Float[Tensor, "#b *rest"]:
        """What each pose's body has."""
        return rows if self.body is None else rows[self.body]


class _Parts(NamedTuple):
    """Shapes of all parts.

    Attributes:
        table: The fields of `Superquadrics`, one column per part.
        radius: Of the sphere outside which a part hides nothing, metres.
        around: Reciprocal semi-axes of an ellipsoid outside which a part hides nothing.
        within: Squared radius, of a plain part's own ellipsoid, at which it hides for sure.
        plain: Whether a part is round, straight and little tapered: a line of sight then has one
            nearest point, which a few steps find.
        kinds: The values that `plain` has.
        bent: Whether any part is bent.
    """

    table: Float[Tensor, "c parts"]
    radius: Float[Tensor, " parts"]
    around: Float[Tensor, "3 parts"]
    within: Float[Tensor, " parts"]
    plain: Bool[Tensor, " parts"]
    kinds: tuple[bool, ...]
    bent: bool

    def shapes(self, part: Int[Tensor, " m"]) -> Superquadrics:
        """The shapes of some of them."""
        return Superquadrics._make(self.table.index_select(1, part).unbind(0))


_KNOWN: deque[tuple[Tensor, _Parts]] = deque(maxlen=8)
"""Parts that were looked past last, with the tensors of their shapes."""


def _known_parts(shape: Float[Tensor, "parts 9"], like: Tensor) -> _Parts:
    """What `tabulate_parts` says, which a body asks for in every evaluation."""
    if torch.compiler.is_compiling() or shape.requires_grad:
        return tabulate_parts(shape.to(like))
    for known, parts in _KNOWN:
        if known is shape and parts.table.dtype == like.dtype and parts.table.device == like.device:
            return parts
    parts = tabulate_parts(shape.to(like))
    _KNOWN.append((shape, parts))
    return parts


def tabulate_parts(shape: Float[Tensor, "parts 9"]) -> _Parts:
    """The shapes of all parts; outside `radius` and `around` the width of the ramp is left free."""
    shape = shape.reshape(-1, 9)  # of several bodies one after the other
    axes, exponents = shape[:, :3], shape[:, 3:5].clamp(*EXPONENTS)
    e1, e2 = exponents.unbind(-1)
    rows = Superquadrics.of(shape)
    taper = torch.stack([rows.taper_x, rows.taper_y], dim=-1)
    widest = axes[:, :2] * (1 + taper.abs())
    section = _farthest(widest[:, 0], widest[:, 1], e2)
    is_bent = rows.bend.abs() >= _LEAST_BEND
    is_round = ((exponents >= _ROUND[0]) & (exponents <= _ROUND[1])).all(-1)
    # A bent axis ends no farther out than a straight one, but the section may stand off its end.
    straight = _farthest(section, axes[:, 2], e1)
    radius = torch.where(is_bent, section + axes[:, 2], straight) + RAMP
    plain = is_round & ~is_bent & (taper.abs() < 0.35).all(-1)
    # In two dimensions norms of order 2/e and 2 differ by no more than a factor 2^((1 - e) / 2).
    larger, smaller = (2 ** (0.5 * s * (1 - exponents)).clamp(min=0).sum(-1) for s in (1, -1))
    around = larger[:, None] * torch.cat([widest, axes[:, 2:]], dim=-1) + RAMP
    around = torch.where(is_bent[:, None], radius[:, None], around)
    narrowest = torch.cat([axes[:, :2] * (1 - taper.abs()), axes[:, 2:]], dim=-1).amin(-1)
    within = (1 / smaller - RAMP / narrowest).clamp(min=0).square()
    some = torch.stack([plain.any(), (~plain).any(), is_bent.any()]).tolist()  # one transfer
    kinds = tuple(compress((True, False), some))
    return _Parts(torch.stack(rows), radius, 1 / around.mT, within, plain, kinds, some[2])


def _farthest(a: Tensor, b: Tensor, exponent: Tensor) -> Tensor:
    """Largest distance of a superellipse with semi-axes a and b from its centre."""
    power = 2 / (1 - exponent.clamp(max=0.98))
    most, least = torch.maximum(a, b), torch.minimum(a, b)
    return most * (1 + (least / most) ** power) ** (1 / power)


def _sight_gaps(
    parts: _Parts,
    views: _Views,
    others: Bool[Tensor, "parts p"],
    behind: Float[Tensor, "bodies parts p"],
) -> Float[Tensor, "b p"]:
    """Signed distance of each line of sight to the nearest of the others, metres.

    It is as it is within half a ramp of zero, and infinite where it is larger for sure, of either
    sign. A line counts from the camera to `behind` the ray's end.
    """
    gap = torch.full_like(views.length, torch.inf)
    at_once = _PAIRS_AT_ONCE if gap.device.type == "cpu" else 2**6 * _PAIRS_AT_ONCE
    poses = max(1, at_once // others.numel())
    for plain in parts.kinds:
        radius, is_kind = (p.view(-1, len(others), 1) for p in (parts.radius, parts.plain == plain))
        reach = torch.where(others & is_kind, radius + behind, -torch.inf)
        for first in range(0, len(gap), poses):
            chunk = slice(first, first + poses)
            some = views.take(chunk)
            near = places(_is_near(some, some.own(radius), some.own(reach)))
            if len(near):
                lines = _stretches(parts, some, near, behind)
                least = _least_gap(parts, lines, gap[chunk].numel(), plain=plain)
                gap[chunk] = torch.minimum(gap[chunk], least.view_as(gap[chunk]))
    return gap


def _is_near(
    views: _Views, radius: Float[Tensor, "#b parts 1"], reach: Float[Tensor, "#b parts p"]
) -> Bool[Tensor, "b parts p"]:
    """Which rays meet a part's sphere before their end."""
    depth = views.centre @ views.direction
    # Beyond the length of a tangent to the sphere; any ray where the camera is inside it.
    tangent = (1 - _ROUNDING) * views.centre.square().sum(-1) - radius[..., 0].square()
    tangent = torch.where(tangent > 0, tangent.clamp(min=0).sqrt(), -torch.inf)
    return (depth > tangent[:, :, None]) & (depth < views.length[:, None] + reach)


_Triple = tuple[Tensor, Tensor, Tensor]


class _Stretches(NamedTuple):
    """Stretches of lines of sight, each in the frame of a part that it may meet.

    Attributes:
        ray: The line.
        part: The part.
        x, y, z: The line's point next to the part's centre, its foot, metres.
        u, v, w: The line's unit direction.
        begin: Where the stretch begins, metres from the foot.
        end: Where it ends.
    """

    ray: Tensor
    part: Tensor
    x: Tensor
    y: Tensor
    z: Tensor
    u: Tensor
    v: Tensor
    w: Tensor
    begin: Tensor
    end: Tensor

    def take(self, index: Int[Tensor, " k"]) -> _Stretches:
        """Some of them."""
        return _Stretches(*(field.index_select(0, index) for field in self))

    def point(self, s: Tensor) -> _Triple:
        """Points at distances from the feet."""
        return self.x + s * self.u, self.y + s * self.v, self.z + s * self.w

    def slope(self, gradient: _Triple) -> Tensor:
        """How steeply something rises along the lines."""
        gx, gy, gz = gradient
        return gx * self.u + gy * self.v + gz * self.w

    def clamp(self, s: Tensor) -> Tensor:
        """The nearest distances on the stretches."""
        return torch.minimum(torch.maximum(s, self.begin), self.end)


def _least_gap(parts: _Parts, lines: _Stretches, count: int, *, plain: bool) -> Float[Tensor, " r"]:
    """Signed distance of so many lines of sight to the nearest part of their stretches, metres."""
    # A stretch is empty where the part is behind the node or the camera.
    lines = lines.take(places((lines.begin <= lines.end) & _is_close(parts, lines)))
    least = lines.end.new_full((count,), torch.inf)
    if plain:
        s, curvature, square = _ellipsoid_minimum(parts.shapes(lines.part), lines)
        hidden = square < parts.within.index_select(0, lines.part)
        gap = _gap(parts, lines, s, curvature, steps=_STEPS)
        gap = torch.where(hidden, gap.new_full((), -torch.inf), gap)
    else:
        lines, s, curvature = _sampled_minima(parts, lines)
        gap = _gap(parts, lines, s, curvature, steps=_SAMPLED_STEPS, bent=parts.bent).amin(0)
    return least.scatter_reduce(0, lines.ray, gap, "amin")


def _stretches(
    parts: _Parts, views: _Views, near: Int[Tensor, " m"], behind: Float[Tensor, "bodies parts p"]
) -> _Stretches:
    """Lines of sight in the frames of parts, from the camera to `behind` the rays' ends."""
    num_parts, nodes = behind.shape[1:]
    owner = near // nodes  # of all parts of all poses
    pose = owner // num_parts
    node, part = near - owner * nodes, owner - pose * num_parts
    ray = pose * nodes + node
    if views.body is not None:
        part = part + num_parts * views.body.index_select(0, pose)
    u, v, w = (a.flatten().index_select(0, ray) for a in views.direction.unbind(1))
    frame = views.frames.flatten(0, 1).T.index_select(1, owner)
    ux, uy, uz, vx, vy, vz, wx, wy, wz, ox, oy, oz = frame.unbind(0)
    x, y, z = (u * a + v * b + w * c for a, b, c in ((ux, vx, wx), (uy, vy, wy), (uz, vz, wz)))
    # Measured from the foot of the perpendicular from the part's centre, for precision.
    start = ox * x + oy * y + oz * z
    foot = (ox - start * x, oy - start * y, oz - start * z)
    half = parts.radius.square().index_select(0, part) - sum(a.square() for a in foot)
    half = half.clamp(min=0).sqrt()
    stop = start + views.length.flatten().index_select(0, ray)
    stop = stop + behind.flatten().index_select(0, part * nodes + node)
    ends = torch.maximum(start, -half), torch.minimum(stop, half)
    return _Stretches(ray, part, *foot, x, y, z, *ends)


def _is_close(parts: _Parts, lines: _Stretches) -> Bool[Tensor, " m"]:
    """Whether lines meet the ellipsoids around the parts."""
    sx, sy, sz = parts.around.index_select(1, lines.part)
    px, py, pz = lines.x * sx, lines.y * sy, lines.z * sz
    dx, dy, dz = lines.u * sx, lines.v * sy, lines.w * sz
    across, speed = px * dx + py * dy + pz * dz, dx * dx + dy * dy + dz * dz
    return (px * px + py * py + pz * pz - 1) * speed < across.square()


def places(mask: Bool[Tensor, "*shape"]) -> Int[Tensor, " k"]:
    """Where a mask is true, counted through all of it."""
    if mask.device.type == "cpu":
        # Without a branch per element: six times faster than `nonzero`.
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.flatten().nonzero()[:, 0]


def _gap(
    parts: _Parts,
    lines: _Stretches,
    s: Float[Tensor, "*two m"],
    curvature: Float[Tensor, "*two m"],
    *,
    steps: int,
    bent: bool = False,
) -> Float[Tensor, "*two m"]:
    """Signed distance between stretches of lines and parts, to first order, metres.

    Args:
        parts: All parts.
        lines: The stretches.
        s: About where they are nearest, metres from the feet.
        curvature: About the curvature of R^2/2 there.
        steps: Steps towards where they are nearest.
        bent: Whether any of the parts is bent.
    """
    shape = parts.shapes(lines.part)

    def slope(s: Tensor) -> Tensor:
        return lines.slope(radial_square(shape, *lines.point(s), bent=bent)[1])

    last, before = s, slope(s)
    s = lines.clamp(s - before / curvature)
    for _ in range(1, steps):
        # Secant; after a step too short for one, the curvature assumed at first.
        now, moved = slope(s), s - last
        secant = ((now - before) * moved + _MICRO * curvature) / (moved.square() + _MICRO)
        secant = torch.minimum(torch.maximum(secant, 0.3 * curvature), 10 * curvature)
        last, before = s, now
        s = lines.clamp(s - now / secant)
    square, (gx, gy, gz) = radial_square(shape, *lines.point(s), bent=bent)
    radial = square.sqrt()
    # grad R = grad(R^2) / 2 R
    steepness = (gx.square() + gy.square() + gz.square()).sqrt().clamp(min=_TINY)
    return (radial - 1) * radial / steepness


def _ellipsoid_minimum(shape: Superquadrics, lines: _Stretches) -> _Triple:
    """Where a stretch is nearest to the tapered ellipsoid, the curvature of R^2/2, and R^2."""
    x, y, z, dx, dy, dz = lines[2:8]
    z, dz = z * shape.ic, dz * shape.ic
    curvature = s = torch.zeros_like(lines.begin)
    ix, iy = shape.ia, shape.ib
    for _ in range(2):  # with the taper at the foot, then with that at the nearest point
        ix, iy = shape.narrowed(z + s * dz)
        u, v = dx * ix, dy * iy
        curvature = (u * u + v * v + dz * dz).clamp(min=_TINY)
        s = lines.clamp(-(x * ix * u + y * iy * v + z * dz) / curvature)
    height = z + s * dz
    ix, iy = shape.narrowed(height)
    square = ((x + s * dx) * ix).square() + ((y + s * dy) * iy).square() + height.square()
    return s, curvature, square


def _sampled_minima(parts: _Parts, lines: _Stretches) -> tuple[_Stretches, Tensor, Tensor]:
    """The first and the last minimum on a stretch: bounds, guess and curvature, each `[2 m]`.

    There are no others: a line meets a bent part at most twice.
    """
    places = torch.linspace(0, 1, _SAMPLES).to(lines.end)[:, None]
    s = torch.lerp(lines.begin, lines.end, places)
    rise = lines.slope(radial_square(parts.shapes(lines.part), *lines.point(s), bent=parts.bent)[1])
    # A minimum is where a fall meets a climb, or at an end. It lies between samples k - 1 and k.
    falls, anything = rise < 0, torch.ones_like(rise[:1], dtype=torch.bool)
    minimum = torch.cat([anything, falls]) & torch.cat([~falls, anything])
    number = torch.arange(_SAMPLES + 1, device=s.device)[:, None]
    first = _SAMPLES - (minimum * number.flip(0)).amax(0)
    k = torch.stack([first, (minimum * number).amax(0)])
    left, right = (k - 1).clamp(min=0), k.clamp(max=_SAMPLES - 1)
    lower, upper = s.gather(0, left), s.gather(0, right)
    fall, climb = -rise.gather(0, left).clamp(max=0), rise.gather(0, right).clamp(min=0)
    change, width = (fall + climb).clamp(min=_TINY), upper - lower
    lines = lines._replace(begin=lower, end=upper)
    return lines, lower + width * fall / change, change / width.clamp(min=_TINY)


def _curves(
    body: BodyModel, eta: Float[Tensor, "c k"], omega: Float[Tensor, "c k"]
) -> Float[Tensor, "parts c k 9"]:
    """Nodes of curves on all parts: point, normal, and how far the next step's middle bulges."""
    shape = body.part_shape.to(eta)[:, None, None, :]

    def sample(eta: Tensor, omega: Tensor) -> SurfaceSample:
        full = (body.num_parts, *eta.shape)
        return surface_points(shape, eta.expand(full), omega.expand(full))

    points, normals = sample(eta, omega)
    middle = sample(*(0.5 * (angle[:, 1:] + angle[:, :-1]) for angle in (eta, omega))).points
    bulge = middle - 0.5 * (points[..., 1:, :] + points[..., :-1, :])
    bulge = torch.cat([bulge, torch.zeros_like(bulge[..., :1, :])], dim=-2)
    return torch.cat([points, normals, bulge], dim=-1).to(body.dtype)


def _crossings(
    curves: Float[Tensor, "parts c k 9"], eye: Float[Tensor, "*batch parts 3"], *, closed: bool
) -> _Triple:
    """Where each curve turns from back to front, then where each turns from front to back.

    Returns:
        Points `[*batch parts 2*c 3]`, normals, and whether they exist `[*batch parts 2*c]`.
    """
    *parts, count, size, _ = curves.shape
    points, normals = curves[..., :3].flatten(-3, -2), curves[..., 3:6].flatten(-3, -2)
    towards = torch.einsum("...pi,...pki->...pk", eye, normals)
    facing = (towards - (normals * points).sum(-1)).unflatten(-1, (count, size))
    away = facing < 0
    before, after = away[..., :-1], away[..., 1:]
    exists, step = torch.cat([before & ~after, ~before & after], dim=-2).max(dim=-1)
    # A contour is born where a curve grazes the line of sight, or at a pole. So it counts by how
    # far the curve turns through: anywhere on a closed curve, on either side of an open one.
    if closed:
        turns = torch.minimum(facing.amax(-1), -facing.amin(-1))
        turns = torch.cat([turns, turns], dim=-1)
    else:
        wanted = torch.cat([facing, -facing], dim=-2)  # positive after the crossing
        later = torch.arange(size, device=eye.device) > step[..., None]
        turns = torch.minimum(
            torch.where(later, wanted, 0.0).amax(-1), -torch.where(later, 0.0, wanted).amin(-1)
        )
    clear = _GRAZING * eye.norm(dim=-1)[..., None]
    exists = exists * (turns / clear).clamp(0, 1)
    # Interpolated to where n . (c - p) is zero.
    place = torch.arange(count, device=eye.device).repeat(2) * size + step
    here, there = (facing.flatten(-2).gather(-1, index) for index in (place, place + 1))
    change = here - there
    t = torch.where(change != 0, here / torch.where(change != 0, change, 1), 0.5).clamp(0, 1)
    t = t[..., None]
    row = torch.arange(math.prod(parts), device=eye.device).reshape(*parts, 1)
    place = place + row * (count * size)
    here, there = (
        curves.flatten(0, -2).index_select(0, index.flatten()).unflatten(0, place.shape)
        for index in (place, place + 1)
    )
    mixed = torch.lerp(here[..., :6], there[..., :6], t)
    return mixed[..., :3] + 4 * t * (1 - t) * here[..., 6:], mixed[..., 3:], exists
