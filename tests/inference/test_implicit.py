"""How a minimum moves with the weights of its terms, against finite differences."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from made_costs import EVERYTHING, make_cost, random_states
from torch import Tensor

from torchcss.cost.total import TrackingCost
from torchcss.errors import ConfigurationError, ShapeError
from torchcss.inference.implicit import TermWeights, differentiable_minimum, weighted_minimum
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.types import Bounds, Modes, Status

NAMES = ("joints", "stabiliser", "temporal")
OPTIMISER = TrustRegionNewton(max_steps=200, tolerance=1e-14)


def weighed(cost: TrackingCost, weights: Tensor) -> TrackingCost:
    by_name = dict(zip(NAMES, weights.tolist(), strict=True))
    return replace(cost, choice=replace(cost.choice, weights=by_name))


def minimum(cost: TrackingCost, weights: Tensor, start: Tensor, bounds: Bounds) -> Modes:
    return OPTIMISER.minimise(weighed(cost, weights), start, bounds)


def attached(cost: TrackingCost, modes: Modes, weights: Tensor) -> Tensor:
    there = weighed(cost, torch.ones(len(NAMES))).gradients(modes.mean)
    return differentiable_minimum(
        modes.mean,
        weighed(cost, weights).local_model(modes.mean).hessian,
        torch.stack([there[name] for name in NAMES], dim=-2),
        modes.active.bool(),
        weights,
    )


@pytest.mark.parametrize("name", ["arm8", "body30"])
def test_derivatives_are_those_of_the_constrained_minimum(name: str) -> None:
    generator = torch.Generator().manual_seed(4)
    cost = make_cost(name, EVERYTHING.without("contour"))
    start = random_states(cost.body, 3, generator=generator)
    weights = torch.tensor([1.0, 2.0, 0.7], dtype=torch.float64, requires_grad=True)
    # Bounds that cut into the free minimum, so that several variables are held.
    free = minimum(cost, weights.detach(), start, cost.body.bounds)
    middle = free.mean[0]
    bounds = cost.body.bounds._replace(lower=cost.body.lower.clone(), upper=cost.body.upper.clone())
    bounds.upper[6:8] = middle[6:8] - 0.1
    bounds.lower[:] = torch.minimum(bounds.lower, bounds.upper - 0.5)
    start = bounds.project(free.mean)
    modes = minimum(cost, weights.detach(), start, bounds)
    ended = (Status.CONVERGED, Status.SMALL_STEP)
    assert all(Status(int(status)) in ended for status in modes.status)
    assert bool(modes.active.any())
    assert not bool(modes.active.all(-1).any())

    direction = torch.randn(modes.mean.shape, generator=generator, dtype=torch.float64)
    x = attached(cost, modes, weights)
    torch.testing.assert_close(x.detach(), modes.mean, rtol=0, atol=0)
    (gradient,) = torch.autograd.grad((direction * x).sum(), weights)
    step = 1e-3
    for term in range(len(NAMES)):
        ends = []
        for sign in (1, -1):
            moved = weights.detach().clone()
            moved[term] += sign * step
            ends.append(minimum(cost, moved, modes.mean, bounds))
        # A finite difference means nothing where a bound lets go in between.
        assert torch.equal(ends[0].active, ends[1].active)
        expected = float((direction * (ends[0].mean - ends[1].mean)).sum() / (2 * step))
        assert float(gradient[term]) == pytest.approx(expected, rel=2e-4, abs=1e-6)


def test_weights_are_learnt_from_where_the_minimum_should_be() -> None:
    """Descent on the weights finds those that a minimum was made with."""
    generator = torch.Generator().manual_seed(4)
    cost = make_cost("arm8", EVERYTHING.without("contour"))
    start = random_states(cost.body, 4, generator=generator)
    true = {"joints": 1.0, "stabiliser": 5.0, "temporal": 0.2}
    bounds = cost.body.bounds
    wanted = OPTIMISER.minimise(cost.with_weights(true), start, bounds).mean
    weights = TermWeights(("stabiliser", "temporal"))
    descent = torch.optim.Adam(weights.parameters(), lr=0.2)
    losses = []
    for _ in range(40):
        descent.zero_grad()
        x = weighted_minimum(cost, weights, wanted, bounds)
        loss = (x - wanted).square().sum()
        loss.backward()
        descent.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.02 * losses[0]
    learnt = weights.factors()
    assert learnt["stabiliser"] > 2.5
    assert learnt["temporal"] < 0.5
    # Terms that are not weighed keep the weights that they have.
    heavy = cost.with_weights(true)
    kept = OPTIMISER.minimise(heavy, wanted, bounds).mean
    alone = TermWeights(("temporal",), {"temporal": true["temporal"]})
    found = weighted_minimum(heavy, alone, wanted, bounds, optimiser=OPTIMISER)
    torch.testing.assert_close(found.detach(), kept)
    # A term that the frame does not have is silent.
    silent = TermWeights(("flow", "temporal"))
    weighted_minimum(cost, silent, start, bounds).sum().backward()
    assert silent.log_weight.grad is not None
    assert float(silent.log_weight.grad[0]) == 0.0


def test_the_gradients_by_term_add_up(generator: torch.Generator) -> None:
    cost = make_cost("arm8", EVERYTHING)
    x = random_states(cost.body, 2, 3, generator=generator)
    factors = {"contour": 0.3, "temporal": 4.0, "joints": 0.0}
    heavy = replace(cost, choice=replace(cost.choice, weights=factors))
    plain, own = cost.gradients(x), heavy.gradients(x)
    assert set(plain) == set(cost.terms(x))
    for name, gradient in plain.items():
        torch.testing.assert_close(own[name], factors.get(name, 1.0) * gradient)
    torch.testing.assert_close(sum(own.values()), heavy.local_model(x).gradient)
    for name, value in cost.terms(x).items():
        torch.testing.assert_close(heavy.terms(x)[name], factors.get(name, 1.0) * value)
    assert cost.gradients(x[:0]) == {}


def test_flat_and_downward_directions_move_nothing() -> None:
    hessian = torch.diag(torch.tensor([2.0, 0.0, -1.0])).double()
    gradients = torch.tensor([[1.0, 1.0, 1.0], [-1.0, -1.0, -1.0]]).double()
    weights = torch.ones(2, dtype=torch.float64, requires_grad=True)
    held = torch.zeros(3, dtype=torch.bool)
    x = differentiable_minimum(torch.zeros(3).double(), hessian, gradients, held, weights)
    x.sum().backward()
    assert weights.grad is not None
    torch.testing.assert_close(weights.grad, torch.tensor([-0.5, 0.5]).double())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rounding_is_no_curvature(generator: torch.Generator, dtype: torch.dtype) -> None:
    """Of a Hessian of rank 2, whose flat directions have curvatures of rounding alone."""
    root = torch.randn(2, 6, generator=generator, dtype=torch.float64)
    gradients = torch.randn(3, 6, generator=generator, dtype=torch.float64)
    weights = torch.ones(3, dtype=dtype, requires_grad=True)
    hessian, held = (root.mT @ root).to(dtype), torch.zeros(6, dtype=torch.bool)
    x = differentiable_minimum(
        torch.zeros(6, dtype=dtype), hessian, gradients.to(dtype), held, weights
    )
    x.sum().backward()
    assert weights.grad is not None
    expected = -gradients @ torch.linalg.pinv(root.mT @ root, rtol=1e-9).sum(-1)
    torch.testing.assert_close(weights.grad, expected.to(dtype), rtol=1e-3, atol=1e-4)


def test_weights_are_positive_and_named() -> None:
    weights = TermWeights(("flow", "contour"), {"flow": 3.0})
    assert weights.factors() == pytest.approx({"flow": 3.0, "contour": 1.0})
    assert len(list(weights.parameters())) == 1
    with pytest.raises(ConfigurationError, match="no terms"):
        TermWeights(("flow",), {"joints": 1.0})
    with pytest.raises(ConfigurationError, match="positive weight of flow"):
        TermWeights(("flow",), {"flow": 0.0})
    with pytest.raises(ShapeError, match="gradients"):
        differentiable_minimum(
            torch.zeros(3), torch.eye(3), torch.zeros(1, 3), torch.zeros(3), torch.ones(2)
        )
