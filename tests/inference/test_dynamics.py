"""A frame that comes late is predicted as if those before it had been there and shown nothing."""

from __future__ import annotations

import pytest
import torch

from torchcss.inference.dynamics import ConstantVelocity, Diffusion
from torchcss.inference.mixture import GaussianMixture

MIXTURE = GaussianMixture(
    torch.tensor([[0.0, 1.0]]).double(), 0.1 * torch.eye(2).double()[None], torch.zeros(1).double()
)
VELOCITY = torch.tensor([[0.5, -1.0]]).double()


@pytest.mark.parametrize("persistence", [0.0, 0.8, 1.0])
@pytest.mark.parametrize("deviation", [0.3, (0.3, 2.0)])
def test_over_several_intervals_is_one_after_another(
    persistence: float, deviation: float | tuple[float, ...]
) -> None:
    dynamics = ConstantVelocity(deviation=deviation, persistence=persistence)
    found = dynamics.over(3).predict(MIXTURE, VELOCITY)
    expected, velocity = MIXTURE, VELOCITY
    for _ in range(3):
        after = dynamics.predict(expected, velocity)
        expected, velocity = after, after.mean - expected.mean
    torch.testing.assert_close(found, expected)


def test_variances_of_a_random_walk_grow_with_time() -> None:
    for intervals in (0.5, 2.0):
        found = Diffusion(deviation=(1.0, 3.0)).over(intervals).predict(MIXTURE, VELOCITY)
        torch.testing.assert_close(found.mean, MIXTURE.mean)
        motion = (found.covariance - MIXTURE.covariance)[0].diagonal()
        torch.testing.assert_close(motion, intervals * torch.tensor([1.0, 9.0]).double())


def test_half_an_interval_twice_is_one() -> None:
    dynamics = ConstantVelocity(persistence=0.64)
    half = dynamics.over(0.5).predict(MIXTURE, VELOCITY).mean - MIXTURE.mean
    # Of its velocity a mode keeps 0.8 in half an interval.
    whole = dynamics.predict(MIXTURE, VELOCITY).mean - MIXTURE.mean
    torch.testing.assert_close(half + 0.8 * half, whole)
