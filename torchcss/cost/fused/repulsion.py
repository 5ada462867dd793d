"""Repulsion between parts; the twin of `torchcss.cost.interpenetration`.

Spheres, then boxes along the axes of both parts, then the box of the one that repels sort out what
is apart. The sums over the nodes of a pair are those of `torchcss.cost.fused.lift`, about the
centre of the part that repels, with the twists of the joints between the two parts; joints that
move that part count with the opposite sign.
"""

from __future__ import annotations

from torchcss.cost.fused.compiler import entry, exp, inlined, kernel, log
from torchcss.cost.fused.kinematics import find_twists, pose_parts, pose_tree
from torchcss.cost.fused.lift import react, sum_points
from torchcss.cost.fused.projection import Spatial, write_point
from torchcss.cost.fused.records import Array, Parts, Points, Repulsion, Result, Room, Tree
from torchcss.cost.fused.superquadric import Bowl, bent_radial_square, radial_hessian


@entry
def add_repulsion(
    x: Array,
    tree: Tree,
    parts: Parts,
    repulsion: Repulsion,
    exact: bool,
    room: Room,
    result: Result,
) -> None:
    """Add the repulsion of all states of a pool.

    Args:
        x: The states.
        tree: The body's tree.
        parts: Its parts.
        repulsion: The term.
        exact: Whether the curvature of the kinematics counts.
        room: Room for what is found on the way.
        result: Where it is added.
    """
    slopes = len(result.gradient[0]) > 0
    for b in range(len(x)):
        pose_tree(x[b], tree, room.frames)
        pose_parts(room.frames, parts, room.frame, room.posed)
        room.reference[:] = 0.0
        if slopes:
            find_twists(room.frames, tree, room.reference, room.twists)
        gradient, hessian = result.gradient[b], result.hessian[b]
        for one in range(len(room.posed)):
            for other in range(len(room.posed)):
                pair = repulsion.pair[one, other]
                if pair < 0 or not _overlap(
                    room.posed[one], room.posed[other], repulsion, (one, other)
                ):
                    continue
                cost, count = _push(repulsion, room.posed, (one, other), slopes, room.points)
                result.value[b] += cost
                if slopes and count:
                    for i in range(3):
                        room.reference[i] = room.posed[other, i, 3]
                    room.sums[0] = 0.0
                    sum_points(room.points, 0, count, room.reference, room.sums[0])
                    _lift_pair(tree, repulsion, pair, exact, room, gradient, hessian)


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
def _push(
    repulsion: Repulsion, posed: Array, pair: tuple[int, int], slopes: bool, points: Points
) -> tuple[float, int]:
    """Cost of the nodes of a pair; those that feel it become points with its derivatives."""
    a, b, nodes, outer = (
        posed[pair[0]],
        posed[pair[1]],
        repulsion.nodes[pair[0]],
        repulsion.outer[pair[1]],
    )
    total, count = 0.0, 0
    for n in range(nodes.shape[1]):
        x, y, z = nodes[0, n], nodes[1, n], nodes[2, n]
        px = a[0, 0] * x + a[0, 1] * y + a[0, 2] * z + a[0, 3]
        py = a[1, 0] * x + a[1, 1] * y + a[1, 2] * z + a[1, 3]
        pz = a[2, 0] * x + a[2, 1] * y + a[2, 2] * z + a[2, 3]
        dx, dy, dz = px - b[0, 3], py - b[1, 3], pz - b[2, 3]
        x = b[0, 0] * dx + b[1, 0] * dy + b[2, 0] * dz
        y = b[0, 1] * dx + b[1, 1] * dy + b[2, 1] * dz
        z = b[0, 2] * dx + b[1, 2] * dy + b[2, 2] * dz
        if abs(x) >= outer[0] or abs(y) >= outer[1] or abs(z) >= outer[2]:
            continue
        if not slopes:
            square, _, _, _ = bent_radial_square(repulsion.shape, pair[1], (x, y, z))
            total += potential(repulsion, square)[0]
            continue
        bowl = radial_hessian(repulsion.shape, pair[1], (x, y, z))
        if bowl.square < repulsion.reach:
            value, first, second = potential(repulsion, bowl.square)
            total += value
            write_point(points, count, (px, py, pz), _turned(_bent(bowl, first, second), b))
            count += 1
    return total, count


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
def _bent(bowl: Bowl, first: float, second: float) -> Spatial:
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
    room: Room,
    gradient: Array,
    hessian: Array,
) -> None:
    """Add the derivatives of a pair's cost in the state."""
    cx, cy, cz = room.reference[0], room.reference[1], room.reference[2]
    chain, signs = repulsion.chain[pair], repulsion.sign[pair]
    for n in range(len(chain)):
        joint, twist = room.twists[chain[n]], room.moved[n]
        factor = signs[n] * tree.factor[chain[n]]
        if signs[n] == 0.0:
            return
        wx, wy, wz = joint[0], joint[1], joint[2]
        twist[0], twist[1], twist[2] = factor * wx, factor * wy, factor * wz
        twist[3] = factor * (joint[3] + wy * cz - wz * cy)
        twist[4] = factor * (joint[4] + wz * cx - wx * cz)
        twist[5] = factor * (joint[5] + wx * cy - wy * cx)
        slope, turning, shifting = react(room.sums[0], twist, exact)
        column = tree.column[chain[n]]
        gradient[column] += slope
        for m in range(n + 1):
            t, other = room.moved[m], tree.column[chain[m]]
            bend = t[0] * turning[0] + t[1] * turning[1] + t[2] * turning[2]
            bend += t[3] * shifting[0] + t[4] * shifting[1] + t[5] * shifting[2]
            hessian[other, column] += bend
            if m != n:
                hessian[column, other] += bend
