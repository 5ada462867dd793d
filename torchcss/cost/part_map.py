"""Which part of a posed body each pixel sees, by rasterising its surface, and which see none.

For masks, for colours, for the overlap of silhouettes. The costs do not use it: for thousands of
samples visibility is found node by node (`torchcss.cost.visibility`).
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn import functional

from torchcss.body.model import BodyModel
from torchcss.types import Vectors
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import grid_faces, nearest_faces

_POSES_AT_ONCE = 16
"""Poses drawn together: it bounds the memory."""

_COARSE = 4
_MARGIN = 2
"""Pixels of the image, along each side, to one that is looked at for what is bare, and how many of
these a body may be off its pose."""

_COVERED = 0.3
"""Posterior probability of being covered from which a pixel is not bare. A mode that is all but
ruled out would hide the background from the one that is right."""


def part_map(
    body: BodyModel,
    state: Vectors,
    camera: Camera,
    *,
    rings: int = 12,
    meridians: int = 16,
    girth: Float[Tensor, "*#batch"] | float = 1.0,
) -> Int[Tensor, "*batch h w"]:
    """The part that each pixel sees, -1 where it sees none.

    Args:
        body: The body on its base.
        state: Its pose, or poses.
        camera: Camera of the image.
        rings: Latitudes of the mesh of each part.
        meridians: Longitudes of the mesh of each part.
        girth: Factor on the cross-sections of all parts, one for all poses or one for each.
    """
    width, height = camera.image_size_wh
    if body.num_parts == 0:
        return torch.full((*state.shape[:-1], height, width), -1, device=state.device)
    mesh = body.mesh(rings, meridians)
    faces = grid_faces(rings, meridians).to(mesh.points.device)
    rotation, centre = body.part_poses(body.pose(state))
    across = torch.as_tensor(girth, dtype=mesh.points.dtype, device=mesh.points.device)
    scale = torch.stack([across, across, torch.ones_like(across)], dim=-1)[..., None, None, :]
    vertices = (mesh.points.flatten(1, 2) * scale) @ rotation.mT + centre[..., None, :]
    parts = torch.arange(body.num_parts, device=faces.device)
    every = (faces + vertices.shape[-2] * parts[:, None, None]).flatten(0, 1)
    label = parts.repeat_interleave(len(faces))
    batch = vertices.shape[:-3]
    vertices = vertices.flatten(-3, -2).reshape(-1, vertices.shape[-3] * vertices.shape[-2], 3)
    seen = []
    for some in vertices.split(_POSES_AT_ONCE):
        uv, depth, valid = camera.project(some)
        seen.append(nearest_faces(uv, depth, every, height, width, valid=valid, label=label))
    return (seen[0] if len(seen) == 1 else torch.cat(seen)).reshape(*batch, height, width)


def grow(masks: Shaped[Tensor, "layers h w"], radius: int) -> Shaped[Tensor, "layers h w"]:
    """Masks and all that is within a square of so many pixels about them.

    Args:
        masks: The masks; of images, the greatest number in the square.
        radius: Half the side of the square, pixels.
    """
    for axis in (-1, -2):
        done = 0
        while done < radius:
            # What has been grown by `done` may be shifted so far: no gap, even at the border.
            step = min(done + 1, radius - done)
            kept, wider = max(masks.shape[axis] - step, 0), masks.clone()
            for to, by in ((-kept, 0), (0, -kept)):
                part = wider.narrow(axis, to, kept)
                torch.maximum(part, masks.narrow(axis, by, kept), out=part)
            masks, done = wider, done + step
    return masks


def bare_pixels(
    body: BodyModel, modes: Float[Tensor, "k n"], log_weight: Float[Tensor, " k"], camera: Camera
) -> Bool[Tensor, "h w"]:
    """Pixels that no likely pose covers, nor comes near.

    Args:
        body: The body on its base.
        modes: Its poses.
        log_weight: Their weights, not necessarily normalised.
        camera: Camera of the image.
    """
    width, height = camera.image_size_wh
    covered = part_map(body, modes, camera.scaled(1 / _COARSE), rings=6, meridians=10) >= 0
    share = (covered * log_weight.softmax(0)[:, None, None]).sum(0)
    near = grow((share > _COVERED)[None], _MARGIN)[None].to(modes)
    return functional.interpolate(near, size=(height, width))[0, 0] == 0
