"""A start of the search from where a detector believes the joints in space (`Keypoints.points`).

Such points are those of some person: they are scaled to the body's limbs, set onto their lines of
sight, and the angles that put the joints there are solved for. What comes out is one start among
many: the search goes on from it by the keypoints in the image alone.

Call `start_from_points`.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.cost.targets import PointTargets
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.types import Bounds, Keypoints, Vectors
from torchcss.vision.camera import Camera

_BONES = tuple(
    (f"{side}_{a}", f"{side}_{b}")
    for side in "lr"
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
)
_LEAST_JOINTS = 6
_SIGMA = 0.03
"""Standard deviation of a point, metres."""


def start_from_points(
    body: BodyModel, camera: Camera, keypoints: Keypoints, starts: Vectors, bounds: Bounds
) -> Vectors:
    """The pose whose joints are where the points are; none where too few are known.

    Args:
        body: The body, before the camera.
        camera: The camera.
        keypoints: Of its image.
        starts: Poses to solve from, in several directions.
        bounds: Box limits.
    """
    names = [name for name in keypoints.names if name in body.joint_names]
    keypoints = keypoints.only(tuple(names))
    if keypoints.points is None:
        return starts[:0]
    # The columns of R are the world's axes: a row times R is in the world.
    points = keypoints.points.to(body.tie) @ camera.R_camera_world.to(body.tie)
    known = keypoints.known & points.isfinite().all(-1)
    if int(known.sum()) < _LEAST_JOINTS:
        return starts[:0]
    joint = torch.tensor(body.joint_columns(names), device=known.device)
    points = points * _scale(body, names, points, known)
    points = points[known] + _place(camera, keypoints.positions[known].to(points), points[known])
    joint = joint[known]
    reach = PointTargets(
        body=body,
        link=body.marker_link[joint],
        offset=body.marker_offset[joint],
        target=points.expand(len(starts), -1, -1),
        sigma=points.new_full((len(joint),), _SIGMA),
    )
    fits = TrustRegionNewton(max_steps=30, tolerance=0.1).minimise(reach, starts, bounds)
    return fits.mean[fits.cost.nan_to_num(torch.inf).argmin()][None]


def _scale(
    body: BodyModel, names: list[str], points: Float[Tensor, "j 3"], known: Bool[Tensor, " j"]
) -> float:
    """By how much the body's limbs are longer than those of the points."""
    rest = body.pose(body.rest).joints
    ours = theirs = 0.0
    for ends in _BONES:
        if set(ends) <= set(names):
            near, far = (names.index(name) for name in ends)
            if bool(known[near] & known[far]):
                one, other = (body.joint_index(name) for name in ends)
                ours += float((rest[one] - rest[other]).norm())
                theirs += float((points[near] - points[far]).norm())
    return ours / theirs if theirs > 0 else 1.0


def _place(
    camera: Camera, uv: Float[Tensor, "j 2"], points: Float[Tensor, "j 3"]
) -> Float[Tensor, "3"]:
    """The shift that brings points nearest to the lines of sight of their pixels."""
    centre = camera.centre_world.to(points)
    sight = torch.nn.functional.normalize(
        camera.unproject(uv, uv.new_ones(len(uv))) - centre, dim=-1
    )
    across = torch.eye(3).to(points) - sight[:, :, None] * sight[:, None, :]
    away = (across @ (centre - points)[:, :, None]).sum(0)
    return torch.linalg.solve(across.sum(0), away)[:, 0]
