"""Superquadric ellipsoids with tapering and bending (Barr 1984): the parts of section 2 [IJRR].

A part is described by nine numbers in its own frame, whose z axis runs along the part:

| number | meaning |
|---|---|
| `a1 a2 a3` | semi-axes, metres |
| `e1 e2` | exponents along and around the axis; 1 is an ellipsoid, towards 0 a box |
| `taper_x taper_y` | relative change of the cross-section from the middle to the +z end |
| `bend_x bend_y` | curvature of the axis, radians per metre, towards x and y |

The map D of eq. 1 takes the angular coordinates (eta, omega) to a point: superquadric, then taper,
then bend. Normals follow by the transformation rule `n' = det(J) J^-T n`, and the implicit function
undoes bend and taper first. `surface_points` is what a body uses; `implicit` tells in from out. The
bend is two curvatures and not one with a direction, which a straight part would not have.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.superquadric import Superquadrics, radial_square, unbend

Vectors = Float[Tensor, "*batch 3"]

SHAPE_NAMES = ("a1", "a2", "a3", "e1", "e2", "taper_x", "taper_y", "bend_x", "bend_y")

_SMALL = 0.01
"""Square of an angle, radians, below which quotients by it are their series, exact to 1e-13."""


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
    a1, a2, a3, e1, e2, taper_x, taper_y, bend_x, bend_y = shape.unbind(-1)
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
        torch.stack([x, y, z], -1), torch.stack([nx, ny, nz], -1), bend_x, bend_y
    )
    length = normals.norm(dim=-1, keepdim=True)
    axis = torch.zeros_like(normals)
    axis[..., 2] = 1.0
    return SurfaceSample(
        points, torch.where(length > 0, normals / torch.where(length > 0, length, 1), axis)
    )


def _bend(points: Tensor, normals: Tensor, bend_x: Tensor, bend_y: Tensor) -> tuple[Tensor, Tensor]:
    """Circular bending of the z axis; volume preserving at the axis."""
    x, y, z = points.unbind(-1)
    nx, ny, nz = normals.unbind(-1)
    # With the curvature k and the angle a = k z by which the axis turns: sin(a) / k, and
    # (1 - cos(a)) / k^2, both smooth in the square of a.
    square = (bend_x.square() + bend_y.square()) * z.square()
    of_sine, of_versine = _turn(square)
    sine, versine = z * of_sine, z.square() * of_versine
    stretch = 1 - bend_x * x - bend_y * y  # length of d(point)/dz
    bent = (x + bend_x * versine * stretch, y + bend_y * versine * stretch, sine * stretch)
    # J^-T det(J): the frame turns by a about the axis beside the bend.
    towards = (bend_x * nx + bend_y * ny) * stretch
    turned = sine * nz - versine * towards
    return (
        torch.stack(bent, -1),
        torch.stack(
            [
                stretch * nx + bend_x * turned,
                stretch * ny + bend_y * turned,
                (1 - square * of_versine) * nz - sine * towards,
            ],
            -1,
        ),
    )


def _turn(square: Tensor) -> tuple[Tensor, Tensor]:
    """`sin(a) / a` and `(1 - cos(a)) / a^2` of the square of an angle, with derivatives at zero."""
    small = square < _SMALL
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    sine = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
    versine = 1 - square / 12 * (1 - square / 30 * (1 - square / 56 * (1 - square / 90)))
    return (
        torch.where(small, sine, angle.sin() / angle),
        torch.where(small, 0.5 * versine, 2 * (0.5 * angle).sin().square() / safe),
    )


def straighten(shape: Float[Tensor, "*batch 9"], points: Vectors) -> Vectors:
    """Undo bend and taper: part frame to the frame of the plain superquadric.

    It can be differentiated in the points, and in the shape of a part that is bent.

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
