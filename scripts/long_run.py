"""A long video in one go: memory, time and files as the frames go by.

    python scripts/long_run.py --frames 2000 --out long_run.json

The shipped clip is played forwards and backwards until the film is long enough, and tracked with
`track_video`, keypoints in the first frame alone. Of every hundred frames the table has the memory
of the process when they were done, the processor's seconds that each took, and the size of the
track's file.
A film of `--opened` frames is opened besides, and the time until its first frame is there measured.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np
from common import Table, finish, peak_mib, start

from torchcss.app.recorder import Picture
from torchcss.app.track import TrackOptions, track_video
from torchcss.cli.options import SettingsOptions
from torchcss.files import save_arrays
from torchcss.io.keypoints.read import OWN_NAMES
from torchcss.io.tracks import TRACK_NAME
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.studies.demo import CLIP, DEMO_SETTINGS
from torchcss.tracking.session import Posterior
from torchcss.types import Frame, frozen

TRACKING = replace(DEMO_SETTINGS, overlay=False)
"""How this script tracks, where nothing else is said."""


@frozen
class Config:
    """How long the films are."""

    frames: int = 2000
    """Frames that are tracked."""
    opened: int = 20_000
    """Frames of the film that is only opened."""
    every: int = 100
    """Frames of a row."""
    tracking: SettingsOptions = TRACKING
    """How to track; the body is the clip's arm."""
    out: Path | None = None
    """JSON file to write."""


def back_and_forth(frames: list[np.ndarray]) -> Iterator[np.ndarray]:
    """Frames forwards and backwards, for ever, so that nothing jumps."""
    return cycle([*frames, *frames[-2:0:-1]])


def memory_mib() -> float:
    """Memory of this process now; where the system does not say it, the most that it ever had."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return peak_mib(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return pages * resource.getpagesize() / 2**20


@dataclass
class Watch:
    """Notes memory, time and the size of a file after every so many frames; a `Sink`."""

    track: Path
    every: int
    rows: list[dict[str, float]] = field(default_factory=list)
    began: float = field(default_factory=time.process_time)
    num_frames: int = 0

    def add(self, frame: Posterior, picture: Picture) -> None:
        """Count a frame."""
        del frame, picture
        self.num_frames += 1
        if self.num_frames % self.every:
            return
        now = time.process_time()
        size = self.track.stat().st_size / 1e6 if self.track.is_file() else 0.0
        self.rows.append({
            "frames": self.num_frames, "memory_mib": memory_mib(),
            "seconds_per_frame": (now - self.began) / self.every, "track_mb": size,
        })  # fmt: skip
        self.began = now

    def close(self) -> None:
        """Nothing to do."""


def seconds_to_open(film: Path) -> tuple[float, Frame]:
    """How long it takes until the first frame of a film is there."""
    began = time.perf_counter()
    first = next(iter(VideoReader(film)))
    return time.perf_counter() - began, first


def main(config: Config) -> dict[str, Any]:
    """Film, track, print, write; return what is written."""
    clip = VideoReader(CLIP / "video.mp4")
    pictures = [frame.image for frame in clip]
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        films = {}
        for num_frames in sorted({config.frames, config.opened}):
            films[num_frames] = work / f"{num_frames}.mp4"
            with VideoWriter(films[num_frames], clip.info.frame_rate) as film:
                for picture in islice(back_and_forth(pictures), num_frames):
                    film.write(picture)
        opening, _ = seconds_to_open(films[config.opened])
        watch = Watch(work / "out" / TRACK_NAME, config.every)
        track_video(
            films[config.frames], camera=CLIP / "cameras.json",
            keypoints=_keypoints_for(config.frames, work), out=work / "out",
            settings=replace(config.tracking, body=DEMO_SETTINGS.body),
            options=TrackOptions(init=CLIP / "body.npz", layout=OWN_NAMES, live=watch),
        )  # fmt: skip
        size = (work / "out" / TRACK_NAME).stat().st_size / 1e6
    columns = ("frames", "memory, MiB", "seconds a frame", "track, MB")
    cells = [[f"{row['frames']:.0f}", *list(row.values())[1:]] for row in watch.rows]
    table = Table(
        f"One long run; a film of {config.opened} frames opens in {opening:.2f} s", columns, cells
    )
    report = {"rows": watch.rows, "seconds_to_open": opening, "track_mb": size}
    return finish(config.out, report, table)


def _keypoints_for(num_frames: int, folder: Path) -> Path:
    """The clip's keypoints of the first frame, for a film of so many frames."""
    with np.load(CLIP / "keypoints.npz") as arrays:
        known = dict(arrays)
    for name in ("keypoints", "confidence"):
        rows = np.zeros((num_frames, *known[name].shape[1:]), known[name].dtype)
        rows[0] = known[name][0]
        known[name] = rows
    path = folder / "keypoints.npz"
    save_arrays(path, known, compressed=True)
    return path


if __name__ == "__main__":
    start(main, Config, __doc__)
