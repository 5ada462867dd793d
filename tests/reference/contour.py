"""Twins of the contour term: the cost with its matches held fixed, and the search for them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchcss.cost.contour import ContourTerm, EdgeAssignments
from torchcss.cost.visibility import SeenNodes
from torchcss.vision.camera import Camera
from torchcss.vision.sampling import sample_bilinear


def cost_of_fixed_matches(
    term: ContourTerm,
    nodes: SeenNodes,
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
    squared = (distance - moved.flatten()[node]).square()
    if term.assignment == "shared":
        wells = weight * (term.unmatched - 0.5 * term.potential(squared).rho)
    else:
        number = torch.zeros_like(cost).flatten().index_add(0, node, torch.ones_like(distance))
        wells = term.nu / number[node] - 0.5 * term.potential(weight * squared).rho
    wells = projection.valid.flatten()[node] * wells
    cost = cost - torch.zeros_like(cost).flatten().index_add(0, node, wells).reshape(cost.shape)
    absent = term.fitted_level * term.nu
    hidden = term.occlusion_factor * absent
    seen = nodes.visible * cost + (1 - nodes.visible) * hidden
    return nodes.exists * seen + (1 - nodes.exists) * absent


def edges_along_lines(
    term: ContourTerm, uv: Tensor, normal_uv: Tensor, edge_field: Tensor
) -> list[tuple[int, float, float]]:
    """Node, distance and weight of the maxima along search lines, one sample after another."""
    reach, found = math.ceil(term.window / term.step) + 2, []
    for node, (start, along) in enumerate(zip(uv, normal_uv, strict=True)):
        response = []
        for k in range(-reach, reach + 1):
            field, inside = sample_bilinear(edge_field, start + k * term.step * along)
            response.append(float((field[:2] @ along).abs() * inside))
        edges = []
        for i in range(2, len(response) - 2):
            before, left, middle, right, after = response[i - 2 : i + 3]
            if not (middle > left and middle >= right):
                continue
            # The parabola through three samples; then 1.5 samples to either side of its top.
            shift = 0.5 * (right - left) / (2 * middle - left - right)
            curve = 2 * middle - left - right
            side = 2 * right - middle - after if shift > 0 else 2 * left - before - middle
            height = middle + 0.5 * shift**2 * (curve + abs(shift) * (side - curve))
            low = left + (0.5 - shift) * (before - left)
            high = right + (0.5 + shift) * (after - right)
            fall = min(middle - low, middle - high) / max(height, 1e-3)
            sharpness = fall * 2 / (1.5 * term.step) ** 2 / 0.05
            distance = (i - reach + shift) * term.step
            if abs(distance) >= term.window:
                continue
            if term.assignment != "shared":
                if height >= term.least_edge:
                    place = start + distance * along
                    weight = float(sample_bilinear(edge_field, place)[0][2])
                    edges.append((distance, weight * (height if term.strength else 1.0)))
            elif sharpness > 0:
                edges.append((distance, height * min(sharpness, 1.0)))
        if term.assignment != "shared":
            if term.assignment == "nearest":
                edges = sorted(edges, key=lambda edge: abs(edge[0]))[:1]
            found += [(node, *edge) for edge in edges]
            continue
        entered = [min(1.0, (term.window - abs(d)) / (0.25 * term.window)) for d, _ in edges]
        total = sum(w * share for (_, w), share in zip(edges, entered, strict=True))
        found += [(node, distance, weight / max(total, 1.0)) for distance, weight in edges]
    return found
