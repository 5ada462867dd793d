"""What is not known of the frame before, in the covariances of this one."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import problems
import pytest
import torch
from torch import Tensor

from torchcss.cost.temporal import MixturePrior
from torchcss.inference.dynamics import Diffusion
from torchcss.inference.marginal import information_of_past
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import CovarianceScaled
from torchcss.inference.tracker import Tracker
from torchcss.linalg import multiply
from torchcss.types import LocalModel

N = 3
UNITS = torch.full((N,), 4.0).double()


def random_information(generator, *batch: int, rank: int = N):
    root = torch.randn(*batch, N, rank, generator=generator, dtype=torch.float64)
    return root @ root.mT


def by_elimination(seen, motion, before, noise):
    """Inverse covariance of x_t, from the Hessian of the pair."""
    link = noise.inverse() + motion
    pair = torch.cat(
        [
            torch.cat([before.inverse() + link, -link], -1),
            torch.cat([-link, seen + link], -1),
        ],
        -2,
    )
    return pair.inverse()[..., N:, N:].inverse()


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_it_is_the_marginal_of_the_pair(batch, generator):
    seen, motion = (random_information(generator, *batch, rank=r) for r in (1, 2))
    before, noise = (random_information(generator, *batch) for _ in range(2))
    told = information_of_past(motion, before, noise, UNITS)
    want = by_elimination(seen, motion, before, noise)
    torch.testing.assert_close(seen + told, want, rtol=1e-9, atol=1e-9)


def test_ends_of_the_scale(generator):
    """No flow is the prior; a flow that knows all leaves what was not known; nothing moves."""
    zero = torch.zeros(N, N).double()
    before, noise = (random_information(generator) for _ in range(2))
    close = partial(torch.testing.assert_close, rtol=1e-5, atol=1e-5)
    told = information_of_past(zero, before, noise, UNITS)
    close(told, (before + noise).inverse())
    told = information_of_past(1e12 * torch.eye(N).double(), before, noise, UNITS)
    close(told, before.inverse())
    told = information_of_past(random_information(generator), before, zero, UNITS)
    close(told, before.inverse())
    # Negative curvature is no knowledge, and what is known exactly stays so.
    told = information_of_past(-torch.eye(N).double(), before, noise, UNITS)
    close(told, (before + noise).inverse())
    assert information_of_past(zero, zero, zero, UNITS).isfinite().all()


def at_zero() -> GaussianMixture:
    covariance = 0.01 * torch.eye(N).double()
    return GaussianMixture(torch.zeros(1, N).double(), covariance[None], torch.zeros(1).double())


@dataclass(frozen=True)
class Odometry(problems.Alike):
    """Linear measurements of the state, zero, and of its motion, zero, after one mode."""

    seen: Tensor
    flow: Tensor
    prior: GaussianMixture
    parts: tuple[str, ...] = ("seen", "flow", "past")

    def local_model(self, x):
        temporal, models = MixturePrior(nu=1e4), []
        for part in self.parts:
            if part == "past":
                models.append(temporal.local_model(x, temporal.density(self.prior)))
            else:
                apart = x if part == "seen" else x - self.prior.mean[0]
                matrix = getattr(self, part).expand(*x.shape, N)
                pull = multiply(matrix, apart)
                models.append(LocalModel(0.5 * (apart * pull).sum(-1), pull, matrix))
        return LocalModel(*(torch.stack(fields).sum(0) for fields in zip(*models, strict=True)))

    def value(self, x):
        return self.local_model(x).value

    def problem(self):
        def children(_, prior):
            cost = replace(self, prior=prior.mixture)
            past, flow = (replace(cost, parts=(part,)) for part in ("past", "flow"))
            return SearchProblem(cost, past=past, motion=flow)

        return SearchProblem(self, of_children=children)


def test_a_tracker_states_what_a_filter_of_odometry_states(generator):
    """Twenty frames: one direction is seen, two are told by flow alone and drift away."""
    noise, flow = 0.3, torch.diag(torch.tensor([40.0, 100.0, 400.0])).double()
    seen = torch.diag(torch.tensor([25.0, 0.0, 0.0])).double()
    tracker = Tracker(
        proposal=CovarianceScaled(covariance_scale=1.0),
        dynamics=Diffusion(deviation=noise),
        num_samples=1,
        num_modes=1,
        soft_matching=True,
    )
    start = at_zero()
    frame = Odometry(seen, flow, start).problem()
    known = start.covariance[0]
    state = tracker.init(start, generator=generator)
    bounds = problems.box(N, -1e2, 1e2)
    for now, _ in problems.follow(tracker, state, [frame] * 20, bounds):
        known = by_elimination(seen, flow, known, noise**2 * torch.eye(N).double()).inverse()
        torch.testing.assert_close(now.mixture.covariance[0], known, rtol=1e-6, atol=0)
    # Each frame adds what dynamics and flow together leave open.
    walked = 0.01 + 20 / (noise**-2 + 100.0)
    assert float(known[1, 1]) == pytest.approx(walked, rel=1e-7)


def test_flow_alone_leaves_a_mode_without_a_parent_as_it_is(generator):
    """Nothing led there, so that nothing of the frame before is in its covariance."""
    start = at_zero()
    tracker = Tracker(
        proposal=CovarianceScaled(covariance_scale=1.0),
        num_samples=1,
        num_modes=1,
        soft_matching=True,
    )
    seen, flow = 1e6 * torch.eye(N).double(), torch.zeros(N, N).double()
    cost = Odometry(seen, flow, start, ("seen",))
    state = tracker.init(start._replace(mean=start.mean + 5.0), generator=generator)
    frame = SearchProblem(cost, past=replace(cost, parts=("past",)), motion=cost)
    state, info = tracker.step(state, frame, problems.box(N, -1e2, 1e2))
    assert info.parent.tolist() == [-1]
    torch.testing.assert_close(state.mixture.covariance[0], seen.inverse(), rtol=1e-6, atol=0)
