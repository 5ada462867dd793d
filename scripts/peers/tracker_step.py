"""One tracker step of fixed shape, its stages, frames to run it on, and its compilation."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple
from unittest.mock import patch

import numpy as np
import torch
from peers.fixed_step import FixedStepState, fixed_step, refill, scaled_draw, start
from torch import Tensor
from torch._dynamo.utils import counters
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from torchcss.body.model import BodyPose
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.fused.engine import fused_engine
from torchcss.cost.joints import JointTerm
from torchcss.cost.total import TrackingCost
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.kernels import compiler
from torchcss.studies.reprojection import reprojection_problem
from torchcss.types import Keypoints, LocalModel, Status

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
        image: The keypoints alone.
        prior: The priors alone.
        mean: The mode that each sample is drawn about.
        factor: A factor of its covariance.
        noise: Standard normal numbers.
    """

    cost: TrackingCost
    image: TrackingCost
    prior: TrackingCost
    mean: Tensor
    factor: Tensor
    noise: Tensor


class _Given(NamedTuple):
    """A cost that is known already, as far as a step asks for it."""

    model: LocalModel

    def local_model(self, _: Tensor) -> LocalModel:
        """The same everywhere."""
        return self.model


def _draw(frame: FrameData, state: FixedStepState, fresh: Tensor, scale: float) -> FixedStepState:
    return refill(state, fresh, scaled_draw(frame.mean, frame.factor, frame.noise, scale))


def _see(frame: FrameData, state: FixedStepState, _: Tensor, __: float) -> LocalModel:
    return frame.image.local_model(state.x)


def _know(frame: FrameData, state: FixedStepState, _: Tensor, __: float) -> LocalModel:
    return frame.prior.local_model(state.x)


def _plan(frame: FrameData, state: FixedStepState, _: Tensor, __: float) -> tuple[Any, Tensor]:
    given: Any = _Given(state.model)
    return fixed_step(given, state, frame.cost.body.bounds)


def _pose(frame: FrameData, state: FixedStepState, _: Tensor, __: float) -> BodyPose:
    return frame.cost.body.pose(state.x)


STAGES: dict[str, Callable[[FrameData, FixedStepState, Tensor, float], Any]] = {
    "drawing": _draw,
    "keypoints": _see,
    "priors": _know,
    "planning": _plan,
}
"""The stages of a step by themselves, each from the state before the step."""


def tracker_step(
    frame: FrameData, state: FixedStepState, fresh: Tensor, deviation_scale: float
) -> tuple[FixedStepState, Tensor]:
    """Draw where a place is fresh; then evaluate, accept or refuse, and plan for all."""
    drawn = _draw(frame, state, fresh, deviation_scale)
    return fixed_step(frame.cost, drawn, frame.cost.body.bounds)


class Arithmetic(TorchDispatchMode):
    """Counts the floating-point operations of torch's calls, in `total`.

    Two for each number of a product's left factor that is not zero and column of the right one, a
    third of n^3 for a Cholesky factor, n^2 for a triangular solution, one for every number that
    comes out of a function of single numbers (`addcmul`: two) or goes into a sum. What is copied,
    chosen, compared or laid out anew counts nothing.
    """

    total = 0.0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.overloadpacket.__name__
        if name in ("mm", "bmm"):
            self.total += 2 * int(args[0].count_nonzero()) * args[1].shape[-1]
        elif name == "linalg_cholesky_ex":
            self.total += args[0].numel() * args[0].shape[-1] / 3
        elif name == "linalg_solve_triangular":
            self.total += args[1].numel() * args[1].shape[-2]
        elif torch.Tag.reduction in func.tags:
            self.total += args[0].numel() * args[0].is_floating_point()
        elif torch.Tag.pointwise in func.tags and name not in ("where", "clone", "copy_"):
            times = 2 if name.startswith("addcmul") else 1
            self.total += times * result.numel() * result.is_floating_point()
        return result


def operations(work: Work) -> dict[str, float]:
    """Floating-point operations a sample of every stage, as `STAGES` stand in torch, and of `all`.

    Args:
        work: What eager steps have worked on.
    """
    found = {}
    for name, stage in {**STAGES, "pose": _pose}.items():
        # Else poses are found by a compiled kernel, which is no call of torch.
        with patch.object(compiler, "AVAILABLE", False), Arithmetic() as counted:
            work.call(stage)
        found[name] = counted.total / (len(work.states) * len(work.fresh))
    found["priors"] -= found.pop("pose")  # those of the keypoints
    return {**found, "all": sum(found.values())}


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
        image = replace(cost, choice=choice.only(["joints"]))
        prior = replace(cost, choice=choice.without("joints"))
        yield FrameData(cost, image, prior, mean, factor, noise)


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

    def call(self, step: Callable[..., Any]) -> list[Any]:
        """Call a step, or a stage of one, for every pool; states stay as they are."""
        return [step(self.frame, state, self.fresh, self.scale) for state in self.states]

    def iterate(self, step: Step) -> None:
        """One iteration of every sample; the first draws them."""
        self.states = [state for state, _ in self.call(step)]
        self.fresh = torch.zeros_like(self.fresh)


def compile_whole(function: Callable[..., Any]) -> Callable[..., Any]:
    """A step or stage as one graph of tensors of fixed shapes; kernels have names in profiles."""
    options: dict[str, Any] = {"cpp.enable_kernel_profile": True}
    return torch.compile(function, fullgraph=True, dynamic=False, options=options)


def compile_step(frames: Iterator[FrameData], scale: float) -> tuple[Step, dict[str, Any]]:
    """Compile, and compare with eager in three iterations of each of two frames.

    Whatever is compiled after the first call raises, as does a graph that breaks.
    """
    torch._dynamo.reset()
    counters.clear()
    compiled: Step = compile_whole(tracker_step)
    took, apart = {}, {}
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
