"""Edges along the normal of a contour node; the twin of `torchcss.cost.contour.ContourTerm`."""

from __future__ import annotations

from torchcss.cost.fused.compiler import floor, kernel
from torchcss.cost.fused.potentials import potential_of
from torchcss.cost.fused.projection import Pixel
from torchcss.cost.fused.records import Array, Edges

_TINY = 1e-12
_SHARP_ENOUGH = 0.05
_FADE = 0.25


@kernel
def match_edges(
    edges: Edges, pixel: Pixel, normal: tuple[float, float], response: Array, found: Array
) -> tuple[float, float, float]:
    """Depth of a node's well, eq. 8 [IJRR], and its cost's derivatives along the normal.

    Args:
        edges: The term.
        pixel: The node in the image.
        normal: Its unit normal there.
        response: Room for the response at each step.
        found: Room for the distance and weight of each edge, `[2 steps]`.
    """
    mu, mv = normal
    _respond(edges, pixel.u, pixel.v, mu, mv, response)
    count, total = _find_peaks(edges, response, found)
    share = 1.0 / max(total, 1.0)
    depth = slope = curvature = total * 0.0
    for k in range(count):
        distance, weight = found[0, k], found[1, k] * share
        squared = distance * distance
        rho, first, second = potential_of(edges.potential, squared)
        depth += weight * max(edges.unmatched - 0.5 * rho, 0.0)
        slope -= weight * first * distance
        curvature += weight * (first + 2.0 * second * squared)
    return depth, slope, curvature


@kernel
def _respond(edges: Edges, u: float, v: float, mu: float, mv: float, response: Array) -> None:
    """The edge response `|G . m|` at the samples of a line; zero outside the image."""
    field, right, bottom = edges.field, edges.corner[0], edges.corner[1]
    for k in range(len(edges.steps)):
        x, y = u + edges.steps[k] * mu, v + edges.steps[k] * mv
        inside = (x >= -0.5) & (x < right + 0.5) & (y >= -0.5) & (y < bottom + 0.5)
        x, y = min(max(x, 0.0), right), min(max(y, 0.0), bottom)
        left, top = min(floor(x), right - 1.0), min(floor(y), bottom - 1.0)
        column, row = int(left), int(top)
        s, t = x - left, y - top
        a = field[row, column, 0] * mu + field[row, column, 1] * mv
        b = field[row, column + 1, 0] * mu + field[row, column + 1, 1] * mv
        c = field[row + 1, column, 0] * mu + field[row + 1, column, 1] * mv
        d = field[row + 1, column + 1, 0] * mu + field[row + 1, column + 1, 1] * mv
        above, below = a + s * (b - a), c + s * (d - c)
        response[k] = abs(above + t * (below - above)) if inside else 0.0


@kernel
def _find_peaks(edges: Edges, response: Array, found: Array) -> tuple[int, float]:
    """Distances and weights of the maxima on a line; their number, and the sum of shares."""
    count, total = 0, edges.step * 0.0
    for m in range(2, len(response) - 2):
        left, middle, right = response[m - 1], response[m], response[m + 1]
        if not (middle > left and not right > middle):
            continue
        before, after = response[m - 2], response[m + 2]
        curve = max(2.0 * middle - left - right, _TINY)
        shift = 0.5 * (right - left) / curve
        side = 2.0 * left - before - middle
        if shift > 0.0:
            side = 2.0 * right - middle - after
        height = middle + 0.5 * shift * shift * (curve + abs(shift) * (side - curve))
        fall = middle - max(
            left + (0.5 - shift) * (before - left), right + (0.5 + shift) * (after - right)
        )
        reach = 1.5 * edges.step
        sharpness = fall / max(height, 1e-3) * (2.0 / (reach * reach * _SHARP_ENOUGH))
        distance = edges.steps[m] + edges.step * shift
        if not abs(distance) < edges.window:
            continue
        weight = height * min(max(sharpness, 0.0), 1.0)
        total += weight * min((edges.window - abs(distance)) / (_FADE * edges.window), 1.0)
        found[0, count], found[1, count] = distance, weight
        count += 1
    return count, total
