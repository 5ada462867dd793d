"""Twin of the interpenetration prior: pair by pair through hand-written kinematics."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.body.surface import surface_points

from . import kinematics


def part_frames(body: BodyModel, x: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Orientation and centre of every part in the frame of the root link (one pose, no batch)."""
    q = x @ body.tie.T + body.offset
    values = dict(zip(body.tree.joint_names, q.unbind(-1), strict=True))
    links = kinematics.forward_kinematics(body.tree.specifications, values)
    frames = []
    for part, link in enumerate(body.part_link.tolist()):
        turn, origin = links[body.tree.link_names[link]]
        centre = origin + turn @ body.part_translation[part]
        frames.append((turn @ body.part_rotation[part], centre))
    return frames


def nodes_of(body: BodyModel, part: int) -> Tensor:
    """Rings of nodes and the poles, in the part's frame."""
    rings, meridians = 4, 6
    shape = body.part_shape[part]
    nodes = []
    for ring in range(rings):
        for meridian in range(meridians):
            eta = math.asin((2 * ring + 1) / rings - 1)
            nodes.append((eta, 2 * math.pi * meridian / meridians - math.pi))
    nodes += [(-math.pi / 2, 0.0), (math.pi / 2, 0.0)]
    eta, omega = torch.tensor(nodes, dtype=shape.dtype).unbind(-1)
    return surface_points(shape.expand(len(nodes), 9), eta, omega).points


def radial_square(shape: Tensor, points: Tensor) -> Tensor:
    """`F^e1` of a superquadric, its taper levelling off smoothly beyond the ends."""
    a1, a2, a3, e1, e2, taper_x, taper_y = shape[:7]
    x, y, z = points.unbind(-1)
    most = max(float(taper_x.abs()), float(taper_y.abs()))
    room = 0.5 if most <= 0.5 else (1 - most) / (2 * most)
    past = z.abs() / a3 - 1
    beyond = z.sign() * (1 + past * room / (past.square() + room**2).sqrt())
    height = torch.where(past > 0, beyond, z / a3)
    x, y = x / (1 + taper_x * height), y / (1 + taper_y * height)
    section = (x / a1).abs() ** (2 / e2) + (y / a2).abs() ** (2 / e2)
    return (section ** (e2 / e1) + (z / a3).abs() ** (2 / e1)) ** e1


def potential(square: Tensor, p: float, sharpness: float, end: float) -> Tensor:
    """The paper's `exp(-f |f|^(p-1))` less its tangent at the end."""
    f = sharpness * (square - 1)
    u = f * f.abs() ** (p - 1)
    near = (-u).exp() - math.exp(-end) * (1 + end - u)
    return torch.where(u < end, near, 0.0)


def may_collide(body: BodyModel, a: int, b: int) -> bool:
    """Whether the parts do not touch by construction, and some joint but a length lies between."""
    names = body.part_names[a], body.part_names[b]
    if a == b or names in body.neighbours or names[::-1] in body.neighbours:
        return False
    for joint in range(body.tree.num_joints):
        moves = [bool(body.tree.ancestors[joint, body.part_link[part]]) for part in (a, b)]
        if moves[0] != moves[1] and not body.tree.joint_names[joint].endswith("_length"):
            return True
    return False


def interpenetration(
    body: BodyModel, x: Tensor, *, weight: float, p: float, sharpness: float, end: float
) -> Tensor:
    """The cost of one pose (no batch), differentiable in x."""
    frames = part_frames(body, x)
    total = x.sum() * 0
    for a in range(body.num_parts):
        nodes = nodes_of(body, a)
        turn, centre = frames[a]
        points = nodes @ turn.T + centre
        for b in range(body.num_parts):
            if not may_collide(body, a, b):
                continue
            other_turn, other_centre = frames[b]
            local = (points - other_centre) @ other_turn
            square = radial_square(body.part_shape[b], local)
            square = square[square < 1 + end / sharpness + 1]
            if len(square):
                cost = potential(square, p, sharpness, end)
                total = total + weight * cost.sum() / len(nodes)
    return total
