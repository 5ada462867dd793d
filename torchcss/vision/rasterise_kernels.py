"""The inner loops of the rasteriser, compiled; `torchcss.vision.rasterise` has their twin in torch.

There, spans of all rows of all triangles are listed, and sorted out by a scatter: on a GPU that is
quick. Here each pixel of a span is compared with what is there.
"""

from __future__ import annotations

import numpy as np

from torchcss.kernels.compiler import entry, floor, inlined, kernel
from torchcss.vision.rasterise import LEAST_AREA


@inlined
def _first_from(x, size):  # type: ignore[no-untyped-def]
    """The first pixel centre at or behind a place, within an image of some pixels."""
    return min(max(-floor(-x), np.float64(0)), np.float64(size))


@entry
def draw_triangles(place, distance, usable, faces, label, near, seen):  # type: ignore[no-untyped-def]
    """Draw triangles, nearer ones over others, and at the same depth the first over the next.

    Args:
        place: Projected vertices of each picture, pixels, `[p v 2]`, double precision.
        distance: Their depths, `[p v]`.
        usable: Which of them may be drawn, `[p v]`.
        faces: Corner indices of the triangles, the same in every picture, `[f 3]`.
        label: What is drawn of each of them, `[f]`.
        near: Inverse depth at every pixel, `[p h w]`, single precision; -1 at first.
        seen: What is there, `[p h w]`; -1 at first.
    """
    for p in range(len(near)):
        for face in range(len(faces)):
            i, j, k = faces[face, 0], faces[face, 1], faces[face, 2]
            if usable[p, i] and usable[p, j] and usable[p, k]:
                _draw(place[p], distance[p], (i, j, k), label[face], near[p], seen[p])


@kernel
def _draw(place, distance, corners, label, near, seen):  # type: ignore[no-untyped-def]
    """Draw one triangle, unless it is seen edge-on."""
    height, width = near.shape
    zero = np.float32(0)
    i, j, k = corners
    twice = (place[j, 0] - place[i, 0]) * (place[k, 1] - place[i, 1])
    twice -= (place[j, 1] - place[i, 1]) * (place[k, 0] - place[i, 0])
    if abs(twice) <= LEAST_AREA:
        return
    # From top to bottom.
    if place[j, 1] < place[i, 1]:
        i, j = j, i
    if place[k, 1] < place[j, 1]:
        j, k = k, j
    if place[j, 1] < place[i, 1]:
        i, j = j, i
    x0, y0, x1, y1 = place[i, 0], place[i, 1], place[j, 0], place[j, 1]
    x2, y2 = place[k, 0], place[k, 1]
    w0, w1, w2 = 1 / distance[i], 1 / distance[j], 1 / distance[k]
    lowest, highest = min(w0, min(w1, w2)), max(w0, max(w1, w2))
    # Inverse depth is affine in the pixel: w = w0 + along (x - x0) + down (y - y0).
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    along = ((w1 - w0) * (y2 - y0) - (w2 - w0) * (y1 - y0)) / area
    down = ((w2 - w0) * (x1 - x0) - (w1 - w0) * (x2 - x0)) / area
    for row in range(int(_first_from(y0, height)), int(_first_from(y2, height))):
        y = np.float64(row)
        # No denominator vanishes: y0 <= y < y2, and y lies between the corners of each edge.
        one = x0 + (y - y0) * ((x2 - x0) / (y2 - y0))
        if y < y1:
            other = x0 + (y - y0) * ((x1 - x0) / (y1 - y0))
        else:
            other = x1 + (y - y1) * ((x2 - x1) / (y2 - y1))
        left = _first_from(min(one, other), width)
        length = int(_first_from(max(one, other), width) - left)
        if length == 0:
            continue
        # The ends of a span are held in the corners' range: the plane of a sliver is steep.
        at = w0 + along * (left - x0) + down * (y - y0)
        start = min(max(at, lowest), highest)
        stop = min(max(at + along * np.float64(length - 1), lowest), highest)
        first = np.float32(start)
        rise = np.float32((stop - start) / np.float64(max(length - 1, 1)))
        begin = int(left)
        for step in range(length):
            here = max(first + rise * np.float32(step), zero)
            if here > near[row, begin + step]:
                near[row, begin + step] = here
                seen[row, begin + step] = label
