"""The first stage of initialisation: pose and lengths from joint positions (section 5 [IJRR]).

It fits joint angles, the place of the body and its internal proportions (within 10 % of the
standard humanoid, left and right tied) to the joints, with hard joint limits, by the robust
optimisation that tracks (section 4.1), from many starts (`torchcss.initialise.multi_start`),
without the keypoints that fit no pose (`torchcss.initialise.outliers`). The best fit gives the
lengths. With them held, every fit is refined once more, and the distinct ones become the mixture
that the tracker begins with. Their covariances are those of the pose with the lengths unknown: the
inverse Hessian of pose and lengths together, of which the pose's block is kept.

One image does not tell a large person from a small one farther away: `stature` fixes the scale,
or the view of another camera, else the anthropometric prior does.

`torchcss.initialise.fit.initialise` calls `fit_joints`.
"""

from __future__ import annotations

from itertools import compress

import torch

from torchcss.body.load import has_free_root, load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import base_without_root, has_root, move_base, root_pose
from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.joints import JointTargets, match_joints
from torchcss.cost.total import TrackingCost
from torchcss.errors import CameraError
from torchcss.initialise.keypoint_checks import check_keypoints
from torchcss.initialise.multi_start import multi_start_fits
from torchcss.initialise.options import LEAST_JOINTS, InitialiseOptions
from torchcss.initialise.outliers import best_distinct, fits_and_outliers, refine_fits, without
from torchcss.initialise.result import (
    STANDARD_STATURE,
    Initialisation,
    as_initialisation,
    check_stature,
    columns_of,
    fitted_lengths,
    hang_on_best,
    mixture_of,
    scale_of,
    scale_report,
    undetermined,
    with_lengths,
    with_uncapped,
    with_unknown_lengths,
)
from torchcss.initialise.view import CameraView
from torchcss.types import Modes
from torchcss.vision.camera import Camera


def fit_joints(
    body: str | BodyModel,
    view: CameraView,
    *,
    generator: torch.Generator,
    options: InitialiseOptions,
    others: tuple[CameraView, ...] = (),
) -> Initialisation:
    """Fit place, pose and lengths of a body to the joints of one image.

    Args:
        body: Name of a body that ships, or the path of a URDF, MJCF or BVH file; or a body whose
            base and lengths are known, of which the pose alone is fitted.
        view: The camera and the keypoints in its pixels.
        generator: Source of the starting poses.
        options: How to look.
        others: What further cameras see at the same time, in the same world; only their keypoints
            matter. Starts and outliers are looked for in the first camera's view.

    Raises:
        KeypointError: If too few joints of the body are seen, or all at one place.
        CameraError: If the camera looks away from a placed body.
        BodyError: If the stature is no person's, or is given for a body from a file.
    """
    scale = scale_of(options.stature)
    # Arms are placed by the fit; afterwards their shoulder stays where it was found.
    free = (
        body
        if isinstance(body, BodyModel)
        else load_body(
            body, dtype=options.dtype, device=options.device, scale=scale,
            free_proportions=options.search.parameters, free_root=True,
        )
    )  # fmt: skip
    if free is not body:
        check_stature(free.name, options.stature)
    assert view.keypoints is not None
    keypoints = view.keypoints.only(free.joint_names).to(free.tie)
    notes = (*free.notes, *check_keypoints(free.name, keypoints, view.camera, options.least_joints))
    cost = options.joint_cost(free, (view._replace(keypoints=keypoints), *others))
    if isinstance(body, BodyModel):
        _check_in_view(body, view.camera)
        fits = multi_start_fits(cost, search=options.search, generator=generator)
        kept = best_distinct(fits, options.num_modes)
        return with_uncapped(as_initialisation(body, kept, notes), cost, options.search)
    free = hang_before_camera(free, view.camera, match_joints(keypoints, free.joint_names))
    return _with_lengths_fitted(cost.with_body(free), generator, options, scale, notes)


def _with_lengths_fitted(
    cost: TrackingCost,
    generator: torch.Generator,
    options: InitialiseOptions,
    scale: float,
    notes: tuple[str, ...],
) -> Initialisation:
    """Fit pose and lengths, leave outliers out, and refine the poses with the lengths held."""
    free, keypoints = cost.body, cost.keypoints
    fits, outliers = fits_and_outliers(cost, search=options.search, generator=generator)
    left_out = tuple(compress(keypoints.names, outliers.tolist()))
    if left_out:
        notes = (*notes, f"keypoints that fit no pose, left out: {', '.join(left_out)}")
        cost = without(cost, outliers)
    lengths = fitted_lengths(free, fits.mean[0], options.stature)
    cost, held, kept, loose = _with_lengths_held(cost, fits, lengths, scale, options)
    result = with_uncapped(as_initialisation(held, kept, notes), cost, options.search)
    report = [*result.report, scale_report(options.stature, lengths, num_views=len(cost.views))]
    if loose:
        what = "kept at their prior" if has_root(held) else "as its place was sought as well"
        report.append(f"not determined by the joints, {what}: {', '.join(loose)}")
    fits = fits.take(slice(options.num_modes))
    known = options.stature is not None or len(cost.views) > 1
    return result._replace(
        report=tuple(report),
        lengths=lengths,
        scale=scale,
        left_out=left_out,
        free_body=free,
        free_mixture=mixture_of(fits),
        size_deviation=0.0 if known else Anthropometric().stature,
    )


def _with_lengths_held(
    cost: TrackingCost,
    fits: Modes,
    lengths: dict[str, float],
    scale: float,
    options: InitialiseOptions,
) -> tuple[TrackingCost, BodyModel, Modes, list[str]]:
    """Refine fits on the body with these lengths.

    Returns:
        The cost with the lengths free again, for a body with a root; the body hung on the best of
        them, the distinct fits, and the parameters that the joints do not determine.
    """
    free, num = cost.body, options.num_modes
    # Twice as many fits as are asked for have their chance.
    candidates = fits.mean if num is None else fits.mean[: 2 * num + 8]
    body = with_lengths(free, lengths, scale, free_root=True)
    starts = columns_of(free, body, candidates)
    body, starts, _ = move_base(body, *root_pose(body, starts[0]), starts)
    refined, loose = refine_fits(cost.with_body(body), starts, options.search), []
    if not (options.free_root or has_free_root(free.name)):
        # The root of the best fit becomes the arm's base, and only its angles are searched.
        found = best_distinct(refined, 1)
        # Where the arm stands is looked for too: what turns it all is then not known.
        loose = undetermined(body, found, joints=cost.with_body(body))
        arm = with_lengths(free, lengths, scale, free_root=None)
        arm = arm.with_base(*base_without_root(body, arm, found.mean[0]))
        starts = columns_of(body, arm, refined.mean)
        body, refined = arm, refine_fits(cost.with_body(arm), starts, options.search)
    kept, search = best_distinct(refined, num), options.search
    if has_root(body):
        body, kept = hang_on_best(body, kept)
        parameters = search.parameters
        free = with_lengths(body, lengths, scale, free_root=True, free_proportions=parameters)
        kept = with_unknown_lengths(cost.with_body(free), body, kept, search)
        loose = undetermined(body, kept, joints=cost.with_body(body))
        cost = cost.with_body(free)
    else:
        cost = cost.with_body(body)
    return cost, body, kept, loose


def _check_in_view(body: BodyModel, camera: Camera) -> None:
    if not bool(camera.project(body.pose(body.rest).joints).valid.any()):
        raise CameraError(
            f"camera {camera.name!r} looks away from the body: all of it is behind the camera; "
            "check the rotation (world to camera) and the body's place"
        )


def hang_before_camera(body: BodyModel, camera: Camera, targets: JointTargets) -> BodyModel:
    """Base: upright in the image, facing the camera, as far as the limbs' lengths suggest."""
    seen = targets.weight > 0
    index, target = targets.joint[seen], targets.position[seen]
    rest = body.pose(body.rest).joints[index]
    # Medians, so that an outlier does not move the body away.
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
