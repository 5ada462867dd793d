import itertools
import math
from dataclasses import dataclass

import problems
import pytest
import scipy.optimize
import scipy.stats
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcss.errors import ConfigurationError
from torchcss.inference.dynamics import ConstantVelocity, Diffusion
from torchcss.inference.importance import fair_samples
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import (
    ChamRehg,
    Condensation,
    CovarianceScaled,
    EigenDirectionGrid,
    HeavyTailed,
    InflatedPosterior,
    MixtureOfProposals,
    Move,
    Spherical,
    project_in_metric,
    with_moves,
)
from torchcss.types import Bounds

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
    Condensation(deviation=(3.0, 1.0)),
    ChamRehg(deviation=0.5),
    InflatedPosterior(covariance_scale=4, deviation=0.3, correlated_projection=True),
    MixtureOfProposals(
        proposals=(
            CovarianceScaled(covariance_scale=1),
            HeavyTailed(covariance_scale=4, include_modes=False),
            EigenDirectionGrid(num_directions=1),
        ),
        shares=(0.5, 0.3, 0.2),
    ),
]
"""Every one that draws at random, wider than the mixture, so that its weights have a variance."""
ALL = [*RANDOM, EigenDirectionGrid()]


@pytest.mark.parametrize("kind", [CovarianceScaled, HeavyTailed, Spherical, InflatedPosterior])
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
        (
            Condensation(deviation=(0.5, 2.0), include_modes=False),
            torch.diag(torch.tensor([0.25, 4.0]).double()),
        ),
        (
            ChamRehg(deviation=0.5, include_modes=False),
            COVARIANCE + 0.25 * torch.eye(2).double(),
        ),
        (
            InflatedPosterior(covariance_scale=4, deviation=0.5, include_modes=False),
            4 * COVARIANCE + 0.25 * torch.eye(2).double(),
        ),
    ],
)
def test_moments(proposal, expected, generator):
    num = 40000
    x, *_ = proposal.sample(ONE, num, FREE, generator=generator)
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
    x, parent, *_ = proposal.sample(mixture, 50, bounds, generator=torch.Generator().manual_seed(3))
    again, *_ = proposal.sample(mixture, 50, bounds, generator=torch.Generator().manual_seed(3))
    assert torch.equal(x, again)
    assert x.dtype == dtype
    assert bool(((x >= bounds.lower) & (x <= bounds.upper)).all())
    for mode in mixture.mean:
        assert bool((x == mode).all(-1).any())
    assert torch.equal(x[0], mixture.mean[1]), "the best mode comes first"
    assert parent[0] == 1
    few, *_ = proposal.sample(mixture, 1, bounds, generator=torch.Generator())
    assert torch.equal(few, mixture.mean[1:])


def test_samples_are_shared_by_weight(generator):
    proposal = CovarianceScaled(covariance_scale=4, include_modes=False, stratified=True)
    _, parent, *_ = proposal.sample(TWO, 100, FREE, generator=generator)
    assert abs(int((parent == 1).sum()) - 75) <= 1


def test_grid_is_the_reports_pattern(generator):
    covariance = torch.diag(torch.tensor([1.0, 16.0, 4.0, 9.0]).double())
    mixture = GaussianMixture(torch.zeros(1, 4).double(), covariance[None], torch.zeros(1).double())
    bounds = problems.unbounded(4)
    x, *_ = EigenDirectionGrid().sample(mixture, 100, bounds, generator=generator)
    assert x.shape == (7, 4)
    assert x.abs().sum(0).tolist() == [0.0, 8.0, 4.0, 6.0]
    torch.testing.assert_close(x.sum(0), torch.zeros(4).double())
    wide = EigenDirectionGrid(num_directions=1, num_steps=2, deviation_scale=3)
    x, *_ = wide.sample(mixture, 100, bounds, generator=generator)
    assert sorted(x[:, 1].tolist()) == [-24.0, -12.0, 0.0, 12.0, 24.0]


def test_a_mode_without_spread_stays(generator):
    point = ONE._replace(covariance=torch.zeros(1, 2, 2).double())
    for proposal in (
        CovarianceScaled(covariance_scale=8),
        HeavyTailed(covariance_scale=4),
        Spherical(deviation_scale=2),
        InflatedPosterior(covariance_scale=4),
        ChamRehg(deviation=0.0),
        EigenDirectionGrid(),
    ):
        x, *_ = proposal.sample(point, 20, FREE, generator=generator)
        torch.testing.assert_close(x, ONE.mean.expand_as(x), rtol=0, atol=1e-6)


@pytest.mark.parametrize("proposal", RANDOM)
def test_densities_integrate_to_one(proposal):
    """On a fine grid that holds nearly all of the mass."""
    side = torch.arange(-80, 80, 0.2, dtype=torch.float64)
    density = proposal.log_density(TWO, torch.cartesian_prod(side + 5, side)).exp()
    # A Student t of three degrees leaves some 6e-4 outside; a piecewise normaliser is drawn.
    piecewise = isinstance(proposal, ChamRehg)
    assert float(density.sum()) * 0.04 == pytest.approx(1, abs=2e-2 if piecewise else 2e-3)


def test_densities_are_those_of_scipy(generator):
    x = TWO.mean.mean(0) + 4 * torch.randn(2, 5, 2, generator=generator).double()
    weight = TWO.weight.tolist()

    def mixture(of):
        return sum(w * of(m.numpy()) for w, m in zip(weight, TWO.mean, strict=True))

    got = HeavyTailed(covariance_scale=4, degrees_of_freedom=5).log_density(TWO, x)
    shape = 4 * COVARIANCE.numpy()
    expected = mixture(lambda m: scipy.stats.multivariate_t(m, shape, df=5).pdf(x.numpy()))
    torch.testing.assert_close(got.exp(), torch.from_numpy(expected))
    got = InflatedPosterior(covariance_scale=2).log_density(TWO, x)
    weight = [w**0.5 for w in weight]
    weight = [w / sum(weight) for w in weight]
    normal = scipy.stats.multivariate_normal
    expected = mixture(lambda m: normal(m, 2 * COVARIANCE.numpy()).pdf(x.numpy()))
    torch.testing.assert_close(got.exp(), torch.from_numpy(expected))
    assert bool(EigenDirectionGrid().log_density(TWO, x).isneginf().all())


def test_projection_in_the_metric_is_the_nearest_admissible_state(generator):
    """Against a plain quadratic programme, on correlated Gaussians that leave the box often."""
    root = torch.randn(4, 4, generator=generator, dtype=torch.float64)
    covariance = root @ root.mT + 0.05 * torch.eye(4).double()
    bounds = problems.box(4, -1.0, 1.5)
    x = (2 * torch.randn(60, 4, generator=generator, dtype=torch.float64)) @ root.mT
    got = project_in_metric(x, covariance.expand(60, 4, 4), bounds)
    assert bool(((got >= bounds.lower) & (got <= bounds.upper)).all())
    inside = ((x >= bounds.lower) & (x <= bounds.upper)).all(-1)
    assert torch.equal(got[inside], x[inside])
    information = torch.linalg.inv(covariance).numpy()

    def distance(y, start):
        return (y - start) @ information @ (y - start)

    excess = []
    for start, mine in zip(x.numpy(), got.numpy(), strict=True):
        best = scipy.optimize.minimize(
            distance,
            mine,
            args=(start,),
            bounds=[(-1.0, 1.5)] * 4,
            method="L-BFGS-B",
            options={"ftol": 1e-15, "gtol": 1e-10},
        )
        clamped = distance(start.clip(-1.0, 1.5), start)
        assert distance(mine, start) <= clamped * (1 + 1e-9) + 1e-9
        excess.append(distance(mine, start) / max(best.fun, 1e-9) if best.fun > 1e-6 else 1.0)
    assert max(excess) < 1 + 1e-4


def nearest_admissible(x, covariance, lower, upper):
    """The best of all ways to hold parameters at their bounds."""
    information = torch.linalg.inv(covariance)
    least, best = torch.full_like(x[:, 0], torch.inf), x
    for pattern in itertools.product((-1, 0, 1), repeat=x.shape[-1]):
        at = torch.tensor(pattern)
        free = at == 0
        y = torch.where(free, x, torch.where(at < 0, lower, upper))
        pull = (information @ (y - x)[..., None])[:, free]
        y[:, free] -= torch.linalg.solve(information[:, free][..., free], pull)[..., 0]
        distance = ((y - x) * (information @ (y - x)[..., None])[..., 0]).sum(-1)
        outside = ((y < lower - 1e-9) | (y > upper + 1e-9)).any(-1)
        better = ~outside & (distance < least)
        least, best = torch.where(better, distance, least), torch.where(better[:, None], y, best)
    return best


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("pinned", [[], [0, 2], [1], [0, 1, 2, 3]])
def test_projection_is_the_best_of_all_ways_to_hold_parameters(pinned, dtype, generator):
    """With equal bounds too, and bounds in float64 for states in float32."""
    root = torch.randn(60, 4, 4, generator=generator, dtype=torch.float64)
    covariance = root @ root.mT + 0.05 * torch.eye(4).double()
    x = 3 * torch.randn(60, 4, generator=generator, dtype=torch.float64)
    lower, upper = torch.rand(2, 4, generator=generator, dtype=torch.float64)
    lower = -lower
    lower[pinned] = upper[pinned]
    got = project_in_metric(x.to(dtype), covariance.to(dtype), Bounds(lower, upper))
    assert got.dtype == dtype
    expected = nearest_admissible(x, covariance, lower, upper).to(dtype)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-3 if dtype == torch.float32 else 1e-9)


def test_projection_of_certain_parameters_moves_them_alone():
    singular = torch.diag(torch.tensor([1.0, 0.0]).double())[None]
    x = torch.tensor([[5.0, 7.0]]).double()
    got = project_in_metric(x, singular, problems.box(2, -1, 1))
    assert got.tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize(
    "proposal", [p for p in RANDOM if not getattr(p, "correlated_projection", False)]
)
@pytest.mark.parametrize("bounds", [FREE, problems.box(2, -2.2, 7.0)])
def test_weights_lead_back_to_the_mixture(proposal, bounds, generator):
    """Weighted samples have the moments of the mixture, projected onto the bounds as they are."""
    num = 40000
    samples = proposal.sample(TWO, num, bounds, generator=generator)
    weight = samples.log_weight.exp()
    drawn = weight > 0
    assert float(weight[drawn].mean()) == pytest.approx(
        1, abs=5 * float(weight.std()) / num**0.5 + 0.02 * isinstance(proposal, ChamRehg)
    )
    truth = bounds.project(TWO.sample(400000, generator=generator).x)
    share = weight / weight.sum()
    size = 5 * float(share.square().sum().sqrt() + 400000**-0.5)
    mean = share @ samples.x
    assert bool(((mean - truth.mean(0)).abs() < size * truth.std(0)).all())
    variance = share @ (samples.x - mean).square()
    assert bool(((variance - truth.var(0)).abs() < 2 * size * truth.var(0)).all())
    fair = fair_samples(samples, samples.log_weight, num, generator=generator)
    assert bool(((fair.x.mean(0) - mean).abs() < 5 * fair.x.std(0) / num**0.5).all())


def test_a_mixture_sampled_as_it_is_has_equal_weights(generator):
    fair = CovarianceScaled(covariance_scale=1, include_modes=False)
    assert fair.sample(TWO, 10, FREE, generator=generator).log_weight.tolist() == [0.0] * 10
    modes = CovarianceScaled(covariance_scale=2).sample(TWO, 10, FREE, generator=generator)
    assert modes.log_weight[:2].tolist() == [-torch.inf] * 2
    pattern = EigenDirectionGrid().sample(TWO, 10, FREE, generator=generator)
    assert bool(pattern.log_weight.isneginf().all())


def test_a_member_that_is_the_mixture_bounds_all_weights(generator):
    wild = Condensation(deviation=0.01, include_modes=False)
    fair = CovarianceScaled(covariance_scale=1, include_modes=False)
    members = MixtureOfProposals(proposals=(wild, fair), shares=(3, 1))
    samples = members.sample(TWO, 1000, FREE, generator=generator)
    assert float(samples.log_weight.exp().max()) <= 4 + 1e-9
    alone = wild.sample(TWO, 1000, FREE, generator=generator)
    assert float(alone.log_weight.exp().mean()) < 0.1, "it misses nearly all of the mass"
    counts = [len(members.sample(TWO, n, FREE, generator=generator).x) for n in (0, 1, 2, 7)]
    assert counts == [0, 1, 2, 7]


def test_a_cluster_does_not_take_all_samples_piecewise(generator):
    """Nine modes on top of each other against one far away."""
    mean = torch.cat([TWO.mean[:1].expand(9, 2), TWO.mean[1:] + 40])
    mean = mean + 1e-3 * torch.randn(10, 2, generator=generator).double()
    cluster = GaussianMixture(mean, COVARIANCE.expand(10, 2, 2), torch.zeros(10).double())
    far = {}
    for piecewise in (False, True):
        proposal = ChamRehg(deviation=0.1, piecewise=piecewise, include_modes=False)
        samples = proposal.sample(cluster, 4000, FREE, generator=generator)
        far[piecewise] = float((samples.parent == 9).double().mean())
    assert far[False] == pytest.approx(0.1, abs=5 * (0.1 * 0.9 / 4000) ** 0.5)
    assert far[True] == pytest.approx(0.5, abs=5 * 0.5 / 4000**0.5)


@pytest.mark.parametrize("stratified", [False, True])
def test_pieces_of_equal_mass_get_equal_shares(stratified, generator):
    """Many draws are rejected, and what is left of the last round is cut off."""
    equal = GaussianMixture(
        torch.tensor([[0.0], [1.0]]).double(),
        torch.ones(2, 1, 1).double(),
        torch.zeros(2).double(),
    )
    proposal = ChamRehg(deviation=0.0, include_modes=False, stratified=stratified)
    samples = proposal.sample(equal, 4000, problems.unbounded(1), generator=generator)
    assert len(samples.x) == 4000
    assert float(samples.parent.double().mean()) == pytest.approx(0.5, abs=5 * 0.5 / 4000**0.5)


def test_members_project_their_samples_as_they_do_alone():
    bounds = problems.box(2, -2.2, 7.0)
    far = HeavyTailed(covariance_scale=2, include_modes=False)
    got = {}
    for correlated in (False, True):
        near = CovarianceScaled(covariance_scale=4, correlated_projection=correlated)
        members = MixtureOfProposals(proposals=(near, far))
        again = torch.Generator().manual_seed(3)
        # The first member comes last: it draws what the others leave.
        alone = [member.sample(TWO, 20, bounds, generator=again) for member in (far, near)][::-1]
        for proposal in (MixtureOfProposals(proposals=(members,)), members):
            source = torch.Generator().manual_seed(3)
            got[correlated] = proposal.sample(TWO, 40, bounds, generator=source)
            assert torch.equal(got[correlated].x, torch.cat([part.x for part in alone]))
    assert not torch.equal(got[True].x, got[False].x)
    # Weights are those of where samples were drawn, wherever they are moved.
    torch.testing.assert_close(got[True].log_weight, got[False].log_weight, rtol=0, atol=0)


@dataclass(frozen=True, kw_only=True)
class Aside(Move):
    """To states at some distances from the best one."""

    distances: tuple[float, ...]

    def states(self, best, bounds):
        return bounds.project(best.mean + torch.tensor(self.distances).double()[:, None])


NEAR = CovarianceScaled(covariance_scale=1)


def test_a_mixture_counts_the_jumps_of_all_its_moves(generator):
    """Jumps of the heaviest component follow the modes, those of one move after the other's."""
    one = Aside(search=NEAR, distances=(20.0,), log_odds=-2.0)
    two = Aside(search=NEAR, distances=(-20.0, 40.0))
    samples = with_moves(NEAR, ((one, 4), (two, 6)), 20).sample(TWO, 20, FREE, generator=generator)
    heaviest = int(TWO.log_weight.argmax())
    assert samples.jumps.parent.tolist() == [heaviest] * 3
    centres = torch.cat([TWO.mean, samples.jumps.mixture.mean])
    moved = TWO.mean[heaviest, 0] + torch.tensor([20.0, -20.0, 40.0]).double()
    assert torch.equal(centres[2:, 0], moved)
    odds = samples.jumps.mixture.log_weight - TWO.log_weight[heaviest]
    torch.testing.assert_close(odds, torch.tensor([-2.0, -5.0, -5.0]).double())
    assert torch.bincount(samples.parent, minlength=5)[2] == 4
    assert int(torch.bincount(samples.parent, minlength=5)[3:].sum()) == 6
    assert float((samples.x - centres[samples.parent]).abs().max()) < 10
    assert bool((samples.log_weight[-10:] == -torch.inf).all())


def test_what_moves_leave_is_drawn_as_without_them(generator):
    nowhere = Aside(search=NEAR, distances=())
    samples = with_moves(NEAR, ((nowhere, 15),), 20).sample(TWO, 20, FREE, generator=generator)
    assert samples.jumps is None
    assert len(samples.x) == 20
    assert with_moves(NEAR, (), 20) is NEAR
    crowd = Aside(search=NEAR, distances=tuple(map(float, range(20, 120))))
    samples = with_moves(NEAR, ((crowd, 100),), 8).sample(TWO, 8, FREE, generator=generator)
    assert int((samples.parent < 2).sum()) == 2, "moves get three quarters at the most"


@settings(max_examples=30, deadline=None)
@given(
    which=st.integers(0, len(ALL) - 1),
    size=st.sampled_from([0.0, 1e-14, 1e-6, 1.0, 1e8, 1e14]),
    rank=st.integers(0, 3),
    k=st.integers(1, 4),
    single=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_singular_huge_and_tiny_covariances(which, size, rank, k, single, seed):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(k, 3, rank, generator=generator, dtype=torch.float64)
    mixture = GaussianMixture(
        torch.randn(k, 3, generator=generator, dtype=torch.float64),
        size * root @ root.mT,
        torch.randn(k, generator=generator, dtype=torch.float64),
    )
    if single:
        mixture = GaussianMixture(*(field.float() for field in mixture))
    bounds = problems.box(3, -4, 4, mixture.mean.dtype)
    proposal = ALL[which]
    if isinstance(proposal, Condensation):
        proposal = Condensation(deviation=0.1)
    samples = proposal.sample(mixture, 12, bounds, generator=generator)
    assert samples.x.dtype == mixture.mean.dtype
    assert bool(((samples.x >= -4) & (samples.x <= 4)).all())
    assert not bool(samples.log_weight.isnan().any())
    assert bool(((samples.parent >= 0) & (samples.parent < k)).all())


def test_bad_choices():
    for make, match in [
        (lambda: Condensation(deviation=-1.0), "Condensation.deviation"),
        (lambda: ChamRehg(deviation=(1.0, math.nan)), "ChamRehg.deviation"),
        (lambda: InflatedPosterior(covariance_scale=2, deviation=math.inf), "deviation"),
        (lambda: CovarianceScaled(covariance_scale=2, max_deviation=-1.0), "max_deviation"),
        (lambda: HeavyTailed(covariance_scale=2, max_deviation=(1.0, math.nan)), "max_deviation"),
        (lambda: HeavyTailed(covariance_scale=2, degrees_of_freedom=0), "at least 1, got 0; 3 is"),
        (lambda: EigenDirectionGrid(num_directions=-1), "Grid.num_directions: expected at least 1"),
        (lambda: EigenDirectionGrid(num_steps=0), "Grid.num_steps: expected at least 1"),
        (lambda: EigenDirectionGrid(deviation_scale=math.nan), "Grid.deviation_scale"),
        (lambda: Diffusion(deviation=-0.1), "Diffusion.deviation: expected at least 0"),
        (lambda: ConstantVelocity(deviation=(0.1, math.inf)), "ConstantVelocity.deviation"),
        (lambda: ConstantVelocity(persistence=math.nan), "ConstantVelocity.persistence"),
        (
            lambda: Aside(search=NEAR, distances=(), log_odds=math.nan),
            "Aside.log_odds: expected a finite number",
        ),
        (lambda: Aside(search=NEAR, distances=(), log_odds=-math.inf), "Aside.log_odds"),
        (lambda: MixtureOfProposals(proposals=()), "at least one"),
        (lambda: MixtureOfProposals(proposals=(ALL[0],), shares=(0.0,)), "shares"),
        (lambda: MixtureOfProposals(proposals=(ALL[0],), shares=(0.5, 0.5)), "one share for each"),
    ]:
        with pytest.raises(ConfigurationError, match=match):
            make()
    free = CovarianceScaled(covariance_scale=2, max_deviation=(1.0, math.inf))  # of one parameter
    assert free.max_deviation == (1.0, math.inf)


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
