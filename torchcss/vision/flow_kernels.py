"""The inner loops of the optical flow, compiled; `torchcss.vision.flow` has their twins in torch.

A conjugate-gradient step in torch is a dozen passes over the image, each of which fetches it from
memory anew. Here a step is three passes, each row at a time. Where numba cannot be
imported the flow takes torch's way, as it does on a GPU and in double precision.
"""

from __future__ import annotations

import numpy as np

from torchcss.kernels.compiler import entry, kernel, sqrt


@kernel
def _apply(x, q, degree, right, down, product):  # type: ignore[no-untyped-def]
    """Matrix times vector, inside a border of zeros; returns their inner product."""
    height, width = degree.shape
    total = np.float64(0.0)  # over all rows
    for row in range(height):
        along = 0.0
        for c in range(width):
            u, v = x[0, row + 1, c + 1], x[1, row + 1, c + 1]
            common = q[0, row, c] * u + q[1, row, c] * v
            before, after = right[row, c], right[row, c + 1]
            above, below = down[row, c], down[row + 1, c]
            to_u = degree[row, c] * u + q[0, row, c] * common
            to_v = degree[row, c] * v + q[1, row, c] * common
            to_u -= before * x[0, row + 1, c] + after * x[0, row + 1, c + 2]
            to_v -= before * x[1, row + 1, c] + after * x[1, row + 1, c + 2]
            to_u -= above * x[0, row, c + 1] + below * x[0, row + 2, c + 1]
            to_v -= above * x[1, row, c + 1] + below * x[1, row + 2, c + 1]
            product[0, row, c] = to_u
            product[1, row, c] = to_v
            along += u * to_u + v * to_v
        total += along
    return total


@kernel
def _descend(length, x, image, inverse, flow, residual, conditioned):  # type: ignore[no-untyped-def]
    """Go along a direction; the new residual, preconditioned, and their inner product."""
    height, width = flow.shape[1:]
    total = np.float64(0.0)  # over all rows
    for row in range(height):
        along = 0.0
        for c in range(width):
            flow[0, row, c] += length * x[0, row + 1, c + 1]
            flow[1, row, c] += length * x[1, row + 1, c + 1]
            r_u = residual[0, row, c] - length * image[0, row, c]
            r_v = residual[1, row, c] - length * image[1, row, c]
            residual[0, row, c], residual[1, row, c] = r_u, r_v
            z_u = inverse[0, row, c] * r_u + inverse[2, row, c] * r_v
            z_v = inverse[1, row, c] * r_v + inverse[2, row, c] * r_u
            conditioned[0, row, c], conditioned[1, row, c] = z_u, z_v
            along += r_u * z_u + r_v * z_v
        total += along
    return total


@kernel
def _turn(share, conditioned, x):  # type: ignore[no-untyped-def]
    """The next direction."""
    height, width = conditioned.shape[1:]
    for row in range(height):
        for c in range(width):
            x[0, row + 1, c + 1] = conditioned[0, row, c] + share * x[0, row + 1, c + 1]
            x[1, row + 1, c + 1] = conditioned[1, row, c] + share * x[1, row + 1, c + 1]


@entry
def solve(flow, q, target, right, down, num_iterations):  # type: ignore[no-untyped-def]
    """Improve a flow, in place, by conjugate gradients on `(q q^T + L) f = target`.

    Args:
        flow: `[2 h w]`, single precision.
        q: Gradient of the brightness times the root of its weight, `[2 h w]`.
        target: Right-hand side, `[2 h w]`.
        right: Weights of the links between columns, `[h w+1]`, zero at both ends.
        down: The same between rows, `[h+1 w]`.
        num_iterations: Steps.
    """
    height, width = flow.shape[1:]
    degree = np.empty((height, width), np.float32)
    inverse = np.empty((3, height, width), np.float32)
    for row in range(height):
        for c in range(width):
            links = right[row, c] + right[row, c + 1] + down[row, c] + down[row + 1, c]
            q_u, q_v = q[0, row, c], q[1, row, c]
            determinant = links * (links + q_u * q_u + q_v * q_v)
            share = 1.0 / determinant if determinant > 0.0 else 0.0
            degree[row, c] = links
            inverse[0, row, c] = (links + q_v * q_v) * share
            inverse[1, row, c] = (links + q_u * q_u) * share
            inverse[2, row, c] = -q_u * q_v * share
    x = np.zeros((2, height + 2, width + 2), np.float32)
    x[:, 1:-1, 1:-1] = flow
    image, conditioned = np.empty_like(flow), np.empty_like(flow)
    _apply(x, q, degree, right, down, image)
    residual = target - image
    x[:] = 0.0
    reduction = _descend(0.0, x, image, inverse, flow, residual, conditioned)
    _turn(0.0, conditioned, x)
    for _ in range(num_iterations):
        bend = _apply(x, q, degree, right, down, image)
        if not bend > 0.0:
            break
        length = np.float32(reduction / bend)
        before = reduction
        reduction = _descend(length, x, image, inverse, flow, residual, conditioned)
        if not before > 0.0:
            break
        _turn(np.float32(reduction / before), conditioned, x)


@kernel
def _order(planes, low, high, width):  # type: ignore[no-untyped-def]
    """The lesser of two rows into the first of them, the greater into the second."""
    for c in range(width):
        a, b = planes[low, c], planes[high, c]
        planes[low, c], planes[high, c] = min(a, b), max(a, b)


@entry
def median(padded, radius, out):  # type: ignore[no-untyped-def]
    """Median over square windows, as `torchcss.vision.flow._inner_median` finds it, row by row.

    Args:
        padded: `[h+2r w+2r]`, single precision.
        radius: r.
        out: `[h w]`.
    """
    height, width = out.shape
    side = 2 * radius + 1
    num_kept = side * side // 2 + 2
    planes = np.empty((num_kept, width), np.float32)
    for row in range(height):
        for index in range(num_kept):
            top, left = index // side, index % side
            planes[index] = padded[row + top, left : left + width]
        first, kept, waiting = 0, num_kept, num_kept
        while True:
            # The least goes to the first place, the greatest to the last; both are dropped.
            last = first + kept - 1
            for place in range(kept // 2):
                _order(planes, first + place, last - place, width)
            half = (kept + 1) // 2
            for place in range(1, half):
                _order(planes, first, first + place, width)
            for place in range(kept // 2, kept - 1):
                _order(planes, first + place, last, width)
            if waiting == side * side:
                break
            first, kept = first + 1, kept - 1
            top, left = waiting // side, waiting % side
            planes[first + kept - 1] = padded[row + top, left : left + width]
            waiting += 1
        out[row] = planes[first + 1]


@entry
def structure(image, scale, step, num_steps):  # type: ignore[no-untyped-def]
    """The smooth part of an image: least total variation near it (Chambolle 2004).

    Args:
        image: `[h w]`, single precision.
        scale: Weight of the total variation.
        step: Length of a step.
        num_steps: Steps.
    """
    height, width = image.shape
    scale, step = np.float32(scale), np.float32(step)
    # Links to the right and down, after a first row and column of zeros.
    along, across = (
        np.zeros((height, width + 1), np.float32),
        np.zeros((height + 1, width), np.float32),
    )
    smooth = image.copy()
    for _ in range(num_steps):
        for row in range(height):
            last = row == height - 1
            below = row if last else row + 1
            for c in range(width - 1):
                u = along[row, c + 1] + step * (smooth[row, c + 1] - smooth[row, c])
                v = across[row + 1, c] + step * (smooth[below, c] - smooth[row, c])
                length = max(1.0, sqrt(u * u + v * v))
                along[row, c + 1] = u / length
                across[row + 1, c] = v / length
            c = width - 1
            v = across[row + 1, c] + step * (smooth[below, c] - smooth[row, c])
            across[row + 1, c] = v / max(1.0, abs(v))
        for row in range(height):
            for c in range(width):
                inward = along[row, c + 1] - along[row, c] + across[row + 1, c] - across[row, c]
                smooth[row, c] = image[row, c] + scale * inward
    return smooth
