"""Edges and colours at the contour nodes; twins of `torchcss.cost.contour` and `region`.

Both look at the same nodes: their derivatives add up in the image, and are pulled back once.
"""

from __future__ import annotations

from torchcss.cost.fused.compiler import inlined, kernel
from torchcss.cost.fused.edges import match_edges
from torchcss.cost.fused.projection import (
    Pixel,
    Slope,
    image_normal,
    project,
    pull_back,
    times,
    write_point,
)
from torchcss.cost.fused.records import Array, Colours, Edges, Lens, Nodes, Points
from torchcss.cost.fused.spline import sample_spline


@kernel
def compare_outline(
    nodes: Nodes,
    lens: Lens,
    edges: Edges,
    colours: Colours,
    exact: bool,
    points: Points,
    response: Array,
    found: Array,
) -> float:
    """Cost of all contour nodes; the points get its derivatives.

    Args:
        nodes: The nodes that exist; all others cost what there is without a contour.
        lens: The camera.
        edges: The contour term.
        colours: The region term.
        exact: Whether the curvature of the projection counts.
        points: One for each node.
        response: Room for the samples of a line.
        found: Room for its edges.
    """
    total, count = 0.0, 0
    hidden = edges.scale * edges.hidden + colours.scale * colours.hidden
    nothing = edges.scale * edges.back_facing + colours.scale * colours.back_facing
    unmatched = edges.scale * edges.unmatched + 0.5 * colours.scale * colours.nu
    for part in range(len(nodes.first) - 1):
        points.first[part] = count
        for i in range(nodes.first[part], nodes.first[part + 1]):
            there, visible = nodes.exists[i], nodes.visible[i]
            cost = hidden
            if there * visible > 0.0:
                x, y, z = nodes.x[i], nodes.y[i], nodes.z[i]
                pixel, matched = project(lens, x, y, z), unmatched
                if pixel.valid:
                    normal = image_normal(lens, pixel, (nodes.nx[i], nodes.ny[i], nodes.nz[i]))
                    gain, slope = _look(edges, colours, part, (pixel, normal), (response, found))
                    matched = matched - gain
                    spatial = pull_back(lens, pixel, times(there * visible, slope), exact)
                    write_point(points, count, (x, y, z), spatial)
                    count += 1
                cost = visible * matched + (1.0 - visible) * hidden
            total += there * (cost - nothing)
    points.first[len(nodes.first) - 1] = count
    return total


@inlined
def _look(
    edges: Edges,
    colours: Colours,
    part: int,
    place: tuple[Pixel, tuple[float, float]],
    room: tuple[Array, Array],
) -> tuple[float, Slope]:
    """What a node gains by what the image shows there, and the cost's derivatives in the image."""
    pixel, (mu, mv) = place
    gain = edges.scale * 0.0
    slope = Slope(gain, gain, gain, gain, gain)
    if edges.scale > 0.0:
        depth, along, curvature = match_edges(edges, pixel, (mu, mv), room[0], room[1])
        gain, along, curvature = edges.scale * depth, edges.scale * along, edges.scale * curvature
        slope = Slope(
            along * mu, along * mv, curvature * mu * mu, curvature * mu * mv, curvature * mv * mv
        )
    if colours.scale > 0.0:
        layer, du, dv = colours.layer[part], colours.offset * mu, colours.offset * mv
        a = sample_spline(colours.field, colours.corner, layer, (pixel.u - du, pixel.v - dv))
        b = sample_spline(colours.field, colours.corner, layer, (pixel.u + du, pixel.v + dv))
        level = 0.25 * colours.scale * colours.nu
        gain = gain + level * (a.value - b.value)
        slope = Slope(
            slope.u + level * (b.u - a.u),
            slope.v + level * (b.v - a.v),
            slope.uu + level * (b.uu - a.uu),
            slope.uv + level * (b.uv - a.uv),
            slope.vv + level * (b.vv - a.vv),
        )
    return gain, slope
