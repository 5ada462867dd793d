"""How to track, as one record of choices, and what it makes: features, cost and tracker.

`Settings` is what the command line shows and `summary.json` holds. `make_extractor`, `make_choice`
and `make_tracker` turn it into the three objects that `torchcss.tracking.session` takes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import field, fields, replace
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import torch

from torchcss.body.load import has_free_root, load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.cost.choice import TERM_TABLE, CostChoice
from torchcss.cost.contour import ContourTerm
from torchcss.cost.edge_energy import EdgeEnergyTerm
from torchcss.cost.flow import FlowTerm
from torchcss.cost.frame import FrameCosts
from torchcss.cost.fused import engine_for
from torchcss.cost.joints import JointTerm
from torchcss.cost.region import RegionTerm
from torchcss.cost.segmentation import SegmentationTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.total import Engine
from torchcss.errors import (
    ConfigurationError,
    check_device,
    check_positive,
    check_range,
    make_whole,
)
from torchcss.inference.dynamics import ConstantVelocity, Deviation
from torchcss.inference.grid_tracker import GridTracker
from torchcss.inference.loss_monitor import LossMonitor
from torchcss.inference.proposals import ChamRehg, Condensation, EigenDirectionGrid
from torchcss.inference.tracker import SequenceTracker, Tracker
from torchcss.initialise.view import CameraView
from torchcss.robust import Leclerc, Lorentzian, Quadratic
from torchcss.tracking.presets import PARTS_OF_A_PERSON, PRESETS, Preset, preset_name
from torchcss.tracking.view import Observer
from torchcss.types import Bounds, Curvature, frozen
from torchcss.vision.edges import EdgeConfiguration
from torchcss.vision.features import FeatureExtractor
from torchcss.vision.flow import TRACKING_FLOW

TERMS = (
    *("contour", "motion_boundaries", "region", "segmentation", "flow", "joints"),
    *("stabiliser", "anthropometric", "pose_prior", "interpenetration", "temporal_mixture"),
)
"""Terms and priors of the cost by default: all that do not stand in for one another, but for
`background` and `silhouette`, which take dark clothes before a dark wall for the wall."""

STILL_TERMS = (*(name for name in TERMS if name != "flow"), "background", "silhouette")
"""Those for a camera that stands still: it shows where the body is, also where the flow has lost
it. Where a body turns quickly the flow falls behind, and holds it back."""

PAPER_TERMS = (
    *("contour", "motion_boundaries", "foreground", "flow"),
    *("stabiliser", "anthropometric", "interpenetration"),
)
"""What the cost of [IJRR] has (sections 3.1, 3.2 and 8): edges weighed by motion boundaries and
foreground, flow and priors on parameters; no costs of colours, no prior over time (note 5), no
`edge_energy`, which eq. 8 and 9 lack. The rows of [RR] leave `foreground` and `interpenetration`
out."""

_NO_COST = ("motion_boundaries", "foreground", "background")
"""Names in `Settings.terms` that have no cost of their own. `motion_boundaries` weighs the edges of
`contour` and `edge_energy` by the motion boundaries, `W = 1 - k S_p`; `foreground` those of a
`contour` as printed, by what is learnt of body and background where no mask is given; `background`
tells `region` and `segmentation` what a camera that stands still sees behind the body."""


def all_terms() -> tuple[str, ...]:
    """What can be in `Settings.terms`: the names of `torchcss.cost.choice.TERM_TABLE`, and more."""
    return (*TERM_TABLE, *_NO_COST)


def watched_terms() -> tuple[str, ...]:
    """The terms that compare with the image in every frame, and so tell a loss of the track."""
    return tuple(name for name, term in TERM_TABLE.items() if term.watched)


_SETS = {"default": TERMS, "still": STILL_TERMS, "papers": PAPER_TERMS}


def named_terms(names: Iterable[str]) -> tuple[str, ...]:
    """Terms by name, each once; `default`, `still` and `papers` stand for the sets of these names.

    Args:
        names: Names as a user gives them.
    """
    names = [names] if isinstance(names, str) else names
    return tuple(dict.fromkeys(term for name in names for term in _SETS.get(name, (name,))))


SINGLE_PRECISION = 1e-3
"""Tolerance of descents, nats, from which on single precision is enough: costs are some hundred
nats, of which it leaves an error of 1e-4 (`scripts/evaluate_posterior.py` with either
`--engine-dtype` measures it)."""

_OF_SAMPLES = ("prediction", "oversampling", "likelihood_power", "limb_jumps")
"""Settings of trackers that descend from samples."""

_OF_COST = ("contour_weight", "boundary_emphasis", "potential")
"""Settings of the cost that no preset changes."""

_POTENTIALS = {"lorentzian": Lorentzian, "leclerc": Leclerc}


@frozen
class Settings:
    """How to track; everything here is in `summary.json`.

    Attributes:
        body: Body to track: arm7, arm8, body30, body32, body34, or a URDF, MJCF or BVH file.
        free_root: Let a body move about that by itself stands in one place, as robots do.
        stature: Height of the standing person, metres, where it is known: it sets the size.
        ground: Height of the floor that the person stands on in the first frame, metres along the
            axis of the camera's world that points up, where it is known: it tells the size where
            the stature does not, see `torchcss.initialise.ground`. In a camera's own frame: how far
            it is above the floor, with a minus.
        preset: Tracker: css, ours, or one after the papers, such as ijrr_css, ijrr_condensation and
            rr_multiple_hypothesis; a name that is not there is answered with the list of all, and
            `torchcss.tracking.presets` says what each is.
        samples: Samples per frame; the preset's number by default.
        modes: Modes kept; the preset's number by default.
        prediction: "velocity": a mode is expected where its own last motion leads; "surface": its
            trunk is where its surface has gone in the picture, see
            `torchcss.tracking.surface_prediction`. For trackers that descend from samples.
        oversampling: How many times as many samples are drawn; those with the best edges descend,
            see `Tracker`.
        likelihood_power: Power of a frame's likelihood in the weights of modes and in the
            covariances, above 0 and at most 1, see `Tracker`; the preset's by default.
        limb_jumps: How many other poses of an arm for which the colours do not speak join the
            search, see `torchcss.tracking.limb_moves`; 0 for none. For trackers that descend from
            samples.
        keypoints_use: The preset's by default. "all": keypoints are observations in every frame;
            "first": they only give the first pose, as in the papers.
        terms: Terms and priors of the cost, the preset's by default; `default` stands for ours,
            `still` for those for a camera that stands still, `papers` for the papers'. See
            `make_choice` for what the preset changes.
        curvature: Which Hessian the optimiser gets; the preset's by default. "autograd" is the slow
            reference.
        working_size: Longer side, in pixels, at which features are computed; larger images are
            reduced to it. At least 64.
        contour_weight: Temperature of the contour term, see `ContourTerm`.
        weights: Further factors on terms and priors by name; `scripts/learn_weights.py` learns
            some.
        boundary_emphasis: k of `W = 1 - k S_p`, for the term `motion_boundaries`.
        potential: Robust potential of edges and flow: both papers use both of these, and do not say
            where. Not for presets with Gaussian errors.
        seed: Seed of all random numbers; the same seed gives the same track.
        device: Where to compute.
        dtype: "float64" or "float32".
        engine: "fused": compiled kernels evaluate the cost, on a CPU where numba is installed;
            "eager": the terms as they are written, as everywhere else.
        engine_dtype: Precision of the kernels; sums are in double precision. None: single where the
            preset's descents end at `SINGLE_PRECISION` nats or more, else double.
        threads: With two or more, compiled kernels share out the samples among so many, and the
            next frame's features are found while this one is searched. Nothing else changes.
        overlay: Write `overlay.mp4` and `report.html`.
    """

    body: str = "body34"
    free_root: bool = False
    stature: float | None = None
    ground: float | None = None
    preset: str = "css"
    samples: int | None = None
    modes: int | None = None
    prediction: Literal["velocity", "surface"] = "velocity"
    oversampling: int = 1
    likelihood_power: float | None = None
    limb_jumps: int = 0
    keypoints_use: Literal["first", "all"] | None = None
    terms: tuple[str, ...] | None = None
    curvature: Literal["exact", "gauss-newton", "autograd"] | None = None
    working_size: int = 640
    contour_weight: float = 150.0
    weights: Mapping[str, float] = field(default_factory=dict)
    boundary_emphasis: float = 0.3
    potential: Literal["lorentzian", "leclerc"] = "lorentzian"
    seed: int = 0
    device: str = "cpu"
    dtype: Literal["float64", "float32"] = "float64"
    engine: Literal["fused", "eager"] = "fused"
    engine_dtype: Literal["float32", "float64"] | None = None
    threads: int = 1
    overlay: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "preset", preset_name(self.preset))
        for name in ("body", "device"):  # a path, a torch.device: as the file of a run holds them
            object.__setattr__(self, name, str(getattr(self, name)))
        if self.terms is not None:
            object.__setattr__(self, "terms", named_terms(self.terms))
            _check_terms(self.terms)
        self._check_names()
        self._check_numbers()
        if not PRESETS[self.preset].descends_from_samples:
            for name in _OF_SAMPLES:
                if self._is_given(name):
                    raise ConfigurationError(
                        f"{name}: {self.preset} does not descend from samples; leave it out"
                    )
        if not PRESETS[self.preset].robust and self._is_given("potential"):
            raise ConfigurationError(
                f"potential: {self.preset} has Gaussian errors, no robust ones; leave it out"
            )
        check_device(self.device)

    def _check_names(self) -> None:
        """Weights and choices are known."""
        if not isinstance(self.weights, Mapping):
            raise ConfigurationError(f"weights: expected factors by name, got {self.weights!r}")
        if strange := sorted(set(self.weights) - set(TERM_TABLE)):
            known = ", ".join(TERM_TABLE)
            raise ConfigurationError(f"weights: no terms {strange}; there are {known}")
        for name, kind in get_type_hints(Settings).items():
            value, parts = getattr(self, name), (kind, *get_args(kind))
            choices = [c for part in parts if get_origin(part) is Literal for c in get_args(part)]
            if choices and value not in choices and value != getattr(Settings, name):
                raise ConfigurationError(
                    f"{name} must be one of {', '.join(choices)}, got {value!r}"
                )

    def _check_numbers(self) -> None:
        """Numbers lie where they may."""
        for name, weight in self.weights.items():
            if not 0 <= weight < math.inf:
                raise ConfigurationError(f"weights: {name}: expected 0 or more, got {weight}")
        counts = ("samples", "modes", "working_size", "oversampling", "threads")
        make_whole(self, "seed", "limb_jumps", *counts)
        check_seed(self.seed)
        check_range(self, *counts, least=1)
        check_range(self, "working_size", least=64, hint="; smaller pictures show no limbs")
        check_range(self, "contour_weight", "limb_jumps")
        check_range(self, "boundary_emphasis", "likelihood_power", most=1)
        check_positive(self, "likelihood_power")
        if self.ground is not None and not math.isfinite(self.ground):
            raise ConfigurationError(f"ground must be finite, metres, got {self.ground}")

    @property
    def used_terms(self) -> tuple[str, ...]:
        """The terms: those given, or the preset's."""
        return _preset_terms(PRESETS[self.preset]) if self.terms is None else self.terms

    @property
    def keypoints_first_only(self) -> bool:
        """Whether keypoints count in the first frame alone."""
        return (self.keypoints_use or PRESETS[self.preset].keypoints_use) == "first"

    def changed(self) -> tuple[str, ...]:
        """Names of the options in which the run differs from its preset."""
        row = PRESETS[self.preset]
        differs = {
            **{
                name: self._is_given(name) for name in ("samples", "modes", *_OF_SAMPLES, *_OF_COST)
            },
            "keypoints_use": self.keypoints_first_only != (row.keypoints_use == "first"),
            "terms": set(self.used_terms) != set(_preset_terms(row)),
            "curvature": self.curvature not in (None, row.curvature.value),
            "weights": any(weight != 1 for weight in self.weights.values()),
        }
        return tuple(name for name, does in differs.items() if does)

    def _is_given(self, name: str) -> bool:
        return getattr(self, name) != getattr(Settings, name)

    @property
    def torch_dtype(self) -> torch.dtype:
        """The floating type."""
        return torch.float32 if self.dtype == "float32" else torch.float64


def _preset_terms(row: Preset) -> tuple[str, ...]:
    """The terms of a row of the table."""
    left_out = {"interpenetration"} if not row.interpenetration else set()
    if row.cost == "rr":
        left_out.add("foreground")
    return tuple(term for term in named_terms([row.terms]) if term not in left_out)


def _check_terms(terms: tuple[str, ...]) -> None:
    """Refuse terms that do not exist, or that cannot track."""
    unknown = sorted(set(terms) - set(all_terms()))
    if unknown:
        raise ConfigurationError(f"unknown terms {unknown}; there are {', '.join(all_terms())}")
    if not set(terms) & set(watched_terms()):
        raise ConfigurationError(
            f"terms: expected at least one of {', '.join(watched_terms())}, which compare a "
            f"pose with the image; got {', '.join(terms) or 'none'}"
        )


_NAMES_OF_V01 = {"evidence": "likelihood_power"}


def settings_from_plain(plain: Mapping[str, Any]) -> Settings:
    """Settings from what a run's folder holds of them, also one of an older version.

    Args:
        plain: Numbers, strings and lists by name; names that are no longer known are left out.

    Raises:
        ConfigurationError: If they are not those of a tracker.
    """
    known = {field.name for field in fields(Settings)}
    now = {_NAMES_OF_V01.get(name, name): value for name, value in plain.items()}
    try:
        return Settings(**{name: value for name, value in now.items() if name in known})
    except TypeError as error:
        raise ConfigurationError(
            f"the run's settings are not those of torchcss: {error}"
        ) from error


def check_seed(seed: int) -> None:
    """Refuse a seed that not every generator of random numbers takes.

    Raises:
        ConfigurationError: If it is none.
    """
    if not 0 <= seed < 2**63:
        raise ConfigurationError(f"seed must lie in 0..{2**63 - 1}, got {seed}")


def make_extractor(settings: Settings) -> FeatureExtractor:
    """The features that the settings ask for, in their type and on their device."""
    kinds = [kind for name, kind in TERM_TABLE.items() if name in settings.used_terms]
    needs = {need for kind in kinds for need in kind().needs}
    flow = TRACKING_FLOW if "flow" in needs or "motion_boundaries" in settings.used_terms else None
    report = PRESETS[settings.preset].cost == "rr"
    extractor = FeatureExtractor(
        edges=EdgeConfiguration(window=None, floor=_CONTRAST) if report else None,
        working_size=settings.working_size,
        flow=flow,
        colour="appearance" in needs or "foreground" in settings.used_terms,
    )
    return extractor.to(dtype=settings.torch_dtype, device=settings.device)


_CONTRAST = 0.12
"""Deviation of grey levels that edges are measured by where contrast is not normalised: about what
they have beside an outline. Ours."""


def boundary_emphasis(settings: Settings) -> float:
    """Emphasis k of the motion-boundary weights, zero if the settings do not ask for them."""
    return settings.boundary_emphasis if "motion_boundaries" in settings.used_terms else 0.0


def make_choice(settings: Settings, sigma: float, free_root: bool | None = None) -> CostChoice:
    """The cost that the settings ask for: their terms, and what their preset has to say.

    A particle filter gets no temporal prior: its particles are moved by `p(x_t | x_{t-1})` already,
    and weighed by `p(r_t | x_t)` alone (section 1.1 [IJRR]). The prior would count twice.

    Segmentation weighs what descents have found, which particles are not. An arm gets none either:
    what looks like it may be the rest of the person, who is not modelled. Nor does an arm know a
    background, which the rest of the person would be taken for.

    As printed (`Preset.cost`) the contour is eq. 8 [IJRR] or 7 [RR], the flow eq. 9, both divided
    by N and with the levels of eq. 5, and only what is hard to estimate is stabilised. Gaussian
    errors look at the nearest edge, and their sigma is wider: by a factor that lets an edge at the
    end of the window cost what a node costs that faces away, so that no limb gains by hiding.

    Args:
        settings: Which terms, and which tracker.
        sigma: Keypoint noise in pixels of the working image.
        free_root: Whether the body moves about; None: told by its name.
    """
    row = PRESETS[settings.preset]
    errors = Lorentzian if row.robust else Quadratic
    potential = _POTENTIALS[settings.potential] if row.robust else Quadratic
    chosen = set(settings.used_terms)
    if row.particles is not None:
        chosen -= {"segmentation", "temporal", "temporal_mixture"}
    if not (has_free_root(settings.body) if free_root is None else free_root):
        chosen -= {"segmentation", "background", "silhouette"}
    contour, flow = _node_terms(settings, row, potential)
    background = "background" in chosen
    set_up = (
        contour,
        EdgeEnergyTerm(potential_kind=potential),
        RegionTerm(background=background),
        SegmentationTerm(background=background),
        flow,
        JointTerm(sigma=sigma, potential_kind=errors),
        Stabiliser(
            nu=9.0 if row.robust or row.cost == "ours" else _GAUSSIAN_TAILS,
            lengths="anthropometric" not in chosen,
            hidden_only=row.cost != "ours",
        ),
    )
    terms = {**{name: kind() for name, kind in TERM_TABLE.items()}, **{t.name: t for t in set_up}}
    return CostChoice(
        terms=tuple(term for name, term in terms.items() if name in chosen),
        weights=dict(settings.weights),
        curvature=row.curvature if settings.curvature is None else Curvature(settings.curvature),
    )


_OCCLUSION_FACTOR = {"ijrr": 1.1, "rr": 0.9}
"""k of `nu_occ = k nu`: above 1 in [IJRR] and below it in [RR], eq. 5 of both. Numbers: ours."""

_PRINTED_WINDOW = 8.0
"""Half length of the search as printed, pixels. With `ContourTerm.least_edge` it makes the mean
error per node of a fitted model less than nu, as section 3.1.1 [IJRR] asks for."""

_GAUSSIAN_TAILS = 1e6
"""Height of tails that no parameter reaches."""


def _node_terms(settings: Settings, row: Preset, potential: type) -> tuple[ContourTerm, FlowTerm]:
    """The two terms of eq. 5, as the preset has them."""
    contour = ContourTerm(weight=settings.contour_weight, potential_kind=potential)
    flow = FlowTerm(potential_kind=potential)
    if row.cost != "ours":
        return _printed(contour, flow, row, foreground="foreground" in settings.used_terms)
    # The weights of motion boundaries make the wells of a fitted model shallower; what is back-
    # facing or hidden must not become cheaper than that. 0.3 takes 12 % on the demo's true states.
    # A potential that costs less at the window's end has cheaper fits, too.
    shallower = 0.4 * boundary_emphasis(settings)
    share = contour.unmatched / ContourTerm().unmatched
    contour = replace(contour, fitted_level=share * contour.fitted_level)
    level = contour.unmatched - (1 - shallower) * (contour.unmatched - contour.fitted_level)
    return replace(contour, fitted_level=level), flow


def _printed(
    contour: ContourTerm, flow: FlowTerm, row: Preset, *, foreground: bool
) -> tuple[ContourTerm, FlowTerm]:
    """The two terms as printed: one weight for both, and one N."""
    assert row.cost != "ours"
    factor = _OCCLUSION_FACTOR[row.cost]
    wider = 1.0 if row.robust else _PRINTED_WINDOW / (2**0.5 * contour.sigma)
    return (
        replace(
            contour,
            sigma=wider * contour.sigma,
            window=_PRINTED_WINDOW,
            fitted_level=1.0,
            occlusion_factor=factor,
            assignment="sum" if row.robust else "nearest",
            strength=row.cost == "rr",
            foreground=foreground,
        ),
        replace(
            flow,
            weight=contour.weight,
            sigma=wider * flow.sigma,
            fitted_level=1.0,
            occlusion_factor=factor,
            printed=True,
        ),
    )


def make_tracker(
    settings: Settings, motion: Deviation = 0.0, body: BodyModel | None = None
) -> SequenceTracker:
    """The tracker that the settings ask for: the row of the table with their numbers.

    Args:
        settings: Preset and numbers; arms and bodies differ in the preset's.
        motion: Standard deviation of every parameter's motion per frame.
        body: The body; None: the one that the settings name.
    """
    row, body = PRESETS[settings.preset], body or load_body(settings.body)
    arm = not has_root(body)
    num_samples = settings.samples or (row.samples_arm if arm else row.samples_body)
    num_modes = settings.modes or (row.modes_arm if arm else row.modes_body)
    many = isinstance(motion, tuple)
    noise = tuple(row.noise * m for m in motion) if many else row.noise * motion
    dynamics = ConstantVelocity(deviation=noise, persistence=row.persistence)
    if row.particles is not None:
        return replace(
            row.particles, num_samples=num_samples, num_modes=num_modes, dynamics=dynamics
        )
    proposal = (row.proposal_arm if arm else None) or row.proposal
    assert proposal is not None
    if isinstance(proposal, EigenDirectionGrid):
        return GridTracker(
            pattern=proposal,
            num_samples=num_samples,
            num_modes=num_modes,
            optimiser=row.optimiser,
        )
    parts = min(body.num_parts or PARTS_OF_A_PERSON, PARTS_OF_A_PERSON)
    power = 1.0 if row.power_of_part is None else row.power_of_part * parts
    # Who searches by noise adds it in the proposal; the dynamics themselves then add none.
    if isinstance(proposal, (ChamRehg, Condensation)):
        proposal, dynamics = replace(proposal, deviation=noise), replace(dynamics, deviation=0.0)
    return Tracker(
        proposal=proposal,
        num_samples=num_samples,
        num_modes=num_modes,
        optimiser=row.optimiser,
        coarse_every=row.coarse_every,
        converged_only=row.converged_only,
        capped=row.capped,
        keep_alike=row.keep_alike,
        likelihood_power=settings.likelihood_power or power,
        oversampling=settings.oversampling,
        survivors=row.survivors_arm if arm else row.survivors_body,
        dynamics=dynamics,
        separation=row.separation,
        soft_matching=row.soft_matching,
        surprise=row.surprise,
    )


def make_engine(settings: Settings) -> Engine | None:
    """What evaluates the cost; None: the terms as they are written."""
    coarse = PRESETS[settings.preset].optimiser.tolerance >= SINGLE_PRECISION
    dtype = settings.engine_dtype or ("float32" if coarse else "float64")
    return engine_for(settings.engine, settings.device, dtype, settings.threads)


class Plan(NamedTuple):
    """What settings mean for a body before a camera: the parts of a session.

    Attributes:
        extractor: Makes the features.
        choice: Terms and weights of the cost, in pixels of the features of the first view.
        tracker: Search, optimiser, numbers of samples and modes.
        bounds: Bounds that the search obeys.
        one_fit: Whether the track starts from the likeliest fit of the first frame alone.
        keypoints_first_only: Whether keypoints count in the first frame alone.
        boundary_emphasis: Weight of motion boundaries, see `FrameFeatures.edge_field`.
        monitor: Tells from the costs when the track is lost.
        jumps_every: Every how many frames the flips of the best mode join the search; 0: never, and
            no limb is put at keypoints that it misses.
        limb_jumps: How many other poses of an arm join the search; 0: none.
        surface_prediction: Whether the pictures tell where each mode's trunk is expected.
        frame_interval: Seconds between frames.
        noise: Noise of a wrist's keypoint that the cost is told, pixels of those features.
        engine: What evaluates the cost; None: the terms as they are written.
    """

    extractor: FeatureExtractor
    choice: CostChoice
    tracker: SequenceTracker
    bounds: Bounds
    one_fit: bool
    keypoints_first_only: bool
    boundary_emphasis: float
    monitor: LossMonitor
    jumps_every: int
    limb_jumps: int
    surface_prediction: bool
    frame_interval: float
    noise: float
    engine: Engine | None

    def observer(self, body: BodyModel, view: CameraView) -> Observer:
        """One camera's part of the loop.

        Args:
            body: The body; later it may hang on another base.
            view: The camera.
        """
        costs = FrameCosts(
            body,
            self.extractor.working_camera(view.camera),
            self.choice,
            frame_interval=self.frame_interval,
            boundary_emphasis=self.boundary_emphasis,
            engine=self.engine,
        )
        return Observer(
            view=view,
            costs=costs,
            extractor=self.extractor,
            relative_noise=_working_noise(self.extractor, view) / self.noise,
            contrast=self.surface_prediction,
        )


def make_plan(settings: Settings, body: BodyModel, view: CameraView, frame_interval: float) -> Plan:
    """Decide what the settings mean.

    Args:
        settings: How to track.
        body: The body.
        view: The first camera, whose keypoints set the noise.
        frame_interval: Seconds between frames.
    """
    extractor, row = make_extractor(settings), PRESETS[settings.preset]
    noise, motion = _working_noise(extractor, view), body.motion_rate * frame_interval
    return Plan(
        extractor=extractor,
        choice=make_choice(settings, noise, has_root(body)),
        tracker=make_tracker(settings, tuple(motion.tolist()), body),
        bounds=row.bounds(body.bounds),
        one_fit=row.start == "one fit",
        keypoints_first_only=settings.keypoints_first_only,
        boundary_emphasis=boundary_emphasis(settings),
        monitor=LossMonitor(),
        jumps_every=row.jumps_every,
        limb_jumps=settings.limb_jumps,
        surface_prediction=settings.prediction == "surface",
        frame_interval=frame_interval,
        noise=noise,
        engine=make_engine(settings),
    )


def _working_noise(extractor: FeatureExtractor, view: CameraView) -> float:
    """Noise of a view's keypoints in pixels of the features."""
    full = view.camera.image_size_wh
    return view.noise * extractor.working_shape(*full)[0] / full[0]
