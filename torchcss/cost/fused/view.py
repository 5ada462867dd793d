"""All image terms of one view, for a pool of states."""

from __future__ import annotations

from torchcss.cost.fused.compiler import entry, kernel
from torchcss.cost.fused.contour import compare_outline
from torchcss.cost.fused.flow import find_interior, follow_flow
from torchcss.cost.fused.joints import compare_joints
from torchcss.cost.fused.kinematics import find_twists, pose_parts, pose_tree
from torchcss.cost.fused.lift import lift, sum_points
from torchcss.cost.fused.outline import find_outline
from torchcss.cost.fused.records import Array, Parts, Result, Room, Tree, View
from torchcss.cost.fused.sight import see_nodes


@entry
def add_view(
    x: Array, mode: Array, tree: Tree, parts: Parts, view: View, room: Room, result: Result
) -> None:
    """Add what a view says of all states of a pool.

    Args:
        x: The states, `[b n]`.
        mode: The mode before that each of them is compared with.
        tree: The body's tree before the camera.
        parts: Its parts.
        view: Camera and terms.
        room: Room for what is found on the way.
        result: Where it is added.
    """
    slopes = len(result.gradient[0]) > 0
    for b in range(len(x)):
        pose_tree(x[b], tree, room.frames)
        pose_parts(room.frames, parts, room.frame, room.posed)
        if slopes:
            _choose_reference(room.frames, room.reference)
            room.sums[:] = 0.0
        if view.edges.scale > 0.0 or view.colours.scale > 0.0:
            result.value[b] += _outline(parts, view, slopes, room)
        if view.flow.scale > 0.0:
            result.value[b] += _flow(parts, view, mode[b], slopes, room)
        if view.marks.scale > 0.0:
            marks = view.marks
            result.value[b] += compare_joints(
                room.frames, view.precise, marks, mode[b], view.exact, room.points
            )
            if slopes:
                for i in range(len(marks.row)):
                    sums = room.sums[marks.row[i]]
                    sum_points(room.points, i, i + 1, room.reference, sums)
        if slopes:
            find_twists(room.frames, tree, room.reference, room.twists)
            gradient, hessian = result.gradient[b], result.hessian[b]
            lift(tree, room.sums, room.twists, view.exact, gradient, hessian)


@kernel
def _choose_reference(frames: Array, reference: Array) -> None:
    """A place near the body: the middle of its joints."""
    share = 1.0 / len(frames)
    for i in range(3):
        reference[i] = 0.0
        for row in range(len(frames)):
            reference[i] += share * frames[row, i, 3]


@kernel
def _outline(parts: Parts, view: View, slopes: bool, room: Room) -> float:
    """Cost of the contour nodes, their derivatives added to the sums."""
    nodes = room.outline
    find_outline(view.curves, room.posed, room.facing, nodes)
    see_nodes(nodes, room.posed, parts, True, room.rays, room.near, room.lines)
    see_nodes(nodes, room.posed, parts, False, room.rays, room.near, room.lines)
    cost = compare_outline(nodes, view.lens, view.edges, view.colours, view.exact, room)
    if slopes:
        _sum_parts(parts, room)
    return cost + view.nothing


@kernel
def _flow(parts: Parts, view: View, mode: int, slopes: bool, room: Room) -> float:
    """Cost of the nodes all over the surface, their derivatives added to the sums."""
    nodes = room.interior
    find_interior(view.flow.nodes, room.posed, nodes)
    see_nodes(nodes, room.posed, parts, False, room.rays, room.near, room.lines)
    cost = follow_flow(nodes, view.lens, view.flow, mode, view.exact, room.points)
    if slopes:
        _sum_parts(parts, room)
    return cost


@kernel
def _sum_parts(parts: Parts, room: Room) -> None:
    points = room.points
    for part in range(len(parts.row)):
        begin, end = points.first[part], points.first[part + 1]
        if begin < end:
            sum_points(points, begin, end, room.reference, room.sums[parts.row[part]])
