"""Time and memory of the cost with its first two derivatives, against autograd in the same run.

    python scripts/benchmark.py --out benchmark.json

The joint term of body34 is evaluated with gradient and exact Hessian for many samples in four ways:

* closed form: what the optimiser calls, `TrackingCost.local_model`;
* value alone: the same without derivatives, the price of a trial step;
* lifted by autograd: `Curvature.AUTOGRAD`, closed-form points, double backward through the tree;
* plain autograd: state, pose, projection, robust cost, and a double backward through all of it, row
  by row, as anybody would write it first. The headline is the closed form against this one.

Two rows of the full cost (contour, joints and stabiliser) follow, which need no autograd twin. Each
repeat times every way once, one after the other; ratios are taken within a repeat, so that a busy
machine slows both sides. Peak memory is that of a process of its own per way. Nothing is asserted.
"""

from __future__ import annotations

import json
import platform
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
from torchcss.vision.features import FeatureExtractor

CLOSED, LIFTED, PLAIN = "joints_closed_form", "joints_lifted_by_autograd", "joints_plain_autograd"
WIDTH, HEIGHT = 640, 480


@dataclass(frozen=True, kw_only=True)
class Config:
    """Size of the problem and what to write."""

    samples: int = 2000
    """States per evaluation."""
    repeats: int = 7
    """Interleaved repeats; the first, which warms up, is not counted when there are more."""
    dtype: Literal["float32", "float64"] = "float64"
    """Floating type."""
    body: str = "body34"
    """Body to pose."""
    autograd_chunk: int = CHUNK
    """Samples that the autograd ways take at a time; the package takes its own."""
    at_least_s: float = 0.3
    """A way that is faster than this is called again and its mean time taken."""
    seed: int = 0
    """Seed of poses, keypoints and picture."""
    out: Path | None = None
    """JSON file to write."""
    memory_of: str | None = None
    """Measure only the memory of this way, print it and stop; the script calls itself with it."""


def make_ways(config: Config) -> tuple[dict[str, Callable[[Tensor], Any]], Tensor]:
    """The ways to evaluate the cost, by name, and the states."""
    generator = torch.Generator().manual_seed(config.seed)
    dtype = getattr(torch, config.dtype)
    # The camera looks along z with y down; the body stands upright 3.5 m before it, facing it.
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    body = load_body(config.body, dtype=dtype).with_base(flip, torch.tensor([0.0, 0.0, 3.5]))
    camera = Camera.pinhole(WIDTH, HEIGHT, focal_px=600.0).to(dtype)
    noise = torch.randn(config.samples, body.num_parameters, generator=generator, dtype=dtype)
    x = body.bounds.project(body.rest + 0.2 * noise)
    names = tuple(name for name in ALIASES["BODY_25B"] if name in body.joint_names)
    truth = body.pose(body.rest).joints[[body.joint_index(name) for name in names]]
    blur = torch.randn(len(names), 2, generator=generator, dtype=dtype)
    observation = JointObservation(
        body.joint_names, camera.project(truth).uv + 3.0 * blur, blur.new_ones(len(names)), names
    )
    term = JointTerm()
    choice = CostChoice(contour=None, joints=term, stabiliser=None, temporal=None)
    joints = TrackingCost(body=body, camera=camera, choice=choice, observation=observation)
    autograd = replace(joints, choice=replace(choice, curvature=Curvature.AUTOGRAD))
    features = FeatureExtractor().to(dtype)(torch.rand(HEIGHT, WIDTH, generator=generator))
    full = replace(
        joints,
        choice=CostChoice(temporal=None),
        predictor=ContourPredictor(body),
        edge_field=(features.edge_energy * features.edge_direction).to(dtype),
    )

    def plain(x: Tensor) -> LocalModel:
        x = x.detach().requires_grad_()
        uv_and_more = camera.project(body.pose(x).joints[:, observation.index])
        return differentiate_twice(term.value(uv_and_more, observation).sum(-1), x)

    def in_chunks(evaluate: Callable[[Tensor], LocalModel]) -> Callable[[Tensor], LocalModel]:
        def whole(x: Tensor) -> LocalModel:
            parts = [evaluate(part) for part in x.split(config.autograd_chunk)]
            return LocalModel(*(torch.cat(items) for items in zip(*parts, strict=True)))

        return whole

    ways = {
        "joints_value": joints.value,
        CLOSED: joints.local_model,
        LIFTED: in_chunks(autograd.local_model),
        PLAIN: in_chunks(plain),
        "full_value": full.value,
        "full_local_model": full.local_model,
    }
    return ways, x


def seconds_of(way: Callable[[Tensor], Any], x: Tensor, at_least_s: float) -> float:
    """Mean time of one call."""
    calls, start = 0, time.perf_counter()
    while calls == 0 or time.perf_counter() - start < at_least_s:
        way(x)
        calls += 1
    return (time.perf_counter() - start) / calls


def peak_mib() -> float:
    """Largest memory that this process has held, MiB."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def measure_memory(config: Config) -> dict[str, float]:
    """Peak memory of one way, and how much of it the evaluation added to the loaded libraries."""
    ways, x = make_ways(config)
    ways[config.memory_of or CLOSED](x[:8])
    before = peak_mib()
    ways[config.memory_of or CLOSED](x)
    return {"peak_mib": peak_mib(), "added_mib": peak_mib() - before}


def memory_in_own_process(config: Config, name: str) -> dict[str, float]:
    options = [f"--{key}={getattr(config, key)}" for key in ("samples", "dtype", "body", "seed")]
    options += [f"--autograd-chunk={config.autograd_chunk}", f"--memory-of={name}"]
    command = [sys.executable, str(Path(__file__).resolve()), *options]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def difference(one: Tensor, other: Tensor) -> float:
    """Largest difference of an item's entries, relative to the item's largest entry."""
    one, other = one.flatten(1), other.flatten(1)
    return float(((one - other).abs().amax(-1) / other.abs().amax(-1)).max())


def quartiles(values: Any) -> dict[str, float]:
    low, median, high = np.percentile(values, [25, 50, 75])
    return {"median": float(median), "lower_quartile": float(low), "upper_quartile": float(high)}


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    if config.memory_of is not None:
        memory = measure_memory(config)
        print(json.dumps(memory))
        return memory
    # First the memory: on Linux a process starts with the peak of the one that started it.
    ways, x = make_ways(replace(config, samples=1))
    memory = {name: memory_in_own_process(config, name) for name in ways}
    ways, x = make_ways(config)
    closed = ways[CLOSED](x)
    agreement = {}
    for name in (LIFTED, PLAIN):
        other = ways[name](x)
        agreement[name] = {
            "gradient": difference(closed.gradient, other.gradient),
            "hessian": difference(closed.hessian, other.hessian),
        }
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(config.repeats):
        for name, way in ways.items():
            times[name].append(seconds_of(way, x, config.at_least_s))
    counted = slice(1, None) if config.repeats > 1 else slice(None)
    seconds = {name: np.array(values)[counted] for name, values in times.items()}
    ratios = {name: quartiles(seconds[name] / seconds[CLOSED]) for name in (LIFTED, PLAIN)}
    report = {
        "metrics": {
            "seconds": {name: quartiles(values) for name, values in seconds.items()},
            "times_closed_form": ratios,
            "memory": memory,
            "relative_difference": agreement,
        },
        "unit": {"seconds": "s per call", "times_closed_form": "1", "memory": "MiB",
                 "relative_difference": "1"},
        "direction": {"seconds": "lower", "times_closed_form": "higher", "memory": "lower",
                      "relative_difference": "lower"},
        "config": config,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "machine": platform.machine(),
    }  # fmt: skip
    print(f"{config.samples} samples of {config.body}, {config.dtype}, "
          f"{report['threads']} threads, {len(seconds[CLOSED])} repeats")  # fmt: skip
    print(f"{'':>26} {'ms, median':>11} {'quartiles':>17} {'peak MiB':>9} {'added':>7}")
    for name, row in report["metrics"]["seconds"].items():
        low, median, high = (1e3 * row[k] for k in ("lower_quartile", "median", "upper_quartile"))
        peak, added = memory[name].values()
        print(f"{name:>26} {median:11.1f} {low:8.1f}-{high:8.1f} {peak:9.0f} {added:7.0f}")
    for name, ratio in ratios.items():
        print(f"{name}: {ratio['median']:.1f} times the closed form's time "
              f"({ratio['lower_quartile']:.1f}-{ratio['upper_quartile']:.1f}); largest relative "
              f"difference {agreement[name]['gradient']:.1e} (gradient), "
              f"{agreement[name]['hessian']:.1e} (Hessian)")  # fmt: skip
    if config.out is not None:
        prepare_output_folder(config.out.parent)
        write_summary(config.out, report)
    return report


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
