"""From frames to a trajectory: the one loop that the command line, scripts and notebooks share.

`track_frames` turns any sequence of images into tracked frames: features, cost, one step of the
tracker, and the base transform moved where the root's angles come near their lock. `track_video`
wraps it for files: it reads video, camera and keypoints, finds the first pose, and writes
`track.npz`, `summary.json` and `overlay.mp4` as it goes, so that a stopped run keeps what it has.
"""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from tqdm import tqdm

from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, has_root, move_base, root_pose
from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.contour import ContourTerm
from torchcss.cost.edge_energy import EdgeEnergyField, EdgeEnergyTerm, edge_energy_field
from torchcss.cost.flow import FlowTargets, FlowTerm, InteriorNodes, flow_targets
from torchcss.cost.interpenetration import Interpenetration, InterpenetrationPairs
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.temporal import MixturePrior, TemporalPrior
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.cost.visibility import ContourPredictor, visible_nodes
from torchcss.errors import ConfigurationError, KeypointError, VideoError
from torchcss.first_pose import LEAST_JOINTS
from torchcss.hypotheses import Initialisation
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import unbounded
from torchcss.inference.tracker import SequenceTracker, Tracker, TrackerInfo, TrackerState
from torchcss.initialise import initialise
from torchcss.io.cameras import check_image_size, read_camera
from torchcss.io.fitted_body import read_fitted_body
from torchcss.io.keypoints import Keypoints, read_keypoints
from torchcss.io.overlay import ProjectedPart, draw_overlay
from torchcss.io.tracks import TrackWriter, prepare_output_folder, write_summary
from torchcss.io.video import Frame, VideoReader, VideoWriter
from torchcss.marks import default_sigma
from torchcss.presets import PRESETS, make_tracker
from torchcss.robust import Quadratic
from torchcss.stopwatch import Stopwatch
from torchcss.synthetic import grid_faces
from torchcss.types import Status
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor
from torchcss.vision.flow import TRACKING

TERMS = (
    *("contour", "motion_boundaries", "flow", "joints"),
    *("stabiliser", "anthropometric", "interpenetration", "temporal"),
)
"""Terms and priors of the cost by default: all that do not stand in for one another."""

ALL_TERMS = (
    *("contour", "motion_boundaries", "edge_energy", "flow", "joints"),
    *("stabiliser", "anthropometric", "interpenetration", "temporal", "temporal_mixture"),
)
"""Terms and priors that can be chosen; see `torchcss.cost.total`. `motion_boundaries` weighs the
edges of `contour` and `edge_energy` by the motion boundaries, `W = 1 - k S_p`."""

_PITCH_LIMIT = math.radians(55)
"""The base follows once the root's pitch exceeds this, well before it locks at 90 degrees."""

_SAVE_SHARE = 0.05
"""Share of the time that may go into saving the track as it grows: a full disk then leaves nearly
all of it, since a save replaces the last good file only when it is complete."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How to track; everything here is in `summary.json`.

    Attributes:
        body: Body to track: arm7, arm8, body30, body32 or body34.
        preset: Tracker, a name in `presets.PRESETS`.
        samples: Samples per frame; the preset's number by default.
        modes: Modes kept; the preset's number by default.
        oversampling: How many times as many samples are drawn; those with the best edges descend,
            see `Tracker`.
        keypoints_use: "all": keypoints are observations in every frame; "first": they only
            give the first pose, as in the papers.
        terms: Terms and priors of the cost; see `make_choice` for what the preset changes.
        working_size: Longer side, in pixels, at which features are computed; larger images are
            reduced to it.
        contour_weight: Temperature of the contour term, see `CostChoice`.
        boundary_emphasis: k of `W = 1 - k S_p`, for the term `motion_boundaries`.
        seed: Seed of all random numbers; the same seed gives the same track.
        device: Where to compute.
        dtype: "float64" or "float32".
        overlay: Write `overlay.mp4`.
    """

    body: str = "body34"
    preset: str = "css"
    samples: int | None = None
    modes: int | None = None
    oversampling: int = 1
    keypoints_use: Literal["first", "all"] = "all"
    terms: tuple[str, ...] = TERMS
    working_size: int = 640
    contour_weight: float = 150.0
    boundary_emphasis: float = 0.3
    seed: int = 0
    device: str = "cpu"
    dtype: Literal["float64", "float32"] = "float64"
    overlay: bool = True

    def __post_init__(self) -> None:
        if self.preset not in PRESETS:
            raise ConfigurationError(f"no tracker {self.preset!r}; there are {', '.join(PRESETS)}")
        unknown = sorted(set(self.terms) - set(ALL_TERMS))
        if unknown:
            raise ConfigurationError(f"unknown terms {unknown}; there are {', '.join(ALL_TERMS)}")
        for name in ("samples", "modes", "working_size", "oversampling"):
            number = getattr(self, name)
            if number is not None and number < 1:
                raise ConfigurationError(f"{name} must be at least 1, got {number}")
        try:
            torch.empty(0, device=self.device)
        except (RuntimeError, AssertionError) as error:  # the latter without CUDA
            raise ConfigurationError(
                f"device {self.device!r} is not available here; use cpu"
            ) from error

    @property
    def torch_dtype(self) -> torch.dtype:
        """The floating type."""
        return torch.float32 if self.dtype == "float32" else torch.float64


class TrackedFrame(NamedTuple):
    """One frame's result.

    Attributes:
        frame: The image and its place in the video.
        body: The body on this frame's base.
        state: The tracker's state, best mode first.
        info: What the step did.
        joints_world: Joint centres of the modes, metres.
        terms: Cost of the best mode by term, nats.
        seconds: Wall time of the frame by stage.
        term_seconds: Wall time of the search by what was evaluated; the rest of it is the
            optimiser's own.
    """

    frame: Frame
    body: BodyModel
    state: TrackerState
    info: TrackerInfo
    joints_world: Float[Tensor, "k j 3"]
    terms: dict[str, float]
    seconds: dict[str, float]
    term_seconds: dict[str, float]


Observe = Callable[[int], JointObservation | None]
"""Keypoints of a frame by its index, in pixels of the working image; None if there are none."""


def track_frames(
    frames: Iterable[Frame],
    *,
    body: BodyModel,
    mixture: GaussianMixture,
    camera: Camera,
    extractor: FeatureExtractor,
    tracker: SequenceTracker,
    choice: CostChoice,
    observe: Observe,
    frame_interval: float,
    generator: torch.Generator,
    boundary_emphasis: float = 0.0,
    limits: bool = True,
    masks: Iterable[np.ndarray | Tensor] | None = None,
) -> Iterator[TrackedFrame]:
    """Track a body through a sequence of images.

    Args:
        frames: The images, in order.
        body: The body on its base.
        mixture: Where it may be in the first frame.
        camera: Camera of the full-size images.
        extractor: Makes the features, at its working size.
        tracker: Search, optimiser, numbers of samples and modes.
        choice: Terms and weights of the cost; pixels are those of the working image.
        observe: Keypoints by frame.
        frame_interval: Seconds between frames, which scales the expected motion.
        generator: Source of the samples.
        boundary_emphasis: Weight of motion boundaries, see `FrameFeatures.edge_field`.
        limits: Whether joint limits hold.
        masks: Foreground of each of the images, of their size, as `FeatureExtractor` takes it;
            None: not known.

    Yields:
        A `TrackedFrame` for every frame.
    """
    working = extractor.working_camera(camera).to(dtype=body.dtype, device=body.tie.device)
    edges = choice.contour is not None or choice.edge_energy is not None
    predictor = ContourPredictor(body) if edges else None
    interior = InteriorNodes(body) if choice.flow is not None else None
    pairs = InterpenetrationPairs(body) if choice.interpenetration is not None else None
    last_image, foregrounds = None, None if masks is None else iter(masks)
    deviation = body.motion_rate * frame_interval
    state = tracker.init(mixture, generator=generator)
    for frame in frames:
        clock = time.perf_counter()
        mask = None
        if foregrounds is not None and (mask := next(foregrounds, None)) is None:
            raise VideoError(f"the masks end before frame {frame.index}; give one for every frame")
        features = extractor(frame.image, last_image, mask)
        last_image = frame.image
        edge_field = features.edge_field(boundary_emphasis=boundary_emphasis).to(body.tie)
        energy = None
        if choice.edge_energy is not None:
            energy = edge_energy_field(edge_field)
        targets = None
        if interior is not None and features.flow is not None:
            mean = state.mixture.mean
            before = body.pose(mean)
            points = interior(body, before).points
            targets = flow_targets(
                interior,
                body,
                mean,
                working,
                features.flow.to(body.tie),
                None if features.flow_outlier is None else features.flow_outlier.to(body.tie),
                visible_nodes(body, before, working.centre_world, points, interior.node_part),
            )
        featured = time.perf_counter()
        stopwatch = Stopwatch()

        def cost_of(
            parent: Tensor,
            prior: GaussianMixture,
            body: BodyModel = body,
            edge_field: Tensor = edge_field,
            energy: EdgeEnergyField | None = energy,
            index: int = frame.index,
            targets: FlowTargets | None = targets,
            stopwatch: Stopwatch = stopwatch,
        ) -> TrackingCost:
            return TrackingCost(
                body=body,
                camera=working,
                choice=choice,
                predictor=predictor,
                edge_field=edge_field,
                energy=energy,
                interior=interior,
                pairs=pairs,
                targets=None if targets is None else targets.take(parent),
                observation=observe(index),
                parent=prior.mean[parent],
                deviation=deviation,
                previous=None
                if choice.temporal_mixture is None
                else choice.temporal_mixture.density(prior),
                stopwatch=stopwatch,
            )

        prior = state.mixture
        bounds = body.bounds if limits else unbounded(state.mixture.mean)
        state, info = tracker.step(state, cost_of, bounds)
        searched, term_seconds = time.perf_counter(), dict(stopwatch.seconds)
        mean = state.mixture.mean
        terms = cost_of(info.origin[:1], prior).terms(mean[:1])
        yield TrackedFrame(
            frame,
            body,
            state,
            info,
            body.pose(mean).joints,
            {name: float(value[0]) for name, value in terms.items()},
            {"features": featured - clock, "search": searched - featured},
            term_seconds,
        )
        body, state = follow_with_base(body, state)


def follow_with_base(body: BodyModel, state: TrackerState) -> tuple[BodyModel, TrackerState]:
    """Move the base under the best mode if the root's pitch nears its lock (design decision 11)."""
    if not has_root(body):
        return body, state
    best = state.mixture.mean[0]
    angles = best[[body.state_index(name) for name in ROOT_NAMES[3:]]]
    if float(angles[1].abs()) < _PITCH_LIMIT and float(angles.abs().max()) < math.radians(270):
        return body, state
    mixture = state.mixture
    body, mean, covariance = move_base(
        body, *root_pose(body, best), mixture.mean, mixture.covariance
    )
    assert covariance is not None
    moved = mixture._replace(mean=mean, covariance=covariance)
    # Particles belong to the old base; a filter draws new ones from the mixture.
    return body, state._replace(
        mixture=moved, velocity=torch.zeros_like(state.velocity), particles=None
    )


def scale_keypoints(
    keypoints: Float[Tensor, "*t j 2"], full: tuple[int, int], working: tuple[int, int]
) -> Float[Tensor, "*t j 2"]:
    """Pixels of the full image to pixels of the working image (centres at integers)."""
    factor = keypoints.new_tensor([working[0] / full[0], working[1] / full[1]])
    return (keypoints + 0.5) * factor - 0.5


def draw_modes(
    tracked: TrackedFrame, camera: Camera, *, rings: int = 16, meridians: int = 20
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the best mode as a shaded body and the others as outlines over the frame.

    Args:
        tracked: A tracked frame.
        camera: Camera of the full-size image.
        rings: Latitudes of the drawn mesh.
        meridians: Longitudes of the drawn mesh.
    """
    body, mixture = tracked.body, tracked.state.mixture
    mesh = body.mesh(rings, meridians)
    faces = grid_faces(rings, meridians)
    rotation, centre = body.part_poses(body.pose(mixture.mean))
    local = mesh.points.flatten(1, 2)
    points = local @ rotation.transpose(-1, -2) + centre[..., None, :]
    modes = []
    for mode in points:
        parts = []
        for part, vertices in enumerate(mode):
            uv, depth, valid = (tensor.cpu() for tensor in camera.project(vertices))
            parts.append(ProjectedPart(uv, depth, valid, faces, part))
        modes.append(parts)
    text = (
        f"frame {tracked.frame.index}   {len(modes)} modes   cost {float(tracked.info.cost[0]):.1f}"
    )
    picture = draw_overlay(
        torch.from_numpy(np.ascontiguousarray(tracked.frame.image)),
        modes,
        weights=mixture.weight,
        text=text,
    )
    return picture.numpy()


@dataclass(kw_only=True)
class Recorder:
    """Writes a run as it goes: track, summary and overlay.

    Attributes:
        folder: The output folder.
        settings: What is run.
        tracker: The tracker that the settings made, for its numbers.
        camera: Camera of the full-size images, for the overlay.
        frame_rate: Frames per second of the overlay.
        notes: Lines for the user, also in the summary.
        extra: Further entries of the summary.
    """

    folder: Path
    settings: Settings
    tracker: SequenceTracker
    camera: Camera
    frame_rate: float
    notes: list[str] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)

    def run(self, frames: Iterator[TrackedFrame], body: BodyModel, total: int | None) -> dict:
        """Track to the end, or to an interruption, which is recorded and raised again.

        Args:
            frames: What `track_frames` yields.
            body: The body, for the names in the file.
            total: Number of frames, for the progress bar.

        Returns:
            The summary.
        """
        writer = TrackWriter(
            self.folder / "track.npz", state_names=body.state_names, joint_names=body.joint_names
        )
        totals: dict[str, float] = {}
        terms: dict[str, float] = {}
        term_seconds: dict[str, float] = {}
        counts = {"samples": 0, "iterations": 0, "distinct": 0}
        statuses = torch.zeros(len(Status), dtype=torch.long)
        ended, began = "interrupted", time.perf_counter()
        saved, took = began, 0.0
        summary: dict[str, Any] = {}
        with ExitStack() as stack:
            film = None
            if self.settings.overlay:
                film = stack.enter_context(
                    VideoWriter(self.folder / "overlay.mp4", self.frame_rate)
                )
            bar = stack.enter_context(tqdm(frames, total=total, unit="frame", dynamic_ncols=True))
            try:
                for frame in bar:
                    self._append(writer, frame)
                    drawn = time.perf_counter()
                    if film is not None:
                        film.write(draw_modes(frame, self.camera))
                    seconds = {**frame.seconds, "overlay": time.perf_counter() - drawn}
                    for into, values in (
                        (totals, seconds),
                        (terms, frame.terms),
                        (term_seconds, frame.term_seconds),
                    ):
                        for name, value in values.items():
                            into[name] = into.get(name, 0.0) + value
                    counts["samples"] += int(frame.info.num_samples)
                    counts["iterations"] += int(frame.info.num_steps.sum())
                    counts["distinct"] += int(frame.info.num_distinct)
                    statuses += frame.info.status_counts.cpu()
                    bar.set_postfix(
                        cost=f"{float(frame.info.cost[0]):.1f}",
                        modes=len(frame.state.mixture.mean),
                    )
                    start = time.perf_counter()
                    if _SAVE_SHARE * (start - saved) >= took:
                        writer.save()
                        saved = time.perf_counter()
                        took = saved - start
                ended = "complete"
            finally:
                if len(writer):
                    writer.save()
                    summary = self._summary(
                        ended, len(writer), time.perf_counter() - began, totals, terms,
                        term_seconds, counts, statuses,
                    )  # fmt: skip
                    write_summary(self.folder, summary)
        return summary

    def _append(self, writer: TrackWriter, frame: TrackedFrame) -> None:
        base = np.eye(4)
        base[:3, :3] = frame.body.base_rotation.cpu().numpy()
        base[:3, 3] = frame.body.base_translation.cpu().numpy()
        mixture = frame.state.mixture
        writer.append(
            frame=frame.frame.index,
            time_s=frame.frame.time_s,
            state=mixture.mean,
            covariance=mixture.covariance,
            log_weight=mixture.log_weight,
            cost=frame.info.cost,
            parent=frame.info.parent if len(writer) else torch.full_like(frame.info.parent, -1),
            joints_world=frame.joints_world,
            base_transform=base,
        )

    def _summary(
        self,
        ended: str,
        num_frames: int,
        wall: float,
        seconds: dict[str, float],
        terms: dict[str, float],
        term_seconds: dict[str, float],
        counts: dict[str, int],
        statuses: Tensor,
    ) -> dict[str, Any]:
        return {
            "ended": ended,
            "body": self.settings.body,
            "preset": self.settings.preset,
            "seed": self.settings.seed,
            "samples": self.tracker.num_samples,
            "modes": self.tracker.num_modes,
            "settings": asdict(self.settings),
            "versions": {
                "python": platform.python_version(),
                **{name: version(name) for name in ("torchcss", "torch", "kornia", "numpy")},
            },
            "num_frames": num_frames,
            "seconds_per_frame": wall / num_frames,
            "seconds_per_frame_by_stage": {k: v / num_frames for k, v in seconds.items()},
            "samples_optimised": counts["samples"],
            "iterations": counts["iterations"],
            "iterations_per_sample": counts["iterations"] / max(counts["samples"], 1),
            "distinct_modes_per_frame": counts["distinct"] / num_frames,
            "optimiser_status": {s.name.lower(): int(statuses[s]) for s in Status},
            "best_mode_cost_by_term": {k: v / num_frames for k, v in terms.items()},
            "share_of_cost_by_term": _shares(terms),
            "share_of_search_time_by_term": _shares(
                {
                    **term_seconds,
                    "optimiser": seconds.get("search", 0.0) - sum(term_seconds.values()),
                }
            ),
            "notes": self.notes,
            **self.extra,
        }


def _shares(values: dict[str, float]) -> dict[str, float]:
    whole = sum(values.values())
    return {name: value / whole if whole else 0.0 for name, value in values.items()}


def make_extractor(settings: Settings) -> FeatureExtractor:
    """The features that the settings ask for, in their type and on their device."""
    moving = {"flow", "motion_boundaries"} & set(settings.terms)
    flow = TRACKING if moving else None
    extractor = FeatureExtractor(working_size=settings.working_size, flow=flow)
    return extractor.to(dtype=settings.torch_dtype, device=settings.device)


def boundary_emphasis(settings: Settings) -> float:
    """Emphasis k of the motion-boundary weights, zero if the settings do not ask for them."""
    return settings.boundary_emphasis if "motion_boundaries" in settings.terms else 0.0


def make_choice(settings: Settings, sigma: float) -> CostChoice:
    """The cost that the settings ask for: their terms, and what their preset has to say.

    A particle filter gets no temporal prior: its particles are moved by `p(x_t | x_{t-1})` already,
    and weighed by `p(r_t | x_t)` alone (section 1.1 [IJRR]). The prior would count twice.

    Args:
        settings: Which terms, and which tracker.
        sigma: Keypoint noise in pixels of the working image.
    """
    row = PRESETS[settings.preset]
    has = settings.terms.__contains__
    repels = has("interpenetration") if row.interpenetration is None else row.interpenetration
    descends = row.particles is None
    potential: dict[str, Any] = {} if row.robust else {"potential_kind": Quadratic}
    contour = ContourTerm(**potential)
    # The weights of motion boundaries make the wells of a fitted model shallower; what is back-
    # facing or hidden must not become cheaper than that. 0.3 takes 12 % on the demo's true states.
    shallower = 0.4 * boundary_emphasis(settings)
    level = contour.unmatched - (1 - shallower) * (contour.unmatched - contour.fitted_level)
    return CostChoice(
        contour=replace(contour, fitted_level=level) if has("contour") else None,
        edge_energy=EdgeEnergyTerm(**potential) if has("edge_energy") else None,
        flow=FlowTerm(**potential) if has("flow") else None,
        joints=JointTerm(sigma=sigma, **potential) if has("joints") else None,
        stabiliser=Stabiliser() if has("stabiliser") else None,
        anthropometric=Anthropometric() if has("anthropometric") else None,
        temporal=TemporalPrior() if has("temporal") and descends else None,
        temporal_mixture=MixturePrior() if has("temporal_mixture") and descends else None,
        interpenetration=Interpenetration() if repels else None,
        contour_weight=settings.contour_weight,
        curvature=row.curvature,
    )


def make_settings_tracker(settings: Settings, motion: Float[Tensor, " n"]) -> SequenceTracker:
    """The tracker that the settings ask for.

    Args:
        settings: Preset and numbers.
        motion: Standard deviation of every parameter's motion per frame.

    Raises:
        ConfigurationError: If the preset's tracker cannot be oversampled.
    """
    tracker = make_tracker(
        settings.preset,
        settings.body,
        num_samples=settings.samples,
        num_modes=settings.modes,
        motion=tuple(motion.tolist()),
    )
    if settings.oversampling == 1:
        return tracker
    if not isinstance(tracker, Tracker):
        raise ConfigurationError(
            f"oversampling: {settings.preset} does not descend from samples; leave it at 1"
        )
    return replace(tracker, oversampling=settings.oversampling)


def track_video(
    video: Path,
    *,
    camera: Path,
    keypoints: Path,
    out: Path,
    settings: Settings | None = None,
    camera_name: str | None = None,
    start: int = 0,
    stop: int | None = None,
    stride: int = 1,
    layout: str | None = None,
    normalised: bool = False,
    masks: Path | None = None,
    init: Path | None = None,
) -> dict[str, Any]:
    """Track a body through a video file.

    Args:
        video: A video, or a folder of images.
        camera: Calibration file, see `torchcss.io.cameras`.
        keypoints: 2D joints, see `torchcss.io.keypoints`.
        out: Folder for `track.npz`, `summary.json` and `overlay.mp4`.
        settings: How to track.
        camera_name: Which camera of the file; by default the one of this video.
        start: First frame.
        stop: Frame before which to end.
        stride: Every how many frames to track.
        layout: Layout of a keypoint file that does not name its joints.
        normalised: Whether keypoints are fractions of the image.
        masks: Foreground of every frame, white or in shades of belief: a video or a folder of
            images, of the size and number of the video's frames.
        init: A body that `torchcss init` fitted to the first frame, to start from.

    Returns:
        The summary.

    Raises:
        TorchcssError: With one line that says what was wrong, for any bad input.
    """
    settings = settings or Settings()
    out = Path(out)
    prepare_output_folder(out)
    part = {"start": start, "stop": stop, "stride": stride}
    reader = VideoReader(video, **part)
    width, height = reader.info.width, reader.info.height
    foreground = None if masks is None else VideoReader(masks, **part)
    if foreground is not None and (foreground.info.width, foreground.info.height) != (
        width,
        height,
    ):
        raise VideoError(
            f"{masks}: masks must have the video's size {width} x {height}, these have "
            f"{foreground.info.width} x {foreground.info.height}"
        )
    loaded = read_camera(camera, camera_name=camera_name, video=video)
    check_image_size(loaded.camera, width, height)
    num_frames = reader.info.num_frames or reader.count_frames()
    marks = read_keypoints(
        keypoints,
        image_size_wh=(width, height),
        num_frames=num_frames,
        layout=layout,
        normalised=normalised,
        first_frame=start,
    )
    notes = [note for note in (loaded.units_note, *marks.report) if note]
    generator = torch.Generator().manual_seed(settings.seed)
    dtype, device = settings.torch_dtype, settings.device
    eye = loaded.camera.to(dtype=dtype, device=device)
    sigma = _sigma(marks)
    if init is not None:
        first = _first_pose_from_file(init, eye, settings)
    else:
        (frame,) = VideoReader(video, start=start, stop=start + 1)
        first = initialise(
            frame.image,
            torch.cat([marks.keypoints[start], marks.confidence[start, :, None]], dim=-1),
            eye,
            settings.body,
            joint_names=marks.joint_names,
            generator=generator,
            sigma=sigma,
            contours="contour" in settings.terms,
            working_size=settings.working_size,
            least_joints=LEAST_JOINTS,
            dtype=dtype,
            device=device,
        )
    notes += first.report
    for note in notes:
        tqdm.write(note)

    extractor = make_extractor(settings)
    working = extractor.working_shape(width, height)
    scaled = scale_keypoints(marks.keypoints, (width, height), working).to(dtype).to(device)
    confidence = marks.confidence.to(dtype).to(device)

    def observe(index: int) -> JointObservation | None:
        if settings.keypoints_use == "first" and index != start:
            return None
        return JointObservation(
            first.body.joint_names, scaled[index], confidence[index], marks.joint_names
        )

    interval = stride / float(reader.info.frame_rate)
    tracker = make_settings_tracker(settings, first.body.motion_rate * interval)
    recorder = Recorder(
        folder=out,
        settings=settings,
        tracker=tracker,
        camera=eye,
        frame_rate=1 / interval,
        notes=notes,
        extra={
            "video": str(video),
            "camera": loaded.camera.name,
            "world_is_metric": loaded.metric,
            "body_lengths_m": first.body.lengths,
        },
    )
    tracked = track_frames(
        reader,
        body=first.body,
        mixture=first.mixture,
        camera=loaded.camera,
        extractor=extractor,
        tracker=tracker,
        choice=make_choice(settings, sigma * working[0] / width),
        observe=observe,
        frame_interval=interval,
        generator=generator,
        boundary_emphasis=boundary_emphasis(settings),
        limits=PRESETS[settings.preset].limits,
        masks=None if foreground is None else (mask.image for mask in foreground),
    )
    return recorder.run(tracked, first.body, reader.num_selected)


def _first_pose_from_file(path: Path, camera: Camera, settings: Settings) -> Initialisation:
    """A fitted body, hung before the video's camera as it was before the picture's."""
    fitted = read_fitted_body(
        path, camera=camera, dtype=settings.torch_dtype, device=settings.device
    )
    if fitted.body.name != settings.body:
        raise ConfigurationError(
            f"{path}: the fitted body is {fitted.body.name}, to be tracked is {settings.body}; "
            f"give the body {fitted.body.name}"
        )
    note = f"first pose: {len(fitted.cost)} hypotheses from {path}"
    return Initialisation(fitted.body, fitted.mixture, fitted.cost, (note,))


def _sigma(marks: Keypoints) -> float:
    """Keypoint noise, from the person's typical size over the whole sequence."""
    sizes = [
        default_sigma(points[seen > 0])
        for points, seen in zip(marks.keypoints, marks.confidence, strict=True)
        if int((seen > 0).sum()) >= 2
    ]
    if not sizes:
        raise KeypointError("no frame has two keypoints; nothing can be tracked from them")
    return float(np.median(sizes))
