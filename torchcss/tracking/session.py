"""From frames to posteriors: the one loop that the command line, studies and notebooks share.

    session = TrackingSession(settings, first, views, frame_interval=1 / 25)
    for posterior in session.track(images):
        ...

`first` says where the body may be in the first frame (`torchcss.initialise`), `views` which cameras
look on (`CameraView`). A frame takes two calls, so that the next one can be seen while this one is
searched:

    observation = session.observe(images)   # features: what needs the pictures alone
    posterior = session.step(observation)   # cost and search: what needs the state

Any number of synchronised, calibrated cameras may look on: what all of them see adds up in the
cost. `checkpoint` returns all that the next frame needs as a record of tensors, and
`TrackingSession.resume` goes on from it bit for bit.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import pairwise, zip_longest
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, has_root, move_base, root_pose
from torchcss.body.rotations import within_half_turn
from torchcss.cost.frame import NOTHING_KNOWN, Learnt
from torchcss.cost.fused import threads_for
from torchcss.cost.joints import JointTerm
from torchcss.cost.total import TrackingCost, beside
from torchcss.errors import ConfigurationError
from torchcss.inference.loss_monitor import MonitorState
from torchcss.inference.mixture import GaussianMixture, tempered
from torchcss.inference.proposals import CovarianceScaled, Proposal, with_moves
from torchcss.inference.tracker import (
    SequenceTracker,
    Tracker,
    TrackerInfo,
    TrackerState,
)
from torchcss.inference.trust_region import default_prior_variance
from torchcss.initialise.result import Initialisation
from torchcss.initialise.view import CameraView
from torchcss.stopwatch import Stopwatch
from torchcss.tracking.flip_moves import Flips
from torchcss.tracking.keypoint_moves import MissedKeypoints
from torchcss.tracking.limb_moves import LostLimbs
from torchcss.tracking.settings import Plan, Settings, make_plan
from torchcss.tracking.surface_prediction import PicturePair, SurfaceDynamics, SurfaceMotion
from torchcss.tracking.view import (
    NOTHING_SEEN,
    Observer,
    ViewObservation,
)
from torchcss.types import TIME_ROUNDING, Bounds, Frame, Vectors
from torchcss.vision.camera import Camera
from torchcss.vision.features import Window

_PITCH_LIMIT = math.radians(55)
"""The base follows once the root's pitch exceeds this, well before it locks at 90 degrees."""

_NUM_FLIPS = 8
"""Flips of the best mode that join the search where flips are made; and so many poses at keypoints
that it misses."""

Image = Frame | np.ndarray
"""An image with its place in the video, or its pixels `[h w 3]` alone: it then is the next one."""

ViewWindows = tuple[Window | None, ...]
"""Where each view is looked at; None: everywhere."""

Views = CameraView | Camera | Sequence[CameraView | Camera]
"""The cameras that look on, in one world, the first one's video counting the frames; or the one."""

Images = Image | Sequence[Image | None]
"""The images of one moment, one of each view; None from a camera that has ended."""


class Observation(NamedTuple):
    """What all cameras see of one moment.

    Attributes:
        views: What each of them sees, the first one's view first.
        seconds: Wall time of the features.
    """

    views: tuple[ViewObservation, ...]
    seconds: float

    @property
    def frame(self) -> Frame:
        """The first camera's image."""
        frame = self.views[0].frame
        assert frame is not None
        return frame


class Posterior(NamedTuple):
    """What is known after one frame.

    Attributes:
        frame: The first camera's image and its place in the video.
        body: The body on this frame's base.
        state: The tracker's state, best mode first.
        info: What the step did.
        covariance: Covariances of the modes that the tracker states, with the likelihood to a
            power, `SequenceTracker.stated_power`. Those in the state are of the cost as it
            is, by which it samples.
        joints_world: Joint centres of the modes, metres.
        terms: Cost of the best mode by term, nats.
        seconds: Wall time of the frame by stage.
        term_seconds: Wall time of the search by what was evaluated; the rest of it is the
            optimiser's own.
        lost: Whether the track counts as lost, see `torchcss.inference.loss_monitor`.
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


class SessionState(NamedTuple):
    """What the next frame needs, and nothing else.

    Attributes:
        tracker: Modes, velocities, generator.
        body: The body on its present base.
        seen: What each camera saw last: the picture, and its contrast where that is wanted.
        memory: What each camera has taught.
        monitor: What tells a loss.
        windows: Where each view is looked at, in the next frame and in the one after it.
        times: Seconds at which the last two frames were shown, or as many as there were.
    """

    tracker: TrackerState
    body: BodyModel
    seen: tuple[ViewObservation, ...]
    memory: tuple[Learnt, ...]
    monitor: MonitorState
    windows: tuple[ViewWindows, ...] = ()
    times: tuple[float, ...] = ()


class TrackingSession:
    """Tracks a body through a sequence of images.

    Args:
        settings: How to track.
        first: Where the body may be in the first frame, and the body.
        views: The cameras that look on, with their keypoints where there are any.
        frame_interval: Seconds between frames as a rule, which scales the expected motion. A frame
            that comes later or earlier by its own time (`Frame.time_s`) is expected to have moved
            by more or less (`torchcss.inference.dynamics`), the temporal priors with it.
        generator: Source of the samples; None: one seeded with `settings.seed`.
        plan: The parts of the session, for studies that exchange some; None: what `make_plan` makes
            of the settings.

    Raises:
        ConfigurationError: If there is no view, what the settings ask for does not fit them, or the
            first mixture is not finite.
        KeypointError: If a view's keypoints do not agree in their shapes, or the body has none of
            their joints.
    """

    def __init__(
        self,
        settings: Settings,
        first: Initialisation,
        views: Views,
        *,
        frame_interval: float = 1 / 25,
        generator: torch.Generator | None = None,
        plan: Plan | None = None,
    ) -> None:
        generator = generator or torch.Generator().manual_seed(settings.seed)
        self._begin(settings, first.body, views, frame_interval, plan)
        nothing = len(self._observers)
        mixture = first.mixture
        if self.plan.one_fit:
            mixture, self._num_floored = _one_fit(first, self._bounds), int(first.uncapped_floored)
        self.state = SessionState(
            tracker=self.plan.tracker.init(mixture, generator=generator),
            body=first.body,
            seen=(NOTHING_SEEN,) * nothing,
            memory=(NOTHING_KNOWN,) * nothing,
            monitor=self.plan.monitor.init(),
            windows=(self._windows(first.body, mixture),) * 2,
        )
        self._expect(self.state)

    @classmethod
    def resume(
        cls,
        state: SessionState,
        settings: Settings,
        views: Views,
        *,
        frame_interval: float = 1 / 25,
        plan: Plan | None = None,
    ) -> TrackingSession:
        """A session that goes on where another left off, with the same settings and views.

        Args:
            state: What `checkpoint` returned.
            settings: How to track.
            views: The cameras.
            frame_interval: Seconds between frames.
            plan: The same parts of the session, if it had some of its own.
        """
        session = cls.__new__(cls)
        session._begin(settings, state.body, views, frame_interval, plan)
        if len(state.seen) != len(session._observers):
            raise ConfigurationError(
                f"the checkpoint is of {len(state.seen)} views, given are "
                f"{len(session._observers)}; give the same views"
            )
        session.state = state
        session._expect(state)
        return session

    def _expect(self, state: SessionState) -> None:
        """Be ready to see the frame that follows a state."""
        self._seen, self._num_seen = state.seen, int(state.tracker.frame)
        self._ahead = deque(state.windows, maxlen=2)
        self._times = deque(state.times, maxlen=2)

    def _windows(self, body: BodyModel, mixture: GaussianMixture) -> ViewWindows:
        """Where each view is looked at two frames later."""
        return tuple(observer.window(body, mixture.mean) for observer in self._observers)

    def _begin(
        self,
        settings: Settings,
        body: BodyModel,
        views: Views,
        frame_interval: float,
        plan: Plan | None,
    ) -> None:
        views = [views] if isinstance(views, (Camera, CameraView)) else views
        if not views:
            raise ConfigurationError("views: expected at least one camera that looks on, got none")
        if not 0 < frame_interval < math.inf:
            raise ConfigurationError(f"frame_interval: expected seconds, got {frame_interval}")
        views = [view if isinstance(view, CameraView) else CameraView(view) for view in views]
        for view in views:
            view.check(body)
        self.settings = settings
        self.plan = plan or make_plan(settings, body, views[0], frame_interval)
        self._observers = [self.plan.observer(body, view) for view in views]
        self._bounds = self.plan.bounds
        self._prior_variance = default_prior_variance(self._bounds)
        self._surface_motion = SurfaceMotion(body) if self.plan.surface_prediction else None
        self._num_floored = 0

    def checkpoint(self) -> SessionState:
        """All that the next frame needs; see `torchcss.tracking.checkpoint` for its tensors."""
        return self.state

    def track(self, images: Iterable[Images]) -> Iterator[Posterior]:
        """Track through a sequence; with two threads the next images are seen meanwhile.

        Who stops on the way may go on with another call, from the moment after the last one that
        was yielded. An iterator has given its next one away by then, where there are two threads.

        Args:
            images: The images of one moment after another.

        Yields:
            What is known after each of them.
        """
        observations = map(self.observe, images)
        try:
            if self.settings.threads < 2:
                yield from map(self.step, observations)
            else:
                yield from self._track_seeing_ahead(observations)
        finally:
            self._expect(self.state)  # what was seen ahead is seen anew

    def _track_seeing_ahead(self, coming: Iterator[Observation]) -> Iterator[Posterior]:
        """The same, each moment seen while the one before is searched."""
        # torch's own threads are set thread by thread.
        with ThreadPoolExecutor(1, initializer=partial(torch.set_num_threads, 1)) as pool:
            pending = pool.submit(next, coming, None)
            while (observation := pending.result()) is not None:
                pending = pool.submit(next, coming, None)
                yield self.step(observation)

    def observe(self, images: Images) -> Observation:
        """See the images of one moment, in their order.

        The next moment may be seen before this one is searched; it is looked at where the body can
        be two frames after the search before. What is seen still earlier is looked at everywhere.

        Args:
            images: One of each view, or that of the only one.

        Raises:
            CameraError: If an image is of another size than its camera's.
            ConfigurationError: If there are more images than views, or none of the first view.
        """
        with threads_for(self.plan.engine):
            began = time.perf_counter()
            given = tuple(images) if isinstance(images, Sequence) else (images,)
            pairs = zip_longest(given, self._observers)
            frames = [self._placed(image, observer) for image, observer in pairs]
            everywhere: ViewWindows = (None,) * len(frames)
            known = bool(self._ahead)
            windows = self._ahead[0] if known else everywhere
            assert frames[0] is not None
            times = (*self._times, frames[0].time_s)
            # Windows are for two intervals: what comes later may be beyond them.
            if sum(self._intervals(*pair) for pair in pairwise(times)) > 2.5:
                windows = everywhere
            self._seen = tuple(map(Observer.observe, self._observers, frames, self._seen, windows))
            # Images that cannot be seen have raised by here, and do not count.
            self._num_seen += 1
            self._times.append(times[-1])
            if known:
                self._ahead.popleft()
            return Observation(self._seen, time.perf_counter() - began)

    def _placed(self, image: Image | None, observer: Observer | None) -> Frame | None:
        """An image with its place in its video; a view without an image is out."""
        if observer is None:
            raise ConfigurationError(
                f"images: expected one of each of the {len(self._observers)} views, got more"
            )
        if image is None:
            if observer is self._observers[0]:
                raise ConfigurationError("images: the first view has none; it counts the frames")
            return None
        pixels = image.image if isinstance(image, Frame) else image
        if not isinstance(pixels, np.ndarray) or pixels.ndim < 2:
            raise ConfigurationError(
                "images: expected pixels [h w 3] as a NumPy array, or a Frame of them, got a "
                f"{type(pixels).__name__}"
            )
        observer.view.camera.check_size(pixels.shape[1], pixels.shape[0])
        if isinstance(image, Frame):
            return image
        index = self._num_seen
        return Frame(index + observer.view.offset, index * self.plan.frame_interval, image)

    def _intervals(self, *times: float) -> float:
        """How many usual intervals go from one frame to the next.

        One where that is so but for the rounding of times in a container, where times do not rise,
        which then say nothing, and before the first frame.
        """
        usual, between = self.plan.frame_interval, times[-1] - times[0]
        rounding = min(TIME_ROUNDING, usual / 2)
        return between / usual if between > 0 and abs(between - usual) > rounding else 1.0

    def step(
        self,
        observation: Observation,
        searched: Callable[[TrackingCost], TrackingCost] = lambda cost: cost,
    ) -> Posterior:
        """Search one frame; the observations come in their order, each once.

        Args:
            observation: What `observe` has returned.
            searched: What the search sees of the frame's cost: by default the cost itself, else
                the same with another engine, say (`torchcss.tracking.batch`).
        """
        with threads_for(self.plan.engine):
            return self._stepped(observation, searched)

    def _stepped(
        self, observation: Observation, searched: Callable[[TrackingCost], TrackingCost]
    ) -> Posterior:
        before, plan, stopwatch = self.state, self.plan, Stopwatch()
        intervals = self._intervals(*before.times[-1:], observation.frame.time_s)
        body, clock = before.body, [time.perf_counter()]
        memory = tuple(
            observer.recall(known, seen)
            for observer, known, seen in self._of_views(before.memory, observation)
        )
        cost = self._cost(observation, memory, stopwatch, intervals)
        clock.append(time.perf_counter())
        tracker, cost = self._tracker(observation, cost, intervals), searched(cost)
        after, info = tracker.step(before.tracker, cost.problem(), self._bounds)
        clock.append(time.perf_counter())
        term_seconds, modes = dict(stopwatch.seconds), after.mixture
        terms = self._terms_of_best(cost.of_children(info.origin[:1], info.prior), modes)
        monitor, lost = self._judged(terms, observation)
        memory = tuple(
            observer.costs.learn(known, seen.features, body, modes.mean, modes.log_weight)
            for observer, known, seen in self._of_views(memory, observation)
        )
        windows = self._windows(body, modes)
        self._ahead.append(windows)
        next_body, moved = follow_with_base(body, after.per_interval(intervals))
        self.state = SessionState(
            *(moved, next_body, observation.views, memory, monitor),
            windows=(*before.windows[1:], windows),
            times=(*before.times, observation.frame.time_s)[-2:],
        )
        return Posterior(
            frame=observation.frame,
            body=body,
            state=after,
            info=self._with_first_fit(info),
            covariance=tempered(modes.covariance, plan.tracker.stated_power, self._prior_variance),
            joints_world=body.pose(modes.mean).joints,
            terms=terms,
            seconds={
                "features": observation.seconds + clock[1] - clock[0],
                "search": clock[2] - clock[1],
            },
            term_seconds=term_seconds,
            lost=lost,
            loss_score=monitor.score,
            others=tuple(view.frame for view in observation.views[1:]),
        )

    def _with_first_fit(self, info: TrackerInfo) -> TrackerInfo:
        """Of the first frame: with the floor of the covariance that the track starts from."""
        floored, self._num_floored = self._num_floored, 0
        return info._replace(num_floored=info.num_floored + floored)

    def _judged(
        self, terms: dict[str, float], observation: Observation
    ) -> tuple[MonitorState, bool]:
        """What tells a loss after a frame, and whether it tells one."""
        watched = {term.name for term in self.plan.choice.terms if term.watched}
        # Per view: the sum falls when a view is out, and is no better for it.
        seen = max(1, sum(view.features is not None for view in observation.views))
        costs = {name: cost / seen for name, cost in terms.items() if name in watched}
        return self.plan.monitor.update(self.state.monitor, costs)

    def _of_views(
        self, memory: Sequence[Learnt], observation: Observation
    ) -> Iterator[tuple[Observer, Learnt, ViewObservation]]:
        return zip(self._observers, memory, observation.views, strict=True)

    def _cost(
        self,
        observation: Observation,
        memory: Sequence[Learnt],
        stopwatch: Stopwatch,
        intervals: float,
    ) -> TrackingCost:
        """The cost of a frame, for samples of the modes before."""
        before = self.state.tracker
        keypoints = not self.plan.keypoints_first_only or int(before.frame) == 0
        return beside(
            [
                (observer if intervals == 1 else observer.over(intervals)).cost(
                    seen,
                    known,
                    self.state.body,
                    before.mixture.mean,
                    keypoints=keypoints,
                    stopwatch=stopwatch,
                )
                for observer, known, seen in self._of_views(memory, observation)
            ]
        )

    def _tracker(
        self, observation: Observation, cost: TrackingCost, intervals: float
    ) -> SequenceTracker:
        """The tracker of a frame, with the moves and dynamics that it asks for.

        Particle filters have neither: they search by the noise of their own dynamics. Nor has a
        `GridTracker`.
        """
        plan, state, frame = self.plan, self.state, int(self.state.tracker.frame)
        tracker = plan.tracker if intervals == 1 else plan.tracker.over(intervals)
        if not isinstance(tracker, Tracker):
            return tracker
        if plan.one_fit and frame == 0:
            tracker = replace(tracker, proposal=_AS_FITTED)
        search, dynamics, num = tracker.proposal, tracker.dynamics, tracker.num_samples
        camera, moves = self._observers[0].view.camera, []
        if plan.jumps_every and len(self._observers) == 1:  # to several cameras they look unlike
            if frame % plan.jumps_every == 0:
                flips = Flips(search=search, body=state.body, camera=camera, num=_NUM_FLIPS)
                moves.append((flips, _NUM_FLIPS))
            if (missed := self._missed_keypoints(cost, search)) is not None:
                moves.append((missed, _NUM_FLIPS))
        if plan.limb_jumps:
            limbs = LostLimbs(search=search, body=state.body, cost=cost, num=plan.limb_jumps)
            moves.append((limbs, 2 * plan.limb_jumps))
        if self._surface_motion is not None:
            pairs = [
                PicturePair(view.camera, seen.contrast_before, seen.contrast)
                for view, seen in zip(cost.views, observation.views, strict=True)
            ]
            dynamics = SurfaceDynamics(
                dynamics=dynamics,
                motion=self._surface_motion,
                body=state.body,
                pairs=pairs,
                deviation=cost.views[0].deviation,
                intervals=intervals,
            )
        return replace(tracker, proposal=with_moves(search, moves, num), dynamics=dynamics)

    def _missed_keypoints(self, cost: TrackingCost, search: Proposal) -> MissedKeypoints | None:
        """The move to keypoints that the best mode misses; the first pose was fitted to them."""
        keypoints = cost.views[0].keypoints
        term = next((term for term in cost.choice.terms if isinstance(term, JointTerm)), None)
        if keypoints is None or term is None or int(self.state.tracker.frame) == 0:
            return None
        return MissedKeypoints(
            search=search,
            body=self.state.body,
            camera=cost.camera,
            keypoints=keypoints,
            term=term,
            num=_NUM_FLIPS,
        )

    def _terms_of_best(self, cost: TrackingCost, modes: GaussianMixture) -> dict[str, float]:
        """What the best mode costs by term, about the prior that the search had."""
        best = modes.mean[:1]
        values = cost.terms(best) | cost.weight_only_terms(best)
        every = torch.cat([best.new_zeros(0), *values.values()]).tolist()
        return dict(zip(values, every, strict=True))


_AS_FITTED = CovarianceScaled(covariance_scale=1.0)
"""Section 5 [IJRR]: the covariance of the one fit gives the first hypotheses, the fit among them.
Fig. 6 inflates what it was in the frame before."""


def _one_fit(first: Initialisation, bounds: Bounds) -> GaussianMixture:
    """The likeliest fit alone, its covariance not capped; what a bound holds has no width.

    Section 5 of both papers.
    """
    best = first.mixture.prune(1)
    if first.uncapped is not None:
        best = best._replace(covariance=first.uncapped[None])
    free = (best.mean > bounds.lower.to(best.mean)) & (best.mean < bounds.upper.to(best.mean))
    both = free[:, :, None] & free[:, None, :]
    return best._replace(covariance=torch.where(both, best.covariance, 0.0))


def follow_with_base(body: BodyModel, state: TrackerState) -> tuple[BodyModel, TrackerState]:
    """Move the base under the best mode if the root's pitch nears its lock (decision "root").

    Args:
        body: The body on its base.
        state: The tracker's state on that base; particles and hypotheses move along.
    """
    if not has_root(body):
        return body, state
    best = state.mixture.mean[0]
    angles = best[body.state_columns(ROOT_NAMES[3:])]
    if float(angles[1].abs()) < _PITCH_LIMIT and float(angles.abs().max()) < math.radians(270):
        return body, state
    mixture, base = state.mixture, root_pose(body, best)
    turned = body.state_columns(ROOT_NAMES[3:])

    def moved(x: Vectors, velocity: Vectors) -> tuple[Vectors, Vectors]:
        """States and their motions on the new base."""
        now, last = (move_base(body, *base, states)[1] for states in (x, x - velocity))
        step = now - last
        step[:, turned] = within_half_turn(step[:, turned])
        return now, step

    particles = state.particles
    if particles is not None:
        x, step = moved(particles.x, particles.velocity)
        particles = particles._replace(x=x, velocity=step)
    _, velocity = moved(mixture.mean, state.velocity)
    body, mean, covariance = move_base(body, *base, mixture.mean, mixture.covariance)
    assert covariance is not None
    return body, state._replace(
        mixture=mixture._replace(mean=mean, covariance=covariance),
        velocity=velocity,
        particles=particles,
    )
