"""Edges along the normals of contour nodes; the twin of `torchcss.cost.contour.ContourTerm`."""

from __future__ import annotations

from torchcss.cost.fused.potentials import potential_of
from torchcss.cost.fused.records import Array, Edges, Peaks, Seen
from torchcss.kernels.compiler import floor, inlined, kernel

ASSIGNMENTS = ("shared", "sum", "nearest")
"""`ContourTerm.assignment`; `Edges.assignment` is a place in this list."""

_TINY = 1e-12
_SHARP_ENOUGH = 0.05
_FADE = 0.25


@kernel
def match_edges(edges: Edges, seen: Seen, count: int, response: Array, peaks: Peaks) -> None:
    """Add what the nodes gain by their wells, eq. 8 [IJRR], and the derivatives.

    Args:
        edges: The term.
        seen: The nodes in the image.
        count: Their number.
        response: Memory for the response along the lines of all nodes, one after the other.
        peaks: Memory for its maxima.
    """
    total, size = 0, len(edges.steps)
    for k in range(count):
        seen.first[k] = total
        line = response[k * size : (k + 1) * size]
        _respond(edges, (seen.u[k], seen.v[k]), (seen.mu[k], seen.mv[k]), line)
        total = _find_maxima(edges, line, k * size, peaks, total)
    seen.first[count] = total
    if edges.assignment == 0:
        _weigh(edges, response, peaks, total)
    else:
        _add_up(edges, seen, count, response, peaks)
    for k in range(count):
        share = well = slope = curvature = edges.scale * 0.0
        for n in range(seen.first[k], seen.first[k + 1]):
            weight = peaks.weight[n]
            share += peaks.share[n]
            well += weight * peaks.well[n]
            slope -= weight * peaks.slope[n]
            curvature += weight * peaks.curvature[n]
        factor, mu, mv = edges.scale / max(share, 1.0), seen.mu[k], seen.mv[k]
        slope, curvature = factor * slope, factor * curvature
        seen.gain[k] += factor * well
        seen.gu[k] += slope * mu
        seen.gv[k] += slope * mv
        seen.uu[k] += curvature * mu * mu
        seen.uv[k] += curvature * mu * mv
        seen.vv[k] += curvature * mv * mv


@kernel
def _respond(
    edges: Edges, place: tuple[float, float], normal: tuple[float, float], response: Array
) -> None:
    """The edge response `|G . m|` at the samples of a line; zero outside the image."""
    field, right, bottom = edges.field, edges.corner[0], edges.corner[1]
    (u, v), (mu, mv) = place, normal
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
def _find_maxima(edges: Edges, line: Array, start: int, peaks: Peaks, total: int) -> int:
    """Add the maxima on a line, which starts at a sample, to the list; its new length."""
    for m in range(2, len(line) - 2):
        peaks.sample[total], peaks.place[total] = start + m, edges.steps[m]
        rises, falls = line[m] > line[m - 1], line[m + 1] > line[m]
        total += int(rises) & int(not falls)  # without a branch, which would be a guess
    return total


@kernel
def _weigh(edges: Edges, response: Array, peaks: Peaks, total: int) -> None:
    """Weights of all edges, and their wells with derivatives along the normal."""
    reach = 1.5 * edges.step
    sharp = 2.0 / (reach * reach * _SHARP_ENOUGH)
    fade = 1.0 / (_FADE * edges.window)
    for n in range(total):
        i = int(peaks.sample[n])
        left, middle, right = response[i - 1], response[i], response[i + 1]
        before, after = response[i - 2], response[i + 2]
        shift, height = _top(before, left, middle, right, after)
        fall = middle - max(
            left + (0.5 - shift) * (before - left), right + (0.5 + shift) * (after - right)
        )
        sharpness = min(max(fall / max(height, 1e-3) * sharp, 0.0), 1.0)
        distance = peaks.place[n] + edges.step * shift
        within = abs(distance) < edges.window
        weight = height * sharpness if within else 0.0
        squared = distance * distance
        rho, first, second = potential_of(edges.potential, squared)
        peaks.place[n], peaks.weight[n] = distance, weight
        peaks.share[n] = weight * min((edges.window - abs(distance)) * fade, 1.0)
        peaks.well[n] = max(edges.unmatched - 0.5 * rho, 0.0)
        peaks.slope[n] = first * distance
        peaks.curvature[n] = first + 2.0 * second * squared


@inlined
def _top(
    before: float, left: float, middle: float, right: float, after: float
) -> tuple[float, float]:
    """Where a maximum is, in steps from its highest sample, and how high."""
    curve = max(2.0 * middle - left - right, _TINY)
    shift = 0.5 * (right - left) / curve
    side = 2.0 * right - middle - after if shift > 0.0 else 2.0 * left - before - middle
    return shift, middle + 0.5 * shift * shift * (curve + abs(shift) * (side - curve))


@kernel
def _add_up(edges: Edges, seen: Seen, count: int, response: Array, peaks: Peaks) -> None:
    """The edges of all nodes as printed: each counts in full, or the nearest alone."""
    for k in range(count):
        begin, end = seen.first[k], seen.first[k + 1]
        number, nearest = 0, edges.window
        for n in range(begin, end):
            i = int(peaks.sample[n])
            shift, height = _top(
                response[i - 2], response[i - 1], response[i], response[i + 1], response[i + 2]
            )
            distance = peaks.place[n] + edges.step * shift
            is_edge = (abs(distance) < edges.window) & (height >= edges.least)
            peaks.place[n], peaks.height[n] = distance, height
            peaks.weight[n] = 1.0 if is_edge else 0.0
            if is_edge:
                number, nearest = number + 1, min(nearest, abs(distance))
        if edges.assignment == 2:
            number = 0
            for n in range(begin, end):
                if abs(peaks.place[n]) > nearest:
                    peaks.weight[n] = 0.0
                number += int(peaks.weight[n] > 0.0)
        for n in range(begin, end):
            peaks.share[n] = 0.0
            if peaks.weight[n] > 0.0:
                _price(edges, (seen.u[k], seen.v[k]), (seen.mu[k], seen.mv[k]), peaks, n)
                peaks.well[n] += edges.unmatched / number


@kernel
def _price(
    edges: Edges, place: tuple[float, float], normal: tuple[float, float], peaks: Peaks, n: int
) -> None:
    """Cost of an edge along a normal, and its derivatives."""
    distance = peaks.place[n]
    weight = _weight_of(edges, place, normal, peaks, n)
    squared = weight * distance * distance
    rho, first, second = potential_of(edges.potential, squared)
    peaks.well[n] = -0.5 * rho
    peaks.slope[n] = weight * first * distance
    peaks.curvature[n] = weight * (first + 2.0 * second * squared)


@inlined
def _weight_of(
    edges: Edges, place: tuple[float, float], normal: tuple[float, float], peaks: Peaks, n: int
) -> float:
    """The weight of an edge along a normal, inside rho."""
    distance = peaks.place[n]
    weight = _weight_at(edges, place[0] + distance * normal[0], place[1] + distance * normal[1])
    return weight * peaks.height[n] if edges.strength else weight


@kernel
def held_gain(edges: Edges, seen: Seen, k: int, place: tuple[float, float], peaks: Peaks) -> float:
    """What a node gains that has moved to a place in the image since its edges were found."""
    along = seen.mu[k], seen.mv[k]
    moved = (place[0] - seen.u[k]) * along[0] + (place[1] - seen.v[k]) * along[1]
    share = gain = edges.scale * 0.0
    for n in range(seen.first[k], seen.first[k + 1]):
        before = peaks.place[n]
        now = before - moved
        share += peaks.share[n]
        if edges.assignment == 0:
            rho, _, _ = potential_of(edges.potential, now * now)
            gain += peaks.weight[n] * (edges.unmatched - 0.5 * rho)
        elif peaks.weight[n] > 0.0:
            weight = _weight_of(edges, (seen.u[k], seen.v[k]), along, peaks, n)
            was, _, _ = potential_of(edges.potential, weight * before * before)
            rho, _, _ = potential_of(edges.potential, weight * now * now)
            gain += peaks.well[n] + 0.5 * (was - rho)
    return edges.scale / max(share, 1.0) * gain


@inlined
def _weight_at(edges: Edges, x: float, y: float) -> float:
    """The weight of the edges at a place, beyond the border that of the border."""
    field, right, bottom = edges.field, edges.corner[0], edges.corner[1]
    x, y = min(max(x, 0.0), right), min(max(y, 0.0), bottom)
    left, top = min(floor(x), right - 1.0), min(floor(y), bottom - 1.0)
    column, row = int(left), int(top)
    above, below = (
        field[row, column, 2] + (x - left) * (field[row, column + 1, 2] - field[row, column, 2]),
        field[row + 1, column, 2]
        + (x - left) * (field[row + 1, column + 1, 2] - field[row + 1, column, 2]),
    )
    return above + (y - top) * (below - above)
