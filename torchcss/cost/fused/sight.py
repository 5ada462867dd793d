"""Which nodes other parts hide; the twin of `torchcss.cost.visibility.line_of_sight`.

Parts are sorted out against parts by the cones about their spheres, then rays against spheres and
ellipsoids. The stretches of rays that are left are put in a list, and all of it takes the same few
steps to where they are nearest to their parts.
"""

from __future__ import annotations

from torchcss.cost.fused.records import Array, Lines, Nodes, Parts, Rays
from torchcss.cost.fused.superquadric import bent_radial_square, narrowed, radial_square, shape_of
from torchcss.kernels.compiler import inlined, kernel, sqrt

_TINY = 1e-12
_STEPS, _SAMPLED_STEPS, _SAMPLES = 3, 4, 12
_APART = 1 / (_SAMPLES - 1)
"""Steps to the nearest point of a plain part and of any other, and samples before the latter."""

_MICRO = 1e-10
"""Square of a step too short to tell the curvature from, square metres."""

_ROUNDING = 1e-6
"""Relative error of a squared distance in single precision, with a margin."""

_SLACK = 1e-4
"""By how much cones may miss each other and still count as meeting, in the cosine."""

_NEVER = -1e30


@kernel
def see_nodes(
    nodes: Nodes, posed: Array, parts: Parts, beside: bool, rays: Rays, near: Lines, lines: Lines
) -> None:
    """Multiply what each node's `visible` is by whether the line of sight to it is free.

    Args:
        nodes: The nodes; those whose `exists` or `visible` is zero are left as they are.
        posed: Poses of the parts.
        parts: Shapes of the parts.
        beside: Look at the neighbours alone, a little outside the node, and behind it too, and
            multiply `exists` instead.
        rays: Memory for the rays.
        near: Memory for the stretches near one part.
        lines: Memory for all stretches that count.
    """
    count = nodes.first[len(posed)]
    _aim(nodes, parts.clearance if beside else parts.clearance * 0.0, count, rays)
    found = 0
    for hider in range(len(posed)):
        met = 0
        behind = parts.behind[hider] if beside else parts.behind[hider] * 0.0
        for part in range(len(posed)):
            if part == hider or (beside and not parts.touching[part, hider]):
                continue
            if nodes.first[part] == nodes.first[part + 1]:
                continue
            if beside or _may_hide(posed, parts, hider, part):
                met = _meet(nodes, rays, posed[hider], parts, (part, hider), behind, near, met)
        if met:
            _stretch(near, met, posed[hider], parts, hider, behind)
            found = _keep(near, met, hider, lines, found)
    _ellipsoid_minimum(lines, found, parts.shape)
    found = _settle(lines, found, parts, rays)
    _descend(lines, found, parts.shape)
    for m in range(found):
        if not parts.plain[lines.part[m]]:
            lines.value[m] = _sampled_gap(lines, m, parts.shape)
        ray = lines.ray[m]
        rays.gap[ray] = min(rays.gap[ray], lines.value[m])
    for i in range(count):
        passed = min(max(0.5 + rays.gap[i] / parts.ramp, 0.0), 1.0)
        if beside:
            nodes.exists[i] *= passed
        else:
            nodes.visible[i] *= passed


@kernel
def _aim(nodes: Nodes, clearance: float, count: int, rays: Rays) -> None:
    """Lines of sight to the nodes, or a little outside them."""
    for i in range(count):
        x = nodes.x[i] + clearance * nodes.nx[i]
        y = nodes.y[i] + clearance * nodes.ny[i]
        z = nodes.z[i] + clearance * nodes.nz[i]
        length = sqrt(x * x + y * y + z * z)
        turned = 1.0 / max(length, _TINY)
        rays.u[i], rays.v[i], rays.w[i] = x * turned, y * turned, z * turned
        rays.length[i] = length if nodes.exists[i] * nodes.visible[i] > 0.0 else _NEVER
        rays.gap[i] = -_NEVER


@kernel
def _may_hide(posed: Array, parts: Parts, hider: int, part: int) -> bool:
    """Whether the cones about the spheres of two parts meet, and the hider is not behind."""
    a, b, r, h = posed[part], posed[hider], parts.radius[part], parts.radius[hider]
    aa = a[0, 3] * a[0, 3] + a[1, 3] * a[1, 3] + a[2, 3] * a[2, 3]
    bb = b[0, 3] * b[0, 3] + b[1, 3] * b[1, 3] + b[2, 3] * b[2, 3]
    ab = a[0, 3] * b[0, 3] + a[1, 3] * b[1, 3] + a[2, 3] * b[2, 3]
    if aa <= r * r or bb <= h * h:
        return True
    if sqrt(bb - h * h) > (sqrt(aa) + r + h) * (1.0 + _SLACK):
        return False
    # The cosine of the sum of half angles, of which the sines are r / |a| and h / |b|.
    together = sqrt(aa - r * r) * sqrt(bb - h * h) - r * h
    return ab > together - _SLACK * sqrt(aa * bb)


@kernel
def _meet(
    nodes: Nodes,
    rays: Rays,
    frame: Array,
    parts: Parts,
    pair: tuple[int, int],
    behind: float,
    near: Lines,
    met: int,
) -> int:
    """Add the rays to a part's nodes that meet the sphere of a hider; returns the new number."""
    part, hider = pair
    cx, cy, cz, radius = frame[0, 3], frame[1, 3], frame[2, 3], parts.radius[hider]
    square = (1.0 - _ROUNDING) * (cx * cx + cy * cy + cz * cz) - radius * radius
    tangent = sqrt(square) if square > 0.0 else square * 0.0 + _NEVER
    reach = radius + behind
    for i in range(nodes.first[part], nodes.first[part + 1]):
        depth = cx * rays.u[i] + cy * rays.v[i] + cz * rays.w[i]
        if depth > tangent and depth < rays.length[i] + reach:
            near.ray[met] = i
            near.u[met], near.v[met], near.w[met] = rays.u[i], rays.v[i], rays.w[i]
            near.end[met] = rays.length[i]
            met += 1
    return met


@kernel
def _stretch(near: Lines, met: int, frame: Array, parts: Parts, hider: int, behind: float) -> None:
    """Put rays into the frame of a part, and find the stretches that may be inside."""
    cx, cy, cz = frame[0, 3], frame[1, 3], frame[2, 3]
    r00, r10, r20 = frame[0, 0], frame[1, 0], frame[2, 0]
    r01, r11, r21 = frame[0, 1], frame[1, 1], frame[2, 1]
    r02, r12, r22 = frame[0, 2], frame[1, 2], frame[2, 2]
    ox = -(r00 * cx + r10 * cy + r20 * cz)
    oy = -(r01 * cx + r11 * cy + r21 * cz)
    oz = -(r02 * cx + r12 * cy + r22 * cz)
    square = parts.radius[hider] * parts.radius[hider]
    sx, sy, sz = parts.around[0, hider], parts.around[1, hider], parts.around[2, hider]
    for m in range(met):
        u, v, w = near.u[m], near.v[m], near.w[m]
        x = r00 * u + r10 * v + r20 * w
        y = r01 * u + r11 * v + r21 * w
        z = r02 * u + r12 * v + r22 * w
        # Measured from the foot of the perpendicular from the part's centre, for precision.
        start = ox * x + oy * y + oz * z
        px, py, pz = ox - start * x, oy - start * y, oz - start * z
        half = sqrt(max(square - (px * px + py * py + pz * pz), 0.0))
        end = min(start + near.end[m] + behind, half)
        a, b, c, d, e, f = px * sx, py * sy, pz * sz, x * sx, y * sy, z * sz
        across, speed = a * d + b * e + c * f, d * d + e * e + f * f
        close = (a * a + b * b + c * c - 1.0) * speed < across * across
        near.x[m], near.y[m], near.z[m] = px, py, pz
        near.u[m], near.v[m], near.w[m] = x, y, z
        near.begin[m] = max(start, -half)
        near.end[m] = end if close else _NEVER


@kernel
def _keep(near: Lines, met: int, hider: int, lines: Lines, found: int) -> int:
    """Add the stretches that are none too short to the list; returns its new length."""
    for m in range(met):
        if near.begin[m] <= near.end[m]:
            lines.part[found], lines.ray[found] = hider, near.ray[m]
            lines.x[found], lines.y[found], lines.z[found] = near.x[m], near.y[m], near.z[m]
            lines.u[found], lines.v[found], lines.w[found] = near.u[m], near.v[m], near.w[m]
            lines.begin[found], lines.end[found] = near.begin[m], near.end[m]
            found += 1
    return found


@kernel
def _ellipsoid_minimum(lines: Lines, found: int, table: Array) -> None:
    """Where each stretch is nearest to the tapered ellipsoid, the curvature there, and R^2."""
    for m in range(found):
        shape = shape_of(table, lines.part[m])
        x, y, z = lines.x[m], lines.y[m], lines.z[m] * shape.ic
        dx, dy, dz = lines.u[m], lines.v[m], lines.w[m] * shape.ic
        begin, end = lines.begin[m], lines.end[m]
        # With the taper at the foot, then with that at the nearest point.
        ix, iy = narrowed(shape, z)
        u, v = dx * ix, dy * iy
        s = -(x * ix * u + y * iy * v + z * dz) / max(u * u + v * v + dz * dz, _TINY)
        ix, iy = narrowed(shape, z + min(max(s, begin), end) * dz)
        u, v = dx * ix, dy * iy
        curvature = max(u * u + v * v + dz * dz, _TINY)
        s = -(x * ix * u + y * iy * v + z * dz) / curvature
        s = min(max(s, begin), end)
        height = z + s * dz
        ix, iy = narrowed(shape, height)
        a, b = (x + s * dx) * ix, (y + s * dy) * iy
        lines.s[m], lines.curvature[m] = s, curvature
        lines.value[m] = a * a + b * b + height * height


@kernel
def _settle(lines: Lines, found: int, parts: Parts, rays: Rays) -> int:
    """Mark the rays that are hidden for sure, and keep the stretches of the others."""
    for m in range(found):
        part = lines.part[m]
        if parts.plain[part] and lines.value[m] < parts.within[part]:
            rays.gap[lines.ray[m]] = _NEVER
    kept = 0
    for m in range(found):
        if rays.gap[lines.ray[m]] > 0.0:
            lines.part[kept], lines.ray[kept] = lines.part[m], lines.ray[m]
            lines.x[kept], lines.y[kept], lines.z[kept] = lines.x[m], lines.y[m], lines.z[m]
            lines.u[kept], lines.v[kept], lines.w[kept] = lines.u[m], lines.v[m], lines.w[m]
            lines.begin[kept], lines.end[kept] = lines.begin[m], lines.end[m]
            lines.s[kept], lines.curvature[kept] = lines.s[m], lines.curvature[m]
            kept += 1
    return kept


@kernel
def _descend(lines: Lines, found: int, table: Array) -> None:
    """Go to where each stretch is nearest to its plain part, and measure the gap there."""
    _probe(lines, found, table)
    for m in range(found):
        s, slope, curvature = lines.s[m], lines.slope[m], lines.curvature[m]
        lines.last[m], lines.before[m] = s, slope
        lines.s[m] = min(max(s - slope / curvature, lines.begin[m]), lines.end[m])
    for _ in range(1, _STEPS):
        _probe(lines, found, table)
        for m in range(found):
            s, slope, curvature = lines.s[m], lines.slope[m], lines.curvature[m]
            moved = s - lines.last[m]
            secant = next_curvature(slope - lines.before[m], moved, curvature)
            lines.last[m], lines.before[m] = s, slope
            lines.s[m] = min(max(s - slope / secant, lines.begin[m]), lines.end[m])
    _probe(lines, found, table)


@inlined
def next_curvature(change: float, moved: float, curvature: float) -> float:
    """By secant; after a step too short for one, the curvature assumed at first."""
    secant = (change * moved + _MICRO * curvature) / (moved * moved + _MICRO)
    return min(max(secant, 0.3 * curvature), 10.0 * curvature)


@kernel
def _probe(lines: Lines, found: int, table: Array) -> None:
    """The slope of R^2/2 along each stretch at `s`, and the signed distance from its part."""
    for m in range(found):
        shape = shape_of(table, lines.part[m])
        s, u, v, w = lines.s[m], lines.u[m], lines.v[m], lines.w[m]
        square, gx, gy, gz = radial_square(
            shape, lines.x[m] + s * u, lines.y[m] + s * v, lines.z[m] + s * w
        )
        radial, steepness = sqrt(square), sqrt(gx * gx + gy * gy + gz * gz)
        lines.slope[m] = gx * u + gy * v + gz * w
        lines.value[m] = (radial - 1.0) * radial / max(steepness, _TINY)


@kernel
def _sampled_gap(lines: Lines, m: int, table: Array) -> float:
    """The gap of a bent part, or of one that is far from round.

    The stretch meets it at most twice: the first and the last minimum are looked at.
    """
    least = lines.value[m] * 0.0 - _NEVER
    for last in range(2):
        lower, upper, fall, climb = _minimum_between(lines, m, table, last)
        change, width = max(fall + climb, _TINY), upper - lower
        s, curvature = lower + width * fall / change, change / max(width, _TINY)
        slope, _ = _slope_at(lines, m, table, s)
        before, past = slope, s
        s = min(max(s - slope / curvature, lower), upper)
        for _ in range(1, _SAMPLED_STEPS):
            slope, _ = _slope_at(lines, m, table, s)
            secant = next_curvature(slope - before, s - past, curvature)
            past, before = s, slope
            s = min(max(s - slope / secant, lower), upper)
        _, gap = _slope_at(lines, m, table, s)
        least = min(least, gap)
    return least


@kernel
def _minimum_between(
    lines: Lines, m: int, table: Array, last: int
) -> tuple[float, float, float, float]:
    """The samples about the first or last minimum, and how the slope falls and climbs there."""
    begin, end = lines.begin[m], lines.end[m]
    lower = upper = s_before = begin
    fall = climb = rise_before = begin * 0.0
    step = (end - begin) * _APART
    s = begin
    for k in range(_SAMPLES + 1):
        inside = k < _SAMPLES
        rise = rise_before
        if inside:
            rise, _ = _slope_at(lines, m, table, s)
        falling = k == 0 or rise_before < 0.0
        climbing = not inside or not rise < 0.0
        if falling and climbing:
            lower, upper = s_before if k else s, s if inside else s_before
            fall = -min(rise_before if k else rise, 0.0)
            climb = max(rise if inside else rise_before, 0.0)
            if last == 0:
                break
        s_before, rise_before = s, rise
        s = s + step
    return lower, upper, fall, climb


@kernel
def _slope_at(lines: Lines, m: int, table: Array, s: float) -> tuple[float, float]:
    """Slope of R^2/2 along a stretch, and the gap."""
    u, v, w = lines.u[m], lines.v[m], lines.w[m]
    square, gx, gy, gz = bent_radial_square(
        table, lines.part[m], (lines.x[m] + s * u, lines.y[m] + s * v, lines.z[m] + s * w)
    )
    radial, steepness = sqrt(square), sqrt(gx * gx + gy * gy + gz * gz)
    return gx * u + gy * v + gz * w, (radial - 1.0) * radial / max(steepness, _TINY)
