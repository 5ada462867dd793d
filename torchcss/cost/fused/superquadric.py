"""The radial function of a part; the twin of `torchcss.body.superquadric`.

Shapes are columns of a table with the fields of `Superquadrics` as rows.
"""

from __future__ import annotations

import math
from collections import namedtuple

from torchcss.cost.fused.projection import Spatial
from torchcss.cost.fused.records import Array
from torchcss.kernels.compiler import by_precision, exp, inlined, kernel, log, sqrt

_SMALL = 0.1
"""Angle, radians, below which a quotient by it is its series."""


Shape = namedtuple("Shape", "ia ib ic around section along whole taper_x taper_y overhang most")
"""A column of the table; see `torchcss.body.superquadric.Superquadrics`."""


Turn = namedtuple("Turn", "x y z cosine sine stretch")
"""How the axis of a bent part turns at a point: see `unbend`."""


@inlined
def shape_of(table: Array, part: int) -> Shape:
    """The shape of a part."""
    return Shape(
        table[0, part],
        table[1, part],
        table[2, part],
        table[3, part],
        table[4, part],
        table[5, part],
        table[6, part],
        table[7, part],
        table[8, part],
        table[9, part],
        table[13, part],
    )


@inlined
def power(base: float, exponent: float) -> float:
    """Power of a positive number."""
    return exp(exponent * log(base))


@inlined
def height_of(overhang: float, w: float) -> float:
    """What a taper is multiplied by at a height in semi-axes."""
    past = max(abs(w) - 1.0, 0.0)
    beyond = overhang * past / sqrt(past * past + overhang * overhang)
    return min(max(w, -1.0), 1.0) + (beyond if w > 0.0 else -beyond)


@inlined
def narrowed(shape: Shape, w: float) -> tuple[float, float]:
    """Reciprocal semi-axes of the section at a height in semi-axes."""
    height = height_of(shape.overhang, w)
    return shape.ia / (1.0 + shape.taper_x * height), shape.ib / (1.0 + shape.taper_y * height)


@inlined
def _bounded_square(shape: Shape, x: float) -> float:
    return min(x * x + by_precision(x, 1e-12, 1e-24), by_precision(x, shape.most, 1e12))


@inlined
def radial_square(shape: Shape, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """`R^2` at a point of a straight part, and half its gradient there."""
    w = z * shape.ic
    ix, iy = narrowed(shape, w)
    u, v = x * ix, y * iy
    uu, vv, ww = _bounded_square(shape, u), _bounded_square(shape, v), _bounded_square(shape, w)
    pu, pv, pw = power(uu, shape.around), power(vv, shape.around), power(ww, shape.along)
    section = max(pu * uu + pv * vv, by_precision(x, 1e-30, 1e-280))
    outer = power(section, shape.section)
    total = max(outer * section + pw * ww, by_precision(x, 1e-30, 1e-280))
    scale = power(total, shape.whole)
    p1, p2 = outer * scale * pu, outer * scale * pv
    past = max(abs(w) - 1.0, 0.0)
    level = shape.overhang / sqrt(past * past + shape.overhang * shape.overhang)
    rise = level * level * level
    narrowing = p1 * u * u * shape.taper_x * ix / shape.ia
    narrowing = narrowing + p2 * v * v * shape.taper_y * iy / shape.ib
    gz = (scale * pw * w - narrowing * rise) * shape.ic
    return total * scale, p1 * u * ix, p2 * v * iy, gz


@kernel
def unbend(bend: float, c: float, s: float, x: float, y: float, z: float) -> Turn:
    """A point of a bent part straightened, and how the axis turns there."""
    towards, across = c * x + s * y, c * y - s * x
    cosine, sine = 1.0 - bend * towards, bend * z
    stretch = max(math.hypot(cosine, sine), 1e-3)
    towards = (2.0 * towards - bend * (towards * towards + z * z)) / (1.0 + stretch)
    if abs(sine) < _SMALL * cosine:
        square, series = (sine / cosine) * (sine / cosine), 0.0 * x
        for odd in (13.0, 11.0, 9.0, 7.0, 5.0, 3.0, 1.0):
            series = 1.0 / odd - square * series
        z = z / cosine * series
    else:
        z = math.atan2(sine, cosine) / bend
    x, y = c * towards - s * across, s * towards + c * across
    return Turn(x, y, z, cosine / stretch, sine / stretch, stretch)


@kernel
def bent_radial_square(
    table: Array, part: int, place: tuple[float, float, float]
) -> tuple[float, float, float, float]:
    """The same of any part."""
    x, y, z = place
    bend, c, s = table[10, part], table[11, part], table[12, part]
    shape = shape_of(table, part)
    if bend == 0.0:
        return radial_square(shape, x, y, z)
    turn = unbend(bend, c, s, x, y, z)
    square, gx, gy, gz = radial_square(shape, turn.x, turn.y, turn.z)
    towards, across, axial = c * gx + s * gy, c * gy - s * gx, gz / turn.stretch
    towards, axial = (
        turn.cosine * towards + turn.sine * axial,
        turn.cosine * axial - turn.sine * towards,
    )
    return square, c * towards - s * across, s * towards + c * across, axial


Bowl = namedtuple("Bowl", "square x y z xx xy xz yy yz zz")
"""`R^2` at a point, with its first and second derivatives."""


@inlined
def as_spatial(bowl: Bowl) -> Spatial:
    """The derivatives alone."""
    return Spatial(bowl.x, bowl.y, bowl.z, bowl.xx, bowl.xy, bowl.xz, bowl.yy, bowl.yz, bowl.zz)


@kernel
def radial_hessian(table: Array, part: int, place: tuple[float, float, float]) -> Bowl:
    """`R^2` of any part with its derivatives."""
    x, y, z = place
    bend, c, s = table[10, part], table[11, part], table[12, part]
    if bend == 0.0:
        return straight_hessian(shape_of(table, part), x, y, z)
    turn = unbend(bend, c, s, x, y, z)
    straight = straight_hessian(shape_of(table, part), turn.x, turn.y, turn.z)
    return _bent(straight, turn, bend, c, s)


@inlined
def straight_hessian(shape: Shape, x: float, y: float, z: float) -> Bowl:
    """The same of a straight part."""
    w = z * shape.ic
    i, j = narrowed(shape, w)
    u, v = x * i, y * j
    uu, vv, ww = _bounded_square(shape, u), _bounded_square(shape, v), _bounded_square(shape, w)
    pu, pv, pw = power(uu, shape.around), power(vv, shape.around), power(ww, shape.along)
    section = max(pu * uu + pv * vv, by_precision(x, 1e-30, 1e-280))
    outer = power(section, shape.section)
    total = max(outer * section + pw * ww, by_precision(x, 1e-30, 1e-280))
    scale = power(total, shape.whole)
    k1, k2 = 4.0 * shape.along, 4.0 * shape.around
    p1, p2, p3 = outer * scale * pu, outer * scale * pv, scale * pw
    # Shares of u in the section, and of w in the total: derivatives are bounded by them.
    fu, fv, fw = pu * uu / section, pv * vv / section, pw * w * w / total
    q2, q3 = pv * v / section, k1 * pw * w / total
    g1, g2, g3 = 2.0 * p1 * u, 2.0 * p2 * v, 2.0 * p3 * w
    h11 = p1 * (2.0 + k2 * fv + k1 * fw * fu)
    h22 = p2 * (2.0 + k2 * fu + k1 * fw * fv)
    h12 = p1 * u * q2 * (k1 * fw - k2)
    h13, h23, h33 = -p1 * u * q3, -p2 * v * q3, p3 * (2.0 + k1 * (1.0 - fw))
    # From these to the straightened position; the taper makes u and v depend on z.
    past, k = max(abs(w) - 1.0, 0.0), shape.ic
    level = 1.0 / sqrt(past * past + shape.overhang * shape.overhang)
    rise = shape.overhang * level
    rise = rise * rise * rise
    curve = -3.0 * past * level * level * rise
    if w < 0.0:
        curve = -curve
    nx, ny = shape.taper_x * i / shape.ia * k, shape.taper_y * j / shape.ib * k
    lx, ly, cx, cy = nx * rise, ny * rise, nx * curve * k, ny * curve * k
    w1, w2 = -u * lx, -v * ly
    s1, s2 = h11 * w1 + h12 * w2 + h13 * k, h12 * w1 + h22 * w2 + h23 * k
    s3 = h13 * w1 + h23 * w2 + h33 * k
    hzz = s1 * w1 + s2 * w2 + s3 * k
    hzz = hzz + g1 * u * (2.0 * lx * lx - cx) + g2 * v * (2.0 * ly * ly - cy)
    return Bowl(
        total * scale,
        g1 * i,
        g2 * j,
        g1 * w1 + g2 * w2 + g3 * k,
        h11 * i * i,
        h12 * i * j,
        i * (s1 - g1 * lx),
        h22 * j * j,
        j * (s2 - g2 * ly),
        hzz,
    )


@inlined
def _turned(bowl: Bowl, c: float, s: float) -> Bowl:
    """The same in axes turned about z: the first towards (c, s), or back with (c, -s)."""
    xx = c * c * bowl.xx + 2.0 * c * s * bowl.xy + s * s * bowl.yy
    yy = s * s * bowl.xx - 2.0 * c * s * bowl.xy + c * c * bowl.yy
    xy = c * s * (bowl.yy - bowl.xx) + (c * c - s * s) * bowl.xy
    xz, yz = c * bowl.xz + s * bowl.yz, c * bowl.yz - s * bowl.xz
    x, y = c * bowl.x + s * bowl.y, c * bowl.y - s * bowl.x
    return Bowl(bowl.square, x, y, bowl.z, xx, xy, xz, yy, yz, bowl.zz)


@inlined
def _bent(straight: Bowl, turn: Turn, bend: float, c: float, s: float) -> Bowl:
    """Derivatives at the straightened point as derivatives at the point of the bent part."""
    plane = _turned(straight, c, s)
    # Rows of the Jacobian: n = (cosine, 0, -sine), (0, 1, 0) and m / stretch.
    nx, nz, stretch = turn.cosine, -turn.sine, turn.stretch
    mx, mz = turn.sine, turn.cosine
    lx, lz = mx / stretch, mz / stretch
    xx = nx * nx * plane.xx + 2.0 * nx * lx * plane.xz + lx * lx * plane.zz
    zz = nz * nz * plane.xx + 2.0 * nz * lz * plane.xz + lz * lz * plane.zz
    xz = nx * nz * plane.xx + (nx * lz + nz * lx) * plane.xz + lx * lz * plane.zz
    xy, yz = nx * plane.xy + lx * plane.yz, nz * plane.xy + lz * plane.yz
    curvature = bend / stretch
    a, b = plane.x * curvature, plane.z * curvature / stretch
    xx = xx - a * mx * mx + 2.0 * b * nx * mx
    zz = zz - a * mz * mz + 2.0 * b * nz * mz
    xz = xz - a * mx * mz + b * (nx * mz + nz * mx)
    x, z = nx * plane.x + lx * plane.z, nz * plane.x + lz * plane.z
    bowl = Bowl(straight.square, x, plane.y, z, xx, xy, xz, plane.yy, yz, zz)
    return _turned(bowl, c, -s)
