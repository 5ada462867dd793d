"""The first stage of initialisation: pose and lengths from joint positions (section 5 [IJRR]).

It fits joint angles, the place of the body and its internal proportions (within 10 % of the
standard humanoid, left and right tied) to the joints, with hard joint limits, by the robust
optimisation that tracks (section 4.1), from many starts (`torchcss.initialise.multi_start`),
without the marks that fit no pose (`torchcss.initialise.outliers`). The best fit gives the lengths.
With them held, every fit is refined once more, and the distinct ones become the mixture that the
tracker begins with. Their covariances are those of the pose with the lengths unknown: the inverse
Hessian of pose and lengths together, of which the pose's block is kept.

One image does not tell a large person from a small one farther away: `stature` fixes the scale,
or the view of another camera (`others`), else the anthropometric prior does.

Call `initialise_from_joints`, for the first frame of a video say.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.catalog import ARM_NAMES
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root, move_base, root_pose
from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.cost.view import View
from torchcss.errors import CameraError, ConfigurationError
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.keypoint_checks import check_joints, default_sigma
from torchcss.initialise.multi_start import Search, find_interpretations
from torchcss.initialise.outliers import best_distinct, explain, refine
from torchcss.initialise.result import (
    STANDARD_STATURE,
    Initialisation,
    as_initialisation,
    columns_of,
    fitted_lengths,
    hang_on_best,
    marginal_covariance,
    scale_of,
    scale_report,
    undetermined_line,
)
from torchcss.types import Modes
from torchcss.vision.camera import Camera

LEAST_JOINTS = 3
"""Fewer joints than this fix neither depth nor direction of a body."""


def initialise_from_joints(
    name: str,
    camera: Camera,
    keypoints: Float[Tensor, "j 2"],
    confidence: Float[Tensor, " j"],
    keypoint_names: tuple[str, ...],
    *,
    generator: torch.Generator,
    joints: JointTerm | None = None,
    search: Search | None = None,
    num_modes: int | None = 8,
    stature: float | None = None,
    placed: BodyModel | None = None,
    least_joints: int = LEAST_JOINTS,
    others: Sequence[View] = (),
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Initialisation:
    """Fit place, pose and lengths of a body to the joints of one image: the first stage.

    Args:
        name: Name of a body that ships, or the path of a URDF, MJCF or BVH file.
        camera: The camera; the keypoints are in its pixels.
        keypoints: Pixels.
        confidence: In [0, 1]; 0 where a joint is missing.
        keypoint_names: Canonical joint names.
        generator: Source of the starting poses.
        joints: The joint term; a default fitted to the size of the person in the image.
        search: How widely interpretations are looked for.
        num_modes: Most distinct fits to keep; 1 for the best alone, None for all.
        stature: Height of the standing person, metres, where it is known.
        placed: A body whose base and lengths are known: only its own parameters are fitted.
        least_joints: Fewest joints to accept; with fewer than three much stays at its prior.
        others: What further cameras see at the same time, in the same world; only their keypoints
            matter. Starts and gross marks are looked for in the first camera's view.
        dtype: Type of the body.
        device: Where to compute.

    Raises:
        KeypointError: If fewer than `least_joints` joints of the body are seen, or all at one
            place.
        CameraError: If the camera looks away from a placed body.
        BodyError: If the stature is no person's.
        ConfigurationError: If no fit is to be kept.
    """
    if num_modes is not None and num_modes < 1:
        raise ConfigurationError(f"expected at least 1 hypothesis to be kept, got {num_modes}")
    keypoints = keypoints.to(dtype=dtype, device=device)
    confidence = confidence.to(dtype=dtype, device=device)
    joints = joints or JointTerm(sigma=default_sigma(keypoints[confidence > 0]))
    search = search or Search()
    scale = scale_of(stature)
    # Arms are placed by the fit; afterwards their shoulder stays where it was found.
    free = placed or load_body(
        name, dtype=dtype, device=device, scale=scale, free_proportions=True, free_root=True
    )
    observation = JointObservation(free.joint_names, keypoints, confidence, keypoint_names)
    warnings = (*free.notes, *check_joints(name, observation, free, camera, least_joints))
    choice = CostChoice(
        contour=None,
        joints=joints,
        temporal=None,
        anthropometric=Anthropometric() if stature is None else Anthropometric(stature=0.0),
    )

    def cost_of(body: BodyModel) -> TrackingCost:
        return TrackingCost(
            body=body,
            camera=camera,
            choice=choice,
            observation=observation,
            others=tuple(others),
        )

    if placed is not None:
        _check_in_view(placed, camera)
        fits = find_interpretations(cost_of(placed), search=search, generator=generator)
        kept = best_distinct(fits, num_modes)
        return as_initialisation(placed, kept, warnings)

    free = _hang_before_camera(free, camera, observation)
    fits, gross = explain(cost_of(free), search=search, generator=generator)
    left_out: tuple[str, ...] = ()
    if bool(gross.any()):
        left_out = tuple(free.joint_names[joint] for joint in observation.index[gross].tolist())
        warnings = (*warnings, f"marks that fit no pose, left out: {', '.join(left_out)}")
        observation.weight = torch.where(gross, 0.0, observation.weight)
    lengths = fitted_lengths(free, fits.mean[0], stature)

    def load(**options: Any) -> BodyModel:
        bare = {name: length / scale for name, length in lengths.items()}
        body = load_body(name, dtype=dtype, device=device, lengths=bare, scale=scale, **options)
        return body.with_base(free.base_rotation, free.base_translation)

    # With the lengths of the best fit, twice as many fits as are asked for have their chance.
    candidates = fits.mean if num_modes is None else fits.mean[: 2 * num_modes + 8]
    body = load(free_root=True)
    starts = columns_of(free, body, candidates)
    body, starts, _ = move_base(body, *root_pose(body, starts[0]), starts)
    fits_held = refine(cost_of(body), starts, search)
    if name in ARM_NAMES:
        # The root of the best fit becomes the arm's base, and only its angles are searched.
        arm = load().with_base(*root_pose(body, fits_held.mean[int(_order(fits_held)[0])]))
        fits_held = refine(cost_of(arm), columns_of(body, arm, fits_held.mean), search)
        body = arm
    kept = best_distinct(fits_held, num_modes)
    if has_root(body):
        body, kept = hang_on_best(body, kept)
        loose = load(free_root=True, free_proportions=True)
        loose = loose.with_base(body.base_rotation, body.base_translation)
        covariance = marginal_covariance(cost_of(loose), body, kept.mean, search)
        kept = kept._replace(covariance=covariance)
    free_fits = fits if num_modes is None else Modes(*(field[:num_modes] for field in fits))
    result = as_initialisation(body, kept, warnings)
    report = [*result.report, scale_report(stature, lengths, num_views=1 + len(others))]
    if (line := undetermined_line(body, kept, joints=cost_of(body))) is not None:
        report.append(line)
    return result._replace(
        report=tuple(report),
        lengths=lengths,
        scale=scale,
        left_out=left_out,
        free_body=free,
        free_mixture=GaussianMixture(
            free_fits.mean, free_fits.covariance, torch.log_softmax(-free_fits.cost, dim=0)
        ),
    )


def _order(fits: Modes) -> Tensor:
    return fits.cost.nan_to_num(math.inf).argsort(stable=True)


def _check_in_view(body: BodyModel, camera: Camera) -> None:
    if not bool(camera.project(body.pose(body.rest).joints).valid.any()):
        raise CameraError(
            f"camera {camera.name!r} looks away from the body: all of it is behind the camera; "
            "check the rotation (world to camera) and the body's place"
        )


def _hang_before_camera(
    body: BodyModel, camera: Camera, observation: JointObservation
) -> BodyModel:
    """Base: upright in the image, facing the camera, as far as the limbs' lengths suggest."""
    seen = observation.weight > 0
    index, target = observation.index[seen], observation.target[seen]
    rest = body.pose(body.rest).joints[index]
    # Medians, so that a gross mark does not move the body away.
    middle, centre_px = rest.median(dim=0).values, target.median(dim=0).values
    in_body = (rest - middle).norm(dim=-1).median()
    on_image = (target - centre_px).norm(dim=-1).median()
    focal = camera.K.diagonal()[:2].mean().to(target)
    # Limbs are seldom parallel to the image: seen length is some 0.8 of the true one.
    depth = 0.8 * focal * in_body / on_image.clamp(min=1.0)
    if len(index) < LEAST_JOINTS:
        # Nothing shows the distance: as far as fills the image's height.
        depth = focal * STANDARD_STATURE / camera.image_size_wh[1]
    centre = camera.unproject(centre_px, depth)
    to_camera = torch.diag(torch.tensor([1.0, -1.0, -1.0])).to(body.tie)
    rotation = camera.R_camera_world.to(body.tie).T @ to_camera
    return body.with_base(rotation, centre - rotation @ middle)
