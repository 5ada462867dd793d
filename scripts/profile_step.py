"""One tracker step as the processor sees it: eager, compiled and fused, whole and by stage.

    python scripts/profile_step.py --out profile/profile.json --folder profile

A step draws samples from modes by their scaled covariances where places are free, evaluates the
cost of all (pose, projection, robust joint residuals, priors; value, gradient and exact Hessian),
accepts or refuses, and plans the next damped Cholesky step inside the box: `fixed_step`, all that
is of fixed shape in the search. Samples are worked off in pools of one size, the last one filled
up, so that one graph serves any number. Compiled it is one graph (`fullgraph=True`), and is not
compiled again for a second frame; a graph that broke or a second compilation would raise. Fused is
what the search does on a CPU: the cost by compiled kernels, the step of `TrustRegionNewton` as
well. What is compiled agrees with eager to rounding; planned steps in the metric of the damped
Hessian, since a matrix that is only just definite passes its rounding on.

The table has the microseconds of every stage by sample and iteration and in brackets

- the share of overhead, `a / (a + b N)`: what a call takes however many its samples, by the times
  of two pools, of `N` samples and of a fifth as many;
- how many times as long it takes as its arithmetic alone, at the rate that a product of large
  matrices reached in the same run. `Arithmetic` counts the operations of the stages as they stand
  in torch, with three Cholesky factors a step, and the same count goes for all ways.

Stages of eager are timed by themselves. One graph has no stages: each is compiled by itself too,
and timed without the checks whether its graph still fits; what overhead there is, the whole has. Of
fused they are its kernels' calls. The rest is the whole without its stages: in the fused engine
the packing, checking and converting of numbers, in one graph its checks, less what calls of stages
by themselves take more. Eager's priors find the poses once more, as they would alone.

A report also has the ratios of eager to compiled and to fused within a repeat, the memory that an
iteration takes on top of its inputs (its results included), and what compiling took, with nothing
from a cache. On a CPU the clock is the process's own, since others may use the machine; on a GPU it
is the wall's. With `--folder` come the figure, and by body and way a table and a trace of
`torch.profiler`.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from common import Table, quartiles, start, write_report
from matplotlib.figure import Figure
from peers.fixed_step import scaled_draw
from peers.tracker_step import (
    STAGES,
    FrameData,
    Step,
    Work,
    compile_step,
    compile_whole,
    fused_step,
    make_frames,
    operations,
    profiled,
    tracker_step,
)
from torch import Tensor
from torch._inductor.utils import fresh_inductor_cache

from torchcss.cost.fused import engine
from torchcss.errors import ConfigurationError
from torchcss.files import prepare_output_folder
from torchcss.inference import trust_region
from torchcss.kernels import checked
from torchcss.show.style import save_figure
from torchcss.tracking.settings import Settings
from torchcss.types import frozen

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
REST, ALL = "the rest", "all"
KERNELS = {"add_view": "keypoints"}
"""Stages of the fused engine's kernels by name; others are of priors."""
REASONS = {
    "drawing": (
        "A product of a matrix and a vector a sample, which reads a number for every two "
        "operations, made for every place, fresh or not."
    ),
    "keypoints": (
        "Eager is 900 calls on a few kilobytes each; the kernels go along the tree joint by joint, "
        "every sum waiting for the one before, fused ones in double precision."
    ),
    "priors": (
        "Eager is 330 calls, which fill a matrix for every diagonal; in kernels it is a division "
        "and a logarithm a parameter, each counted as one operation."
    ),
    "planning": (
        "Eager and compiled give three dampings to a library matrix by matrix, which are too small "
        "for it; in the kernel a row is five registers and fewer, and roots wait for one another."
    ),
    REST: (
        "Compiled, a call checks that its graph still fits; fused, results are turned from double "
        "into single precision and checked, and the state is copied."
    ),
}
"""Why a stage is not faster."""
SMALLER = 5
"""The pool that tells the overhead has so many times fewer samples."""
PRODUCT = 1024
"""Rows and columns of the matrices whose product tells the rate of arithmetic."""
Seconds = dict[str, dict[str, float]]
"""Times by way and stage."""


@frozen
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
        if min(*self.samples, self.pool) < 2:
            raise ConfigurationError("samples, pool: expected at least 2: one has no overhead")


class Ways(NamedTuple):
    """A step in all ways.

    Attributes:
        steps: The step by way.
        stages: Its stages by way and name, where they can be called by themselves.
        found: What compiling took, and how far apart the results are.
    """

    steps: dict[str, Step]
    stages: dict[str, Mapping[str, Callable[..., Any]]]
    found: dict[str, Any]


def ways_of(config: Config, frames: Iterator[FrameData]) -> Ways:
    """Compile the step of a body."""
    steps: dict[str, Step] = {"eager": tracker_step}
    if not config.device.startswith("cuda") and (fused := fused_step(config.dtype)) is not None:
        steps["fused"] = fused
    steps["compiled"], found = compile_step(frames, math.sqrt(config.covariance_scale))
    compiled = {name: compile_whole(stage) for name, stage in STAGES.items()}
    return Ways(steps, {"eager": STAGES, "compiled": compiled}, found)


def works_of(config: Config, ways: Ways, frame: FrameData, samples: int) -> dict[str, Work]:
    """Samples of a frame for every way, in pools for which all is compiled then."""
    scale = math.sqrt(config.covariance_scale)
    works = {way: Work(frame, samples, scale) for way in ways.steps}
    for way, step in ways.steps.items():
        works[way].iterate(step)
        works[way].iterate(step)
    for stage in (stage for stages in ways.stages.values() for stage in stages.values()):
        works["eager"].call(stage)
    return works


def seconds_of(config: Config, call: Callable[[], Any]) -> float:
    """Mean time of a call."""
    gpu, calls = config.device.startswith("cuda"), 0
    clock = time.perf_counter if gpu else time.process_time
    begin = now = clock()
    while calls == 0 or now - begin < config.at_least_s:
        call()
        if gpu:
            torch.cuda.synchronize()
        calls, now = calls + 1, clock()
    return (now - begin) / calls


def fused_stages(config: Config, work: Work, step: Step) -> dict[str, float]:
    """Times of an iteration's kernels; what is drawn is drawn by torch."""
    spent, calls, add_terms = dict.fromkeys(STAGES, 0.0), 0, engine._Packed.add

    def add(packed: engine._Packed, *arguments: Any) -> None:
        begin = time.process_time()
        add_terms(packed, *arguments)
        name = KERNELS.get(packed.kernel.__name__, "priors")
        spent[name] += time.process_time() - begin

    def run(*arguments: Any) -> None:
        begin = time.process_time()
        checked.run(*arguments)
        spent["planning"] += time.process_time() - begin

    def iterate() -> None:
        nonlocal calls
        work.iterate(step)
        calls += 1

    def draw(frame: FrameData, _: Any, __: Tensor, scale: float) -> Tensor:
        return scaled_draw(frame.mean, frame.factor, frame.noise, scale)

    with patch.object(engine._Packed, "add", add), patch.object(trust_region, "run", run):
        seconds_of(config, iterate)
    times = {name: seconds / calls for name, seconds in spent.items()}
    return times | {"drawing": seconds_of(config, partial(work.call, draw))}


def seconds_by_stage(config: Config, ways: Ways, works: Mapping[str, Work]) -> Seconds:
    """Times of an iteration of all samples, whole and by stage."""
    times: Seconds = {}
    for way, step in ways.steps.items():
        work = works[way]
        times[way] = {ALL: seconds_of(config, partial(work.iterate, step))}
        if way == "fused":
            times[way] |= fused_stages(config, work, step)
        with torch.compiler.set_stance("default", skip_guard_eval_unsafe=True):
            for name, stage in ways.stages.get(way, {}).items():
                call = partial(works["eager"].call, stage)
                times[way][name] = seconds_of(config, call)
        if len(times[way]) > 1:
            times[way][REST] = times[way][ALL] - sum(times[way][name] for name in STAGES)
    return times


def rate_of_products(config: Config) -> float:
    """Floating-point operations a second in a product of large matrices."""
    like = torch.empty(0, dtype=getattr(torch, config.dtype), device=config.device)
    matrix = torch.ones(PRODUCT, PRODUCT).to(like)
    product = partial(torch.mm, matrix, matrix)
    product()
    times = [seconds_of(config, product) for _ in range(config.repeats)]
    return 2 * PRODUCT**3 / float(np.median(times))


def measure(config: Config, body: str, rate: float) -> Iterator[dict[str, Any]]:
    """The rows of one body."""
    like = torch.empty(0, dtype=getattr(torch, config.dtype), device=config.device)

    def size_of(samples: int) -> int:
        return math.ceil(samples / math.ceil(samples / config.pool))

    for pool, several in groupby(sorted(config.samples), size_of):
        smaller = max(1, pool // SMALLER)
        frames = make_frames(body, pool, like, config.seed)
        frame = next(make_frames(body, smaller, like, config.seed))
        with nullcontext() if config.cached else fresh_inductor_cache():
            ways = ways_of(config, frames)
            # One graph has no stages; its stages by themselves are not compiled twice.
            few = ways._replace(stages={"eager": STAGES})
            fewer = works_of(config, few, frame, smaller)
            frame = next(frames)
            works_of(config, ways, frame, pool)
        for samples in several:
            works = works_of(config, ways, frame, samples)
            rounds = [
                (seconds_by_stage(config, few, fewer), seconds_by_stage(config, ways, works))
                for _ in range(config.repeats)
            ]
            needed = operations(works["eager"])
            row = {"body": body, "samples": samples, "pool": pool, "operations": needed}
            row |= ways.found | of_rounds(rounds, (smaller, pool, samples), needed, rate)
            for way, step in ways.steps.items():
                stem = f"{body}_{samples}_{way}"
                row[way] |= profile_of(config, works[way], step, stem)
            yield row


def of_rounds(
    rounds: Sequence[tuple[Seconds, Seconds]],
    sizes: tuple[int, int, int],
    needed: Mapping[str, float],
    rate: float,
) -> dict[str, Any]:
    """What the times say of every way and its stages; `stage_of` has the arguments."""
    found: dict[str, Any] = {"times_as_fast": {}}
    for way in rounds[0][1]:
        stages = {
            name: stage_of(
                [(few[way].get(name, math.nan), many[way][name]) for few, many in rounds],
                sizes,
                needed.get(name, math.nan) / rate,
            )
            for name in (*STAGES, REST, ALL)
        }
        seconds = quartiles([many[way][ALL] / sizes[-1] for _, many in rounds])
        found[way] = {"seconds": seconds, "stages": stages}
        if way != "eager":
            ratios = [many["eager"][ALL] / many[way][ALL] for _, many in rounds]
            found["times_as_fast"][way] = quartiles(ratios)
    return found


def stage_of(
    rounds: Sequence[tuple[float, float]], sizes: tuple[int, int, int], arithmetic: float
) -> dict[str, float]:
    """Seconds a sample, share of overhead, and times the seconds of the arithmetic.

    Args:
        rounds: Seconds of a call with fewer samples, and of an iteration of all.
        sizes: How many samples the first call has, a call of the iteration, and all its calls.
        arithmetic: Seconds a sample.
    """
    (smaller, pool, samples), shares = sizes, []
    for few, many in rounds:
        call = many * pool / samples
        grows = (call - few) / (pool - smaller) * pool
        shares.append(np.clip(1 - grows / call, 0.0, 1.0) if call > 0 else math.nan)
    seconds = float(np.median([many for _, many in rounds])) / samples
    share = float(np.median(shares))
    return {"seconds": seconds, "overhead": share, "times_arithmetic": seconds / arithmetic}


def profile_of(config: Config, work: Work, step: Step, stem: str) -> dict[str, Any]:
    """Memory and share of library calls, medians; the table and the trace go into the folder."""
    with tempfile.TemporaryDirectory() as scratch:
        path = (config.folder or Path(scratch)) / stem
        runs = [
            profiled(work, step, path.with_suffix(".json"), config.rows)
            for _ in range(config.repeats)
        ]
        path.with_suffix(".txt").write_text(runs[-1][1])
    # The profiler's clock is the wall's, so that one run may be disturbed.
    return {key: float(np.median([run[0][key] for run in runs])) for key in runs[0][0]}


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


def lines_of(row: dict[str, Any]) -> Iterator[list[str | float]]:
    """A row's lines of the table: its stages, and how many times as fast a step is."""
    ways = ["eager", *row["times_as_fast"]]
    for name in (*STAGES, REST, ALL):
        line: list[str | float] = [f"{row['body']}, {row['samples']} samples: {name}"]
        line.append(1e-3 * row["operations"].get(name, math.nan))
        for stage in (row[way]["stages"][name] for way in ways):
            shares = (
                f"{stage['overhead']:.0%}",
                f"{round(stage['times_arithmetic'], 1):g} x",
            )
            known = [text for text in shares if "nan" not in text]
            line.append(f"{1e6 * stage['seconds']:.3g}" + f" ({', '.join(known)})" * bool(known))
        yield [*line, REASONS.get(name, "")]
    ratios = [
        f"{ratio['median']:.2f} ({ratio['lower_quartile']:.2f} to {ratio['upper_quartile']:.2f})"
        for ratio in row["times_as_fast"].values()
    ]
    yield [f"{row['body']}, {row['samples']} samples: times as fast", math.nan, "1", *ratios, ""]


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    torch.set_num_threads(config.threads)
    if config.folder is not None:
        prepare_output_folder(config.folder)
    rows, rate = [], rate_of_products(config)
    for row in (row for body in config.bodies for row in measure(config, body, rate)):
        rows.append(row)
        print(f"{row['body']}, {row['samples']} samples: compiled in "
              f"{row['compile']['wall_s']:.0f} s, apart from eager by "
              f"{max(row['relative_difference'].values()):.1e}", flush=True)  # fmt: skip
    made = {"config": config, "torch": torch.__version__}
    report = {"operations_a_second": rate, "rows": rows, **made}
    if config.folder is not None:
        save_figure(picture(rows), config.folder / "profile.png", dpi=100)
    title = f"A step eager, compiled and fused, {config.dtype} on {config.device}"
    heads = (
        "body, samples: stage",
        "kflop",
        *(f"{way}, µs" for way in ["eager", *rows[0]["times_as_fast"]]),
    )
    lines = [line for row in rows for line in lines_of(row)]
    Table(title, heads, [line[:-1] for line in lines]).print()
    write_report(config.out, report, Table(title, (*heads, "why it is not faster"), lines))
    return report


if __name__ == "__main__":
    start(main, Config, __doc__)
