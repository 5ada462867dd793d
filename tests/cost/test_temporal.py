"""The prior about the parent mode: one parent for all, or one for each."""

from __future__ import annotations

import math

import pytest
import torch

from torchcss.body.model import differentiate_twice
from torchcss.cost.temporal import TemporalPrior


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_derivatives_are_those_of_autograd(
    own: bool, batch: tuple[int, ...], generator: torch.Generator
) -> None:
    n = 5
    x = torch.randn(*batch, n, generator=generator, dtype=torch.float64)
    parent = torch.randn(*(batch if own else ()), n, generator=generator, dtype=torch.float64)
    deviation = 0.05 + torch.rand(n, generator=generator, dtype=torch.float64)
    deviation[1] = math.inf
    prior = TemporalPrior(nu=4.0)
    leaf = x.clone().requires_grad_()
    z = (leaf - parent) / deviation
    expected = differentiate_twice(2.0 * torch.log1p(z.square() / 4.0).sum(-1), leaf)
    got = prior.local_model(x, parent, deviation)
    assert got.value.shape == batch
    for ours, theirs in zip(got, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-10)


def test_each_item_knows_its_own_parent(generator: torch.Generator) -> None:
    x = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    model = TemporalPrior().local_model(x, x.clone(), torch.ones(3, dtype=torch.float64))
    assert not model.value.any()
    assert not model.gradient.any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_far_from_the_parent(dtype: torch.dtype) -> None:
    x = torch.full((2, 3), 1e30, dtype=dtype)
    model = TemporalPrior().local_model(x, -x, torch.full((3,), 1e-3).to(dtype))
    for part in model:
        assert part.dtype == dtype
        assert torch.isfinite(part).all()
