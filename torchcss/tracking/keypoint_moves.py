"""A limb that misses its keypoints is looked for where these are.

The robust cost takes a keypoint for an outlier once a limb has strayed from it, and no sample of a
limb that leans the wrong way reaches the pose that explains it: a thigh that is lifted towards the
camera, tracked as one that goes back, is held by the hip's limit, and the knee falls behind. So
before a frame is searched, the joints of the best mode are compared with their keypoints. Joints
that miss them are moved to the keypoints' lines of sight, each segment of their limbs leaning
towards the camera or away from it (`torchcss.body.flips`), and the poses found are proposed. The
image decides what remains: it is a move as in `torchcss.tracking.flip_moves`, for another reason.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchcss.body.flips import Segments
from torchcss.body.model import BodyModel
from torchcss.cost.joints import JointTerm, match_joints
from torchcss.inference.mixture import GaussianMixture, separated
from torchcss.inference.proposals import Move
from torchcss.initialise.multi_start import all_ways, place_joints
from torchcss.tracking.flip_moves import POSES_APART
from torchcss.types import Bounds, Keypoints, Vector, Vectors, frozen
from torchcss.vision.camera import Camera

MISSED = 2.0
"""How far off a keypoint is missed, in distances at which a Lorentzian cost pulls most: beyond, the
pull is less than four fifths of that, and falls."""

_STEPS = 12
"""Steps towards a pose: all of 140 are within 5 cm of where more lead then; after eight, 95 %."""


@frozen
class MissedKeypoints(Move):
    """The limbs of the best mode that miss keypoints, put there; see `Move` for their samples.

    Attributes:
        search: How samples of each pose are drawn.
        log_odds: Weight of a pose against that of the best mode, nats: keypoints may be wrong.
        body: The body on this frame's base.
        camera: The camera of the view.
        keypoints: Those of the frame.
        term: What they cost.
        num: Most poses wanted.
    """

    body: BodyModel
    camera: Camera
    keypoints: Keypoints
    term: JointTerm
    num: int

    def states(self, best: GaussianMixture, bounds: Bounds) -> Vectors:
        """The poses, the nearest to the keypoints first; they obey the body's own limits."""
        x = bounds.project(best.mean[0])
        return poses_at_keypoints(
            self.body, self.camera, x, self.keypoints, self.term, num=self.num
        )


def poses_at_keypoints(
    body: BodyModel,
    camera: Camera,
    x: Vector,
    keypoints: Keypoints,
    term: JointTerm,
    *,
    num: int,
) -> Vectors:
    """Poses with the joints that miss their keypoints put there, the nearest first.

    Args:
        body: The body; the poses obey its joint limits.
        camera: The camera of the view.
        x: The pose.
        keypoints: Those of one frame.
        term: What they cost.
        num: Most poses wanted.

    Returns:
        The poses, each with fewer keypoints missed, and with a joint `POSES_APART` from where it is
        in the others; none if the pose misses none, or is out of the camera's sight, nor for a body
        without limbs that can flip.
    """
    joints, targets = body.pose(x).joints, match_joints(keypoints, body.joint_names)

    def squared(places: Tensor) -> Tensor:
        """Squared errors in scales; a joint that cannot be seen has none."""
        uv, _, valid = camera.project(places[..., targets.joint, :])
        off = targets.weight * (uv - targets.position).square().sum(-1) / term.sigma**2
        return torch.where(valid, off, 0.0)

    limit = MISSED**2 * term.nu
    missed = squared(joints) > limit
    if num < 1 or not bool(missed.any()) or not (segments := Segments(body)).limbs:
        return x.new_zeros(0, len(x))
    which = targets.joint[missed]
    sight = joints - camera.centre_world.to(joints)
    sight = sight / sight.norm(dim=-1, keepdim=True)
    sight = sight.index_copy(0, which, camera.rays(targets.position[missed]))
    flipped = _ways_of_limbs(body, segments, which)
    target = segments.flip(joints.expand(len(flipped), -1, -1), flipped, camera.centre_world, sight)
    start = x.expand(len(flipped), -1)
    poses = place_joints(body, segments, target, start, body.bounds, steps=_STEPS)
    places = body.pose(poses).joints
    off = squared(places)
    left = torch.nonzero((off > limit).sum(-1) < missed.sum())[:, 0]
    order = left[off[left].clamp(max=limit).sum(-1).argsort(stable=True)]
    return poses[order[separated(places[order], POSES_APART, num, fill=False)]]


def _ways_of_limbs(
    body: BodyModel, segments: Segments, joints: Int[Tensor, " m"]
) -> Bool[Tensor, "w g"]:
    """The limbs with one of these joints flipped in all their ways, one limb at a time."""
    ways = all_ways(segments.depth, joints.device)
    rows = ways.new_zeros(1, len(segments.groups))
    names = {body.joint_names[joint] for joint in joints.tolist()}
    for limb in segments.limbs:
        if names.isdisjoint(limb.groups):
            continue
        own = rows[:1].repeat(len(ways) - 1, 1)
        own[:, [segments.groups.index(name) for name in limb.groups[: segments.depth]]] = ways[1:]
        rows = torch.cat([rows, own])
    return rows
