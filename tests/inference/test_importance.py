import problems
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcss.inference.importance import (
    fair_samples,
    normalised_log_weight,
    posterior_log_weight,
    survival,
    tempered_log_weight,
)
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.inference.proposals import CovarianceScaled, EigenDirectionGrid, Samples

PRIOR = GaussianMixture(
    torch.tensor([[0.0, 0.0]]).double(),
    torch.tensor([[[1.0, 0.3], [0.3, 0.5]]]).double(),
    torch.zeros(1).double(),
)
LIKELIHOOD = problems.Bowl(
    torch.tensor([[3.0, 0.0], [0.0, 1.0]]).double(), torch.tensor([1.0, -0.5]).double()
)
FREE = problems.unbounded(2)


def test_the_posterior_of_a_gaussian_is_recovered(generator):
    num = 60000
    wide = CovarianceScaled(covariance_scale=4)
    samples = wide.sample(PRIOR, num, FREE, generator=generator)
    log_weight = posterior_log_weight(samples, LIKELIHOOD)
    information = torch.linalg.inv(PRIOR.covariance[0]) + LIKELIHOOD.hessian
    covariance = torch.linalg.inv(information)
    mean = covariance @ (LIKELIHOOD.hessian @ LIKELIHOOD.minimum)
    got = fair_samples(samples, log_weight, num, generator=generator)
    error = 5 / float(survival(log_weight).effective_sample_size) ** 0.5
    deviation = covariance.diagonal().sqrt()
    assert bool(((got.x.mean(0) - mean).abs() < error * deviation).all())
    apart = (torch.cov(got.x.T) - covariance).abs()
    assert bool((apart < 2 * error * deviation[:, None] * deviation).all())
    assert bool((got.log_weight == 0).all())


@pytest.mark.parametrize("n", [2, 8, 34])
def test_survival_of_scaled_covariances_is_the_one_on_the_page(n, generator):
    """(15 / 64)^(n / 2) for s = 8; in 34 dimensions a single sample has nearly all the weight."""
    mixture = GaussianMixture(
        torch.zeros(1, n).double(), torch.eye(n).double()[None], torch.zeros(1).double()
    )
    proposal = CovarianceScaled(covariance_scale=8, include_modes=False)
    free = problems.unbounded(n)
    num = 100000 if n < 34 else 5000
    log_weight = proposal.sample(mixture, num, free, generator=generator).log_weight
    if n < 34:
        expected = (15 / 64) ** (n / 2)
        assert float(survival(log_weight).survival_rate) == pytest.approx(expected, rel=0.2)
    else:
        assert float(survival(log_weight).effective_sample_size) < 5


@settings(max_examples=40, deadline=None)
@given(
    num=st.integers(1, 50),
    spread=st.sampled_from([0.0, 1.0, 1e3, 1e12]),
    offset=st.floats(-1e6, 1e6),
    seed=st.integers(0, 2**31),
)
def test_weights_and_survival_whatever_their_size(num, spread, offset, seed):
    generator = torch.Generator().manual_seed(seed)
    log_weight = offset + spread * torch.randn(num, generator=generator, dtype=torch.float64)
    assert float(normalised_log_weight(log_weight).exp().sum()) == pytest.approx(1)
    order = torch.randperm(num, generator=generator)
    result, again = survival(log_weight), survival(log_weight[order])
    for a, b in zip(result, again, strict=True):
        torch.testing.assert_close(a, b)
    assert 1 - 1e-9 <= float(result.effective_sample_size) <= num + 1e-9
    tempered, power = tempered_log_weight(log_weight, 0.5)
    assert 0 <= power <= 1
    assert float(survival(tempered).survival_rate) >= 0.5 - 1e-6
    if power < 1:
        assert float(survival(tempered).survival_rate) == pytest.approx(0.5, abs=0.02)


def test_equal_weights_survive_whole():
    assert float(survival(torch.zeros(1000).double()).survival_rate) == pytest.approx(1)


def test_no_weight_at_all():
    nothing = torch.full((4,), -torch.inf).double()
    assert [float(x) for x in survival(nothing)] == [0.0, 0.0]
    assert normalised_log_weight(nothing).exp().tolist() == pytest.approx([0.25] * 4)
    assert [float(x) for x in survival(nothing[:0])] == [0.0, 0.0]


def test_patterns_and_failures_have_no_weight(generator):
    pattern = EigenDirectionGrid().sample(PRIOR, 5, FREE, generator=generator)
    assert bool(posterior_log_weight(pattern, LIKELIHOOD).isneginf().all())

    class Holes(problems.Bowl):
        def value(self, x):
            return torch.where(x[..., 0] > 0, super().value(x), torch.nan)

    samples = CovarianceScaled(covariance_scale=2).sample(PRIOR, 50, FREE, generator=generator)
    log_weight = posterior_log_weight(samples, Holes(LIKELIHOOD.hessian, LIKELIHOOD.minimum))
    assert not bool(log_weight.isnan().any())
    assert bool(log_weight[samples.x[:, 0] <= 0].isneginf().all())
    fair = fair_samples(samples, log_weight, 20, generator=generator)
    assert isinstance(fair, Samples)
    assert bool((fair.x[:, 0] > 0).all())


def test_fair_samples_keep_what_their_parents_are_and_where_they_were_drawn(generator):
    jump = Prior(PRIOR._replace(mean=PRIOR.mean + 5), torch.zeros(1, dtype=torch.long))
    places = torch.arange(6.0).double().reshape(3, 2)
    parent = torch.tensor([0, 1, 1])
    samples = Samples(places, parent, torch.zeros(3).double(), jump, places + 0.5)
    fair = fair_samples(samples, samples.log_weight, 12, generator=generator)
    assert fair.jumps is jump
    assert sorted(set(fair.parent.tolist())) == [0, 1]
    assert fair.drawn is not None
    assert torch.equal(fair.drawn, fair.x + 0.5)
