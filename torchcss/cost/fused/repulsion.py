"""Repulsion between parts; the twin of `torchcss.cost.interpenetration`.

Spheres, then boxes along the axes of both parts, then the box of the one that repels sort out what
is apart. The sums over the nodes of a pair are those of `torchcss.cost.fused.lift`, about the
centre of the part that repels, with the twists of the joints between the two parts; joints that
move that part count with the opposite sign.
"""

from __future__ import annotations

from torchcss.cost.fused.kinematics import find_twists, pose_parts, pose_tree
from torchcss.cost.fused.lift import react, sum_points
from torchcss.cost.fused.projection import Spatial, read_point, write_point
from torchcss.cost.fused.records import (
    Array,
    Lines,
    PairScratch,
    Parts,
    Points,
    Repulsion,
    Result,
    Tree,
)
from torchcss.cost.fused.superquadric import (
    as_spatial,
    bent_radial_square,
    radial_hessian,
    radial_square,
    shape_of,
    straight_hessian,
)
from torchcss.kernels.compiler import entry, exp, inlined, kernel, log


@entry
def add_repulsion(
    x: Array,
    tree: Tree,
    parts: Parts,
    repulsion: Repulsion,
    exact: bool,
    scratch: PairScratch,
    result: Result,
) -> None:
    """Add the repulsion of all states of a pool.

    Args:
        x: The states.
        tree: The body's tree.
        parts: Its parts.
        repulsion: The term.
        exact: Whether the curvature of the kinematics counts.
        scratch: Memory for what is found on the way.
        result: Where it is added.
    """
    slopes = len(result.gradient[0]) > 0
    for b in range(len(x)):
        pose_tree(x[b], tree, scratch.frames)
        pose_parts(scratch.frames, parts, scratch.frame, scratch.posed)
        scratch.reference[:] = 0.0
        if slopes:
            find_twists(scratch.frames, tree, scratch.reference, scratch.twists)
        found = _find_nodes(repulsion, scratch.posed, scratch.lines)
        _measure(repulsion.shape, scratch.lines, found)
        if not slopes:
            for m in range(found):
                result.value[b] += potential(repulsion, scratch.lines.value[m])[0]
            continue
        gradient, hessian = result.gradient[b], result.hessian[b]
        found = _felt(scratch.lines, found, repulsion.reach)
        _curve(repulsion.shape, scratch.lines, found, scratch.points)
        m = 0
        while m < found:
            begin, pair = m, scratch.lines.ray[m]
            cost, m = _push(repulsion, scratch, m, found)
            result.value[b] += cost
            scratch.sums[0] = 0.0
            sum_points(scratch.points, begin, m, scratch.reference, scratch.sums[0])
            _lift_pair(tree, repulsion, pair, exact, scratch, gradient, hessian)


@kernel
def _find_nodes(repulsion: Repulsion, posed: Array, lines: Lines) -> int:
    """List the nodes that may feel another part, in its frame; their number."""
    found = 0
    for one in range(len(posed)):
        for other in range(len(posed)):
            pair = repulsion.pair[one, other]
            if pair >= 0 and _overlap(posed[one], posed[other], repulsion, (one, other)):
                found = _add_nodes(repulsion, posed, (one, other), lines, found)
    return found


@kernel
def _add_nodes(
    repulsion: Repulsion, posed: Array, pair: tuple[int, int], lines: Lines, found: int
) -> int:
    """Add the nodes of a part that are in the box of another one; the list's new length."""
    a, b, number = posed[pair[0]], posed[pair[1]], repulsion.pair[pair[0], pair[1]]
    nodes, outer = repulsion.nodes[pair[0]], repulsion.outer[pair[1]]
    dx, dy, dz = a[0, 3] - b[0, 3], a[1, 3] - b[1, 3], a[2, 3] - b[2, 3]
    for n in range(nodes.shape[1]):
        x, y, z = nodes[0, n], nodes[1, n], nodes[2, n]
        px = a[0, 0] * x + a[0, 1] * y + a[0, 2] * z + dx
        py = a[1, 0] * x + a[1, 1] * y + a[1, 2] * z + dy
        pz = a[2, 0] * x + a[2, 1] * y + a[2, 2] * z + dz
        x = b[0, 0] * px + b[1, 0] * py + b[2, 0] * pz
        y = b[0, 1] * px + b[1, 1] * py + b[2, 1] * pz
        z = b[0, 2] * px + b[1, 2] * py + b[2, 2] * pz
        lines.x[found], lines.y[found], lines.z[found] = x, y, z
        lines.part[found], lines.ray[found] = pair[1], number
        inside = (abs(x) < outer[0]) & (abs(y) < outer[1]) & (abs(z) < outer[2])
        found += int(inside)
    return found


@kernel
def _measure(table: Array, lines: Lines, found: int) -> None:
    """R^2 of all nodes in the list."""
    for m in range(found):
        shape = shape_of(table, lines.part[m])
        square, _, _, _ = radial_square(shape, lines.x[m], lines.y[m], lines.z[m])
        lines.value[m] = square
    for m in range(found):
        part = lines.part[m]
        if table[10, part] != 0.0:
            place = lines.x[m], lines.y[m], lines.z[m]
            lines.value[m], _, _, _ = bent_radial_square(table, part, place)


@kernel
def _overlap(a: Array, b: Array, repulsion: Repulsion, pair: tuple[int, int]) -> bool:
    """Whether the nodes of part a may be in the potential of part b."""
    dx, dy, dz = a[0, 3] - b[0, 3], a[1, 3] - b[1, 3], a[2, 3] - b[2, 3]
    inner, outer = repulsion.inner[pair[0]], repulsion.outer[pair[1]]
    reach = repulsion.spheres[pair[0], pair[1]]
    if dx * dx + dy * dy + dz * dz > reach * reach:
        return False
    for i in range(3):
        along = abs(b[0, i] * dx + b[1, i] * dy + b[2, i] * dz)
        for k in range(3):
            along -= abs(b[0, i] * a[0, k] + b[1, i] * a[1, k] + b[2, i] * a[2, k]) * inner[k]
        if along > outer[i]:
            return False
    for i in range(3):
        along = abs(a[0, i] * dx + a[1, i] * dy + a[2, i] * dz)
        for k in range(3):
            along -= abs(a[0, i] * b[0, k] + a[1, i] * b[1, k] + a[2, i] * b[2, k]) * outer[k]
        if along > inner[i]:
            return False
    return True


@kernel
def _felt(lines: Lines, found: int, reach: float) -> int:
    """Keep the nodes that feel the other part; their number."""
    kept = 0
    for m in range(found):
        lines.x[kept], lines.y[kept], lines.z[kept] = lines.x[m], lines.y[m], lines.z[m]
        lines.part[kept], lines.ray[kept] = lines.part[m], lines.ray[m]
        kept += int(lines.value[m] < reach)
    return kept


@kernel
def _curve(table: Array, lines: Lines, found: int, points: Points) -> None:
    """R^2 of the nodes with its derivatives, in the frames of the other parts."""
    for m in range(found):
        shape = shape_of(table, lines.part[m])
        place = lines.x[m], lines.y[m], lines.z[m]
        bowl = straight_hessian(shape, place[0], place[1], place[2])
        lines.value[m] = bowl.square
        write_point(points, m, place, as_spatial(bowl))
    for m in range(found):
        if table[10, lines.part[m]] != 0.0:
            place = lines.x[m], lines.y[m], lines.z[m]
            bowl = radial_hessian(table, lines.part[m], place)
            lines.value[m] = bowl.square
            write_point(points, m, place, as_spatial(bowl))


@kernel
def _push(repulsion: Repulsion, scratch: PairScratch, m: int, found: int) -> tuple[float, int]:
    """The next pair: its cost and where it ends. Its points get the cost's derivatives."""
    lines, points, total, pair = scratch.lines, scratch.points, 0.0, scratch.lines.ray[m]
    frame = scratch.posed[lines.part[m]]
    for i in range(3):
        scratch.reference[i] = frame[i, 3]
    while m < found and lines.ray[m] == pair:
        x, y, z = points.x[m], points.y[m], points.z[m]
        value, first, second = potential(repulsion, lines.value[m])
        total += value
        place = (
            frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z + frame[0, 3],
            frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z + frame[1, 3],
            frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z + frame[2, 3],
        )
        cost = _bent(read_point(points, m), first, second)
        write_point(points, m, place, _turned(cost, frame))
        m += 1
    return total, m


@inlined
def potential(repulsion: Repulsion, square: float) -> tuple[float, float, float]:
    """Cost of a node and its first and second derivatives in `R^2`."""
    f = repulsion.sharpness * (square - 1.0)
    if not f < repulsion.end:
        return 0.0 * f, 0.0 * f, 0.0 * f
    u, du, ddu = f, repulsion.sharpness, 0.0 * f
    if repulsion.p > 1.0:
        size = max(abs(f), 1e-30)
        power = exp((repulsion.p - 2.0) * log(size))
        ddu = repulsion.p * (repulsion.p - 1.0) * power
        ddu = (ddu if f > 0.0 else -ddu) * repulsion.sharpness * repulsion.sharpness
        u, du = f * size * power, repulsion.p * repulsion.sharpness * size * power
    paper, last = exp(-u), repulsion.last
    value = paper - last * (1.0 + repulsion.exponent - u)
    first, second = (last - paper) * du, paper * du * du + (last - paper) * ddu
    return repulsion.scale * value, repulsion.scale * first, repulsion.scale * second


@inlined
def _bent(bowl: Spatial, first: float, second: float) -> Spatial:
    """Derivatives of a function of `R^2`."""
    return Spatial(
        first * bowl.x,
        first * bowl.y,
        first * bowl.z,
        first * bowl.xx + second * bowl.x * bowl.x,
        first * bowl.xy + second * bowl.x * bowl.y,
        first * bowl.xz + second * bowl.x * bowl.z,
        first * bowl.yy + second * bowl.y * bowl.y,
        first * bowl.yz + second * bowl.y * bowl.z,
        first * bowl.zz + second * bowl.z * bowl.z,
    )


@inlined
def _turned(cost: Spatial, frame: Array) -> Spatial:
    """Derivatives in the axes of a frame, as those in the camera's."""
    a, b, c = frame[0, 0], frame[0, 1], frame[0, 2]
    d, e, f = frame[1, 0], frame[1, 1], frame[1, 2]
    g, h, i = frame[2, 0], frame[2, 1], frame[2, 2]
    # Rows of R A.
    ax = a * cost.xx + b * cost.xy + c * cost.xz
    ay = a * cost.xy + b * cost.yy + c * cost.yz
    az = a * cost.xz + b * cost.yz + c * cost.zz
    dx = d * cost.xx + e * cost.xy + f * cost.xz
    dy = d * cost.xy + e * cost.yy + f * cost.yz
    dz = d * cost.xz + e * cost.yz + f * cost.zz
    gx = g * cost.xx + h * cost.xy + i * cost.xz
    gy = g * cost.xy + h * cost.yy + i * cost.yz
    gz = g * cost.xz + h * cost.yz + i * cost.zz
    return Spatial(
        a * cost.x + b * cost.y + c * cost.z,
        d * cost.x + e * cost.y + f * cost.z,
        g * cost.x + h * cost.y + i * cost.z,
        ax * a + ay * b + az * c,
        ax * d + ay * e + az * f,
        ax * g + ay * h + az * i,
        dx * d + dy * e + dz * f,
        dx * g + dy * h + dz * i,
        gx * g + gy * h + gz * i,
    )


@kernel
def _lift_pair(
    tree: Tree,
    repulsion: Repulsion,
    pair: int,
    exact: bool,
    scratch: PairScratch,
    gradient: Array,
    hessian: Array,
) -> None:
    """Add the derivatives of a pair's cost in the state."""
    cx, cy, cz = scratch.reference[0], scratch.reference[1], scratch.reference[2]
    chain, signs = repulsion.chain[pair], repulsion.sign[pair]
    for n in range(len(chain)):
        joint, twist = scratch.twists[chain[n]], scratch.moved[n]
        factor = signs[n] * tree.factor[chain[n]]
        if signs[n] == 0.0:
            return
        wx, wy, wz = joint[0], joint[1], joint[2]
        twist[0], twist[1], twist[2] = factor * wx, factor * wy, factor * wz
        twist[3] = factor * (joint[3] + wy * cz - wz * cy)
        twist[4] = factor * (joint[4] + wz * cx - wx * cz)
        twist[5] = factor * (joint[5] + wx * cy - wy * cx)
        slope, turning, shifting = react(scratch.sums[0], twist, 1.0 if exact else 0.0)
        column = tree.column[chain[n]]
        gradient[column] += slope
        for m in range(n + 1):
            t, other = scratch.moved[m], tree.column[chain[m]]
            bend = t[0] * turning[0] + t[1] * turning[1] + t[2] * turning[2]
            bend += t[3] * shifting[0] + t[4] * shifting[1] + t[5] * shifting[2]
            hessian[other, column] += bend
            if m != n:
                hessian[column, other] += bend
