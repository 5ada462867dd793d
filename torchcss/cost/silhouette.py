"""Which part of a posed body each pixel sees, by rasterising its surface.

For masks, for colours, for the overlap of silhouettes. The costs do not use it: for thousands of
samples visibility is found node by node (`torchcss.cost.visibility`).
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.raster import grid_faces, nearest_faces
from torchcss.vision.camera import Camera

_POSES_AT_ONCE = 16
"""Poses drawn together: it bounds the memory."""


def part_map(
    body: BodyModel,
    state: Float[Tensor, "*batch n"],
    camera: Camera,
    *,
    rings: int = 12,
    meridians: int = 16,
    girth: float = 1.0,
) -> Int[Tensor, "*batch h w"]:
    """The part that each pixel sees, -1 where it sees none.

    Args:
        body: The body on its base.
        state: Its pose, or poses.
        camera: Camera of the image.
        rings: Latitudes of the mesh of each part.
        meridians: Longitudes of the mesh of each part.
        girth: Factor on the cross-sections of all parts.
    """
    width, height = camera.image_size_wh
    if body.num_parts == 0:
        return torch.full((*state.shape[:-1], height, width), -1, device=state.device)
    mesh = body.mesh(rings, meridians)
    faces = grid_faces(rings, meridians).to(mesh.points.device)
    rotation, centre = body.part_poses(body.pose(state))
    points = mesh.points * mesh.points.new_tensor([girth, girth, 1.0])
    vertices = points.flatten(1, 2) @ rotation.mT + centre[..., None, :]
    offsets = vertices.shape[-2] * torch.arange(body.num_parts, device=faces.device)
    every = (faces + offsets[:, None, None]).flatten(0, 1)
    batch = vertices.shape[:-3]
    vertices = vertices.flatten(-3, -2).reshape(-1, vertices.shape[-3] * vertices.shape[-2], 3)
    seen = every.new_empty(len(vertices), height, width)
    for first in range(0, len(vertices), _POSES_AT_ONCE):
        uv, depth, valid = camera.project(some := vertices[first : first + _POSES_AT_ONCE])
        face = nearest_faces(uv, depth, every, height, width, valid=valid)
        seen[first : first + len(some)] = torch.where(face >= 0, face // len(faces), face)
    return seen.reshape(*batch, height, width)
