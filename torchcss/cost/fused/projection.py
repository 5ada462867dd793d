"""From points to pixels and back with derivatives; the twin of `torchcss.vision.camera`.

Points are in the camera's own frame.
"""

from __future__ import annotations

from collections import namedtuple

from torchcss.cost.fused.records import Lens, Points
from torchcss.kernels.compiler import inlined, sqrt

Pixel = namedtuple("Pixel", "u v valid a b w aa ab bb")
"""An image point and what its derivatives need; see `ProjectionModel`."""


Slope = namedtuple("Slope", "u v uu uv vv")
"""First and second derivatives of a cost in an image point, nats per (square) pixel."""


Spatial = namedtuple("Spatial", "x y z xx xy xz yy yz zz")
"""First and second derivatives of a cost in a point, nats per (square) metre."""


@inlined
def project(lens: Lens, x: float, y: float, z: float) -> Pixel:
    """Project a point; one that the camera cannot see gets a place outside the image."""
    one, zero = lens.fx / lens.fx, lens.fx * 0.0
    reach = lens.limit * z
    if not (z > lens.near and x * x + y * y < reach * reach):
        return Pixel(-lens.width, -lens.height, False, zero, zero, zero, one, zero, one)
    w = one / z
    a, b = x * w, y * w
    if not lens.distorts:
        return Pixel(lens.fx * a + lens.cx, lens.fy * b + lens.cy, True, a, b, w, one, zero, one)
    p1, p2 = lens.p1, lens.p2
    r2 = a * a + b * b
    q = 1.0 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    q1 = lens.k1 + r2 * (2.0 * lens.k2 + r2 * (3.0 * lens.k3))
    da = a * q + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    db = b * q + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
    return Pixel(
        lens.fx * da + lens.cx,
        lens.fy * db + lens.cy,
        True,
        a,
        b,
        w,
        q + 2.0 * (a * a * q1 + p1 * b + 3.0 * p2 * a),
        2.0 * (a * b * q1 + p1 * a + p2 * b),
        q + 2.0 * (b * b * q1 + 3.0 * p1 * b + p2 * a),
    )


@inlined
def image_normal(
    lens: Lens, pixel: Pixel, normal: tuple[float, float, float]
) -> tuple[float, float]:
    """Unit normal in the image of a surface that is seen edge on; along u where there is none."""
    a, b, (x, y, z) = pixel.a, pixel.b, normal
    x, y = x - a * z, y - b * z
    x, y = (1.0 + b * b) * x - a * b * y, (1.0 + a * a) * y - a * b * x
    if lens.distorts:
        largest = max(max(abs(pixel.aa), abs(pixel.bb)), abs(pixel.ab))
        scale = 1.0 / largest if largest > 0.0 else largest + 1.0
        aa, ab, bb = scale * pixel.aa, scale * pixel.ab, scale * pixel.bb
        x, y = bb * x - ab * y, aa * y - ab * x
        if aa * bb - ab * ab < 0.0:
            x, y = -x, -y
    x, y = x / lens.fx, y / lens.fy
    # Scaled, lest squares overflow.
    largest = max(abs(x), abs(y))
    if not largest > 0.0:
        return 1.0 + 0.0 * x, 0.0 * x
    x, y = x / largest, y / largest
    length = sqrt(x * x + y * y)
    return x / length, y / length


@inlined
def pull_back(lens: Lens, pixel: Pixel, slope: Slope, exact: bool) -> Spatial:
    """Derivatives in a point of a cost of its image; if not exact, for a flat projection."""
    a, b, w = pixel.a, pixel.b, pixel.w
    ea, eb = lens.fx * slope.u, lens.fy * slope.v
    haa, hab, hbb = (
        lens.fx * lens.fx * slope.uu,
        lens.fx * lens.fy * slope.uv,
        lens.fy * lens.fy * slope.vv,
    )
    fa, fb, faa, fab, fbb = ea, eb, haa, hab, hbb
    if lens.distorts:
        aa, ab, bb = pixel.aa, pixel.ab, pixel.bb
        ca, cb = haa * aa + hab * ab, hab * aa + hbb * ab
        da, db = haa * ab + hab * bb, hab * ab + hbb * bb
        fa, fb = ea * aa + eb * ab, ea * ab + eb * bb
        faa, fab, fbb = aa * ca + ab * cb, ab * ca + bb * cb, ab * da + bb * db
        if exact:
            r2 = a * a + b * b
            q1 = lens.k1 + r2 * (2.0 * lens.k2 + r2 * (3.0 * lens.k3))
            bend = 8.0 * lens.k2 + 24.0 * lens.k3 * r2
            aaa = 6.0 * (a * q1 + lens.p2) + bend * a * a * a
            aab = 2.0 * (b * q1 + lens.p1) + bend * a * a * b
            abb = 2.0 * (a * q1 + lens.p2) + bend * a * b * b
            bbb = 6.0 * (b * q1 + lens.p1) + bend * b * b * b
            faa += ea * aaa + eb * aab
            fab += ea * aab + eb * abb
            fbb += ea * abb + eb * bbb
    x, y, z = a * faa + b * fab, a * fab + b * fbb, a * fa + b * fb
    zz = a * x + b * y
    if exact:
        x, y, zz = x + fa, y + fb, zz + 2.0 * z
    ww = w * w
    return Spatial(w * fa, w * fb, -w * z, ww * faa, ww * fab, -ww * x, ww * fbb, -ww * y, ww * zz)


@inlined
def times(factor: float, slope: Slope) -> Slope:
    """Derivatives of a cost that weighs so much."""
    return Slope(
        factor * slope.u, factor * slope.v, factor * slope.uu, factor * slope.uv, factor * slope.vv
    )


@inlined
def write_point(points: Points, i: int, place: tuple[float, float, float], cost: Spatial) -> None:
    """Write a point and its cost's derivatives."""
    points.x[i], points.y[i], points.z[i] = place
    points.gx[i], points.gy[i], points.gz[i] = cost.x, cost.y, cost.z
    points.xx[i], points.xy[i], points.xz[i] = cost.xx, cost.xy, cost.xz
    points.yy[i], points.yz[i], points.zz[i] = cost.yy, cost.yz, cost.zz


@inlined
def read_point(points: Points, i: int) -> Spatial:
    """The derivatives of a point's cost."""
    return Spatial(
        points.gx[i],
        points.gy[i],
        points.gz[i],
        points.xx[i],
        points.xy[i],
        points.xz[i],
        points.yy[i],
        points.yz[i],
        points.zz[i],
    )
