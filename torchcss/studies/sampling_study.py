"""The sampling study of section 7 [IJRR]: one run of a sampler, and what is said of it.

`run_sampler` searches a problem of `torchcss.studies.reprojection` from its start mode with a
proposal and sums the run up in a `SamplerRun`; `depth_flips` names the limbs that its minima lean
the other way in depth.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import Proposal
from torchcss.linalg import squared_mahalanobis
from torchcss.studies.minima import FoundMinima, find_minima, joined_minima, other_minima
from torchcss.studies.reprojection import ReprojectionProblem
from torchcss.types import Modes, Vector

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
    axis = problem.camera.R_camera_world[2].to(x)
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
) -> SamplerRun:
    """Search a problem from its start mode, and sum up what was found.

    Args:
        problem: What to search.
        proposal: Where samples go; without the mode itself, as a rule.
        num_samples: How many.
        generator: Source of the samples.
        distance: Threshold of `distinct_modes`.
    """
    start, bounds, cost = problem.start, problem.bounds, problem.cost
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


def num_shared(
    first: FoundMinima, second: FoundMinima, start: Modes, *, distance: float = 1.0
) -> int:
    """How many minima of one run another one found too.

    Two minima are the same where they are closer than a threshold in the metric of either; the
    tests by which a run tells its own minima apart are `other_minima`.

    Args:
        first: The run whose minima are looked for.
        second: The run among whose minima they are looked for.
        start: What both started from.
        distance: The threshold, standard deviations.
    """
    mine, theirs = (
        GaussianMixture(
            found.modes.mean[found.minima],
            found.modes.covariance[found.minima],
            start.cost.new_zeros(len(found.minima)),
        )
        for found in (first, second)
    )
    if not len(mine.mean) or not len(theirs.mean):
        return 0
    apart = torch.minimum(mine.squared_distance(theirs.mean).mT, theirs.squared_distance(mine.mean))
    return int((apart.amin(-1) <= distance**2).sum())
