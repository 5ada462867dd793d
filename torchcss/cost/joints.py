"""Joint correspondences: predicted joint centres against 2D keypoints, with confidences.

For every joint centre that the detector names too, the cost is `1/2 rho(w |r_bar - r|^2)` in pixels
(eq. 5 and 8 [IJRR] with one assignment per node), `w` the keypoint's confidence times the inverse
square of the joint's own spread: detectors place hips and toes less exactly than wrists. A joint
without keypoint is constant zero; a joint that the camera cannot see (behind it) costs as much as
one that is `OUTLIER_LENGTHS` scales away: more than any that is well placed, though not more than
one that lies farther off, since the Lorentzian grows without end.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.robust import Lorentzian, RobustPotential
from torchcss.types import PointCost
from torchcss.vision.camera import Camera, Projection

SPREAD = {
    "hip": 2.0,
    "shoulder": 1.3,
    "nose": 1.3,
    "eye": 1.5,
    "ear": 1.5,
    "skullbase": 1.5,
    "vc7": 1.3,
    "skull_tip": 1.5,
    "toe": 1.5,
    "heel": 1.5,
    "midtarsal": 1.5,
    "HumanoidRoot": 1.5,
    "vt1": 1.3,
}
"""Spread of a keypoint relative to a wrist's, by the joint's name without its side. Detectors mark
hips and face on the surface, not at the joint (measured in the data's READMEs: 10 px against 6)."""

OUTLIER_LENGTHS = 10.0
_FAR_PX = 1e8


class JointObservation:
    """Keypoints of one frame matched to the joint centres of a body.

    Args:
        joint_names: Names of the body's joint centres.
        keypoints: Detected positions, pixels, in the order of `keypoint_names`.
        confidence: Confidence in [0, 1]; 0 where there is none.
        keypoint_names: Names of the keypoints; those that the body lacks are left out.
        relative_noise: Noise of these keypoints in multiples of `JointTerm.sigma`: views in which
            the person is larger have more pixels of noise.

    Attributes:
        index: Joint centre of every correspondence.
        target: Where it should project, pixels.
        weight: Confidence over squared spread, the latter in multiples of `JointTerm.sigma`.
    """

    def __init__(
        self,
        joint_names: tuple[str, ...],
        keypoints: Float[Tensor, "j 2"],
        confidence: Float[Tensor, " j"],
        keypoint_names: tuple[str, ...],
        *,
        relative_noise: float = 1.0,
    ) -> None:
        pairs = [
            (joint_names.index(name), column)
            for column, name in enumerate(keypoint_names)
            if name in joint_names
        ]
        device = keypoints.device
        columns = torch.tensor([column for _, column in pairs], dtype=torch.long, device=device)
        spread = [_spread(keypoint_names[column]) for _, column in pairs]
        self.index: Int[Tensor, " m"] = torch.tensor(
            [joint for joint, _ in pairs], dtype=torch.long, device=device
        )
        target, confidence = keypoints[columns], confidence[columns]
        known = (confidence > 0) & target.isfinite().all(-1)
        self.target: Float[Tensor, "m 2"] = torch.where(known[:, None], target, 0.0)
        weight = torch.where(known, confidence.clamp(0, 1), 0.0)
        noise = relative_noise * keypoints.new_tensor(spread)
        self.weight: Float[Tensor, " m"] = weight / noise.square()

    @property
    def says_nothing(self) -> bool:
        """Whether it has no keypoint of this body, as in a frame in which nobody was detected."""
        return not bool((self.weight > 0).any())


def _error(uv: Float[Tensor, "*batch m 2"], observation: JointObservation) -> Tensor:
    """Distance in the image; beyond all images it is cut off, lest its square overflow."""
    return (uv - observation.target).clamp(-_FAR_PX, _FAR_PX)


def _spread(name: str) -> float:
    return SPREAD.get(name, SPREAD.get(name.split("_", 1)[-1], 1.0))


@dataclass(frozen=True, kw_only=True)
class JointTerm:
    """The robust joint-correspondence cost.

    Attributes:
        sigma: Scale of the keypoint noise of a wrist, pixels.
        nu: Level of the outliers, nats per joint: the cost grows as nu log(error / sigma).
        potential_kind: The potential rho.
    """

    sigma: float = 3.0
    nu: float = 8.0
    potential_kind: type = Lorentzian

    @property
    def potential(self) -> RobustPotential:
        """`rho` on the squared error in pixels; its curvature at zero is that of sigma."""
        return self.potential_kind(nu=self.nu, sigma=self.sigma * self.nu**0.5)

    def value(
        self, projection: Projection, observation: JointObservation
    ) -> Float[Tensor, "*batch m"]:
        """Cost of every correspondence, nats.

        Args:
            projection: Where the joint centres of the observation project.
            observation: The keypoints.
        """
        error = _error(projection.uv, observation)
        squared = observation.weight * error.square().sum(-1)
        rho = self.potential(squared).rho
        return 0.5 * torch.where(projection.valid, rho, self._unseen(observation))

    def point_cost(
        self,
        points_world: Float[Tensor, "*batch m 3"],
        camera: Camera,
        observation: JointObservation,
        *,
        gauss_newton: bool = False,
    ) -> PointCost:
        """The same with first and second derivatives in the joint centres' positions.

        Args:
            points_world: The joint centres of the observation, metres.
            camera: The camera whose pixels the observation is in.
            observation: The keypoints.
            gauss_newton: Leave out the curvature of the projection, eq. 9 [RR].
        """
        model = camera.project_with_derivatives(points_world)
        error = _error(model.uv, observation)
        weight = observation.weight
        rho, first, second = self.potential(weight * error.square().sum(-1))
        value = 0.5 * torch.where(model.valid, rho, self._unseen(observation))
        gradient = (first * weight)[..., None] * error
        outer = error[..., :, None] * error[..., None, :]
        hessian = (first * weight)[..., None, None] * torch.eye(
            2, dtype=error.dtype, device=error.device
        )
        hessian = hessian + (2 * second * weight.square())[..., None, None] * outer
        return camera.pull_back(model, value, gradient, hessian, gauss_newton=gauss_newton)

    def _unseen(self, observation: JointObservation) -> Tensor:
        far = observation.weight * (OUTLIER_LENGTHS * self.sigma) ** 2
        return self.potential(far).rho
