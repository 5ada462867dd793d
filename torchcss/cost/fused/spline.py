"""Images as cubic splines; the twin of `torchcss.vision.spline`."""

from __future__ import annotations

from collections import namedtuple

from torchcss.cost.fused.records import Array
from torchcss.kernels.compiler import floor, inlined

_MARGIN = 4
_LEAST = 1.5 - _MARGIN


Sample = namedtuple("Sample", "value u v uu uv vv")
"""The image at a point, with its derivatives along u and v."""


Basis = namedtuple("Basis", "a b c d")
"""The four cubic B-splines on a cell, or their derivatives."""


@inlined
def sample_spline(field: Array, corner: Array, layer: int, place: tuple[float, float]) -> Sample:
    """Evaluate a layer and its derivatives.

    Args:
        field: Coefficients `[layers y x]` within their margins.
        corner: Last places of the first of four coefficients, along u and v, as `real` numbers.
        layer: The image.
        place: Column and row, pixels.
    """
    u, v = place
    x, y = min(max(u, _LEAST), corner[0]), min(max(v, _LEAST), corner[1])
    left, top = floor(x), floor(y)
    column, row = int(left) + (_MARGIN - 1), int(top) + (_MARGIN - 1)
    bu, su, cu = _basis(x - left)
    bv, sv, cv = _basis(y - top)
    fa, ga, ha = _row(field, layer, row, column, (bu, su, cu))
    fb, gb, hb = _row(field, layer, row + 1, column, (bu, su, cu))
    fc, gc, hc = _row(field, layer, row + 2, column, (bu, su, cu))
    fd, gd, hd = _row(field, layer, row + 3, column, (bu, su, cu))
    return Sample(
        bv.a * fa + bv.b * fb + bv.c * fc + bv.d * fd,
        bv.a * ga + bv.b * gb + bv.c * gc + bv.d * gd,
        sv.a * fa + sv.b * fb + sv.c * fc + sv.d * fd,
        bv.a * ha + bv.b * hb + bv.c * hc + bv.d * hd,
        sv.a * ga + sv.b * gb + sv.c * gc + sv.d * gd,
        cv.a * fa + cv.b * fb + cv.c * fc + cv.d * fd,
    )


@inlined
def _basis(t: float) -> tuple[Basis, Basis, Basis]:
    """The splines at a fraction of a cell, their first and their second derivatives."""
    r = 1.0 - t
    t2, r2 = t * t, r * r
    sixth, third = 1.0 / 6.0, 2.0 / 3.0
    values = Basis(
        r2 * r * sixth, third - t2 + 0.5 * t2 * t, third - r2 + 0.5 * r2 * r, t2 * t * sixth
    )
    slopes = Basis(-0.5 * r2, 1.5 * t2 - 2.0 * t, 2.0 * r - 1.5 * r2, 0.5 * t2)
    return values, slopes, Basis(r, 3.0 * t - 2.0, 3.0 * r - 2.0, t)


@inlined
def _row(
    field: Array, layer: int, row: int, column: int, bases: tuple[Basis, Basis, Basis]
) -> tuple[float, float, float]:
    """Four coefficients of a row, summed with the splines along u and with their derivatives."""
    a, b = field[layer, row, column], field[layer, row, column + 1]
    c, d = field[layer, row, column + 2], field[layer, row, column + 3]
    f, g, h = bases
    return (
        f.a * a + f.b * b + f.c * c + f.d * d,
        g.a * a + g.b * b + g.c * c + g.d * d,
        h.a * a + h.b * b + h.c * c + h.d * d,
    )
