"""`TrackingCost.value` inside the transforms of `torch.func`, and in forward mode."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from made_costs import make_full_cost, random_states
from torch import Tensor, func
from torch.autograd import forward_ad

from torchcss.cost.fused import engine_for
from torchcss.cost.total import TrackingCost
from torchcss.errors import ShapeError


@pytest.fixture(params=["eager", "fused"])
def cost(request: pytest.FixtureRequest) -> TrackingCost:
    return replace(make_full_cost(own_parents=4), engine=engine_for(request.param, "cpu"))


@pytest.fixture
def x(cost: TrackingCost, generator: torch.Generator) -> Tensor:
    return random_states(cost.body, 4, generator=generator)


def test_derivatives_are_those_of_the_local_model(cost: TrackingCost, x: Tensor) -> None:
    model = cost.local_model(x)
    got = {
        "grad": func.grad(lambda x: cost.value(x).sum())(x),
        "jacrev": func.jacrev(cost.value)(x).sum(1),
        "vjp": func.vjp(cost.value, x)[1](torch.ones_like(model.value))[0],
        "vmap": func.vmap(func.grad(cost.value))(x),
        "forward": func.vmap(func.jacfwd(cost.value))(x),
    }
    for name, gradient in got.items():
        assert torch.equal(gradient, model.gradient), name
    along = func.jvp(cost.value, (x,), (torch.ones_like(x),))
    with forward_ad.dual_level():
        dual = forward_ad.unpack_dual(cost.value(forward_ad.make_dual(x, torch.ones_like(x))))
    for value, tangent in (along, dual):
        torch.testing.assert_close(value, model.value)
        torch.testing.assert_close(tangent, model.gradient.sum(-1))
    for second in (func.hessian, lambda f: func.jacrev(func.jacrev(f))):
        torch.testing.assert_close(func.vmap(second(cost.value))(x), model.hessian)


def test_a_batch_is_evaluated_as_one(cost: TrackingCost, x: Tensor) -> None:
    value = cost.value(x)
    assert torch.equal(func.vmap(cost.value)(x), value)
    assert torch.equal(func.vmap(cost.value, in_dims=1)(x.T), value)
    twice = func.vmap(func.vmap(cost.value))(x.reshape(2, 2, -1))
    assert torch.equal(twice.flatten(), value)
    # Of samples with parents of their own all are needed.
    for part in (lambda: cost.value(x[:2]), lambda: func.vmap(cost.value, chunk_size=2)(x)):
        with pytest.raises(ShapeError, match="2 states, and the cost is that of 4 samples"):
            part()
    assert torch.equal(cost.take(torch.tensor([1, 3])).value(x[[1, 3]]), value[[1, 3]])
