"""What the camera sees of a posed body: occluding contours and self-occlusion (section 3.1 [IJRR]).

The occluding contour of a part is where its normals are perpendicular to the line of sight. On the
part's mesh it crosses every ring (a closed curve around the part) twice, once each way, and every
meridian (pole to pole) once; the crossings are found by linear interpolation of `n . (c - p)`
between neighbouring nodes and are the contour nodes, a fixed number per part. Rings serve limbs
seen from the side, meridians limbs that point at the camera.

A node is occluded where another part crosses its line of sight in front of it. Parts are taken as
tapered ellipsoids here; the transition is a ramp some millimetres wide, so that the cost has no
jump where a limb passes in front of another. A node whose outside touches a neighbouring part (the
end of the upper arm inside the forearm) lies on no image contour and is left out.

Make a `ContourPredictor` for a body once, and call it with poses.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.surface import surface_points

_TINY = 1e-12
_FAR = 1e6
"""Metres beyond which squares could overflow in single precision; nothing is seen there."""

_GRAZING = 0.15
"""Sine of the angle by which a curve must turn through the line of sight to count fully."""


class ContourNodes(NamedTuple):
    """Nodes of the occluding contours of all parts, world frame.

    Attributes:
        points: Positions, metres.
        normals: Unit outward normals; they are also the contour's normals in the image.
        exists: 0 where the ring or meridian has no contour (wholly back-facing or front-facing) or
            runs inside a neighbouring part; 1 on a clear contour, between where one fades.
        visible: 1 where nothing is in front, 0 where another part is, between on the ramp.
    """

    points: Float[Tensor, "*batch p 3"]
    normals: Float[Tensor, "*batch p 3"]
    exists: Float[Tensor, "*batch p"]
    visible: Float[Tensor, "*batch p"]


class ContourPredictor(nn.Module):
    """Finds the contour nodes of a body for any number of poses at once.

    Args:
        body: The body whose parts are predicted.
        rings: Closed curves per part, each with two nodes; by default 7, and more for a body of few
            parts, so that its contour is as finely sampled as a large one's.
        meridians: Pole-to-pole curves per part, each with one node; by default nearly as many.
        ramp: Width of the transition between visible and occluded, metres.
        clearance: How far outside the surface a node must be free of neighbouring parts, metres.

    Attributes:
        node_part: The part of each node.
        node_link: The link of each node.
    """

    node_part: Tensor
    node_link: Tensor
    ring_points: Tensor
    ring_normals: Tensor
    meridian_points: Tensor
    meridian_normals: Tensor
    other: Tensor
    touching: Tensor

    _RING_STEPS = 16
    _MERIDIAN_STEPS = 12

    def __init__(
        self,
        body: BodyModel,
        *,
        rings: int | None = None,
        meridians: int | None = None,
        ramp: float = 0.010,
        clearance: float = 0.010,
    ) -> None:
        super().__init__()
        self.ramp, self.clearance = ramp, clearance
        rings = rings or max(7, min(18, 126 // max(body.num_parts, 1)))
        meridians = meridians or rings - 1
        real, device = torch.float64, body.tie.device
        shape = body.part_shape.to(real)[:, None, None, :]
        heights = (torch.arange(rings, dtype=real, device=device) + 0.5) * (1.9 / rings) - 0.95
        around = torch.arange(self._RING_STEPS + 1, dtype=real, device=device)
        eta, omega = torch.meshgrid(
            heights.asin(), around * (2 * torch.pi / self._RING_STEPS) - torch.pi, indexing="ij"
        )
        full = (body.num_parts, *eta.shape)
        ring = surface_points(shape, eta.expand(full), omega.expand(full))
        pole = torch.linspace(-1, 1, self._MERIDIAN_STEPS + 1, dtype=real, device=device)
        sides = torch.arange(meridians, dtype=real, device=device)
        omega, eta = torch.meshgrid(
            sides * (2 * torch.pi / meridians) + 0.1, pole * torch.pi / 2, indexing="ij"
        )
        full = (body.num_parts, *eta.shape)
        meridian = surface_points(shape, eta.expand(full), omega.expand(full))
        per_part = 2 * rings + meridians
        parts = torch.arange(body.num_parts, device=device)
        touching = torch.eye(body.num_parts, dtype=torch.bool, device=device)
        for first, second in body.neighbours:
            i, j = body.part_names.index(first), body.part_names.index(second)
            touching[i, j] = touching[j, i] = True
        touching &= ~torch.eye(body.num_parts, dtype=torch.bool, device=device)
        node_part = parts.repeat_interleave(per_part)
        for name, value in (
            ("node_part", node_part),
            ("node_link", body.part_link.repeat_interleave(per_part)),
            ("ring_points", ring.points.to(body.dtype)),
            ("ring_normals", ring.normals.to(body.dtype)),
            ("meridian_points", meridian.points.to(body.dtype)),
            ("meridian_normals", meridian.normals.to(body.dtype)),
            ("other", 1 - torch.eye(body.num_parts, device=device)[node_part]),
            ("touching", touching[node_part].float()),
        ):
            self.register_buffer(name, value, persistent=False)

    @property
    def num_nodes(self) -> int:
        """Number of contour nodes."""
        return len(self.node_part)

    def forward(
        self, body: BodyModel, pose: BodyPose, centre_world: Float[Tensor, "3"]
    ) -> ContourNodes:
        """Predict the occluding contours.

        Args:
            body: The body that this predictor was made for (its base may have moved).
            pose: Any number of posed bodies.
            centre_world: The camera's centre, metres.

        Returns:
            Nodes in the order of `node_part`.
        """
        rotation, centre = body.part_poses(pose)
        centre_world = centre_world.to(centre)
        eye = ((centre_world - centre)[..., None, :] @ rotation)[..., 0, :]
        ring = _ring_crossings(self.ring_points, self.ring_normals, eye)
        meridian = _meridian_crossings(self.meridian_points, self.meridian_normals, eye)
        points, normals, exists = (
            torch.cat(pair, dim=eye.dim() - 1) for pair in zip(ring, meridian, strict=True)
        )
        normals = normals / normals.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        turn = rotation.transpose(-1, -2)
        points = (points @ turn + centre[..., None, :]).flatten(-3, -2)
        normals = (normals @ turn).flatten(-3, -2)
        exists = exists.flatten(-2)
        rays = points + self.clearance * normals - centre_world
        visible, free = line_of_sight(
            body, rotation, eye, rays, other=self.other, touching=self.touching, ramp=self.ramp
        )
        return ContourNodes(points, normals, exists * free, visible)


def line_of_sight(
    body: BodyModel,
    rotation: Float[Tensor, "*batch parts 3 3"],
    eye: Float[Tensor, "*batch parts 3"],
    rays: Float[Tensor, "*batch p 3"],
    *,
    other: Float[Tensor, "p parts"],
    touching: Float[Tensor, "p parts"] | None = None,
    ramp: float = 0.010,
) -> tuple[Float[Tensor, "*batch p"], Float[Tensor, "*batch p"]]:
    """Visibility of points past all parts, and whether neighbouring parts leave them free.

    Args:
        body: The body.
        rotation: World orientations of the parts.
        eye: The camera's centre in the frames of the parts, metres.
        rays: From the camera's centre to the points, world axes, metres.
        other: 0 where a part cannot hide a point (its own), else 1.
        touching: 1 where a part is a neighbour of the point's own; None: nothing is.
        ramp: Width of the transition between visible and hidden, metres.

    Returns:
        1 where nothing is in front of the point, 0 where a part is; and 1 where no neighbouring
        part is close behind.
    """
    # All pairs of node and part at once, in the part's frame and in units of its semi-axes.
    # Single precision: the closest approach is found as a vector, without cancellation.
    shape = body.part_shape.float()
    scale = 1 / shape[:, :3]
    axes = (rotation.float() * scale[:, None, :]).movedim(-3, -1)
    rays, eye_single = rays.float().clamp(-_FAR, _FAR), eye.float().clamp(-_FAR, _FAR)
    rx, ry, rz = (rays @ axes[..., i, :] for i in range(3))
    ox, oy, oz = (eye_single * scale)[..., None, :, :].unbind(-1)
    # Height of closest approach decides the taper of the cross-section.
    nearest = -(ox * rx + oy * ry + oz * rz) / (rx * rx + ry * ry + rz * rz).clamp(min=_TINY)
    height = (oz + nearest * rz).clamp(-1, 1)
    fx, fy = 1 / (1 + shape[:, 5] * height), 1 / (1 + shape[:, 6] * height)
    ox, oy, rx, ry = ox * fx, oy * fy, rx * fx, ry * fy
    square = (rx * rx + ry * ry + rz * rz).clamp(min=_TINY)
    nearest = -(ox * rx + oy * ry + oz * rz) / square
    px, py, pz = ox + nearest * rx, oy + nearest * ry, oz + nearest * rz
    depth = 1 - (px * px + py * py + pz * pz)
    thickness = shape[:, :2].mean(-1)
    # How deep the ray passes inside, and how far in front of the node it enters, metres; parts
    # behind the camera hide nothing.
    crossed = (depth * (0.5 / ramp * thickness)).clamp(0, 1) * (nearest > 0)
    entry = nearest - (depth.clamp(min=0) / square).sqrt()
    front = (1 - entry) * eye_single.norm(dim=-1)[..., None, :]
    covered = crossed * (front / ramp).clamp(0, 1) * other
    visible = (1 - covered).prod(-1).to(eye)
    if touching is None:
        return visible, torch.ones_like(visible)
    # A neighbour just behind the node hides the step in depth that makes an image edge.
    close = crossed * (4 + front / thickness).clamp(0, 1) * touching
    return visible, (1 - close).prod(-1).to(eye)


def visible_nodes(
    body: BodyModel,
    pose: BodyPose,
    centre_world: Float[Tensor, "3"],
    points: Float[Tensor, "*batch p 3"],
    node_part: Int[Tensor, " p"],
) -> Float[Tensor, "*batch p"]:
    """Visibility of surface nodes past the other parts: 1 where seen, 0 where hidden.

    Args:
        body: The body.
        pose: Its poses.
        centre_world: The camera's centre, metres.
        points: Nodes, world frame, metres.
        node_part: The part of each node.
    """
    rotation, centre = body.part_poses(pose)
    centre_world = centre_world.to(centre)
    eye = ((centre_world - centre)[..., None, :] @ rotation)[..., 0, :]
    other = 1 - torch.eye(body.num_parts, device=points.device)[node_part]
    return line_of_sight(body, rotation, eye, points - centre_world, other=other)[0]


def _ring_crossings(
    points: Float[Tensor, "parts rings steps 3"],
    normals: Float[Tensor, "parts rings steps 3"],
    eye: Float[Tensor, "*batch parts 3"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Both crossings of every ring: `[*batch parts 2*rings ...]`."""
    parts, rings, steps, _ = points.shape
    facing = _facing(points, normals, eye)
    clear = _clearness(facing, eye)
    before, after = facing[..., :-1], facing[..., 1:]
    found = []
    index = torch.arange(parts * rings, device=points.device).reshape(parts, rings)
    for crossing in ((before < 0) & (after >= 0), (before >= 0) & (after < 0)):
        exists, step = crossing.max(dim=-1)
        found.append(
            (*_interpolate(points, normals, facing, index * steps + step, step), exists * clear)
        )
    return tuple(torch.cat(pair, dim=eye.dim() - 1) for pair in zip(*found, strict=True))  # type: ignore[return-value]


def _meridian_crossings(
    points: Float[Tensor, "parts meridians steps 3"],
    normals: Float[Tensor, "parts meridians steps 3"],
    eye: Float[Tensor, "*batch parts 3"],
) -> tuple[Tensor, Tensor, Tensor]:
    """The crossing of every meridian: `[*batch parts meridians ...]`."""
    parts, meridians, steps, _ = points.shape
    facing = _facing(points, normals, eye)
    crossing = (facing[..., :-1] < 0) != (facing[..., 1:] < 0)
    exists, step = crossing.max(dim=-1)
    index = torch.arange(parts * meridians, device=points.device).reshape(parts, meridians)
    # Towards which side the curve turns on either side of the crossing: this also fades a contour
    # that leaves over a pole, before another crossing takes its place.
    later = torch.arange(steps, device=points.device) > step[..., None]
    turned = torch.where(facing.gather(-1, step[..., None]) < 0, facing, -facing)
    exists = exists * _clearness(torch.where(later, turned.clamp(min=0), turned.clamp(max=0)), eye)
    return (*_interpolate(points, normals, facing, index * steps + step, step), exists)


def _clearness(facing: Tensor, eye: Tensor) -> Float[Tensor, "*batch parts c"]:
    """1 where a curve turns well to both sides of the line of sight; 0 where it only grazes it.

    A contour is born where a curve touches the line of sight, with both crossings in one place.
    """
    distance = eye.norm(dim=-1)[..., None]
    turned = torch.minimum(facing.amax(-1), -facing.amin(-1))
    return (turned / (_GRAZING * distance)).clamp(0, 1)


def _facing(points: Tensor, normals: Tensor, eye: Tensor) -> Float[Tensor, "*batch parts c steps"]:
    """`n . (c - p)` at every node; positive where it faces the camera."""
    flat = normals.flatten(1, 2)
    towards = (eye[..., None, :] @ flat.transpose(-1, -2))[..., 0, :]
    offset = (flat * points.flatten(1, 2)).sum(-1)
    return (towards - offset).unflatten(-1, points.shape[1:3])


def _interpolate(
    points: Tensor,
    normals: Tensor,
    facing: Tensor,
    flat: Int[Tensor, "*batch parts c"],
    step: Tensor,
) -> tuple[Tensor, Tensor]:
    """Point and normal where `facing` changes sign between `step` and the next node."""
    here = facing.gather(-1, step[..., None])[..., 0]
    there = facing.gather(-1, step[..., None] + 1)[..., 0]
    change = here - there
    t = torch.where(change != 0, here / torch.where(change != 0, change, 1), 0.5).clamp(0, 1)
    table = torch.cat([points, normals], dim=-1).flatten(0, 2)
    mixed = table[flat] * (1 - t[..., None]) + table[flat + 1] * t[..., None]
    return mixed[..., :3], mixed[..., 3:]
