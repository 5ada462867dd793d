"""Twin of the visibility test: a slow ray caster over the true tapered, bent superquadrics.

Every line of sight is marched through every part in small steps, and the step that comes nearest to
the surface is searched further. Shapes are evaluated from their definition, in double precision.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchcss.body.model import BodyModel, BodyPose

STEPS = 48
"""Samples of a line within a part's bounding sphere."""
REFINEMENTS = 25
"""Golden sections of the two steps around the sample nearest to the part."""
OWN_MARGIN = 1e-5
"""A line through the node's own part is not looked at in this last stretch, metres."""


def shape_function(shape: Tensor, points: Tensor) -> Tensor:
    """Negative inside a part, positive outside: one shape `[9]`, points `[m 3]` in its frame."""
    a1, a2, a3, e1, e2, taper_x, taper_y, bend_x, bend_y = shape.double().tolist()
    bend, direction = math.hypot(bend_x, bend_y), math.atan2(bend_y, bend_x)
    x, y, z = points.unbind(-1)
    if bend != 0:
        # The axis is a circle about a centre at 1 / bend along `direction`; the length of arc is z.
        c, s = math.cos(direction), math.sin(direction)
        towards, across = c * x + s * y, c * y - s * x
        to_axis = 1 / bend - towards
        z_arc = torch.atan2(z, to_axis) / bend
        towards = 1 / bend - (to_axis.square() + z.square()).sqrt()
        x, y, z = c * towards - s * across, s * towards + c * across, z_arc
    height = (z / a3).clamp(-1, 1)
    u, v = x / (a1 * (1 + taper_x * height)), y / (a2 * (1 + taper_y * height))
    section = u.abs() ** (2 / e2) + v.abs() ** (2 / e2)
    return section ** (e2 / e1) + (z / a3).abs() ** (2 / e1) - 1


def least_value(
    shape: Tensor, start: Tensor, along: Tensor, begin: Tensor, end: Tensor
) -> tuple[Tensor, Tensor]:
    """Least of the shape function on `start + t along`, `begin <= t <= end`, and its t; `[m]`."""

    def value(t: Tensor) -> Tensor:
        return shape_function(shape, start + t[:, None] * along)

    step = (end - begin) / STEPS
    best, place = value(begin), begin
    for index in range(1, STEPS + 1):
        t = begin + index * step
        here = value(t)
        place, best = torch.where(here < best, t, place), torch.minimum(here, best)
    # Only where it is still open whether the line enters.
    open_ = (best > 0) & (best < 10)
    shrunk, t = best[open_], place[open_]
    start, along = start[open_], along[open_]
    low, high = (
        torch.maximum(begin[open_], t - step[open_]),
        torch.minimum(end[open_], t + step[open_]),
    )
    ratio = (math.sqrt(5) - 1) / 2
    for _ in range(REFINEMENTS):
        left, right = high - ratio * (high - low), low + ratio * (high - low)
        at_left, at_right = value(left), value(right)
        low, high = (
            torch.where(at_left < at_right, low, left),
            torch.where(at_left < at_right, right, high),
        )
        shrunk = torch.minimum(shrunk, torch.minimum(at_left, at_right))
    best[open_] = shrunk
    return best, place


def is_hidden(
    body: BodyModel,
    pose: BodyPose,
    centre_world: Tensor,
    targets: Tensor,
    own: Tensor,
    *,
    by_own: bool = False,
) -> Tensor:
    """Whether parts are on the lines of sight from the camera to the targets.

    Args:
        body: The body, in double precision.
        pose: Poses `[b]`, or one without batch.
        centre_world: Camera centre.
        targets: Places `[... p 3]`, any leading dimensions before those of the pose.
        own: The part of each target `[p]`.
        by_own: Whether to look at the target's own part, instead of at all others.
    """
    rotation, centre = body.part_poses(pose)
    shape = targets.shape[:-1]
    hidden = torch.zeros(shape, dtype=torch.bool)
    ray = targets - centre_world
    length = ray.norm(dim=-1)
    ray = ray / length[..., None]
    own = own.expand(shape)
    for part in range(body.num_parts):
        radius = 1.5 * float(body.part_shape[part, :3].norm())
        middle = (centre[..., part, :] - centre_world)[..., None, :].expand(targets.shape)
        depth = (middle * ray).sum(-1)
        aside = (middle - depth[..., None] * ray).norm(dim=-1)
        reach = (radius**2 - aside.square()).clamp(min=0).sqrt()
        stop = length - OWN_MARGIN if by_own else length
        begin, end = (depth - reach).clamp(min=0), torch.minimum(depth + reach, stop)
        looked = (end > begin) & ~hidden & ((own == part) == by_own)
        turn = rotation[..., part, :, :][..., None, :, :].expand(*targets.shape, 3)[looked]
        start = (-middle[looked][:, None, :] @ turn)[:, 0]
        along = (ray[looked][:, None, :] @ turn)[:, 0]
        value, _ = least_value(body.part_shape[part], start, along, begin[looked], end[looked])
        hidden[looked] = value < 0
    return hidden


def boundary_distance(
    body: BodyModel,
    pose: BodyPose,
    centre_world: Tensor,
    targets: Tensor,
    own: Tensor,
    distances: tuple[float, ...],
    *,
    by_own: bool = False,
) -> Tensor:
    """The first of `distances` by which a target must move for its visibility to change, or inf."""
    truth = is_hidden(body, pose, centre_world, targets, own, by_own=by_own)
    found = torch.full(truth.shape, math.inf, dtype=targets.dtype)
    for distance in reversed(distances):
        moved = neighbourhood(targets, centre_world, distance)
        changed = (is_hidden(body, pose, centre_world, moved, own, by_own=by_own) != truth).any(0)
        found[changed] = distance
    return found


def neighbourhood(targets: Tensor, centre_world: Tensor, distance: float) -> Tensor:
    """The targets moved by `distance` in ten directions, `[10 p 3]`: across the ray, along it."""
    ray = targets - centre_world
    ray = ray / ray.norm(dim=-1, keepdim=True)
    helper = torch.zeros_like(ray)
    helper.scatter_(-1, ray.abs().argmin(dim=-1, keepdim=True), 1.0)
    u = torch.linalg.cross(ray, helper)
    u = u / u.norm(dim=-1, keepdim=True)
    v = torch.linalg.cross(ray, u)
    angles = (torch.arange(8, dtype=targets.dtype) * (torch.pi / 4))[
        (...,) + (None,) * targets.dim()
    ]
    across = angles.cos() * u + angles.sin() * v
    return targets + distance * torch.cat([across, torch.stack([ray, -ray])])
