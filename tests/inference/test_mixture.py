import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcss.errors import ShapeError
from torchcss.inference.mixture import (
    GaussianMixture,
    bhattacharyya,
    distinct_modes,
    draw_components,
    match_to_prior,
    prior_at,
    representatives,
    separated,
    tempered,
)


def random_mixture(
    k: int, n: int, *, generator: torch.Generator, size: float = 1.0
) -> GaussianMixture:
    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    root = draw(k, n, n)
    covariance = size * (root @ root.mT + 0.1 * torch.eye(n).double())
    return GaussianMixture(5 * size**0.5 * draw(k, n), covariance, draw(k)).normalise()


@settings(max_examples=25, deadline=None)
@given(
    k=st.integers(1, 6),
    size=st.sampled_from([1e-12, 1.0, 1e12]),
    offset=st.floats(-1e5, 1e5),
    seed=st.integers(0, 2**31),
)
def test_weights_sum_to_one(k, size, offset, seed):
    mixture = random_mixture(k, 3, generator=torch.Generator().manual_seed(seed), size=size)
    shifted = mixture._replace(log_weight=mixture.log_weight + offset)
    for result in (shifted.normalise(), shifted.prune(2)):
        assert float(result.log_weight.exp().sum()) == pytest.approx(1)
    assert shifted.prune(2).log_weight.tolist() == sorted(
        shifted.prune(2).log_weight.tolist(), reverse=True
    )


def test_weights_far_below_the_smallest_number_keep_their_order():
    weight = torch.tensor([-1e6, -1e6 - 3.0, -torch.inf])
    mixture = GaussianMixture(torch.zeros(3, 2), torch.eye(2).expand(3, 2, 2), weight)
    torch.testing.assert_close(mixture.weight[0] / mixture.weight[1], torch.tensor(math.exp(3)))
    nothing = mixture._replace(log_weight=torch.full((3,), -torch.inf))
    torch.testing.assert_close(nothing.weight, torch.full((3,), 1 / 3))


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_log_density_is_that_of_torch(batch, generator):
    mixture = random_mixture(4, 3, generator=generator)
    x = 5 * torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    components = torch.distributions.MultivariateNormal(mixture.mean, mixture.covariance)
    twin = torch.distributions.MixtureSameFamily(
        torch.distributions.Categorical(logits=mixture.log_weight), components
    )
    torch.testing.assert_close(mixture.log_density(x), twin.log_prob(x))


def test_sample_moments(generator):
    mixture, num = random_mixture(3, 2, generator=generator), 20000
    x, component = mixture.sample(num, generator=generator)
    mean, covariance = mixture.moments()
    deviation = covariance.diagonal().sqrt()
    assert bool(((x.mean(0) - mean).abs() < 5 * deviation / num**0.5).all())
    # Four standard errors; the kurtosis of a mixture this wide is below 6.
    product = (x - mean)[:, :, None] * (x - mean)[:, None, :]
    error = product.std(0) / num**0.5
    assert bool(((product.mean(0) - covariance).abs() < 5 * error).all())
    share = torch.bincount(component, minlength=3) / num
    assert bool(((share - mixture.weight).abs() < 5 * 0.5 / num**0.5).all())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_singular_mixture(dtype, generator):
    covariance = torch.diag(torch.tensor([1.0, 0.0], dtype=dtype)).expand(2, 2, 2)
    mixture = GaussianMixture(
        torch.tensor([[0.0, 1.0], [0.0, 2.0]], dtype=dtype), covariance, torch.zeros(2).to(dtype)
    )
    x, component = mixture.sample(100, generator=generator)
    assert torch.equal(x[:, 1], mixture.mean[component, 1])
    assert bool(bhattacharyya(mixture, mixture).diagonal().isfinite().all())
    assert not bool(mixture.log_density(x).isnan().any())
    assert match_to_prior(mixture, mixture).parent.tolist() == [0, 1]


def test_stratified_components_get_their_share(generator):
    weight = torch.tensor([0.5, 0.3, 0.2, 0.0]).log()
    drawn = draw_components(weight, 100, generator=generator, stratified=True)
    counts = torch.bincount(drawn, minlength=4)
    assert bool(((counts - torch.tensor([50, 30, 20, 0])).abs() <= 1).all())
    assert int(draw_components(weight, 1000, generator=generator).max()) < 3
    assert draw_components(weight, 0, generator=generator).shape == (0,)


def planted(generator: torch.Generator):
    """Known modes, each found many times with a small error, in random order."""
    truth = random_mixture(5, 4, generator=generator)
    truth = truth._replace(mean=50 * truth.mean)
    which = torch.arange(5).repeat(40)[torch.randperm(5 * 40, generator=generator)]
    error = 0.01 * torch.randn(len(which), 4, generator=generator, dtype=torch.float64)
    cost = which + 1e-4 * torch.rand(len(which), generator=generator, dtype=torch.float64)
    return truth, truth.mean[which] + error, truth.covariance[which], cost, which


@pytest.mark.parametrize("distance", [0.3, 1.0, 3.0])
def test_known_modes_are_recovered_whatever_the_threshold(distance, generator):
    _, mean, covariance, cost, which = planted(generator)
    kept = distinct_modes(mean, covariance, cost, distance=distance)
    assert which[kept].tolist() == [0, 1, 2, 3, 4]
    best = [float(cost[which == i].min()) for i in range(5)]
    assert cost[kept].tolist() == best
    for most in (1, 3, 10):
        few = distinct_modes(mean, covariance, cost, distance=distance, most=most)
        assert torch.equal(few, kept[:most])


def test_order_of_candidates_is_irrelevant(generator):
    _, mean, covariance, cost, _ = planted(generator)
    order = torch.randperm(len(mean), generator=generator)
    kept = distinct_modes(mean, covariance, cost)
    again = distinct_modes(mean[order], covariance[order], cost[order])
    assert torch.equal(order[again], kept)


def test_only_finite_candidates_are_modes(generator):
    _, mean, covariance, _, _ = planted(generator)
    cost = torch.full((len(mean),), torch.inf).double()
    assert len(distinct_modes(mean, covariance, cost)) == 0
    cost[3] = 1.0
    assert distinct_modes(mean, covariance, cost).tolist() == [3]


def test_bhattacharyya_as_printed(generator):
    a, b = (random_mixture(k, 3, generator=generator) for k in (2, 4))
    printed = bhattacharyya(a, b)
    for i in range(2):
        for j in range(4):
            total = a.covariance[i] + b.covariance[j]
            d = a.mean[i] - b.mean[j]
            squared = d @ torch.linalg.solve(total / 2, d)
            root = (a.covariance[i].det() * b.covariance[j].det()).sqrt()
            expected = squared + 0.5 * (total.det() / root).log()
            torch.testing.assert_close(printed[i, j], expected)
    with pytest.raises(ShapeError, match="3 and 2 parameters"):
        bhattacharyya(a, random_mixture(1, 2, generator=generator))


def test_matching_multiplies_and_uses_a_prior_mode_once():
    def mixture(mean, weight):
        mean = torch.tensor(mean).double()[:, None]
        return GaussianMixture(
            mean, torch.ones(len(mean), 1, 1).double(), torch.tensor(weight).double().log()
        )

    prior = mixture([0.0, 10.0, 99.0], [0.6, 0.3, 0.1])
    posterior = mixture([0.1, 9.0, 0.2, 50.0], [0.4, 0.3, 0.2, 0.1])
    got = match_to_prior(posterior, prior)
    # The third is closest to a component already used; the fourth finds none.
    assert got.parent.tolist() == [0, 1, 2, -1]
    weight = torch.tensor([0.4 * 0.6, 0.3 * 0.3, 0.2 * 0.1, 0.1 * 0.1]).double()
    weighted = posterior._replace(log_weight=posterior.log_weight + got.log_weight)
    torch.testing.assert_close(weighted.weight, weight / weight.sum())
    empty = prior._replace(log_weight=torch.tensor([0.0, -torch.inf, -torch.inf]).double())
    assert match_to_prior(posterior, empty).parent.tolist() == [0, -1, -1, -1]


def test_densities_of_many_states_at_once(generator):
    """The density of thousands of states is worked off in parts."""
    mixture = random_mixture(3, 2, generator=generator)
    x = 5 * torch.randn(2500, 2, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(mixture.log_density(x)[::500], mixture.log_density(x[::500]))
    assert mixture.log_density(x[:0]).shape == (0,)


def separated_one_by_one(landmarks: torch.Tensor, distance: float, num: int) -> list[int]:
    """The definition, mode by mode in plain numbers."""
    modes = landmarks.tolist()

    def apart(a: int, b: int) -> float:
        return max(math.dist(p, q) for p, q in zip(modes[a], modes[b], strict=True))

    best: list[int] = []
    for mode in range(len(modes)):
        if all(apart(mode, other) >= distance for other in best):
            best.append(mode)
    best = best[:num]
    others = [mode for mode in range(len(modes)) if mode not in best]
    return sorted(best + others[: num - len(best)])


@settings(max_examples=60, deadline=None)
@given(
    k=st.integers(1, 12),
    points=st.integers(1, 3),
    num=st.integers(1, 14),
    distance=st.sampled_from([0.0, 0.5, 1.5, 4.0, 100.0]),
    single_precision=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_separated_is_its_definition(k, points, num, distance, single_precision, seed):
    drawn = torch.Generator().manual_seed(seed)
    dtype = torch.float32 if single_precision else torch.float64
    landmarks = 2 * torch.randn(k, points, 3, generator=drawn, dtype=dtype)
    chosen = separated(landmarks, distance, num)
    assert chosen.dtype == torch.long
    assert chosen.tolist() == separated_one_by_one(landmarks, distance, num)
    assert len(chosen) == min(k, num)
    # The best is always among them.
    assert int(chosen[0]) == 0


def test_representatives_are_the_best_members():
    landmarks = torch.tensor([0.0, 0.9, 1.8, 3.0, 3.1, 9.0])[:, None, None]
    chosen = torch.tensor([0, 3, 5])
    # The second is like the first alone; the third like none of those chosen, and stands for none.
    score = torch.tensor([-2.0, -1.0, 7.0, -1.0, -2.0, -3.0])
    assert representatives(landmarks, 1.0, chosen, score).tolist() == [1, 3, 5]
    assert representatives(landmarks, 1.0, chosen, -score).tolist() == [0, 4, 5]
    # What is like two of them belongs to the first.
    assert representatives(landmarks, 2.0, chosen, score).tolist() == [2, 3, 5]
    # Modes that were chosen stand for themselves, however alike they are.
    assert representatives(landmarks, 2.0, torch.tensor([0, 1, 2]), score).tolist() == [0, 1, 2]
    # The worst of all scores is still a score.
    worst = torch.full((6,), -torch.inf)
    assert representatives(landmarks, 0.5, chosen, worst).tolist() == [0, 3, 5]


def test_separated_of_alike_modes_keeps_the_best():
    landmarks = torch.tensor([0.0, 0.1, 0.2, 3.0, 3.1, 9.0])[:, None, None]
    assert separated(landmarks, 1.0, 3).tolist() == [0, 3, 5]
    # Places left go to the best of the others.
    assert separated(landmarks, 1.0, 4).tolist() == [0, 1, 3, 5]
    assert separated(landmarks[:3], 1.0, 2).tolist() == [0, 1]
    assert separated(landmarks[:0], 1.0, 2).tolist() == []


@settings(max_examples=30, deadline=None)
@given(power=st.sampled_from([1e-3, 0.1, 0.7, 1.0]), seed=st.integers(0, 2**31))
def test_tempered_is_the_mode_of_a_tempered_likelihood(power, seed):
    """Likelihood to a power times the prior, by the precisions."""
    drawn = torch.Generator().manual_seed(seed)
    n = 4
    prior = 0.1 + torch.rand(n, generator=drawn, dtype=torch.float64)
    root = torch.randn(n, 2, generator=drawn, dtype=torch.float64)
    # Two directions that the image sees, two that it does not.
    likelihood = root @ root.T
    precision = torch.diag(1 / prior)
    covariance = (likelihood + precision).inverse()
    expected = (power * likelihood + precision).inverse()
    got = tempered(covariance.expand(3, n, n), power, prior)
    torch.testing.assert_close(got, expected.expand(3, n, n), rtol=1e-8, atol=1e-10)
    # Never narrower than before, never wider than the prior.
    assert float(torch.linalg.eigvalsh(got[0] - covariance).min()) > -1e-10
    assert float(torch.linalg.eigvalsh(torch.diag(prior) - got[0]).min()) > -1e-10
    prior_alone = torch.diag(prior)
    torch.testing.assert_close(tempered(prior_alone, power, prior), prior_alone)


def prior_at_one_by_one(
    posterior: GaussianMixture, prior: GaussianMixture, surprise: float
) -> list[float]:
    """The definition, mode by mode."""
    n = posterior.mean.shape[-1]
    logs = []
    for mean, covariance in zip(posterior.mean, posterior.covariance, strict=True):
        total = 0.0
        for pi, centre, spread in zip(prior.weight, prior.mean, prior.covariance, strict=True):
            apart = mean - centre
            squared = float(apart @ torch.linalg.solve(covariance + spread, apart))
            total += float(pi) * math.exp(-min(n, surprise) * min(squared / (2 * n), 1))
        logs.append(math.log(total))
    return logs


@settings(max_examples=40, deadline=None)
@given(
    k=st.integers(1, 6),
    m=st.integers(1, 6),
    n=st.integers(1, 8),
    surprise=st.sampled_from([0.5, 3.4, math.inf]),
    seed=st.integers(0, 2**31),
)
def test_prior_at_is_its_definition(k, m, n, surprise, seed):
    drawn = torch.Generator().manual_seed(seed)
    posterior = random_mixture(k, n, generator=drawn)
    prior = random_mixture(m, n, generator=drawn)
    past = prior_at(posterior, prior, surprise)
    expected = torch.tensor(prior_at_one_by_one(posterior, prior, surprise)).double()
    torch.testing.assert_close(past.log_weight, expected, rtol=1e-6, atol=1e-6)
    # Modes do not compete: what one inherits does not depend on the others, or on any order.
    order = torch.randperm(k, generator=drawn)
    again = prior_at(posterior.take(order), prior.take(torch.arange(m).flip(0)), surprise)
    torch.testing.assert_close(again.log_weight, past.log_weight[order])
    near = past.parent[order] >= 0
    assert torch.equal(again.parent >= 0, near)
    assert torch.equal(m - 1 - again.parent[near], past.parent[order][near])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_prior_at_of_what_goes_on_and_of_what_is_new(dtype):
    prior = GaussianMixture(
        torch.tensor([[0.0, 0.0], [4.0, 0.0], [50.0, 0.0]], dtype=dtype),
        torch.diag(torch.tensor([0.1, 0.0], dtype=dtype)).expand(3, 2, 2),
        torch.tensor([0.0, -3.0, -torch.inf], dtype=dtype),
    )
    log_total = prior.log_weight.logsumexp(0)
    posterior = GaussianMixture(
        torch.tensor([[0.0, 0.0], [0.0, 0.0], [4.0, 0.0], [50.0, 0.0], [2.0, 0.0]], dtype=dtype),
        torch.zeros(5, 2, 2, dtype=dtype),
        torch.zeros(5, dtype=dtype),
    )
    past = prior_at(posterior, prior)
    # The second parameter is held: it does not vary, and says nothing.
    assert past.parent.tolist() == [0, 0, 1, -1, -1]
    expected = torch.stack(
        [
            torch.tensor([0.0, -5.0], dtype=dtype).logsumexp(0),
            torch.tensor([0.0, -5.0], dtype=dtype).logsumexp(0),
            torch.tensor([-2.0, -3.0], dtype=dtype).logsumexp(0),
            log_total - 2,  # who has no weight gives none
            log_total - 2,
        ]
    )
    torch.testing.assert_close(past.log_weight, expected - log_total)
    # A prior without any weight is one of equal weights.
    empty = prior._replace(log_weight=torch.full((3,), -torch.inf, dtype=dtype))
    assert bool(prior_at(posterior, empty).log_weight.isfinite().all())
    # Where it does vary, a held parameter that moves is very far.
    moved = posterior._replace(mean=posterior.mean + torch.tensor([0.0, 0.1], dtype=dtype))
    assert prior_at(moved, prior).parent.tolist() == [-1] * 5


@pytest.mark.parametrize("compare", [prior_at, match_to_prior])
def test_mixtures_over_different_states_are_told(compare, generator):
    two, three = (random_mixture(2, n, generator=generator) for n in (2, 3))
    with pytest.raises(ShapeError, match="same state, got 2 and 3 parameters"):
        compare(two, three)
