"""From frames to a trajectory: the one loop that the command line, scripts and notebooks share.

`track_frames` turns any sequence of images into tracked frames: features, cost, one step of the
tracker, and the base transform moved where the root's angles near their lock. `torchcss.cost.frame`
makes the cost of a frame from its features; whoever looks at a cost, or smooths a track, uses the
same. `torchcss.app.track.track_video` wraps the loop for files.

Any number of synchronised, calibrated cameras may look on (`ViewStream`): what all of them see adds
up in the cost. A camera that sends pictures of one colour, or none any more, is out: it says
nothing until it is back.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, has_root, move_base, root_pose
from torchcss.cost.frame import FrameCosts, beside
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.inference.mixture import GaussianMixture, tempered
from torchcss.inference.proposals import unbounded
from torchcss.inference.tracker import (
    CostFactory,
    SequenceTracker,
    Tracker,
    TrackerInfo,
    TrackerState,
    stated_evidence,
)
from torchcss.inference.trust_region import default_prior_variance
from torchcss.stopwatch import Stopwatch
from torchcss.tracking.flip_moves import with_flips
from torchcss.tracking.limb_moves import with_limbs
from torchcss.tracking.recovery import Recovery
from torchcss.tracking.surface_prediction import Carrier, Displaced, Sight
from torchcss.tracking.view import Observe, ViewStream, Watcher
from torchcss.types import Frame
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor

_PITCH_LIMIT = math.radians(55)
"""The base follows once the root's pitch exceeds this, well before it locks at 90 degrees."""


NUM_JUMPS = 8
"""Flips of the best mode that join the search where jumps are made."""


class TrackedFrame(NamedTuple):
    """One frame's result.

    Attributes:
        frame: The image and its place in the video.
        body: The body on this frame's base.
        state: The tracker's state, best mode first.
        info: What the step did.
        covariance: Covariances of the modes with the likelihood to a power, `stated_evidence`: what
            the tracker states. Those in the state are of the cost as it is, by which it samples.
        joints_world: Joint centres of the modes, metres.
        terms: Cost of the best mode by term, nats.
        seconds: Wall time of the frame by stage.
        term_seconds: Wall time of the search by what was evaluated; the rest of it is the
            optimiser's own.
        lost: Whether the track counts as lost, see `torchcss.tracking.recovery`.
        loss_score: By how many deviations the image costs more than before, see `LossMonitor`.
        others: The images of the other cameras; None from one that has ended.
    """

    frame: Frame
    body: BodyModel
    state: TrackerState
    info: TrackerInfo
    covariance: Float[Tensor, "k n n"]
    joints_world: Float[Tensor, "k j 3"]
    terms: dict[str, float]
    seconds: dict[str, float]
    term_seconds: dict[str, float]
    lost: bool = False
    loss_score: float = 0.0
    others: tuple[Frame | None, ...] = ()


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
    recovery: Recovery | None = None,
    jumps_every: int = 0,
    limb_jumps: int = 0,
    carries: bool = False,
    others: Sequence[ViewStream] = (),
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
        recovery: How losses are told and what is done then; None: nothing.
        jumps_every: Every how many frames the flips of the best mode join the search, see
            `torchcss.tracking.flip_moves`; 0: never. Not where several cameras look on: to them a
            flip looks different.
        limb_jumps: How many other poses of an arm for which the colours do not speak join the
            search, see `torchcss.tracking.limb_moves`; 0: none. Not for particle filters.
        carries: Whether the pictures tell where each mode's trunk is expected, see
            `torchcss.tracking.surface_prediction`. Not for particle filters.
        others: What further cameras send.

    Yields:
        A `TrackedFrame` for every frame.
    """

    def watcher(camera: Camera, observe: Observe, masks: Iterable[Any] | None) -> Watcher:
        costs = FrameCosts(
            body,
            extractor.working_camera(camera),
            choice,
            frame_interval=frame_interval,
            boundary_emphasis=boundary_emphasis,
        )
        return Watcher(costs, extractor, observe, masks, carries=carries)

    watchers = [watcher(camera, observe, masks)]
    watchers += [watcher(other.camera, other.observe, other.masks) for other in others]
    streams = [iter(other.frames) for other in others]
    state = tracker.init(mixture, generator=generator)
    carrier = Carrier(body) if carries else None
    lost, num_lost = False, 0
    watch = None if recovery is None else recovery.monitor.init()
    for frame in frames:
        clock = time.perf_counter()
        beside_it = tuple(next(stream, None) for stream in streams)
        for each, image in zip(watchers, (frame, *beside_it), strict=True):
            each.look(image)
        jumping = time.perf_counter()
        searching, num_prior = tracker, len(state.mixture.mean)
        if recovery is not None and 0 < num_lost <= recovery.patience:
            searching = recovery.widened(tracker)
            state = recovery.with_jumps(state, body, camera)
        elif jumps_every and not others and int(state.frame) % jumps_every == 0:
            state = with_flips(state, body, camera, num=NUM_JUMPS)
        jumped = time.perf_counter() - jumping
        stopwatch = Stopwatch()
        cost = beside([each.cost(body, state.mixture.mean, stopwatch) for each in watchers])
        bounds = body.bounds if limits else unbounded(state.mixture.mean)
        if limb_jumps and isinstance(searching, Tracker):
            looking, known = time.perf_counter(), len(state.mixture.mean)
            dynamics = searching.dynamics
            state = with_limbs(state, body, cost, dynamics, bounds, num=limb_jumps)
            if len(state.mixture.mean) > known:
                modes = state.mixture.mean
                cost = beside([each.cost(body, modes, stopwatch) for each in watchers])
            jumped += time.perf_counter() - looking
        featured = time.perf_counter()
        prior = state.mixture
        if carrier is not None and isinstance(searching, Tracker):
            sights = [
                Sight(view.camera, *each.contrasts)
                for view, each in zip(cost.views, watchers, strict=True)
            ]
            mean = state.mixture.mean
            expected = carrier(
                body,
                sights,
                before=mean,
                velocity=state.velocity,
                expected=searching.dynamics.predict(state.mixture, state.velocity).mean,
                deviation=cost.deviation,
            )
            dynamics = Displaced(searching.dynamics, expected - mean)
            searching = replace(searching, dynamics=dynamics)
        asked: list[GaussianMixture] = []
        state, info = searching.step(state, _noting(cost, asked), bounds)
        if len(prior.mean) > num_prior:
            # A mode that was jumped to goes back to the best one, from which the jump was made.
            info = info._replace(parent=torch.where(info.parent < num_prior, info.parent, 0))
        searched, term_seconds = time.perf_counter(), dict(stopwatch.seconds)
        mean = state.mixture.mean
        # About the prior that the search had, one frame ahead.
        values = cost.of_children(info.origin[:1], asked[0]).terms(mean[:1])
        if choice.segmentation is not None:
            values["segmentation"] = cost.unsearched(mean[:1])
        terms = {name: float(value[0]) for name, value in values.items()}
        if recovery is not None and watch is not None:
            watch, lost = recovery.judge(watch, _per_view(terms, watchers))
            num_lost = num_lost + 1 if lost else 0
        if not lost:
            for each in watchers:
                each.learn(body, mean, state.mixture.log_weight)
        yield TrackedFrame(
            frame,
            body,
            state,
            info,
            tempered(
                state.mixture.covariance,
                stated_evidence(tracker),
                default_prior_variance(bounds),
            ),
            body.pose(mean).joints,
            terms,
            {
                "features": featured - clock - jumped,
                "search": searched - featured + jumped,
            },
            term_seconds,
            lost,
            0.0 if watch is None else watch.score,
            beside_it,
        )
        body, state = follow_with_base(body, state)


def _noting(cost: TrackingCost, priors: list[GaussianMixture]) -> CostFactory:
    """`cost.of_children`, which puts down the priors that it is asked about."""

    def of_children(parent: Tensor, prior: GaussianMixture) -> TrackingCost:
        priors.append(prior)
        return cost.of_children(parent, prior)

    return of_children


def _per_view(terms: dict[str, float], watchers: Sequence[Watcher]) -> dict[str, float]:
    """What a frame costs a view: the sum falls when a view is out, and is no better for it."""
    seen = max(1, sum(each.features is not None for each in watchers))
    return {name: value / seen for name, value in terms.items()}


def follow_with_base(body: BodyModel, state: TrackerState) -> tuple[BodyModel, TrackerState]:
    """Move the base under the best mode if the root's pitch nears its lock (design decision 11)."""
    if not has_root(body):
        return body, state
    best = state.mixture.mean[0]
    angles = best[[body.state_index(name) for name in ROOT_NAMES[3:]]]
    if float(angles[1].abs()) < _PITCH_LIMIT and float(angles.abs().max()) < math.radians(270):
        return body, state
    mixture, base = state.mixture, root_pose(body, best)
    _, last, _ = move_base(body, *base, mixture.mean - state.velocity)
    body, mean, covariance = move_base(body, *base, mixture.mean, mixture.covariance)
    assert covariance is not None
    velocity = mean - last
    turned = [body.state_index(name) for name in ROOT_NAMES[3:]]
    velocity[:, turned] = torch.remainder(velocity[:, turned] + math.pi, 2 * math.pi) - math.pi
    # Particles belong to the old base; a filter draws new ones from the mixture.
    return body, state._replace(
        mixture=mixture._replace(mean=mean, covariance=covariance),
        velocity=velocity,
        particles=None,
    )


def scale_keypoints(
    keypoints: Float[Tensor, "*t j 2"], full: tuple[int, int], working: tuple[int, int]
) -> Float[Tensor, "*t j 2"]:
    """Pixels of the full image to pixels of the working image (centres at integers).

    Args:
        keypoints: Pixels of the full image.
        full: Its width and height.
        working: Width and height of the working image.
    """
    factor = keypoints.new_tensor([working[0] / full[0], working[1] / full[1]])
    return (keypoints + 0.5) * factor - 0.5
