"""Joint correspondences: predicted joint centres against 2D keypoints, with confidences.

For every joint centre that the detector names too, the cost is `1/2 rho(w |r_bar - r|^2)` in pixels
(eq. 5 and 8 [IJRR] with one assignment per node), `w` the keypoint's confidence times the inverse
square of the joint's own spread: detectors place hips and toes less exactly than wrists. A joint
without keypoint is constant zero; a joint that the camera cannot see (behind it) costs as much as
one that is `OUTLIER_LENGTHS` scales away: more than any that is well placed, though not more than
one that lies farther off, since the Lorentzian grows without end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cost.context import FrameContext
from torchcss.cost.term import Kind, Posed, Term
from torchcss.robust import Lorentzian, RobustPotential
from torchcss.types import Keypoints, PointCost
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
    known = (confidence > 0) & place.isfinite().all(-1)
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


@dataclass(frozen=True, kw_only=True)
class JointTerm(Term):
    """The robust joint-correspondence cost.

    Attributes:
        weight: Factor on the cost, whose nu is in nats already.
        sigma: Scale of the keypoint noise of a wrist, pixels.
        nu: Level of the outliers, nats per joint: the cost grows as nu log(error / sigma).
        potential_kind: The potential rho.
    """

    name: ClassVar[str] = "joints"
    kind: ClassVar[Kind] = "image"
    watched: ClassVar[bool] = True

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

    def prepare(self, context: FrameContext) -> BoundJoints | None:
        """Bind the term to the keypoints of a frame; None without any."""
        if context.keypoints is None:
            return None
        targets = match_joints(context.keypoints, context.body.joint_names)
        return BoundJoints(self, targets, context.body.marker_link[targets.joint])

    def value(self, projection: Projection, targets: JointTargets) -> Float[Tensor, "*batch m"]:
        """Cost of every correspondence, nats.

        Args:
            projection: Where the joint centres of the targets project.
            targets: The keypoints, matched to the body.
        """
        error = _error(projection.uv, targets)
        squared = targets.weight * error.square().sum(-1)
        rho = self.potential(squared).rho
        return 0.5 * torch.where(projection.valid, rho, self._unseen(targets))

    def point_cost(
        self,
        points_world: Float[Tensor, "*batch m 3"],
        camera: Camera,
        targets: JointTargets,
        *,
        gauss_newton: bool = False,
    ) -> PointCost:
        """The same with first and second derivatives in the joint centres' positions.

        Args:
            points_world: The joint centres of the targets, metres.
            camera: The camera whose pixels the targets are in.
            targets: The keypoints, matched to the body.
            gauss_newton: Leave out the curvature of the projection, eq. 9 [RR].
        """
        model = camera.project_with_derivatives(points_world)
        error = _error(model.uv, targets)
        weight = targets.weight
        rho, first, second = self.potential(weight * error.square().sum(-1))
        value = 0.5 * torch.where(model.valid, rho, self._unseen(targets))
        gradient = (first * weight)[..., None] * error
        outer = error[..., :, None] * error[..., None, :]
        hessian = (first * weight)[..., None, None] * torch.eye(
            2, dtype=error.dtype, device=error.device
        )
        hessian = hessian + (2 * second * weight.square())[..., None, None] * outer
        return camera.pull_back(model, value, gradient, hessian, gauss_newton=gauss_newton)

    def _unseen(self, targets: JointTargets) -> Tensor:
        far = targets.weight * (OUTLIER_LENGTHS * self.sigma) ** 2
        return self.potential(far).rho


@dataclass(frozen=True, eq=False)
class BoundJoints:
    """The keypoints of a frame; a `BoundImage`."""

    term: JointTerm
    targets: JointTargets
    link: Int[Tensor, " m"]
    size: int = 0

    @property
    def scale(self) -> float:
        """Factor on the nats of a joint."""
        return self.term.weight

    def points(self, posed: Posed) -> Float[Tensor, "*batch m 3"]:
        """The joint centres that have keypoints."""
        return posed.pose.joints[..., self.targets.joint, :]

    def value(
        self, posed: Posed, at: Float[Tensor, "*batch m 3"] | None = None
    ) -> Float[Tensor, "*batch m"]:
        """Cost of every joint."""
        points = self.points(posed) if at is None else at
        return self.term.value(posed.camera.project(points), self._of_samples(posed))

    def point_cost(self, posed: Posed, *, gauss_newton: bool = False) -> PointCost:
        """Cost and derivatives of every joint."""
        targets, points = self._of_samples(posed), self.points(posed)
        return self.term.point_cost(points, posed.camera, targets, gauss_newton=gauss_newton)

    def _of_samples(self, posed: Posed) -> JointTargets:
        joint, position, weight = self.targets
        if weight.dim() == 1:
            return self.targets
        return JointTargets(joint, posed.of_parent(position), posed.of_parent(weight))
