"""The learnt prior on poses, in double precision; the twin of `torchcss.cost.pose_prior`."""

from __future__ import annotations

import math

from torchcss.cost.fused.kinematics import find_twists, pose_tree
from torchcss.cost.fused.records import Array, Limbs, LimbScratch, Result, Tree
from torchcss.kernels.compiler import entry, inlined, kernel

_SHORT = 1e-9
_TRUNK = 2


@entry
def add_pose_prior(
    x: Array, tree: Tree, limbs: Limbs, scratch: LimbScratch, result: Result
) -> None:
    """Add the prior of all states of a pool.

    Args:
        x: The states, `[b n]`.
        tree: The body's tree.
        limbs: The directions of the body, and their density.
        scratch: Memory for what is found on the way.
        result: Where it is added.
    """
    slopes = len(result.gradient[0]) > 0
    for b in range(len(x)):
        pose_tree(x[b], tree, scratch.frames)
        _find_units(limbs, scratch)
        for line in range(2):
            _find_axes(line, scratch)
        if slopes:
            scratch.reference[:] = 0.0
            find_twists(scratch.frames, tree, scratch.reference, scratch.twists)
            for joint in range(len(tree.parent)):
                _move_units(joint, limbs, scratch)
                for line in range(2):
                    _turn_axes(joint, line, scratch)
        for group in range(len(limbs.first)):
            _find_directions(group, limbs, scratch)
            result.value[b] += limbs.scale * _density(group, limbs, scratch)
            if slopes:
                _find_slopes(group, tree, limbs, scratch)
                _lift(group, limbs, scratch, result.gradient[b], result.hessian[b])


@kernel
def _find_units(limbs: Limbs, scratch: LimbScratch) -> None:
    """Directions and lengths of all segments."""
    for p in range(len(limbs.row)):
        frame, place = scratch.frames[limbs.row[p]], limbs.place[p]
        for i in range(3):
            scratch.point[p, i] = frame[i, 3]
            for k in range(3):
                scratch.point[p, i] += frame[i, k] * place[k]
    for m in range(len(limbs.end)):
        square = 0.0
        for i in range(3):
            apart = limbs.fixed[m, i]
            for e in range(limbs.end.shape[1]):
                apart += limbs.difference[m, e] * scratch.point[limbs.end[m, e], i]
            scratch.unit[m, i] = apart
            square += apart * apart
        scratch.length[m] = max(math.sqrt(square), _SHORT)
        for i in range(3):
            scratch.unit[m, i] /= scratch.length[m]


@kernel
def _cross(a: Array, b: Array, product: Array) -> None:
    product[0] = a[1] * b[2] - a[2] * b[1]
    product[1] = a[2] * b[0] - a[0] * b[2]
    product[2] = a[0] * b[1] - a[1] * b[0]


@kernel
def _find_axes(line: int, scratch: LimbScratch) -> None:
    """The frame along hips or shoulders: left, up, front."""
    axes = scratch.axes[line]
    for i in range(3):
        axes[0, i] = scratch.unit[line, i]
    _cross(axes[0], scratch.unit[_TRUNK], axes[2])
    normal = math.sqrt(axes[2, 0] ** 2 + axes[2, 1] ** 2 + axes[2, 2] ** 2)
    scratch.normal[line] = max(normal, _SHORT)
    for i in range(3):
        axes[2, i] /= scratch.normal[line]
    _cross(axes[2], axes[0], axes[1])


@kernel
def _move_units(joint: int, limbs: Limbs, scratch: LimbScratch) -> None:
    """How the directions of all segments move with a joint."""
    twist, moved = scratch.twists[joint], scratch.moved[joint]
    for p in range(len(limbs.row)):
        point, velocity = scratch.point[p], scratch.velocity[p]
        x, y, z = (point[0], point[1], point[2])
        share = 1.0 if limbs.above[joint, p] else 0.0
        velocity[0] = share * (twist[1] * z - twist[2] * y + twist[3])
        velocity[1] = share * (twist[2] * x - twist[0] * z + twist[4])
        velocity[2] = share * (twist[0] * y - twist[1] * x + twist[5])
    for m in range(len(limbs.end)):
        x = y = z = 0.0
        if limbs.moves[joint, m]:
            for e in range(limbs.end.shape[1]):
                share, velocity = limbs.difference[m, e], scratch.velocity[limbs.end[m, e]]
                x += share * velocity[0]
                y += share * velocity[1]
                z += share * velocity[2]
            unit, shorter = scratch.unit[m], 1.0 / scratch.length[m]
            along = x * unit[0] + y * unit[1] + z * unit[2]
            x, y = (x - along * unit[0]) * shorter, (y - along * unit[1]) * shorter
            z = (z - along * unit[2]) * shorter
        moved[m, 0], moved[m, 1], moved[m, 2] = x, y, z


@kernel
def _turn_axes(joint: int, line: int, scratch: LimbScratch) -> None:
    """How a frame turns with a joint: about its left by how its front moves against its up."""
    axes, moved, spin = scratch.axes[line], scratch.moved[joint], scratch.spin[joint, line]
    about = 0.0
    _cross(moved[line], scratch.unit[_TRUNK], spin)
    for i in range(3):
        about -= axes[1, i] * spin[i]
    _cross(axes[0], moved[_TRUNK], spin)
    for i in range(3):
        about -= axes[1, i] * spin[i]
    _cross(axes[0], moved[line], spin)
    for i in range(3):
        spin[i] += about / scratch.normal[line] * axes[0, i]


@kernel
def _find_directions(group: int, limbs: Limbs, scratch: LimbScratch) -> None:
    """The directions of a group in its frame."""
    axes = scratch.axes[limbs.line[group]]
    for s in range(limbs.segments[group]):
        unit = scratch.unit[limbs.first[group] + s]
        for k in range(3):
            place = unit[0] * axes[k, 0] + unit[1] * axes[k, 1] + unit[2] * axes[k, 2]
            scratch.direction[3 * s + k] = limbs.side[group, k] * place


@kernel
def _density(group: int, limbs: Limbs, scratch: LimbScratch) -> float:
    """`-log p` of a group's directions, the shares of its Gaussians, and their pulls."""
    size, number, most = 3 * limbs.segments[group], limbs.number[group], limbs.uniform[group]
    share = scratch.share
    for k in range(number):
        share[k] = limbs.height[group, k]
    for i in range(size):
        mean, offset = limbs.mean[group, i], scratch.offset[i]
        for k in range(number):
            offset[k] = scratch.direction[i] - mean[k]
    for i in range(size):
        pull, own = scratch.pulls[i], scratch.offset[i]
        for k in range(number):
            pull[k] = 0.0
        for j in range(size):
            precision, offset = limbs.precision[group, i, j], scratch.offset[j]
            for k in range(number):
                pull[k] += precision[k] * offset[k]
        for k in range(number):
            share[k] -= 0.5 * pull[k] * own[k]
    for k in range(number):
        most = max(most, share[k])
    total = math.exp(limbs.uniform[group] - most)
    for k in range(number):
        share[k] = math.exp(share[k] - most)
        total += share[k]
    for k in range(number):
        share[k] /= total
    return -(most + math.log(total))


@kernel
def _find_slopes(group: int, tree: Tree, limbs: Limbs, scratch: LimbScratch) -> None:
    """How the directions of a group move with each parameter."""
    line = limbs.line[group]
    axes, slope = scratch.axes[line], scratch.slope
    slope[:] = 0.0
    scratch.touched[:] = False
    for joint in range(len(tree.parent)):
        if not limbs.bends[group, joint]:
            continue
        column, factor = tree.column[joint], tree.factor[joint]
        scratch.touched[column] = True
        for s in range(limbs.segments[group]):
            row = limbs.first[group] + s
            _cross(scratch.spin[joint, line], scratch.unit[row], scratch.turned)
            for k in range(3):
                moved = 0.0
                for i in range(3):
                    moved += (scratch.moved[joint, row, i] - scratch.turned[i]) * axes[k, i]
                slope[3 * s + k, column] += factor * limbs.side[group, k] * moved


@kernel
def _lift(group: int, limbs: Limbs, scratch: LimbScratch, gradient: Array, hessian: Array) -> None:
    """Add the derivatives of a group's density in the state."""
    size, number, slope = 3 * limbs.segments[group], limbs.number[group], scratch.slope
    for i in range(size):
        scratch.pull[i] = limbs.scale * _dot(scratch.pulls[i], scratch.share, number)
        for j in range(i + 1):
            bend = limbs.scale * _dot(limbs.precision[group, i, j], scratch.share, number)
            scratch.bend[i, j] = scratch.bend[j, i] = bend
        for a in range(len(gradient)):
            scratch.bent[i, a] = 0.0
    for i in range(size):
        bend, bent = scratch.bend[i], scratch.bent[i]
        for j in range(0, size, 3):
            _add(bend[j : j + 3], slope[j], slope[j + 1], slope[j + 2], bent)
    for i in range(0, size, 3):
        _add(scratch.pull[i : i + 3], slope[i], slope[i + 1], slope[i + 2], gradient)
        one, two, three = scratch.bent[i], scratch.bent[i + 1], scratch.bent[i + 2]
        for a in range(len(gradient)):
            if scratch.touched[a]:
                turn = scratch.turned
                turn[0], turn[1], turn[2] = one[a], two[a], three[a]
                _add(turn, slope[i], slope[i + 1], slope[i + 2], hessian[a])


@inlined
def _dot(a: Array, b: Array, size: int) -> float:
    total = 0.0
    for k in range(size):
        total += a[k] * b[k]
    return total


@inlined
def _add(share: Array, one: Array, two: Array, three: Array, total: Array) -> None:
    """Add three rows, those of one segment, in their shares."""
    first, second, third = share[0], share[1], share[2]
    for a in range(len(total)):
        total[a] += first * one[a] + second * two[a] + third * three[a]
