"""Microseconds per evaluation of the whole cost: fused engine, eager engine and autograd.

    python scripts/benchmark_engines.py --sequence ../shared/data/balance_beam_4cam --view cam01

A few frames are tracked with all default terms; of the last one the states that the search visited
are kept, with the modes that they came from. At these states value, gradient and Hessian are
evaluated by every engine in turn, in pools of several sizes, and the processor time of this thread
is taken; ratios are taken within a repeat. Printed are medians over repeats. The first line says by
how much the engines differ. The fused engine's value alone stands beside them, and its value with
the visibility and the matches of the pool's first state.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from common import Table, finish, start
from torch import Tensor

from torchcss.cli.options import SettingsOptions
from torchcss.cost.fused.engine import FusedEngine
from torchcss.cost.total import TrackingCost
from torchcss.studies.comparison import find_start, track_together
from torchcss.studies.evaluation import Thresholds
from torchcss.studies.sequences import read_sequence
from torchcss.tracking.settings import Settings
from torchcss.types import Curvature, LocalModel, Numbers, Vectors, frozen

SETTINGS = Settings()


@frozen
class Config:
    """What to track and how often to measure."""

    settings: SettingsOptions = SETTINGS
    """How to track."""
    sequence: Path
    """Folder of a recorded sequence."""
    view: str | None = None
    """Its camera, where it has several."""
    frames: int = 4
    """Frames to track; the states are those of the last."""
    pools: tuple[int, ...] = (60, 7)
    """States evaluated at a time."""
    repeats: int = 15
    """Repeats; in each all engines take turns."""
    autograd: int = 7
    """States that autograd is timed on; with 0 it is left out."""
    out: Path | None = None
    """JSON file to write."""


class RecordingEngine:
    """An engine that evaluates eagerly and keeps what it was asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[TrackingCost, Tensor]] = []

    def value(self, cost: TrackingCost, x: Vectors) -> Numbers:
        """See `TrackingCost.value`."""
        return replace(cost, engine=None).value(x)

    def local_model(self, cost: TrackingCost, x: Vectors) -> LocalModel:
        """See `TrackingCost.local_model`."""
        self.asked.append((replace(cost, engine=None), x))
        return replace(cost, engine=None).local_model(x)


def visited(config: Config) -> tuple[TrackingCost, Tensor]:
    """The whole cost of the last frame, for the states visited there."""
    recorder, sequence = RecordingEngine(), read_sequence(config.sequence, view=config.view)
    settings = config.settings
    begin = find_start(sequence, settings)
    with patch("torchcss.tracking.settings.make_engine", lambda _: recorder):
        list(track_together(sequence, [(settings, begin)], Thresholds(), stop=config.frames))
    most = max(len(cost.choice.terms) for cost, _ in recorder.asked)
    whole = [(cost, x) for cost, x in recorder.asked if len(cost.choice.terms) == most]
    last = [(cost, x) for cost, x in whole if cost.views[0] is whole[-1][0].views[0]]

    def joined(name: str) -> Tensor | None:
        parts = [getattr(cost, name) for cost, _ in last]
        return None if parts[0] is None else torch.cat(parts)

    cost = replace(last[0][0], parent=joined("parent"), component=joined("component"))
    x = torch.cat([x for _, x in last])
    order = torch.randperm(len(x), generator=torch.Generator().manual_seed(0))
    return cost.take(order), x[order]


def from_first(cost: TrackingCost, x: Tensor) -> Tensor:
    """Cost with the visibility and the matches of the first state."""
    return cost.held_value(x, x[:1].expand_as(x))


def microseconds(evaluate: Callable[[Tensor], Any], x: Tensor) -> float:
    """Processor time of one evaluation, the mean of a call."""
    began = time.thread_time()
    evaluate(x)
    return 1e6 * (time.thread_time() - began) / len(x)


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    torch.set_num_threads(1)
    cost, x = visited(config)
    print(f"{cost.body.name}, {len(x)} states visited, terms: "
          f"{', '.join(term.name for term in cost.choice.terms)}")  # fmt: skip
    by_autograd = replace(cost.choice, curvature=Curvature.AUTOGRAD)
    fused = replace(cost, engine=FusedEngine("float32"))
    engines = {
        "eager": cost,
        "fused": fused,
        "fused, float64": replace(cost, engine=FusedEngine("float64")),
        "fused, value": fused,
        "fused, value, matches held": fused,
    }
    asked = {"fused, value": TrackingCost.value, "fused, value, matches held": from_first}
    if config.autograd:
        engines["autograd"] = replace(cost, choice=by_autograd)
    rows, eager = [], cost.local_model(x)
    for name in ("fused", "fused, float64"):
        apart = (engines[name].local_model(x).value - eager.value).abs()
        print(f"{name}: {apart.max():.1e} nats from eager at most, {apart.median():.1e} as a rule")
    for pool in config.pools:
        sizes = {name: pool if name != "autograd" else config.autograd for name in engines}
        ways = {name: engines[name].take(torch.arange(size)) for name, size in sizes.items()}
        ask = {name: asked.get(name, TrackingCost.local_model) for name in engines}
        for name, way in ways.items():
            ask[name](way, x[: sizes[name]])
        rounds = []
        for repeat in range(config.repeats):
            states = x.roll(repeat * pool, 0)
            ways = {
                name: engines[name].take(torch.arange(len(x)).roll(repeat * pool)[:size])
                for name, size in sizes.items()
                if name != "autograd" or repeat < 3
            }
            rounds.append({n: microseconds(partial(ask[n], w), states[: sizes[n]])
                           for n, w in ways.items()})  # fmt: skip
        for name in engines:
            taken = [times[name] for times in rounds if name in times]
            ratio = [times[name] / times["fused"] for times in rounds if name in times]
            row = {"engine": name, "pool": sizes[name], "beside": pool}
            row |= {"microseconds": float(np.median(taken)), "of_fused": float(np.median(ratio))}
            rows.append(row)
    columns = ("engine", "pool", "beside", "microseconds", "times the fused engine")
    table = Table("Evaluations of the whole cost", columns, [list(row.values()) for row in rows])
    report = {"rows": rows, "config": config, "torch": torch.__version__}
    return finish(config.out, report, table)


if __name__ == "__main__":
    start(main, Config, __doc__)
