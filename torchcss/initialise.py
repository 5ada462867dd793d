"""Pose, proportions and first hypotheses from joint positions in one image (section 5 [IJRR]).

The first stage fits joint angles, the place of the body and its internal proportions (within 10 %
of the standard humanoid, left and right tied) to the joints, with hard joint limits, by the robust
optimisation that tracks (section 4.1), from many starts (`torchcss.interpretations`). The best fit
gives the lengths. With them held, every fit is refined once more, and the distinct ones become the
mixture that the tracker begins with. Their covariances are those of the pose with the lengths
unknown: the inverse Hessian of pose and lengths together, of which the pose's block is kept.

One image does not tell a large person from a small one farther away: `stature` fixes the scale,
else the anthropometric prior does.

With a picture, the second stage fits cross-sections and tapers to joints and contours, pose and
lengths held, and the third all parameters (`torchcss.shape_fit`); the fits are then refined on the
body so found, contours included.

What to call: `initialise` for one picture, `initialise_from_joints` for the first frame of a video.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from torchcss.body.catalog import LENGTHS, PROPORTION_RANGE, PROPORTIONS
from torchcss.body.model import BodyModel, load_body
from torchcss.body.root import ROOT_NAMES, has_root, move_base, root_pose
from torchcss.body.shape import WHOLE_SHAPE, ShapeParameters, with_shape
from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.cost.visibility import ContourPredictor
from torchcss.errors import BodyError, CameraError, KeypointError
from torchcss.inference.mixture import GaussianMixture, distinct_modes
from torchcss.inference.trust_region import TrustRegionNewton, default_prior_variance
from torchcss.interpretations import Search, descend, find_interpretations
from torchcss.joint_names import JOINT_NAMES, canonical_joint_name
from torchcss.linalg import inverse_on_free
from torchcss.shape_fit import ShapeFit, fit_shape
from torchcss.types import Modes
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor

LEAST_JOINTS = 3
"""Fewer joints than this fix neither depth nor direction of a body."""

STANDARD_STATURE = 1.75
"""Stature of the standard humanoid, metres."""

_SOLE = STANDARD_STATURE - sum(LENGTHS[n] for n in ("shank", "thigh", "trunk", "neck", "head"))
"""Height of the ankle joint above the ground."""

DEFAULT_VIEW_DEGREES = 54.0
"""Field of view along the longer side of a picture from an unknown camera: that of a 35 mm lens on
35 mm film, in the middle of what telephones and cameras have."""

_SUSPICIOUS = 0.5
"""Nats per marked joint from which a fit is so bad that left and right may be swapped."""

_CLEARLY_BETTER = 5.0
"""Nats by which a fit with exchanged sides must be better to be reported."""

_ARM, _LEG = (
    ("shoulder", "elbow", "wrist", "hand_tip"),
    ("hip", "knee", "ankle", "toe", "heel", "midtarsal"),
)
_SIDED = {
    "the whole body": (*_ARM, *_LEG, "eye", "ear"),
    "the arms": _ARM,
    "the legs": _LEG,
}

_GROSS, _FEW = 10.0, 0.3
"""Deviations from which a mark is no mark of its joint, and the share of marks that may be such: if
more are, it is the fit that is wrong."""

_UNDETERMINED = 0.9
"""Share of a parameter's prior deviation from which the image is said not to determine it."""


class Stage(NamedTuple):
    """The best fit after one stage.

    Attributes:
        name: What was fitted to what.
        body: The body at this stage.
        state: Its state.
        cost: Cost in nats of the stage's own cost function.
    """

    name: str
    body: BodyModel
    state: Float[Tensor, " n"]
    cost: float


class Initialisation(NamedTuple):
    """Where tracking starts.

    Attributes:
        body: The body with the fitted lengths and shape, hung on the base of the best fit.
        mixture: The distinct fits, best first.
        cost: Their costs, nats.
        report: What was found and assumed, one line each.
        lengths: The fitted lengths, metres; empty where they were given.
        scale: Overall scale of the standard humanoid that the lengths were compared with.
        stages: The best fit after every stage.
        free_body: The same body with its lengths as parameters; None where they were given.
        free_mixture: The fits of pose and lengths together, best first, on `free_body`.
        left_out: Joints whose marks fit no pose and were left out.
    """

    body: BodyModel
    mixture: GaussianMixture
    cost: Float[Tensor, " k"]
    report: tuple[str, ...]
    lengths: Mapping[str, float] = {}
    scale: float = 1.0
    stages: tuple[Stage, ...] = ()
    free_body: BodyModel | None = None
    free_mixture: GaussianMixture | None = None
    left_out: tuple[str, ...] = ()

    def hypotheses(self, num: int, *, generator: torch.Generator) -> Float[Tensor, "num n"]:
        """The first `num` states to believe in: the fits, then samples of their mixture.

        Args:
            num: How many.
            generator: Source of the samples.
        """
        fits = self.mixture.mean[:num]
        samples = self.mixture.sample(num - len(fits), generator=generator).x
        return torch.cat([fits, self.body.bounds.project(samples)])


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
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> Initialisation:
    """Fit place, pose and lengths of a body to the joints of one image: the first stage.

    Args:
        name: Name of a body that ships, or the path of a URDF (which then must be `placed`).
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
        dtype: Type of the body.
        device: Where to compute.

    Raises:
        KeypointError: If fewer than `least_joints` joints of the body are seen, or all at one
            place.
        CameraError: If the camera looks away from a placed body.
        BodyError: If the stature is no person's.
    """
    keypoints = keypoints.to(dtype=dtype, device=device)
    confidence = confidence.to(dtype=dtype, device=device)
    joints = joints or JointTerm(sigma=default_sigma(keypoints[confidence > 0]))
    search = search or Search()
    scale = _scale(stature)
    # Arms are placed by the fit; afterwards their shoulder stays where it was found.
    free = placed or load_body(
        name, dtype=dtype, device=device, scale=scale, free_proportions=True, free_root=True
    )
    observation = JointObservation(free.joint_names, keypoints, confidence, keypoint_names)
    warnings = check_joints(name, observation, free, camera, least_joints)
    choice = CostChoice(
        contour=None,
        joints=joints,
        temporal=None,
        anthropometric=Anthropometric() if stature is None else Anthropometric(stature=0.0),
    )

    def cost_of(body: BodyModel) -> TrackingCost:
        return TrackingCost(body=body, camera=camera, choice=choice, observation=observation)

    if placed is not None:
        _check_in_view(placed, camera)
        fits = find_interpretations(cost_of(placed), search=search, generator=generator)
        kept = _best_distinct(fits, num_modes)
        return _as_initialisation(placed, kept, warnings)

    free = _hang_before_camera(free, camera, observation)
    fits = _best_distinct(
        find_interpretations(cost_of(free), search=search, generator=generator), None
    )
    left_out: tuple[str, ...] = ()
    gross = _gross_marks(cost_of(free), fits.mean[0], joints.sigma)
    if bool(gross.any()):
        # However far off, a robust potential pulls a little; what is no mark of a joint must not.
        left_out = tuple(free.joint_names[joint] for joint in observation.index[gross].tolist())
        warnings = (*warnings, f"marks that fit no pose, left out: {', '.join(left_out)}")
        observation.weight = torch.where(gross, 0.0, observation.weight)
        fits = _best_distinct(_refine(cost_of(free), fits.mean, search), None)
    lengths = _lengths(free, fits.mean[0], stature)

    def load(**options: bool) -> BodyModel:
        bare = {name: length / scale for name, length in lengths.items()}
        body = load_body(name, dtype=dtype, device=device, lengths=bare, scale=scale, **options)
        return body.with_base(free.base_rotation, free.base_translation)

    # With the lengths of the best fit, twice as many fits as are asked for have their chance.
    candidates = fits.mean if num_modes is None else fits.mean[: 2 * num_modes + 8]
    body = load(free_root=True)
    starts = _columns(free, body, candidates)
    body, starts, _ = move_base(body, *root_pose(body, starts[0]), starts)
    fits_held = _refine(cost_of(body), starts, search)
    if name.startswith("arm"):
        # The root of the best fit becomes the arm's base, and only its angles are searched.
        arm = load().with_base(*root_pose(body, fits_held.mean[int(_order(fits_held)[0])]))
        fits_held = _refine(cost_of(arm), _columns(body, arm, fits_held.mean), search)
        body = arm
    kept = _best_distinct(fits_held, num_modes)
    if has_root(body):
        body, kept = _hang_on_best(body, kept)
        loose = load(free_root=True, free_proportions=True)
        loose = loose.with_base(body.base_rotation, body.base_translation)
        covariance = marginal_covariance(cost_of(loose), body, kept.mean, search)
        kept = kept._replace(covariance=covariance)
    free_fits = fits if num_modes is None else Modes(*(field[:num_modes] for field in fits))
    result = _as_initialisation(body, kept, warnings)
    report = [*result.report, _scale_report(stature, lengths)]
    if (line := _undetermined(body, kept, joints=cost_of(body))) is not None:
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
    working_size: int = 640,
    search: Search | None = None,
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
        working_size: Longer side of the picture on which contours are searched.
        search: How widely interpretations are looked for.
        dtype: Type of the body.
        device: Where to compute.

    Raises:
        KeypointError: If no joint of the body is marked, or all are at one place.
        CameraError: If the camera is of another image size, or there is neither picture nor camera.
        BodyError: If the stature is no person's.
    """
    names, keypoints, confidence = _as_keypoints(joints_2d, joint_names)
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
        search=search, num_modes=num_modes, stature=stature, least_joints=1, dtype=dtype,
        device=device,
    )  # fmt: skip
    notes += _swapped_sides(first, camera, keypoints, confidence, names, joints, generator)
    first = first._replace(report=(*notes, *first.report))
    if image is None or not contours:
        return first
    kept = torch.tensor([name not in first.left_out for name in names]).to(confidence)
    extractor = FeatureExtractor(working_size=working_size)
    field = extractor(image).edge_field().to(first.body.tie)
    working = extractor.working_camera(camera).to(dtype=dtype, device=device)
    factor = working.image_size_wh[0] / camera.image_size_wh[0]
    observation = JointObservation(
        first.body.joint_names,
        factor * (keypoints.to(first.body.tie) + 0.5) - 0.5,
        (kept * confidence).to(first.body.tie),
        names,
    )
    choice = CostChoice(
        joints=replace(joints, sigma=factor * joints.sigma),
        temporal=None,
        anthropometric=Anthropometric() if stature is None else Anthropometric(stature=0.0),
    )
    cost = TrackingCost(
        body=first.body, camera=working, choice=choice, edge_field=field, observation=observation
    )
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

    def load(lengths: Mapping[str, float], *, free: bool) -> BodyModel:
        bare = {name: length / scale for name, length in lengths.items()}
        body = load_body(
            name, lengths=bare, scale=scale, free_proportions=free, free_root=rooted,
            dtype=first.body.dtype, device=first.body.tie.device,
        )  # fmt: skip
        return body.with_base(first.body.base_rotation, first.body.base_translation)

    loose = load(first.lengths, free=True)
    state = _spread(first.body, loose, first.mixture.mean[:1])[0]
    parameters = ShapeParameters(loose, WHOLE_SHAPE)
    assert cost.edge_field is not None
    base = replace(cost, body=loose, choice=replace(cost.choice, contour=None), edge_field=None)
    flesh, whole = fit_shape(
        base, state, parameters, cost.edge_field, bounds=search.bounds(loose),
        contour=cost.choice.contour, contour_weight=cost.choice.contour_weight,
    )  # fmt: skip
    lengths = {**first.lengths, **_lengths(loose, whole.state, stature)}

    def shaped(body: BodyModel, fit: ShapeFit) -> BodyModel:
        offset = (fit.shape @ parameters.tie.T).unflatten(-1, body.part_shape.shape)
        return with_shape(body, body.part_shape + offset)

    def cost_of(body: BodyModel) -> TrackingCost:
        return replace(cost, body=body, predictor=ContourPredictor(body))

    body = shaped(load(lengths, free=False), whole)
    best = _columns(loose, body, whole.state[None])
    starts = torch.cat([best, first.mixture.mean])
    fits = TrustRegionNewton(max_steps=40, tolerance=1e-2).minimise(
        cost_of(body), starts, search.bounds(body)
    )
    kept = _best_distinct(fits, num_modes)
    if rooted:
        body, kept = _hang_on_best(body, kept)
        loose_now = shaped(load(lengths, free=True), whole)
        loose_now = loose_now.with_base(body.base_rotation, body.base_translation)
        covariance = marginal_covariance(cost_of(loose_now), body, kept.mean, search)
        kept = kept._replace(covariance=covariance)
    result = _as_initialisation(body, kept, first.report)
    second = Stage(
        "cross-sections from joints and contours", shaped(first.body, flesh),
        first.mixture.mean[0], flesh.cost,
    )  # fmt: skip
    third = Stage(
        "all parameters from joints and contours", body, kept.mean[0], float(kept.cost[0])
    )
    return first._replace(
        body=body,
        mixture=result.mixture,
        cost=result.cost,
        report=(
            *(line for line in first.report if line != _scale_report(stature, first.lengths)),
            f"shape: {len(parameters.names)} numbers of the parts fitted to the contours; "
            f"{len(kept.cost)} distinct fits to joints and contours, best cost {third.cost:.1f}",
            _scale_report(stature, lengths),
        ),
        lengths=lengths,
        stages=(*first.stages, second, third),
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


def _as_keypoints(
    joints_2d: Mapping[str, Sequence[float]] | Tensor, joint_names: tuple[str, ...] | None
) -> tuple[tuple[str, ...], Tensor, Tensor]:
    if isinstance(joints_2d, Mapping):
        names = [canonical_joint_name(name) for name in joints_2d]
        unknown = [given for given, name in zip(joints_2d, names, strict=True) if name is None]
        if unknown:
            raise KeypointError(
                f"unknown joint {unknown[0]!r}; the known ones are {', '.join(JOINT_NAMES)}"
            )
        rows = [[*(float(number) for number in place), 1.0][:3] for place in joints_2d.values()]
        if any(len(row) != 3 for row in rows):
            raise KeypointError("expected (u, v) or (u, v, confidence) for every joint")
        table = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
        return tuple(name or "" for name in names), table[:, :2], table[:, 2]
    if (
        joint_names is None
        or len(joint_names) != len(joints_2d)
        or joints_2d.shape[-1] not in (2, 3)
    ):
        raise KeypointError(
            f"joints_2d: expected [joints, 2 or 3] with as many joint_names, got "
            f"{list(joints_2d.shape)} and {'none' if joint_names is None else len(joint_names)}"
        )
    full = joints_2d.shape[-1] == 3
    confidence = joints_2d[:, 2] if full else torch.ones_like(joints_2d[:, 0])
    return joint_names, joints_2d[:, :2], confidence


def _swapped_sides(
    found: Initialisation,
    camera: Camera,
    keypoints: Tensor,
    confidence: Tensor,
    names: tuple[str, ...],
    joints: JointTerm,
    generator: torch.Generator,
) -> list[str]:
    """Say where exchanging left and right would fit much better; nothing is exchanged."""
    best = float(found.cost[0])
    seen = sum(
        seen > 0 and name in found.body.joint_names
        for name, seen in zip(names, confidence.tolist(), strict=True)
    )
    if best < _SUSPICIOUS * seen or not has_root(found.body):
        return []
    quick = Search(num_starts=24, num_flips=0, num_samples=0, max_steps=30)
    costs: dict[str, float] = {}
    for what, places in _SIDED.items():
        swapped = tuple(_other_side(name, places) for name in names)
        if swapped == names:
            continue
        cost = TrackingCost(
            body=found.body,
            camera=camera,
            choice=CostChoice(contour=None, joints=joints, temporal=None),
            observation=JointObservation(
                found.body.joint_names, keypoints.to(found.body.tie),
                confidence.to(found.body.tie), swapped,
            ),
        )  # fmt: skip
        fits = find_interpretations(cost, search=quick, generator=generator)
        costs[what] = float(fits.cost.min())
    if not costs or min(costs.values()) > best - _CLEARLY_BETTER:
        return []
    what = min(costs, key=lambda name: costs[name])
    return [
        f"left and right look swapped in {what}: exchanged, they fit with cost {costs[what]:.1f} "
        f"instead of {best:.1f}; they are used as given, so exchange them if the picture agrees"
    ]


def _other_side(name: str, places: tuple[str, ...]) -> str:
    side, _, place = name.partition("_")
    if side not in ("l", "r") or place not in places:
        return name
    return f"{'r' if side == 'l' else 'l'}_{place}"


def marginal_covariance(
    cost: TrackingCost, body: BodyModel, x: Float[Tensor, "k n"], search: Search
) -> Float[Tensor, "k n n"]:
    """Covariances of poses when the lengths are unknown too.

    Args:
        cost: Cost of the same body with free lengths, on the same base.
        body: The body with lengths held.
        x: Its fitted states.
        search: Whether limits hold.
    """
    loose = cost.body
    columns = [loose.state_index(name) for name in body.state_names]
    full = _spread(body, loose, x)
    model, bounds = cost.local_model(full), search.bounds(loose)
    held = (full <= bounds.lower) & (model.gradient > 0)
    held = held | ((full >= bounds.upper) & (model.gradient < 0))
    lengths = bounds.upper > bounds.lower
    lengths[columns] = False
    covariance = inverse_on_free(
        model.hessian, ~held | lengths, default_prior_variance(loose.bounds)
    )
    return covariance[:, columns][:, :, columns]


def stature_of(lengths: Mapping[str, float], scale: float = 1.0) -> float:
    """Height of the standing body, metres.

    Args:
        lengths: Lengths by name, metres.
        scale: Overall scale of the body, for the height of the ankle.
    """
    names = ("shank", "thigh", "trunk", "neck", "head")
    return scale * _SOLE + sum(lengths[name] for name in names)


def default_sigma(keypoints: Float[Tensor, "j 2"]) -> float:
    """Noise of a detector's keypoints, pixels: 0.6 % of the diagonal of the person's box.

    Detectors err in proportion to the person's size in the image: the beam clip's keypoints, 6 px
    on a person of 950 px, set the ratio. At least one pixel.
    """
    keypoints = keypoints[keypoints.isfinite().all(-1)]
    if len(keypoints) < 2:
        return 3.0
    diagonal = (keypoints.max(dim=0).values - keypoints.min(dim=0).values).norm()
    return max(1.0, 0.006 * float(diagonal))


def check_joints(
    name: str,
    observation: JointObservation,
    body: BodyModel,
    camera: Camera,
    least: int,
) -> tuple[str, ...]:
    """Refuse joints from which nothing can be fitted, and say what is odd about the others.

    Raises:
        KeypointError: If too few joints are seen, or all are at one place.
    """
    seen = observation.weight > 0
    places, index = observation.target[seen], observation.index[seen].tolist()
    names = [body.joint_names[joint] for joint in index]
    if len(names) < least:
        raise KeypointError(
            f"{len(names)} joints of {name} are marked in the first frame, at least {least} are "
            "needed: start at another frame or mark more joints"
        )
    report = []
    apart = torch.cdist(places, places)
    if len(names) > 1 and float(apart.max()) < 1.0:
        raise KeypointError(
            f"all {len(names)} joints are marked at one place, "
            f"({float(places[0, 0]):.0f}, {float(places[0, 1]):.0f}): mark them where they are"
        )
    pairs = torch.nonzero(torch.triu(apart < 0.5, diagonal=1)).tolist()
    if pairs:
        same = ", ".join(f"{names[a]} and {names[b]}" for a, b in pairs)
        report.append(f"joints marked at the same place: {same}")
    outside = [
        n for n, inside in zip(names, camera.inside_image(places), strict=True) if not inside
    ]
    if outside:
        report.append(f"joints outside the image: {', '.join(outside)}")
    return tuple(report)


def _scale(stature: float | None) -> float:
    if stature is None:
        return 1.0
    if not 0.4 <= stature <= 2.8:
        raise BodyError(f"stature: expected a person's height in metres, 0.4 to 2.8, got {stature}")
    return stature / STANDARD_STATURE


def _lengths(body: BodyModel, x: Float[Tensor, " n"], stature: float | None) -> dict[str, float]:
    """Fitted lengths; with known stature made to add up to it, as far as their interval allows."""
    lengths = {
        name: body.lengths[name] + float(x[body.state_index(f"{name}_length")])
        for name in PROPORTIONS
        if f"{name}_length" in body.state_names
    }
    if stature is None or "shank" not in lengths:
        return lengths
    scale = _scale(stature)
    factor = (stature - scale * _SOLE) / (stature_of(lengths, scale) - scale * _SOLE)
    for name, length in lengths.items():
        middle, margin = scale * LENGTHS[name], scale * LENGTHS[name] * PROPORTION_RANGE
        lengths[name] = min(max(length * factor, middle - margin), middle + margin)
    return lengths


def _scale_report(stature: float | None, lengths: Mapping[str, float]) -> str:
    fitted = ", ".join(f"{name} {length:.3f} m" for name, length in lengths.items())
    source = (
        "the prior on proportions sets the scale, which one image does not show"
        if stature is None
        else f"the known stature of {stature:g} m sets the scale"
    )
    return f"{source}; lengths within 10 % of the standard humanoid: {fitted}"


def _undetermined(body: BodyModel, modes: Modes, joints: TrackingCost) -> str | None:
    """Which parameters of the best fit the image leaves at their prior."""
    prior = torch.minimum(
        default_prior_variance(body.bounds).sqrt(), body.sticky_deviation
    ).nan_to_num(posinf=math.inf)
    image = replace(joints, choice=replace(joints.choice, stabiliser=None, anthropometric=None))
    curvature = image.local_model(modes.mean[:1]).hessian[0].diagonal()
    free = torch.as_tensor(modes.active[0]) == 0
    deviation = modes.covariance[0].diagonal().sqrt()
    loose = free & (deviation > _UNDETERMINED * prior)
    # A parameter that moves no marked joint has no curvature at all.
    loose = loose | (curvature.abs() * prior.square() < 1e-6)
    names = [
        name for name, is_loose in zip(body.state_names, loose.tolist(), strict=True) if is_loose
    ]
    if not names:
        return None
    return f"not determined by the joints, kept at their prior: {', '.join(names)}"


def _gross_marks(cost: TrackingCost, x: Float[Tensor, " n"], sigma: float) -> Bool[Tensor, " m"]:
    """Marks that are `_GROSS` of their deviations off the best fit; none if they are many."""
    observation = cost.observation
    assert observation is not None
    joints = cost.body.pose(x).joints[observation.index]
    apart = (cost.camera.project(joints).uv - observation.target).norm(dim=-1)
    gross = apart * observation.weight.sqrt() > _GROSS * sigma
    seen = int((observation.weight > 0).sum())
    return gross if int(gross.sum()) <= _FEW * seen else torch.zeros_like(gross)


def _refine(cost: TrackingCost, x: Float[Tensor, "b n"], search: Search) -> Modes:
    """Descend from fits with other lengths: first at a wide scale, then to the minimum."""
    bounds = search.bounds(cost.body)
    x = descend(cost, x, bounds, ((4.0, 8),))
    return TrustRegionNewton(max_steps=60, tolerance=1e-3).minimise(cost, x, bounds)


def _order(fits: Modes) -> Tensor:
    return fits.cost.nan_to_num(math.inf).argsort(stable=True)


def _best_distinct(fits: Modes, num: int | None) -> Modes:
    keep = distinct_modes(fits.mean, fits.covariance, fits.cost)[:num]
    return Modes(*(field[keep] for field in fits))


def _hang_on_best(body: BodyModel, fits: Modes) -> tuple[BodyModel, Modes]:
    """Hang the body on the root of the best fit; the covariances are still to be mapped.

    Fits that lie across it by a right angle, where the root's angles lock, are left out.
    """
    body, mean, _ = move_base(body, *root_pose(body, fits.mean[0]), fits.mean)
    root = [body.state_index(name) for name in ROOT_NAMES]
    inside = (mean >= body.lower) & (mean <= body.upper)
    keep = torch.nonzero(inside[:, root].all(-1))[:, 0]
    return body, Modes(*(field[keep] for field in fits._replace(mean=mean)))


def _columns(source: BodyModel, target: BodyModel, x: Tensor) -> Tensor:
    """The parameters of one body out of the states of another that has them too."""
    return x[:, [source.state_index(name) for name in target.state_names]]


def _spread(source: BodyModel, target: BodyModel, x: Tensor) -> Tensor:
    """States of a body as those of one with more parameters, which stay at zero."""
    full = x.new_zeros(len(x), target.num_parameters)
    full[:, [target.state_index(name) for name in source.state_names]] = x
    return full


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


def _as_initialisation(body: BodyModel, fits: Modes, warnings: tuple[str, ...]) -> Initialisation:
    mixture = GaussianMixture(fits.mean, fits.covariance, torch.log_softmax(-fits.cost, dim=0))
    best = float(fits.cost[0])
    report = (
        *warnings,
        f"first pose: {len(fits.cost)} distinct fits to the keypoints, best cost {best:.1f}",
    )
    stage = Stage("pose and proportions from joints", body, fits.mean[0], best)
    return Initialisation(body, mixture, fits.cost, report, stages=(stage,))
