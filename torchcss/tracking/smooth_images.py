"""Smooth a track with its video in view: a second pass in which all frames share what they see.

`torchcss.tracking.smooth` takes the mode of a frame as a Gaussian, found when only the frames
before were known, with a temporal prior about the frame before in it. `smooth_modes_on_images`
starts from that result and fits the states again to the images, a window of frames at a time: the
cost of every frame (edges, keypoints, flow, priors, but no temporal prior about a parent mode) plus
the motion prior over all of them (`inference.smoothing.refine_in_windows`). Frames that the tracker
had lost get the evidence of their image again.

The flow of a frame moves the nodes of the frame before, as the start has them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from torchcss.body.model import BodyModel
from torchcss.body.root import free_turns
from torchcss.cost.frame import NOTHING_KNOWN
from torchcss.cost.total import TrackingCost, beside
from torchcss.errors import ConfigurationError, VideoError
from torchcss.inference.smoothing import IN_WINDOWS, Refined, refine_in_windows
from torchcss.initialise.view import CameraView
from torchcss.tracking.settings import Plan, Settings, make_plan
from torchcss.tracking.smooth import (
    Smoothed,
    Smoothing,
    TrackedModes,
    base_changes,
    motion_prior,
    smooth_modes,
)
from torchcss.tracking.view import NOTHING_SEEN, Observer
from torchcss.types import Frame, Trajectory

IMAGES = Smoothing(acceleration_ratio=20.0)
"""How to smooth by default. Images say where the body is more exactly than the modes of a tracker
do, so that motion may be freer; chosen on the same view as the other default."""

ShownFrames = Frame | Sequence[Frame | None]
"""What one moment shows: a frame of the only view, or one of each view."""


class SmoothedOnImages(NamedTuple):
    """A trajectory that was fitted to the images.

    Attributes:
        first: What it started from.
        refined: Its states, covariances and costs.
        cost_at_start: What the images said of each state of the start, nats.
    """

    first: Smoothed
    refined: Refined
    cost_at_start: Float[Tensor, " t"]


def smooth_modes_on_images(
    body: BodyModel,
    track: TrackedModes,
    images: Iterable[ShownFrames],
    *,
    settings: Settings,
    views: Sequence[CameraView],
    choice: Smoothing = IMAGES,
) -> SmoothedOnImages:
    """Smooth a track, and fit the result to the images again.

    Args:
        body: Its body, on the origin.
        track: Its modes.
        images: The images of its frames, in order.
        settings: How it was tracked. Temporal terms are left out, and the segmentation, which tells
            modes apart. Colours are learnt from the track that was smoothed without images.
        views: The cameras that look on.
        choice: How to smooth.

    Raises:
        TorchcssError: As `smooth_modes`; or if frames are missing.
    """
    if choice.lag is not None:
        raise ConfigurationError("lag: the images are fitted with all frames in view; leave it out")
    first = smooth_modes(body, track, choice)
    start = first.refined.mean
    plan = make_plan(settings, body, views[0], 0.0)
    past = (term.name for term in plan.choice.terms if term.of_past)
    cost = plan.choice.without(*past, "segmentation")
    plan = plan._replace(choice=cost, surface_prediction=False)
    moments = _moments(images, track.frames.tolist(), len(views))
    at_start: list[float] = []

    def costs() -> Iterator[TrackingCost]:
        for row, one in enumerate(_costs(body, track.bases, start, moments, plan, views)):
            at_start.append(float(one.value(start[row : row + 1])))
            yield one

    refined = refine_in_windows(
        costs(),
        start,
        track.times,
        motion_prior(body, choice),
        free_turns(body),
        choice=replace(IN_WINDOWS, likelihood_power=1 / choice.frames_as_one),
        changes=base_changes(body, track.bases),
    )
    if choice.persistence is None:
        refined = refined._replace(covariance=first.refined.covariance)
    return SmoothedOnImages(first, refined, torch.tensor(at_start, dtype=torch.float64))


def _moments(
    images: Iterable[ShownFrames], frames: Sequence[int], num_views: int
) -> Iterator[tuple[Frame | None, ...]]:
    """The images of the frames, of every view; checked."""
    moments = iter(tqdm(images, total=len(frames), unit="frame", dynamic_ncols=True))
    for index in frames:
        shown = next(moments, None)
        shown = (shown,) if isinstance(shown, Frame) else tuple(shown or (None,))
        if shown[0] is None or shown[0].index != index:
            raise VideoError(
                f"the video has no frame {index} where the track expects it; give the video "
                "that was tracked"
            )
        yield shown + (None,) * (num_views - len(shown))


def _costs(
    body: BodyModel,
    bases: Float[Tensor, "t 4 4"],
    start: Trajectory,
    moments: Iterable[tuple[Frame | None, ...]],
    plan: Plan,
    views: Sequence[CameraView],
) -> Iterator[TrackingCost]:
    """The cost of every frame; colours and flow come from the states of the start."""
    observers = [plan.observer(body, view) for view in views]
    changes = base_changes(body, bases)
    seen = (NOTHING_SEEN,) * len(observers)
    memory = [NOTHING_KNOWN] * len(observers)
    before = None
    for row, frames in enumerate(moments):
        seen = tuple(map(Observer.observe, observers, frames, seen))
        memory = list(map(Observer.recall, observers, memory, seen))
        there = body.with_base(bases[row, :3, :3], bases[row, :3, 3])
        keypoints = row == 0 or not plan.keypoints_first_only
        known = list(zip(observers, seen, memory, strict=True))
        yield beside(
            [
                observer.cost(now, past, there, before, keypoints=keypoints)
                for observer, now, past in known
            ]
        )
        own = start[row : row + 1]
        memory = [each.costs.learn(past, now.features, there, own) for each, now, past in known]
        before = changes[row](own) if row in changes else own
