"""The priors about the parent mode (one for all, or one for each) and about the whole mixture."""

from __future__ import annotations

import math

import pytest
import torch

from torchcss.cost.stabiliser import long_tailed
from torchcss.cost.temporal import MixturePrior, TemporalPrior
from torchcss.cost.term import differentiate_twice
from torchcss.inference.dynamics import Diffusion
from torchcss.inference.mixture import GaussianMixture


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_derivatives_are_those_of_autograd(
    own: bool, batch: tuple[int, ...], generator: torch.Generator
) -> None:
    n = 5
    x = torch.randn(*batch, n, generator=generator, dtype=torch.float64)
    parent = torch.randn(*(batch if own else ()), n, generator=generator, dtype=torch.float64)
    deviation = 0.05 + torch.rand(n, generator=generator, dtype=torch.float64)
    deviation[1] = math.inf
    leaf = x.clone().requires_grad_()
    z = (leaf - parent) / deviation
    expected = differentiate_twice(2.0 * torch.log1p(z.square() / 4.0).sum(-1), leaf)
    got = long_tailed(x, parent, deviation, TemporalPrior.nu)
    assert got.value.shape == batch
    for ours, theirs in zip(got, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-10)


def make_mixture(n: int, generator: torch.Generator) -> GaussianMixture:
    root = torch.randn(3, n, n, generator=generator, dtype=torch.float64)
    mean = torch.randn(3, n, generator=generator, dtype=torch.float64)
    weight = torch.rand(3, generator=generator, dtype=torch.float64)
    covariance = root @ root.mT + 0.1 * torch.eye(n, dtype=torch.float64)
    return GaussianMixture(mean, covariance, weight.log().log_softmax(0))


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_mixture_against_the_library_and_autograd(
    batch: tuple[int, ...], generator: torch.Generator
) -> None:
    n, nu = 4, 5.0
    mixture = make_mixture(n, generator)
    leaf = (2 * torch.randn(*batch, n, generator=generator, dtype=torch.float64)).requires_grad_()
    modes = torch.distributions.MultivariateNormal(mixture.mean, mixture.covariance)
    height = modes.log_prob(mixture.mean) + mixture.log_weight
    density = modes.log_prob(leaf[..., None, :]) + mixture.log_weight - height.max()
    floor = density.new_full((*batch, 1), -nu)
    expected = differentiate_twice(-torch.cat([density, floor], -1).logsumexp(-1), leaf)
    prior = MixturePrior(nu=nu)
    got = prior.local_model(leaf.detach(), prior.density(mixture))
    assert got.value.shape == batch
    for ours, theirs in zip(got, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_far_from_every_mode(dtype: torch.dtype, generator: torch.Generator) -> None:
    """No pull, the height of the tails; frozen parameters with no variance do no harm."""
    mixture = make_mixture(3, generator)
    frozen = mixture.covariance.clone()
    frozen[:, 1], frozen[:, :, 1] = 0.0, 0.0
    prior = MixturePrior(nu=6.0)
    mixture = GaussianMixture(mixture.mean, frozen, mixture.log_weight)
    density = prior.density(GaussianMixture(*(part.to(dtype) for part in mixture)))
    for size in (1e3, 1e30):
        model = prior.local_model(torch.full((2, 3), size, dtype=dtype), density)
        for part in model:
            assert part.dtype == dtype
            assert torch.isfinite(part).all()
        torch.testing.assert_close(model.value, torch.full((2,), 6.0, dtype=dtype))
        assert not model.gradient.any()


def test_what_no_image_shows_drifts_apart_as_a_random_walk() -> None:
    """Fifty blank frames: each posterior is its prior, the posterior before and the motion."""
    motion, n = 0.14, 3
    dynamics, prior = Diffusion(deviation=motion), MixturePrior(nu=40.0)
    mean, weight = torch.zeros(1, n).double(), torch.zeros(1).double()
    covariance = 0.01**2 * torch.eye(n).double()[None]
    for _ in range(50):
        ahead = dynamics.predict(GaussianMixture(mean, covariance, weight), mean)
        covariance = prior.local_model(mean, prior.density(ahead)).hessian.inverse()
    walked = (0.01**2 + 50 * motion**2) ** 0.5
    deviation = covariance[0].diagonal().sqrt()
    torch.testing.assert_close(deviation, torch.full_like(deviation, walked), rtol=1e-9, atol=0)
    assert (prior.height(n), MixturePrior().height(n)) == (40.0, n)
