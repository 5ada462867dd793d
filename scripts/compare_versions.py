"""Seconds a frame and memory of `torchcss track`, against another version of it, in turns.

    python scripts/compare_versions.py --against v0.1 --data DATA --out compare_versions.json

The other version, any commit of this repository, runs in an environment of its own: its checkout,
packages as its `constraints.txt` has them, and its kernels lie in a folder of `--environments`
named after the commit. The first run installs them with pip, whose settings hold (`PIP_FIND_LINKS`
for a torch for the CPU), later runs find them. `--same-environment` runs it with the packages of
this environment instead and needs no network. The report's `note` has the versions of both. Each
repeat tracks every clip with both, one after the other, in processes of one thread; ratios are
taken within a repeat. The clips:

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
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from common import REPOSITORY, Table, finish, peak_mib, start
from matplotlib.figure import Figure

from torchcss.errors import ConfigurationError
from torchcss.files import prepare_output_folder
from torchcss.kernels.pipeline import cache_folders
from torchcss.show.style import save_figure
from torchcss.studies.demo import CLIP
from torchcss.types import frozen

ENTRY = """
import sys
try:
    from torchcss.cli.main import main
except ModuleNotFoundError:
    from torchcss.cli import main
sys.exit(main())
"""
"""Runs the command line of any version."""
LOOK = """
import platform
from importlib import metadata, util
found = ["Python " + platform.python_version()]
for name in ("torch", "numpy", "numba"):
    try:
        found.append(name + " " + metadata.version(name))
    except metadata.PackageNotFoundError:
        found.append("no " + name)
print(util.find_spec("torchcss").origin, ", ".join(found), sep="\\n")
"""
"""Tells which package is imported, and the versions beside it."""


@frozen
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
    environments: Path = next(cache_folders()).parent / "environments"
    """Folder of the other versions and their environments; it may be deleted."""
    same_environment: bool = False
    """Run the other version with the packages of this environment."""
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


class Version(NamedTuple):
    """A version as it is run.

    Attributes:
        source: Its checkout.
        python: The interpreter of its environment.
        kernels: Variable that names its cache of kernels; empty: that of this environment.
    """

    source: Path
    python: str
    kernels: dict[str, str]

    def variables(self) -> dict[str, str]:
        """Variables of its processes, which have one thread."""
        own = {"PYTHONPATH": str(self.source), "OMP_NUM_THREADS": "1"}
        return {**os.environ, **own, **self.kernels}


def other_version(config: Config) -> Version:
    """The other version, with an environment of its own or with this one.

    Raises:
        ConfigurationError: If there is no such version, or its packages cannot be installed.
        OutputError: If its folder cannot be made.
    """
    git, told = ["git", "-C", str(REPOSITORY)], f"--against {config.against}"
    name = f"{config.against}^{{commit}}"
    commit = said([*git, "rev-parse", "--verify", name], told).strip()
    place = config.environments.resolve() / commit
    source, packed = place / "source", place / "source.zip"
    prepare_output_folder(place)
    said([*git, "archive", "--output", str(packed), commit], told)
    shutil.unpack_archive(packed, source)
    if config.same_environment:
        return Version(source, sys.executable, {})
    python, installed = place / "environment" / "bin" / "python", place / "installed"
    if not installed.exists():  # or not to the end
        print(f"installing {config.against} in {place}, once (minutes)", file=sys.stderr)
        # -I: what PYTHONPATH and the folder here have is not taken for what is installed there.
        said([sys.executable, "-I", "-m", "venv", "--clear", str(place / "environment")], told)
        pip = [str(python), "-I", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        said([*pip, "-c", str(source / "constraints.txt"), "-e", str(source)], told)
        installed.touch()
    return Version(source, str(python), {"TORCHCSS_CACHE": str(place)})


def said(words: list[str], told: str, variables: dict[str, str] | None = None) -> str:
    """What a command printed.

    Raises:
        ConfigurationError: If it failed, with what was asked for (`told`) and its last lines.
    """
    done = subprocess.run(words, capture_output=True, text=True, env=variables)
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise ConfigurationError("\n".join([f"{told}: {' '.join(words)}", *lines[-8:]]))
    return done.stdout


def packages(version: Version) -> str:
    """Versions of Python, torch, numpy and numba that a version runs with.

    Raises:
        ConfigurationError: If it is another package that is imported.
    """
    words, told = [version.python, "-P", "-c", LOOK], str(version.source)
    file, found = said(words, told, version.variables()).splitlines()
    print(f"{file}: {found}")
    if not Path(file).resolve().is_relative_to(version.source.resolve()):
        raise ConfigurationError(f"{version.source}: expected its package, got {file}")
    return found


def clips(config: Config) -> dict[str, list[str]]:
    """What `torchcss track` is told of each clip."""
    end = ["--no-overlay", "--stop", str(config.frames)]
    arm = [
        *(str(CLIP / "video.mp4"), "--keypoints", str(CLIP / "keypoints.npz")),
        *("--camera", str(CLIP / "cameras.json"), "--body", "arm8", "--keypoints-use", "first"),
    ]
    found = {"arm": [*arm, *end]}
    if config.data is not None:
        folder = config.data.resolve() / "balance_beam_4cam"
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


def track(version: Version, words: list[str]) -> Measured:
    """Track a clip with a version, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command = [version.python, "-c", ENTRY, "track", *words, "--out", folder]
        variables = version.variables()
        log = Path(folder) / "log"
        with log.open("w") as printed:
            began = time.perf_counter()
            process = subprocess.Popen(
                command, env=variables, cwd=folder, stdout=printed, stderr=subprocess.STDOUT
            )
            _, status, usage = os.wait4(process.pid, 0)
            seconds = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise ConfigurationError(f"{version.source}: {log.read_text(errors='replace')[-2000:]}")
        summary = json.loads((Path(folder) / "summary.json").read_text())
    return Measured(summary["seconds_per_frame"], seconds, peak_mib(usage.ru_maxrss))


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    other, this = other_version(config), Version(REPOSITORY, sys.executable, {})
    note = f"{config.against}: {packages(other)}; this version: {packages(this)}"
    ways = {"other": (other, []), "this": (this, ["--threads", "1"])}
    if config.two:
        ways["two threads"] = this, ["--threads", "2"]
    runs: dict[str, dict[str, list[Measured]]] = {}
    for repeat in range(config.repeats + 1):
        for clip, words in clips(config).items():
            for way, (version, more) in ways.items():
                if repeat == 0 and way == "two threads":
                    continue  # only to have the kernels of both versions in their caches
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
    report = {"note": note, "frames": config.frames, "repeats": config.repeats, "rows": rows}
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
