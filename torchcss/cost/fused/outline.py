"""Nodes of the occluding contours; the twin of `torchcss.cost.visibility.ContourPredictor`.

On every ring and meridian of a part, `n . (c - p)` changes sign at most twice. A node is where it
does, by linear interpolation; it counts by how far the curve turns through the line of sight.
"""

from __future__ import annotations

from torchcss.cost.fused.records import Array, Curves, Nodes
from torchcss.kernels.compiler import inlined, kernel, sqrt

_GRAZING = 0.15
"""Sine of the angle by which a curve must turn through the line of sight to count fully."""


@kernel
def find_outline(curves: Curves, posed: Array, facing: Array, nodes: Nodes) -> None:
    """Find the contour nodes of all parts: those that exist, part after part."""
    count = 0
    for part in range(len(posed)):
        nodes.first[part] = count
        frame, table = posed[part], curves.table[part]
        # The camera is at the origin; this is it in the frame of the part.
        ex = -(frame[0, 0] * frame[0, 3] + frame[1, 0] * frame[1, 3] + frame[2, 0] * frame[2, 3])
        ey = -(frame[0, 1] * frame[0, 3] + frame[1, 1] * frame[1, 3] + frame[2, 1] * frame[2, 3])
        ez = -(frame[0, 2] * frame[0, 3] + frame[1, 2] * frame[1, 3] + frame[2, 2] * frame[2, 3])
        clear = _GRAZING * sqrt(ex * ex + ey * ey + ez * ez)
        _face(table, ex, ey, ez, facing)
        for ring in range(curves.rings):
            size: int = curves.ring_nodes
            start = ring * size
            most, least = facing[start], facing[start]
            for k in range(start + 1, start + size):
                most, least = max(most, facing[k]), min(least, facing[k])
            share = min(min(most, -least) / clear, 1.0)
            if not share > 0.0:
                continue
            for rising in range(2):
                step = _first_crossing(facing, start, size, rising)
                if step >= 0:
                    _add_node(table, facing, step, share, frame, nodes, count)
                    count += 1
        for meridian in range(curves.meridians):
            start: int = curves.rings * curves.ring_nodes + meridian * curves.meridian_nodes
            for rising in range(2):
                step = _first_crossing(facing, start, curves.meridian_nodes, rising)
                if step < 0:
                    continue
                sign = 1.0 if rising == 1 else -1.0
                before = after = facing[start] * 0.0
                for k in range(start, step + 1):
                    before = min(before, sign * facing[k])
                for k in range(step + 1, start + curves.meridian_nodes):
                    after = max(after, sign * facing[k])
                share = min(min(after, -before) / clear, 1.0)
                if share > 0.0:
                    _add_node(table, facing, step, share, frame, nodes, count)
                    count += 1
    nodes.first[len(posed)] = count


@kernel
def _face(table: Array, ex: float, ey: float, ez: float, facing: Array) -> None:
    """By how much each node of a part's curves faces the camera, `n . (c - p)`."""
    for k in range(table.shape[1]):
        facing[k] = ex * table[3, k] + ey * table[4, k] + ez * table[5, k] - table[9, k]


@inlined
def _first_crossing(facing: Array, start: int, size: int, rising: int) -> int:
    """The first step on a curve that turns to the front, or away from it; -1: there is none."""
    away = facing[start] < 0
    for k in range(start, start + size - 1):
        then = facing[k + 1] < 0
        if away != then and away == (rising == 1):
            return k
        away = then
    return -1


@inlined
def _add_node(
    table: Array, facing: Array, step: int, share: float, frame: Array, nodes: Nodes, i: int
) -> None:
    """Write the node where a curve turns, between the nodes of a step."""
    here, there = facing[step], facing[step + 1]
    change = here - there
    t = 0.5 * share / share
    if change != 0.0:
        t = min(max(here / change, 0.0), 1.0)
    bulge = 4.0 * t * (1.0 - t)
    n = step + 1
    x = table[0, step] + t * (table[0, n] - table[0, step]) + bulge * table[6, step]
    y = table[1, step] + t * (table[1, n] - table[1, step]) + bulge * table[7, step]
    z = table[2, step] + t * (table[2, n] - table[2, step]) + bulge * table[8, step]
    a = table[3, step] + t * (table[3, n] - table[3, step])
    b = table[4, step] + t * (table[4, n] - table[4, step])
    c = table[5, step] + t * (table[5, n] - table[5, step])
    turned = 1.0 / max(sqrt(a * a + b * b + c * c), 1e-6)
    a, b, c = a * turned, b * turned, c * turned
    nodes.x[i] = frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z + frame[0, 3]
    nodes.y[i] = frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z + frame[1, 3]
    nodes.z[i] = frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z + frame[2, 3]
    nodes.nx[i] = frame[0, 0] * a + frame[0, 1] * b + frame[0, 2] * c
    nodes.ny[i] = frame[1, 0] * a + frame[1, 1] * b + frame[1, 2] * c
    nodes.nz[i] = frame[2, 0] * a + frame[2, 1] * b + frame[2, 2] * c
    nodes.exists[i], nodes.visible[i] = share, 1.0
