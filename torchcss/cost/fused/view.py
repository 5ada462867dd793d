"""All image terms of one view, for a pool of states."""

from __future__ import annotations

from torchcss.cost.fused.contour import compare_outline
from torchcss.cost.fused.flow import find_interior, follow_flow
from torchcss.cost.fused.joints import compare_joints
from torchcss.cost.fused.kinematics import find_twists, pose_parts, pose_tree
from torchcss.cost.fused.lift import lift, sum_points
from torchcss.cost.fused.outline import find_outline
from torchcss.cost.fused.records import Array, Parts, Result, Tree, View, Workspace
from torchcss.cost.fused.sight import see_nodes
from torchcss.kernels.compiler import entry, kernel


@entry
def add_view(
    x: Array,
    mode: Array,
    tree: Tree,
    parts: Parts,
    view: View,
    workspace: Workspace,
    result: Result,
) -> None:
    """Add what a view says of all states of a pool.

    Args:
        x: The states, `[b n]`.
        mode: The mode before that each of them is compared with.
        tree: The body's tree before the camera.
        parts: Its parts.
        view: Camera and terms.
        workspace: Memory for what is found on the way.
        result: Where it is added.
    """
    slopes, share = len(result.gradient[0]) > 0, 1.0 if view.exact else 0.0
    for b in range(len(x)):
        pose_tree(x[b], tree, workspace.frames)
        pose_parts(workspace.frames, parts, workspace.frame, workspace.posed)
        if slopes:
            choose_reference(workspace.frames, workspace.reference)
            workspace.sums[:] = 0.0
        if view.edges.scale > 0.0 or view.colours.scale > 0.0:
            result.value[b] += find_and_compare_outline(parts, view, slopes, workspace)
        if view.flow.scale > 0.0:
            result.value[b] += find_and_follow_flow(parts, view, mode[b], slopes, workspace)
        if view.keypoints.scale > 0.0:
            keypoints = view.keypoints
            result.value[b] += compare_joints(
                workspace.frames, view.precise, keypoints, mode[b], view.exact, workspace.points
            )
            if slopes:
                for i in range(len(keypoints.row)):
                    sums = workspace.sums[keypoints.row[i]]
                    sum_points(workspace.points, i, i + 1, workspace.reference, sums)
        if slopes:
            find_twists(workspace.frames, tree, workspace.reference, workspace.twists)
            gradient, hessian = result.gradient[b], result.hessian[b]
            lift(tree, workspace.sums, workspace.twists, share, gradient, hessian)


@kernel
def choose_reference(frames: Array, reference: Array) -> None:
    """A place near the body: the middle of its joints."""
    share = 1.0 / len(frames)
    for i in range(3):
        reference[i] = 0.0
        for row in range(len(frames)):
            reference[i] += share * frames[row, i, 3]


@kernel
def find_and_compare_outline(parts: Parts, view: View, slopes: bool, workspace: Workspace) -> float:
    """Cost of the contour nodes, their derivatives added to the sums."""
    nodes = workspace.outline
    find_outline(view.curves, workspace.posed, workspace.facing, nodes)
    see_nodes(nodes, workspace.posed, parts, True, workspace.rays, workspace.near, workspace.lines)
    see_nodes(nodes, workspace.posed, parts, False, workspace.rays, workspace.near, workspace.lines)
    cost = compare_outline(nodes, view.lens, view.edges, view.colours, view.exact, workspace)
    if slopes:
        _sum_parts(parts, workspace)
    return cost + view.nothing


@kernel
def find_and_follow_flow(
    parts: Parts, view: View, mode: int, slopes: bool, workspace: Workspace
) -> float:
    """Cost of the nodes all over the surface, their derivatives added to the sums."""
    nodes = workspace.interior
    find_interior(view.flow.nodes, workspace.posed, nodes)
    see_nodes(nodes, workspace.posed, parts, False, workspace.rays, workspace.near, workspace.lines)
    flow, points = view.flow, workspace.points
    cost = follow_flow(nodes, view.lens, flow, mode, view.exact, False, points)
    if slopes:
        _sum_parts(parts, workspace)
    return cost


@kernel
def _sum_parts(parts: Parts, workspace: Workspace) -> None:
    points = workspace.points
    for part in range(len(parts.row)):
        begin, end = points.first[part], points.first[part + 1]
        if begin < end:
            sum_points(points, begin, end, workspace.reference, workspace.sums[parts.row[part]])
