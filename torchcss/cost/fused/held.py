"""What a view says with visibility and matches held; the twin of `TrackingCost.held_value`."""

from __future__ import annotations

from torchcss.cost.fused.contour import sum_outline
from torchcss.cost.fused.edges import held_gain
from torchcss.cost.fused.flow import follow_flow
from torchcss.cost.fused.joints import compare_joints
from torchcss.cost.fused.kinematics import pose_parts, pose_tree
from torchcss.cost.fused.projection import project
from torchcss.cost.fused.records import Array, Nodes, Parts, Result, Tree, View, Workspace
from torchcss.cost.fused.region import held_contrast
from torchcss.cost.fused.view import find_and_compare_outline, find_and_follow_flow
from torchcss.kernels.compiler import entry, kernel


@entry
def add_held_view(
    x: Array,
    found_at: Array,
    mode: Array,
    tree: Tree,
    parts: Parts,
    view: View,
    workspace: Workspace,
    result: Result,
) -> None:
    """Add what a view says of all states of a pool, no derivatives.

    Args:
        x: The states, `[b n]`.
        found_at: Those at which visibility and matches are found.
        mode: The mode before that each of them is compared with.
        tree: The body's tree before the camera.
        parts: Its parts.
        view: Camera and terms.
        workspace: Memory for what is found on the way.
        result: Where it is added.
    """
    count = 0
    for b in range(len(x)):
        if b == 0 or mode[b] != mode[b - 1] or _differ(found_at[b], found_at[b - 1]):
            pose_tree(found_at[b], tree, workspace.frames)
            pose_parts(workspace.frames, parts, workspace.frame, workspace.posed)
            count = _find(parts, view, mode[b], workspace)
        pose_tree(x[b], tree, workspace.frames)
        pose_parts(workspace.frames, parts, workspace.frame, workspace.posed)
        if view.edges.scale > 0.0 or view.colours.scale > 0.0:
            _carry(workspace.outline, workspace.posed)
            result.value[b] += _outline(view, count, workspace)
        if view.flow.scale > 0.0:
            _carry(workspace.interior, workspace.posed)
            result.value[b] += follow_flow(
                workspace.interior, view.lens, view.flow, mode[b], False, True, workspace.points
            )
        if view.keypoints.scale > 0.0:
            result.value[b] += compare_joints(
                workspace.frames, view.precise, view.keypoints, mode[b], False, workspace.points
            )


@kernel
def _differ(one: Array, other: Array) -> bool:
    count = 0
    for i in range(len(one)):
        count += int(one[i] != other[i])
    return count > 0


@kernel
def _find(parts: Parts, view: View, mode: int, workspace: Workspace) -> int:
    """Find the nodes, what is seen of them, and their matches; how many are in the image."""
    posed, count = workspace.posed, 0
    if view.edges.scale > 0.0 or view.colours.scale > 0.0:
        find_and_compare_outline(parts, view, False, workspace)
        count = workspace.points.first[len(posed)]
        _fasten(workspace.outline, posed)
    if view.flow.scale > 0.0:
        find_and_follow_flow(parts, view, mode, False, workspace)
        _fasten(workspace.interior, posed)
    return count


@kernel
def _fasten(nodes: Nodes, posed: Array) -> None:
    """Replace the normals, which nobody needs any more, by the nodes' places in their parts."""
    for part in range(len(posed)):
        frame = posed[part]
        for i in range(nodes.first[part], nodes.first[part + 1]):
            x, y, z = nodes.x[i] - frame[0, 3], nodes.y[i] - frame[1, 3], nodes.z[i] - frame[2, 3]
            nodes.nx[i] = frame[0, 0] * x + frame[1, 0] * y + frame[2, 0] * z
            nodes.ny[i] = frame[0, 1] * x + frame[1, 1] * y + frame[2, 1] * z
            nodes.nz[i] = frame[0, 2] * x + frame[1, 2] * y + frame[2, 2] * z


@kernel
def _carry(nodes: Nodes, posed: Array) -> None:
    """Put the nodes where their parts are."""
    for part in range(len(posed)):
        frame = posed[part]
        for i in range(nodes.first[part], nodes.first[part + 1]):
            a, b, c = nodes.nx[i], nodes.ny[i], nodes.nz[i]
            nodes.x[i] = frame[0, 0] * a + frame[0, 1] * b + frame[0, 2] * c + frame[0, 3]
            nodes.y[i] = frame[1, 0] * a + frame[1, 1] * b + frame[1, 2] * c + frame[1, 3]
            nodes.z[i] = frame[2, 0] * a + frame[2, 1] * b + frame[2, 2] * c + frame[2, 3]


@kernel
def _outline(view: View, count: int, workspace: Workspace) -> float:
    """Cost of the contour nodes where they are, with the matches that were found."""
    edges, colours, nodes, seen = view.edges, view.colours, workspace.outline, workspace.seen
    for k in range(count):
        i = int(seen.node[k])
        pixel = project(view.lens, nodes.x[i], nodes.y[i], nodes.z[i])
        place = pixel.u, pixel.v
        seen.gain[k] = 0.0
        if edges.scale > 0.0:
            seen.gain[k] += held_gain(edges, seen, k, place, workspace.peaks)
        if colours.scale > 0.0:
            seen.gain[k] += held_contrast(colours, seen, k, place)
    return sum_outline(nodes, edges, colours, seen, count) + view.nothing
