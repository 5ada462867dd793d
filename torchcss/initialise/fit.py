"""Pose, proportions, shape and first hypotheses from one picture (section 5 [IJRR]).

The first stage fits pose and lengths to the marked joints (`torchcss.initialise.from_joints`). With
a picture, the second fits cross-sections and tapers to joints and contours, pose and lengths held,
to each of the poses that the joints do not tell apart, and the third all parameters from the
cheapest (`torchcss.initialise.shape`); the fits are then refined on the body so found, contours
included. Beside the edges of the papers, contours are compared with the colours on either side of
them: of what the first stage's best pose covers, and of what surrounds it.

Call `initialise`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.body.shape import WHOLE_SHAPE, ShapeParameters, with_shape
from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.frame import FrameCosts
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.cost.region import RegionTerm
from torchcss.cost.shaped import Outline
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.cost.view import View
from torchcss.cost.visibility import ContourPredictor
from torchcss.errors import CameraError
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.initialise.from_joints import initialise_from_joints
from torchcss.initialise.keypoint_checks import default_sigma, keypoint_table, swapped_sides
from torchcss.initialise.multi_start import Search
from torchcss.initialise.outliers import best_distinct
from torchcss.initialise.result import (
    Initialisation,
    Stage,
    as_initialisation,
    columns_of,
    fitted_lengths,
    hang_on_best,
    marginal_covariance,
    scale_report,
    spread_to,
)
from torchcss.initialise.shape import ShapeFit, fit_shape
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor

DEFAULT_VIEW_DEGREES = 54.0
"""Field of view along the longer side of a picture from an unknown camera: that of a 35 mm lens on
35 mm film, in the middle of what telephones and cameras have."""

_BESIDE_COLOURS = 40.0
"""Weight of the edges where colours tell the outline too: a quarter of what they have alone.
Clothes have edges all over, the outline is in one place, and edges draw limbs thin. Where colours
tell nothing, edges still lead. On a walker of 160 pixels the silhouettes overlap by 0.63 with edges
alone; beside colours by 0.72 at full weight, 0.77 at a quarter, and 0.78 without edges."""

_RIVALS = 3.0
"""By how much more than the best a pose may cost the joints, nats, and be given flesh of its own:
odds of twenty to one. Flesh takes time, and changes what poses cost by less."""


def initialise(
    image: UInt8[np.ndarray, "h w 3"] | Tensor | None,
    joints_2d: Mapping[str, Sequence[float]] | Float[Tensor, "j c"],
    camera: Camera | None = None,
    body: str = "body34",
    *,
    generator: torch.Generator,
    joint_names: tuple[str, ...] | None = None,
    focal_px: float | None = None,
    field_of_view_degrees: float | None = None,
    sigma: float | None = None,
    stature: float | None = None,
    num_modes: int | None = 8,
    contours: bool = True,
    colours: bool = True,
    working_size: int = 640,
    search: Search | None = None,
    least_joints: int = 1,
    others: Sequence[View] = (),
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Initialisation:
    """Fit pose, proportions and shape of a body to one picture with marked joints: all stages.

    Args:
        image: Red, green, blue; None where only its joints are known (then `camera` is needed).
        joints_2d: Pixels by joint name, `(u, v)` or `(u, v, confidence)`, missing ones missing; or
            a tensor of as many rows as `joint_names`.
        camera: The camera of the picture. None: a pinhole camera of the given focal length or field
            of view, else of `DEFAULT_VIEW_DEGREES` along the longer side.
        body: Name of a body that ships.
        generator: Source of the starting poses.
        joint_names: Names of the rows of `joints_2d`, if it is a tensor.
        focal_px: Focal length in pixels.
        field_of_view_degrees: Angle between the left and the right border of the picture.
        sigma: Noise of a marked wrist, pixels; by default 0.6 % of the person's size.
        stature: Height of the standing person, metres, where it is known.
        num_modes: Most hypotheses; 1 for the best alone, None for all.
        contours: Run the second and third stage on the picture's contours.
        colours: Let them see the colours on either side too.
        working_size: Longer side of the picture on which contours are searched.
        search: How widely interpretations are looked for.
        least_joints: Fewest joints of the body that have to be marked.
        others: What further cameras see at the same time, in the same world; of these the keypoints
            are used.
        dtype: Type of the body.
        device: Where to compute.

    Raises:
        KeypointError: If fewer joints of the body are marked, or all are at one place.
        CameraError: If the camera is of another image size, or there is neither picture nor camera.
        BodyError: If the stature is no person's.
        ConfigurationError: If no hypothesis is to be kept.
    """
    names, keypoints, confidence = keypoint_table(joints_2d, joint_names)
    notes: list[str] = []
    if camera is None:
        if image is None:
            raise CameraError("neither picture nor camera is given; give one, for the image's size")
        camera, note = default_camera(
            image.shape[1], image.shape[0], focal_px=focal_px,
            field_of_view_degrees=field_of_view_degrees,
        )  # fmt: skip
        notes.append(note)
    if image is not None and tuple(image.shape[1::-1]) != camera.image_size_wh:
        raise CameraError(
            f"camera {camera.name!r} belongs to images of {camera.image_size_wh} pixels, this one "
            f"has {tuple(image.shape[1::-1])}; use camera.resized if it was only resized"
        )
    camera = camera.to(dtype=dtype, device=device)
    joints = JointTerm(sigma=sigma or default_sigma(keypoints[confidence > 0]))
    first = initialise_from_joints(
        body, camera, keypoints, confidence, names, generator=generator, joints=joints,
        search=search, num_modes=num_modes, stature=stature, least_joints=least_joints,
        others=others, dtype=dtype, device=device,
    )  # fmt: skip
    notes += swapped_sides(
        first.body, first.mixture.mean[0], camera, keypoints, confidence, names, joints, generator
    )
    first = first._replace(report=(*notes, *first.report))
    if image is None or not contours:
        return first
    kept = torch.tensor([name not in first.left_out for name in names]).to(confidence)
    extractor = FeatureExtractor(working_size=working_size, colour=colours)
    features = extractor.to(device=device)(image)
    working = extractor.working_camera(camera)
    # Of the longer side, which is not rounded: the shorter one has a factor of its own.
    factor = max(working.image_size_wh) / max(camera.image_size_wh)
    choice = CostChoice(
        region=RegionTerm() if colours else None,
        contour_weight=_BESIDE_COLOURS if colours else CostChoice.contour_weight,
        joints=replace(joints, sigma=factor * joints.sigma),
        temporal=None,
        anthropometric=Anthropometric() if stature is None else Anthropometric(stature=0.0),
    )
    observation = JointObservation(
        first.body.joint_names,
        keypoints.to(first.body.tie),
        (kept * confidence).to(first.body.tie),
        names,
    )
    marked = View(camera=camera, observation=observation).of_keypoints(factor)
    costs = FrameCosts(first.body, working, choice)
    cost = costs(
        features,
        body=first.body,
        observation=marked.observation,
        appearance=costs.learn(None, features, first.body, first.mixture.mean[0], fitted=False),
    )
    cost = replace(cost, others=tuple(view.of_keypoints(factor) for view in others))
    return _with_contours(first, cost, stature, search or Search(), num_modes)


def _with_contours(
    first: Initialisation,
    cost: TrackingCost,
    stature: float | None,
    search: Search,
    num_modes: int | None,
) -> Initialisation:
    """The second and the third stage, and the hypotheses refined on the body that they find."""
    name, scale, rooted = first.body.name, first.scale, has_root(first.body)
    scale_line = partial(scale_report, stature, num_views=len(cost.views))

    def load(lengths: Mapping[str, float], *, free: bool) -> BodyModel:
        bare = {name: length / scale for name, length in lengths.items()}
        body = load_body(
            name, lengths=bare, scale=scale, free_proportions=free, free_root=rooted,
            dtype=first.body.dtype, device=first.body.tie.device,
        )  # fmt: skip
        return body.with_base(first.body.base_rotation, first.body.base_translation)

    loose = load(first.lengths, free=True)
    rivals = first.mixture.mean[first.cost <= first.cost[0] + _RIVALS]
    parameters = ShapeParameters(loose, WHOLE_SHAPE)
    bones = replace(cost.choice, contour=None, region=None)
    flesh, whole = fit_shape(
        replace(cost, body=loose, choice=bones), spread_to(first.body, loose, rivals), parameters,
        _outlines(cost), bounds=search.bounds(loose),
    )  # fmt: skip
    lengths = {**first.lengths, **fitted_lengths(loose, whole.state, stature)}

    def shaped(body: BodyModel, fit: ShapeFit) -> BodyModel:
        offset = (fit.shape @ parameters.tie.T).unflatten(-1, body.part_shape.shape)
        return with_shape(body, body.part_shape + offset)

    def cost_of(body: BodyModel) -> TrackingCost:
        return replace(cost, body=body, predictor=ContourPredictor(body))

    body = shaped(load(lengths, free=False), whole)
    best = columns_of(loose, body, whole.state[None])
    starts = torch.cat([best, first.mixture.mean])
    fits = TrustRegionNewton(max_steps=40, tolerance=1e-2).minimise(
        cost_of(body), starts, search.bounds(body)
    )
    kept = best_distinct(fits, num_modes)
    if rooted:
        body, kept = hang_on_best(body, kept)
        loose_now = shaped(load(lengths, free=True), whole)
        loose_now = loose_now.with_base(body.base_rotation, body.base_translation)
        covariance = marginal_covariance(cost_of(loose_now), body, kept.mean, search)
        kept = kept._replace(covariance=covariance)
    result = as_initialisation(body, kept, first.report)
    second = Stage(
        "cross-sections, with contours", shaped(first.body, flesh),
        first.mixture.mean[flesh.start], flesh.cost,
    )  # fmt: skip
    third = Stage("all parameters, with contours", body, kept.mean[0], float(kept.cost[0]))
    return first._replace(
        body=body,
        mixture=result.mixture,
        cost=result.cost,
        report=(
            *(line for line in first.report if line != scale_line(first.lengths)),
            f"shape: {len(parameters.names)} numbers of the parts fitted to the contours; "
            f"{len(kept.cost)} distinct fits to joints and contours, best cost {third.cost:.1f}",
            scale_line(lengths),
        ),
        lengths=lengths,
        stages=(*first.stages, second, third),
    )


def _outlines(cost: TrackingCost) -> tuple[Outline, ...]:
    choice = cost.choice
    compared = (
        (choice.contour, cost.edge_field, choice.contour_weight),
        (choice.region, cost.region, choice.region_weight),
    )
    return tuple(
        Outline(term, image, weight)
        for term, image, weight in compared
        if term is not None and image is not None
    )


def default_camera(
    width: int,
    height: int,
    *,
    focal_px: float | None = None,
    field_of_view_degrees: float | None = None,
) -> tuple[Camera, str]:
    """A pinhole camera for a picture without calibration, and a line that says which.

    Args:
        width: Width of the picture, pixels.
        height: Its height.
        focal_px: Focal length in pixels.
        field_of_view_degrees: Angle between left and right border. Neither: the default.
    """
    if focal_px is not None or field_of_view_degrees is not None:
        camera = Camera.pinhole(
            width, height, focal_px=focal_px, field_of_view_degrees=field_of_view_degrees
        )
        return camera, f"camera: pinhole, focal length {float(camera.K[0, 0]):.0f} px, as given"
    longer = max(width, height)
    focal = 0.5 * longer / math.tan(math.radians(0.5 * DEFAULT_VIEW_DEGREES))
    return Camera.pinhole(width, height, focal_px=focal, name="default"), (
        f"camera: not given; assumed a field of view of {DEFAULT_VIEW_DEGREES:g} degrees along the "
        f"longer side, focal length {focal:.0f} px"
    )
