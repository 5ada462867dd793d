"""From derivatives at points to those in the state; the twin of `torchcss.body.lift`.

Sums over the points that a joint carries, 33 numbers for each: stiffness K of the point's velocity
(S), its moments (M = sum [p]x A, K = sum [p]x A [p]x^T), P = sum p g^T and f = sum g. They are
added up along the tree, and the twists of the joints turn them into derivatives.
"""

from __future__ import annotations

from torchcss.cost.fused.records import Array, Points, Tree
from torchcss.kernels.compiler import inlined, kernel


@kernel
def sum_points(points: Points, begin: int, end: int, reference: Array, sums: Array) -> None:
    """Add the sums over some points, all carried by one frame, about a place of reference."""
    rx, ry, rz = reference[0], reference[1], reference[2]
    zero = rx * 0.0
    s0 = s1 = s2 = s3 = s4 = s5 = zero
    m0 = m1 = m2 = m3 = m4 = m5 = m6 = m7 = m8 = zero
    k0 = k1 = k2 = k3 = k4 = k5 = zero
    p0 = p1 = p2 = p3 = p4 = p5 = p6 = p7 = p8 = zero
    f0 = f1 = f2 = zero
    for i in range(begin, end):
        x, y, z = points.x[i] - rx, points.y[i] - ry, points.z[i] - rz
        fx, fy, fz = points.gx[i], points.gy[i], points.gz[i]
        xx, xy, xz = points.xx[i], points.xy[i], points.xz[i]
        yy, yz, zz = points.yy[i], points.yz[i], points.zz[i]
        s0, s1, s2, s3, s4, s5 = s0 + xx, s1 + xy, s2 + xz, s3 + yy, s4 + yz, s5 + zz
        # [p]x A, row by row.
        a0, a1, a2 = y * xz - z * xy, y * yz - z * yy, y * zz - z * yz
        b0, b1, b2 = z * xx - x * xz, z * xy - x * yz, z * xz - x * zz
        c0, c1, c2 = x * xy - y * xx, x * yy - y * xy, x * yz - y * xz
        m0, m1, m2 = m0 + a0, m1 + a1, m2 + a2
        m3, m4, m5 = m3 + b0, m4 + b1, m5 + b2
        m6, m7, m8 = m6 + c0, m7 + c1, m8 + c2
        k0, k1, k2 = k0 + y * a2 - z * a1, k1 + z * a0 - x * a2, k2 + x * a1 - y * a0
        k3, k4 = k3 + z * b0 - x * b2, k4 + x * b1 - y * b0
        k5 = k5 + x * c1 - y * c0
        p0, p1, p2 = p0 + x * fx, p1 + x * fy, p2 + x * fz
        p3, p4, p5 = p3 + y * fx, p4 + y * fy, p5 + y * fz
        p6, p7, p8 = p6 + z * fx, p7 + z * fy, p8 + z * fz
        f0, f1, f2 = f0 + fx, f1 + fy, f2 + fz
    new = (
        *(s0, s1, s2, s3, s4, s5),
        *(m0, m1, m2, m3, m4, m5, m6, m7, m8),
        *(k0, k1, k2, k3, k4, k5),
        *(p0, p1, p2, p3, p4, p5, p6, p7, p8),
        *(f0, f1, f2),
    )
    for n in range(33):
        sums[n] += new[n]


@kernel
def lift(
    tree: Tree, sums: Array, twists: Array, share: float, gradient: Array, hessian: Array
) -> None:
    """Add the derivatives in the state. The sums per frame become sums per joint and below.

    `share` of the curvature of the kinematics counts: 1 is exact, 0 is Gauss-Newton.
    """
    for j in range(len(tree.parent) - 1, -1, -1):
        above, own = sums[tree.parent[j]], sums[1 + j]
        for n in range(33):
            above[n] += own[n]
    for j in range(len(tree.parent)):
        slope, turning, shifting = react(sums[1 + j], twists[j], share)
        factor, column = tree.factor[j], tree.column[j]
        gradient[column] += factor * slope
        i = j
        while i >= 0:
            t = twists[i]
            entry = t[0] * turning[0] + t[1] * turning[1] + t[2] * turning[2]
            entry += t[3] * shifting[0] + t[4] * shifting[1] + t[5] * shifting[2]
            entry *= factor * tree.factor[i]
            hessian[tree.column[i], column] += entry
            if i != j:
                hessian[column, tree.column[i]] += entry
            i = tree.parent[i] - 1


Triple = tuple[float, float, float]


@inlined
def react(sums: Array, twist: Array, share: float) -> tuple[float, Triple, Triple]:
    """Slope along a joint, and how the wrench on what it carries changes with its motion."""
    wx, wy, wz, vx, vy, vz = twist[0], twist[1], twist[2], twist[3], twist[4], twist[5]
    sxx, sxy, sxz, syy, syz, szz = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    mxx, mxy, mxz, myx, myy, myz = sums[6], sums[7], sums[8], sums[9], sums[10], sums[11]
    mzx, mzy, mzz = sums[12], sums[13], sums[14]
    kxx, kxy, kxz, kyy, kyz, kzz = sums[15], sums[16], sums[17], sums[18], sums[19], sums[20]
    pxx, pxy, pxz, pyx, pyy, pyz = sums[21], sums[22], sums[23], sums[24], sums[25], sums[26]
    pzx, pzy, pzz, fx, fy, fz = sums[27], sums[28], sums[29], sums[30], sums[31], sums[32]
    slope = wx * (pyz - pzy) + wy * (pzx - pxz) + wz * (pxy - pyx)
    slope += vx * fx + vy * fy + vz * fz
    tx = kxx * wx + kxy * wy + kxz * wz + mxx * vx + mxy * vy + mxz * vz
    ty = kxy * wx + kyy * wy + kyz * wz + myx * vx + myy * vy + myz * vz
    tz = kxz * wx + kyz * wy + kzz * wz + mzx * vx + mzy * vy + mzz * vz
    sx = mxx * wx + myx * wy + mzx * wz + sxx * vx + sxy * vy + sxz * vz
    sy = mxy * wx + myy * wy + mzy * wz + sxy * vx + syy * vy + syz * vz
    sz = mxz * wx + myz * wy + mzz * wz + sxz * vx + syz * vy + szz * vz
    tx += share * (pxy * wy + pxz * wz - (pyy + pzz) * wx + fz * vy - fy * vz)
    ty += share * (pyx * wx + pyz * wz - (pxx + pzz) * wy + fx * vz - fz * vx)
    tz += share * (pzx * wx + pzy * wy - (pxx + pyy) * wz + fy * vx - fx * vy)
    return slope, (tx, ty, tz), (sx, sy, sz)
