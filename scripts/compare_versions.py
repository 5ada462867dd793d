"""Seconds a frame and memory of `torchcss track`, against another version of it, in turns.

    python scripts/compare_versions.py --against v0.1 --data DATA --out compare_versions.json

The other version, any commit of this repository, is checked out beside and runs with the packages
of this environment. Each repeat tracks every clip with both, one after the other, in processes of
one thread; ratios are taken within a repeat. The clips:

| clip | what |
|---|---|
| arm | the shipped clip, keypoints in the first frame |
| beam | `balance_beam_4cam` of the data, camera cam01, keypoints in all frames |
| beam, first | the same, keypoints in the first frame |

Seconds a frame are those of tracking, without what comes before the first frame; the seconds of a
whole run have start, first pose and writing in them, and kernels are in the cache before the clock
runs. With `--two` a third row is this version with two threads. With `--samples` one clip, the beam
or else the arm, is tracked with each of these numbers of samples instead, and `--plot` draws
seconds a frame against samples.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from common import REPOSITORY, Table, finish, peak_mib, start
from matplotlib.figure import Figure

from torchcss.errors import ConfigurationError
from torchcss.show.style import save_figure
from torchcss.studies.demo import CLIP

ENTRY = """
import sys
try:
    from torchcss.cli.main import main
except ModuleNotFoundError:
    from torchcss.cli import main
sys.exit(main())
"""
"""Runs the command line of any version."""


@dataclass(frozen=True, kw_only=True)
class Config:
    """What is compared."""

    against: str
    """Tag or commit of the other version."""
    data: Path | None = None
    """Folder that has `balance_beam_4cam`; without it the shipped clip is all."""
    frames: int = 20
    """Frames of each clip."""
    repeats: int = 3
    """Repeats."""
    two: bool = False
    """Measure this version with two threads, too."""
    samples: tuple[int, ...] = ()
    """Numbers of samples a frame to track one clip with."""
    out: Path | None = None
    """JSON file to write."""
    plot: Path | None = None
    """Picture of seconds a frame against `--samples` to write."""


class Measured(NamedTuple):
    """What one run took."""

    seconds_per_frame: float
    seconds: float
    memory_mib: float


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """A folder with another version.

    Raises:
        ConfigurationError: If there is no such version.
    """
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "other"
        git = ["git", "-C", str(REPOSITORY), "worktree"]
        words = [*git, "add", "--detach", "--quiet", str(place), revision]
        done = subprocess.run(words, capture_output=True, text=True)
        if done.returncode:
            raise ConfigurationError(f"--against {revision}: {done.stderr.strip()}")
        try:
            yield place
        finally:
            subprocess.run([*git, "remove", "--force", str(place)], check=True)


def clips(config: Config) -> dict[str, list[str]]:
    """What `torchcss track` is told of each clip."""
    end = ["--no-overlay", "--stop", str(config.frames)]
    arm = [
        *(str(CLIP / "video.mp4"), "--keypoints", str(CLIP / "keypoints.npz")),
        *("--camera", str(CLIP / "cameras.json"), "--body", "arm8", "--keypoints-use", "first"),
    ]
    found = {"arm": [*arm, *end]}
    if config.data is not None:
        folder = config.data / "balance_beam_4cam"
        beam = [
            *(str(folder / "cam01.mp4"), "--keypoints", str(folder / "keypoints2d_cam01.npz")),
            *("--camera", str(folder / "cameras.json"), "--camera-name", "cam01"),
        ]
        found["beam"] = [*beam, *end]
        found["beam, first"] = [*beam, "--keypoints-use", "first", *end]
    if config.samples:
        words = found.get("beam", found["arm"])
        found = {f"{num} samples": [*words, "--samples", str(num)] for num in config.samples}
    return found


def track(version: Path, words: list[str]) -> Measured:
    """Track a clip with a version, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", ENTRY, "track", *words, "--out", folder]
        environment = {**os.environ, "PYTHONPATH": str(version), "OMP_NUM_THREADS": "1"}
        log = Path(folder) / "log"
        with log.open("w") as said:
            began = time.perf_counter()
            process = subprocess.Popen(
                command, env=environment, cwd=folder, stdout=said, stderr=subprocess.STDOUT
            )
            _, status, usage = os.wait4(process.pid, 0)
            seconds = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise ConfigurationError(f"{version}: {log.read_text(errors='replace')[-2000:]}")
        summary = json.loads((Path(folder) / "summary.json").read_text())
    return Measured(summary["seconds_per_frame"], seconds, peak_mib(usage.ru_maxrss))


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    with checked_out(config.against) as other:
        ways: dict[str, tuple[Path, list[str]]] = {
            "other": (other, []), "this": (REPOSITORY, ["--threads", "1"]),
        }  # fmt: skip
        if config.two:
            ways["two threads"] = REPOSITORY, ["--threads", "2"]
        runs: dict[str, dict[str, list[Measured]]] = {}
        for repeat in range(config.repeats + 1):
            for clip, words in clips(config).items():
                for way, (version, more) in ways.items():
                    if repeat == 0 and way != "this":
                        continue  # only to have the kernels in the cache
                    found = track(version, [*words, *more])
                    if repeat:
                        runs.setdefault(clip, {}).setdefault(way, []).append(found)
    rows, cells = {}, []
    for clip, by_way in runs.items():
        for way, measured in by_way.items():
            ratios = [
                one.seconds_per_frame / two.seconds_per_frame
                for one, two in zip(by_way["other"], measured, strict=True)
            ]
            row = {
                **{name: median(values) for name, values in zip(
                    Measured._fields, zip(*measured, strict=True), strict=True
                )},
                "times_as_fast": [median(ratios), min(ratios), max(ratios)],
            }  # fmt: skip
            rows[f"{clip}: {way}"] = row
            spread = f"{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
            cells.append([f"{clip}: {way}", *list(row.values())[:3], spread])
    columns = (
        *("clip: version", "seconds a frame", "seconds in all", "memory, MiB"),
        f"times as fast as {config.against}",
    )
    table = Table(f"`torchcss track`, {config.frames} frames", columns, cells)
    if config.plot is not None:
        save_figure(seconds_figure(config, rows), config.plot)
    report = {"frames": config.frames, "repeats": config.repeats, "rows": rows}
    return finish(config.out, report, table)


def seconds_figure(config: Config, rows: dict[str, dict[str, Any]]) -> Figure:
    """Seconds a frame of each version against samples, on logarithmic axes."""
    figure = Figure(figsize=(5.5, 4), layout="constrained")
    axes = figure.subplots()
    lines = {"other": config.against, "this": "this version", "two threads": "two threads"}
    for way, label in lines.items():
        points = [rows.get(f"{num} samples: {way}") for num in config.samples]
        if all(points):
            seconds = [point["seconds_per_frame"] for point in points if point]
            axes.loglog(config.samples, seconds, "o-", label=label)
    axes.set(xlabel="samples a frame", ylabel="seconds a frame, one core")
    axes.grid(which="both", alpha=0.3)
    axes.legend()
    return figure


if __name__ == "__main__":
    start(main, Config, __doc__)
