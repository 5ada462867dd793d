"""Nodes all over the surface against the optical flow; the twin of `torchcss.cost.flow`."""

from __future__ import annotations

from torchcss.cost.fused.potentials import potential_of, robust_slope
from torchcss.cost.fused.projection import project, pull_back, times, write_point
from torchcss.cost.fused.records import Array, Flow, Lens, Nodes, Points
from torchcss.kernels.compiler import kernel, sqrt

_GRAZING = 0.15
_NEAR_RAMP = 0.1
"""Depth behind the camera's near plane over which a node comes to count, metres."""


@kernel
def find_interior(table: Array, posed: Array, nodes: Nodes) -> None:
    """Place the nodes, `[parts 6 nodes]` in their parts; `exists` says how they face the camera."""
    size = table.shape[2]
    for part in range(len(posed)):
        nodes.first[part] = part * size
        _place(table[part], posed[part], part * size, nodes)
    nodes.first[len(posed)] = len(posed) * size


@kernel
def _place(table: Array, frame: Array, start: int, nodes: Nodes) -> None:
    for k in range(table.shape[1]):
        i = start + k
        a, b, c = table[0, k], table[1, k], table[2, k]
        x = frame[0, 0] * a + frame[0, 1] * b + frame[0, 2] * c + frame[0, 3]
        y = frame[1, 0] * a + frame[1, 1] * b + frame[1, 2] * c + frame[1, 3]
        z = frame[2, 0] * a + frame[2, 1] * b + frame[2, 2] * c + frame[2, 3]
        a, b, c = table[3, k], table[4, k], table[5, k]
        nx = frame[0, 0] * a + frame[0, 1] * b + frame[0, 2] * c
        ny = frame[1, 0] * a + frame[1, 1] * b + frame[1, 2] * c
        nz = frame[2, 0] * a + frame[2, 1] * b + frame[2, 2] * c
        distance = sqrt(x * x + y * y + z * z)
        facing = -(nx * x + ny * y + nz * z) / (_GRAZING * max(distance, 1e-30))
        nodes.x[i], nodes.y[i], nodes.z[i] = x, y, z
        nodes.nx[i], nodes.ny[i], nodes.nz[i] = nx, ny, nz
        nodes.exists[i] = min(max(facing, 0.0), 1.0)
        nodes.visible[i] = 1.0


@kernel
def follow_flow(
    nodes: Nodes, lens: Lens, flow: Flow, mode: int, exact: bool, held: bool, points: Points
) -> float:
    """Cost of all nodes about the targets of a mode; the points get its derivatives.

    Args:
        nodes: The nodes.
        lens: The camera.
        flow: The term.
        mode: The mode.
        exact: Whether the curvature of the projection counts.
        held: Whether a node is as much in front of the camera as when this was last asked.
        points: The points.
    """
    total, count, target = 0.0, 0, flow.target[mode]
    size = flow.nodes.shape[2]
    for part in range(len(nodes.first) - 1):
        points.first[part] = count
        for i in range(nodes.first[part], nodes.first[part + 1]):
            x, y, z = nodes.x[i], nodes.y[i], nodes.z[i]
            k = i - part * size
            weight = target[2, part, k]
            untold = (1.0 - weight) * flow.untold
            near = min(max((z - lens.near) / _NEAR_RAMP, 0.0), 1.0)
            pixel = project(lens, x, y, z)
            if not pixel.valid:
                near = 0.0 * lens.near
            if held:
                near = nodes.near[i]
            nodes.near[i] = near
            cost = near * flow.back_facing
            facing, visible = nodes.exists[i], nodes.visible[i]
            if facing * near > 0.0:
                du, dv = pixel.u - target[0, part, k], pixel.v - target[1, part, k]
                rho, slope = robust_slope(flow.potential, weight, du, dv)
                told = visible * (0.5 * rho + untold) + (1.0 - visible) * flow.hidden
                cost = near * (facing * told + (1.0 - facing) * flow.back_facing)
                seen = flow.scale * facing * visible * near
                if seen * weight > 0.0:
                    spatial = pull_back(lens, pixel, times(seen, slope), exact)
                    write_point(points, count, (x, y, z), spatial)
                    count += 1
            if near < 1.0:
                far, _, _ = potential_of(flow.potential, weight * flow.far)
                cost = cost + (1.0 - near) * (0.5 * far + untold)
            total += flow.scale * cost
    points.first[len(nodes.first) - 1] = count
    return total
