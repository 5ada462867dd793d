import problems
import pytest
import torch

from torchcss.inference.mixture import distinct_modes
from torchcss.inference.proposals import CovarianceScaled
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.studies import minima
from torchcss.studies.minima import (
    find_minima,
    is_minimum,
    joined_minima,
    low_path,
    other_minima,
)
from torchcss.types import LocalModel, Modes, Status

FREE = problems.unbounded(2)
BOX = problems.box(2, -3, 3)


def banana(ripple: float) -> problems.AutogradCost:
    """A steep valley along a parabola, with ripples of a given height on its floor."""

    def function(x):
        u, v = x.unbind(-1)
        wave = 0.5 * ripple * (1 - torch.cos(5 * torch.pi * u))
        return 500 * (v - u**2) ** 2 + wave + 0.01 * u**2

    return problems.AutogradCost(function)


def floor(cost: problems.AutogradCost):
    u = torch.linspace(-1.4, 1.4, 29, dtype=torch.float64)
    return TrustRegionNewton().minimise(cost, torch.stack([u, u**2], -1), BOX)


def test_ripples_on_a_curved_floor_are_one_valley():
    for ripple, valleys in [(0.05, 1), (2.0, None)]:
        cost = banana(ripple)
        modes = floor(cost)
        kept = distinct_modes(modes.mean, modes.covariance, modes.cost, distance=0.01)
        assert len(kept) == 7, "one minimum per wave"
        label = joined_minima(cost, modes.mean[kept], modes.covariance[kept], modes.cost[kept], BOX)
        assert len(label.unique()) == (valleys or len(kept))
        assert int(label[0]) == 0, "the lowest stands for its valley"


def test_a_straight_path_would_not_do(monkeypatch):
    cost = banana(0.0)
    u = torch.tensor([[-1.2, 1.44], [1.2, 1.44]]).double()
    assert float(cost.value(u.mean(0))) > 500
    assert bool(low_path(cost, u[:1], u[1:], BOX))
    monkeypatch.setattr(minima, "DEPTH", 1)
    assert not bool(low_path(cost, u[:1], u[1:], BOX))


@pytest.mark.parametrize("barrier", [0.05, 5.0])
def test_two_wells_are_one_if_the_barrier_is_low(barrier):
    well = problems.DoubleWell(barrier=barrier)
    covariance = 0.1 * torch.eye(2).double().expand(2, 2, 2)
    label = joined_minima(well, well.minima, covariance, torch.zeros(2).double(), FREE)
    assert len(label.unique()) == (1 if barrier < 0.1 else 2)


def test_bounds_stop_paths():
    """The way round leads outside."""
    cost = banana(0.0)
    u = torch.tensor([[-1.2, 1.44], [1.2, 1.44]]).double()
    narrow = problems.box(2, 1.0, 3.0)._replace(lower=torch.tensor([-3.0, 1.0]).double())
    assert not bool(low_path(cost, u[:1], u[1:], narrow))


def test_the_order_of_the_minima_is_irrelevant(generator):
    cost = banana(0.05)
    modes = floor(cost)
    kept = distinct_modes(modes.mean, modes.covariance, modes.cost, distance=0.01)
    order = kept[torch.randperm(len(kept), generator=generator)]
    label = joined_minima(cost, modes.mean[order], modes.covariance[order], modes.cost[order], BOX)
    assert float(modes.cost[order][label].unique().max()) == float(modes.cost[kept].min())


def test_saddles_slopes_and_failures_are_no_minima():
    well = problems.DoubleWell()
    x = torch.cat([well.minima, torch.tensor([[0.0, 0.0], [1.0, 0.5]]).double()])
    modes = TrustRegionNewton().minimise(well, x, FREE)
    honest = is_minimum(modes, well, FREE)
    assert bool(honest.all.all()), "the optimiser leaves a saddle"
    claimed = modes._replace(mean=x)
    tests = is_minimum(claimed, well, FREE)
    assert tests.upward.tolist() == [True, True, False, False]
    assert is_minimum(claimed, well, problems.box(2, -1.5, 1.5)).inside.tolist() == [
        False, False, True, True,
    ]  # fmt: skip
    stopped = modes._replace(status=torch.full_like(modes.status, int(Status.STEP_LIMIT)))
    assert not bool(is_minimum(stopped, well, FREE).all.any())


def test_an_end_that_is_not_finite_is_tested_beside_the_others():
    """The cost is not finite in the middle of the box either, where such ends are moved."""

    class HalfSpace(problems.Bowl):
        def local_model(self, x):
            nowhere = torch.where(x[..., 0] < 0.5, torch.nan, 0.0)
            value, gradient, hessian = super().local_model(x)
            return LocalModel(
                value + nowhere, gradient + nowhere[..., None], hessian + nowhere[..., None, None]
            )

    # Eigenvalues of smaller matrices do not raise.
    bowl, bounds = HalfSpace(torch.eye(3), torch.ones(3)), problems.box(3, -5, 5)
    x = torch.tensor([[1.5, 0.2, 0.0], [-1.0, 0.0, 0.0]]).double()
    modes = TrustRegionNewton().minimise(bowl, x, bounds)
    assert modes.status.tolist() == [Status.CONVERGED, Status.NON_FINITE]
    tests = is_minimum(modes, bowl, bounds)
    assert tests.all.tolist() == tests.upward.tolist() == [True, False]
    claimed = modes._replace(status=torch.full_like(modes.status, int(Status.CONVERGED)))
    assert is_minimum(claimed, bowl, bounds).all.tolist() == [True, False]


def test_a_held_variable_may_curve_downwards():
    """On the bound the well curves downwards along u, but the bound holds it there."""
    well = problems.DoubleWell(tilt=50.0)
    bounds = problems.box(2, -0.5, 3.0)
    modes = TrustRegionNewton().minimise(well, torch.tensor([[0.1, 0.0]]).double(), bounds)
    assert bool(modes.active[0, 0])
    assert bool(is_minimum(modes, well, bounds).all)
    free = modes._replace(active=torch.zeros_like(modes.active))
    assert not bool(is_minimum(free, well, bounds).upward)


@pytest.mark.parametrize("num", [0, 1])
def test_few_minima(num):
    well = problems.DoubleWell()
    covariance = torch.eye(2).double().expand(num, 2, 2)
    label = joined_minima(well, well.minima[:num], covariance, torch.zeros(num).double(), FREE)
    assert label.tolist() == list(range(num))


def test_a_run_finds_the_other_well_alone(generator):
    well = problems.DoubleWell()
    start = TrustRegionNewton().minimise(well, well.minima[0], FREE)
    wide = CovarianceScaled(deviation_scale=20)
    found = find_minima(
        well, start, FREE, proposal=wide, num_samples=50, generator=generator, distance=0.5
    )
    assert found.raw.shape == found.modes.mean.shape == (50, 2)
    torch.testing.assert_close(found.modes.mean[found.minima], well.minima[1:], rtol=0, atol=1e-3)
    same = Modes(*(field[None] for field in start))
    tests = is_minimum(same, well, FREE)
    assert len(other_minima(same, tests, start)) == 0
    assert len(other_minima(found.modes, found.tests, start, distance=1e6)) == 0


def test_nothing_converges(generator, monkeypatch):
    well = problems.DoubleWell()
    start = TrustRegionNewton().minimise(well, well.minima[0], FREE)
    monkeypatch.setattr(minima, "_STEPS", 1)
    wide = CovarianceScaled(deviation_scale=20)
    found = find_minima(well, start, FREE, proposal=wide, num_samples=10, generator=generator)
    assert not bool(found.tests.converged[1:].any())
    assert len(found.minima) == 0
