"""The study problem of section 7 [IJRR]: which poses explain the image joints of one body?

Table 1 of [IJRR] counts the minima of "3D joint to image joint" likelihoods, without any image:

    f(x) = sum_j 1/2 rho(|P(p_j(x)) - u_j|^2 / sigma^2)
         + sum_i 1/2 rho_s(((x_i - mu_i) / sigma_i)^2)

the reprojection error of the joint centres `p_j` in units of the pixel noise `sigma`, and the
sticky priors on hard-to-see parameters. It is the tracker's cost of keypoints and priors alone.
Joint limits are hard, lengths are known. One camera sees little of depth, so that every limb may
bend towards it or away: the cost has very many minima.

`study_problem("body34", generator=...)` draws one such problem: a plausible pose, its noisy image,
the cost, and the start mode, which is the minimum that the truth descends to, with its covariance.
The same generator state gives the same problem, whatever the noise and the potential.

The camera has 1920 x 1080 pixels and a view of 54 degrees; the body stands 3.5 m before it, which
fills the image's height. With a pixel of noise the standard deviations of the start mode then
spread about as far as in Fig. 5 [IJRR] (`scripts/spectra.py` measures it). Three pixels halve that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.fused import engine_for
from torchcss.cost.joints import SPREAD, JointTerm, spread_of
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.total import TrackingCost
from torchcss.errors import BodyError
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.robust import Lorentzian, Quadratic, RobustPotential
from torchcss.types import Bounds, Keypoints, Modes, Vector, frozen
from torchcss.vision.camera import Camera

WIDTH, HEIGHT, FOCAL_PX = 1920, 1080, 1900.0
DISTANCE = 3.5
"""From the camera to the body's root, metres."""

ROBUST_NU = 8.0
"""Level of the outliers of the robust variant, nats per joint."""

ROOT_DEVIATION = {
    "root_x": 0.1, "root_y": 0.1, "root_z": 0.3,
    "root_yaw": 0.8, "root_pitch": 0.15, "root_roll": 0.15,
}  # fmt: skip
"""Standard deviations of the root of plausible poses, metres and radians: about upright, facing the
camera or turned sideways. The other parameters are drawn from their sticky priors."""

CLICKED_JOINTS = (
    "HumanoidRoot", "vt1", "skull_tip", "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow",
    "r_wrist", "l_hip", "l_knee", "l_ankle", "r_hip", "r_knee", "r_ankle",
)  # fmt: skip
"""What one would click: the ends of trunk, head and limbs."""

_FACE = ("nose", "l_eye", "r_eye", "l_ear", "r_ear")
_FOOT = ("l_heel", "r_heel", "l_midtarsal", "r_midtarsal")


@frozen
class StudyChoice:
    """What the problem of a study is like.

    Attributes:
        pixel_noise: Standard deviation of every image coordinate, pixels.
        prior_scale: Factor on the deviations of the stabilisers, which are a tracker's. The pose
            is drawn with the factor one.
        widest: Largest standard deviation of a parameter of the start mode; by default the
            optimiser's, a quarter of its range.
        limits: Whether the joint limits hold.
        robust: Lorentzian reprojection error instead of a quadratic one.
        all_joints: All joint centres but those of face and foot are seen, not `CLICKED_JOINTS`
            alone; an arm shows all that it has.
    """

    pixel_noise: float = 3.0
    prior_scale: float = 1.0
    widest: float | None = None
    limits: bool = True
    robust: bool = False
    all_joints: bool = False

    @property
    def potential(self) -> RobustPotential:
        """`rho` of the squared error in units of the noise."""
        return Lorentzian(nu=ROBUST_NU, sigma=ROBUST_NU**0.5) if self.robust else Quadratic()


class ReprojectionProblem(NamedTuple):
    """One problem of the study.

    Attributes:
        choice: What it is like.
        body: The body, hung before the camera.
        camera: The camera.
        truth: The pose that made the observations.
        joint_names: Names of the observed joint centres.
        observed: Where they appear, noise included, pixels.
        cost: What to minimise.
        bounds: The joint limits.
        start: The minimum that the truth descends to; `mean`, `covariance` (of the free variables,
            decision "active bounds") and `cost` are those of the start mode.
    """

    choice: StudyChoice
    body: BodyModel
    camera: Camera
    truth: Vector
    joint_names: tuple[str, ...]
    observed: Float[Tensor, "j 2"]
    cost: TrackingCost
    bounds: Bounds
    start: Modes


def study_problem(
    body_name: str = "body34",
    *,
    generator: torch.Generator,
    choice: StudyChoice | None = None,
    pose: dict[str, float] | None = None,
) -> ReprojectionProblem:
    """Draw a pose, its image, and make the problem of finding it again.

    Args:
        body_name: A body of the catalogue.
        generator: Source of the pose and of the noise.
        choice: What the problem is like.
        pose: Parameters by name instead of a pose drawn; the others are zero.

    Raises:
        BodyError: If the body has no such parameter.
    """
    choice = choice or StudyChoice()
    body = load_body(body_name)
    place = torch.tensor([0.0, 0.0, -DISTANCE], dtype=torch.float64)
    body = body.with_base(torch.eye(3, dtype=torch.float64), place)
    camera = study_camera("reprojection")
    truth = plausible_pose(body, generator=generator)
    if pose is not None:
        truth = torch.zeros_like(truth)
        truth[body.state_columns(pose)] = truth.new_tensor([*pose.values()])
        truth = body.bounds.project(truth)
    body.sticky_deviation.mul_(choice.prior_scale)
    names = CLICKED_JOINTS
    if choice.all_joints or body_name.startswith("arm"):
        names = tuple(name for name in body.joint_names if name not in (*_FACE, *_FOOT))
    exact = camera.project(body.pose(truth).joints[body.joint_columns(names)]).uv
    noise = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
    observed = exact + choice.pixel_noise * noise
    cost, bounds = _cost(body, camera, names, observed, choice), body.bounds
    if not choice.limits:
        infinite = torch.full_like(truth, math.inf)
        bounds = Bounds(-infinite, infinite)
    variance = None if choice.widest is None else torch.full_like(truth, choice.widest**2)
    start = TrustRegionNewton(max_steps=1000).minimise(cost, truth, bounds, prior_variance=variance)
    return ReprojectionProblem(choice, body, camera, truth, names, observed, cost, bounds, start)


def _cost(
    body: BodyModel,
    camera: Camera,
    names: tuple[str, ...],
    observed: Float[Tensor, "j 2"],
    choice: StudyChoice,
) -> TrackingCost:
    """Reprojection error and sticky priors."""
    # The joint term expects more noise of some joints; their confidences make all alike.
    widest = max(SPREAD.values())
    confidence = [(spread_of(name) / widest) ** 2 for name in names]
    keypoints = Keypoints(observed, observed.new_tensor(confidence), names)
    potential = choice.potential
    joints = JointTerm(
        sigma=choice.pixel_noise / widest, nu=potential.nu, potential_kind=type(potential)
    )
    return TrackingCost(
        choice=CostChoice(terms=(joints, Stabiliser())),
        views=(FrameContext(body=body, camera=camera, keypoints=keypoints),),
        engine=engine_for("fused", "cpu"),
    )


def study_camera(name: str) -> Camera:
    """The camera of the study, at the world's origin: Y is up, and the body is along -Z."""
    K = Camera.pinhole(WIDTH, HEIGHT, focal_px=FOCAL_PX).K
    upright = torch.tensor([1.0, -1.0, -1.0]).diag()
    return Camera(K, (WIDTH, HEIGHT), R_camera_world=upright, name=name)


def plausible_pose(body: BodyModel, *, generator: torch.Generator) -> Vector:
    """Draw every parameter from its sticky prior, cut off at the joint limits.

    Args:
        body: A body of the catalogue.
        generator: Source of the pose.
    """
    deviation = body.sticky_deviation.clone()
    for name, value in ROOT_DEVIATION.items():
        if name in body.state_names:
            deviation[body.state_index(name)] = value
    if not bool(deviation.isfinite().all()):
        raise BodyError(
            f"{body.name}: expected a sticky prior for every joint, which bodies from a URDF lack; "
            "draw the pose yourself"
        )
    low, high = (torch.special.ndtr((end - body.sticky_mean) / deviation) for end in body.bounds)
    share = torch.rand(low.shape, generator=generator, dtype=low.dtype)
    z = torch.special.ndtri(low + share * (high - low))
    return body.bounds.project(body.sticky_mean + deviation * z)
