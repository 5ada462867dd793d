"""The sampling study of section 7 [IJRR]: problems, one run of a sampler, and what is said of it.

The problem is that of `torchcss.studies.reprojection` with the freedom that Table 1 [IJRR] leaves:
noise, how far the priors reach, which joints are seen, limits, robustness. `run_sampler` searches
it from its start mode with a proposal and sums the run up in a `SamplerRun`; `depth_flips` names
the limbs that its minima lean the other way in depth.

What to call: `study_problem`, then `run_sampler`.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.inference.proposals import Proposal
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.linalg import squared_mahalanobis
from torchcss.robust import Lorentzian, Quadratic
from torchcss.studies.minima import FoundMinima, find_minima, joined_minima, other_minima
from torchcss.studies.reprojection import ReprojectionProblem, reprojection_problem
from torchcss.types import (
    Bounds,
    CostFunction,
    Items,
    LocalModel,
    Numbers,
    Vector,
    Vectors,
    frozen,
)

CLICKED_JOINTS = (
    "HumanoidRoot", "vt1", "skull_tip", "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow",
    "r_wrist", "l_hip", "l_knee", "l_ankle", "r_hip", "r_knee", "r_ankle",
)  # fmt: skip
"""What one would click: the ends of trunk, head and limbs."""

SEGMENTS = {
    "trunk": ("HumanoidRoot", "vt1"),
    "head": ("vt1", "skull_tip"),
    "l_upper_arm": ("l_shoulder", "l_elbow"),
    "r_upper_arm": ("r_shoulder", "r_elbow"),
    "l_forearm": ("l_elbow", "l_wrist"),
    "r_forearm": ("r_elbow", "r_wrist"),
    "r_hand": ("r_wrist", "r_hand_tip"),
    "l_thigh": ("l_hip", "l_knee"),
    "r_thigh": ("r_hip", "r_knee"),
    "l_shank": ("l_knee", "l_ankle"),
    "r_shank": ("r_knee", "r_ankle"),
}
"""Segments that can lean towards the camera or away from it, and their ends."""

LEAST_LEAN = 0.01
"""Metres in depth between a segment's ends within which it leans neither way."""

ROBUST_NU = 8.0
"""Level of the outliers of the robust variant, nats per joint."""


@dataclass(frozen=True)
class ExactSteps:
    """A cost whose descents take exact Hessians from the first step on.

    The optimiser damps the second-order parts of a cost that can do without them while it is far
    from a minimum. That takes half as many steps and leads past small minima, into basins that the
    start was not in: the right thing for a tracker, and a confusion where basins are counted.

    Attributes:
        cost: The same for all states.
    """

    cost: CostFunction

    def value(self, x: Vectors) -> Numbers:
        """Cost in nats."""
        return self.cost.value(x)

    def local_model(self, x: Vectors) -> LocalModel:
        """Cost, gradient and exact Hessian."""
        return self.cost.local_model(x)

    def take(self, items: Items) -> ExactSteps:
        """The cost of some items."""
        return ExactSteps(self.cost.take(items))


class Lengths(NamedTuple):
    """How far states are from the start, and what they cost.

    Attributes:
        distance: Euclidean, in the parameters (radians, metres).
        deviations: In the metric of the start's covariance.
        cost: Nats above the start's.
    """

    distance: Float[Tensor, " s"]
    deviations: Float[Tensor, " s"]
    cost: Float[Tensor, " s"]


class SamplerRun(NamedTuple):
    """One run of a sampler.

    Attributes:
        found: Samples, descents, tests and minima.
        raw: Of the samples.
        ends: Of the ends of their descents.
        minima: Of the minima.
        num_half: Minima when the duplicate distance is halved.
        num_double: Minima when it is doubled.
        num_valleys: Minima when those joined by low paths count as one.
        flips: How many minima lean each segment the other way, by name.
        seconds: For samples, descents and tests.
    """

    found: FoundMinima
    raw: Lengths
    ends: Lengths
    minima: Lengths
    num_half: int
    num_double: int
    num_valleys: int
    flips: dict[str, int]
    seconds: float


@frozen
class StudyChoice:
    """What the problem of a study is like.

    Attributes:
        pixel_noise: Standard deviation of every image coordinate, pixels.
        prior_scale: Factor on the deviations of the stabilisers, which are a tracker's. The pose
            is drawn with the factor one.
        widest: Largest standard deviation of a parameter of the start mode; by default the
            optimiser's, a quarter of its range.
        limits: Whether the joint limits hold.
        robust: Lorentzian reprojection error instead of a quadratic one.
        all_joints: All joint centres but those of face and foot are seen, not `CLICKED_JOINTS`
            alone; an arm shows all that it has.
    """

    pixel_noise: float = 3.0
    prior_scale: float = 1.0
    widest: float | None = None
    limits: bool = True
    robust: bool = False
    all_joints: bool = False


def study_problem(
    body_name: str = "body34",
    *,
    generator: torch.Generator,
    choice: StudyChoice | None = None,
    pose: dict[str, float] | None = None,
) -> ReprojectionProblem:
    """Make a problem of the study.

    Args:
        body_name: A body of the catalogue.
        generator: Source of the pose and of the noise.
        choice: What it is like.
        pose: Parameters by name instead of a pose drawn; the others are zero.

    Returns:
        The problem; its body, cost, bounds and start agree with the choice.

    Raises:
        BodyError: If the body has no such parameter.
    """
    choice = choice or StudyChoice()
    problem = reprojection_problem(
        body_name,
        generator=generator,
        pixel_noise=choice.pixel_noise,
        potential=Lorentzian(nu=ROBUST_NU, sigma=ROBUST_NU**0.5) if choice.robust else Quadratic(),
        joint_names=None if choice.all_joints or body_name.startswith("arm") else CLICKED_JOINTS,
    )
    cost, truth, bounds = problem.cost, problem.truth, problem.bounds
    cost.body.sticky_deviation.mul_(choice.prior_scale)
    if pose is not None:
        noise = cost.target - _project(problem, truth)
        truth = torch.zeros_like(truth)
        truth[cost.body.state_columns(pose)] = truth.new_tensor([*pose.values()])
        truth = cost.body.bounds.project(truth)
        cost = replace(cost, target=_project(problem, truth) + noise)
    if not choice.limits:
        infinite = torch.full_like(bounds.lower, math.inf)
        bounds = Bounds(-infinite, infinite)
    variance = None if choice.widest is None else torch.full_like(truth, choice.widest**2)
    start = TrustRegionNewton(max_steps=1000).minimise(cost, truth, bounds, prior_variance=variance)
    return problem._replace(truth=truth, cost=cost, bounds=bounds, start=start)


def _project(problem: ReprojectionProblem, x: Vector) -> Float[Tensor, "j 2"]:
    joints = problem.cost.body.pose(x).joints[problem.cost.index]
    return problem.cost.camera.project(joints).uv


def depth_flips(problem: ReprojectionProblem, x: Float[Tensor, "m n"]) -> dict[str, int]:
    """How many states lean each segment the other way in depth than the start.

    Towards the camera instead of away from it, or back: the forward-backward flips of [IJRR].

    Args:
        problem: Body, camera and start.
        x: States, such as the minima found.

    Returns:
        Numbers by the segment's name, the most frequent first; zeros are left out.
    """
    body = problem.cost.body
    axis = problem.cost.camera.R_camera_world[2].to(x)
    depth, at_start = (body.pose(state).joints @ axis for state in (x, problem.start.mean))
    counts = {}
    for name, ends in SEGMENTS.items():
        if all(end in body.joint_names for end in ends):
            near, far = (body.joint_index(end) for end in ends)
            now, then = (z[..., far] - z[..., near] for z in (depth, at_start))
            leaning = torch.minimum(now.abs(), then.abs()) > LEAST_LEAN
            counts[name] = int((leaning & (now * then < 0)).sum())
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return {name: count for name, count in ordered if count}


def spectrum(covariance: Float[Tensor, "n n"]) -> Vector:
    """Standard deviations along a covariance's eigenvectors, the widest first (Fig. 5 [IJRR])."""
    return torch.linalg.eigvalsh(covariance).clamp(min=0).sqrt().flip(0)


def run_sampler(
    problem: ReprojectionProblem,
    proposal: Proposal,
    num_samples: int,
    *,
    generator: torch.Generator,
    distance: float = 1.0,
    exact_steps: bool = True,
) -> SamplerRun:
    """Search a problem from its start mode, and sum up what was found.

    Args:
        problem: What to search.
        proposal: Where samples go; without the mode itself, as a rule.
        num_samples: How many.
        generator: Source of the samples.
        distance: Threshold of `distinct_modes`.
        exact_steps: See `ExactSteps`.
    """
    start, bounds = problem.start, problem.bounds
    cost = ExactSteps(problem.cost) if exact_steps else problem.cost
    clock = time.perf_counter()
    found = find_minima(
        cost, start, bounds, proposal=proposal, num_samples=num_samples, generator=generator,
        distance=distance,
    )  # fmt: skip
    seconds = time.perf_counter() - clock
    modes, minima = found.modes, found.minima
    half, double = (
        len(other_minima(modes, found.tests, start, distance=factor * distance))
        for factor in (0.5, 2.0)
    )
    label = joined_minima(
        cost,
        torch.cat([start.mean[None], modes.mean[minima]]),
        torch.cat([start.covariance[None], modes.covariance[minima]]),
        torch.cat([start.cost[None], modes.cost[minima]]),
        bounds,
    )
    return SamplerRun(
        found=found,
        raw=_lengths(problem, found.raw, cost.value(found.raw)),
        ends=_lengths(problem, modes.mean, modes.cost),
        minima=_lengths(problem, modes.mean[minima], modes.cost[minima]),
        num_half=half,
        num_double=double,
        num_valleys=len(label.unique()) - 1,
        flips=depth_flips(problem, modes.mean[minima]),
        seconds=seconds,
    )


def _lengths(problem: ReprojectionProblem, x: Tensor, cost: Tensor) -> Lengths:
    apart = x - problem.start.mean
    deviations = squared_mahalanobis(apart, problem.start.covariance).sqrt()
    return Lengths(apart.norm(dim=-1), deviations, cost - problem.start.cost)
