"""Twin of the contour term's derivatives: the cost with its matches held fixed, for autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcss.cost.contour import ContourTerm, EdgeAssignments
from torchcss.cost.visibility import ContourNodes
from torchcss.vision.camera import Camera


def cost_of_fixed_matches(
    term: ContourTerm,
    nodes: ContourNodes,
    camera: Camera,
    assignments: EdgeAssignments,
    uv: Tensor,
    normal_uv: Tensor,
    points: Tensor,
) -> Tensor:
    """Cost of every node when it moves to `points` and its edges stay where they were found.

    Args:
        term: The term.
        nodes: Where the nodes were when the image was searched.
        camera: The camera.
        assignments: The edges found, along `normal_uv` from `uv`; nodes of all batches in a row.
        uv: The nodes' images at the search.
        normal_uv: The search directions.
        points: Where the nodes are now; the argument to differentiate in.
    """
    projection = camera.project(points)
    moved = ((projection.uv - uv) * normal_uv).sum(-1)
    cost = torch.full_like(moved, term.unmatched)
    node, distance, weight = assignments
    rho = term.potential((distance - moved.flatten()[node]).square()).rho
    wells = weight * projection.valid.flatten()[node] * (term.unmatched - 0.5 * rho)
    cost = cost - torch.zeros_like(cost).flatten().index_add(0, node, wells).reshape(cost.shape)
    absent = term.fitted_level * term.nu
    hidden = term.occlusion_factor * absent
    seen = nodes.visible * cost + (1 - nodes.visible) * hidden
    return nodes.exists * seen + (1 - nodes.exists) * absent
