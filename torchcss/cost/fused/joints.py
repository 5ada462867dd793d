"""Joint centres against keypoints, in double precision; the twin of `torchcss.cost.joints`."""

from __future__ import annotations

from torchcss.cost.fused.potentials import potential_of, robust_slope
from torchcss.cost.fused.projection import project, pull_back, times, write_point
from torchcss.cost.fused.records import Array, Lens, PackedKeypoints, Points
from torchcss.kernels.compiler import kernel

_FAR_PX = 1e8


@kernel
def compare_joints(
    frames: Array, lens: Lens, keypoints: PackedKeypoints, mode: int, exact: bool, points: Points
) -> float:
    """Cost of all keypoints; there is a point for each, with its cost's derivatives."""
    total, target = 0.0, keypoints.target[mode]
    for i in range(len(keypoints.row)):
        frame, place = frames[keypoints.row[i]], keypoints.place[i]
        a, b, c = place[0], place[1], place[2]
        x = frame[0, 0] * a + frame[0, 1] * b + frame[0, 2] * c + frame[0, 3]
        y = frame[1, 0] * a + frame[1, 1] * b + frame[1, 2] * c + frame[1, 3]
        z = frame[2, 0] * a + frame[2, 1] * b + frame[2, 2] * c + frame[2, 3]
        pixel = project(lens, x, y, z)
        weight = target[2, i]
        du = min(max(pixel.u - target[0, i], -_FAR_PX), _FAR_PX)
        dv = min(max(pixel.v - target[1, i], -_FAR_PX), _FAR_PX)
        rho, slope = robust_slope(keypoints.potential, weight, du, dv)
        if not pixel.valid:
            rho, _, _ = potential_of(keypoints.potential, weight * keypoints.far)
        total += 0.5 * keypoints.scale * rho
        write_point(
            points, i, (x, y, z), pull_back(lens, pixel, times(keypoints.scale, slope), exact)
        )
    return total
