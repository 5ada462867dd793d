"""One tracker step of fixed shape: frames to run it on, its compilation, and a comparison."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from peers.fixed_step import FixedStepState, fixed_step, refill, scaled_draw, start
from torch import Tensor
from torch._dynamo.utils import counters
from torch._inductor.utils import fresh_inductor_cache
from torch.profiler import ProfilerActivity, profile

from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.fused.engine import fused_engine
from torchcss.cost.joints import JointTerm
from torchcss.cost.total import TrackingCost
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.studies.reprojection import reprojection_problem
from torchcss.types import Keypoints, Status

FRAME_INTERVAL = 1 / 25
NUM_MODES = 3
LIBRARY = ("linalg_cholesky_ex", "linalg_solve_triangular", "aten::bmm", "aten::mm", "aten::addmm")
"""Calls of a linear algebra library, which compiling does not change."""
Step = Callable[..., tuple[Any, Tensor]]
"""From a frame, a state of a kind, fresh places and a scale to state and what was accepted."""


class FrameData(NamedTuple):
    """What a frame brings; tensors have one row per place of the pool.

    Attributes:
        cost: Keypoints, sticky and temporal priors.
        mean: The mode that each sample is drawn about.
        factor: A factor of its covariance.
        noise: Standard normal numbers.
    """

    cost: TrackingCost
    mean: Tensor
    factor: Tensor
    noise: Tensor


def tracker_step(
    frame: FrameData, state: FixedStepState, fresh: Tensor, deviation_scale: float
) -> tuple[FixedStepState, Tensor]:
    """Draw where a place is fresh; then evaluate, accept or refuse, and plan for all."""
    drawn = scaled_draw(frame.mean, frame.factor, frame.noise, deviation_scale)
    return fixed_step(frame.cost, refill(state, fresh, drawn), frame.cost.body.bounds)


def fused_step(dtype: Literal["float32", "float64"]) -> Step | None:
    """The same as the search does it on a CPU: compiled kernels, and the trust region's step.

    No item ends, so that every iteration is one evaluation and one plan of all. None: there are no
    kernels here.
    """
    engine = fused_engine(dtype)
    newton = TrustRegionNewton()

    def step(frame: FrameData, state: Any, fresh: Tensor, scale: float) -> tuple[Any, Tensor]:
        cost = replace(frame.cost, engine=engine)
        drawn = scaled_draw(frame.mean, frame.factor, frame.noise, scale)
        if isinstance(state, FixedStepState):
            state = newton.start(drawn)
        state, info = newton.step(cost, state, cost.body.bounds)
        running = torch.full_like(state.status, int(Status.RUNNING))
        return state._replace(status=running), info.accepted

    return None if engine is None else step


def make_frames(body_name: str, pool: int, like: Tensor, seed: int) -> Iterator[FrameData]:
    """Frame after frame: other keypoints, other modes, other draws, in the type of a tensor."""
    generator = torch.Generator().manual_seed(seed)
    problem = reprojection_problem(body_name, generator=generator)
    cost = problem.cost
    body, camera, seen = cost.body.to(like), cost.camera.to(like), cost.target
    factor = torch.linalg.cholesky(problem.start.covariance).to(like)
    factor = factor.expand(pool, -1, -1).contiguous()
    choice = CostChoice().without("contour").having(JointTerm())
    motion = FRAME_INTERVAL * body.motion_rate
    while True:
        uv = (seen + torch.randn(seen.shape, generator=generator)).to(like)
        observation = Keypoints(uv, torch.ones_like(uv[:, 0]), problem.joint_names)
        modes = torch.randn(NUM_MODES, len(motion), generator=generator).to(like)
        modes = problem.start.mean.to(like) + 0.5 * motion * modes
        mean = modes[torch.arange(pool, device=like.device) % NUM_MODES]
        noise = torch.randn(mean.shape, generator=generator).to(like)
        view = FrameContext(body=body, camera=camera, keypoints=observation, deviation=motion)
        alike = torch.eye(len(motion)).to(mean).expand(len(mean), -1, -1)
        parents = Prior.of(GaussianMixture(mean, alike, mean.new_zeros(len(mean))))
        cost = TrackingCost(choice=choice, views=(view,))
        cost = cost.of_children(torch.arange(len(mean), device=mean.device), parents)
        yield FrameData(cost, mean, factor, noise)


def difference(
    ours: tuple[FixedStepState, Tensor], other: tuple[FixedStepState, Tensor]
) -> dict[str, float]:
    """Largest differences of two results, relative to the largest number of their kind.

    Items that were accepted in one and refused in the other are counted and left out. Steps are
    measured in the metric of the damped Hessian (W = 1), in which the rounding of a weak direction
    counts for what it costs.
    """
    (a, accepted), (b, also) = ours, other
    same = accepted == also
    found = {"decided_otherwise": float((~same).double().mean())}
    pairs = {"x": (a.x, b.x), "predicted": (a.predicted, b.predicted)}
    pairs |= {name: (getattr(a.model, name), getattr(b.model, name)) for name in b.model._fields}
    for name, (one, two) in pairs.items():
        found[name] = float((one - two)[same].abs().max() / two[same].abs().max())
    matrix = b.model.hessian[same].double()
    matrix = matrix + torch.diag_embed(b.damping[same, None].expand_as(b.x[same])).double()
    apart, length = (
        (v * (matrix @ v[..., None])[..., 0]).sum(-1).clamp(min=0).max().sqrt()
        for v in ((a.step - b.step)[same].double(), b.step[same].double())
    )
    return found | {"step": float(apart / length)}


class Work:
    """So many samples of a frame in pools, and their states."""

    def __init__(self, frame: FrameData, samples: int, scale: float) -> None:
        self.frame, self.scale = frame, scale
        self.fresh = torch.ones_like(frame.mean[:, 0], dtype=torch.bool)
        self.states: list[Any] = [
            start(frame.mean) for _ in range(math.ceil(samples / len(frame.mean)))
        ]

    def iterate(self, step: Step) -> None:
        """One iteration of every sample; the first draws them."""
        self.states = [step(self.frame, s, self.fresh, self.scale)[0] for s in self.states]
        self.fresh = torch.zeros_like(self.fresh)


def compile_step(
    frames: Iterator[FrameData], scale: float, *, cached: bool
) -> tuple[Step, dict[str, Any]]:
    """Compile, and compare with eager in three iterations of each of two frames.

    Whatever is compiled after the first call raises, as does a graph that breaks.
    """
    torch._dynamo.reset()
    counters.clear()
    # Named kernels show up in the profiler's tables.
    options: dict[str, Any] = {"cpp.enable_kernel_profile": True}
    compiled: Step = torch.compile(tracker_step, fullgraph=True, dynamic=False, options=options)
    took, apart = {}, {}
    with nullcontext() if cached else fresh_inductor_cache():
        for frame in (next(frames), next(frames)):
            work = Work(frame, 1, scale)
            for _ in range(3):
                arguments = (frame, work.states[0], work.fresh, scale)
                wall, cpu = time.perf_counter(), time.process_time()
                with torch._dynamo.config.patch(error_on_recompile=bool(took)):
                    ours = compiled(*arguments)
                took = took or {
                    "wall_s": time.perf_counter() - wall,
                    "cpu_s": time.process_time() - cpu,
                }
                for name, value in difference(ours, tracker_step(*arguments)).items():
                    apart[name] = max(value, apart.get(name, 0.0))
                work.states, work.fresh = [ours[0]], torch.zeros_like(work.fresh)
    graphs = counters["stats"]["unique_graphs"]
    return compiled, {"compile": took, "graphs": graphs, "relative_difference": apart}


def profiled(work: Work, step: Step, trace: Path, num_rows: int) -> tuple[dict[str, float], str]:
    """Peak memory and share of library calls in an iteration, and the table; writes the trace."""
    gpu = work.fresh.is_cuda
    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * gpu
    if gpu:
        torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated() if gpu else 0
    with profile(activities=activities, profile_memory=True) as profiler:
        work.iterate(step)
    profiler.export_chrome_trace(str(trace))
    rows, unit = profiler.key_averages(), "device" if gpu else "cpu"
    times = {row.key: getattr(row, f"self_{unit}_time_total") for row in rows}
    library = sum(time for key, time in times.items() if any(name in key for name in LIBRARY))
    if gpu:
        peak = torch.cuda.max_memory_allocated() - before
    else:
        events = json.loads(trace.read_text())["traceEvents"]
        changes = [event for event in events if event["name"] == "[memory]"]
        changes.sort(key=lambda event: event["ts"])
        peak = max(np.cumsum([event["args"]["Bytes"] for event in changes]), default=0)
    table = rows.table(sort_by=f"self_{unit}_time_total", row_limit=num_rows)
    share = library / max(sum(times.values()), 1e-9)
    return {"memory_mib": float(peak) / 2**20, "library_share": share}, table
