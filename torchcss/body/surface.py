"""Superquadric ellipsoids with tapering and bending (Barr 1984): the parts of section 2 [IJRR].

A part is described by nine numbers in its own frame, whose z axis runs along the part:

| number | meaning |
|---|---|
| `a1 a2 a3` | semi-axes, metres |
| `e1 e2` | exponents along and around the axis; 1 is an ellipsoid, towards 0 a box |
| `taper_x taper_y` | relative change of the cross-section from the middle to the +z end |
| `bend` | curvature of the axis, radians per metre |
| `bend_direction` | direction in the x-y plane towards which the axis bends, radians |

The map D of eq. 1 takes the angular coordinates (eta, omega) to a point: superquadric, then taper,
then bend. Normals follow by the transformation rule `n' = det(J) J^-T n`, and the implicit function
undoes bend and taper first. `surface_points` is what a body uses; `implicit` tells in from out.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.superquadric import Superquadrics, radial_square, unbend

Vectors = Float[Tensor, "*batch 3"]

SHAPE_NAMES = ("a1", "a2", "a3", "e1", "e2", "taper_x", "taper_y", "bend", "bend_direction")

_SMALL = 0.1
"""Angle, radians, below which quotients by it are their series; these are then exact to 1e-13."""


class SurfaceSample(NamedTuple):
    """Points of a surface with unit outward normals, in the part's frame.

    Attributes:
        points: Metres.
        normals: Perpendicular to the surface, of length one, outwards.
    """

    points: Vectors
    normals: Vectors


def _signed_power(base: Tensor, exponent: Tensor) -> Tensor:
    magnitude = base.abs()
    positive = magnitude > 0
    safe = torch.where(positive, magnitude, torch.ones_like(magnitude))
    return torch.where(positive, base.sign() * safe**exponent, torch.zeros_like(base))


def surface_points(
    shape: Float[Tensor, "*batch 9"], eta: Float[Tensor, "*batch"], omega: Float[Tensor, "*batch"]
) -> SurfaceSample:
    """Evaluate the surface and its normals; the map D of eq. 1 [IJRR].

    Args:
        shape: The nine shape numbers, see the module's table.
        eta: Latitude in [-pi/2, pi/2], along the part.
        omega: Longitude in [-pi, pi), around the part.

    Returns:
        Points in metres and unit outward normals, in the part's frame.
    """
    a1, a2, a3, e1, e2, taper_x, taper_y, bend, direction = shape.unbind(-1)
    cos_eta, sin_eta, cos_omega, sin_omega = eta.cos(), eta.sin(), omega.cos(), omega.sin()
    ring = _signed_power(cos_eta, e1)
    x = a1 * ring * _signed_power(cos_omega, e2)
    y = a2 * ring * _signed_power(sin_omega, e2)
    z = a3 * _signed_power(sin_eta, e1)
    # The normal's dual superquadric.
    dual = _signed_power(cos_eta, 2 - e1)
    nx = dual * _signed_power(cos_omega, 2 - e2) / a1
    ny = dual * _signed_power(sin_omega, 2 - e2) / a2
    nz = _signed_power(sin_eta, 2 - e1) / a3
    # Taper: X = fx x, Y = fy y, Z = z, with fx = 1 + taper_x z / a3.
    fx, fy = 1 + taper_x * z / a3, 1 + taper_y * z / a3
    nx, ny, nz = (
        nx * fy,
        ny * fx,
        nz * fx * fy - nx * fy * x * taper_x / a3 - ny * fx * y * taper_y / a3,
    )
    x, y = x * fx, y * fy
    points, normals = _bend(
        torch.stack([x, y, z], -1), torch.stack([nx, ny, nz], -1), bend, direction
    )
    length = normals.norm(dim=-1, keepdim=True)
    axis = torch.zeros_like(normals)
    axis[..., 2] = 1.0
    return SurfaceSample(
        points, torch.where(length > 0, normals / torch.where(length > 0, length, 1), axis)
    )


def _bend(
    points: Tensor, normals: Tensor, bend: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """Circular bending of the z axis towards `direction`; volume preserving at the axis."""
    c, s = direction.cos(), direction.sin()
    x, y, z = points.unbind(-1)
    r, across = c * x + s * y, c * y - s * x  # towards the bend, and beside it
    angle = bend * z
    # 1 / bend - cos(angle) (1 / bend - r), and sin(angle) (1 / bend - r), without the radius.
    bent_r = angle.cos() * r + 0.5 * angle * z * _sinc(0.5 * angle).square()
    bent_z = z * _sinc(angle) - angle.sin() * r
    nx, ny, nz = normals.unbind(-1)
    nr, n_across = c * nx + s * ny, c * ny - s * nx
    stretch = 1 - bend * r  # length of d(point)/dz
    # J^-T det(J): the frame turns by `angle` about the axis beside the bend.
    nr, n_across, nz = nr * stretch, n_across * stretch, nz
    turned_r = angle.cos() * nr + angle.sin() * nz
    turned_z = -angle.sin() * nr + angle.cos() * nz
    return (
        torch.stack([c * bent_r - s * across, s * bent_r + c * across, bent_z], -1),
        torch.stack([c * turned_r - s * n_across, s * turned_r + c * n_across, turned_z], -1),
    )


def _sinc(angle: Tensor) -> Tensor:
    """`sin(a) / a`, with derivatives at zero."""
    small = angle.abs() < _SMALL
    square = angle.square()
    safe = torch.where(small, torch.ones_like(angle), angle)
    series = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
    return torch.where(small, series, safe.sin() / safe)


def straighten(shape: Float[Tensor, "*batch 9"], points: Vectors) -> Vectors:
    """Undo bend and taper: part frame to the frame of the plain superquadric.

    Args:
        shape: The nine shape numbers.
        points: Points in the part's frame, metres.
    """
    rows = Superquadrics.of(shape)
    (x, y, z), _ = unbend(rows, *points.unbind(-1))
    height = rows.height(z * rows.ic)
    return torch.stack([x / (1 + rows.taper_x * height), y / (1 + rows.taper_y * height), z], -1)


def implicit(shape: Float[Tensor, "*batch 9"], points: Vectors) -> Float[Tensor, "*batch"]:
    """Inside-outside function: negative inside, zero on the surface, positive outside.

    It is `R^2 - 1` with the radial function R of `torchcss.body.superquadric`.

    Args:
        shape: The nine shape numbers.
        points: Points in the part's frame, metres.
    """
    rows = Superquadrics.of(shape)
    return radial_square(rows, *points.unbind(-1), bent=bool((rows.bend != 0).any()))[0] - 1


def angular_grid(
    rings: int, meridians: int, *, dtype: torch.dtype, device: torch.device | None = None
) -> tuple[Float[Tensor, "rings meridians"], Float[Tensor, "rings meridians"]]:
    """Latitudes and longitudes of the mesh of one part, poles left out.

    Latitudes are equally spaced in `sin(eta)`, so that the rings of an ellipsoid are equally spaced
    along the part.

    Args:
        rings: Number of latitudes.
        meridians: Number of longitudes.
        dtype: Type of the result.
        device: Where to put the result.
    """
    heights = (torch.arange(rings, dtype=dtype, device=device) + 0.5) * (2 / rings) - 1
    longitudes = torch.arange(meridians, dtype=dtype, device=device) * (2 * torch.pi / meridians)
    eta, omega = torch.meshgrid(heights.asin(), longitudes - torch.pi, indexing="ij")
    return eta, omega
