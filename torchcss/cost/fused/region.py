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
