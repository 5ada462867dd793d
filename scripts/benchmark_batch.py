"""Frames a second of `track_batch` against the same sequences one after the other.

    python scripts/benchmark_batch.py --sequences 4 --frames 10 --out benchmark_batch.json
    python scripts/benchmark_batch.py --data clips --body body34 --sequences 8 --device cuda
    python scripts/benchmark_batch.py --workers 2 --sequences 8 --frames 25 --repeats 1

Without `--data` every sequence is the shipped clip of an arm, each with a seed of its own; with it
they are the folders there, as `scripts/make_clips.py` writes them, over and over if need be. First
poses are found before the clock runs. Each repeat takes both ways in turn; ratios are taken within
a repeat. The last lines say whether both ways found the same, bit for bit.

With `--workers` it is `torchcss batch` instead, with one process and with so many, each of one
thread: clips an hour, starts and first poses among the rest.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from common import QUARTILES, Table, finish, quartiles, start
from evaluate_posterior import find_clips

from torchcss import CameraView, Settings, TrackingSession, read_camera, track_batch
from torchcss.app.batch import Batch
from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.initialise.result import Initialisation
from torchcss.io.fitted_body import read_fitted_body
from torchcss.io.video import VideoReader
from torchcss.studies.comparison import find_start
from torchcss.studies.demo import CLIP, DEMO_SETTINGS
from torchcss.studies.sequences import read_sequence
from torchcss.types import Frame, frozen

SETTINGS = replace(DEMO_SETTINGS, overlay=False)


@frozen
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
    workers: int | None = None
    """Processes of a batch, to compare with one."""
    out: Path | None = None
    """JSON file to write."""


class Prepared(NamedTuple):
    """A sequence, ready to be tracked."""

    settings: Settings
    first: Initialisation
    view: CameraView
    frames: list[Frame]
    interval: float

    def session(self) -> TrackingSession:
        """A new session at the first pose."""
        return TrackingSession(self.settings, self.first, [self.view], frame_interval=self.interval)


def folders(config: Config) -> list[Path]:
    """The clips."""
    return [CLIP] if config.data is None else find_clips(config.data)


def films(config: Config) -> Iterator[Prepared]:
    """The sequences, over and over."""
    settings = config.settings
    clips = folders(config)
    for index in range(config.sequences):
        folder = clips[index % len(clips)]
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
        yield Prepared(own, first, view, frames, 1 / float(reader.info.frame_rate))


def timed(config: Config, sequences: list[Prepared], *, beside: bool) -> tuple[float, list[Any]]:
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


def clips_an_hour(config: Config, workers: int) -> float:
    """How many clips a batch of the sequences tracks with so many processes."""
    clips = folders(config)
    with tempfile.TemporaryDirectory() as folder:
        rows = []
        for index in range(config.sequences):
            clip = clips[index % len(clips)]
            row = {
                "name": str(index), "video": str(clip / "video.mp4"), "stop": config.frames,
                "camera": str(clip / "cameras.json"), "seed": config.settings.seed + index,
            }  # fmt: skip
            if config.data is None:
                row["init"] = str(CLIP / "body.npz")
            points = "keypoints.npz" if config.data is None else "keypoints2d.npz"
            rows.append(json.dumps({**row, "keypoints": str(clip / points)}))
        manifest = Path(folder) / "clips.jsonl"
        manifest.write_text("\n".join(rows), encoding="utf-8")
        batch = Batch(
            manifest=manifest, out=Path(folder) / "out", workers=workers, settings=config.settings
        )
        os.environ["OMP_NUM_THREADS"] = "1"  # for the processes that start now
        began = time.perf_counter()
        process = multiprocessing.get_context("spawn").Process(target=batch.run)
        process.start()
        process.join()
        if process.exitcode:
            raise ConfigurationError(f"the batch ended with {process.exitcode}")
        return 3600 * config.sequences / (time.perf_counter() - began)


def batches(config: Config, workers: int) -> dict[str, Any]:
    """One process against several."""
    rounds = [
        {num: clips_an_hour(config, num) for num in (1, workers)} for _ in range(config.repeats)
    ]
    rows = [
        [f"{num} processes", float(np.median([each[num] for each in rounds]))]
        for num in (1, workers)
    ]
    table = Table(f"`torchcss batch`, clips of {config.frames} frames", ("", "clips an hour"), rows)
    return finish(config.out, {"rounds": rounds}, table)


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    if config.workers is not None:
        return batches(config, config.workers)
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
        rows.append([label, *quartiles([row[name] for row in rounds]).values()])
    settings = config.settings
    title = (
        f"{config.sequences} sequences of {config.frames} frames, {settings.body}, "
        f"{settings.samples or 'default'} samples, {settings.engine} on {settings.device}"
    )
    columns = ("", *(name.replace("_", " ") for name in QUARTILES))
    same = all(row["same"] for row in rounds)
    print("the same bit for bit" if same else
          f"not the same bit for bit: {max(row['apart'] for row in rounds):.1e} apart")  # fmt: skip
    report = {"rounds": rounds, "settings": asdict(settings), "torch": torch.__version__}
    return finish(config.out, report, Table(title, columns, rows))


if __name__ == "__main__":
    start(main, Config, __doc__)
