"""Time and memory of the cost with its first two derivatives, against autograd in the same run.

    python scripts/benchmark.py --out benchmark.json

The joint term of body34 is evaluated with gradient and exact Hessian for many samples in four ways:

* closed form: what the optimiser calls, `TrackingCost.local_model`;
* value alone, without derivatives: the price of a trial step;
* lifted by autograd: `Curvature.AUTOGRAD`, double backward through the tree alone;
* plain autograd: state, pose, projection, robust cost, and a double backward through all of it, row
  by row, as anybody would write it first. The headline is the closed form against this one.

Two rows of the full cost (contour, joints and stabiliser) follow. Each repeat times every way, one
after the other; ratios are taken within a repeat, so that a busy machine slows both sides. Memory
is the peak of a process of its own per way. Nothing is asserted.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from torch import Tensor

from torchcss.body.model import differentiate_twice, load_body
from torchcss.cost.joints import JointObservation, JointTerm
from torchcss.cost.total import CHUNK, CostChoice, TrackingCost
from torchcss.cost.visibility import ContourPredictor
from torchcss.io.tracks import prepare_output_folder, write_summary
from torchcss.joint_names import ALIASES
from torchcss.types import Curvature, LocalModel
from torchcss.vision.camera import Camera

CLOSED, LIFTED, PLAIN = "joints_closed_form", "joints_lifted_by_autograd", "joints_plain_autograd"
WAYS = ("joints_value", CLOSED, LIFTED, PLAIN, "full_value", "full_local_model")
WIDTH, HEIGHT = 640, 480
AT_LEAST_S = 0.3  # A way that is faster is called again, and the mean time taken.


@dataclass(frozen=True, kw_only=True)
class Config:
    """Size of the problem and what to write."""

    samples: int = 2000
    """States per evaluation."""
    repeats: int = 7
    """Interleaved repeats, after one call of each way that compares the results."""
    dtype: Literal["float32", "float64"] = "float64"
    """Floating type."""
    plain_chunk: int = CHUNK
    """Samples that plain autograd takes at a time; the package takes its own number."""
    threads: int | None = None
    """Threads of torch; its own choice by default."""
    out: Path | None = None
    """JSON file to write."""
    memory_of: str | None = None
    """Measure only the memory of this way; the script calls itself with it."""


def make_ways(config: Config) -> tuple[dict[str, Callable[[Tensor], Any]], Tensor]:
    """The ways to evaluate the cost, by name, and the states."""
    generator = torch.Generator().manual_seed(0)
    dtype = getattr(torch, config.dtype)
    # The camera looks along z with y down; the body stands upright 3.5 m before it, facing it.
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    body = load_body("body34", dtype=dtype).with_base(flip, torch.tensor([0.0, 0.0, 3.5]))
    camera = Camera.pinhole(WIDTH, HEIGHT, focal_px=600.0).to(dtype)
    noise = torch.randn(config.samples, body.num_parameters, generator=generator, dtype=dtype)
    x = body.bounds.project(body.rest + 0.2 * noise)
    names = tuple(name for name in ALIASES["BODY_25B"] if name in body.joint_names)
    joints = body.pose(body.rest).joints[[body.joint_index(name) for name in names]]
    uv = camera.project(joints).uv
    uv = uv + 3.0 * torch.randn(uv.shape, generator=generator, dtype=dtype)
    observation = JointObservation(body.joint_names, uv, torch.ones_like(uv[:, 0]), names)
    choice = CostChoice(contour=None, joints=(term := JointTerm()), stabiliser=None, temporal=None)
    cost = TrackingCost(body=body, camera=camera, choice=choice, observation=observation)
    autograd = replace(cost, choice=replace(choice, curvature=Curvature.AUTOGRAD))
    # Noise for edges: the search along the normals takes the same time whatever it finds.
    edge_field = 0.7 * torch.rand(2, HEIGHT, WIDTH, generator=generator, dtype=dtype)
    everything, predictor = CostChoice(temporal=None), ContourPredictor(body)
    full = replace(cost, choice=everything, predictor=predictor, edge_field=edge_field)

    def plain(x: Tensor) -> LocalModel:
        parts = []
        for part in x.split(config.plain_chunk):
            part = part.detach().requires_grad_()
            projection = camera.project(body.pose(part).joints[:, observation.index])
            parts.append(differentiate_twice(term.value(projection, observation).sum(-1), part))
        return LocalModel(*(torch.cat(items) for items in zip(*parts, strict=True)))

    evaluations = cost.value, cost.local_model, autograd.local_model, plain
    evaluations += full.value, full.local_model
    return dict(zip(WAYS, evaluations, strict=True)), x


def seconds_of(way: Callable[[Tensor], Any], x: Tensor) -> float:
    """Mean time of one call."""
    calls, start = 0, time.perf_counter()
    while calls == 0 or time.perf_counter() - start < AT_LEAST_S:
        way(x)
        calls += 1
    return (time.perf_counter() - start) / calls


def measure_memory(config: Config, name: str) -> dict[str, float]:
    """Peak memory of this process with one way, and how much a few samples would need less."""
    unit = 1 if sys.platform == "darwin" else 1024
    ways, x = make_ways(config)
    peaks = []
    for states in (x[:8], x):
        ways[name](states)
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20)
    return {"peak_mib": peaks[1], "added_mib": peaks[1] - peaks[0]}


def memory_in_own_process(config: Config, name: str) -> dict[str, float]:
    """The same of a new process."""
    keys = ("samples", "dtype", "plain_chunk", "threads")
    options = (f"--{key.replace('_', '-')}={getattr(config, key)}" for key in keys)
    command = [sys.executable, __file__, *options, f"--memory-of={name}"]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def difference(closed: LocalModel, other: LocalModel) -> float:
    """Largest difference of an item's derivatives, relative to the item's largest of that order."""
    pairs = [(a.flatten(1), b.flatten(1)) for a, b in zip(closed[1:], other[1:], strict=True)]
    return max(float(((a - b).abs().amax(1) / b.abs().amax(1)).max()) for a, b in pairs)


def quartiles(values: list[float]) -> dict[str, float]:
    """The middle and the spread."""
    names = ("lower_quartile", "median", "upper_quartile")
    return dict(zip(names, np.percentile(values, [25, 50, 75]).tolist(), strict=True))


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    if config.memory_of is not None:
        print(json.dumps(memory := measure_memory(config, config.memory_of)))
        return memory
    # First of all the memory: on Linux a process starts with the peak of the one that starts it.
    memory = {name: memory_in_own_process(config, name) for name in WAYS}
    ways, x = make_ways(config)
    closed = ways[CLOSED](x)
    agreement = {name: difference(closed, ways[name](x)) for name in (LIFTED, PLAIN)}
    rounds = [{name: seconds_of(ways[name], x) for name in WAYS} for _ in range(config.repeats)]
    metrics = {
        "seconds": {name: quartiles([times[name] for times in rounds]) for name in WAYS},
        "times_closed_form": {
            name: quartiles([times[name] / times[CLOSED] for times in rounds])
            for name in (LIFTED, PLAIN)
        },
        "memory": memory,
        "relative_difference": agreement,
    }
    report = {
        "metrics": metrics,
        "unit": dict(zip(metrics, ("s per call", "1", "MiB", "1"), strict=True)),
        "direction": dict(zip(metrics, ("lower", "higher", "lower", "lower"), strict=True)),
        "config": config,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
    print_table(report)
    if config.out is not None:
        prepare_output_folder(config.out.parent)
        write_summary(config.out, report)
    return report


def print_table(report: dict[str, Any]) -> None:
    """The report for people."""
    config, metrics = report["config"], report["metrics"]
    print(f"{config.samples} samples, {config.dtype}, {report['threads']} threads")
    print(f"{'ms':>26} {'quartile':>9} {'median':>9} {'quartile':>9} {'peak MiB':>9} {'added':>6}")
    for name, row in metrics["seconds"].items():
        times = "".join(f" {1e3 * value:9.1f}" for value in row.values())
        peak, added = metrics["memory"][name].values()
        print(f"{name:>26}{times} {peak:9.0f} {added:6.0f}")
    for name, ratio in metrics["times_closed_form"].items():
        low, median, high = ratio.values()
        print(f"{name}: {median:.1f} times the closed form ({low:.1f} to {high:.1f})")
        print(f"    largest relative difference {metrics['relative_difference'][name]:.1e}")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
