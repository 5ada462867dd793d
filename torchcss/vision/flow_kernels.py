"""The inner loops of the optical flow, compiled; their twins in torch stand in the modules.

A step of the flow's solver is a dozen passes over the image in torch, each of which fetches it from
memory anew. Here all steps of a solve are one pass. Where numba cannot be imported the
flow takes torch's way, as it does on a GPU and in double precision.
"""

from __future__ import annotations

import numpy as np

from torchcss.kernels.compiler import entry, floor, inlined, sqrt


@inlined
def _go_on(line, num):  # type: ignore[no-untyped-def]
    """Continue the coefficients of a line, which begin at its second number, straight on."""
    line[0] = 2.0 * line[1] - line[2] if num > 1 else line[1]
    line[num + 1] = 2.0 * line[num] - line[num - 1] if num > 1 else line[num]
    line[num + 2] = line[num + 1]


@entry
def spline(image, factors, coefficients):  # type: ignore[no-untyped-def]
    """Coefficients of the natural cubic spline through an image; Thomas' algorithm, twice.

    Args:
        image: `[h w]`, single precision.
        factors: Memory, as long as the longer side.
        coefficients: Becomes those of a row before the image, of its own, and of two behind it, and
            as many columns, `[h+3 w+3]`.
    """
    height, width = image.shape
    factors[0] = 0.0
    for k in range(1, len(factors)):
        factors[k] = 1.0 / (4.0 - factors[k - 1])
    for row in range(height):
        source, to, factor = image[row], coefficients[row + 1, 1 : width + 1], factors[row]
        above = coefficients[row, 1 : width + 1]
        if row == 0 or row == height - 1:
            for c in range(width):
                to[c] = source[c]
        else:
            for c in range(width):
                to[c] = (6.0 * source[c] - above[c]) * factor
    for row in range(height - 2, 0, -1):
        to, below = coefficients[row + 1, 1 : width + 1], coefficients[row + 2, 1 : width + 1]
        factor = factors[row]
        for c in range(width):
            to[c] -= factor * below[c]
    for row in range(1, height + 1):
        line = coefficients[row]
        for c in range(2, width):
            line[c] = (6.0 * line[c] - line[c - 1]) * factors[c - 1]
        for c in range(width - 1, 1, -1):
            line[c] -= factors[c - 1] * line[c + 1]
        _go_on(line, width)
    for c in range(width + 3):
        _go_on(coefficients[:, c], height)


@entry
def slopes(coefficients, along_u, along_v):  # type: ignore[no-untyped-def]
    """Slopes of a spline at its pixels.

    Args:
        coefficients: As `spline` finds them, `[h+3 w+3]`.
        along_u: Becomes the slope along u, `[h w]`.
        along_v: Becomes the slope along v, `[h w]`.
    """
    height, width = along_u.shape
    share = np.float32(1 / 12)
    for row in range(height):
        above, line, below = coefficients[row], coefficients[row + 1], coefficients[row + 2]
        to_u, to_v = along_u[row], along_v[row]
        for c in range(width):
            left = above[c] + 4.0 * line[c] + below[c]
            right = above[c + 2] + 4.0 * line[c + 2] + below[c + 2]
            to_u[c] = (right - left) * share
            upper = above[c] + 4.0 * above[c + 1] + above[c + 2]
            lower = below[c] + 4.0 * below[c + 1] + below[c + 2]
            to_v[c] = (lower - upper) * share


@inlined
def _ends(t):  # type: ignore[no-untyped-def]
    """Share and slope of the coefficient two pixels off, a place t beyond one pixel off."""
    return t * t * t * np.float32(1 / 6), np.float32(0.5) * t * t


@inlined
def _middle(t):  # type: ignore[no-untyped-def]
    """Share and slope of a coefficient, at a distance of up to one pixel behind it."""
    share = ((np.float32(0.5) * t - np.float32(1)) * t * t) + np.float32(2 / 3)
    return share, (np.float32(1.5) * t - np.float32(2)) * t


@entry
def linearise(flow, first, second, least, gradient, offset, visible):  # type: ignore[no-untyped-def]
    """Warp the second frame and linearise constant brightness, see `torchcss.vision.warping`.

    Args:
        flow: `[2 h w]`, single precision, finite.
        first: Grey levels of the first frame and their slopes, `[3 h w]`.
        second: Spline through the second frame, `[h+3 w+3]`.
        least: Square of the least gradient that is not rounding.
        gradient: Becomes the mean of both frames' gradients, `[2 h w]`.
        offset: Becomes the residual less gradient times flow, `[h w]`.
        visible: Becomes 1 where the pixel goes to a place in the image, else 0.
    """
    height, width = offset.shape
    # Ends of the image, and its outermost pixels, in its own precision.
    right, bottom = np.float32(width - 0.5), np.float32(height - 0.5)
    last_u, last_v, zero = np.float32(width - 1), np.float32(height - 1), np.float32(0)
    for row in range(height):
        for c in range(width):
            u, v = flow[0, row, c] + np.float32(c), flow[1, row, c] + np.float32(row)
            inside = u >= -0.5 and u <= right and v >= -0.5 and v <= bottom
            visible[row, c] = np.float32(1 if inside else 0)
            u, v = min(max(u, zero), last_u), min(max(v, zero), last_v)
            left, top = floor(u), floor(v)  # type: ignore[arg-type]
            s, t = u - left, v - top
            x, y = int(left), int(top)
            (a0, b0), (a1, b1) = _ends(1 - s), _middle(s)
            (a2, b2), (a3, b3) = _middle(1 - s), _ends(s)
            b0, b2 = -b0, -b2
            level, to_u, to_v = np.float32(0), np.float32(0), np.float32(0)
            for tap in range(4):
                if tap == 0:
                    share, rise = _ends(1 - t)
                    rise = -rise
                elif tap == 1:
                    share, rise = _middle(t)
                elif tap == 2:
                    share, rise = _middle(1 - t)
                    rise = -rise
                else:
                    share, rise = _ends(t)
                k, p = second[y + tap, x], second[y + tap, x + 1]
                q, r = second[y + tap, x + 2], second[y + tap, x + 3]
                along = a0 * k + a1 * p + a2 * q + a3 * r
                level += share * along
                to_v += rise * along
                to_u += share * (b0 * k + b1 * p + b2 * q + b3 * r)
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


@entry
def inverse_blocks(flow, energy, inverse, target):  # type: ignore[no-untyped-def]
    """Inverse of each pixel's block (uu, vv, uv) and the target beside it, as `_inverse_blocks`.

    Args:
        flow: `[2 h w]`, single precision.
        energy: The gradient of brightness times the root of its weight, the target, and the weights
            of links, as `weigh` has found them.
        inverse: `[3 h w]`.
        target: `[2 h w]`.
    """
    q, wanted, right, down = energy
    height, width = flow.shape[1:]
    for row in range(height):
        for c in range(width):
            links = right[row, c] + right[row, c + 1] + down[row, c] + down[row + 1, c]
            u, v = q[0, row, c], q[1, row, c]
            linked = links > 0.0
            share = 1.0 / (links * (links + u * u + v * v)) if linked else np.float32(1)
            inverse[0, row, c] = (links + v * v) * share if linked else np.float32(1)
            inverse[1, row, c] = (links + u * u) * share if linked else np.float32(1)
            inverse[2, row, c] = -u * v * share if linked else np.float32(0)
            target[0, row, c] = wanted[0, row, c] if linked else flow[0, row, c]
            target[1, row, c] = wanted[1, row, c] if linked else flow[1, row, c]


@inlined
def _relax(x, before, system, shares, step, row):  # type: ignore[no-untyped-def]
    """A step of one row, in place of what was there before the last one."""
    target, inverse, right, down = system
    length, keep = shares[step, 0], shares[step, 1]
    for c in range(target.shape[2]):
        k = c + 1
        left, along, up, under = right[row, c], right[row, k], down[row, c], down[row + 1, c]
        u = target[0, row, c] + left * x[0, row + 1, c] + along * x[0, row + 1, c + 2]
        v = target[1, row, c] + left * x[1, row + 1, c] + along * x[1, row + 1, c + 2]
        u += up * x[0, row, k] + under * x[0, row + 2, k]
        v += up * x[1, row, k] + under * x[1, row + 2, k]
        to_u = inverse[0, row, c] * u + inverse[2, row, c] * v
        to_v = inverse[1, row, c] * v + inverse[2, row, c] * u
        u, v = x[0, row + 1, k], x[1, row + 1, k]
        before[0, row + 1, k] = u + length * (to_u - u) + keep * (u - before[0, row + 1, k])
        before[1, row + 1, k] = v + length * (to_v - v) + keep * (v - before[1, row + 1, k])


@entry
def solve_flow(flow, system, shares, one, other, improved):  # type: ignore[no-untyped-def]
    """Improve a flow by Chebyshev's semi-iteration; see `torchcss.vision.flow`.

    Every step follows the one before at a distance of one row: what they share stays in the cache.

    Args:
        flow: `[2 h w]`, single precision.
        system: Right-hand side, `[2 h w]`; inverse of each pixel's block (uu, vv, uv), `[3 h w]`;
            weights of the links between columns, `[h w+1]`, and between rows, `[h+1 w]`, zero at
            the ends.
        shares: Of Jacobi's step and of the change before, for each step, `[n 2]`.
        one: Memory for the flow inside a border of zeros, `[2 h+2 w+2]`.
        other: The same again.
        improved: Becomes the flow after all steps.
    """
    (height, width), num = flow.shape[1:], len(shares)
    for i in range(2):
        for row in range(height + 2):
            for c in range(width + 2):
                one[i, row, c] = other[i, row, c] = 0.0
        for row in range(height):
            source, to, too = flow[i, row], one[i, row + 1, 1:], other[i, row + 1, 1:]
            for c in range(width):
                to[c] = too[c] = source[c]
    for front in range(height + num - 1):
        for step in range(max(0, front - height + 1), min(front + 1, num)):
            # Each array keeps its place in a call: only so is it seen that they differ.
            if step % 2 == 0:
                _relax(one, other, system, shares, step, front - step)
            else:
                _relax(other, one, system, shares, step, front - step)
    last = one if num % 2 == 0 else other
    for i in range(2):
        for row in range(height):
            to, source = improved[i, row], last[i, row + 1, 1:]
            for c in range(width):
                to[c] = source[c]


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
def median(image, padded, out):  # type: ignore[no-untyped-def]
    """Median over windows of five by five, as `torchcss.vision.flow._inner_median` finds it.

    Rows are sorted, then columns, which leaves rows sorted. So many are then above or below each
    number that the median is that of the middle diagonal, of the greatest number of the diagonal
    before it and of the least of the one behind it. All stays in registers, eight pixels at a time.

    Args:
        image: `[h w]`, single precision.
        padded: Memory for the image and two pixels about it, its border replicated, `[h+4 w+4]`.
        out: Becomes the medians, `[h w]`.
    """
    height, width = out.shape
    for row in range(height + 4):
        source, whole = image[min(max(row - 2, 0), height - 1)], padded[row]
        middle = whole[2:]
        for c in range(width):
            middle[c] = source[c]
        whole[0] = whole[1] = source[0]
        whole[width + 2] = whole[width + 3] = source[width - 1]
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
