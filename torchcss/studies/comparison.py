"""Several trackers compared in one pass over a sequence.

All trackers of one seed start from the same first pose (`find_start`) and see the same images, each
where its own body can be. `track_together` runs them frame by frame, so that the film is decoded
once and trackers that look at the whole picture share its features; nothing of a frame stays in
memory, and a run can end as soon as it has lost the body.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from torchcss.app.init import initialise_video
from torchcss.body.catalog import ARM_NAMES
from torchcss.body.chain import offset_matrix
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.errors import TorchcssError
from torchcss.initialise.fit import initialise
from torchcss.initialise.keypoint_checks import typical_sigma
from torchcss.initialise.noise import Noise
from torchcss.initialise.options import LEAST_JOINTS, InitialiseOptions
from torchcss.initialise.result import Initialisation
from torchcss.initialise.view import CameraView
from torchcss.io.video import VideoReader
from torchcss.studies.evaluation import Evaluator, FrameMeasures, Thresholds, loss
from torchcss.studies.render.motions import Motion
from torchcss.studies.sequences import RecordedSequence
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import Plan, Settings, make_plan
from torchcss.types import Frame


class Start(NamedTuple):
    """What all trackers of one seed start from.

    Attributes:
        first: Body and mixture of the first frame.
        sigma: Noise of the keypoints, pixels of the full image.
        generator: Its state after the first pose was found; tracking does not advance it.
    """

    first: Initialisation
    sigma: float
    generator: torch.Generator


def find_start(sequence: RecordedSequence, settings: Settings, *, start: int = 0) -> Start:
    """Find the first pose from the keypoints of the first frame.

    A body is fitted in the three stages of `torchcss.initialise`. An arm is told base and lengths,
    as in the demo, and only its pose is fitted; one with fewer joints than the one that moved is
    told where its first joint is in the first frame.

    Args:
        sequence: What is to be tracked.
        settings: The body, the seed, the type. The tracker does not matter, nor do its terms: all
            start from the same pose, which those of the default preset find.
        start: First frame.
    """
    keypoints, dtype, device = sequence.keypoints, settings.torch_dtype, settings.device
    generator = torch.Generator().manual_seed(settings.seed)
    camera = sequence.camera.to(dtype=dtype, device=device)
    told = None if sequence.truth is None else told_arm(sequence.truth, settings.body, start)
    if told is not None:
        sigma = sequence.keypoint_noise_px or typical_sigma(keypoints)
        options = InitialiseOptions(
            sigma=sigma, least_joints=LEAST_JOINTS, dtype=dtype, device=device
        )
        placed = told.to(dtype=dtype, device=device)
        first = initialise(
            None, keypoints.at(start), camera, placed, generator=generator, options=options
        )
    else:
        sigma = typical_sigma(keypoints)
        neutral = replace(settings, preset=Settings.preset, terms=None)
        first = initialise_video(
            sequence.video, keypoints, camera, neutral, start=start, noise=Noise(sigma),
            generator=generator,
        )  # fmt: skip
    return Start(first, sigma, generator)


def told_arm(truth: Motion, name: str, start: int) -> BodyModel | None:
    """An arm with base and lengths of the one that moved.

    Args:
        truth: What moved.
        name: The body that tracks it.
        start: First frame, in which the arm's first joint is where it hangs.

    Returns:
        None if there is no such arm: the body is to be fitted.
    """
    moved = truth.body
    if has_root(moved) or moved.name == name:
        return None if has_root(moved) else moved
    if name not in ARM_NAMES:
        return None
    arm = load_body(name, lengths=moved.lengths)
    above, own = (
        next((row for row in body.tree.specifications if row.name == arm.state_names[0]), None)
        for body in (moved, arm)
    )
    if above is None or own is None or above.parent is None:
        return None
    links = moved.forward_kinematics(truth.states[start])
    hung = links[moved.tree.link_index(above.parent)].numpy(force=True) @ offset_matrix(above)
    base = torch.from_numpy(hung @ np.linalg.inv(offset_matrix(own)))
    return arm.with_base(base[:3, :3], base[:3, 3])


class TrackerRun(NamedTuple):
    """One tracker from the first frame to its end.

    Attributes:
        number: Its place among the trackers.
        settings: What was run.
        measures: What was measured, frame by frame.
        ended: "complete", "lost" if it was stopped for that, or the error that ended it.
    """

    number: int
    settings: Settings
    measures: list[FrameMeasures]
    ended: str


def track_together(
    sequence: RecordedSequence,
    runs: Sequence[tuple[Settings, Start] | tuple[Settings, Start, Plan]],
    thresholds: Thresholds,
    *,
    start: int = 0,
    stop: int | None = None,
    stop_when_lost: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[TrackerRun]:
    """Run several trackers, frame by frame, in one pass over the video.

    Args:
        sequence: What is tracked.
        runs: The trackers and their starts; plans where other parts are wanted than those that the
            settings ask for.
        thresholds: What counts as failed.
        start: First frame.
        stop: Frame before which to end.
        stop_when_lost: End a run as soon as the body is lost for good.
        progress: Called after every frame with its index and the number of trackers left.

    Yields:
        Every run, when it ends.
    """
    reader = VideoReader(sequence.video, start=start, stop=stop)
    going = [
        (
            TrackerRun(number, settings, [], "complete"),
            session_of(sequence, settings, begin, *plan),
            Evaluator(sequence, begin.first.body, thresholds),
        )
        for number, (settings, begin, *plan) in enumerate(runs)
    ]
    # Of sessions that see the same, one observes for all, even after its own run has ended.
    observers = {
        key: session for _, session, _ in going if (key := observation_key(session)) is not None
    }
    first: Frame | None = None
    for frame in reader:
        first = first or frame
        used = {observation_key(session) for _, session, _ in going}
        seen = {key: each.observe(frame) for key, each in observers.items() if key in used}
        left = []
        for run, session, evaluator in going:
            ended = None
            try:
                observation = seen.get(observation_key(session)) or session.observe(frame)
                posterior = session.step(observation)
                run.measures.append(evaluator(posterior, first, observation.seconds))
            except (TorchcssError, RuntimeError, ArithmeticError) as error:
                # The others go on: a study takes hours. The table says that this one ended.
                ended = f"error: {type(error).__name__}: {error}"
            if ended is None and stop_when_lost and loss(run.measures, thresholds) is not None:
                ended = "lost"
            if ended is None:
                left.append((run, session, evaluator))
            else:
                yield run._replace(ended=ended)
        going = left
        if progress is not None:
            progress(frame.index, len(going))
        if not going:
            return
    for run, _, _ in going:
        yield run


def observation_key(session: TrackingSession) -> Hashable | None:
    """What the features of a picture depend on, the same where two sessions see the same.

    None where a session looks only where its own body can be: nobody else sees what it sees.

    Args:
        session: A session of one camera.
    """
    plan, extractor = session.plan, session.plan.extractor
    if not plan.choice.whole_picture:
        return None
    choices = extractor.edges, extractor.flow, extractor.working_size, extractor.colour
    return *choices, extractor.luma.dtype, extractor.luma.device, plan.surface_prediction


def session_of(
    sequence: RecordedSequence, settings: Settings, begin: Start, plan: Plan | None = None
) -> TrackingSession:
    """A session that tracks a sequence.

    Args:
        sequence: What is tracked.
        settings: How.
        begin: Where it starts.
        plan: See `TrackingSession`.
    """
    return TrackingSession(
        settings,
        begin.first,
        [view_of(sequence, settings, begin)],
        frame_interval=1 / sequence.frame_rate,
        generator=begin.generator,
        plan=plan,
    )


def plan_of(sequence: RecordedSequence, settings: Settings, begin: Start) -> Plan:
    """What settings mean for a sequence; the arguments are those of `session_of`."""
    view = view_of(sequence, settings, begin)
    return make_plan(settings, begin.first.body, view, 1 / sequence.frame_rate)


def view_of(sequence: RecordedSequence, settings: Settings, begin: Start) -> CameraView:
    """The camera of a sequence, with its keypoints; the arguments are those of `session_of`."""
    camera = sequence.camera.to(dtype=settings.torch_dtype, device=settings.device)
    return CameraView(camera, sequence.keypoints, begin.sigma)
