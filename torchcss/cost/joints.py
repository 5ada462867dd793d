"""Joint correspondences: predicted joint centres against 2D keypoints, with confidences.

For every joint centre that the detector names too, the cost is `1/2 rho(w |r_bar - r|^2)` in pixels
(eq. 5 and 8 [IJRR] with one assignment per node), `w` the keypoint's confidence times the inverse
square of the joint's own spread: detectors place hips and toes less exactly than wrists. A joint
without keypoint is constant zero; a joint that the camera cannot see (behind it) costs as much as
one that is `OUTLIER_LENGTHS` scales away: more than any that is well placed, though not more than
one that lies farther off, since the Lorentzian grows without end.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cost.context import FrameContext
from torchcss.cost.term import OnPoints, Posed, Term
from torchcss.robust import Lorentzian, RobustPotential, residual_cost
from torchcss.types import Keypoints, PointCost, frozen
from torchcss.vision.camera import Camera

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

COARSE_SCALE = 6.0
"""How much farther off a keypoint may be in the coarse cost before it counts as an outlier. Their
noise stays what it is: were it so much wider, the temporal prior would hold every limb back."""

OUTLIER_LENGTHS = 10.0
_FAR_PX = 1e8


class JointTargets(NamedTuple):
    """Keypoints of one frame matched to the joint centres of a body.

    Attributes:
        joint: Joint centre of every correspondence.
        position: Where it should project, pixels.
        weight: Confidence over squared spread, the latter in multiples of `JointTerm.sigma`.
    """

    joint: Int[Tensor, " m"]
    position: Float[Tensor, "*b m 2"]
    weight: Float[Tensor, "*b m"]


def match_joints(keypoints: Keypoints, joint_names: tuple[str, ...]) -> JointTargets:
    """Match keypoints to the joint centres of a body; those that the body lacks are left out.

    Args:
        keypoints: Those of one frame, or of one for each sample.
        joint_names: Names of the body's joint centres.
    """
    columns, joints, spread = _pairs(keypoints.names, joint_names)
    place, confidence = keypoints.positions[..., columns, :], keypoints.confidence[..., columns]
    known = keypoints.known[..., columns]
    weight = torch.where(known, confidence.clamp(0, 1), 0.0)
    noise = keypoints.relative_noise * place.new_tensor(spread)
    return JointTargets(
        torch.tensor(joints, dtype=torch.long, device=place.device),
        torch.where(known[..., None], place, 0.0),
        weight / noise.square(),
    )


@cache
def _pairs(
    names: tuple[str, ...], joint_names: tuple[str, ...]
) -> tuple[list[int], list[int], list[float]]:
    """Columns of keypoints that a body has, its joints, and their spread."""
    columns = [column for column, name in enumerate(names) if name in joint_names]
    joints = [joint_names.index(names[column]) for column in columns]
    return columns, joints, [_spread(names[column]) for column in columns]


def _error(uv: Float[Tensor, "*batch m 2"], targets: JointTargets) -> Tensor:
    """Distance in the image; beyond all images it is cut off, lest its square overflow."""
    return (uv - targets.position).clamp(-_FAR_PX, _FAR_PX)


def _spread(name: str) -> float:
    return SPREAD.get(name, SPREAD.get(name.split("_", 1)[-1], 1.0))


@frozen
class JointTerm(Term):
    """The robust joint-correspondence cost.

    Attributes:
        weight: Factor on the cost, whose nu is in nats already.
        sigma: Scale of the keypoint noise of a wrist, pixels.
        nu: Level of the outliers, nats per joint: the cost grows as nu log(error / sigma).
        potential_kind: The potential rho.
    """

    name = "joints"
    kind = "image"
    watched = True
    of_several = True

    weight: float = 1.0
    sigma: float = 3.0
    nu: float = 8.0
    potential_kind: type = Lorentzian

    @property
    def potential(self) -> RobustPotential:
        """`rho` on the squared error in pixels; its curvature at zero is that of sigma."""
        return self.potential_kind(nu=self.nu, sigma=self.sigma * self.nu**0.5)

    def coarse(self) -> JointTerm:
        """The same term for which hardly a keypoint is an outlier, see `COARSE_SCALE`."""
        return replace(self, nu=COARSE_SCALE**2 * self.nu)

    def prepare(self, context: FrameContext) -> OnPoints | None:
        """Bind the term to the keypoints of a frame; None without any."""
        if context.keypoints is None:
            return None
        targets = match_joints(context.keypoints, context.body.joint_names)
        return OnPoints(
            term=self,
            find=lambda posed: posed.pose.joints[..., targets.joint, :],
            image=targets,
            link=context.body.marker_link[targets.joint],
            scale=self.weight,
            size=0,
            of_parents=None if targets.weight.dim() == 1 else _of_parents,
        )

    def value(
        self,
        points: Float[Tensor, "*batch m 3"],
        camera: Camera,
        targets: JointTargets,
        at: Float[Tensor, "*batch m 3"] | None = None,
    ) -> Float[Tensor, "*batch m"]:
        """Cost of every correspondence, nats.

        Args:
            points: The joint centres of the targets, metres.
            camera: The camera whose pixels the targets are in.
            targets: The keypoints, matched to the body.
            at: Where the joint centres have moved since; None: nowhere.
        """
        projection = camera.project(points if at is None else at)
        squared = targets.weight * _error(projection.uv, targets).square().sum(-1)
        rho = self.potential(squared).rho
        return torch.where(projection.valid, 0.5 * rho, self._unseen(targets))

    def point_cost(
        self,
        points: Float[Tensor, "*batch m 3"],
        camera: Camera,
        targets: JointTargets,
        *,
        gauss_newton: bool = False,
    ) -> PointCost:
        """The same with first and second derivatives in the joint centres' positions.

        Args:
            points: The joint centres of the targets, metres.
            camera: The camera whose pixels the targets are in.
            targets: The keypoints, matched to the body.
            gauss_newton: Leave the curvature of the projection out.
        """
        model = camera.project_with_derivatives(points)
        cost, gradient, hessian = residual_cost(
            self.potential, _error(model.uv, targets), targets.weight
        )
        value = torch.where(model.valid, cost, self._unseen(targets))
        return camera.pull_back(model, value, gradient, hessian, gauss_newton=gauss_newton)

    def _unseen(self, targets: JointTargets) -> Tensor:
        far = targets.weight * (OUTLIER_LENGTHS * self.sigma) ** 2
        return 0.5 * self.potential(far).rho


def _of_parents(posed: Posed, targets: JointTargets) -> JointTargets:
    joint, position, weight = targets
    return JointTargets(joint, posed.of_parent(position), posed.of_parent(weight))
