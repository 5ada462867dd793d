"""One tracker step as the processor sees it: eager, compiled and fused, by body and samples.

    python scripts/profile_step.py --out profile/profile.json --folder profile

A step draws samples from modes by their scaled covariances where places are free, evaluates the
cost of all (pose, projection, robust joint residuals, priors; value, gradient and exact Hessian),
accepts or refuses, and plans the next damped Cholesky step inside the box: `fixed_step`, all that
is of fixed shape in the search. Samples are worked off in pools of one size, the last one filled
up, so that one graph serves any number. Compiled it is one graph (`fullgraph=True`), and is not
compiled again for a second frame; a graph that broke or a second compilation would raise. Fused is
what the search does on a CPU: the cost by compiled kernels, the step of `TrustRegionNewton` as
well.

Printed are seconds per sample and iteration (one evaluation and one step), the ratios of eager to
compiled and to fused within a repeat, the memory that an iteration takes on top of its inputs (its
results included), and what compiling took, with nothing from a cache. On a CPU the clock is the
process's own, since others may use the machine; on a GPU it is the wall's. With `--folder` come the
figure, and by body and way a table and a trace of `torch.profiler`.

What it says on a CPU (float32, one thread): compiled is slower nowhere, 4 times as fast as eager
for the arm in pools of 100, where eager is mostly the overhead of over a thousand calls, 2.3 times
in pools of 500, and 1.4 to 2 times for the bodies. Cholesky factors, triangular solves and
products, two fifths of the compiled step of a body, are the same library calls in both. One of them
is slower when compiled, the product of the lift: inductor lays its factors out with the batch
innermost, though the code asks for contiguous ones, and `bmm` then copies them item by item, 7
instead of 1 microsecond for 34 parameters. Checking that a graph still fits takes 0.4 ms a call.
A compilation takes a minute of processor time, which a body earns back after 4 million
sample-iterations, thousands of frames with the usual 60 samples. The search on a CPU takes neither,
but the fused engine.

What is compiled agrees with eager to 2e-5 in float32; planned steps to 1e-3, in the metric of the
damped Hessian, since a matrix that is only just definite passes its rounding on (1e-9 in float64).
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from common import Table, finish, quartiles, start
from matplotlib.figure import Figure
from peers.tracker_step import (
    Step,
    Work,
    compile_step,
    fused_step,
    make_frames,
    profiled,
    tracker_step,
)

from torchcss.errors import ConfigurationError
from torchcss.files import prepare_output_folder
from torchcss.show.style import save_figure
from torchcss.tracking.settings import Settings

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


@dataclass(frozen=True, kw_only=True)
class Config:
    """What to measure and what to write."""

    bodies: tuple[str, ...] = ("arm8", "body30", "body34")
    """Bodies, of 8, 30 and 34 parameters."""
    samples: tuple[int, ...] = (100, 1000, 10_000)
    """Numbers of samples."""
    pool: int = 500
    """Most samples in one call; a graph is compiled per body and size of pool."""
    dtype: Literal["float32", "float64"] = "float32"
    """Floating type; the search needs no more than float32."""
    device: str = "cpu"
    """Where to compute: cpu or cuda, whose times and memory can be told."""
    covariance_scale: float = 8.0
    """Factor on the modes' covariances when drawing."""
    repeats: int = 5
    """Interleaved repeats."""
    at_least_s: float = 0.3
    """A way that is faster is called again, and the mean time taken."""
    cached: bool = False
    """Let the compiler use what it compiled before; its time then says nothing."""
    rows: int = 15
    """Rows of the profiler's tables."""
    seed: int = 0
    """Seed of poses and draws."""
    threads: int = 1
    """Threads of torch."""
    out: Path | None = None
    """JSON file to write."""
    folder: Path | None = None
    """Folder for the figure, the tables and the traces."""

    def __post_init__(self) -> None:
        if self.device.partition(":")[0] not in ("cpu", "cuda"):
            raise ConfigurationError(f"device: expected cpu or cuda, got {self.device!r}")
        Settings(device=self.device)  # refuses one that is not here


def seconds_of(config: Config, work: Work, step: Step) -> float:
    """Mean time of one iteration of all samples."""
    gpu, calls = config.device.startswith("cuda"), 0
    clock = time.perf_counter if gpu else time.process_time
    begin = now = clock()
    while calls == 0 or now - begin < config.at_least_s:
        work.iterate(step)
        if gpu:
            torch.cuda.synchronize()
        calls, now = calls + 1, clock()
    return (now - begin) / calls


def measure(config: Config, body: str) -> Iterator[dict[str, Any]]:
    """The rows of one body."""
    like = torch.empty(0, dtype=getattr(torch, config.dtype), device=config.device)
    pool, found, ways = 0, {}, {"eager": tracker_step}
    on_cpu = not config.device.startswith("cuda")
    if on_cpu and (fused := fused_step(config.dtype)) is not None:
        ways["fused"] = fused
    scale = math.sqrt(config.covariance_scale)
    for samples in sorted(config.samples):
        size = math.ceil(samples / math.ceil(samples / config.pool))
        frames = make_frames(body, size, like, config.seed)
        if size != pool:
            pool = size
            ways["compiled"], found = compile_step(frames, scale, cached=config.cached)
        frame = next(frames)
        work = {name: Work(frame, samples, scale) for name in ways}
        row: dict[str, Any] = {"body": body, "samples": samples, "pool": pool, **found}
        for name, step in ways.items():
            work[name].iterate(step)
            with tempfile.TemporaryDirectory() as scratch:
                stem = (config.folder or Path(scratch)) / f"{body}_{samples}_{name}"
                runs = [
                    profiled(work[name], step, stem.with_suffix(".json"), config.rows)
                    for _ in range(config.repeats)
                ]
                stem.with_suffix(".txt").write_text(runs[-1][1])
            # The profiler's clock is the wall's, so that one run may be disturbed.
            row[name] = {key: float(np.median([run[0][key] for run in runs])) for key in runs[0][0]}
        rounds = [
            {name: seconds_of(config, work[name], step) / samples for name, step in ways.items()}
            for _ in range(config.repeats)
        ]
        for name in ways:
            row[name]["seconds"] = quartiles([times[name] for times in rounds])
        row["times_as_fast"] = {
            name: quartiles([times["eager"] / times[name] for times in rounds])
            for name in ways
            if name != "eager"
        }
        yield row


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Time and memory over samples, eager solid, compiled dashed and fused dotted."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for colour, body in zip(COLOURS, dict.fromkeys(row["body"] for row in rows), strict=False):
        own = [row for row in rows if row["body"] == body]
        samples = [row["samples"] for row in own]
        for name, style in (("eager", "-"), ("compiled", "--"), ("fused", ":")):
            if name not in own[0]:
                continue
            times = 1e6 * np.array([list(row[name]["seconds"].values()) for row in own])
            look: dict[str, Any] = {"color": colour, "ls": style, "marker": "o", "ms": 4}
            left.plot(samples, times[:, 1], label=f"{body} {name}", **look)
            left.fill_between(samples, times[:, 0], times[:, 2], color=colour, alpha=0.15)
            right.plot(samples, [row[name]["memory_mib"] for row in own], **look)
    left.set(ylabel="microseconds per sample and iteration", ylim=(0, None))
    right.set(ylabel="MiB taken by an iteration", yscale="log")
    for axis in (left, right):
        axis.set(xlabel="samples", xscale="log")
    left.legend(fontsize=8)
    return figure


def _ways(row: dict[str, Any]) -> list[str]:
    """The ways that a row has, eager first."""
    return ["eager", *row["times_as_fast"]]


def cells_of(row: dict[str, Any], name: str) -> list[str | float]:
    """A way's line of the table: microseconds per sample and iteration, medians."""
    way, ratio = row[name], "1"
    if name != "eager":
        low, middle, high = row["times_as_fast"][name].values()
        ratio = f"{middle:.2f} ({low:.2f} to {high:.2f})"
    label = f"{row['body']}, {row['samples']} samples, {name}"
    return [label, 1e6 * way["seconds"]["median"], ratio, way["memory_mib"], way["library_share"]]


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    torch.set_num_threads(config.threads)
    if config.folder is not None:
        prepare_output_folder(config.folder)
    rows = []
    for row in (row for body in config.bodies for row in measure(config, body)):
        rows.append(row)
        print(f"{row['body']}, {row['samples']} samples: compiled in "
              f"{row['compile']['wall_s']:.0f} s, apart from eager by "
              f"{max(row['relative_difference'].values()):.1e}", flush=True)  # fmt: skip
    report = {"rows": rows, "config": config, "torch": torch.__version__}
    if config.folder is not None:
        save_figure(picture(rows), config.folder / "profile.png", dpi=100)
    title = f"A step eager, compiled and fused, {config.dtype} on {config.device}"
    columns = ("body", "microseconds", "times as fast", "MiB", "library's share")
    table = Table(title, columns, [cells_of(row, name) for row in rows for name in _ways(row)])
    return finish(config.out, report, table)


if __name__ == "__main__":
    start(main, Config, __doc__)
