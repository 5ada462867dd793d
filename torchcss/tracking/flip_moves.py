"""Jumps to the other poses that project to the same places: what one camera cannot tell apart.

A limb that comes towards the camera looks like one that goes away from it. Between the two lies a
wall of cost that samples about a mode seldom cross, but where the other pose is can be computed:
it is a forward-backward flip (`torchcss.body.flips`), as in initialisation. `Flips` is the proposal
that samples the flips of the best mode, so that every one of them is descended from; the image
decides what remains (Sminchisescu and Triggs, Kinematic Jump Processes, CVPR 2003, do so for every
sample).
"""

from __future__ import annotations

import torch

from torchcss.body.flips import Segments
from torchcss.body.model import BodyModel
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.joints import JointTerm
from torchcss.cost.total import TrackingCost
from torchcss.inference.mixture import GaussianMixture, separated
from torchcss.inference.proposals import Move
from torchcss.initialise.multi_start import flips
from torchcss.types import Bounds, Keypoints, Vector, Vectors, frozen
from torchcss.vision.camera import Camera

_NOISE = 0.02
"""Scale by which flips are judged, as a share of the body's extent in the image."""

_MOST_NOISE = 6.0
"""Scales by which a joint may miss its place: as far as the ranking of the flips looks. Where joint
limits leave nearly no flip, what they leave looks different, and a descent from it leads nowhere.
"""

_ALL = 1_000_000
"""More combinations than any body has."""

_STEPS = 8
"""Steps towards a flip: nearly all are within 5 cm then, and are descended from afterwards."""

_AT_ONCE = 128
"""Combinations that are posed at a time; the first few hundred of thousands mostly do."""

POSES_APART = 0.15
"""Least distance of some joint, metres, at which two poses are two. A body has a thousand flips
that differ by the tilt of a foot or of the trunk, and they are the most plausible."""


@frozen
class Flips(Move):
    """The flips of the best mode; see `Move` for how they are sampled.

    Attributes:
        search: How samples of each flip are drawn.
        log_odds: Weight of a flip against that of the best mode, nats.
        body: The body on this frame's base.
        camera: Any camera of the view.
        num: Most flips wanted.
    """

    body: BodyModel
    camera: Camera
    num: int

    def states(self, best: GaussianMixture, bounds: Bounds) -> Vectors:
        """The flips, the most plausible first; they obey the body's own limits."""
        return flipped_poses(self.body, self.camera, bounds.project(best.mean[0]), num=self.num)


def flipped_poses(body: BodyModel, camera: Camera, x: Vector, *, num: int) -> Vectors:
    """Other poses whose joints project to where a pose's do, the most plausible first.

    Args:
        body: The body; the poses obey its joint limits.
        camera: Any camera of the view.
        x: The pose.
        num: Most poses wanted.

    Returns:
        The poses, each with a joint `POSES_APART` from where it is in the given one and in the
        others; none for a body without limbs that can flip, or wholly out of the camera's sight.
    """
    segments = Segments(body)
    nothing = x.new_zeros(0, len(x))
    if not segments.limbs or num < 1:
        return nothing
    joints = body.pose(x).joints
    uv, _, valid = camera.project(joints)
    if not bool(valid.any()):
        return nothing
    extent = float((uv[valid].amax(0) - uv[valid].amin(0)).max())
    sigma = max(1.0, _NOISE * extent)
    keypoints = Keypoints(uv, valid.to(uv), body.joint_names)
    cost = TrackingCost(
        choice=CostChoice().without("contour", "temporal").having(JointTerm(sigma=sigma)),
        views=(FrameContext(body=body, camera=camera, keypoints=keypoints),),
    )
    kept, where = nothing, joints.new_zeros(0, *joints.shape)
    for poses in flips(cost, segments, x[None], body.bounds, _ALL, _STEPS).split(_AT_ONCE):
        places = body.pose(poses).joints
        missed = torch.where(valid, (camera.project(places).uv - uv).norm(dim=-1), 0.0).amax(-1)
        differs = (places - joints).norm(dim=-1).amax(-1) >= POSES_APART
        left = torch.nonzero((missed <= _MOST_NOISE * sigma) & differs)[:, 0]
        kept, where = torch.cat([kept, poses[left]]), torch.cat([where, places[left]])
        chosen = separated(where, POSES_APART, num, fill=False)
        kept, where = kept[chosen], where[chosen]
        if len(kept) == num:
            break
    return kept
