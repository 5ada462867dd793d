"""Writes a run as it goes: `track.npz`, `summary.json` and `overlay.mp4`.

`Recorder.run` takes what `TrackingSession.track` yields; a run that is interrupted
keeps what it has. Whatever else should see the frames as they come is a `Sink`: the overlay's film
is one, the live viewer (`torchcss.app.live`) another. `draw_modes` draws one frame of the overlay.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor
from tqdm import tqdm

from torchcss.app.smooth import SMOOTH_NAME
from torchcss.body.model import BodyModel
from torchcss.files import output_error
from torchcss.inference.tracker import SequenceTracker, stated_evidence
from torchcss.io.cameras import calibration
from torchcss.io.checkpoint import remove_checkpoint
from torchcss.io.tracks import TRACK_NAME, FrameModes, Track, TrackWriter, write_summary
from torchcss.io.video import VideoWriter
from torchcss.io.view_files import RecordedCamera
from torchcss.show.overlay import draw_overlay, project_body
from torchcss.tracking.session import Posterior
from torchcss.tracking.settings import Settings
from torchcss.types import Status
from torchcss.vision.camera import Camera

_SAVE_SHARE = 0.05
"""Share of the time that may go into saving the track as it grows: a full disk then leaves nearly
all of it, since a save replaces the last good file only when it is complete."""


def draw_modes(
    tracked: Posterior,
    camera: Camera,
    *,
    image: UInt8[np.ndarray, "h w 3"] | None = None,
    rings: int = 16,
    meridians: int = 20,
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the best mode as a shaded body and the others as outlines over the frame.

    Args:
        tracked: A tracked frame.
        camera: Camera of the full-size image.
        image: What that camera took; by default the first camera's image.
        rings: Latitudes of the drawn mesh.
        meridians: Longitudes of the drawn mesh.
    """
    body, mixture = tracked.body, tracked.state.mixture
    modes = project_body(body, mixture.mean, camera, rings=rings, meridians=meridians)
    text = (
        f"frame {tracked.frame.index}   {len(modes)} modes   cost {float(tracked.info.cost[0]):.1f}"
    )
    picture = draw_overlay(
        torch.from_numpy(np.ascontiguousarray(tracked.frame.image if image is None else image)),
        modes,
        weights=mixture.weight,
        text=text,
    )
    return picture.numpy()


class Picture:
    """The picture of a tracked frame with its modes: drawn when asked for, once for all sinks.

    Attributes:
        camera: Camera of the full-size image.
    """

    def __init__(self, frame: Posterior, camera: Camera) -> None:
        self.camera = camera
        self._frame = frame

    @cached_property
    def image(self) -> UInt8[np.ndarray, "h w 3"]:
        """The frame with its modes drawn over it."""
        return draw_modes(self._frame, self.camera)


class Sink(Protocol):
    """What wants to see the frames of a run as they come."""

    def add(self, frame: Posterior, picture: Picture) -> None:
        """Take the next frame.

        Args:
            frame: What the tracker found.
            picture: How it looks.
        """
        ...

    def close(self) -> None:
        """The run is over, or was interrupted."""
        ...


class Film:
    """The sink that writes `overlay.mp4`.

    Args:
        path: The file.
        frame_rate: Frames per second.
    """

    def __init__(self, path: Path, frame_rate: float) -> None:
        self._writer = VideoWriter(path, frame_rate)

    def add(self, frame: Posterior, picture: Picture) -> None:
        """Append the picture."""
        self._writer.write(picture.image)

    def close(self) -> None:
        """Complete the file."""
        self._writer.close()


class OtherFilm:
    """The sink that writes the overlay of a further camera.

    Args:
        path: The file.
        frame_rate: Frames per second.
        camera: The camera of its full-size images.
        place: Which of `Posterior.others` it took.
    """

    def __init__(self, path: Path, frame_rate: float, camera: Camera, place: int) -> None:
        self._writer = VideoWriter(path, frame_rate)
        self._camera, self._place = camera, place

    def add(self, frame: Posterior, picture: Picture) -> None:
        """Append the picture; a black one where the camera has ended."""
        del picture
        own = frame.others[self._place]
        width, height = self._camera.image_size_wh
        image = np.zeros((height, width, 3), np.uint8) if own is None else own.image
        self._writer.write(draw_modes(frame, self._camera, image=image))

    def close(self) -> None:
        """Complete the file."""
        self._writer.close()


@dataclass(kw_only=True)
class Recorder:
    """Writes a run as it goes: track, summary and overlay.

    Attributes:
        folder: The output folder.
        settings: What is run.
        tracker: The tracker that the settings made, for its numbers.
        camera: Camera of the full-size images, for the overlay.
        frame_rate: Frames per second of the overlay.
        video: What that camera took, if it was read from a file.
        others: Further cameras and their videos.
        recorded: All cameras with their files, for the track; empty: the first camera alone.
        notes: Lines for the user, also in the summary.
        extra: Further entries of the summary.
        sinks: What sees the frames besides; closed at the end of the run.
        on_first_frame: Writes what else belongs to the run, when its first frame is saved.
    """

    folder: Path
    settings: Settings
    tracker: SequenceTracker
    camera: Camera
    frame_rate: float
    video: Path | None = None
    others: Sequence[tuple[Camera, Path]] = ()
    recorded: Sequence[RecordedCamera] = ()
    notes: list[str] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)
    sinks: Sequence[Sink] = ()
    on_first_frame: Callable[[], None] | None = None

    def run(self, frames: Iterator[Posterior], body: BodyModel, total: int | None) -> dict:
        """Track to the end, or to an interruption, which is recorded and raised again.

        Args:
            frames: What `TrackingSession.track` yields.
            body: The body, for the names in the file.
            total: Number of frames, for the progress bar.

        Returns:
            The summary.
        """
        writer = TrackWriter(
            self.folder / TRACK_NAME,
            Track.empty(
                body.state_names,
                body.joint_names,
                likelihood_power=stated_evidence(self.tracker),
                body=body,
                cameras=self.recorded or [RecordedCamera(self.camera)],
                settings=asdict(self.settings),
            ),
        )
        totals = _Totals()
        ended, began = "interrupted", time.perf_counter()
        saved, took = began, 0.0
        summary: dict[str, Any] = {}
        with ExitStack() as stack:
            sinks = list(self.sinks)
            if self.settings.overlay:
                sinks.insert(0, Film(self.folder / "overlay.mp4", self.frame_rate))
            for sink in sinks:
                stack.push(partial(_close, sink))
            bar = stack.enter_context(tqdm(frames, total=total, unit="frame", dynamic_ncols=True))
            try:
                for frame in bar:
                    self._append(writer, frame)
                    if len(writer) == 1:
                        remove_checkpoint(self.folder)
                        writer.save()
                        self._replace_last_run()
                    drawn = time.perf_counter()
                    picture = Picture(frame, self.camera)
                    for sink in sinks:
                        sink.add(frame, picture)
                    totals.add(frame, overlay_s=time.perf_counter() - drawn)
                    bar.set_postfix(
                        cost=f"{float(frame.info.cost[0]):.1f}",
                        modes=len(frame.state.mixture.mean),
                    )
                    start = time.perf_counter()
                    if _SAVE_SHARE * (start - saved) >= took:
                        writer.save()
                        saved = time.perf_counter()
                        took = saved - start
                ended = "complete"
            finally:
                if len(writer):
                    writer.save()
                    wall = time.perf_counter() - began
                    summary = self._summary(ended, len(writer), wall, totals)
                    write_summary(self.folder, summary)
        return summary

    def _replace_last_run(self) -> None:
        """Remove what belongs to another track, now that there is one in its place."""
        for old in (self.folder / SMOOTH_NAME, *self.folder.glob("overlay*.mp4")):
            if old.stem in ("smooth", "overlay") or old.stem.removeprefix("overlay_").isdigit():
                try:
                    old.unlink(missing_ok=True)
                except OSError as error:
                    raise output_error(old, error) from error
        if self.on_first_frame is not None:
            self.on_first_frame()

    def _append(self, writer: TrackWriter, frame: Posterior) -> None:
        base = np.eye(4)
        base[:3, :3] = frame.body.base_rotation.cpu().numpy()
        base[:3, 3] = frame.body.base_translation.cpu().numpy()
        mixture = frame.state.mixture
        parent = frame.info.parent
        writer.append(
            FrameModes(
                frame=frame.frame.index,
                time_s=frame.frame.time_s,
                state=mixture.mean,
                covariance=frame.covariance,
                log_weight=mixture.log_weight,
                cost=frame.info.cost,
                parent=parent if len(writer) else torch.full_like(parent, -1),
                joints_world=frame.joints_world,
                base_transform=base,
            )
        )

    def _summary(self, ended: str, num_frames: int, wall: float, totals: _Totals) -> dict[str, Any]:
        return {
            "ended": ended,
            "body": self.settings.body,
            "preset": self.settings.preset,
            "seed": self.settings.seed,
            "samples": self.tracker.num_samples,
            "modes": self.tracker.num_modes,
            "settings": asdict(self.settings),
            "versions": {
                "python": platform.python_version(),
                **{name: version(name) for name in ("torchcss", "torch", "kornia", "numpy")},
            },
            "num_frames": num_frames,
            "seconds_per_frame": wall / num_frames,
            **totals.summary(num_frames),
            "notes": self.notes,
            # As in a camera file, so that this file is one.
            **calibration((self.camera, self.video), *self.others),
            **self.extra,
        }


def _close(sink: Sink, kind: type[BaseException] | None, *_: object) -> None:
    # The first error is the one to report; a full disk will refuse the closing too.
    with nullcontext() if kind is None else suppress(OSError):
        sink.close()


@dataclass(kw_only=True)
class _Totals:
    """What the frames of a run add up to.

    Attributes:
        seconds: Wall time by stage.
        terms: Cost of the best modes by term, nats.
        term_seconds: Wall time of the search by what was evaluated.
        samples: Samples optimised, or weighed.
        iterations: Iterations of the optimiser, of all samples.
        distinct: Distinct modes found.
        lost: Frames that counted as lost.
        statuses: How many samples ended with each `Status`, by its number.
        events: When the target was lost and found.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    terms: dict[str, float] = field(default_factory=dict)
    term_seconds: dict[str, float] = field(default_factory=dict)
    samples: int = 0
    iterations: int = 0
    distinct: int = 0
    lost: int = 0
    statuses: Tensor = field(default_factory=lambda: torch.zeros(len(Status), dtype=torch.long))
    events: list[dict[str, Any]] = field(default_factory=list)

    def add(self, frame: Posterior, *, overlay_s: float) -> None:
        """Take in a frame, and how long the sinks took, drawing included."""
        for into, values in (
            (self.seconds, {**frame.seconds, "overlay": overlay_s}),
            (self.terms, frame.terms),
            (self.term_seconds, frame.term_seconds),
        ):
            for name, value in values.items():
                into[name] = into.get(name, 0.0) + value
        self.samples += int(frame.info.num_samples)
        self.iterations += int(frame.info.num_steps.sum())
        self.distinct += int(frame.info.num_distinct)
        self.lost += frame.lost
        self.statuses += frame.info.status_counts.cpu()
        was_lost = bool(self.events) and self.events[-1]["event"] == "lost"
        if frame.lost != was_lost:
            self.events.append(
                {
                    "event": "lost" if frame.lost else "found",
                    "frame": frame.frame.index,
                    "time_s": frame.frame.time_s,
                    "deviations": frame.loss_score,
                }
            )

    def summary(self, num_frames: int) -> dict[str, Any]:
        """The entries of the summary.

        Args:
            num_frames: Frames written; an interruption may leave one more than was added.
        """
        optimiser = self.seconds.get("search", 0.0) - sum(self.term_seconds.values())
        return {
            "seconds_per_frame_by_stage": {k: v / num_frames for k, v in self.seconds.items()},
            "samples_optimised": self.samples,
            "iterations": self.iterations,
            "iterations_per_sample": self.iterations / max(self.samples, 1),
            "distinct_modes_per_frame": self.distinct / num_frames,
            "events": self.events,
            "frames_searched_widely": self.lost,
            "optimiser_status": {s.name.lower(): int(self.statuses[s]) for s in Status},
            "best_mode_cost_by_term": {k: v / num_frames for k, v in self.terms.items()},
            "share_of_cost_by_term": _shares(self.terms),
            "share_of_search_time_by_term": _shares({**self.term_seconds, "optimiser": optimiser}),
        }


def _shares(values: dict[str, float]) -> dict[str, float]:
    whole = sum(values.values())
    return {name: value / whole if whole else 0.0 for name, value in values.items()}
