"""The study problem of section 7 [IJRR]: which poses explain the image joints of one body?

Table 1 of [IJRR] counts the minima of "3D joint to image joint" likelihoods, without any image:

    f(x) = sum_j 1/2 rho(|P(p_j(x)) - u_j|^2 / sigma^2)
         + sum_i 1/2 rho_s(((x_i - mu_i) / sigma_i)^2)

the reprojection error of the joint centres `p_j` in units of the pixel noise `sigma`, and the
sticky priors on hard-to-see parameters. Joint limits are hard, lengths are known. One camera sees
little of depth, so that every limb may bend towards it or away: the cost has very many minima.

`reprojection_problem("body34", generator=...)` draws one such problem: a plausible pose, its noisy
image, the cost, and the start mode, which is the minimum that the truth descends to, with its
covariance. The same generator state gives the same problem, whatever the noise and the potential.

The camera has 1920 x 1080 pixels and a view of 54 degrees; the body stands 3.5 m before it, which
fills the image's height. With a pixel of noise the standard deviations of the start mode then
spread about as far as in Fig. 5 [IJRR] (`scripts/spectra.py` measures it). Three pixels halve that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.kinematics import TreePose
from torchcss.body.lift import lift_to_joints
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.stabiliser import Stabiliser
from torchcss.errors import BodyError, CameraError, check_shape
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.robust import Lorentzian, Quadratic, RobustPotential
from torchcss.types import (
    BlendedCost,
    Bounds,
    LocalModel,
    Modes,
    Numbers,
    PointCost,
    Vector,
    Vectors,
    frozen,
)
from torchcss.vision.camera import Camera

WIDTH, HEIGHT, FOCAL_PX = 1920, 1080, 1900.0
DISTANCE = 3.5
"""From the camera to the body's root, metres."""

ROOT_DEVIATION = {
    "root_x": 0.1, "root_y": 0.1, "root_z": 0.3,
    "root_yaw": 0.8, "root_pitch": 0.15, "root_roll": 0.15,
}  # fmt: skip
"""Standard deviations of the root of plausible poses, metres and radians: about upright, facing the
camera or turned sideways. The other parameters are drawn from their sticky priors."""

_FACE = ("nose", "l_eye", "r_eye", "l_ear", "r_ear")
_FOOT = ("l_heel", "r_heel", "l_midtarsal", "r_midtarsal")

STATES_AT_ONCE = 1024
"""States evaluated at a time: small enough for the caches, large enough to hide call overhead."""
_VECTOR = 32
"""A batch is filled up to a multiple of this, so that an item's bits do not depend on its place."""


@frozen
class ReprojectionCost(BlendedCost):
    """Reprojection error of joint centres and sticky priors; a `CostFunction`.

    A joint that the camera cannot see (behind it) costs as much as one that is missed by the
    image's diagonal.

    Attributes:
        body: The body, hung on its base.
        camera: The camera.
        index: Which of the body's joint centres are observed.
        target: Where, pixels.
        pixel_noise: Standard deviation of each coordinate, pixels.
        potential: `rho` of the squared error in units of the noise.
        nu: Height of the tails of the sticky priors, nats.
        focal: Focal lengths in units of the noise, plain numbers.
    """

    body: BodyModel
    camera: Camera
    index: Int[Tensor, " j"]
    target: Float[Tensor, "j 2"]
    pixel_noise: float
    potential: RobustPotential = Quadratic()
    nu: float = Stabiliser.nu
    focal: tuple[float, float] = field(init=False)

    def __post_init__(self) -> None:
        if self.camera.has_distortion:
            raise CameraError(
                f"{self.camera.name}: expected a camera without lens distortion, got "
                f"{self.camera.distortion.tolist()}; undistort the observations first"
            )
        focal_u, focal_v = (self.camera.K.diagonal()[:2] / self.pixel_noise).tolist()
        object.__setattr__(self, "focal", (focal_u, focal_v))

    def take(self, items: Int[Tensor, " b"]) -> ReprojectionCost:
        """The cost restricted to some samples: the same for all of them."""
        return self

    def to(self, dtype: torch.dtype) -> ReprojectionCost:
        """The same cost in another floating type."""
        body = self.body.with_base(self.body.base_rotation, self.body.base_translation)
        return replace(self, body=body.to(dtype), target=self.target.to(dtype))

    def value(self, x: Vectors) -> Numbers:
        """Cost in nats."""
        return self._chunked(lambda part, _: (self._value(part),), x)[0]

    def local_model(self, x: Vectors) -> LocalModel:
        """Cost, gradient and exact Hessian."""
        return LocalModel(*self._chunked(lambda part, _: self._local_model(part, None), x))

    def blended_model(self, x: Vectors, share: Numbers) -> LocalModel:
        """The same with a Hessian between Gauss-Newton, never negative, and the exact one.

        Args:
            x: States.
            share: Factor on the parts of the Hessian that may be negative: the second derivatives
                of kinematics, projection and potentials. 1 is exact.
        """
        return LocalModel(*self._chunked(self._local_model, x, share))

    def _chunked(
        self,
        evaluate: Callable[[Tensor, Tensor], tuple[Tensor, ...]],
        x: Vectors,
        share: Numbers | None = None,
    ) -> tuple[Tensor, ...]:
        check_shape("x", x, self.body.num_parameters)
        batch, n = x.shape[:-1], x.shape[-1]
        flat = x.reshape(batch.numel(), n)
        share = x.new_ones(len(flat)) if share is None else share.reshape(len(flat))
        # Sums over rows of any other length round the last items of a batch differently.
        missing = -len(flat) % _VECTOR
        flat = torch.cat([flat, flat[-1:].expand(missing, n)])
        share = torch.cat([share, share[-1:].expand(missing)])
        pairs = zip(flat.split(STATES_AT_ONCE), share.split(STATES_AT_ONCE), strict=True)
        parts = list(zip(*(evaluate(*pair) for pair in pairs), strict=True))
        whole = (part[0] if len(part) == 1 else torch.cat(part) for part in parts)
        return tuple(part[: batch.numel()].reshape((*batch, *part.shape[1:])) for part in whole)

    def _pose(self, x: Float[Tensor, "b n"]) -> tuple[TreePose, Float[Tensor, "3 j b"]]:
        """The tree and the observed joint centres in the camera's frame, the batch innermost."""
        body, turn = self.body, self.camera.R_camera_world.to(x)
        origin = turn @ body.base_translation + self.camera.t_camera_world.to(x)
        base = torch.cat([turn @ body.base_rotation, origin[:, None]], 1)
        q = x if body.is_untied else x @ body.tie.T + body.offset
        frames = body.tree.frames(q, base)
        points = body.tree.points(
            frames, body.marker_link[self.index], body.marker_offset[self.index]
        )
        return body.tree.at_base(frames), points.transpose(0, 1)

    def _image(self, points: Float[Tensor, "3 j b"]) -> tuple[Tensor, ...]:
        """Normalised coordinates and inverse depth (0 where invalid), errors in units of noise."""
        camera, noise = self.camera, self.pixel_noise
        x, y, z = points
        valid = z > camera.near
        w = torch.where(valid, torch.where(valid, z, 1.0).reciprocal(), 0.0)
        a, b = x * w, y * w
        focal_u, focal_v = self.focal
        shift = (camera.K[:2, 2].to(self.target) - self.target) / noise
        width, height = (side / noise for side in camera.image_size_wh)
        u = torch.where(valid, focal_u * a + shift[:, :1], width)
        v = torch.where(valid, focal_v * b + shift[:, 1:], height)
        return a, b, w, u, v

    def _value(self, x: Float[Tensor, "b n"]) -> Float[Tensor, " b"]:
        *_, u, v = self._image(self._pose(x)[1])
        return 0.5 * self.potential(u * u + v * v).rho.sum(0) + self._prior(x, None)[0]

    def _local_model(self, x: Float[Tensor, "b n"], share: Float[Tensor, " b"] | None):
        """Value, gradient and Hessian; without `share` the exact one."""
        tree, points = self._pose(x)
        a, b, w, u, v = self._image(points)
        rho, first, second = self.potential(u * u + v * v)
        bend = 2.0 * second if share is None else (2.0 * share) * second
        # Derivatives in the normalised coordinates (a, b), then in the point: da = w (1, 0, -a).
        focal_u, focal_v = self.focal
        g_a, g_b = focal_u * first * u, focal_v * first * v
        h_aa = focal_u**2 * (first + bend * u * u)
        h_ab = (focal_u * focal_v) * (bend * u * v)
        h_bb = focal_v**2 * (first + bend * v * v)
        along = a * g_a + b * g_b
        gradient = torch.stack([w * g_a, w * g_b, -w * along])
        w2 = w * w
        curl = w2 if share is None else w2 * share
        h_a, h_b = a * h_aa + b * h_ab, a * h_ab + b * h_bb
        xx, xy, yy = w2 * h_aa, w2 * h_ab, w2 * h_bb
        xz, yz = -(w2 * h_a + curl * g_a), -(w2 * h_b + curl * g_b)
        zz = w2 * (a * h_a + b * h_b) + 2.0 * curl * along
        hessian = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).unflatten(0, (3, 3))
        body = self.body
        model = lift_to_joints(
            body.tree,
            tree,
            points.permute(2, 1, 0),
            body.marker_link[self.index],
            PointCost(0.5 * rho.T, gradient.permute(2, 1, 0), hessian.permute(3, 2, 0, 1)),
            second_order_kinematics=True if share is None else share,
        )
        model = body.tied(model)
        value, slope, curvature = self._prior(x, share)
        model.hessian.diagonal(dim1=-2, dim2=-1).add_(curvature)
        return LocalModel(model.value + value, model.gradient + slope, model.hessian)

    def _prior(self, x: Float[Tensor, "b n"], share: Float[Tensor, " b"] | None):
        """The sticky prior: value, gradient and the diagonal of its Hessian."""
        inverse = self.body.sticky_deviation.reciprocal()
        z = (x - self.body.sticky_mean) * inverse
        z2 = z * z
        rho, first, second = Lorentzian(nu=self.nu, sigma=self.nu**0.5)(z2)
        bend = 2.0 * second if share is None else (2.0 * share[:, None]) * second
        return 0.5 * rho.sum(-1), first * z * inverse, (first + bend * z2) * inverse.square()


class ReprojectionProblem(NamedTuple):
    """One problem of the study.

    Attributes:
        truth: The pose that made the observations.
        joint_names: Names of the observed joint centres.
        cost: What to minimise; it holds the body, hung before the camera, and what was observed.
        bounds: The joint limits.
        start: The minimum that the truth descends to; `mean`, `covariance` (of the free variables,
            decision "active bounds") and `cost` are those of the start mode.
    """

    truth: Vector
    joint_names: tuple[str, ...]
    cost: ReprojectionCost
    bounds: Bounds
    start: Modes


def reprojection_problem(
    body_name: str = "body34",
    *,
    generator: torch.Generator,
    pixel_noise: float = 1.0,
    potential: RobustPotential | None = None,
    joint_names: tuple[str, ...] | None = None,
) -> ReprojectionProblem:
    """Draw a pose, its image, and make the problem of finding it again.

    Args:
        body_name: A body of the catalogue.
        generator: Source of the pose and of the noise.
        pixel_noise: Standard deviation of every image coordinate, pixels.
        potential: `rho` of the squared error in units of the noise; `Quadratic()` by default.
        joint_names: The observed joint centres; all but those of face and foot by default.

    Raises:
        BodyError: If the body lacks one of the joints.
    """
    body = load_body(body_name)
    place = torch.tensor([0.0, 0.0, -DISTANCE], dtype=torch.float64)
    body = body.with_base(torch.eye(3, dtype=torch.float64), place)
    camera = study_camera("reprojection")
    truth = plausible_pose(body, generator=generator)
    names = joint_names or tuple(n for n in body.joint_names if n not in (*_FACE, *_FOOT))
    index = torch.tensor(body.joint_columns(names))
    exact = camera.project(body.pose(truth).joints[index]).uv
    noise = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
    cost = ReprojectionCost(
        body=body,
        camera=camera,
        index=index,
        target=exact + pixel_noise * noise,
        pixel_noise=pixel_noise,
        potential=Quadratic() if potential is None else potential,
    )
    start = TrustRegionNewton(max_steps=1000).minimise(cost, truth, body.bounds)
    return ReprojectionProblem(truth, names, cost, body.bounds, start)


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
