"""First pose and proportions from 2D joint correspondences in one image (section 5 [IJRR]).

This is the first of the papers' three stages, done simply: joint angles, the place of the body and
its internal proportions (within 10 % of the standard humanoid) are fitted to the keypoints by the
same bound-constrained robust optimisation that tracks, from many starts around the body's vertical
and in random poses, in one batch. The best fit gives the lengths; with them held, all fits are
refined once more and the distinct ones become the mixture that the tracker begins with.

Call `initialise_from_joints`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.catalog import PROPORTIONS
from torchcss.body.model import BodyModel, load_body
from torchcss.body.root import ROOT_NAMES, has_root, move_base, root_pose
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.errors import KeypointError
from torchcss.inference.mixture import GaussianMixture, distinct_modes
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.types import Modes
from torchcss.vision.camera import Camera

LEAST_JOINTS = 3
"""Fewer joints than this fix neither depth nor direction of a body."""


class Initialisation(NamedTuple):
    """Where tracking starts.

    Attributes:
        body: The body with the fitted lengths, hung on the base of the best fit.
        mixture: The distinct fits, best first.
        cost: Their costs, nats.
        report: What was found and assumed, one line each.
    """

    body: BodyModel
    mixture: GaussianMixture
    cost: Float[Tensor, " k"]
    report: tuple[str, ...]


def initialise_from_joints(
    name: str,
    camera: Camera,
    keypoints: Float[Tensor, "j 2"],
    confidence: Float[Tensor, " j"],
    keypoint_names: tuple[str, ...],
    *,
    generator: torch.Generator,
    joints: JointTerm | None = None,
    num_starts: int = 256,
    num_modes: int = 8,
    placed: BodyModel | None = None,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Initialisation:
    """Fit place, pose and lengths of a body to the keypoints of one image.

    Args:
        name: Name of a body that ships, or the path of a URDF (which then must be `placed`).
        camera: The camera; the keypoints are in its pixels.
        keypoints: Pixels.
        confidence: In [0, 1]; 0 where a joint is missing.
        keypoint_names: Canonical joint names.
        generator: Source of the random starting poses.
        joints: The joint term; a default fitted to the size of the person in the image.
        num_starts: Starting poses, optimised in one batch.
        num_modes: Most distinct fits to keep.
        placed: A body whose base and lengths are known: only its own parameters are fitted.
        dtype: Type of the body.
        device: Where to compute.

    Raises:
        KeypointError: If fewer than three joints of the body are seen.
    """
    keypoints = keypoints.to(dtype=dtype, device=device)
    confidence = confidence.to(dtype=dtype, device=device)
    joints = joints or JointTerm(sigma=default_sigma(keypoints[confidence > 0]))
    optimiser = TrustRegionNewton(max_steps=100, tolerance=1e-4)

    def fit(body: BodyModel, starts: Tensor) -> Modes:
        cost = TrackingCost(
            body=body,
            camera=camera,
            choice=CostChoice(contour=None, joints=joints),
            observation=JointObservation(body.joint_names, keypoints, confidence, keypoint_names),
        )
        return optimiser.minimise(cost, starts, body.bounds)

    # Arms are placed by the fit; afterwards their shoulder stays where it was found.
    free = placed or load_body(
        name, dtype=dtype, device=device, free_proportions=True, free_root=True
    )
    observation = JointObservation(free.joint_names, keypoints, confidence, keypoint_names)
    seen = int((observation.weight > 0).sum())
    if seen < LEAST_JOINTS:
        raise KeypointError(
            f"{seen} joints of {name} are marked in the first frame, at least {LEAST_JOINTS} are "
            "needed: start at another frame or mark more joints"
        )
    if placed is not None:
        fits = fit(placed, _starts(placed, num_starts, generator))
        return _as_mixture(placed, fits, num_modes, {})

    free = _hang_before_camera(free, camera, observation)
    fits = fit(free, _starts(free, num_starts, generator))
    best = fits.mean[int(fits.cost.nan_to_num(math.inf).argmin())]
    lengths = {
        name: free.lengths[name] + float(best[free.state_index(f"{name}_length")])
        for name in PROPORTIONS
        if f"{name}_length" in free.state_names
    }
    body = load_body(name, dtype=dtype, device=device, lengths=lengths, free_root=True)
    body = body.with_base(free.base_rotation, free.base_translation)
    body, starts, _ = move_base(body, *root_pose(free, best), _columns(free, body, fits.mean))
    fits = fit(body, starts)
    if name.startswith("arm"):
        # The root of the best fit becomes the arm's base, and only its angles are searched.
        best = fits.mean[int(fits.cost.nan_to_num(math.inf).argmin())]
        arm = load_body(name, dtype=dtype, device=device, lengths=lengths)
        arm = arm.with_base(*root_pose(body, best))
        fits = fit(arm, _columns(body, arm, fits.mean))
        body = arm
    return _as_mixture(body, fits, num_modes, lengths)


def _columns(source: BodyModel, target: BodyModel, x: Tensor) -> Tensor:
    """The parameters of one body out of the states of another that has them too."""
    return x[:, [source.state_index(name) for name in target.state_names]]


def default_sigma(keypoints: Float[Tensor, "j 2"]) -> float:
    """Noise of a detector's keypoints, pixels: 0.6 % of the diagonal of the person's box.

    Detectors err in proportion to the person's size in the image: the beam clip's keypoints, 6 px
    on a person of 950 px, set the ratio. At least one pixel.
    """
    if len(keypoints) < 2:
        return 3.0
    diagonal = (keypoints.max(dim=0).values - keypoints.min(dim=0).values).norm()
    return max(1.0, 0.006 * float(diagonal))


def _hang_before_camera(
    body: BodyModel, camera: Camera, observation: JointObservation
) -> BodyModel:
    """Base: upright in the image, facing the camera, as far as the limbs' lengths suggest."""
    seen = observation.weight > 0
    index, target = observation.index[seen], observation.target[seen]
    rest = body.pose(body.rest).joints[index]
    in_body = rest - rest.mean(dim=0)
    on_image = target - target.mean(dim=0)
    extent = on_image.square().sum(-1).mean().sqrt().clamp(min=1.0)
    focal = camera.K.diagonal()[:2].mean().to(extent)
    # Limbs are seldom parallel to the image: seen length is some 0.8 of the true one.
    depth = 0.8 * focal * in_body.square().sum(-1).mean().sqrt() / extent
    centre = camera.unproject(target.mean(dim=0), depth)
    to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0])).to(body.tie)
    rotation = camera.R_camera_world.to(body.tie).T @ to_camera
    return body.with_base(rotation, centre - rotation @ rest.mean(dim=0))


def _starts(body: BodyModel, num: int, generator: torch.Generator) -> Float[Tensor, "b n"]:
    """Poses all around the vertical, spread about the stabilisers' rest values."""
    size = (num, body.num_parameters)
    noise = torch.randn(size, generator=generator, dtype=torch.float64).to(body.tie)
    spread = torch.where(body.sticky_deviation.isfinite(), body.sticky_deviation, 0.3)
    x = body.sticky_mean + 0.6 * spread * noise
    if has_root(body):
        columns = [body.state_index(name) for name in ROOT_NAMES]
        x[:, columns] = 0.1 * noise[:, columns]
        turn = torch.arange(num, device=x.device).to(x) * (2 * math.pi / num)
        x[:, body.state_index("root_yaw")] = torch.remainder(turn + math.pi, 2 * math.pi) - math.pi
    return body.bounds.project(x)


def _as_mixture(
    body: BodyModel, fits: Modes, num_modes: int, lengths: dict[str, float]
) -> Initialisation:
    keep = distinct_modes(fits.mean, fits.covariance, fits.cost)[:num_modes]
    mean, covariance, cost = fits.mean[keep], fits.covariance[keep], fits.cost[keep]
    if has_root(body):
        body, mean, moved = move_base(body, *root_pose(body, mean[0]), mean, covariance)
        covariance = covariance if moved is None else moved
    mixture = GaussianMixture(mean, covariance, torch.log_softmax(-cost, dim=0))
    report = [
        f"first pose: {len(keep)} distinct fits to the keypoints, best cost {float(cost[0]):.1f}"
    ]
    if lengths:
        fitted = ", ".join(f"{name} {length:.3f} m" for name, length in lengths.items())
        report.append(f"lengths within 10 % of the standard humanoid, which sets scale: {fitted}")
    return Initialisation(body, mixture, cost, tuple(report))
