"""The iteration of fixed shape: the same mathematics as the optimiser's, never uphill."""

from __future__ import annotations

import math

import pytest
import torch
from peers.fixed_step import FixedStepState, fixed_step, refill, scaled_draw, start
from torch import Tensor

from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.studies.reprojection import reprojection_problem
from torchcss.types import Bounds, CostFunction, LocalModel

REAL = torch.float64


class Bowl:
    """A quadratic with a given Hessian and minimum."""

    def __init__(self, hessian: Tensor, minimum: Tensor) -> None:
        self.hessian, self.minimum = hessian, minimum

    def take(self, items: Tensor) -> Bowl:
        del items  # all samples descend in the same bowl
        return self

    def value(self, x: Tensor) -> Tensor:
        return self.local_model(x).value

    def local_model(self, x: Tensor) -> LocalModel:
        apart = x - self.minimum
        gradient = apart @ self.hessian
        return LocalModel(
            0.5 * (apart * gradient).sum(-1), gradient, self.hessian.expand(*x.shape, x.shape[-1])
        )


def box(n: int, half: float = math.inf) -> Bounds:
    limit = torch.full((n,), half, dtype=REAL)
    return Bounds(-limit, limit)


def iterate(
    cost: CostFunction, state: FixedStepState, bounds: Bounds, steps: int
) -> FixedStepState:
    for _ in range(steps):
        before = state.model.value
        state, _ = fixed_step(cost, state, bounds)
        assert bool((state.model.value <= before).all())
        assert bool((bounds.project(state.x) == state.x).all())
    return state


def test_a_step_is_equation_13(generator: torch.Generator) -> None:
    root = torch.randn(4, 4, generator=generator, dtype=REAL)
    cost = Bowl(root @ root.T, torch.randn(4, generator=generator, dtype=REAL))
    x = torch.randn(5, 4, generator=generator, dtype=REAL)
    scale = torch.tensor([1.0, 2.0, 0.5, 3.0], dtype=REAL)
    state, accepted = fixed_step(cost, start(x, damping=0.7), box(4), scale=scale)
    assert bool(accepted.all())
    damped = cost.hessian + 0.7 * torch.diag(scale**-2)
    expected = -torch.linalg.solve(damped, cost.local_model(x).gradient.T).T
    torch.testing.assert_close(state.step, expected)
    after, accepted = fixed_step(cost, state, box(4), scale=scale)
    assert bool(accepted.all())
    decrease = state.model.value - after.model.value
    torch.testing.assert_close(decrease, state.predicted)
    torch.testing.assert_close(after.damping, state.damping / 3)


def test_variables_at_bounds_are_held(generator: torch.Generator) -> None:
    root = torch.randn(4, 4, generator=generator, dtype=REAL)
    cost = Bowl(root @ root.T + torch.eye(4, dtype=REAL), torch.full((4,), 3.0, dtype=REAL))
    x = 4 * torch.randn(20, 4, generator=generator, dtype=REAL)
    state = iterate(cost, start(x), box(4, 2.0), 60)
    modes = TrustRegionNewton().minimise(cost, x, box(4, 2.0))
    torch.testing.assert_close(state.x, modes.mean, rtol=0, atol=1e-5)
    assert bool((state.x == 2).any())


def test_an_indefinite_matrix_is_damped_until_it_is_definite() -> None:
    cost = Bowl(torch.diag(torch.tensor([2.0, -50.0], dtype=REAL)), torch.zeros(2, dtype=REAL))
    x = torch.tensor([[1.0, 0.1]], dtype=REAL)
    state, _ = fixed_step(cost, start(x), box(2, 5.0))
    assert float(state.damping) == 100.0, "1, 10 and 100 were tried"
    assert float(state.predicted) > 0
    few, _ = fixed_step(cost, start(x), box(2, 5.0), factorisations=1)
    assert float(few.damping) == 1.0
    assert float(few.step.abs().sum()) == 0
    few, accepted = fixed_step(cost, few, box(2, 5.0), factorisations=1)
    assert not bool(accepted)
    assert float(few.damping) == 4.0
    end = iterate(cost, state, box(2, 5.0), 30)
    torch.testing.assert_close(end.x, torch.tensor([[0.0, 5.0]], dtype=REAL))


def test_the_minima_are_those_of_the_optimiser(generator: torch.Generator) -> None:
    problem = reprojection_problem("arm8", generator=generator)
    noise = torch.randn(40, 8, generator=generator, dtype=REAL)
    x = problem.bounds.project(problem.start.mean + 0.3 * noise)
    state = iterate(problem.cost, start(x), problem.bounds, 100)
    modes = TrustRegionNewton().minimise(problem.cost, x, problem.bounds)
    same = (state.x - modes.mean).abs().amax(-1) < 1e-3
    # From far away two ways of damping may lead to different minima.
    assert float(same.float().mean()) > 0.7
    free = (state.x > problem.bounds.lower) & (state.x < problem.bounds.upper)
    slope = torch.where(free, state.model.gradient, 0.0).abs().amax(-1)
    assert float((slope < 1e-2).float().mean()) > 0.9


def test_items_do_not_influence_each_other(generator: torch.Generator) -> None:
    problem = reprojection_problem("arm8", generator=generator)
    noise = torch.randn(6, 8, generator=generator, dtype=REAL)
    x = problem.bounds.project(problem.start.mean + 0.3 * noise)
    broken = x.index_fill(0, torch.tensor([2]), math.nan)
    others = torch.tensor([0, 1, 3, 4, 5])
    state, alone = start(broken), start(x[others])
    for _ in range(8):
        state, _ = fixed_step(problem.cost, state, problem.bounds)
        alone, _ = fixed_step(problem.cost, alone, problem.bounds)
    torch.testing.assert_close(state.x[others], alone.x, rtol=0, atol=1e-9)
    assert float(state.model.value[2]) == math.inf
    assert bool(state.x[2].isnan().all())


def test_refilled_places_begin_anew(generator: torch.Generator) -> None:
    cost = Bowl(torch.eye(3, dtype=REAL), torch.zeros(3, dtype=REAL))
    x, new = torch.randn(2, 4, 3, generator=generator, dtype=REAL)
    state = iterate(cost, start(x), box(3), 4)
    fresh = torch.tensor([True, False, False, True])
    mixed, _ = fixed_step(cost, refill(state, fresh, new), box(3))
    on, _ = fixed_step(cost, state, box(3))
    begun, _ = fixed_step(cost, start(new), box(3))
    for got, old, anew in zip(mixed[2:], on[2:], begun[2:], strict=True):
        torch.testing.assert_close(got[~fresh], old[~fresh])
        torch.testing.assert_close(got[fresh], anew[fresh])
    torch.testing.assert_close(mixed.x[fresh], new[fresh])


def test_a_refilled_place_forgets_its_last_item() -> None:
    """A start at which the cost is not finite stays, whoever was there before."""

    class Walled(Bowl):
        def local_model(self, x: Tensor) -> LocalModel:
            model = super().local_model(x)
            return model._replace(value=torch.where(x[:, 0] > 5, math.nan, model.value))

    cost = Walled(2 * torch.eye(2, dtype=REAL), torch.zeros(2, dtype=REAL))
    new = torch.tensor([[6.0, 4.0]], dtype=REAL)
    before, _ = fixed_step(cost, start(torch.tensor([[3.0, 4.0]], dtype=REAL)), box(2))
    state, begun = refill(before, torch.tensor([True]), new), start(new)
    for part, anew in zip(state.model, begun.model, strict=True):
        torch.testing.assert_close(part, anew)
    state = iterate(cost, state, box(2), 3)
    assert torch.equal(state.x, new)
    assert float(state.model.value) == math.inf


@pytest.mark.parametrize("scale", [2.0, torch.tensor(2.0, dtype=REAL)])
def test_draws_have_the_scaled_covariance(
    scale: float | Tensor, generator: torch.Generator
) -> None:
    num, factor = 40_000, torch.tensor([[1.0, 0.0], [0.5, 0.2]], dtype=REAL)
    noise = torch.randn(num, 2, generator=generator, dtype=REAL)
    mean = torch.tensor([3.0, -1.0], dtype=REAL)
    x = scaled_draw(mean.expand(num, 2), factor.expand(num, 2, 2), noise, scale)
    expected = 4 * factor @ factor.T
    deviation = expected.diagonal().sqrt()
    assert bool(((x.mean(0) - mean).abs() < 5 * deviation / num**0.5).all())
    error = torch.cov(x.T) - expected
    # A covariance of n samples is uncertain by at most sqrt(2 / n) of the deviations' product.
    assert bool((error.abs() < 5 * (2 / num) ** 0.5 * torch.outer(deviation, deviation)).all())
