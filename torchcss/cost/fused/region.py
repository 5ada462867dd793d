"""Colours on either side of the contour; the twin of `torchcss.cost.region.RegionTerm`."""

from __future__ import annotations

from torchcss.cost.fused.records import Colours, Seen
from torchcss.cost.fused.spline import sample_spline
from torchcss.kernels.compiler import kernel


@kernel
def match_colours(colours: Colours, seen: Seen, count: int) -> None:
    """Add what the nodes gain by the colours inside and outside, and the derivatives."""
    level = 0.25 * colours.scale * colours.nu
    left, top = colours.origin[0], colours.origin[1]
    for k in range(count):
        layer, u, v = int(colours.layer[seen.part[k]]), seen.u[k], seen.v[k]
        du, dv = colours.offset * seen.mu[k], colours.offset * seen.mv[k]
        inside, outside = (u - du - left, v - dv - top), (u + du - left, v + dv - top)
        a = sample_spline(colours.field, colours.corner, layer, inside)
        b = sample_spline(colours.field, colours.corner, layer, outside)
        seen.gain[k] += level * (a.value - b.value)
        seen.gu[k] += level * (b.u - a.u)
        seen.gv[k] += level * (b.v - a.v)
        seen.uu[k] += level * (b.uu - a.uu)
        seen.uv[k] += level * (b.uv - a.uv)
        seen.vv[k] += level * (b.vv - a.vv)


@kernel
def held_contrast(colours: Colours, seen: Seen, k: int, place: tuple[float, float]) -> float:
    """What a node gains that has moved to a place in the image since its normal was found."""
    layer, u, v = int(colours.layer[seen.part[k]]), place[0], place[1]
    du, dv, origin = colours.offset * seen.mu[k], colours.offset * seen.mv[k], colours.origin
    inside, outside = (u - du, v - dv), (u + du, v + dv)
    gain = colours.scale * 0.0
    for (x, y), sign in ((inside, 1.0), (outside, -1.0)):
        there = x - origin[0], y - origin[1]
        gain += sign * sample_spline(colours.field, colours.corner, layer, there).value
    return 0.25 * colours.scale * colours.nu * gain
