"""Jumps to the other poses that project to the same places: what one camera cannot tell apart.

A limb that comes towards the camera looks like one that goes away from it. Between the two lies a
wall of cost that samples about a mode seldom cross, but where the other pose is can be computed:
it is a forward-backward flip (`torchcss.body.flips`), as in initialisation. `with_flips` puts the
flips of the best mode among the modes from which a tracker samples, so that every one of them is
descended from in the next frame; the image decides what remains (Sminchisescu and Triggs,
Kinematic Jump Processes, CVPR 2003, do so for every sample).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.flips import Segments
from torchcss.body.model import BodyModel
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.tracker import TrackerState
from torchcss.interpretations import flips
from torchcss.vision.camera import Camera

_NOISE = 0.02
"""Scale by which flips are judged, as a share of the body's extent in the image."""


def with_flips(
    state: TrackerState, body: BodyModel, camera: Camera, *, num: int, log_odds: float = -5.0
) -> TrackerState:
    """A tracker's state with the flips of its best mode among its modes.

    Args:
        state: Where the last frame left off, the best mode first.
        body: The body on the state's base.
        camera: Any camera of the view.
        num: Most flips wanted.
        log_odds: Their weight against that of the best mode, nats. Low odds spend one sample on
            each, and make the image's evidence outweigh a jump before it leads.
    """
    mixture = state.mixture
    x = flipped_poses(body, camera, mixture.mean[0], num=num)
    like = mixture.take(torch.zeros(len(x), dtype=torch.long, device=x.device))
    joined = GaussianMixture(
        torch.cat([mixture.mean, x]),
        torch.cat([mixture.covariance, like.covariance]),
        torch.cat([mixture.log_weight, like.log_weight + log_odds]),
    )
    velocity = torch.cat([state.velocity, torch.zeros_like(x)])
    # Particles are of the old modes; a filter draws new ones from the mixture.
    return state._replace(mixture=joined.normalise(), velocity=velocity, particles=None)


def flipped_poses(
    body: BodyModel, camera: Camera, x: Float[Tensor, " n"], *, num: int
) -> Float[Tensor, "s n"]:
    """Other poses whose joints project to where a pose's do, the most plausible first.

    Args:
        body: The body; the poses obey its joint limits.
        camera: Any camera of the view.
        x: The pose.
        num: Most poses wanted.

    Returns:
        The poses, the given one among them if it is as plausible; none for a body without limbs
        that can flip.
    """
    segments = Segments(body)
    if not segments.limbs or num < 1:
        return x.new_zeros(0, len(x))
    uv, _, valid = camera.project(body.pose(x).joints)
    if not bool(valid.any()):
        return x.new_zeros(0, len(x))
    extent = float((uv[valid].amax(0) - uv[valid].amin(0)).max())
    cost = TrackingCost(
        body=body,
        camera=camera,
        choice=CostChoice(contour=None, joints=JointTerm(sigma=max(1.0, _NOISE * extent))),
        observation=JointObservation(body.joint_names, uv, valid.to(uv), body.joint_names),
    )
    return flips(cost, segments, x[None], body.bounds, num)
