"""Pose, proportions, shape and first hypotheses from one picture (section 5 [IJRR]).

The first stage fits pose and lengths to the joints (`torchcss.initialise.from_joints`). With
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

import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.body.shape import WHOLE_SHAPE, ShapeParameters, with_shape
from torchcss.body.surface import SHAPE_NAMES
from torchcss.cost.contour import ContourTerm
from torchcss.cost.frame import NOTHING_KNOWN, FrameCosts
from torchcss.cost.fused import threads_for
from torchcss.cost.joints import JointTerm
from torchcss.cost.outline import OutlineTerm
from torchcss.cost.region import RegionTerm
from torchcss.cost.shaped import Outline
from torchcss.cost.total import TrackingCost
from torchcss.errors import CameraError, ConfigurationError
from torchcss.initialise.from_joints import fit_joints
from torchcss.initialise.ground import stature_on_floor
from torchcss.initialise.keypoint_checks import (
    check_numbers,
    default_sigma,
    keypoints_by_name,
    swapped_sides,
)
from torchcss.initialise.multi_start import optimise
from torchcss.initialise.noise import briefly, noise_factor
from torchcss.initialise.options import InitialiseOptions
from torchcss.initialise.outliers import best_distinct
from torchcss.initialise.result import (
    Initialisation,
    Stage,
    as_initialisation,
    columns_of,
    fitted_lengths,
    hang_on_best,
    scale_report,
    spread_to,
    with_lengths,
    with_uncapped,
    with_unknown_lengths,
)
from torchcss.initialise.shape import ShapeFit, fit_shape
from torchcss.initialise.view import CameraView
from torchcss.types import ColourImage, Keypoints, Vector
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor

Picture = ColourImage | Tensor
"""Red, green, blue."""

DEFAULT_VIEW_DEGREES = 54.0
"""Field of view along the longer side of a picture from an unknown camera: that of a 35 mm lens on
35 mm film, in the middle of what telephones and cameras have."""

_BESIDE_COLOURS = 40.0
"""Weight of the edges where colours tell the outline too: a quarter of what they have alone.
Clothes have edges all over, the outline is in one place, and edges draw limbs thin. Where colours
tell nothing, edges still lead. On a walker of 160 pixels the silhouettes overlap by 0.63 with edges
alone; beside colours by 0.72 at full weight, 0.77 at a quarter, and 0.78 without edges."""

_POOR_FIT = 3.0
"""How many times as noisy as expected keypoints are where the user is told."""

_MISSED = 0.5
"""Share of the noise that was learnt before, below which the search starts anew: the fit before was
not the best."""

_NO_POSE = (
    "they fit no pose before this camera well; look at the first frame's keypoints, or start at "
    "another frame"
)

_RIVALS = 3.0
"""By how much more than the best a pose may cost the joints, nats, and be given a shape of its
own: odds of twenty to one. A shape takes time, and changes what poses cost by less."""


def initialise(
    image: Picture | None,
    keypoints: Keypoints | Mapping[str, Sequence[float]],
    camera: Camera | None = None,
    body: str | BodyModel = "body34",
    *,
    generator: torch.Generator,
    options: InitialiseOptions | None = None,
    others: Sequence[CameraView] = (),
) -> Initialisation:
    """Fit pose, proportions and shape of a body to one picture with known joints: all stages.

    Args:
        image: Red, green, blue; None where only its joints are known (then `camera` is needed).
        keypoints: The joints, or pixels by joint name, `(u, v)` or `(u, v, confidence)`. A body
            from a file has joints under its own names too (`BodyModel.joint_names`).
        camera: The camera of the picture, such as `Camera.pinhole`. None: a pinhole camera with a
            field of view of `DEFAULT_VIEW_DEGREES` along the longer side.
        body: Name of a body that ships, or the path of a URDF, MJCF or BVH file; or a body whose
            base, lengths and shape are known, of which the pose alone is fitted.
        generator: Source of the starting poses.
        options: How the pose is looked for, and what else is fitted.
        others: What further cameras see at the same time, in the same world (`CameraView.at`); of
            these the keypoints are used.

    Raises:
        KeypointError: If fewer joints of the body are known than asked for, all are at one place,
            or the keypoints are not those of one image.
        CameraError: If the camera is of another image size or looks away from a placed body, or
            there is neither picture nor camera.
        BodyError: If the stature is no person's, or stature or floor are to tell the size of
            another body.
        ConfigurationError: If the floor is known, and several cameras look on.
    """
    options = options or InitialiseOptions()
    if not isinstance(keypoints, Keypoints):
        own = body if isinstance(body, BodyModel) else load_body(body)
        keypoints = keypoints_by_name(keypoints, own=own.joint_of_name)
    check_numbers(keypoints, frames=False)
    camera, notes = _camera_of(image, camera)
    view = CameraView(camera.to(dtype=options.dtype, device=options.device), keypoints)
    with threads_for(options.evaluator):
        learns = options.sigma is None if options.learn_noise is None else options.learn_noise
        sigma = options.sigma or default_sigma(keypoints)
        others = tuple(each.to(view.camera.K).relative_to(sigma) for each in others)
        options = replace(options, sigma=sigma)
        noise = 1.0
        if learns:
            brief = replace(options, search=briefly(options.search))
            rough = fit_joints(body, view, generator=generator, options=brief, others=others)
            noise = _noise(rough, view, others, options)
        told = replace(options, sigma=noise * sigma)
        first, known = _fit_of_size(body, view, generator, told, others)
        if learns:
            while (found := _noise(first, view, others, options)) < _MISSED * noise:
                noise, told = found, replace(options, sigma=found * sigma)
                first, known = _fit_of_size(body, view, generator, told, others)
            notes.append(_noise_line(first.body, noise, sigma))
        options = known
        first = first._replace(noise=noise)
        given = keypoints.only(first.body.joint_names).to(first.body.tie)
        alone = options.joint_cost(first.body, [view._replace(keypoints=given)])
        if not learns and (line := _misses(alone, first.mixture.mean[0])):
            notes.append(line)
        notes += swapped_sides(alone, first.mixture.mean[0], generator)
        first = first._replace(report=(*notes, *first.report))
        if image is None or not options.contours or isinstance(body, BodyModel):
            return first
        return _to_the_picture(first, image, view._replace(keypoints=given), others, options)


def _noise_line(body: BodyModel, noise: float, sigma: float) -> str:
    """What to say of the noise that was learnt, as a multiple of what was expected, pixels."""
    what = "a wrist" if {"l_wrist", "r_wrist"} & {*body.joint_names} else "a joint"
    line = f"keypoints: noise of {what} {noise * sigma:.1f} px, from the best fit"
    if noise <= _POOR_FIT:
        return line
    return f"{line}, {noise:.1f} times what detectors have: {_NO_POSE}"


def _misses(alone: TrackingCost, x: Vector) -> str | None:
    """A line where keypoints cost as much as if all of them erred `_POOR_FIT` times their noise."""
    joints, given = alone.choice.find(JointTerm), alone.keypoints
    error = 2 * x.new_tensor(_POOR_FIT * joints.sigma).square()
    most = alone.choice.weight(joints.name) * joints.weight * 0.5 * joints.potential(error).rho
    if alone.terms(x[None])[joints.name] <= most * given.known.sum():
        return None
    return (
        f"keypoints: the best fit misses them by more than {_POOR_FIT:g} times the noise of "
        f"{joints.sigma:.1f} px that is given: {_NO_POSE}"
    )


def _fit_of_size(
    body: str | BodyModel,
    view: CameraView,
    generator: torch.Generator,
    options: InitialiseOptions,
    others: tuple[CameraView, ...],
) -> tuple[Initialisation, InitialiseOptions]:
    """The fit to the joints, of the size that the floor tells where it is known, which is held."""
    first = fit_joints(body, view, generator=generator, options=options, others=others)
    if options.ground is None or options.stature is not None:
        return first, options
    if others:
        raise ConfigurationError("ground: several cameras show the size; leave it out")
    stature, doubt = stature_on_floor(first, view.camera, options.ground)
    options = replace(options, ground=None, stature=round(stature, 3))
    first = fit_joints(body, view, generator=generator, options=options)
    line = f"the floor tells the size: {stature:.2f} m, to {100 * doubt:.1f} %"
    return first._replace(size_deviation=doubt, report=(*first.report, line)), options


def _camera_of(image: Picture | None, camera: Camera | None) -> tuple[Camera, list[str]]:
    """The camera, checked or assumed, and what to say of it."""
    if camera is None:
        if image is None:
            raise CameraError("neither picture nor camera is given; give one, for the image's size")
        camera, note = default_camera(image.shape[1], image.shape[0])
        return camera, [note]
    if image is not None:
        camera.check_size(image.shape[1], image.shape[0])
    return camera, []


def _to_the_picture(
    first: Initialisation,
    image: Picture,
    view: CameraView,
    others: tuple[CameraView, ...],
    options: InitialiseOptions,
) -> Initialisation:
    """The stages that look at the picture, from a fit to its joints."""
    given = view.keypoints
    assert given is not None
    left_out = torch.tensor([name in first.left_out for name in given.names])
    view = view._replace(keypoints=given.without(left_out.to(options.device)))
    cost = _contour_cost(image, first, view, options)
    scaled = (each.scaled(_factor(view.camera, cost.camera)) for each in others)
    beside = (
        replace(cost.views[0], camera=each.camera, keypoints=each.keypoints, edge_field=None,
                features=None, appearance=None)
        for each in scaled
    )  # fmt: skip
    return _with_contours(first, replace(cost, views=(*cost.views, *beside)), options)


def _noise(
    first: Initialisation,
    view: CameraView,
    others: tuple[CameraView, ...],
    options: InitialiseOptions,
) -> float:
    """How many times as noisy as the options say keypoints are."""
    body, fits = first.free_body or first.body, first.free_mixture or first.mixture
    names = body.joint_names
    given = (
        each._replace(keypoints=each.keypoints and each.keypoints.only(names).to(body.tie))
        for each in (view, *others)
    )
    # Else an unusual pose would pass for noise.
    cost = replace(options, pose_prior=False).joint_cost(body, given)
    return noise_factor(cost, fits.mean[0], options.search)


def _factor(camera: Camera, working: Camera) -> float:
    """By how much a picture was shrunk: its longer side, the shorter one may be rounded."""
    return max(working.image_size_wh) / max(camera.image_size_wh)


def _contour_cost(
    image: Picture,
    first: Initialisation,
    view: CameraView,
    options: InitialiseOptions,
) -> TrackingCost:
    """The cost of a picture at its working size: joints, edges and colours."""
    extractor = FeatureExtractor(working_size=options.working_size, colour=options.colours)
    features = extractor.to(device=options.device)(image)
    working = extractor.working_camera(view.camera)
    factor = _factor(view.camera, working)
    choice = options.joint_choice
    joints = choice.find(JointTerm)
    beside = (ContourTerm(weight=_BESIDE_COLOURS), RegionTerm())
    outlines = beside if options.colours else (ContourTerm(),)
    choice = choice.having(replace(joints, sigma=factor * joints.sigma))
    choice = replace(choice, terms=(*outlines, *choice.terms))
    costs, body = FrameCosts(first.body, working, choice, engine=options.evaluator), first.body
    return costs(
        features,
        body=body,
        keypoints=view.scaled(factor).keypoints,
        known=costs.learn(NOTHING_KNOWN, features, body, first.mixture.mean, fitted=False),
    )


def _with_contours(
    first: Initialisation, cost: TrackingCost, options: InitialiseOptions
) -> Initialisation:
    """The second and the third stage, and the hypotheses refined on the body that they find."""
    search, rooted = options.search, has_root(first.body)
    load = partial(with_lengths, first.body, scale=first.scale, free_root=rooted)
    loose = load(first.lengths, free_proportions=search.parameters)
    rivals = first.mixture.mean[first.cost <= first.cost[0] + _RIVALS]
    parameters = ShapeParameters(loose, SHAPE_NAMES if options.bends else WHOLE_SHAPE)
    bones = cost.choice.without("contour", "region")
    sections, whole = fit_shape(
        replace(cost, choice=bones).with_body(loose), spread_to(first.body, loose, rivals),
        parameters, _outlines(cost), bounds=search.bounds(loose),
    )  # fmt: skip
    lengths = {**first.lengths, **fitted_lengths(loose, whole.state, options.stature)}

    def shaped(body: BodyModel, fit: ShapeFit) -> BodyModel:
        offset = (fit.shape @ parameters.tie.T).unflatten(-1, body.part_shape.shape)
        return with_shape(body, body.part_shape + offset)

    body = shaped(load(lengths), whole)
    best = columns_of(loose, body, whole.state[None])
    starts = torch.cat([best, first.mixture.mean])
    cost = cost.with_body(body)
    fits = optimise(cost, starts, search.bounds(body), 40)
    kept = best_distinct(fits, options.num_modes)
    if rooted:
        body, kept = hang_on_best(body, kept)
        free = shaped(load(lengths, free_proportions=search.parameters), whole)
        free = free.with_base(body.base_rotation, body.base_translation)
        cost = cost.with_body(free)
        kept = with_unknown_lengths(cost, body, kept, search)
    result = as_initialisation(body, kept, first.report)
    second = Stage(
        "cross-sections, with contours", shaped(first.body, sections),
        first.mixture.mean[sections.start], sections.cost,
    )  # fmt: skip
    third = Stage("all parameters, with contours", body, kept.mean[0], float(kept.cost[0]))
    scale_line = partial(scale_report, options.stature, num_views=len(cost.views))
    found = first._replace(
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
    return with_uncapped(found, cost, search)


def _outlines(cost: TrackingCost) -> tuple[Outline, ...]:
    bound = ((term, cost.bound[term, cost.views[0]]) for term in cost.choice.terms)
    return tuple(
        Outline(term, each.image, term.weight)
        for term, each in bound
        if isinstance(term, OutlineTerm) and each is not None
    )


def default_camera(width: int, height: int) -> tuple[Camera, str]:
    """A pinhole camera for a picture without calibration, and a line that says which."""
    longer = max(width, height)
    focal = 0.5 * longer / math.tan(math.radians(0.5 * DEFAULT_VIEW_DEGREES))
    return Camera.pinhole(width, height, focal_px=focal, name="default"), (
        f"camera: not given; assumed a field of view of {DEFAULT_VIEW_DEGREES:g} degrees along the "
        f"longer side, focal length {focal:.0f} px"
    )
