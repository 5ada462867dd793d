"""The inner loops of the optical flow, compiled; their twins in torch stand in the modules.

A conjugate-gradient step in torch is a dozen passes over the image, each of which fetches it from
memory anew. Here a step is three passes, each row at a time. Where numba cannot be imported the
flow takes torch's way, as it does on a GPU and in double precision.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from torchcss.kernels.compiler import entry, floor, inlined, kernel, sqrt

FlowMemory = namedtuple("FlowMemory", "degree inverse x image residual conditioned")
"""Memory for `solve_flow`.

Attributes:
    degree: Sum of each pixel's links, `[h w]`.
    inverse: Inverse of each pixel's block, `[3 h w]`.
    x: A direction inside a border of zeros, `[2 h+2 w+2]`.
    image: The matrix times it, `[2 h w]`.
    residual: What is left.
    conditioned: The same, preconditioned.
"""


def make_flow_memory(height: int, width: int) -> FlowMemory:
    """Memory for images of a size."""
    inside = [np.empty((channels, height, width), np.float32) for channels in (3, 2, 2, 2)]
    border = np.zeros((2, height + 2, width + 2), np.float32)
    return FlowMemory(np.empty((height, width), np.float32), inside[0], border, *inside[1:])


@inlined
def _near(t):  # type: ignore[no-untyped-def]
    """Cubic convolution with the slope -3/4 at one, at a distance up to one."""
    return (1.25 * t - 2.25) * t * t + 1.0


@inlined
def _far(t):  # type: ignore[no-untyped-def]
    """The same at a distance from one to two."""
    return ((-0.75 * t + 3.75) * t - 6.0) * t + 3.0


@entry
def linearise(flow, first, second, least, gradient, offset, visible):  # type: ignore[no-untyped-def]
    """Warp the second frame and linearise constant brightness, see `torchcss.vision.flow`.

    Args:
        flow: `[2 h w]`, single precision, finite.
        first: Grey levels of the first frame and their gradient, `[3 h w]`.
        second: The same of the second frame.
        least: Square of the least gradient that is not rounding.
        gradient: Becomes the mean of both frames' gradients, `[2 h w]`.
        offset: Becomes the residual less gradient times flow, `[h w]`.
        visible: Becomes 1 where the pixel goes to a place in the image, else 0.
    """
    height, width = offset.shape
    # Beyond these ends of the image, in its own precision, all that is sampled is its border.
    right, bottom = np.float32(width - 0.5), np.float32(height - 0.5)
    for row in range(height):
        for c in range(width):
            u, v = flow[0, row, c] + np.float32(c), flow[1, row, c] + np.float32(row)
            inside = u >= -0.5 and u <= right and v >= -0.5 and v <= bottom
            visible[row, c] = np.float32(1 if inside else 0)
            u, v = min(max(u, -3.0), right + 3.0), min(max(v, -3.0), bottom + 3.0)
            left, top = floor(u), floor(v)  # type: ignore[arg-type]
            s, t = u - left, v - top
            x, y = int(left), int(top)
            x0, x1 = min(max(x - 1, 0), width - 1), min(max(x, 0), width - 1)
            x2, x3 = min(max(x + 1, 0), width - 1), min(max(x + 2, 0), width - 1)
            a0, a1, a2, a3 = _far(s + 1.0), _near(s), _near(1.0 - s), _far(2.0 - s)
            level, to_u, to_v = np.float32(0), np.float32(0), np.float32(0)
            for tap in range(4):
                k = min(max(y - 1 + tap, 0), height - 1)
                if tap == 0:
                    share = _far(t + 1.0)
                elif tap == 1:
                    share = _near(t)
                elif tap == 2:
                    share = _near(1.0 - t)
                else:
                    share = _far(2.0 - t)
                a, b, d = second[0, k], second[1, k], second[2, k]
                level += share * (a0 * a[x0] + a1 * a[x1] + a2 * a[x2] + a3 * a[x3])
                to_u += share * (a0 * b[x0] + a1 * b[x1] + a2 * b[x2] + a3 * b[x3])
                to_v += share * (a0 * d[x0] + a1 * d[x1] + a2 * d[x2] + a3 * d[x3])
            to_u, to_v = 0.5 * (first[1, row, c] + to_u), 0.5 * (first[2, row, c] + to_v)
            if not to_u * to_u + to_v * to_v > least:
                to_u, to_v = np.float32(0), np.float32(0)
            gradient[0, row, c], gradient[1, row, c] = to_u, to_v
            along = to_u * flow[0, row, c] + to_v * flow[1, row, c]
            offset[row, c] = level - first[0, row, c] - along


@entry
def weigh(flow, constancy, data, smoothness, energy):  # type: ignore[no-untyped-def]
    """The quadratic energy about a flow under Lorentzian potentials; see `torchcss.vision.flow`.

    Args:
        flow: `[2 h w]`, single precision.
        constancy: What `linearise` has found.
        data: nu and the square of sigma of the data term, and the least weight, zero.
        smoothness: The same of links.
        energy: Becomes the `q`, `target`, `right` and `down` of `solve_flow`.
    """
    gradient, offset, visible = constancy
    q, target, right, down = energy
    height, width = offset.shape
    for row in range(height):
        u, v, seen, rest = flow[0, row], flow[1, row], visible[row], offset[row]
        to_u, to_v, q_u, q_v = gradient[0, row], gradient[1, row], q[0, row], q[1, row]
        target_u, target_v = target[0, row], target[1, row]
        for c in range(width):
            residual = rest[c] + (to_u[c] * u[c] + to_v[c] * v[c])
            root = sqrt(_weight(residual * residual, data) * seen[c])
            q_u[c], q_v[c] = root * to_u[c], root * to_v[c]
            target_u[c], target_v[c] = -q_u[c] * (root * rest[c]), -q_v[c] * (root * rest[c])
        right[row, 0] = right[row, width] = 0.0
        _weigh_links(u[1:], v[1:], u[: width - 1], v[: width - 1], smoothness, right[row, 1:width])
        if row > 0:
            _weigh_links(u, v, flow[0, row - 1], flow[1, row - 1], smoothness, down[row])
    for c in range(width):
        down[0, c] = down[height, c] = 0.0


@inlined
def _weight(squared, potential):  # type: ignore[no-untyped-def]
    """Derivative of a Lorentzian potential, no less than the least weight."""
    nu, variance, least = potential
    return max(nu * (1.0 / (squared + variance)), least)


@inlined
def _weigh_links(u, v, other_u, other_v, potential, weight):  # type: ignore[no-untyped-def]
    for c in range(len(weight)):
        d_u, d_v = u[c] - other_u[c], v[c] - other_v[c]
        weight[c] = _weight(d_u * d_u + d_v * d_v, potential)


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
def solve_flow(flow, q, target, right, down, num_iterations, memory):  # type: ignore[no-untyped-def]
    """Improve a flow, in place, by conjugate gradients on `(q q^T + L) f = target`.

    Args:
        flow: `[2 h w]`, single precision.
        q: Gradient of the brightness times the root of its weight, `[2 h w]`.
        target: Right-hand side, `[2 h w]`.
        right: Weights of the links between columns, `[h w+1]`, zero at both ends.
        down: The same between rows, `[h+1 w]`.
        num_iterations: Steps.
        memory: Memory for what is found on the way; the border of `x` is zero.
    """
    height, width = flow.shape[1:]
    degree, inverse, x, image, residual, conditioned = memory
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
            x[0, row + 1, c + 1], x[1, row + 1, c + 1] = flow[0, row, c], flow[1, row, c]
    _apply(x, q, degree, right, down, image)
    for row in range(height):
        for c in range(width):
            x[0, row + 1, c + 1] = x[1, row + 1, c + 1] = 0.0
            residual[0, row, c] = target[0, row, c] - image[0, row, c]
            residual[1, row, c] = target[1, row, c] - image[1, row, c]
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


@inlined
def _sorted(a, b, c, d, e):  # type: ignore[no-untyped-def]
    """Five numbers, the least first, by a network of nine exchanges."""
    a, b = min(a, b), max(a, b)
    d, e = min(d, e), max(d, e)
    c, e = min(c, e), max(c, e)
    c, d = min(c, d), max(c, d)
    b, e = min(b, e), max(b, e)
    a, d = min(a, d), max(a, d)
    a, c = min(a, c), max(a, c)
    b, d = min(b, d), max(b, d)
    b, c = min(b, c), max(b, c)
    return a, b, c, d, e


@entry
def median(padded, out):  # type: ignore[no-untyped-def]
    """Median over windows of five by five, as `torchcss.vision.flow._inner_median` finds it.

    Rows are sorted, then columns, which leaves rows sorted. So many are then above or below each
    number that the median is that of the middle diagonal, of the greatest number of the diagonal
    before it and of the least of the one behind it. All stays in registers, eight pixels at a time.

    Args:
        padded: `[h+4 w+4]`, single precision.
        out: `[h w]`.
    """
    height, width = out.shape
    for row in range(height):
        p, q, r = padded[row], padded[row + 1], padded[row + 2]
        s, t = padded[row + 3], padded[row + 4]
        for k in range(width):
            a0, a1, a2, a3, a4 = _sorted(p[k], p[k + 1], p[k + 2], p[k + 3], p[k + 4])
            b0, b1, b2, b3, b4 = _sorted(q[k], q[k + 1], q[k + 2], q[k + 3], q[k + 4])
            c0, c1, c2, c3, c4 = _sorted(r[k], r[k + 1], r[k + 2], r[k + 3], r[k + 4])
            d0, d1, d2, d3, d4 = _sorted(s[k], s[k + 1], s[k + 2], s[k + 3], s[k + 4])
            e0, e1, e2, e3, e4 = _sorted(t[k], t[k + 1], t[k + 2], t[k + 3], t[k + 4])
            a0, b0, c0, d0, e0 = _sorted(a0, b0, c0, d0, e0)
            a1, b1, c1, d1, e1 = _sorted(a1, b1, c1, d1, e1)
            a2, b2, c2, d2, e2 = _sorted(a2, b2, c2, d2, e2)
            a3, b3, c3, d3, e3 = _sorted(a3, b3, c3, d3, e3)
            a4, b4, c4, d4, e4 = _sorted(a4, b4, c4, d4, e4)
            before = max(max(a3, b2), max(c1, d0))
            behind = min(min(b4, c3), min(d2, e1))
            _, one, two, three, _ = _sorted(a4, b3, c2, d1, e0)
            # The fourth of seven: three, two and one from the diagonal, the rest from the others.
            low, high = min(before, behind), max(before, behind)
            out[row, k] = min(three, min(max(two, low), max(one, high)))


@entry
def structure(image, scale, step, num_steps, along, across, smooth):  # type: ignore[no-untyped-def]
    """The smooth part of an image: least total variation near it (Chambolle 2004).

    Args:
        image: `[h w]`, single precision.
        scale: Weight of the total variation.
        step: Length of a step.
        num_steps: Steps.
        along: Memory for the links to the right, `[h w+1]`, zero.
        across: Memory for the links down, `[h+1 w]`, zero.
        smooth: A copy of the image; becomes its smooth part.
    """
    height, width = image.shape
    scale, step = np.float32(scale), np.float32(step)
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


@entry
def displace(outliers, flow, reach, least, arrived):  # type: ignore[no-untyped-def]
    """Add outliers where five neighbours of each go, see `torchcss.vision.boundaries.displaced`.

    Args:
        outliers: `[h w]`.
        flow: `[2 h w]`.
        reach: Distance of the neighbours.
        least: Outliers that are no greater are left out.
        arrived: `[5 h w]`, zero; what arrives is added, for each neighbour apart.
    """
    height, width = outliers.shape
    for row in range(height):
        for c in range(width):
            outlier = outliers[row, c]
            if not outlier > least:
                continue
            for side in range(5):
                down = reach if side == 3 else (-reach if side == 4 else 0)
                right = reach if side == 1 else (-reach if side == 2 else 0)
                there = min(max(row + down, 0), height - 1)
                beside = min(max(c + right, 0), width - 1)
                u = flow[0, there, beside] + np.float32(c)
                v = flow[1, there, beside] + np.float32(row)
                # Also false for what is not a number.
                if not (u > -1 and u < width and v > -1 and v < height):
                    continue
                left, top = floor(u), floor(v)
                share_u, share_v = u - left, v - top
                for y in range(2):
                    for x in range(2):
                        i, j = int(top) + y, int(left) + x
                        if i >= 0 and i < height and j >= 0 and j < width:
                            part = share_u if x == 1 else 1.0 - share_u
                            part = part * (share_v if y == 1 else 1.0 - share_v)
                            arrived[side, i, j] += outlier * part
