"""Smooth a run on disk: `smooth.npz`, and an entry `smoothed` in `summary.json`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from torchcss.app.view_files import Selection, moments, open_view
from torchcss.errors import ConfigurationError, TrackFileError
from torchcss.files import prepare_output_folder
from torchcss.io.run import Run, as_run
from torchcss.io.tracks import TRACK_NAME, save_track, write_summary
from torchcss.tracking.settings import Settings, settings_from_plain
from torchcss.tracking.smooth import SmoothedTrack, Smoothing, smooth_track
from torchcss.tracking.smooth_images import IMAGES, smooth_frames

SMOOTH_NAME = "smooth.npz"


def smooth(
    run: Run | str | os.PathLike[str],
    choice: Smoothing | None = None,
    *,
    images: bool = False,
    out: str | os.PathLike[str] | None = None,
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
    track = run.track._replace(body=run.body)
    run = replace(run, track=track)
    done = _with_images(run, choice or IMAGES) if images else smooth_track(track, choice=choice)
    save_track(path, done.track)
    entry = {"file": path, **done.effect, "modes": done.modes}
    summary = {**run.summary, "smoothed": entry}
    write_summary(into, summary)
    return Run(path=path, track=done.track, summary=summary)


def _with_images(run: Run, choice: Smoothing) -> SmoothedTrack:
    """Smooth a run with the images of its cameras in view."""
    track, settings = run.track, settings_of(run)
    if not len(track.frames):
        raise TrackFileError(f"{run.path}: the track has no frames, of which images could show any")
    files = run.cameras[0].files if run.cameras else None
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
    views = [
        open_view(each.files, each.camera, Selection(start=first, stop=stop))
        for each in run.cameras
        if each.files is not None
    ]
    return smooth_frames(
        track,
        moments(views, set(track.frames.tolist())),
        settings=settings,
        views=[view.view(torch.zeros((), dtype=torch.float64)) for view in views],
        choice=choice,
    )


def settings_of(run: Run) -> Settings:
    """The settings that a run was made with, for evaluation on the processor in float64.

    Args:
        run: The run; where it does not say, the defaults.

    Raises:
        ConfigurationError: If its settings are not those of this version.
    """
    try:
        told = {"body": run.body.name, **run.settings, "device": "cpu", "dtype": "float64"}
        return settings_from_plain(told)
    except ConfigurationError as error:
        raise ConfigurationError(f"{run.path}: {error}") from error


def report(effect: Mapping[str, Any]) -> str:
    """What smoothing did, in a few lines.

    Args:
        effect: `summary["smoothed"]` of a smoothed run.
    """
    lines = [
        f"jitter {effect['jitter_before_m_per_s2']:.1f} to {effect['jitter_after_m_per_s2']:.1f} "
        f"m/s^2, joints moved by {effect['mean_change_mm']:.0f} mm in the mean",
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
