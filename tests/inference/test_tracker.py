import io
from dataclasses import dataclass, replace

import problems
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcss.cost.temporal import MixturePrior
from torchcss.errors import ConfigurationError, ShapeError
from torchcss.inference.dynamics import ConstantVelocity, Diffusion
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.inference.particle import ParticleFilter
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import (
    CovarianceScaled,
    EigenDirectionGrid,
    HeavyTailed,
    Move,
    Samples,
    Spherical,
    with_moves,
)
from torchcss.inference.tracker import Tracker
from torchcss.types import LocalModel, Status

BOUNDS = problems.box(2, -6, 6)
CSS = Tracker(proposal=CovarianceScaled(covariance_scale=8), num_samples=40, num_modes=3)


def test_both_wells_are_found_and_followed(generator):
    state = CSS.init(problems.single(), generator=generator)
    wells = [problems.DoubleWell(slope=0.5 + 0.02 * t) for t in range(5)]
    for well, (now, info) in zip(
        wells, problems.follow(CSS, state, map(SearchProblem, wells), BOUNDS), strict=True
    ):
        state = now
        found = state.mixture.mean[state.mixture.mean[:, 0].argsort()]
        torch.testing.assert_close(found, well.minima, rtol=0, atol=0.02)
        assert int(info.num_distinct) == 2
        assert int(info.status_counts.sum()) == int(info.num_samples) == 40
        assert float(state.mixture.log_weight.exp().sum()) == pytest.approx(1)
        # The modes themselves are no draws; the others' weights lead back to the prior.
        assert 1 <= float(info.survival.effective_sample_size) < 40
        assert float(info.survival.survival_rate) * 40 == pytest.approx(
            float(info.survival.effective_sample_size)
        )
        # Equal minima share the posterior.
        assert float(info.effective_sample_size) == pytest.approx(2, abs=0.01)
    assert int(state.frame) == 5
    assert sorted(info.parent.tolist()) == [0, 1]
    assert sorted(info.origin.tolist()) == [0, 1]


def test_weights_are_those_of_the_costs(generator):
    well = problems.DoubleWell(tilt=0.4)
    state, info = CSS.step(
        CSS.init(problems.single(), generator=generator), SearchProblem(well), BOUNDS
    )
    # One prior mode: its weight is one, and the posterior that of the likelihood.
    expected = (-info.cost).softmax(0)
    torch.testing.assert_close(state.mixture.weight, expected)
    assert info.parent.tolist() == [0, -1]


def test_saved_and_restored_runs_continue_exactly(generator):
    wells = [problems.DoubleWell(tilt=0.1 * t) for t in range(6)]
    tracker = Tracker(
        proposal=CSS.proposal,
        num_samples=20,
        num_modes=3,
        dynamics=ConstantVelocity(deviation=0.01),
    )
    state = tracker.init(problems.single(), generator=generator)
    *_, (whole, _) = problems.follow(tracker, state, map(SearchProblem, wells), BOUNDS)
    *_, (half, _) = problems.follow(tracker, state, map(SearchProblem, wells[:3]), BOUNDS)
    file = io.BytesIO()
    torch.save([half.mixture._asdict(), half.velocity, half.generator_state, half.frame], file)
    file.seek(0)
    mixture, *rest = torch.load(file)
    resumed = type(half)(GaussianMixture(**mixture), *rest)
    *_, (end, _) = problems.follow(tracker, resumed, map(SearchProblem, wells[3:]), BOUNDS)
    assert whole.particles is end.particles is None
    for a, b in zip((*whole.mixture, *whole[1:4]), (*end.mixture, *end[1:4]), strict=True):
        assert torch.equal(a, b)


def test_a_step_is_a_pure_function_of_the_state(generator):
    state = CSS.init(problems.single(), generator=generator)
    a, _ = CSS.step(state, SearchProblem(problems.DoubleWell()), BOUNDS)
    b, _ = CSS.step(state, SearchProblem(problems.DoubleWell()), BOUNDS)
    assert torch.equal(a.mixture.mean, b.mixture.mean)
    assert torch.equal(generator.get_state(), state.generator_state)


@dataclass(frozen=True)
class FarWells(problems.Alike):
    """Two wells that have moved ten widths away from the modes; the smoother self reaches them."""

    width: float = 0.1

    centres = torch.tensor([[-3.0, 0.0], [3.0, 0.0]]).double()

    def _cost(self):
        def function(x):
            squared = (x - self.centres.to(x)).square().sum(-1)
            return -20 * (-0.5 * squared / self.width**2).exp().sum()

        return problems.AutogradCost(function)

    def value(self, x):
        return self._cost().value(x)

    def local_model(self, x):
        return self._cost().local_model(x)

    def problem(self):
        return SearchProblem(self, coarse=replace(self, width=2.0))


@pytest.mark.parametrize("num_samples", [12, 3, 2])
def test_every_mode_descends_on_the_smoother_cost(num_samples, generator):
    """Also one that is hardly ever sampled; the modes descend as they are, too."""
    mean = FarWells.centres + torch.tensor([0.0, 1.0]).double()
    covariance = 1e-4 * torch.eye(2).double().expand(2, 2, 2)
    mixture = GaussianMixture(mean, covariance, torch.tensor([0.0, -30.0]).double())
    tracker = replace(CSS, num_samples=num_samples, num_modes=4, coarse_every=3)
    state, info = tracker.step(
        tracker.init(mixture, generator=generator), FarWells().problem(), BOUNDS
    )
    found = torch.cdist(FarWells.centres, state.mixture.mean) < 1e-3
    assert int(info.num_samples) == num_samples
    if num_samples == 12:
        assert found.any(1).tolist() == [True, True]
        origin = info.origin[found.long().argmax(1)]
        assert origin.tolist() == [0, 1]
        # Those that were not so started are where they were.
        assert int(info.num_distinct) >= 4
    else:  # one is drawn, or none, and the best mode begins
        assert found.any(1).tolist() == [True, False]
    never = replace(tracker, coarse_every=0)
    state, _ = never.step(never.init(mixture, generator=generator), FarWells().problem(), BOUNDS)
    assert not (torch.cdist(FarWells.centres, state.mixture.mean) < 0.5).any()


class Shuffled:
    """A proposal whose samples come in another order."""

    def sample(self, mixture, num, bounds, *, generator):
        samples = CSS.proposal.sample(mixture, num, bounds, generator=generator)
        order = torch.randperm(num, generator=torch.Generator().manual_seed(5))
        return samples.take(order)

    def log_density(self, mixture, x):
        return CSS.proposal.log_density(mixture, x)


def test_the_order_of_the_samples_is_irrelevant(generator):
    other = Tracker(proposal=Shuffled(), num_samples=40, num_modes=3)
    well = problems.DoubleWell(tilt=0.3)
    state = CSS.init(problems.single(), generator=generator)
    a, b = (t.step(state, SearchProblem(well), BOUNDS)[0].mixture for t in (CSS, other))
    torch.testing.assert_close(a.mean, b.mean, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(a.log_weight, b.log_weight, rtol=1e-6, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(
    variance=st.sampled_from([0.0, 1e-14, 1.0, 1e14]),
    num_modes=st.integers(1, 3),
    single_precision=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_awkward_covariances(variance, num_modes, single_precision, seed):
    dtype = torch.float32 if single_precision else torch.float64
    mixture = problems.single(variance=(variance, 0.5 * variance))
    mixture = GaussianMixture(*(x.to(dtype) for x in mixture))
    tracker = Tracker(proposal=CSS.proposal, num_samples=15, num_modes=num_modes)
    state = tracker.init(mixture, generator=torch.Generator().manual_seed(seed))
    frames = [SearchProblem(problems.DoubleWell(tilt=0.2))] * 3
    for state, info in problems.follow(tracker, state, frames, BOUNDS):  # noqa: B020
        assert 1 <= len(state.mixture.mean) <= num_modes
        assert all(bool(x.isfinite().all()) for x in state.mixture)
        assert state.mixture.mean.dtype == dtype
        assert float(state.mixture.weight.sum()) == pytest.approx(1, abs=1e-5)
        assert float(info.cost.min()) < 1


def test_all_samples_in_one_minimum(generator):
    bowl = problems.Bowl(4 * torch.eye(2).double(), torch.tensor([0.5, 0.0]).double())
    state, info = CSS.step(
        CSS.init(problems.single(), generator=generator), SearchProblem(bowl), BOUNDS
    )
    assert state.mixture.mean.shape == (1, 2)
    assert float(state.mixture.log_weight) == 0
    assert int(info.num_distinct) == 1
    assert info.parent.tolist() == [0]


class Nowhere(problems.DoubleWell):
    def local_model(self, x):
        return LocalModel(*(torch.full_like(v, torch.nan) for v in super().local_model(x)))


def test_no_sample_with_a_finite_cost_carries_the_prior_over(generator):
    tracker = Tracker(
        proposal=CSS.proposal, num_samples=10, num_modes=3, dynamics=Diffusion(deviation=0.5)
    )
    start = tracker.init(problems.single(), generator=generator)
    state, info = tracker.step(start, SearchProblem(Nowhere()), BOUNDS)
    assert torch.equal(state.mixture.mean, start.mixture.mean)
    assert bool((state.mixture.covariance - start.mixture.covariance).diagonal(0, 1, 2).gt(0).all())
    assert int(info.status_counts[Status.NON_FINITE]) == 10
    assert int(info.num_distinct) == 0
    assert info.cost.tolist() == [torch.inf]
    state, info = tracker.step(state, SearchProblem(problems.DoubleWell()), BOUNDS)
    assert float(info.cost.min()) < 0.01


def test_weights_do_not_underflow(generator):
    """The lesser mode lies 40 nats a frame behind, far below the smallest number after 100."""
    tracker = Tracker(proposal=EigenDirectionGrid(), num_samples=20, num_modes=2)
    well = problems.DoubleWell(barrier=100, tilt=10.0)
    both = GaussianMixture(
        well.minima, 0.01 * torch.eye(2).double().expand(2, 2, 2), torch.zeros(2).double()
    )
    state = tracker.init(both, generator=generator)
    *_, (state, _) = problems.follow(tracker, state, map(SearchProblem, [well] * 100), BOUNDS)
    assert len(state.mixture.mean) == 2
    assert -5000 < float(state.mixture.log_weight[1]) < -3000


def test_a_cost_made_from_the_samples_parents(generator):
    seen = []

    class Sticky(problems.ItemBowls):
        pass

    def make(parent, prior):
        seen.append((parent, prior))
        return Sticky(torch.ones(len(parent), 1).double(), prior.mixture.mean[parent])

    state = CSS.init(problems.single(), generator=generator)
    problem = SearchProblem(
        problems.Bowl(torch.eye(2).double(), torch.zeros(2).double()),
        of_children=lambda parent, prior: SearchProblem(make(parent, prior)),
    )
    state, _ = CSS.step(state, problem, BOUNDS)
    parent, prior = seen[0]
    assert parent.shape == (40,)
    assert torch.equal(prior.mixture.mean, problems.single().mean)
    torch.testing.assert_close(state.mixture.mean[:1], prior.mixture.mean, rtol=0, atol=0.2)


@dataclass(frozen=True, kw_only=True)
class ToTheOtherWell(Move):
    """From one minimum of a double well into the other."""

    def states(self, best, bounds):
        return -best.mean


def test_a_move_finds_the_other_well_and_parents_are_modes_of_the_frame_before(generator):
    well = problems.DoubleWell()
    start = GaussianMixture(well.minima[:1], 1e-4 * torch.eye(2).double()[None], torch.zeros(1))
    narrow = CovarianceScaled(covariance_scale=1)
    move = ToTheOtherWell(search=narrow, log_odds=0.0)
    tracker = replace(CSS, proposal=with_moves(narrow, ((move, 3),), 40), num_modes=3)
    state = tracker.init(start, generator=generator)
    for known in (1, 2):
        before, (state, info) = state, tracker.step(state, SearchProblem(well), BOUNDS)
        assert len(state.mixture.mean) == 2, "both wells"
        assert 0 <= int(info.parent.min()) <= int(info.parent.max()) < known
        assert len(info.prior.parent) == known + 1
        # Whoever was put elsewhere is at rest there.
        assert float(state.velocity.abs().max()) < 0.1
    assert before.frame == 1
    with pytest.raises(TypeError, match="proposal"):
        ParticleFilter(num_samples=4, num_modes=1, proposal=move)


def test_bad_input(generator):
    for power in (0.0, -1.0, torch.inf):
        with pytest.raises(ConfigurationError, match=r"Tracker\.likelihood_power: expected"):
            replace(CSS, likelihood_power=power)
    for name in ("survivors", "separation", "coarse_every"):
        for number in (-1, torch.nan, torch.inf):
            with pytest.raises(ConfigurationError, match=rf"Tracker\.{name}: expected at least 0"):
                replace(CSS, **{name: number})
    with pytest.raises(ConfigurationError, match="num_samples"):
        Tracker(proposal=CSS.proposal, num_samples=0, num_modes=1)
    with pytest.raises(ShapeError, match=r"mixture.covariance.*\[..., 1, 2, 2\]"):
        CSS.init(problems.single()._replace(covariance=torch.eye(3)[None]), generator=generator)
    state = CSS.init(problems.single(), generator=generator)
    with pytest.raises(ShapeError, match="bounds"):
        CSS.step(state, SearchProblem(problems.DoubleWell()), problems.box(3, -1, 1))


@pytest.mark.parametrize("screened", [False, True])
def test_oversampling_descends_from_the_best_alone(generator, screened):
    """Section 4.2 [RR]; by the screening cost, where there is one."""
    starts = []

    class Watched(problems.DoubleWell):
        def local_model(self, x):
            starts.append(x)
            return super().local_model(x)

    screening = problems.Bowl(torch.eye(2).double(), torch.tensor([-2.0, 1.0]).double())
    problem = SearchProblem(Watched(), screening=screening if screened else None)
    many = replace(CSS, num_samples=6, oversampling=20)
    state = many.init(problems.single(), generator=generator)
    again = torch.Generator()
    again.set_state(state.generator_state)
    drawn = many.proposal.sample(state.mixture, 120, BOUNDS, generator=again).x
    score = screening.value(drawn) if screened else problems.DoubleWell().value(drawn)
    starts.clear()
    _, info = many.step(state, problem, BOUNDS)
    assert int(info.num_samples) == 6
    first = next(x for x in starts if len(x) == 6)
    # The mode that goes on from the last frame comes first, whatever it costs.
    score[0] = -torch.inf
    torch.testing.assert_close(first, drawn[score.argsort()[:6].sort().values])


@pytest.mark.parametrize("survivors", [0, 3])
def test_oversampling_keeps_the_modes_of_the_last_frame(generator, survivors):
    """A mode of little weight in the other well, where hardly a sample falls."""
    well = problems.DoubleWell()
    two = GaussianMixture(
        well.minima, 0.01 * torch.eye(2).double().expand(2, 2, 2), torch.tensor([0.0, -9.0])
    ).normalise()
    tracker = replace(CSS, num_samples=8, oversampling=10, survivors=survivors)
    state, _ = tracker.step(tracker.init(two, generator=generator), SearchProblem(well), BOUNDS)
    assert len(state.mixture.mean) == 2


def test_modes_that_see_nothing_come_to_rest_inside_the_bounds(generator):
    tracker = replace(CSS, dynamics=ConstantVelocity(persistence=0.5), num_modes=1)
    five = GaussianMixture(
        torch.tensor([[5.9, 0.0]]).double().expand(5, 2),
        torch.eye(2).double().expand(5, 2, 2),
        torch.zeros(5).double(),
    )
    state = tracker.init(five, generator=generator)
    state = state._replace(velocity=torch.tensor([[0.4, -0.4]]).double().expand(5, 2))
    for _ in range(12):
        state, info = tracker.step(state, SearchProblem(Nowhere()), BOUNDS)
        assert len(state.mixture.mean) == len(info.cost) == 1
        assert torch.equal(BOUNDS.project(state.mixture.mean), state.mixture.mean)
    # 0.2 + 0.1 + ...: half of the velocity goes on each time.
    torch.testing.assert_close(
        state.mixture.mean[0], torch.tensor([6.0, -0.4]).double(), rtol=0, atol=1e-3
    )
    assert float(state.velocity.abs().max()) < 1e-3


def test_likelihoods_count_by_their_power(generator):
    well = problems.DoubleWell(tilt=0.4)
    for power in (1.0, 0.1):
        tracker = replace(CSS, likelihood_power=power)
        state, info = tracker.step(
            tracker.init(problems.single(), generator=generator), SearchProblem(well), BOUNDS
        )
        torch.testing.assert_close(state.mixture.weight, (-power * info.cost).softmax(0))
        assert info.parent.tolist() == [0, -1]
        assert tracker.stated_power == power
    # Frame after frame it adds up: the odds of two modes are those of all costs so far.
    assert float(info.cost[1] - info.cost[0]) > 0.5
    both = GaussianMixture(
        well.minima, 0.01 * torch.eye(2).double().expand(2, 2, 2), torch.zeros(2).double()
    )
    tracker = Tracker(
        proposal=EigenDirectionGrid(), num_samples=20, num_modes=2, likelihood_power=0.1
    )
    state = tracker.init(both, generator=generator)
    *_, (state, info) = problems.follow(tracker, state, map(SearchProblem, [well] * 30), BOUNDS)
    odds = state.mixture.log_weight[0] - state.mixture.log_weight[1]
    torch.testing.assert_close(odds, 3 * (info.cost[1] - info.cost[0]), rtol=1e-3, atol=1e-3)


def with_landmarks(cost) -> SearchProblem:
    return SearchProblem(cost, landmarks=cost.landmarks)


class Comb(problems.AutogradCost):
    """Minima near -3, -1.5, 0, 1.5 and 3, the best at 0, the next best beside it."""

    def __init__(self):
        turn = 2 * torch.pi / 1.5
        super().__init__(
            lambda x: 6 * (1 - (turn * x[0]).cos()) + (0.3 * x[0] - 0.1).square() + 2 * x[1] ** 2
        )


class LandmarkedComb(Comb):
    """The landmark is where the state is; a second one never moves, and does not count."""

    def landmarks(self, x):
        return torch.stack([x, torch.zeros_like(x)], dim=-2)


def test_separation_keeps_modes_whose_landmarks_differ(generator):
    def found(cost, separation: float, num_modes: int) -> list[int]:
        tracker = replace(CSS, num_samples=60, num_modes=num_modes, separation=separation)
        start = tracker.init(problems.single((0.0, 0.0), (0.6, 0.1)), generator=generator)
        state, _ = tracker.step(start, cost, problems.box(2, -3.7, 3.7))
        # In multiples of the distance between two minima, the best mode first.
        return (state.mixture.mean[:, 0] / 1.5).round().int().tolist()

    assert found(with_landmarks(LandmarkedComb()), 0.0, 5) == [0, 1, -1, 2, -2]
    # Next neighbours' landmarks are 1.5 apart, every second one's 3.
    assert found(with_landmarks(LandmarkedComb()), 1.4, 3) == [0, 1, -1]
    assert found(with_landmarks(LandmarkedComb()), 2.8, 3) == [0, 2, -2]
    # Places left go to the best of those alike; the order is that of the weights.
    assert found(with_landmarks(LandmarkedComb()), 2.8, 4) == [0, 1, 2, -2]
    assert found(with_landmarks(LandmarkedComb()), 50.0, 3) == [0, 1, -1]
    # A cost without landmarks is not concerned.
    assert found(SearchProblem(Comb()), 2.8, 3) == [0, 1, -1]


def step_of_rivals(generator, *, soft_matching: bool):
    """Of two modes the first has all the weight, and meets a rival that is cheaper, and alike."""
    tracker = replace(
        CSS,
        num_samples=60,
        num_modes=2,
        separation=1.6,
        soft_matching=soft_matching,
    )
    past = GaussianMixture(
        torch.tensor([[1.4, 0.0], [0.0, 0.0]]).double(),
        torch.tensor([[0.36, 0.0], [0.0, 0.01]]).double().expand(2, 2, 2),
        torch.tensor([0.0, -18.0]).double(),
    )
    state = tracker.init(past, generator=generator)
    state, info = tracker.step(state, with_landmarks(LandmarkedComb()), problems.box(2, -3.7, 3.7))
    return (state.mixture.mean[:, 0] / 1.5).round().int().tolist(), state, info


def test_soft_matching_hands_no_past_to_who_is_far_from_it(generator):
    """The rival stands for both; hard matching gives the first mode's past to the next, at 3."""
    places, _, _ = step_of_rivals(generator, soft_matching=False)
    assert places == [2, 0]
    places, state, info = step_of_rivals(generator, soft_matching=True)
    # Who has the past stays, a tenth of a nat dearer, and stands for both neighbours.
    assert places == [1, -1]
    assert info.parent.tolist() == [0, -1]
    assert float(state.mixture.log_weight[0]) > -0.2
    # What is near no mode of the last frame did not move there: it is new.
    torch.testing.assert_close(state.velocity[0], state.mixture.mean[0] - torch.tensor([1.4, 0.0]))
    assert torch.equal(state.velocity[1], torch.zeros_like(state.velocity[1]))


@pytest.mark.parametrize("soft_matching", [False, True])
def test_an_empty_place_is_nobodys_parent(soft_matching, generator):
    well = problems.DoubleWell()
    before = GaussianMixture(
        well.minima[[0, 0]],
        0.01 * torch.eye(2).double().expand(2, 2, 2),
        torch.tensor([-torch.inf, 0.0]).double(),
    )
    tracker = replace(CSS, soft_matching=soft_matching, num_modes=1)
    start = tracker.init(before, generator=generator)
    start = start._replace(mixture=before)
    _, info = tracker.step(start, SearchProblem(well), BOUNDS)
    assert info.parent.tolist() == [1]


@dataclass(frozen=True)
class AfterModes(problems.Alike):
    """What a frame says, and what the modes before make likely."""

    seen: problems.DoubleWell
    prior: Prior
    alone: bool = False

    def value(self, x):
        return self.local_model(x).value

    def local_model(self, x):
        past = MixturePrior().local_model(x, MixturePrior().density(self.prior.mixture))
        if self.alone:
            return past
        return LocalModel(*(a + b for a, b in zip(self.seen.local_model(x), past, strict=True)))

    @staticmethod
    def problem(well):
        def children(_, prior):
            cost = AfterModes(well, prior)
            return SearchProblem(cost, past=replace(cost, alone=True))

        return SearchProblem(well, of_children=children)


@pytest.mark.parametrize("soft", [True, False])
@pytest.mark.parametrize("power", [0.1, 1.0])
def test_the_past_counts_once(power, soft, generator):
    """The prior in the cost guides descents; weights are those of a cost without it."""
    well = problems.DoubleWell()
    before = GaussianMixture(
        well.minima,
        torch.diag_embed(torch.tensor([[0.01, 0.01], [0.04, 0.04]]).double()),
        torch.tensor([0.6, 0.4]).double().log(),
    )
    tracker = replace(CSS, soft_matching=soft, likelihood_power=power)
    start = tracker.init(before, generator=generator)
    runs = [
        list(problems.follow(tracker, start, [frame] * 12, BOUNDS))
        for frame in (SearchProblem(well), AfterModes.problem(well))
    ]
    for (plain, told), (state, info) in zip(*runs, strict=True):
        torch.testing.assert_close(state.mixture.weight, plain.mixture.weight, rtol=0, atol=0.01)
        torch.testing.assert_close(info.cost, told.cost, rtol=0, atol=0.01)
        # A frame that prefers neither makes neither surer.
        assert float(state.mixture.weight[0]) < 0.61


@pytest.mark.parametrize(
    ("separation", "kept"),
    # With 1.6 next neighbours are alike: 2 stands for 1, and of the others 0, the cheapest, for -1.
    [(1.4, [2]), (1.4, [2, 0]), (1.4, [2, 1, 0]), (1.6, [2, 0]), (1.6, [2, 0, -2])],
)
def test_with_soft_matching_who_weighs_most_is_kept(separation, kept, generator):
    """At 3, where the past is; three poses are cheaper, by half a nat, and new."""
    tracker = replace(
        CSS, num_samples=80, num_modes=len(kept), separation=separation, soft_matching=True,
        likelihood_power=0.1,
    )  # fmt: skip
    start = tracker.init(problems.single((3.0, 0.0), (0.8, 0.1)), generator=generator)
    state, info = tracker.step(start, with_landmarks(LandmarkedComb()), problems.box(2, -3.7, 3.7))
    assert (state.mixture.mean[:, 0] / 1.5).round().int().tolist() == kept
    assert int(info.parent[0]) == 0
    assert int(info.num_distinct) >= 4
    hard = replace(tracker, soft_matching=False)
    state, _ = hard.step(start, with_landmarks(LandmarkedComb()), problems.box(2, -3.7, 3.7))
    without = (state.mixture.mean[:, 0] / 1.5).round().int().tolist()
    assert (2 in without) == (separation == 1.6 and len(kept) > 1)


def test_halving_leaves_the_best_minima_and_takes_fewer_evaluations(generator):
    def run(survivors: int):
        tracker = replace(CSS, num_samples=200, num_modes=5, survivors=survivors)
        start = tracker.init(problems.single((0.0, 0.0), (0.6, 0.1)), generator=generator)
        return tracker.step(start, SearchProblem(Comb()), problems.box(2, -3.7, 3.7))

    (every, all_of_them), (halved, info) = run(0), run(20)
    torch.testing.assert_close(halved.mixture.mean[:3], every.mixture.mean[:3], rtol=0, atol=1e-3)
    assert int(info.num_samples) == int(all_of_them.num_samples) == 200
    assert int(info.status_counts.sum()) <= 20
    assert int(info.num_steps.sum()) < 0.8 * int(all_of_them.num_steps.sum())


class Crowded(problems.AutogradCost):
    """Nine narrow minima within 9 cm about 0, and three shallower ones, farther apart."""

    PLACES = (*(0.01 * k for k in range(-4, 5)), -2.0, 2.0, 3.0)
    DEPTHS = (*(9.0 - 0.1 * abs(k) for k in range(-4, 5)), 5.0, 4.0, 3.0)

    def __init__(self):
        places, depths = torch.tensor(self.PLACES).double(), torch.tensor(self.DEPTHS).double()
        width = torch.tensor([0.004] * 9 + [0.3] * 3).double()

        def value(x):
            wells = depths * torch.exp(-0.5 * ((x[0] - places) / width).square())
            return 10 - wells.sum() + 2 * x[1] ** 2

        super().__init__(value)

    def landmarks(self, x):
        return x[..., None, :]


class FromThePlaces:
    """A proposal that starts near every minimum."""

    def sample(self, mixture, num, bounds, *, generator):
        x = torch.tensor(Crowded.PLACES).double()[:, None] * torch.tensor([1.0, 0.0]).double()
        zero = torch.zeros(len(x)).double()
        return Samples(x + 0.001, zero.long(), zero)

    def log_density(self, mixture, x):
        return torch.zeros_like(x[..., 0])


def test_halving_leaves_what_is_unlike(generator):
    """Four places: the crowd of the best minima alone would fill them."""

    def found(separation: float) -> list[float]:
        tracker = replace(CSS, proposal=FromThePlaces(), num_samples=12, num_modes=4)
        tracker = replace(tracker, survivors=4, separation=separation)
        start = tracker.init(problems.single((0.0, 0.0), (1e-4, 0.1)), generator=generator)
        state, _ = tracker.step(start, with_landmarks(Crowded()), problems.box(2, -3.7, 3.7))
        return sorted(state.mixture.mean[:, 0].mul(10).round().int().tolist())  # decimetres

    assert found(0.0) == [0, 0, 0, 0]
    assert found(0.5) == [-20, 0, 20, 30]


@pytest.mark.parametrize(("survivors", "left"), [(4, 4), (2, 3)])
def test_halving_never_drops_modes_for_being_alike(generator, survivors, left):
    """Nor for want of places."""
    near = torch.tensor([[0.01, 0.0], [-0.02, 0.0], [0.03, 0.0]]).double()
    three = GaussianMixture(
        near, 1e-4 * torch.eye(2).double().expand(3, 2, 2), torch.zeros(3).double()
    )
    tracker = replace(CSS, num_samples=30, num_modes=6, survivors=survivors, separation=0.5)
    _, info = tracker.step(
        tracker.init(three, generator=generator), with_landmarks(Crowded()), BOUNDS
    )
    assert int(info.status_counts.sum()) == left
    assert {0, 1, 2} <= set(info.origin.tolist())


def test_halving_never_drops_the_modes_that_go_on(generator):
    """The lesser well is the worst of all starts once half of the samples are near the better."""
    well = problems.DoubleWell(tilt=0.4)
    both = GaussianMixture(
        well.minima,
        1e-4 * torch.eye(2).double().expand(2, 2, 2),
        torch.tensor([0.0, -9.0]).double(),
    )
    tracker = replace(CSS, num_samples=60, num_modes=2, survivors=4)
    state, _ = tracker.step(tracker.init(both, generator=generator), SearchProblem(well), BOUNDS)
    torch.testing.assert_close(
        state.mixture.mean.sort(dim=0).values, well.minima.sort(dim=0).values, rtol=0, atol=0.05
    )


PRINTED = replace(
    CSS,
    proposal=CovarianceScaled(covariance_scale=8, include_modes=False),
    coarse_every=0,
    converged_only=True,
    capped=False,
)


def test_covariances_as_printed_are_not_capped(generator):
    """A shallow bowl: its deviation of 100 exceeds the prior's by far."""
    bowl = SearchProblem(problems.Bowl(1e-4 * torch.eye(2).double(), torch.zeros(2).double()))
    for tracker, variance in ((CSS, 9.0), (PRINTED, 1e4)):
        state, info = tracker.step(
            tracker.init(problems.single(), generator=generator), bowl, BOUNDS
        )
        expected = variance * torch.eye(2).double()
        torch.testing.assert_close(state.mixture.covariance[0], expected)
        assert int(info.num_floored) == 0


def test_steps_3_to_6_of_figure_6_by_hand(generator):
    """The K likeliest in this frame alone; then the weight of the prior mode next to each."""

    def egg_box(x):
        near = 0.05 * (x - 0.5).square().sum()
        return near - 3 * torch.cos(2 * x[0]) - 2 * torch.cos(2 * x[1])

    weight = torch.tensor([0.6, 0.3, 0.1]).double()  # the cheapest minimum was the least before
    places = torch.tensor([[3.0, 0.0], [0.0, 3.0], [0.0, 0.0]]).double()
    before = GaussianMixture(places, 0.3 * torch.eye(2).double().expand(3, 2, 2), weight.log())
    problem = SearchProblem(problems.AutogradCost(egg_box))

    def after(num_modes: int):
        tracker = replace(PRINTED, num_samples=80, num_modes=num_modes)
        return tracker.step(tracker.init(before, generator=generator), problem, BOUNDS)

    # Of the same samples, since the generator's state is part of the tracker's.
    (_, every), (state, info) = after(80), after(3)
    assert int(info.num_distinct) == len(every.cost) > 6
    torch.testing.assert_close(info.cost.sort().values, every.cost.sort().values[:3])
    own = torch.cdist(state.mixture.mean, places).argmin(-1)
    assert own.tolist() == info.parent.tolist() == [0, 1, 2]
    assert int(info.cost.argmin()) == 2, "no longer in the order of cost"
    expected = (-info.cost).exp() * weight[own]
    torch.testing.assert_close(state.mixture.weight, expected / expected.sum())
    hessian = problem.cost.local_model(state.mixture.mean).hessian
    torch.testing.assert_close(state.mixture.covariance, torch.linalg.inv(hessian))


def test_floored_covariances_are_counted(generator):
    flat = SearchProblem(
        problems.Bowl(torch.diag(torch.tensor([4.0, 0.0])).double(), torch.zeros(2).double())
    )
    _, info = PRINTED.step(PRINTED.init(problems.single(), generator=generator), flat, BOUNDS)
    assert int(info.num_floored) == 40
    _, info = CSS.step(CSS.init(problems.single(), generator=generator), flat, BOUNDS)
    assert int(info.num_floored) == 0


@pytest.mark.parametrize("kind", [CovarianceScaled, HeavyTailed, Spherical])
def test_a_held_parameter_is_never_sampled(generator, kind):
    """The minimum is at the bound of the first, flattest parameter, in both frames."""
    bounds = problems.box(2, -6, 0.5)
    problem = SearchProblem(
        problems.Bowl(torch.diag(torch.tensor([1e-3, 1.0])).double(), torch.tensor([4.0, 0.0]))
    )
    proposal = kind(covariance_scale=4, include_modes=False)
    tracker = replace(PRINTED, proposal=proposal)
    state, _ = tracker.step(tracker.init(problems.single(), generator=generator), problem, bounds)
    assert state.mixture.mean[0, 0] == 0.5
    assert not bool(state.mixture.covariance[0, 0].any())
    samples = proposal.sample(state.mixture, 50, bounds, generator=generator)
    assert bool((samples.x[:, 0] == 0.5).all())
    assert float(samples.x[:, 1].std()) > 0.5
    state, info = tracker.step(state, problem, bounds)
    assert float(info.cost[0]) == pytest.approx(0.5 * 1e-3 * 3.5**2)
    assert all(bool(part.isfinite().all()) for part in state.mixture)


@dataclass(frozen=True)
class Rippled(problems.Alike):
    """Two valleys 4 apart, each with ripples half a centimetre long."""

    height: float = 0.3

    def _cost(self):
        def function(x):
            wells = 8 * ((x[0] / 2) ** 2 - 1) ** 2 + 0.5 * x[1] ** 2
            return wells - self.height * torch.cos(2 * torch.pi * x[0] / 0.005)

        return problems.AutogradCost(function)

    def value(self, x):
        return self._cost().value(x)

    def local_model(self, x):
        return self._cost().local_model(x)


def test_ripples_do_not_fool_the_test_for_confounded_minima(generator):
    """[IJRR] 3.3: after convergence modes are separated or confounded."""
    start = problems.single((2.0, 0.0), (1e-4, 0.01))
    both = GaussianMixture(*(torch.cat([part, part]) for part in start))
    both = both._replace(mean=torch.tensor([[-2.0, 0.0], [2.0, 0.0]]).double())
    problem = SearchProblem(Rippled(), landmarks=lambda x: x[:, None])
    found = {}
    for separation in (0.0, 0.03):
        tracker = replace(PRINTED, num_modes=5, separation=separation, keep_alike=False)
        state, info = tracker.step(tracker.init(both, generator=generator), problem, BOUNDS)
        assert int(info.num_distinct) > 5, "every ripple is a minimum of its own"
        found[separation] = state.mixture.mean[:, 0]
    apart = torch.pdist(found[0.0][:, None])
    assert float(apart.min()) < 0.006
    apart = torch.pdist(found[0.03][:, None])
    assert float(apart.min()) >= 0.03
    assert bool((found[0.03] > 1).any())
    assert bool((found[0.03] < -1).any())
