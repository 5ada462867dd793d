"""Frames a second of `track_batch` against the same sequences one after the other.

    python scripts/benchmark_batch.py --sequences 4 --frames 10 --out benchmark_batch.json
    python scripts/benchmark_batch.py --data clips --body body34 --sequences 8 --device cuda

Without `--data` every sequence is the shipped clip of an arm, each with a seed of its own; with it
they are the folders there, as `scripts/make_clips.py` writes them, over and over if need be. First
poses are found before the clock runs. Each repeat takes both ways in turn; ratios are taken within
a repeat. The last lines say whether both ways found the same, bit for bit.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import Table, start, write_report

from torchcss import CameraView, Settings, TrackingSession, read_camera, track_batch
from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.initialise.result import Initialisation
from torchcss.io.fitted_body import read_fitted_body
from torchcss.io.video import VideoReader
from torchcss.studies.comparison import find_start
from torchcss.studies.demo import CLIP, DEMO_SETTINGS
from torchcss.studies.sequences import read_sequence
from torchcss.types import Frame

SETTINGS = replace(DEMO_SETTINGS, overlay=False)


@dataclass(frozen=True, kw_only=True)
class Config:
    """What to track, and how often."""

    settings: SettingsOptions = SETTINGS
    """How to track."""
    data: Path | None = None
    """Folder of clips; by default the shipped one is all of them."""
    sequences: int = 4
    """Number of sequences."""
    frames: int = 10
    """Frames of each."""
    repeats: int = 3
    """Repeats; in each both ways take turns."""
    out: Path | None = None
    """JSON file to write."""


class Film(NamedTuple):
    """A sequence, ready to be tracked."""

    settings: Settings
    first: Initialisation
    view: CameraView
    frames: list[Frame]
    interval: float

    def session(self) -> TrackingSession:
        """A new session at the first pose."""
        return TrackingSession(self.settings, self.first, [self.view], frame_interval=self.interval)


def films(config: Config) -> Iterator[Film]:
    """The sequences, over and over."""
    settings = config.settings
    folders = [CLIP]
    if config.data is not None:
        folders = sorted(path.parent for path in config.data.glob("*/reference3d.npz"))
        if not folders:
            raise ConfigurationError(f"{config.data}: no clip in it")
    for index in range(config.sequences):
        folder = folders[index % len(folders)]
        own = replace(settings, seed=settings.seed + index)
        video = folder / "video.mp4"
        if config.data is None:
            camera = read_camera(folder / "cameras.json", video=video)
            eye = camera.to(dtype=own.torch_dtype, device=own.device)
            first = read_fitted_body(
                folder / "body.npz", camera=eye, dtype=own.torch_dtype, device=own.device
            )
            view = CameraView(camera)
        else:
            sequence = read_sequence(folder)
            begin = find_start(sequence, own)
            first, view = begin.first, CameraView(sequence.camera, sequence.keypoints, begin.sigma)
        reader = VideoReader(video)
        frames = list(islice(reader, config.frames))
        yield Film(own, first, view, frames, 1 / float(reader.info.frame_rate))


def timed(config: Config, sequences: list[Film], *, beside: bool) -> tuple[float, list[Any]]:
    """Seconds that all sequences take, and the modes of their last frames."""
    sessions = [film.session() for film in sequences]
    pairs = [(session, film.frames) for session, film in zip(sessions, sequences, strict=True)]
    began = time.perf_counter()
    if beside:
        list(track_batch(pairs))
    else:
        for session, frames in pairs:
            list(session.track(frames))
    modes = [session.state.tracker.mixture.mean.cpu() for session in sessions]
    return time.perf_counter() - began, modes


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    torch.set_num_threads(1)
    sequences = list(films(config))
    num = sum(len(film.frames) for film in sequences)
    timed(config, [film._replace(frames=film.frames[:1]) for film in sequences], beside=True)
    rounds = []
    for _ in range(config.repeats):
        (alone, one), (together, other) = (
            timed(config, sequences, beside=beside) for beside in (False, True)
        )
        same = all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
        apart = max(
            float((a - b).abs().max()) if a.shape == b.shape else np.inf
            for a, b in zip(one, other, strict=True)
        )
        rounds.append({"alone": num / alone, "together": num / together, "ratio": alone / together,
                       "same": same, "apart": apart})  # fmt: skip
    rows = []
    for name, label in (("alone", "one after the other, frames a second"),
                        ("together", "side by side, frames a second"),
                        ("ratio", "ratio")):  # fmt: skip
        quartiles = np.quantile([row[name] for row in rounds], (0.25, 0.5, 0.75))
        rows.append([label, *map(float, quartiles)])
    settings = config.settings
    title = (
        f"{config.sequences} sequences of {config.frames} frames, {settings.body}, "
        f"{settings.samples or 'default'} samples, {settings.engine} on {settings.device}"
    )
    table = Table(title, ("", "lower quartile", "median", "upper quartile"), rows)
    table.print()
    same = all(row["same"] for row in rounds)
    print("the same bit for bit" if same else
          f"not the same bit for bit: {max(row['apart'] for row in rounds):.1e} apart")  # fmt: skip
    report = {"rounds": rounds, "settings": asdict(settings), "torch": torch.__version__}
    write_report(config.out, report, table)
    return report


if __name__ == "__main__":
    start(main, Config, __doc__)
