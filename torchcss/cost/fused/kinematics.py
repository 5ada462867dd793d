"""Poses of joints and parts; the twin of `torchcss.body.kinematics`.

A joint's frame is that of its parent, times a constant, turned about its z axis or shifted along
it, eq. 1 [IJRR].
"""

from __future__ import annotations

from torchcss.body.kinematics_kernels import follow, move
from torchcss.cost.fused.records import Array, Parts, Tree
from torchcss.kernels.compiler import kernel


@kernel
def pose_tree(x: Array, tree: Tree, frames: Array) -> None:
    """Frames of the base and of all joints, `[1 + q 3 4]`, at a state."""
    for i in range(3):
        for k in range(4):
            frames[0, i, k] = tree.base[i, k]
    for j in range(len(tree.parent)):
        above, constant, frame = frames[tree.parent[j]], tree.constant[j], frames[1 + j]
        follow(above, constant, frame)
        q = tree.factor[j] * x[tree.column[j]] + tree.offset[j]
        move(frame, q, tree.revolute[j])


@kernel
def pose_parts(frames: Array, parts: Parts, scratch: Array, posed: Array) -> None:
    """Orientation and centre of all parts, `[parts 3 4]`."""
    for part in range(len(parts.row)):
        follow(frames[parts.row[part]], parts.constant[part], scratch)
        for i in range(3):
            for k in range(4):
                posed[part, i, k] = scratch[i, k]


@kernel
def find_twists(frames: Array, tree: Tree, reference: Array, twists: Array) -> None:
    """Angular and linear velocity of every joint, the latter at a point of reference."""
    for j in range(len(tree.parent)):
        frame, twist = frames[1 + j], twists[j]
        zx, zy, zz = frame[0, 2], frame[1, 2], frame[2, 2]
        if tree.revolute[j]:
            a, b, c = (
                frame[0, 3] - reference[0],
                frame[1, 3] - reference[1],
                frame[2, 3] - reference[2],
            )
            twist[0], twist[1], twist[2] = zx, zy, zz
            twist[3], twist[4], twist[5] = b * zz - c * zy, c * zx - a * zz, a * zy - b * zx
        else:
            twist[0], twist[1], twist[2] = 0.0, 0.0, 0.0
            twist[3], twist[4], twist[5] = zx, zy, zz
