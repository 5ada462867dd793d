"""Smooth a track with its video in view: a second pass in which all frames share what they see.

`torchcss.smooth` takes the mode of a frame as a Gaussian, found when only the frames before were
known, with a temporal prior about the frame before in it. `smooth_frames` starts from that result
and fits the states again to the images, a window of frames at a time: the cost of every frame
(edges, keypoints, flow, priors, but no temporal prior about a parent mode) plus the motion prior
over all of them (`inference.smoothing.refine_in_windows`). Frames that the tracker had lost get the
evidence of their image again.

The flow of a frame carries the nodes of the frame before, as the start has them.

`smooth_video` does it for files, and writes what `smooth_file` writes.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchcss.body.model import BodyModel
from torchcss.body.root import free_turns
from torchcss.cost.frame import FrameCosts, beside
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.errors import ConfigurationError, TrackFileError, VideoError
from torchcss.inference.smoothing import refine_in_windows
from torchcss.io.fitted_body import body_beside, read_fitted_body
from torchcss.io.keypoints import Scale
from torchcss.io.track_body import body_of_track
from torchcss.io.tracks import SUMMARY_NAME, Track, read_summary
from torchcss.io.video import Frame
from torchcss.settings import Settings, boundary_emphasis, make_choice, make_extractor
from torchcss.smooth import (
    SmoothedTrack,
    Smoothing,
    base_changes,
    effect_of,
    motion_prior,
    open_track,
    smooth_track,
    track_of,
    write_smoothed,
)
from torchcss.types import Status
from torchcss.view_files import ViewFiles, open_view
from torchcss.views import Observe, ViewStream, Watcher
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
        others: What further cameras send, see `torchcss.pipeline.track_frames`.

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
    result = result._replace(evidence=1 / choice.persistence)
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


def smooth_video(
    track: str | os.PathLike[str],
    *,
    video: Path,
    camera: Path,
    keypoints: Path,
    out: str | os.PathLike[str] | None = None,
    choice: Smoothing | None = None,
    camera_name: str | None = None,
    layout: str | None = None,
    normalised: bool | Scale = False,
    masks: Path | None = None,
    body: Path | None = None,
    others: Sequence[ViewFiles] = (),
) -> dict[str, Any]:
    """Smooth a track on disk with its video: `smooth.npz` and an entry in `summary.json`.

    Args:
        track: `track.npz`, or the folder that it is in; its `summary.json` has the settings.
        video: The video that was tracked, or a folder of images.
        camera: Calibration file, see `torchcss.io.cameras`.
        keypoints: 2D joints, see `torchcss.io.keypoints`.
        out: Output folder; by default that of the track.
        choice: How to smooth; `IMAGES` by default.
        camera_name: Which camera of the file; by default the one of this video.
        layout: Layout of a keypoint file that does not name its joints.
        normalised: Whether keypoints are fractions of the image, and which, see
            `torchcss.io.keypoints.Scale`.
        masks: Foreground of every frame.
        body: The fitted body; by default `body.npz` beside the track if there is one, else the
            flesh of the standard humanoid on the lengths of the track.
        others: What further cameras recorded, see `torchcss.track_video`.

    Returns:
        The entry of the summary.

    Raises:
        TorchcssError: With one line that says what was wrong, for any bad input.
    """
    found, folder, into = open_track(track, out)
    settings = settings_of(folder, found)
    flesh = body_beside(folder) if body is None else read_fitted_body(body).body
    if not len(found.frames):
        raise TrackFileError(f"{track}: the track has no frames, of which the video could show any")
    first, stop = int(found.frames[0]), int(found.frames[-1]) + 1
    files = ViewFiles(
        video=Path(video),
        keypoints=Path(keypoints),
        camera_name=camera_name,
        masks=masks,
        layout=layout,
        normalised=normalised,
    )
    views = [open_view(each, camera, start=first, stop=stop) for each in (files, *others)]
    extractor = make_extractor(settings)
    noise = views[0].noise(extractor)
    main, *beside_it = (
        view.stream(
            extractor,
            found.joint_names,
            torch.zeros((), dtype=torch.float64),
            sigma=noise,
            only_first=first if settings.keypoints_use == "first" else None,
            frames=set(found.frames.tolist()),
        )
        for view in views
    )
    done = smooth_frames(
        found,
        main.frames,
        body=flesh,
        camera=main.camera,
        extractor=extractor,
        cost=make_choice(settings, noise),
        observe=main.observe,
        choice=choice,
        boundary_emphasis=boundary_emphasis(settings),
        masks=main.masks,
        others=beside_it,
    )
    return write_smoothed(done, into, folder)


def settings_of(folder: Path, track: Track) -> Settings:
    """The settings that a track was made with, for evaluation on the processor in float64.

    Args:
        folder: Where its `summary.json` is; without one, the defaults.
        track: The track, which tells its body then.

    Raises:
        ConfigurationError: If the summary's settings are not those of this version.
    """
    entries: dict[str, Any] = {}
    if (folder / SUMMARY_NAME).is_file():
        entries = read_summary(folder).get("settings", {})
    known = {field.name for field in fields(Settings)}
    try:
        entries = {name: value for name, value in entries.items() if name in known}
        if "terms" in entries:
            entries["terms"] = tuple(entries["terms"])
        settings = Settings(**{"body": "", **entries, "device": "cpu", "dtype": "float64"})
    except (TypeError, AttributeError) as error:
        raise ConfigurationError(
            f"{folder / SUMMARY_NAME}: its settings are not those of torchcss: {error}"
        ) from error
    return settings if settings.body else replace(settings, body=body_of_track(track).name)
