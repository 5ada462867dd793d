"""Twin of the occlusion test: march along every line of sight through the true surfaces."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.surface import implicit

STEPS = 48


def is_hidden(
    body: BodyModel, pose: BodyPose, centre_world: Tensor, targets: Tensor, own: Tensor
) -> Tensor:
    """Whether a part other than a target's own lies on its line of sight (one pose, no batch).

    Only the stretch of the line inside a part's bounding sphere is marched.
    """
    rotation, centre = body.part_poses(pose)
    hidden = torch.zeros(len(targets), dtype=torch.bool)
    ray = targets - centre_world
    fractions = (torch.arange(STEPS, dtype=targets.dtype) + 0.5) / STEPS
    for part in range(body.num_parts):
        shape = body.part_shape[part]
        radius = 1.5 * float(shape[:3].norm())
        square = ray.square().sum(-1)
        nearest = ((centre[part] - centre_world) * ray).sum(-1) / square
        reach = radius / square.sqrt()
        first, last = (nearest - reach).clamp(0, 1), (nearest + reach).clamp(0, 1)
        t = first[:, None] + fractions * (last - first)[:, None]
        points = centre_world + t[..., None] * ray[:, None, :]
        local = (points - centre[part]) @ rotation[part]
        inside = (implicit(shape, local) < 0) & (last > first)[:, None]
        hidden |= inside.any(-1) & (own != part)
    return hidden


def neighbourhood(targets: Tensor, centre_world: Tensor, distance: float) -> Tensor:
    """The targets moved by `distance` in ten directions, `[10 p 3]`: across the ray, along it."""
    ray = targets - centre_world
    ray = ray / ray.norm(dim=-1, keepdim=True)
    helper = torch.zeros_like(ray)
    helper.scatter_(-1, ray.abs().argmin(dim=-1, keepdim=True), 1.0)
    u = torch.linalg.cross(ray, helper)
    u = u / u.norm(dim=-1, keepdim=True)
    v = torch.linalg.cross(ray, u)
    angles = torch.arange(8, dtype=targets.dtype) * (torch.pi / 4)
    across = angles.cos()[:, None, None] * u + angles.sin()[:, None, None] * v
    return targets + distance * torch.cat([across, torch.stack([ray, -ray])])
