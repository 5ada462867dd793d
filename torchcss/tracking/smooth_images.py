"""Smooth a track with its video in view: a second pass in which all frames share what they see.

`torchcss.tracking.smooth` takes the mode of a frame as a Gaussian, found when only the frames
before were known, with a temporal prior about the frame before in it. `smooth_frames` starts from
that result and fits the states again to the images, a window of frames at a time: the cost of every
frame (edges, keypoints, flow, priors, but no temporal prior about a parent mode) plus the motion
prior over all of them (`inference.smoothing.refine_in_windows`). Frames that the tracker had lost
get the evidence of their image again.

The flow of a frame moves the nodes of the frame before, as the start has them.

`torchcss.smooth` does it for a run on disk.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from tqdm import tqdm

from torchcss.body.root import free_turns
from torchcss.cost.total import TrackingCost, beside
from torchcss.errors import VideoError
from torchcss.inference.smoothing import IN_WINDOWS, refine_in_windows
from torchcss.io.run import body_of_track
from torchcss.io.tracks import Track
from torchcss.tracking.settings import Settings, make_plan
from torchcss.tracking.smooth import (
    SmoothedTrack,
    Smoothing,
    base_changes,
    effect_of,
    motion_prior,
    smooth_track,
    track_of,
)
from torchcss.tracking.view import NOTHING_KNOWN, NOTHING_SEEN, CameraView, Observer
from torchcss.types import Frame, Status

IMAGES = Smoothing(acceleration_ratio=20.0)
"""How to smooth by default. Images say where the body is more exactly than the modes of a tracker
do, so that motion may be freer; chosen on the same view as the other default."""


def smooth_frames(
    track: Track,
    images: Iterable[Frame | Sequence[Frame | None]],
    *,
    settings: Settings,
    views: Sequence[CameraView],
    choice: Smoothing | None = None,
) -> SmoothedTrack:
    """Smooth a track, and fit the result to the images again.

    Args:
        track: The track.
        images: The images of its frames, in order: one of each view.
        settings: How it was tracked. Temporal terms are left out, and the segmentation, which tells
            modes apart. Colours are learnt from the track that was smoothed without images.
        views: The cameras that look on.
        choice: How to smooth; `IMAGES` by default.

    Raises:
        TorchcssError: As `smooth_track`; or if frames are missing.
    """
    choice = choice or IMAGES
    first, began = smooth_track(track, choice=choice), time.perf_counter()
    body = body_of_track(track)
    start, bases = (
        torch.from_numpy(array) for array in (first.track.state[:, 0], track.base_transform)
    )
    changes = base_changes(body, bases)
    plan = make_plan(settings, body, views[0], 0.0)
    cost = plan.choice.without("temporal", "temporal_mixture", "segmentation")
    plan = plan._replace(choice=cost, surface_prediction=False)
    observers = [plan.observer(body, view) for view in views]
    at_start: list[float] = []

    def costs() -> Iterator[TrackingCost]:
        moments = iter(tqdm(images, total=len(track.frames), unit="frame", dynamic_ncols=True))
        seen = (NOTHING_SEEN,) * len(observers)
        memory = [NOTHING_KNOWN] * len(observers)
        for row, index in enumerate(track.frames.tolist()):
            frames = next(moments, None)
            frames = (frames,) if isinstance(frames, Frame) else tuple(frames or (None,))
            if frames[0] is None or frames[0].index != index:
                raise VideoError(
                    f"the video has no frame {index} where the track expects it; give the video "
                    "that was tracked"
                )
            frames += (None,) * (len(observers) - len(frames))
            seen = tuple(map(Observer.observe, observers, frames, seen))
            memory = list(map(Observer.recall, observers, memory, seen))
            before = start[row - 1 : row] if row else None
            if before is not None and row - 1 in changes:
                before = changes[row - 1](before)
            there = body.with_base(bases[row, :3, :3], bases[row, :3, 3])
            keypoints = row == 0 or not plan.keypoints_first_only
            one = beside(
                [
                    observer.cost(now, known, there, before, keypoints=keypoints)
                    for observer, now, known in zip(observers, seen, memory, strict=True)
                ]
            )
            at_start.append(float(one.value(start[row : row + 1])))
            memory = [
                observer.learn(known, now, there, start[row : row + 1])
                for observer, now, known in zip(observers, seen, memory, strict=True)
            ]
            yield one

    refined = refine_in_windows(
        costs(),
        start,
        torch.from_numpy(track.times),
        motion_prior(body, choice),
        free_turns(body),
        choice=replace(IN_WINDOWS, likelihood_power=1 / choice.persistence),
        changes=changes,
    )
    result = track_of(track, body, refined, cost=refined.cost)
    result = result._replace(likelihood_power=1 / choice.persistence)
    effect = {
        **first.effect,
        **effect_of(track, first.modes, result),
        "evidence_of": "images",
        "seconds": first.effect["seconds"] + time.perf_counter() - began,
        "states_at_a_limit": int(refined.active.sum()),
        "mean_cost_before_images": float(np.mean(at_start)),
        "mean_cost_after_images": float(refined.cost.mean()),
        "status": Status(int(refined.status)).name.lower(),
        "iterations": int(refined.num_steps),
    }
    return SmoothedTrack(result, first.modes, effect)
