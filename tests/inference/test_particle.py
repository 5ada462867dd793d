import io

import problems
import pytest
import torch

from torchcss.errors import ConfigurationError
from torchcss.inference.dynamics import ConstantVelocity, Diffusion
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.particle import AnnealedParticleFilter, ParticleFilter
from torchcss.inference.problem import SearchProblem
from torchcss.inference.tracker import Particles
from torchcss.types import LocalModel, Status

FREE = problems.unbounded(2)
BOUNDS = problems.box(2, -6, 6)
STEP = (0.5, 0.3)
CENTRE = problems.single((0.0, 0.0))


def make(kind, **options):
    return kind(
        **{"num_samples": 2000, "num_modes": 3, "dynamics": Diffusion(deviation=STEP), **options}
    )


FILTERS = [
    make(ParticleFilter),
    make(ParticleFilter, dilution=0.3, noise_scale=2.0),
    make(AnnealedParticleFilter, num_samples=300, num_layers=4),
]


def bowl(*minimum: float) -> problems.Bowl:
    hessian = torch.tensor([[4.0, 1.0], [1.0, 2.0]]).double()
    return problems.Bowl(hessian, torch.tensor(minimum).double())


def moments(particles: Particles) -> tuple[torch.Tensor, torch.Tensor]:
    points = torch.zeros(1, 1, 1).double().expand(len(particles.x), 1, 1)
    return GaussianMixture(particles.x, points, particles.log_weight).moments()


@pytest.mark.parametrize("options", [{}, {"dilution": 0.25}, {"dilution": 0.5, "noise_scale": 3.0}])
def test_it_is_the_kalman_filter_where_that_is_exact(options, generator):
    """Gaussian prior, linear dynamics, Gaussian likelihood; the weights undo any inflation."""
    tracker = make(ParticleFilter, num_samples=40000, **options)
    costs = [bowl(0.3, -0.2), bowl(0.6, 0.1), bowl(0.2, 0.4)]
    mean, covariance = CENTRE.mean[0], CENTRE.covariance[0]
    noise = torch.diag(torch.tensor(STEP).double().square())
    state = tracker.init(CENTRE, generator=generator)
    for cost, (now, info) in zip(
        costs, problems.follow(tracker, state, map(SearchProblem, costs), FREE), strict=True
    ):
        information = torch.linalg.inv(covariance + noise)
        covariance = torch.linalg.inv(information + cost.hessian)
        mean = covariance @ (information @ mean + cost.hessian @ cost.minimum)
        got_mean, got_covariance = moments(now.particles)
        # Five standard errors of as many independent samples as survive.
        error = 5 / float(info.survival.effective_sample_size) ** 0.5
        deviation = covariance.diagonal().sqrt()
        assert bool(((got_mean - mean).abs() < error * deviation).all())
        size = 2 * deviation[:, None] * deviation
        assert bool(((got_covariance - covariance).abs() < error * size).all())


@pytest.mark.parametrize("tracker", FILTERS)
def test_the_mixture_sums_the_particles_up(tracker, generator):
    state, info = tracker.step(
        tracker.init(CENTRE, generator=generator), SearchProblem(bowl(0.3, 0.2)), FREE
    )
    for got, expected in zip(state.mixture.moments(), moments(state.particles), strict=True):
        torch.testing.assert_close(got, expected)
    share = [
        state.particles.log_weight[state.particles.component == i].exp().sum()
        for i in range(len(state.mixture.mean))
    ]
    torch.testing.assert_close(torch.stack(share), state.mixture.weight)
    assert state.mixture.weight.tolist() == sorted(state.mixture.weight.tolist(), reverse=True)
    torch.testing.assert_close(info.cost, bowl(0.3, 0.2).value(state.mixture.mean))
    assert int(info.num_samples) == tracker.num_samples * getattr(tracker, "num_layers", 1)
    assert 0 < float(info.survival.survival_rate) <= 1


@pytest.mark.parametrize("tracker", FILTERS)
def test_two_separate_wells_are_two_components(tracker, generator):
    well = problems.DoubleWell(width=0.3)
    both = GaussianMixture(
        well.minima, 0.01 * torch.eye(2).double().expand(2, 2, 2), torch.zeros(2).double()
    )
    state = tracker.init(both, generator=generator)
    state, info = tracker.step(state, SearchProblem(well), BOUNDS)
    best = state.mixture.mean[:2]
    best = best[best[:, 0].argsort()]
    torch.testing.assert_close(best, well.minima, rtol=0, atol=0.25)
    assert sorted(info.origin[:2].tolist()) == [0, 1]
    assert float(state.mixture.weight[:2].min()) > 0.3


def test_annealing_drifts_into_a_minimum_that_resampling_misses(generator):
    """Far away and narrow: one layer leaves next to no survivor, many find the way."""
    far = problems.Bowl(400 * torch.eye(2).double(), torch.tensor([2.0, 1.5]).double())
    state = make(ParticleFilter).init(
        problems.single((0.0, 0.0), variance=(0.01, 0.01)), generator=generator
    )
    _, plain = make(ParticleFilter, num_samples=200).step(state, SearchProblem(far), FREE)
    annealed = make(AnnealedParticleFilter, num_samples=200, num_layers=10)
    _, info = annealed.step(state, SearchProblem(far), FREE)
    assert float(info.cost.min()) < 1 < float(plain.cost.min())
    assert float(plain.survival.effective_sample_size) < 5
    assert float(info.survival.survival_rate) > 0.49


@pytest.mark.parametrize("tracker", FILTERS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bounds_type_and_repeatability(tracker, dtype):
    mixture = GaussianMixture(*(field.to(dtype) for field in CENTRE))
    bounds = problems.box(2, -0.3, 0.4, dtype)
    runs = []
    for _ in range(2):
        state = tracker.init(mixture, generator=torch.Generator().manual_seed(4))
        states = [
            state
            for state, _ in problems.follow(
                tracker, state, map(SearchProblem, [bowl(1.0, 1.0)] * 2), bounds
            )
        ]
        runs.append(states[-1])
    a, b = runs
    assert torch.equal(a.particles.x, b.particles.x)
    assert a.particles.x.dtype == a.mixture.mean.dtype == dtype
    assert bool(((a.particles.x >= bounds.lower) & (a.particles.x <= bounds.upper)).all())
    assert float(a.mixture.weight.sum()) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("tracker", FILTERS)
def test_saved_and_restored_runs_continue_exactly(tracker, generator):
    costs = [bowl(0.1 * t, 0.2) for t in range(6)]
    state = tracker.init(CENTRE, generator=generator)
    *_, (whole, _) = problems.follow(tracker, state, map(SearchProblem, costs), FREE)
    *_, (half, _) = problems.follow(tracker, state, map(SearchProblem, costs[:3]), FREE)
    file = io.BytesIO()
    torch.save([half.mixture._asdict(), *half[1:4], half.particles._asdict()], file)
    file.seek(0)
    mixture, *rest, particles = torch.load(file)
    resumed = type(half)(GaussianMixture(**mixture), *rest, Particles(**particles))
    *_, (end, _) = problems.follow(tracker, resumed, map(SearchProblem, costs[3:]), FREE)
    for a, b in zip(
        (*whole.mixture, *whole.particles), (*end.mixture, *end.particles), strict=True
    ):
        assert torch.equal(a, b)


@pytest.mark.parametrize("tracker", FILTERS)
def test_dropped_particles_are_drawn_from_the_mixture(tracker, generator):
    state, _ = tracker.step(
        tracker.init(CENTRE, generator=generator), SearchProblem(bowl(0.3, 0.2)), FREE
    )
    again, _ = tracker.step(state._replace(particles=None), SearchProblem(bowl(0.3, 0.2)), FREE)
    assert float((again.mixture.moments()[0] - state.mixture.moments()[0]).norm()) < 0.3


class Nowhere(problems.Bowl):
    def local_model(self, x):
        return LocalModel(*(torch.full_like(field, torch.nan) for field in super().local_model(x)))


@pytest.mark.parametrize("tracker", FILTERS)
def test_no_finite_cost(tracker, generator):
    nowhere = Nowhere(torch.eye(2).double(), torch.zeros(2).double())
    state, info = tracker.step(
        tracker.init(CENTRE, generator=generator), SearchProblem(nowhere), FREE
    )
    assert int(info.status_counts[Status.NON_FINITE]) == tracker.num_samples
    assert int(info.num_distinct) == 0
    assert bool(info.cost.isinf().all())
    assert float(info.survival.effective_sample_size) == 0
    _, info = tracker.step(state, SearchProblem(bowl(0.0, 0.0)), FREE)
    assert float(info.cost.min()) < 0.5


@pytest.mark.parametrize("tracker", FILTERS)
@pytest.mark.parametrize("variance", [0.0, 1e-14, 1e14])
def test_awkward_priors(tracker, variance, generator):
    state = tracker.init(
        problems.single((0.0, 0.0), variance=(variance, variance)), generator=generator
    )
    twice = map(SearchProblem, [bowl(0.0, 0.0)] * 2)
    for state, _ in problems.follow(tracker, state, twice, BOUNDS):  # noqa: B020
        assert all(bool(field.isfinite().all()) for field in state.mixture)
    still = make(type(tracker), num_samples=50, dynamics=Diffusion())
    state, _ = still.step(
        still.init(CENTRE, generator=generator), SearchProblem(bowl(0.0, 0.0)), BOUNDS
    )
    assert 1 <= len(state.mixture.mean) <= 3


def test_velocity_carries_particles_on(generator):
    """A target at steady speed: particles that know it keep up, those that diffuse lag behind."""
    path = [
        problems.Bowl(400 * torch.eye(2).double(), torch.tensor([0.2 * t, 0.0]).double())
        for t in range(1, 8)
    ]
    behind = []
    for dynamics in (ConstantVelocity(deviation=0.05), Diffusion(deviation=0.05)):
        tracker = make(ParticleFilter, dynamics=dynamics)
        state = tracker.init(
            problems.single((0.0, 0.0), variance=(0.01, 0.01)), generator=generator
        )
        *_, (state, _) = problems.follow(tracker, state, map(SearchProblem, path), FREE)
        behind.append(float(path[-1].minimum[0] - state.mixture.moments()[0][0]))
    assert abs(behind[0]) < 0.05 < behind[1]
    assert float(state.velocity[0, 0]) == pytest.approx(0.2, abs=0.1)


def test_parents_are_the_modes_of_the_last_frame(generator):
    tracker = make(ParticleFilter, num_samples=100)
    seen = []

    def children(parent, prior):
        seen.append((parent, prior))
        minima = prior.mixture.mean[parent]
        return SearchProblem(problems.ItemBowls(torch.ones(len(parent), 1).double(), minima))

    problem = SearchProblem(bowl(0.0, 0.0), of_children=children)

    state = tracker.init(CENTRE, generator=generator)
    state, _ = tracker.step(state, problem, FREE)
    state, info = tracker.step(state, problem, FREE)
    for parent, prior in seen:
        assert int(parent.max()) < len(prior.parent)
    assert len(seen) == 4
    assert torch.equal(seen[-1][0], info.origin)


def test_bad_choices():
    for bad, match in [
        ({"dilution": 2.0}, "dilution"),
        ({"noise_scale": 0.5}, "narrower"),
        ({"noise_scale": torch.inf}, "noise_scale: expected at least 1, got inf"),
        ({"num_samples": 0}, "num_samples"),
    ]:
        with pytest.raises(ConfigurationError, match=match):
            make(ParticleFilter, **bad)
    for bad, match in [
        ({"num_layers": torch.nan}, "num_layers"),
        ({"survival_rate": 1.0}, "survival"),
    ]:
        with pytest.raises(ConfigurationError, match=match):
            make(AnnealedParticleFilter, **bad)
