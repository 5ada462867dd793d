"""Smooth a run on disk: `smooth.npz`, and an entry `smoothed` in `summary.json`."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from torchcss.app.view_files import FrameSelection, moments, open_run
from torchcss.body.bases import pose_track
from torchcss.errors import ConfigurationError, TrackFileError
from torchcss.files import StrPath, naming, prepare_output_folder
from torchcss.initialise.view import CameraView
from torchcss.io.run import Run, as_run, body_of_track
from torchcss.io.tracks import SMOOTH_NAME, TRACK_NAME, Track, save_track, write_summary
from torchcss.tracking import smooth_images
from torchcss.tracking.settings import Settings, settings_from_plain
from torchcss.tracking.smooth import Smoothed, Smoothing, TrackedModes, smooth_modes
from torchcss.tracking.smooth_images import IMAGES, ShownFrames
from torchcss.types import Status


class SmoothedTrack(NamedTuple):
    """A smoothed track.

    Attributes:
        track: One mode per frame; the alternatives stay in the track that it came from.
        modes: Which of the modes of the track it came from each frame's was.
        effect: What it changed, for people; numbers and lists.
    """

    track: Track
    modes: Int[np.ndarray, " t"]
    effect: dict[str, Any]


def smooth(
    run: Run | StrPath,
    choice: Smoothing | None = None,
    *,
    images: bool = False,
    out: StrPath | None = None,
) -> Run:
    """Smooth a run.

    Args:
        run: The run, or its folder. Its track stays as it is.
        choice: How to smooth.
        images: Fit the result to the images of its cameras again.
        out: Folder for `smooth.npz` and `summary.json`; by default the run's own.

    Returns:
        The smoothed run, whose `summary["smoothed"]` says what was changed.

    Raises:
        TorchcssError: With one line that says what was wrong.
    """
    run = as_run(run)
    into = prepare_output_folder(run.folder if out is None else out)
    path = into / SMOOTH_NAME
    if run.path.name != TRACK_NAME and run.path.resolve() == path.resolve():
        raise ConfigurationError(
            f"{run.path}: the smoothed track would replace it; give the track that it came from, "
            "or another folder with --out"
        )
    if into.resolve() != run.folder.resolve() and (into / TRACK_NAME).is_file():
        raise ConfigurationError(
            f"{into}: holds another run, whose summary would be replaced; give another folder with "
            "--out"
        )
    track = run.track._replace(body=run.body)
    run = replace(run, track=track)
    done = _with_images(run, choice or IMAGES) if images else smooth_track(track, choice)
    save_track(path, done.track)
    summary = {**run.summary, "smoothed": {"file": path, **done.effect, "modes": done.modes}}
    write_summary(into, summary)
    return Run(path=path, track=done.track, summary=summary)


def smooth_track(track: Track, choice: Smoothing | None = None) -> SmoothedTrack:
    """Smooth a track (`torchcss.tracking.smooth`).

    Args:
        track: The track, with several modes per frame or one.
        choice: How to smooth.

    Raises:
        TrackFileError: If the track is empty, its times do not rise, or it does not say which body
            it is of.
    """
    choice, began = choice or Smoothing(), time.perf_counter()
    done = smooth_modes(body_of_track(track), _tensors(track), choice)
    return _smoothed(track, done, choice, began)


def smooth_frames(
    track: Track,
    images: Iterable[ShownFrames],
    *,
    settings: Settings,
    views: Sequence[CameraView],
    choice: Smoothing = IMAGES,
) -> SmoothedTrack:
    """Smooth a track, and fit the result to the images again (`torchcss.tracking.smooth_images`).

    Args:
        track: The track.
        images: The images of its frames, in order.
        settings: How it was tracked.
        views: The cameras that look on.
        choice: How to smooth.

    Raises:
        TorchcssError: As `smooth_track`; or if frames are missing.
    """
    began, body = time.perf_counter(), body_of_track(track)
    done = smooth_images.smooth_modes_on_images(
        body, _tensors(track), images, settings=settings, views=views, choice=choice
    )
    refined = done.refined
    found = done.first._replace(refined=refined, cost=refined.cost)
    smoothed = _smoothed(track, found, choice, began)
    smoothed.effect.update(
        evidence_of="images",
        mean_cost_before_images=float(done.cost_at_start.mean()),
        mean_cost_after_images=float(refined.cost.mean()),
        status=Status(int(refined.status)).name.lower(),
        iterations=int(refined.num_steps),
    )
    return smoothed


def _tensors(track: Track) -> TrackedModes:
    """The modes of a track as tensors."""
    names = ("frames", "times", "base_transform", "state", "covariance", "log_weight", "cost")
    arrays = (torch.from_numpy(getattr(track, name)) for name in names)
    return TrackedModes(*arrays, likelihood_power=track.likelihood_power)


def _smoothed(track: Track, done: Smoothed, choice: Smoothing, began: float) -> SmoothedTrack:
    """The states as a track of one mode per frame, and what they changed."""
    refined = done.refined
    bases = torch.from_numpy(track.base_transform)
    joints = pose_track(body_of_track(track), refined.mean, bases).joints
    parent = np.zeros((len(track.frames), 1), dtype=np.int64)
    parent[:1] = -1
    result = track._replace(
        state=refined.mean[:, None].numpy(),
        covariance=refined.covariance[:, None].numpy(),
        log_weight=np.zeros((len(track.frames), 1)),
        cost=done.cost[:, None].numpy(),
        parent=parent,
        joints_world=joints[:, None].numpy(),
        likelihood_power=1 / choice.persistence if choice.persistence else track.likelihood_power,
    )
    modes = done.modes.numpy()
    effect = {
        **asdict(choice),
        "evidence_of": "modes",
        "seconds": time.perf_counter() - began,
        **_effect(track, modes, result),
        "frames_without_evidence": track.frames[~done.seen.numpy()],
        "states_at_a_limit": int(refined.active.sum()),
    }
    return SmoothedTrack(result, modes, effect)


def jitter(joints: Float[np.ndarray, "t j 3"], times: Float[np.ndarray, " t"]) -> float:
    """Mean acceleration of the joints, m/s^2; NaN for fewer than three frames."""
    if len(times) < 3:
        return math.nan
    step = np.diff(times)[:, None, None]
    velocity = np.diff(joints, axis=0) / step
    change = np.diff(velocity, axis=0) / (0.5 * (step[1:] + step[:-1]))
    return float(np.linalg.norm(change, axis=-1).mean())


def _effect(track: Track, modes: Int[np.ndarray, " t"], smooth: Track) -> dict[str, Any]:
    """What smoothing changed.

    Args:
        track: The track that was smoothed.
        modes: The path through its modes.
        smooth: What came out.
    """
    everywhere = np.arange(len(modes))
    parent = track.parent[everywhere, modes]
    switched = (parent[1:] != modes[:-1]) & (parent[1:] >= 0)
    best, path = track.joints_world[:, 0], track.joints_world[everywhere, modes]
    after = smooth.joints_world[:, 0]
    moved = np.linalg.norm(after - best, axis=-1)
    return {
        "frames_not_the_trackers_best": int((modes != 0).sum()),
        "path_switches": int(switched.sum()),
        "mean_change_mm": 1000 * float(moved.mean()),
        "greatest_change_mm": 1000 * float(moved.max()),
        "jitter_before_m_per_s2": jitter(best, track.times),
        "jitter_of_the_path_m_per_s2": jitter(path, track.times),
        "jitter_after_m_per_s2": jitter(after, track.times),
    }


def _with_images(run: Run, choice: Smoothing) -> SmoothedTrack:
    """Smooth a run with the images of its cameras in view."""
    track, settings = run.track, run_settings(run)
    if not len(track.frames):
        raise TrackFileError(f"{run.path}: the track has no frames, of which images could show any")
    files = track.first_files
    known = {
        "--camera": bool(run.cameras),
        "--video": files is not None,
        "--keypoints": files is not None and files.keypoints is not None,
    }
    if missing := [option for option, there in known.items() if not there]:
        raise ConfigurationError(
            f"{run.path}: the images can be fitted only where video, camera and keypoints are "
            f"known; give {', '.join(missing)}"
        )
    first, stop = int(track.frames[0]), int(track.frames[-1]) + 1
    views = open_run(run, FrameSelection(start=first, stop=stop))
    return smooth_frames(
        track,
        moments(views, set(track.frames.tolist())),
        settings=settings,
        views=[view.view(torch.zeros((), dtype=torch.float64)) for view in views],
        choice=choice,
    )


def run_settings(run: Run) -> Settings:
    """The settings that a run was made with, for evaluation on the processor in float64.

    Args:
        run: The run; where it does not say, the defaults.

    Raises:
        ConfigurationError: If its settings are not those of this version.
    """
    told = {"body": run.body.name, **run.settings, "device": "cpu", "dtype": "float64"}
    with naming(run.path, ConfigurationError):
        return settings_from_plain(told)


def report(effect: Mapping[str, Any]) -> str:
    """What smoothing did, in a few lines.

    Args:
        effect: `summary["smoothed"]` of a smoothed run.
    """
    late = "" if effect.get("lag") is None else f" (with {effect['lag']} frames after each in view)"
    before, after = effect["jitter_before_m_per_s2"], effect["jitter_after_m_per_s2"]
    has_jitter = before is not None and not math.isnan(before)  # two frames have none
    lines = [
        (f"jitter {before:.1f} to {after:.1f} m/s^2, " if has_jitter else "")
        + f"joints moved by {effect['mean_change_mm']:.0f} mm in the mean{late}",
        f"{effect['frames_not_the_trackers_best']} frames take another mode than the tracker's "
        f"best, {effect['path_switches']} switches between modes are left",
    ]
    blind = len(effect["frames_without_evidence"])
    if blind:
        lines.append(f"{blind} frames had no evidence and follow from their neighbours")
    if "mean_cost_after_images" in effect:
        lines.append(
            f"mean cost of a frame {effect['mean_cost_before_images']:.1f} to "
            f"{effect['mean_cost_after_images']:.1f} nats"
        )
    return "\n".join([*lines, f"wrote {effect['file']}"])
