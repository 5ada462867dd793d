"""The learnt prior on poses, in double precision; the twin of `torchcss.cost.pose_prior`."""

from __future__ import annotations

import math

from torchcss.cost.fused.kinematics import find_twists, pose_tree
from torchcss.cost.fused.records import Array, Limbs, LimbScratch, Result, Tree
from torchcss.kernels.compiler import entry, kernel

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
    for m in range(len(limbs.difference)):
        square = 0.0
        for i in range(3):
            apart = limbs.fixed[m, i]
            for p in range(len(limbs.row)):
                apart += limbs.difference[m, p] * scratch.point[p, i]
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
        _cross(twist[:3], scratch.point[p], scratch.velocity[p])
        for i in range(3):
            scratch.velocity[p, i] += twist[3 + i]
            scratch.velocity[p, i] *= limbs.above[joint, p]
    for m in range(len(limbs.difference)):
        along = 0.0
        for i in range(3):
            moved[m, i] = 0.0
            for p in range(len(limbs.row)):
                moved[m, i] += limbs.difference[m, p] * scratch.velocity[p, i]
            along += moved[m, i] * scratch.unit[m, i]
        for i in range(3):
            moved[m, i] = (moved[m, i] - along * scratch.unit[m, i]) / scratch.length[m]


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
    size, most = 3 * limbs.segments[group], limbs.uniform[group]
    for k in range(limbs.number[group]):
        exponent, precision = limbs.height[group, k], limbs.precision[group, k]
        for i in range(size):
            pull = 0.0
            for j in range(size):
                pull += precision[i, j] * (scratch.direction[j] - limbs.mean[group, k, j])
            scratch.pulls[k, i] = pull
            exponent -= 0.5 * pull * (scratch.direction[i] - limbs.mean[group, k, i])
        scratch.share[k] = exponent
        most = max(most, exponent)
    total = math.exp(limbs.uniform[group] - most)
    for k in range(limbs.number[group]):
        scratch.share[k] = math.exp(scratch.share[k] - most)
        total += scratch.share[k]
    for k in range(limbs.number[group]):
        scratch.share[k] /= total
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
                slope[column, 3 * s + k] += factor * limbs.side[group, k] * moved


@kernel
def _lift(group: int, limbs: Limbs, scratch: LimbScratch, gradient: Array, hessian: Array) -> None:
    """Add the derivatives of a group's density in the state."""
    size, slope, bend = 3 * limbs.segments[group], scratch.slope, scratch.bend
    for i in range(size):
        scratch.pull[i] = 0.0
        for j in range(size):
            bend[i, j] = 0.0
    for k in range(limbs.number[group]):
        share = limbs.scale * scratch.share[k]
        for i in range(size):
            scratch.pull[i] += share * scratch.pulls[k, i]
            for j in range(size):
                bend[i, j] += share * limbs.precision[group, k, i, j]
    for a in range(len(gradient)):
        if not scratch.touched[a]:
            continue
        for i in range(size):
            gradient[a] += slope[a, i] * scratch.pull[i]
            scratch.bent[i] = 0.0
            for j in range(size):
                scratch.bent[i] += bend[i, j] * slope[a, j]
        for c in range(len(gradient)):
            if scratch.touched[c]:
                for i in range(size):
                    hessian[a, c] += scratch.bent[i] * slope[c, i]
