"""Time and memory of the cost with its first two derivatives, against autograd in the same run.

    python scripts/benchmark.py --out benchmark.json

Two costs of body34: the joint term alone, and the full cost, which is contour, flow, joints,
interpenetration and stabiliser at 1008 nodes with their visibility. Each in several ways:

* `value`: without derivatives, the price of a trial step;
* `closed`: with gradient and exact Hessian in closed form, what the optimiser calls;
* `plain`: the joint term written anew and differentiated by double backward, nothing of the
  package's derivatives in it (`peers/autograd_cost.py`);
* `autograd`: the full cost by the package's own curvature of that name; `one_by_one`: the same with
  chunks of a single sample. These three are timed on one chunk, of the size that suits them best,
  and extrapolated.

Each repeat times every way in turn; ratios are taken within a repeat, so that a busy machine slows
both sides. Memory is the peak of a process of its own. Then come the times of the full cost by
term, and of the features of a frame with flow. Nothing is asserted.

What the profile says of the full cost: two fifths of the local model is visibility, a fifth each
the edge search of the contour term and the interpenetration, a tenth the lift; the rest is under a
tenth. Within visibility no single function has more than a fifth: finding the contours, the refined
gaps, the test of spheres and the turn into the parts' frames have about that each. Of what was
tried last: leaving out lines that nothing depends on, ellipsoids about the parts and points deep
inside them, and longer rows with fewer, larger chunks took it from a half to this; single precision
for the contours, one comparison instead of two, and larger chunks of the whole cost gave nothing or
less.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from common import QUARTILES, Table, finish, peak_mib, quartiles, start
from peers.autograd_cost import joints_by_autograd, made_up_costs, made_up_frames
from torch import Tensor

from torchcss.cost.total import TrackingCost
from torchcss.io.pictures import read_image
from torchcss.stopwatch import Stopwatch
from torchcss.types import Curvature, LocalModel, frozen
from torchcss.vision.features import FeatureExtractor
from torchcss.vision.flow import TRACKING_FLOW

COMPARED = {  # with which other way each is compared
    "joints_plain": "joints_closed",
    "full_closed": "full_value",
    "full_autograd": "full_closed",
    "full_one_by_one": "full_closed",
}
Way = tuple[Callable[[Tensor], Any], Tensor]
AT_LEAST_S = 0.3  # A way that is faster is called again, and the mean time taken.


@frozen
class Config:
    """Size of the problem and what to write."""

    samples: int = 2000
    """States per evaluation."""
    repeats: int = 5
    """Interleaved repeats, after one call of each way that compares the results."""
    dtype: Literal["float32", "float64"] = "float64"
    """Floating type."""
    plain_joints: int = 256
    """Samples on which plain autograd of the joint term is timed."""
    plain_full: int = 64
    """Samples on which plain autograd of the full cost is timed."""
    size_wh: tuple[int, int] = (640, 480)
    """Size of the made-up frames."""
    frames: tuple[Path, Path] | None = None
    """Two frames of a video to extract features from, instead of the made-up ones."""
    threads: int | None = None
    """Threads of torch; its own choice by default."""
    out: Path | None = None
    """JSON file to write."""
    memory_of: str | None = None
    """Measure only the memory of this way; the script calls itself with it."""


def make_ways(config: Config) -> tuple[dict[str, Way], TrackingCost]:
    """The ways to evaluate the costs, by name, with the states to time them on; the full cost."""
    alone, full, x = made_up_costs(config.samples, config.size_wh, getattr(torch, config.dtype))
    by_autograd = replace(full, choice=replace(full.choice, curvature=Curvature.AUTOGRAD))
    return {
        "joints_value": (alone.value, x),
        "joints_closed": (alone.local_model, x),
        "joints_plain": (partial(joints_by_autograd, alone), x[: config.plain_joints]),
        "full_value": (full.value, x),
        "full_closed": (full.local_model, x),
        "full_autograd": (by_autograd.local_model, x[: config.plain_full]),
        "full_one_by_one": (by_autograd.local_model, x[:1]),
    }, full


def seconds_of(way: Callable[[Tensor], Any], x: Tensor) -> float:
    """Mean time of one call."""
    calls, start = 0, time.perf_counter()
    while calls == 0 or time.perf_counter() - start < AT_LEAST_S:
        way(x)
        calls += 1
    return (time.perf_counter() - start) / calls


def measure_memory(config: Config, name: str) -> dict[str, float]:
    """Peak memory of this process with one way, and how much a few samples would need less."""
    evaluate, x = make_ways(config)[0][name]
    peaks = []
    for states in (x[:8], x):
        evaluate(states)
        peaks.append(peak_mib(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))
    return {"peak_mib": peaks[1], "added_mib": peaks[1] - peaks[0]}


def memory_in_own_process(config: Config, name: str) -> dict[str, float]:
    """The same of a new process."""
    keys = ("samples", "dtype", "plain_joints", "plain_full", "threads")
    options = (f"--{key.replace('_', '-')}={getattr(config, key)}" for key in keys)
    command = [sys.executable, __file__, *options, f"--memory-of={name}"]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def difference(closed: LocalModel, other: LocalModel) -> float:
    """Largest difference of an item's derivatives, relative to the item's largest of that order."""
    pairs = [(a.flatten(1), b.flatten(1)) for a, b in zip(closed[1:], other[1:], strict=True)]
    return max(float(((a - b).abs().amax(1) / b.abs().amax(1)).max()) for a, b in pairs)


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    if config.memory_of is not None:
        print(json.dumps(memory := measure_memory(config, config.memory_of)))
        return memory
    pair: Any = made_up_frames(config.size_wh)
    if config.frames is not None:
        pair = [read_image(path) for path in config.frames]
    ways, full = make_ways(config)
    # First of all the memory: on Linux a process starts with the peak of the one that starts it.
    memory = {name: memory_in_own_process(config, name) for name in ways}
    agreement = {}
    for name in ("joints_plain", "full_autograd"):
        evaluate, x = ways[name]
        agreement[name] = difference(ways[COMPARED[name]][0](x), evaluate(x))
    rounds = [
        {name: seconds_of(*way) * config.samples / len(way[1]) for name, way in ways.items()}
        for _ in range(config.repeats)
    ]
    watches = {"full_value": Stopwatch(), "full_closed": Stopwatch()}
    replace(full, stopwatch=watches["full_value"]).value(ways["full_value"][1])
    replace(full, stopwatch=watches["full_closed"]).local_model(ways["full_closed"][1])
    extractor = FeatureExtractor(flow=TRACKING_FLOW, working_size=640)
    extract = [seconds_of(lambda frame: extractor(frame, pair[0]), pair[1]) for _ in rounds]
    metrics = {
        "seconds": {name: quartiles([times[name] for times in rounds]) for name in ways},
        "ratio": {n: quartiles([t[n] / t[other] for t in rounds]) for n, other in COMPARED.items()},
        "memory": memory,
        "relative_difference": agreement,
        "seconds_by_term": {name: watch.seconds for name, watch in watches.items()},
        "seconds_of_features": quartiles(extract),
    }
    units = ("s per call", "1", "MiB", "1", "s per call", "s per frame")
    report = {"metrics": metrics, "unit": dict(zip(metrics, units, strict=True)), "config": config}
    report |= {"threads": torch.get_num_threads(), "torch": torch.__version__}
    tell(report)
    return finish(config.out, report, table_of(report))


def table_of(report: dict[str, Any]) -> Table:
    """The report for the page of results."""
    rows = []
    for name, times in report["metrics"]["seconds"].items():
        peak, added = report["metrics"]["memory"][name].values()
        rows.append([name, *(1e3 * value for value in times.values()), peak, added])
    columns = ("evaluation", *(f"ms, {name}" for name in QUARTILES), "peak MiB", "added MiB")
    config = report["config"]
    title = f"Evaluations of the cost, {config.samples} samples, {config.dtype}"
    return Table(f"{title}, {report['threads']} threads", columns, rows)


def tell(report: dict[str, Any]) -> None:
    """How evaluations compare, and where their time goes."""
    metrics = report["metrics"]
    for name, ratio in metrics["ratio"].items():
        low, median, high = ratio.values()
        apart = metrics["relative_difference"].get(name)
        note = "" if apart is None else f"; relative difference {apart:.1e}"
        print(f"{name} takes {median:.2f} times {COMPARED[name]} ({low:.2f} to {high:.2f}){note}")
    for name, seconds in metrics["seconds_by_term"].items():
        print(f"{name} by term, ms:", {term: round(1e3 * value) for term, value in seconds.items()})
    print(f"features of a frame: {metrics['seconds_of_features']['median']:.2f} s")


if __name__ == "__main__":
    start(main, Config, __doc__)
