"""Several trackers side by side through one pass over a sequence.

All trackers of one seed start from the same first pose (`find_start`) and see the same images.
`track_together` runs them frame by frame, so that the features of a frame, which do not depend on
who tracks and take longer than many a tracker, are computed once; nothing of a frame stays in
memory, and a run can end as soon as it has lost the body.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import torch

from torchcss.body.root import has_root
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.errors import TorchcssError
from torchcss.initialise.from_joints import initialise_from_joints
from torchcss.initialise.keypoint_checks import typical_sigma
from torchcss.initialise.result import Initialisation
from torchcss.io.video import VideoReader
from torchcss.studies.evaluation import FrameMeasures, Thresholds, Yardstick, loss
from torchcss.studies.sequences import RecordedSequence
from torchcss.tracking.first_frame import initialise_video
from torchcss.tracking.presets import PRESETS
from torchcss.tracking.recovery import Recovery
from torchcss.tracking.session import TrackedFrame, scale_keypoints, track_frames
from torchcss.tracking.settings import (
    Settings,
    boundary_emphasis,
    make_choice,
    make_extractor,
    make_settings_tracker,
)
from torchcss.types import Frame
from torchcss.vision.features import FeatureExtractor, FrameFeatures


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
    as in the demo, and only its pose is fitted.

    Args:
        sequence: What is to be tracked.
        settings: The body, the seed, the type; the tracker does not matter.
        start: First frame.
    """
    marks, dtype, device = sequence.keypoints, settings.torch_dtype, settings.device
    generator = torch.Generator().manual_seed(settings.seed)
    camera = sequence.camera.to(dtype=dtype, device=device)
    truth = sequence.truth
    if truth is not None and truth.body.name == settings.body and not has_root(truth.body):
        sigma = sequence.keypoint_noise_px or typical_sigma(marks.keypoints, marks.confidence)
        first = initialise_from_joints(
            settings.body, camera, marks.keypoints[start], marks.confidence[start],
            marks.joint_names, generator=generator, joints=JointTerm(sigma=sigma),
            placed=truth.body.to(dtype=dtype, device=device), dtype=dtype, device=device,
        )  # fmt: skip
        return Start(first, sigma, generator)
    sigma = typical_sigma(marks.keypoints, marks.confidence)
    first = initialise_video(
        sequence.video, marks, camera, settings, start=start, sigma=sigma, generator=generator
    )
    return Start(first, sigma, generator)


class SharedFeatures(FeatureExtractor):
    """An extractor that remembers the last frame, for trackers that are run side by side.

    Args:
        extractor: What makes the features.
    """

    def __init__(self, extractor: FeatureExtractor) -> None:
        super().__init__(
            edges=extractor.edges,
            flow=extractor.flow,
            working_size=extractor.working_size,
            colour=extractor.colour,
        )
        self.to(dtype=extractor.luma.dtype, device=extractor.luma.device)
        self._last: tuple[tuple[Any, ...], FrameFeatures] | None = None

    def forward(self, frame: Any, previous: Any = None, mask: Any = None) -> FrameFeatures:
        """See `FeatureExtractor`; the same objects as last time give the same features."""
        asked = (frame, previous, mask)
        if self._last is not None and all(
            have is want for have, want in zip(self._last[0], asked, strict=True)
        ):
            return self._last[1]
        self._last = (asked, super().forward(*asked))
        return self._last[1]


class Run(NamedTuple):
    """One tracker from the first frame to its end.

    Attributes:
        settings: What was run.
        measures: What was measured, frame by frame.
        ended: "complete", "lost" if it was stopped for that, or the error that ended it.
    """

    settings: Settings
    measures: list[FrameMeasures]
    ended: str


def track_together(
    sequence: RecordedSequence,
    runs: Sequence[tuple[Settings, Start]],
    thresholds: Thresholds,
    *,
    start: int = 0,
    stop: int | None = None,
    stop_when_lost: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[Run]:
    """Run trackers side by side, frame by frame, through one pass over the video.

    Args:
        sequence: What is tracked.
        runs: The trackers, which agree in terms, working size, type and device, and their starts.
        thresholds: What counts as failed.
        start: First frame.
        stop: Frame before which to end.
        stop_when_lost: End a run as soon as the body is lost for good.
        progress: Called after every frame with its index and the number of trackers left.

    Yields:
        Every run, when it ends.
    """
    reader = VideoReader(sequence.video, start=start, stop=stop)
    extractor = SharedFeatures(make_extractor(runs[0][0]))
    current: list[Frame | None] = [None]
    going = [
        (
            Run(settings, [], "complete"),
            _follow(sequence, settings, begin, iter(lambda: current[0], None), extractor, start),
            Yardstick(sequence, begin.first.body, thresholds),
        )
        for settings, begin in runs
    ]
    first: Frame | None = None
    for frame in reader:
        clock = time.perf_counter()
        extractor(frame.image, None if current[0] is None else current[0].image)
        features_s = time.perf_counter() - clock
        current[0], first = frame, first or frame
        left = []
        for run, tracked, yardstick in going:
            ended = None
            try:
                run.measures.append(yardstick(next(tracked), first, features_s))
            except (TorchcssError, RuntimeError, ArithmeticError) as error:
                # The others go on: a study takes hours. The table says that this one ended.
                ended = f"error: {type(error).__name__}: {error}"
            if ended is None and stop_when_lost and loss(run.measures, thresholds) is not None:
                ended = "lost"
            if ended is None:
                left.append((run, tracked, yardstick))
            else:
                yield run._replace(ended=ended)
        going = left
        if progress is not None:
            progress(frame.index, len(going))
        if not going:
            return
    for run, _, _ in going:
        yield run


def _follow(
    sequence: RecordedSequence,
    settings: Settings,
    begin: Start,
    frames: Iterator[Frame],
    extractor: FeatureExtractor,
    start: int,
) -> Iterator[TrackedFrame]:
    marks, body, interval = sequence.keypoints, begin.first.body, 1 / sequence.frame_rate
    full = sequence.camera.image_size_wh
    working = extractor.working_shape(*full)
    scaled = scale_keypoints(marks.keypoints, full, working).to(body.tie)
    confidence = marks.confidence.to(body.tie)

    def observe(index: int) -> JointObservation | None:
        if settings.keypoints_use == "first" and index != start:
            return None
        return JointObservation(
            body.joint_names, scaled[index], confidence[index], marks.joint_names
        )

    return track_frames(
        frames,
        body=body,
        mixture=begin.first.mixture,
        camera=sequence.camera,
        extractor=extractor,
        tracker=make_settings_tracker(settings, body.motion_rate * interval),
        choice=make_choice(settings, begin.sigma * working[0] / full[0]),
        observe=observe,
        frame_interval=interval,
        generator=begin.generator,
        boundary_emphasis=boundary_emphasis(settings),
        limits=PRESETS[settings.preset].limits,
        recovery=Recovery() if settings.recovery else None,
        jumps_every=PRESETS[settings.preset].jumps_every,
        limb_jumps=settings.limb_jumps,
        carries=settings.prediction == "surface",
    )
