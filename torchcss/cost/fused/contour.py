"""What the image has at the contour nodes; the twin of `torchcss.cost.outline`.

Edges and colours look at the same nodes: their derivatives add up in the image, and are pulled back
once.
"""

from __future__ import annotations

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
from torchcss.cost.fused.records import Colours, Edges, Lens, Nodes, Points, Seen, Workspace
from torchcss.cost.fused.region import match_colours
from torchcss.kernels.compiler import kernel


@kernel
def compare_outline(
    nodes: Nodes, lens: Lens, edges: Edges, colours: Colours, exact: bool, workspace: Workspace
) -> float:
    """Cost of all contour nodes; the points get its derivatives.

    Args:
        nodes: The nodes that exist; all others cost what there is without a contour.
        lens: The camera.
        edges: The contour term.
        colours: The region term.
        exact: Whether the curvature of the projection counts.
        workspace: Memory for what is found on the way, and for the points.
    """
    count = _look(nodes, lens, workspace.seen)
    if edges.scale > 0.0:
        match_edges(edges, workspace.seen, count, workspace.response, workspace.peaks)
    if colours.scale > 0.0:
        match_colours(colours, workspace.seen, count)
    _pull_back(nodes, lens, workspace.seen, count, exact, workspace.points)
    return sum_outline(nodes, edges, colours, workspace.seen, count)


@kernel
def sum_outline(nodes: Nodes, edges: Edges, colours: Colours, seen: Seen, count: int) -> float:
    """Cost of all contour nodes, by what those that are seen gain."""
    hidden = edges.scale * edges.hidden + colours.scale * colours.hidden
    nothing = edges.scale * edges.back_facing + colours.scale * colours.back_facing
    unmatched = edges.scale * edges.unmatched + 0.5 * colours.scale * colours.nu
    total = 0.0
    for i in range(nodes.first[len(nodes.first) - 1]):
        cost = nodes.visible[i] * unmatched + (1.0 - nodes.visible[i]) * hidden
        total += nodes.exists[i] * (cost - nothing)
    for k in range(count):
        i = seen.node[k]
        total -= nodes.exists[i] * nodes.visible[i] * seen.gain[k]
    return total


@kernel
def _look(nodes: Nodes, lens: Lens, seen: Seen) -> int:
    """Project the nodes that are seen; their number."""
    count = 0
    for part in range(len(nodes.first) - 1):
        for i in range(nodes.first[part], nodes.first[part + 1]):
            if not nodes.exists[i] * nodes.visible[i] > 0.0:
                continue
            pixel = project(lens, nodes.x[i], nodes.y[i], nodes.z[i])
            if not pixel.valid:
                continue
            mu, mv = image_normal(lens, pixel, (nodes.nx[i], nodes.ny[i], nodes.nz[i]))
            seen.node[count], seen.part[count] = i, part
            seen.u[count], seen.v[count] = pixel.u, pixel.v
            seen.a[count], seen.b[count], seen.w[count] = pixel.a, pixel.b, pixel.w
            seen.aa[count], seen.ab[count], seen.bb[count] = pixel.aa, pixel.ab, pixel.bb
            seen.mu[count], seen.mv[count] = mu, mv
            seen.gain[count] = seen.gu[count] = seen.gv[count] = 0.0
            seen.uu[count] = seen.uv[count] = seen.vv[count] = 0.0
            count += 1
    return count


@kernel
def _pull_back(
    nodes: Nodes, lens: Lens, seen: Seen, count: int, exact: bool, points: Points
) -> None:
    """Write the nodes with their costs' derivatives in space."""
    part = -1
    for k in range(count):
        i = int(seen.node[k])
        while part < seen.part[k]:
            part += 1
            points.first[part] = k
        pixel = Pixel(
            seen.u[k],
            seen.v[k],
            True,
            seen.a[k],
            seen.b[k],
            seen.w[k],
            seen.aa[k],
            seen.ab[k],
            seen.bb[k],
        )
        slope = Slope(seen.gu[k], seen.gv[k], seen.uu[k], seen.uv[k], seen.vv[k])
        slope = times(nodes.exists[i] * nodes.visible[i], slope)
        place = nodes.x[i], nodes.y[i], nodes.z[i]
        write_point(points, k, place, pull_back(lens, pixel, slope, exact))
    for rest in range(part + 1, len(points.first)):
        points.first[rest] = count
