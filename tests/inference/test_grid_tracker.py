"""Fig. 4 [RR], on costs whose minima and Hessians are known."""

import math
from dataclasses import dataclass, replace

import problems
import pytest
import torch

from torchcss.errors import ConfigurationError
from torchcss.inference.grid_tracker import GridTracker
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.problem import SearchProblem
from torchcss.inference.proposals import EigenDirectionGrid
from torchcss.linalg import LEAST_CURVATURE
from torchcss.types import LocalModel, Status

BOUNDS = problems.box(2, -6, 6)
ARM = GridTracker(num_samples=9, num_modes=3, pattern=EigenDirectionGrid(num_directions=1))
START = torch.Generator().manual_seed(0)


@dataclass(frozen=True)
class Counted(problems.Alike):
    """Any cost, with every state at which it was asked."""

    cost: object
    values: list
    models: list

    @staticmethod
    def of(cost: object) -> "Counted":
        return Counted(cost, [], [])

    def value(self, x):
        self.values.append(x)
        return self.cost.value(x)

    def local_model(self, x):
        self.models.append(x)
        return self.cost.local_model(x)


def bowl(*curvature: float, minimum=(0.0, 0.0)) -> problems.Bowl:
    hessian = torch.diag(torch.tensor(curvature)).double()
    return problems.Bowl(hessian, torch.tensor(minimum).double())


def test_k_hypotheses_descend_and_the_pattern_is_scored_alone():
    """The starts of the next frame are the best k of the pool, undescended."""
    cost, edges = Counted.of(bowl(100.0, 4.0)), Counted.of(bowl(1.0, 1.0, minimum=(0.0, 9.0)))
    problem = SearchProblem(cost, screening=edges)
    state, info = ARM.step(ARM.init(problems.single(), generator=START), problem, BOUNDS)
    assert int(info.num_samples) == 3
    assert info.status_counts.tolist()[Status.CONVERGED] == 3
    assert len(cost.models[0]) == 3
    assert not cost.values, "the full cost scores nothing"
    # First the pattern about the fit, then that about the three minima, which are one.
    assert [len(x) for x in edges.values] == [3, 9]
    pool = edges.values[1]
    torch.testing.assert_close(pool[::3], torch.zeros(3, 2).double(), rtol=0, atol=1e-6)
    # Of Hessian diag(100, 4) the second direction is the less certain: sigma is a half.
    torch.testing.assert_close(
        pool[1:3].abs(), torch.tensor([[0.0, 0.5]]).double().expand(2, 2), rtol=0, atol=1e-6
    )
    assert state.particles is not None
    torch.testing.assert_close(
        state.particles.x, torch.tensor([[0.0, 0.5]]).double().expand(3, 2), rtol=0, atol=1e-6
    )
    # Minima that are one count three times: there is no test for duplicates.
    torch.testing.assert_close(state.mixture.weight, torch.full((3,), 1 / 3).double())
    again = Counted.of(bowl(100.0, 4.0))
    ARM.step(state, SearchProblem(again), BOUNDS)
    assert torch.equal(again.models[0], state.particles.x), "no dynamics"


def test_the_first_hypotheses_are_the_pattern_about_the_fit():
    body = replace(ARM, num_samples=49, num_modes=7, pattern=EigenDirectionGrid())
    cost = Counted.of(bowl(1.0, 1.0))
    body.step(body.init(problems.single(), generator=START), SearchProblem(cost), BOUNDS)
    fit, step = torch.tensor([2.0, 1.0]), torch.tensor([[1.0, 0.0], [0.0, 0.5]])
    expected = torch.stack([fit, fit - step[0], fit + step[0], fit - step[1], fit + step[1]])
    found = torch.cdist(cost.models[0], expected.double()).amin(0)
    assert float(found.max()) < 1e-9


def test_both_wells_are_kept_with_weights_of_this_frame_alone():
    well = problems.DoubleWell(tilt=0.4)
    tracker = replace(ARM, num_modes=2)
    both = GaussianMixture(
        well.minima, 0.01 * torch.eye(2).double().expand(2, 2, 2), torch.tensor([-5.0, 0.0])
    )
    state = tracker.init(both, generator=START)
    for _ in range(3):
        state, info = tracker.step(state, SearchProblem(well), BOUNDS)
        torch.testing.assert_close(state.mixture.weight, (-info.cost).softmax(0))
    assert not int(info.num_floored)


def test_a_held_parameter_is_no_direction_of_the_pattern():
    """The minimum is at the upper bound of the first parameter, the flattest of all."""
    bounds = problems.box(2, -6, 0.5)
    edges = Counted.of(bowl(1.0, 1.0))
    problem = SearchProblem(bowl(1e-3, 1.0, minimum=(4.0, 0.0)), screening=edges)
    state, _ = ARM.step(ARM.init(problems.single(), generator=START), problem, bounds)
    pool = edges.values[-1]
    assert bool((pool[:, 0] == 0.5).all())
    assert float(pool[:, 1].abs().max()) == pytest.approx(1.0)
    assert not bool(state.mixture.covariance[:, 0].any())


def test_what_has_not_converged_is_left_out_and_all_stay_if_none_has():
    hurried = replace(ARM, optimiser=replace(ARM.optimiser, max_steps=1))
    well = SearchProblem(problems.DoubleWell())
    begun, _ = ARM.step(ARM.init(problems.single(), generator=START), well, BOUNDS)
    state, info = hurried.step(begun, well, BOUNDS)
    assert int(info.num_distinct) == int(info.status_counts[Status.CONVERGED])
    first, info = hurried.step(
        hurried.init(problems.single((0.3, 1.0)), generator=START), well, BOUNDS
    )
    assert int(info.num_distinct) == 0
    assert info.cost.tolist() == [math.inf]
    assert torch.equal(first.mixture.mean, problems.single((0.3, 1.0)).mean)

    class Nowhere(problems.DoubleWell):
        def local_model(self, x):
            return LocalModel(*(torch.full_like(v, torch.nan) for v in super().local_model(x)))

    lost, info = ARM.step(state, SearchProblem(Nowhere()), BOUNDS)
    assert (int(info.num_distinct), int(info.num_floored)) == (0, 0)
    assert torch.equal(lost.mixture.mean, state.mixture.mean)


def test_nothing_is_random_and_steps_are_pure():
    wells = [SearchProblem(problems.DoubleWell(tilt=0.1 * t)) for t in range(6)]
    start = ARM.init(problems.single(), generator=START)
    *_, (whole, _) = problems.follow(ARM, start, wells, BOUNDS)
    *_, (half, _) = problems.follow(ARM, start, wells[:3], BOUNDS)
    *_, (end, _) = problems.follow(ARM, half, wells[3:], BOUNDS)
    other = ARM.init(problems.single(), generator=torch.Generator().manual_seed(9))
    *_, (same, _) = problems.follow(ARM, other, wells, BOUNDS)
    for one in (end, same):
        assert whole.particles is not None
        assert one.particles is not None
        for a, b in zip((*whole.mixture, *whole.particles), (*one.mixture, *one.particles),
                        strict=True):  # fmt: skip
            assert torch.equal(a, b)
    assert int(end.frame) == 6
    assert ARM.stated_power == 1


def test_floored_hessians_are_counted():
    """Of a parameter about which the cost says nothing, the deviation is that of the floor."""
    problem = SearchProblem(bowl(40.0, 0.0))
    start = ARM.init(problems.single(), generator=START)
    state, info = ARM.step(start, problem, BOUNDS)
    assert int(info.num_floored) == 3
    expected = torch.tensor([1 / 40, 9.0 / LEAST_CURVATURE]).double()
    torch.testing.assert_close(state.mixture.covariance[0].diagonal(), expected)


def test_bad_numbers():
    with pytest.raises(ConfigurationError, match=r"GridTracker.num_modes"):
        replace(ARM, num_modes=0)
