"""The reprojection error of joint centres and sticky priors, nothing else, in double precision.

The twin of `torchcss.studies.reprojection.ReprojectionCost`.
"""

from __future__ import annotations

import math
from collections import namedtuple

from torchcss.cost.fused.kinematics import find_twists, pose_tree
from torchcss.cost.fused.lift import lift, sum_points
from torchcss.cost.fused.potentials import potential_of
from torchcss.cost.fused.projection import Spatial, write_point
from torchcss.cost.fused.records import Array, Points, Result, Tree
from torchcss.kernels.compiler import entry, kernel

Reprojection = namedtuple(
    "Reprojection", "row place shift focal far near potential mean sharpness nu"
)
"""What the cost compares with; image lengths are in units of the noise.

Attributes:
    row: Row of the frame that carries each joint.
    place: The joint in that frame, metres.
    shift: Principal point less the observed place, `[joints 2]`.
    focal: Focal lengths.
    far: What an error counts as where a joint cannot be seen.
    near: Least depth that can be seen, metres.
    potential: `rho`.
    mean: Where the priors pull to.
    sharpness: Reciprocals of their deviations.
    nu: Height of their tails, nats.
"""


Scratch = namedtuple("Scratch", "frames points sums twists reference")
"""Memory for one state; see `Workspace`."""


@entry
def add_reprojection(
    x: Array, share: Array, tree: Tree, seen: Reprojection, scratch: Scratch, result: Result
) -> None:
    """Add the cost of all states of a pool.

    Args:
        x: The states, `[b n]`.
        share: How much of the second-order parts each Hessian is to contain.
        tree: The body's tree before the camera.
        seen: What it is compared with.
        scratch: Memory for what is found on the way.
        result: Where it is added.
    """
    slopes = len(result.gradient[0]) > 0
    for b in range(len(x)):
        gradient, hessian = result.gradient[b], result.hessian[b]
        pose_tree(x[b], tree, scratch.frames)
        result.value[b] += _compare(scratch.frames, seen, share[b], scratch.points)
        result.value[b] += _priors(x[b], seen, share[b], gradient, hessian)
        if slopes:
            for i in range(3):
                scratch.reference[i] = scratch.frames[0, i, 3]
            scratch.sums[:] = 0.0
            for i in range(len(seen.row)):
                sums = scratch.sums[seen.row[i]]
                sum_points(scratch.points, i, i + 1, scratch.reference, sums)
            find_twists(scratch.frames, tree, scratch.reference, scratch.twists)
            lift(tree, scratch.sums, scratch.twists, share[b], gradient, hessian)


@kernel
def _compare(frames: Array, seen: Reprojection, share: float, points: Points) -> float:
    """Cost of all joints; there is a point for each, with its cost's derivatives."""
    total, focal_u, focal_v = 0.0, seen.focal[0], seen.focal[1]
    for i in range(len(seen.row)):
        frame, place = frames[seen.row[i]], seen.place[i]
        x, y, z = frame[0, 3], frame[1, 3], frame[2, 3]
        for k in range(3):
            x += frame[0, k] * place[k]
            y += frame[1, k] * place[k]
            z += frame[2, k] * place[k]
        a, b, w, u, v = 0.0, 0.0, 0.0, seen.far[0], seen.far[1]
        if z > seen.near:
            w = 1.0 / z
            a, b = x * w, y * w
            u, v = focal_u * a + seen.shift[i, 0], focal_v * b + seen.shift[i, 1]
        rho, first, second = potential_of(seen.potential, u * u + v * v)
        total += 0.5 * rho
        # Derivatives in the normalised coordinates (a, b), then in the point: da = w (1, 0, -a).
        bend = 2.0 * share * second
        ga, gb = focal_u * first * u, focal_v * first * v
        aa = focal_u * focal_u * (first + bend * u * u)
        ab = focal_u * focal_v * bend * u * v
        bb = focal_v * focal_v * (first + bend * v * v)
        xz, yz = a * aa + b * ab + share * ga, a * ab + b * bb + share * gb
        along, ww = a * ga + b * gb, w * w
        zz = a * xz + b * yz + share * along
        spatial = Spatial(
            w * ga, w * gb, -w * along, ww * aa, ww * ab, -ww * xz, ww * bb, -ww * yz, ww * zz
        )
        write_point(points, i, (x, y, z), spatial)
    return total


@kernel
def _priors(x: Array, seen: Reprojection, share: float, gradient: Array, hessian: Array) -> float:
    """Lorentzian priors of single parameters."""
    total, nu = 0.0, seen.nu
    for i in range(len(x)):
        sharpness = seen.sharpness[i]
        z = (x[i] - seen.mean[i]) * sharpness
        first = nu / (z * z + nu)
        total += 0.5 * nu * math.log1p(z * z / nu)
        if len(gradient):
            gradient[i] += first * z * sharpness
            bend = first - share * 2.0 * first * z * z / (z * z + nu)
            hessian[i, i] += bend * sharpness * sharpness
    return total
