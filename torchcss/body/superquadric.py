"""The radial function of a superquadric part, with taper and bend undone, and its derivatives.

With u, v, w the coordinates of a straightened point in units of the semi-axes, and Barr's
inside-outside function

    F = (|u|^(2/e2) + |v|^(2/e2))^(e2/e1) + |w|^(2/e1),    R^2 = F^e1,

R is 0 at the centre and 1 on the surface, and grows with the distance from the centre along every
ray of a part without taper and bend, whatever its exponents. Visibility measures gaps by it
(`torchcss.cost.visibility`), the repulsion of parts is a potential of it
(`torchcss.cost.interpenetration`), and `torchcss.body.surface.implicit` tells in from out.

**Taper.** The section at height w is scaled by `1 + taper h(w)`, where h is w within the part.
Beyond its ends h goes on for a while and levels off, twice differentiable, so that the section
never vanishes.

**Bend.** The axis is an arc of curvature k. Seen from its centre, a point has the distance s / k
and the angle t; straightened, it is (1 - s) / k towards the centre and t / k along the axis. With
n = (cos t, -sin t) and m = (sin t, cos t) in the plane of the bend, the first has the gradient n
and the Hessian -(k / s) m m^T, the second m / s and (k / s^2) (n m^T + m n^T).

Make a `Superquadrics` of shape numbers, then call `radial_square`, or `radial_hessian` for second
derivatives too. Powers are exponentials of logarithms: on a CPU `pow` takes up to seven times as
long.
"""

from __future__ import annotations

from collections import namedtuple
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.linalg import multiply

Triple = tuple[Tensor, Tensor, Tensor]

_LEAST_SQUARE = {torch.float32: 1e-12, torch.float64: 1e-24}
_MOST_SQUARE = 1e12
_MOST_POWER = 60.0  # of e, in single precision
_LEAST_POWER = {torch.float32: 1e-30, torch.float64: 1e-280}
"""Bounds on squared coordinates and on powers, so that the type holds all products."""

EXPONENTS = (0.1, 2.0)
"""From all but a box to a diamond; powers beyond these leave single precision."""

_MOST_TAPER = 0.95
_OVERHANG = 0.5
"""How far a taper goes on beyond the ends of its part, in semi-axes, before it levels off."""

_SMALL = 0.1
"""Angle, radians, below which a quotient by it is its series, exact to 1e-13."""


class Superquadrics(NamedTuple):
    """Shapes as the radial function takes them, each field one number per shape.

    Attributes:
        ia, ib, ic: Reciprocal semi-axes.
        around: Exponent `1/e2 - 1`.
        section: Exponent `e2/e1 - 1`.
        along: Exponent `1/e1 - 1`.
        whole: Exponent `e1 - 1`.
        taper_x, taper_y: Relative change of the section from the middle to the +z end.
        overhang: How far the taper goes on beyond the ends, in semi-axes.
        bend: Curvature of the axis, per metre.
        c, s: Cosine and sine of the direction of the bend.
        most: Bound on squared coordinates in single precision.
    """

    ia: Tensor
    ib: Tensor
    ic: Tensor
    around: Tensor
    section: Tensor
    along: Tensor
    whole: Tensor
    taper_x: Tensor
    taper_y: Tensor
    overhang: Tensor
    bend: Tensor
    c: Tensor
    s: Tensor
    most: Tensor

    @classmethod
    def of(
        cls, shape: Float[Tensor, "*batch 9"], *, exponents: tuple[float, float] = EXPONENTS
    ) -> Superquadrics:
        """From the nine shape numbers of `torchcss.body.surface`.

        Args:
            shape: Shape numbers.
            exponents: Least and greatest exponent; others count as these.
        """
        a1, a2, a3, e1, e2, taper_x, taper_y, bend_x, bend_y = shape.unbind(-1)
        e1, e2 = e1.clamp(*exponents), e2.clamp(*exponents)
        taper_x, taper_y = (t.clamp(-_MOST_TAPER, _MOST_TAPER) for t in (taper_x, taper_y))
        # Short enough that the section stays positive.
        widest = torch.maximum(taper_x.abs(), taper_y.abs()).clamp(min=0.1)
        overhang = ((1 - widest) / (2 * widest)).clamp(max=_OVERHANG)
        exponent = (1 / e2 - 1, e2 / e1 - 1, 1 / e1 - 1, e1 - 1)
        square = bend_x.square() + bend_y.square()
        is_bent = square > 0
        safe = torch.where(is_bent, square, 1.0).sqrt()
        bend = torch.where(is_bent, safe, 0.0)
        turn = (torch.where(is_bent, bend_x / safe, 1.0), bend_y / safe)
        most = (_MOST_POWER * torch.minimum(e1, e2)).exp().clamp(max=_MOST_SQUARE)
        axes = (1 / a1, 1 / a2, 1 / a3)
        return cls(*axes, *exponent, taper_x, taper_y, overhang, bend, *turn, most)

    def height(self, w: Tensor) -> Tensor:
        """What a taper is multiplied by at a height in semi-axes."""
        past = (w.abs() - 1).clamp(min=0)
        level = (past.square() + self.overhang.square()).rsqrt()
        return w.clamp(-1, 1) + w.sign() * self.overhang * past * level

    def narrowed(self, w: Tensor) -> tuple[Tensor, Tensor]:
        """Reciprocal semi-axes of the section at a height in semi-axes."""
        height = self.height(w)
        return self.ia / (1 + self.taper_x * height), self.ib / (1 + self.taper_y * height)


_Bend = namedtuple("_Bend", "cosine sine stretch")
"""Cosine and sine of the axis' turn at a point, and how far it is stretched there."""


_Factors = namedtuple("_Factors", "u v w ix iy of_u of_v pu pv pw section total outer scale")
"""What value and derivatives of R^2 are made of.

Attributes:
    u, v, w: Coordinates in semi-axes.
    ix, iy: Reciprocal semi-axes of the section there.
    of_u, of_v: Shares of the section's power, pu u^2 and pv v^2.
    pu, pv, pw: Powers of u^2, v^2 and w^2, each by its exponent.
    section, total: Sums of powers.
    outer, scale: Powers of these, the first times the second.
"""


def radial_square(
    shape: Superquadrics, x: Tensor, y: Tensor, z: Tensor, *, bent: bool
) -> tuple[Tensor, Triple]:
    """`R^2` at points of the part's frame, and half its gradient there.

    Args:
        shape: The shape of every point's part.
        x: Coordinates in the part's frame, metres.
        y: The second of them.
        z: The third.
        bent: Whether any of the parts is bent.
    """
    turn = None
    if bent:
        (x, y, z), turn = unbend(shape, x, y, z)
    f = _factors(shape, x, y, z)
    p1, p2 = f.outer * f.pu, f.outer * f.pv
    rise, _ = _slope_of_height(shape, f.w)
    narrowing = p1 * f.u.square() * shape.taper_x * f.ix / shape.ia
    narrowing = narrowing + p2 * f.v.square() * shape.taper_y * f.iy / shape.ib
    gradient = (
        p1 * f.u * f.ix,
        p2 * f.v * f.iy,
        (f.scale * f.pw * f.w - narrowing * rise) * shape.ic,
    )
    if turn is not None:
        t, across, axial = _to_plane(shape, gradient)
        axial = axial / turn.stretch
        t, axial = turn.cosine * t + turn.sine * axial, turn.cosine * axial - turn.sine * t
        gradient = _from_plane(shape, (t, across, axial))
    return f.total * f.scale, gradient


def radial_hessian(
    shape: Superquadrics, x: Tensor, y: Tensor, z: Tensor, *, bent: bool
) -> tuple[Tensor, Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
    """`R^2` with its first and second derivatives; for the arguments see `radial_square`."""
    turn = None
    if bent:
        (x, y, z), turn = unbend(shape, x, y, z)
    f = _factors(shape, x, y, z)
    k1, k2 = 4 * shape.along, 4 * shape.around
    p1, p2, p3 = f.outer * f.pu, f.outer * f.pv, f.scale * f.pw
    # Shares of u in the section, and of w in the total: derivatives are bounded by them.
    fu, fv, fw = f.of_u / f.section, f.of_v / f.section, f.pw * f.w.square() / f.total
    q2, q3 = f.pv * f.v / f.section, k1 * f.pw * f.w / f.total
    # Derivatives in u, v, w.
    g1, g2, g3 = 2 * p1 * f.u, 2 * p2 * f.v, 2 * p3 * f.w
    h11 = p1 * (2 + k2 * fv + k1 * fw * fu)
    h22 = p2 * (2 + k2 * fu + k1 * fw * fv)
    h12 = p1 * f.u * q2 * (k1 * fw - k2)
    h13, h23, h33 = -p1 * f.u * q3, -p2 * f.v * q3, p3 * (2 + k1 * (1 - fw))
    # From these to the straightened position; the taper makes u and v depend on z.
    rise, curve = _slope_of_height(shape, f.w)
    nx, ny = shape.taper_x * f.ix / shape.ia * shape.ic, shape.taper_y * f.iy / shape.ib * shape.ic
    lx, ly, cx, cy = nx * rise, ny * rise, nx * curve * shape.ic, ny * curve * shape.ic
    i, j, k = f.ix, f.iy, shape.ic
    w1, w2 = -f.u * lx, -f.v * ly
    s1, s2 = h11 * w1 + h12 * w2 + h13 * k, h12 * w1 + h22 * w2 + h23 * k
    s3 = h13 * w1 + h23 * w2 + h33 * k
    hxz, hyz = i * (s1 - g1 * lx), j * (s2 - g2 * ly)
    hzz = s1 * w1 + s2 * w2 + s3 * k
    hzz = hzz + g1 * f.u * (2 * lx * lx - cx) + g2 * f.v * (2 * ly * ly - cy)
    hxx, hxy, hyy = h11 * i * i, h12 * i * j, h22 * j * j
    gradient = torch.stack([g1 * i, g2 * j, g1 * w1 + g2 * w2 + g3 * k], dim=-1)
    hessian = torch.stack([hxx, hxy, hxz, hxy, hyy, hyz, hxz, hyz, hzz], dim=-1)
    hessian = hessian.unflatten(-1, (3, 3))
    if turn is not None:
        gradient, hessian = _bent(shape, turn, gradient, hessian)
    return f.total * f.scale, gradient, hessian


def unbend(shape: Superquadrics, x: Tensor, y: Tensor, z: Tensor) -> tuple[Triple, _Bend]:
    """Straightened points, and how the axis turns there."""
    towards, across, z = _to_plane(shape, (x, y, z))
    # In units of the radius of the bend, seen from its centre.
    cosine, sine = 1 - shape.bend * towards, shape.bend * z
    stretch = torch.hypot(cosine, sine).clamp(min=1e-3)
    # (1 - stretch) / bend, without cancellation where the bend is slight.
    towards = (2 * towards - shape.bend * (towards.square() + z.square())) / (1 + stretch)
    # atan2(sine, cosine) / bend, by its series in the tangent where that is small.
    small = sine.abs() < _SMALL * cosine
    of_axis = torch.where(small, cosine, 1.0)
    square = torch.where(small, sine / of_axis, 0.0).square()
    series = torch.zeros_like(square)
    for odd in (13, 11, 9, 7, 5, 3, 1):
        series = 1 / odd - square * series
    angle = torch.atan2(sine, torch.where(small, 1.0, cosine))
    z = torch.where(small, z / of_axis * series, angle / torch.where(small, 1.0, shape.bend))
    return _from_plane(shape, (towards, across, z)), _Bend(
        cosine / stretch, sine / stretch, stretch
    )


def _to_plane(shape: Superquadrics, vector: Triple) -> Triple:
    """Components towards the bend, beside it and along the axis."""
    x, y, z = vector
    return shape.c * x + shape.s * y, shape.c * y - shape.s * x, z


def _from_plane(shape: Superquadrics, vector: Triple) -> Triple:
    towards, across, z = vector
    return shape.c * towards - shape.s * across, shape.s * towards + shape.c * across, z


def _factors(shape: Superquadrics, x: Tensor, y: Tensor, z: Tensor) -> _Factors:
    w = z * shape.ic
    ix, iy = shape.narrowed(w)
    u, v = x * ix, y * iy
    # Added, not clamped to, so that autograd sees the curvature where a coordinate is zero.
    least = _LEAST_SQUARE[x.dtype]
    most = shape.most if x.dtype == torch.float32 else _MOST_SQUARE
    uu, vv, ww = ((a.square() + least).clamp(max=most) for a in (u, v, w))
    pu, pv, pw = _power(uu, shape.around), _power(vv, shape.around), _power(ww, shape.along)
    of_u, of_v = pu * uu, pv * vv
    section = (of_u + of_v).clamp(min=_LEAST_POWER[x.dtype])
    outer = _power(section, shape.section)
    total = (outer * section + pw * ww).clamp(min=_LEAST_POWER[x.dtype])
    scale = _power(total, shape.whole)
    return _Factors(
        u, v, w, ix, iy, of_u, of_v, pu, pv, pw, section, total, outer * scale, scale
    )  # fmt: skip


def _slope_of_height(shape: Superquadrics, w: Tensor) -> tuple[Tensor, Tensor]:
    """First and second derivative of `Superquadrics.height`."""
    past = (w.abs() - 1).clamp(min=0)
    level = (past.square() + shape.overhang.square()).rsqrt()
    rise = (shape.overhang * level) ** 3
    return rise, -3 * w.sign() * past * level.square() * rise


def _bent(
    shape: Superquadrics,
    turn: _Bend,
    gradient: Float[Tensor, "*batch 3"],
    hessian: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
    """Derivatives at the straightened point as derivatives at the point of the bent part."""
    zero, one = torch.zeros_like(turn.cosine), torch.ones_like(turn.cosine)
    c, s = shape.c.expand_as(zero), shape.s.expand_as(zero)
    plane = torch.stack([c, s, zero, -s, c, zero, zero, zero, one], dim=-1).unflatten(-1, (3, 3))
    n = torch.stack([turn.cosine, zero, -turn.sine], dim=-1)
    m = torch.stack([turn.sine, zero, turn.cosine], dim=-1)
    stretch = turn.stretch[..., None]
    beside = torch.stack([zero, one, zero], dim=-1)
    jacobian = torch.stack([n, beside, m / stretch], dim=-2)
    slope = multiply(plane, gradient)
    bowl = jacobian.mT @ (plane @ hessian @ plane.mT) @ jacobian
    curvature = (shape.bend / turn.stretch)[..., None, None]
    mixed = n[..., :, None] * m[..., None, :]
    bowl = bowl - slope[..., :1, None] * curvature * (m[..., :, None] * m[..., None, :])
    bowl = bowl + slope[..., 2:, None] * curvature / stretch[..., None] * (mixed + mixed.mT)
    slope = multiply(jacobian.mT, slope)
    return multiply(plane.mT, slope), plane.mT @ bowl @ plane


def _power(base: Tensor, exponent: Tensor) -> Tensor:
    """`base ** exponent` for positive bases."""
    return (base.log() * exponent).exp()
