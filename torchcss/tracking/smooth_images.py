"""Smooth a track with its video in view: a second pass in which all frames share what they see.

`torchcss.tracking.smooth` takes the mode of a frame as a Gaussian, found when only the frames
before were known, with a temporal prior about the frame before in it. `smooth_frames` starts from
that result and fits the states again to the images, a window of frames at a time: the cost of every
frame (edges, keypoints, flow, priors, but no temporal prior about a parent mode) plus the motion
prior over all of them (`inference.smoothing.refine_in_windows`). Frames that the tracker had lost
get the evidence of their image again.

The flow of a frame carries the nodes of the frame before, as the start has them.

`smooth_video` does it for files, and writes what `smooth_file` writes.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchcss.body.model import BodyModel
from torchcss.body.root import free_turns
from torchcss.cost.frame import FrameCosts, beside
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.errors import VideoError
from torchcss.inference.smoothing import refine_in_windows
from torchcss.io.run import body_of_track
from torchcss.io.tracks import Track
from torchcss.tracking.smooth import (
    SmoothedTrack,
    Smoothing,
    base_changes,
    effect_of,
    motion_prior,
    smooth_track,
    track_of,
)
from torchcss.tracking.view import Observe, ViewStream, Watcher
from torchcss.types import Frame, Status
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor

IMAGES = Smoothing(agility=20.0)
"""How to smooth by default. Images say where the body is more exactly than the modes of a tracker
do, so that motion may be freer; chosen on the same view as the other default."""


def smooth_frames(
    track: Track,
    frames: Iterable[Frame],
    *,
    body: BodyModel | None = None,
    camera: Camera,
    extractor: FeatureExtractor,
    cost: CostChoice,
    observe: Observe,
    choice: Smoothing | None = None,
    boundary_emphasis: float = 0.0,
    masks: Iterable[np.ndarray | Tensor] | None = None,
    others: Sequence[ViewStream] = (),
) -> SmoothedTrack:
    """Smooth a track, and fit the result to the images again.

    Args:
        track: The track.
        frames: The images of its frames, in order.
        body: The body with its flesh; None: told from the track, with the flesh of the standard
            humanoid.
        camera: Camera of the full-size images.
        extractor: Makes the features, at its working size.
        cost: Terms and weights; temporal terms are left out, and the segmentation, which tells
            modes apart. Colours are learnt from the track that was smoothed without images. Pixels
            are those of the working image.
        observe: Keypoints by frame.
        choice: How to smooth; `IMAGES` by default.
        boundary_emphasis: See `FrameFeatures.edge_field`.
        masks: Foreground of each of the images; None: not known.
        others: What further cameras send, see `torchcss.tracking.session.track_frames`.

    Raises:
        TorchcssError: As `smooth_track`; or if frames are missing.
    """
    choice = choice or IMAGES
    first, began = smooth_track(track, body, choice=choice), time.perf_counter()
    body = body_of_track(track, body)
    start, bases = (
        torch.from_numpy(array) for array in (first.track.state[:, 0], track.base_transform)
    )
    changes = base_changes(body, bases)
    watchers = [
        Watcher(
            FrameCosts(
                body,
                extractor.working_camera(view.camera),
                replace(cost, temporal=None, temporal_mixture=None, segmentation=None),
                boundary_emphasis=boundary_emphasis,
            ),
            extractor,
            view.observe,
            view.masks,
        )
        for view in (ViewStream(frames, camera, observe, masks), *others)
    ]
    streams = [iter(view.frames) for view in others]
    at_start: list[float] = []

    def costs() -> Iterator[TrackingCost]:
        images = iter(tqdm(frames, total=len(track.frames), unit="frame", dynamic_ncols=True))
        for row, index in enumerate(track.frames.tolist()):
            frame = next(images, None)
            if frame is None or frame.index != index:
                raise VideoError(
                    f"the video has no frame {index} where the track expects it; give the video "
                    "that was tracked"
                )
            beside_it = [next(stream, None) for stream in streams]
            for watcher, image in zip(watchers, (frame, *beside_it), strict=True):
                watcher.look(image)
            before = start[row - 1 : row] if row else None
            if before is not None and row - 1 in changes:
                before = changes[row - 1](before)
            there = body.with_base(bases[row, :3, :3], bases[row, :3, 3])
            one = beside([watcher.cost(there, before) for watcher in watchers])
            at_start.append(float(one.value(start[row : row + 1])))
            for watcher in watchers:
                watcher.learn(there, start[row : row + 1])
            yield one

    refined = refine_in_windows(
        costs(),
        start,
        torch.from_numpy(track.times),
        motion_prior(body, choice),
        free_turns(body),
        evidence=1 / choice.persistence,
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
