import math
import sys
from pathlib import Path

import pytest
import torch

from torchcss.errors import ConfigurationError
from torchcss.inference.dynamics import ConstantVelocity, Diffusion
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import (
    CovarianceScaled,
    EigenDirectionGrid,
    HeavyTailed,
    Spherical,
)

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import problems

FREE = problems.unbounded(2)
COVARIANCE = torch.tensor([[4.0, 1.0], [1.0, 0.5]]).double()
ONE = GaussianMixture(
    torch.tensor([[1.0, -2.0]]).double(), COVARIANCE[None], torch.zeros(1).double()
)
TWO = GaussianMixture(
    torch.tensor([[1.0, -2.0], [8.0, 0.0]]).double(),
    COVARIANCE.expand(2, 2, 2),
    torch.tensor([0.25, 0.75]).double().log(),
)
RANDOM = [
    CovarianceScaled(covariance_scale=8),
    HeavyTailed(covariance_scale=4),
    Spherical(deviation_scale=2),
]
ALL = [*RANDOM, EigenDirectionGrid()]


@pytest.mark.parametrize("kind", [CovarianceScaled, HeavyTailed, Spherical])
@pytest.mark.parametrize(
    "scales",
    [{}, {"covariance_scale": 4, "deviation_scale": 2}, {"covariance_scale": 0}],
)
def test_exactly_one_positive_scale(kind, scales):
    with pytest.raises(ConfigurationError, match="exactly one positive scale"):
        kind(**scales)


@pytest.mark.parametrize(
    ("proposal", "expected"),
    [
        (CovarianceScaled(covariance_scale=9, include_modes=False), 9 * COVARIANCE),
        (CovarianceScaled(deviation_scale=3, include_modes=False), 9 * COVARIANCE),
        (
            HeavyTailed(degrees_of_freedom=9, covariance_scale=2, include_modes=False),
            2 * 9 / 7 * COVARIANCE,
        ),
        (
            Spherical(deviation_scale=1, include_modes=False),
            float(COVARIANCE.det()) ** 0.5 * torch.eye(2).double(),
        ),
        (
            CovarianceScaled(covariance_scale=1, max_deviation=(1.0, 9.0), include_modes=False),
            COVARIANCE * torch.tensor([[0.25, 0.5], [0.5, 1.0]]).double(),
        ),
    ],
)
def test_moments(proposal, expected, generator):
    num = 40000
    x, _ = proposal.sample(ONE, num, FREE, generator=generator)
    deviation = expected.diagonal().sqrt()
    assert bool(((x.mean(0) - ONE.mean[0]).abs() < 5 * deviation / num**0.5).all())
    product = (x - ONE.mean)[:, :, None] * (x - ONE.mean)[:, None, :]
    error = product.std(0) / num**0.5
    assert bool(((product.mean(0) - expected).abs() < 5 * error).all())


@pytest.mark.parametrize("proposal", ALL)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bounds_modes_and_repeatability(proposal, dtype):
    mixture = GaussianMixture(*(x.to(dtype) for x in TWO))
    bounds = problems.box(2, -2.5, 8.5, dtype)
    x, parent = proposal.sample(mixture, 50, bounds, generator=torch.Generator().manual_seed(3))
    again, _ = proposal.sample(mixture, 50, bounds, generator=torch.Generator().manual_seed(3))
    assert torch.equal(x, again)
    assert x.dtype == dtype
    assert bool(((x >= bounds.lower) & (x <= bounds.upper)).all())
    for mode in mixture.mean:
        assert bool((x == mode).all(-1).any())
    assert torch.equal(x[0], mixture.mean[1]), "the best mode comes first"
    assert parent[0] == 1
    few, _ = proposal.sample(mixture, 1, bounds, generator=torch.Generator())
    assert torch.equal(few, mixture.mean[1:])


def test_samples_are_shared_by_weight(generator):
    proposal = CovarianceScaled(covariance_scale=4, include_modes=False, stratified=True)
    _, parent = proposal.sample(TWO, 100, FREE, generator=generator)
    assert abs(int((parent == 1).sum()) - 75) <= 1


def test_grid_is_the_reports_pattern(generator):
    covariance = torch.diag(torch.tensor([1.0, 16.0, 4.0, 9.0]).double())
    mixture = GaussianMixture(torch.zeros(1, 4).double(), covariance[None], torch.zeros(1).double())
    bounds = problems.unbounded(4)
    x, _ = EigenDirectionGrid().sample(mixture, 100, bounds, generator=generator)
    assert x.shape == (7, 4)
    assert x.abs().sum(0).tolist() == [0.0, 8.0, 4.0, 6.0]
    torch.testing.assert_close(x.sum(0), torch.zeros(4).double())
    wide = EigenDirectionGrid(num_directions=1, num_steps=2, deviation_scale=3)
    x, _ = wide.sample(mixture, 100, bounds, generator=generator)
    assert sorted(x[:, 1].tolist()) == [-24.0, -12.0, 0.0, 12.0, 24.0]


def test_a_mode_without_spread_stays(generator):
    point = ONE._replace(covariance=torch.zeros(1, 2, 2).double())
    for proposal in ALL:
        x, _ = proposal.sample(point, 20, FREE, generator=generator)
        torch.testing.assert_close(x, ONE.mean.expand_as(x), rtol=0, atol=1e-6)


def test_dynamics():
    velocity = torch.tensor([[1.0, 2.0], [0.0, 0.0]]).double()
    still = Diffusion(deviation=(0.1, 2.0)).predict(TWO, velocity)
    added = still.covariance - TWO.covariance
    torch.testing.assert_close(
        added, torch.diag(torch.tensor([0.01, 4.0]).double()).expand(2, 2, 2)
    )
    assert torch.equal(still.mean, TWO.mean)
    moved = ConstantVelocity(persistence=0.5).predict(TWO, velocity)
    torch.testing.assert_close(moved.mean, TWO.mean + 0.5 * velocity)
    assert torch.equal(moved.covariance, TWO.covariance)
    assert math.isclose(float(moved.weight.sum()), 1)
