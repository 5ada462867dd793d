"""The long-tailed priors: derivatives, at the limits, where unknown, and far out."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.cost.stabiliser import Stabiliser, long_tailed
from torchcss.cost.term import differentiate_twice


def by_hand(x: Tensor, centre: Tensor, deviation: Tensor, nu: float) -> Tensor:
    """`nu / 2 log(1 + ((x - mu) / sigma)^2 / nu)`, summed."""
    z = (x - centre) / deviation
    return 0.5 * nu * torch.log1p(z.square() / nu).sum(-1)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("nu", [0.5, 9.0])
@pytest.mark.parametrize("spread", [0.1, 1.0, 100.0])
def test_derivatives_are_those_of_autograd(
    batch: tuple[int, ...], nu: float, spread: float, generator: torch.Generator
) -> None:
    n = 6
    x = spread * torch.randn(*batch, n, generator=generator, dtype=torch.float64)
    centre = torch.randn(n, generator=generator, dtype=torch.float64)
    deviation = 0.1 + torch.rand(n, generator=generator, dtype=torch.float64)
    deviation[2] = math.inf
    got = long_tailed(x, centre, deviation, nu)
    leaf = x.clone().requires_grad_()
    expected = differentiate_twice(by_hand(leaf, centre, deviation, nu), leaf)
    for ours, theirs in zip(got, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-10)


def test_near_rest_it_is_the_gaussian() -> None:
    centre = torch.tensor([0.3, -0.2], dtype=torch.float64)
    deviation = torch.tensor([0.1, 0.5], dtype=torch.float64)
    model = long_tailed(centre, centre, deviation, 9.0)
    assert float(model.value) == 0.0
    assert not model.gradient.any()
    torch.testing.assert_close(model.hessian, torch.diag(deviation.pow(-2)))


def test_the_pull_fades_beyond_root_nu_deviations() -> None:
    z = torch.linspace(0, 30, 3001, dtype=torch.float64)[:, None]
    one = torch.ones(1, dtype=torch.float64)
    pull = long_tailed(z, 0 * one, one, 9.0).gradient[:, 0]
    assert float(z[pull.argmax(), 0]) == pytest.approx(3.0, abs=0.02)
    assert float(pull[-1]) < 0.2 * float(pull.max())


def test_bodies_at_their_limits() -> None:
    for name in ("arm8", "body34"):
        body = load_body(name, free_proportions=True)
        bounds = body.bounds
        x = torch.stack([bounds.lower, bounds.upper, body.rest])
        x = torch.where(x.isfinite(), x, 1e3)
        model = long_tailed(x, body.sticky_mean, body.sticky_deviation, Stabiliser.nu)
        for part in model:
            assert torch.isfinite(part).all()
        leaf = x.clone().requires_grad_()
        value = by_hand(leaf, body.sticky_mean, body.sticky_deviation, 9.0)
        expected = differentiate_twice(value, leaf)
        for ours, theirs in zip(model, expected, strict=True):
            torch.testing.assert_close(ours, theirs)
        free = ~body.sticky_deviation.isfinite()
        assert not model.gradient[:, free].any()
        assert not model.hessian[:, free].any()


def test_no_prior_at_all() -> None:
    x = torch.randn(3, 2, dtype=torch.float64)
    nothing = torch.full((2,), math.inf, dtype=torch.float64)
    for part in long_tailed(x, 0 * nothing.reciprocal(), nothing, 9.0):
        assert not part.any()


@pytest.mark.parametrize(
    ("dtype", "far"),
    [(torch.float32, 1e10), (torch.float32, 1e30), (torch.float64, 1e100), (torch.float64, 1e300)],
)
def test_far_tails_stay_finite(dtype: torch.dtype, far: float) -> None:
    x = torch.tensor([[far], [-far]], dtype=dtype)
    model = long_tailed(x, torch.zeros(1).to(dtype), torch.ones(1).to(dtype), 9.0)
    for part in model:
        assert part.dtype == dtype
        assert torch.isfinite(part).all()
    assert model.value[0] > 40
    assert (model.gradient[:, 0] * x[:, 0] >= 0).all()


def test_the_papers_stabilise_what_is_hard_to_estimate() -> None:
    """Section 3.2.2: clavicles, spine, neck and twists; not what moves the limbs in the image."""
    for name, free in (("arm8", 3), ("body34", 14)):
        body = load_body(name)
        held = Stabiliser(hidden_only=True).deviation(body).isfinite()
        everything = Stabiliser().deviation(body).isfinite()
        assert int((everything & ~held).sum()) == free
        names = {name for name, has in zip(body.state_names, held.tolist(), strict=True) if has}
        assert not any("elbow" in name or "knee" in name or "root" in name for name in names)
        assert {"r_clavicle_protraction", "r_shoulder_twist"} <= names
