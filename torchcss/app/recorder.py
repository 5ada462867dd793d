"""Writes a run as it goes, so that it can be interrupted at any moment and goes on where it was.

`Recorder.run` takes what `TrackingSession.track` yields. From time to time, at the end, and on
Ctrl-C or SIGTERM it writes `track.npz`, then `summary.json`, then `checkpoint.npz`, each whole or
not at all; the checkpoint says how many frames of the track belong to it. Whatever else should see
the frames as they come is a `Sink`, such as the live viewer (`torchcss.app.live`). What cannot be
written piecemeal, the overlay film, is made at the end (`torchcss.show.track_pictures`).
"""

from __future__ import annotations

import platform
import re
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor
from tqdm import tqdm

from torchcss.app.claims import WorkClaim
from torchcss.errors import OutputError
from torchcss.files import output_error
from torchcss.io.cameras import calibration
from torchcss.io.checkpoint import Checkpoint, remove_checkpoint, write_checkpoint
from torchcss.io.run import Run
from torchcss.io.tracks import (
    TRACK_NAME,
    FrameModes,
    Track,
    TrackWriter,
    write_summary,
)
from torchcss.io.view_files import RecordedCamera
from torchcss.show.track_pictures import draw_modes
from torchcss.tracking.checkpoint import state_tensors
from torchcss.tracking.session import Posterior, TrackingSession
from torchcss.types import ColourImage, Status
from torchcss.vision.camera import Camera

CHECKPOINT_EVERY = 10.0
"""Seconds of wall time between checkpoints."""


class Picture:
    """The picture of a tracked frame with its modes: drawn when asked for, and once.

    Attributes:
        camera: Camera of the full-size image.
    """

    def __init__(self, frame: Posterior, camera: Camera) -> None:
        self.camera = camera
        self._frame = frame

    @cached_property
    def image(self) -> ColourImage:
        """The frame with its modes drawn over it."""
        frame = self._frame
        return draw_modes(frame.frame.image, frame.body, modes_of(frame), self.camera)


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


class Terminated(KeyboardInterrupt):
    """The process was asked to end (SIGTERM)."""


@dataclass(kw_only=True)
class Recorder:
    """Writes a run as it goes.

    Attributes:
        folder: The output folder.
        session: What is run.
        recorded: The cameras with their files.
        frame_interval: Seconds between frames as a rule.
        size_deviation: What is not known of the body's size, see `Track`.
        notes: Lines for the user, also in the summary.
        extra: Further entries of the summary; a resumed run keeps those that it is not given.
        sink: What sees the frames besides; closed at the end of the run.
        on_first_frame: Writes what else belongs to the run, when its first frame is saved.
        checkpoint_every: Seconds of wall time between checkpoints.
        begun: The run to go on with, which has a checkpoint; None: a new one starts.
        lock: The lock of the folder: nothing is written when another process has taken it over.
        num_done: Frames that were tracked before this run goes on.
    """

    folder: Path
    session: TrackingSession
    recorded: Sequence[RecordedCamera]
    frame_interval: float
    size_deviation: float = 0.0
    notes: Sequence[str] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)
    sink: Sink | None = None
    on_first_frame: Callable[[], None] | None = None
    checkpoint_every: float = CHECKPOINT_EVERY
    begun: Run | None = None
    lock: WorkClaim | None = None

    def __post_init__(self) -> None:
        session = self.session
        self._wall, self._began = 0.0, time.perf_counter()
        self._totals = _Totals()
        self._state = session.checkpoint()
        if self.begun is None:
            body = session.state.body
            track = Track.empty(body.state_names, body.joint_names, body)._replace(
                likelihood_power=float(session.plan.tracker.stated_power),
                size_deviation=self.size_deviation,
                cameras=tuple(self.recorded),
                settings=asdict(session.settings),
            )
        else:
            going_on = self.begun.checkpoint
            assert going_on is not None
            track, notes = self.begun.track.first(going_on.num_frames), going_on.notes
            self._wall, totals = notes["wall_s"], notes["totals"]
            self._totals = _Totals(**{**totals, "statuses": torch.tensor(totals["statuses"])})
            self.notes, self.extra = notes["notes"], {**notes["extra"], **self.extra}
        self.num_done = len(track.frames)
        self._writer = TrackWriter(self.folder / TRACK_NAME, track)

    def run(self, frames: Iterable[Posterior], total: int | None) -> dict[str, Any]:
        """Track to the end, or to an interruption, which is recorded and raised again.

        Args:
            frames: What `TrackingSession.track` yields.
            total: Number of frames of the whole run, for the progress bar.

        Returns:
            The summary.
        """
        ended, writer = "interrupted", self._writer
        self._began = saved = time.perf_counter()
        with ExitStack() as stack:
            stack.enter_context(ended_by_sigterm())
            if self.sink is not None:
                stack.push(partial(_close, self.sink))
            bar = tqdm(
                frames, "tracking", total, initial=len(writer), unit="frame", dynamic_ncols=True
            )
            stack.enter_context(bar)
            try:
                for frame in bar:
                    self._take(frame)
                    cost, num_modes = float(frame.info.cost[0]), len(frame.state.mixture.mean)
                    bar.set_postfix(cost=f"{cost:.1f}", modes=num_modes)
                    if len(writer) == 1 or time.perf_counter() - saved >= self.checkpoint_every:
                        self._save(ended)
                        saved = time.perf_counter()
                ended = "complete"
            finally:
                if len(writer):
                    self._save(ended)
        return self.summary(ended)

    def summary(self, ended: str) -> dict[str, Any]:
        """What `summary.json` holds.

        Args:
            ended: "complete" or "interrupted".
        """
        settings, plan = self.session.settings, self.session.plan
        wall = self._wall + time.perf_counter() - self._began
        return {
            "ended": ended,
            "body": settings.body,
            "preset": settings.preset,
            "seed": settings.seed,
            "samples": plan.tracker.num_samples,
            "modes": plan.tracker.num_modes,
            "settings": asdict(settings),
            "changed_beside_preset": list(settings.changed()),
            "versions": {
                "python": platform.python_version(),
                **{name: version(name) for name in ("torchcss", "torch", "kornia", "numpy")},
            },
            "num_frames": len(self._writer),
            "frame_interval_s": self.frame_interval,
            "seconds_per_frame": wall / max(len(self._writer), 1),
            **self._totals.summary(len(self._writer)),
            "notes": list(self.notes),
            # As in a camera file, so that this file is one.
            **calibration(*((one.camera, one.files and one.files.video) for one in self.recorded)),
            **self.extra,
        }

    def _take(self, frame: Posterior) -> None:
        """Add a frame, and show it to the sink."""
        if not len(self._writer):
            self._replace_last_run()
        self._writer.append(modes_of(frame, is_first=not len(self._writer)))
        # The session may be one frame ahead when an interruption comes; its state then is not.
        self._state = self.session.checkpoint()
        self._totals.add(frame)
        if self.sink is not None:
            self.sink.add(frame, Picture(frame, self.recorded[0].camera))

    def _save(self, ended: str) -> None:
        """Write track, summary and checkpoint, in this order: the checkpoint is never ahead."""
        if self.lock is not None and not self.lock.holds:
            raise OutputError(f"{self.folder}: another process has taken over; it goes on there")
        self._writer.save()
        if len(self._writer) == 1 and self.on_first_frame is not None:
            self.on_first_frame()
        write_summary(self.folder, self.summary(ended))
        notes = {
            "wall_s": self._wall + time.perf_counter() - self._began,
            "totals": {**asdict(self._totals), "statuses": self._totals.statuses.tolist()},
            "notes": list(self.notes),
            "extra": dict(self.extra),
        }
        tensors = state_tensors(self._state)
        write_checkpoint(self.folder, Checkpoint(len(self._writer), tensors, notes))

    def _replace_last_run(self) -> None:
        """Remove what belongs to another track, now that there will be one in its place."""
        remove_checkpoint(self.folder)
        for old in sorted(self.folder.iterdir()):
            if OF_A_TRACK.fullmatch(old.name):
                try:
                    old.unlink(missing_ok=True)
                except OSError as error:
                    raise output_error(old, error) from error


OF_A_TRACK = re.compile(r"smooth\.npz|overlay(_[0-9]+)?\.mp4|(smooth_)?report\.html")
"""Files that were made of a track."""


def modes_of(frame: Posterior, *, is_first: bool = False) -> FrameModes:
    """A frame as the track takes it."""
    mixture, parent = frame.state.mixture, frame.info.parent
    numbers = {
        "base_transform": frame.body.base_transform,
        "state": mixture.mean,
        "covariance": frame.covariance,
        "log_weight": mixture.log_weight,
        "cost": frame.info.cost,
        "parent": torch.full_like(parent, -1) if is_first else parent,
        "joints_world": frame.joints_world,
    }
    return FrameModes(
        frame=frame.frame.index,
        time_s=frame.frame.time_s,
        **{name: tensor.detach().double().cpu() for name, tensor in numbers.items()},
    )


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """A request to end interrupts as Ctrl-C does; handlers belong to the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # what is being written is finished
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


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
        floored: Ends of descents whose covariance was floored, see `TrackerInfo.num_floored`.
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
    floored: int = 0
    statuses: Tensor = field(default_factory=lambda: torch.zeros(len(Status), dtype=torch.long))
    events: list[dict[str, Any]] = field(default_factory=list)

    def add(self, frame: Posterior) -> None:
        """Take in a frame."""
        for name in ("seconds", "terms", "term_seconds"):
            into, values = getattr(self, name), getattr(frame, name)
            into.update({key: into.get(key, 0.0) + value for key, value in values.items()})
        info = frame.info
        self.samples += int(info.num_samples)
        self.iterations += int(info.num_steps.sum())
        self.distinct += int(info.num_distinct)
        self.lost += frame.lost
        self.floored += int(info.num_floored)
        self.statuses += info.status_counts.cpu()
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
            "frames_told_lost": self.lost,
            "covariances_floored": self.floored,
            "optimiser_status": {s.name.lower(): int(self.statuses[s]) for s in Status},
            "best_mode_cost_by_term": {k: v / num_frames for k, v in self.terms.items()},
            "share_of_cost_by_term": _shares(self.terms),
            "share_of_search_time_by_term": _shares({**self.term_seconds, "optimiser": optimiser}),
        }


def _shares(values: dict[str, float]) -> dict[str, float]:
    whole = sum(values.values())
    return {name: value / whole if whole else 0.0 for name, value in values.items()}
