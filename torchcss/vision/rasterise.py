"""Z-buffer labels of triangle meshes, nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from torchcss.errors import ShapeError, check_shape
from torchcss.kernels import compiler
from torchcss.kernels.checked import run

Faces = Int[Tensor, "f 3"]
"""Corner indices of triangles."""
Places = Float[Tensor, "v 2"]
"""Projected vertices, pixels."""

_NEAREST_DEPTH = 1e-6
"""Metres; a vertex at or behind this depth is behind the camera."""

_FARTHEST_PIXEL = 1e9
"""A projection further out than this is no longer exact in float64; its triangles are dropped."""

LEAST_AREA = 1e-12
"""Square pixels, doubled; a triangle seen edge-on has no pixels, and no plane to divide by."""

_PIXELS_AT_ONCE = 4_000_000
"""Candidate pixels expanded together: bounds the memory when a mesh fills the image many times."""


class Fragments(NamedTuple):
    """What is seen at every pixel centre.

    Attributes:
        face: Index of the nearest triangle, -1 where there is none.
        barycentric: Perspective-correct weights of its three corners, zero where there is none.
        depth: Depth of the surface in the unit of the input, `inf` where there is none.
    """

    face: Int[Tensor, "h w"]
    barycentric: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]


def _expand(counts: Int[Tensor, " a"]) -> tuple[Int[Tensor, " b"], Int[Tensor, " b"]]:
    """List `counts[a]` entries for every a: which a each entry belongs to, and its place there."""
    owner = torch.repeat_interleave(counts)
    starts = counts.cumsum(0) - counts
    place = torch.arange(owner.shape[0], device=counts.device) - starts.index_select(0, owner)
    return owner, place


def rasterise(
    uv: Places,
    depth: Float[Tensor, " v"],
    faces: Faces,
    height: int,
    width: int,
    *,
    valid: Bool[Tensor, " v"] | None = None,
) -> Fragments:
    """Find the nearest triangle at every pixel centre.

    Both sides of a triangle are drawn. A triangle with a corner behind the camera, not finite, not
    `valid` or projected beyond 1e9 pixels is left out whole; everything else is clipped to the
    image. Of triangles at the same depth (to float32) the one with the lowest index wins. Nothing
    here is differentiable.

    Args:
        uv: Projected vertices, pixels; u counts columns, v counts rows, centres at integers.
        depth: Depth of the vertices along the optical axis.
        faces: Corner indices of the triangles.
        height: Rows of the image.
        width: Columns of the image.
        valid: Vertices that may be used; all when absent.

    Raises:
        ShapeError: If a shape is wrong or a face names a vertex that does not exist.
    """
    check_shape("uv", uv, None, 2)
    check_shape("depth", depth, uv.shape[0])
    check_shape("faces", faces, None, 3)
    if height < 1 or width < 1:
        raise ShapeError(f"image size: expected at least 1 x 1, got {height} x {width}")
    if faces.numel() and (int(faces.min()) < 0 or int(faces.max()) >= uv.shape[0]):
        raise ShapeError(
            f"faces: expected vertex indices from 0 to {uv.shape[0] - 1}, got "
            f"{int(faces.min())} to {int(faces.max())}; does the mesh belong to these vertices?"
        )
    valid = torch.ones_like(depth, dtype=torch.bool) if valid is None else valid
    uv, depth, faces = uv.detach(), depth.detach(), faces.long()
    place, distance = uv.double(), depth.double()
    nearest = nearest_faces(uv[None], depth[None], faces, height, width, valid=valid[None])
    nearest = nearest.flatten()
    pixel = torch.nonzero(nearest >= 0)[:, 0]
    face = nearest[pixel]

    table = torch.cat(
        (place[faces].flatten(1), distance[faces], doubled_areas(place, faces)[:, None]), -1
    )
    parts, weighted = _barycentric(table.index_select(0, face), pixel % width, pixel // width)
    total = weighted.sum(0)
    barycentric = uv.new_zeros(height * width, 3)
    surface = uv.new_full((height * width,), torch.inf)
    barycentric[pixel] = (weighted / total).T.to(uv)
    surface[pixel] = (parts.sum(0) / total).to(uv)
    return Fragments(
        face=nearest.view(height, width),
        barycentric=barycentric.view(height, width, 3),
        depth=surface.view(height, width),
    )


def _barycentric(
    triangles: Float[Tensor, "p 10"], column: Int[Tensor, " p"], row: Int[Tensor, " p"]
) -> tuple[Float[Tensor, "3 p"], Float[Tensor, "3 p"]]:
    """Shares of the corners in the picture at pixels of triangles, and these by inverse depth.

    The shares are the areas of the three sub-triangles. Rounding makes one negative at a border,
    and, where corners are 1e8 pixels away, may leave none positive; then the middle of the triangle
    has to do.
    """
    u0, v0, u1, v1, u2, v2, *depths, twice = triangles.unbind(-1)
    u0, u1, u2, v0, v1, v2 = u0 - column, u1 - column, u2 - column, v0 - row, v1 - row, v2 - row
    parts = torch.stack((u1 * v2 - v1 * u2, u2 * v0 - v2 * u0, u0 * v1 - v0 * u1)) / twice
    parts = parts.clamp_min(0)
    parts = torch.where(parts.sum(0) > 0, parts, 1 / 3)
    return parts, parts / torch.stack(depths)


def nearest_faces(
    uv: Float[Tensor, "b v 2"],
    depth: Float[Tensor, "b v"],
    faces: Faces,
    height: int,
    width: int,
    *,
    valid: Bool[Tensor, "b v"],
    label: Int[Tensor, " f"] | None = None,
) -> Int[Tensor, "b h w"]:
    """Only the `face` of `rasterise`, of many pictures of one mesh at once.

    Args:
        uv: Projected vertices of each picture, pixels.
        depth: Their depths.
        faces: Corner indices of the triangles, the same in every picture.
        height: Rows of a picture.
        width: Columns of a picture.
        valid: Vertices that may be used.
        label: What stands for each triangle in the pictures; None: its index.

    Raises:
        ShapeError: If a shape is wrong.
    """
    check_shape("depth", depth, None, None)
    check_shape("uv", uv, *depth.shape, 2)
    check_shape("valid", valid, *depth.shape)
    label = torch.arange(len(faces), device=faces.device) if label is None else label
    check_shape("label", label, len(faces))
    # float64, so that neither large coordinates nor thin triangles open cracks.
    place, distance, faces = uv.detach().double(), depth.detach().double(), faces.long()
    usable = valid & (place.abs() < _FARTHEST_PIXEL).all(-1)
    usable = usable & (distance > _NEAREST_DEPTH) & (distance < torch.inf)
    pictures, vertices = distance.shape
    if compiler.COMPILED and place.device.type == "cpu" and not torch.compiler.is_compiling():
        # Compiled: only where it is used.
        from torchcss.vision.rasterise_kernels import draw_triangles

        near = torch.full((pictures, height, width), -1, dtype=torch.float32)
        seen = torch.full_like(near, -1, dtype=torch.long)
        given = (part.contiguous() for part in (place, distance, usable, faces, label))
        run(draw_triangles, *given, near, seen)
        return seen
    if not pictures or not len(faces):
        return faces.new_full((pictures, height, width), -1)
    first = vertices * torch.arange(pictures, device=faces.device)
    every = (faces + first[:, None, None]).flatten(0, 1)
    place, distance = place.flatten(0, 1), distance.flatten()
    drawn = usable.flatten()[every].all(-1) & (doubled_areas(place, every).abs() > LEAST_AREA)
    drawn = torch.nonzero(drawn)[:, 0]
    nearest = _by_spans(place, distance, every, drawn, height, width, pictures)
    nearest = nearest.where(nearest < 0, label.repeat(pictures)[nearest])
    return nearest.view(pictures, height, width)


def doubled_areas(place: Places, faces: Faces) -> Float[Tensor, " f"]:
    """Signed areas of triangles, doubled.

    Rows count downwards: a triangle that runs anticlockwise to the eye has a negative area.

    Args:
        place: Projected vertices, pixels.
        faces: Corner indices.
    """
    first, second, third = place[faces].unbind(1)
    a, b = second - first, third - first
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _by_spans(
    place: Places,
    distance: Float[Tensor, " v"],
    faces: Faces,
    drawn: Int[Tensor, " d"],
    height: int,
    width: int,
    pictures: int,
) -> Int[Tensor, " bhw"]:
    """Spans of all triangles, and the nearest of these on every pixel, -1 where there is none.

    Of several pictures each has as many of the triangles, one after the other.
    """
    corner, inverse = place[faces[drawn]], 1 / distance[faces[drawn]]
    order = corner[..., 1].argsort(-1)
    inverse = inverse.gather(-1, order)
    (x0, x1, x2), (y0, y1, y2) = (corner[..., axis].gather(-1, order).unbind(-1) for axis in (0, 1))
    # Inverse depth is affine in the pixel: w = w0 + along (x - x0) + down (y - y0).
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    w0, rise1, rise2 = inverse[:, 0], inverse[:, 1] - inverse[:, 0], inverse[:, 2] - inverse[:, 0]
    along = (rise1 * (y2 - y0) - rise2 * (y1 - y0)) / area
    down = (rise2 * (x1 - x0) - rise1 * (x2 - x0)) / area
    lowest, highest = inverse.amin(-1), inverse.amax(-1)

    # Triangles to rows.
    top, bottom = (y.ceil().clamp(0, height).long() for y in (y0, y2))
    triangle, step = _expand(bottom - top)
    row = top[triangle] + step
    y = row.double()
    table = torch.stack((x0, y0, x1, y1, x2, y2, w0, along, down, lowest, highest))
    x0, y0, x1, y1, x2, y2, w0, along, down, lowest, highest = table.index_select(1, triangle)
    upper = y < y1
    xa, ya = torch.where(upper, x0, x1), torch.where(upper, y0, y1)
    xb, yb = torch.where(upper, x1, x2), torch.where(upper, y1, y2)
    # No denominator vanishes: a row lies in y0 <= y < y2, and in ya <= y < yb.
    long_edge = x0 + (y - y0) * ((x2 - x0) / (y2 - y0))
    short_edge = xa + (y - ya) * ((xb - xa) / (yb - ya))
    left = torch.minimum(long_edge, short_edge).ceil().clamp(0, width)
    right = torch.maximum(long_edge, short_edge).ceil().clamp(0, width)
    length = (right - left).long()
    # The ends of a span are clamped to the corners' range, because the plane of a sliver is steep.
    start = (w0 + along * (left - x0) + down * (y - y0)).clamp(lowest, highest)
    stop = (w0 + along * (right - 1 - x0) + down * (y - y0)).clamp(lowest, highest)
    slope = ((stop - start) / (length - 1).clamp_min(1)).float()
    plane = torch.stack((start.float(), slope))
    first_pixel = row * width + left.long()
    if pictures > 1:
        picture = drawn[triangle] // (faces.shape[0] // pictures)
        first_pixel = first_pixel + picture * (height * width)

    # Rows to pixels. A positive float orders like its bits, so one integer maximum over
    # (inverse depth, reversed face index) finds the nearest face and settles ties.
    name = torch.stack((first_pixel, faces.shape[0] - 1 - drawn[triangle]))
    best = _nearest_of_spans(length, plane, name, pictures * height * width)
    return torch.where(best >= 0, faces.shape[0] - 1 - (best & 0xFFFFFFFF), best)


def _nearest_of_spans(
    length: Int[Tensor, " r"],
    plane: Float[Tensor, "2 r"],
    name: Int[Tensor, "2 r"],
    num_pixels: int,
) -> Int[Tensor, " p"]:
    """The greatest key of the spans on every pixel, -1 where there is none.

    Args:
        length: Pixels of each span.
        plane: Inverse depth at its first pixel, and its rise from pixel to pixel.
        name: Its first pixel, and the lower half of its key.
        num_pixels: Pixels of all pictures.
    """
    best = torch.full((num_pixels,), -1, dtype=torch.long, device=length.device)
    for chunk in _chunks(length):
        span, offset = _expand(length[chunk])
        near, rise = plane[:, chunk].index_select(1, span)
        pixel, reverse = name[:, chunk].index_select(1, span)
        near = (near + rise * offset).clamp_min(0)
        key = (near.view(torch.int32).long() << 32) | reverse
        best.scatter_reduce_(0, pixel + offset, key, "amax")
    return best


def _chunks(length: Int[Tensor, " r"]) -> list[slice]:
    """Cut spans into runs of about `_PIXELS_AT_ONCE` pixels."""
    if not length.numel():
        return []
    end = length.cumsum(0)
    pieces = int(end[-1]) // _PIXELS_AT_ONCE + 1
    goals = _PIXELS_AT_ONCE * torch.arange(1, pieces, device=length.device)
    cuts = [0, *torch.searchsorted(end, goals).tolist(), length.shape[0]]
    return [slice(a, b) for a, b in pairwise(cuts)]


@cache
def grid_faces(rings: int, meridians: int) -> Faces:
    """Triangles of a mesh of rings closed around the part, poles capped by fans.

    Args:
        rings: Latitudes.
        meridians: Longitudes.
    """
    rows, columns = (torch.arange(n, device="cpu") for n in (rings - 1, meridians))
    ring, step = torch.meshgrid(rows, columns, indexing="ij")
    here = ring * meridians + step
    beside = ring * meridians + (step + 1) % meridians
    quads = torch.stack([here, beside, here + meridians, beside + meridians], dim=-1).reshape(-1, 4)
    sides = torch.cat([quads[:, [0, 1, 3]], quads[:, [0, 3, 2]]])
    fan = torch.arange(1, meridians - 1, device="cpu")
    bottom = torch.stack([torch.zeros_like(fan), fan + 1, fan], dim=-1)
    top = torch.stack([torch.zeros_like(fan), fan, fan + 1], dim=-1) + (rings - 1) * meridians
    return torch.cat([sides, bottom, top])


def join_faces(
    faces: Sequence[Faces], num_vertices: Sequence[int]
) -> tuple[Int[Tensor, "F 3"], Int[Tensor, " F"]]:
    """Join meshes into one whose vertices are concatenated.

    Args:
        faces: Faces of every mesh.
        num_vertices: Number of vertices of every mesh.

    Returns:
        The faces of the joined mesh, and for each of them which mesh it came from.
    """
    shifted, owner, offset = [], [], 0
    for index, (mesh, size) in enumerate(zip(faces, num_vertices, strict=True)):
        shifted.append(mesh.long() + offset)
        owner.append(torch.full_like(shifted[-1][:, 0], index))
        offset += size
    return torch.cat(shifted), torch.cat(owner)


def interpolate(
    attribute: Float[Tensor, "v c"],
    faces: Faces,
    face: Int[Tensor, " i"],
    barycentric: Float[Tensor, "i 3"],
) -> Float[Tensor, "i c"]:
    """Interpolate a quantity given at vertices to pixels of known triangles.

    Args:
        attribute: The quantity at every vertex.
        faces: Corner indices of the triangles.
        face: Triangle of every pixel, none of them -1.
        barycentric: Weights of its corners.
    """
    corner = faces.index_select(0, face)
    first, second, third = (attribute.index_select(0, corner[:, k]) for k in range(3))
    a, b, c = barycentric.to(attribute)[:, :, None].unbind(1)
    return a * first + b * second + c * third


def vertex_normals(vertices: Float[Tensor, "v 3"], faces: Faces) -> Float[Tensor, "v 3"]:
    """Smooth unit normals: the area-weighted mean over the triangles round a vertex.

    They point where the corners of a triangle run anticlockwise. A vertex of no triangle, or of
    triangles that cancel, gets a zero normal.
    """
    first, second, third = vertices[faces].unbind(1)
    area = torch.linalg.cross(second - first, third - first)
    total = torch.zeros_like(vertices).index_add(0, faces.reshape(-1), area.repeat_interleave(3, 0))
    return functional.normalize(total, dim=-1)
