"""Robust potentials: derivatives against autograd, kornia's losses, shapes, limits."""

from __future__ import annotations

import math

import kornia.losses
import pytest
import torch

from torchcss.errors import ConfigurationError
from torchcss.robust import Charbonnier, Leclerc, Lorentzian, Quadratic, RobustPotential

KINDS = [Quadratic, Lorentzian, Charbonnier, Leclerc]
POTENTIALS = [kind(nu=1.7, sigma=0.6) for kind in KINDS]
MOST = {Quadratic: math.inf, Lorentzian: math.inf, Charbonnier: math.inf, Leclerc: 1.7}
PROBES = [0.0, 1e-12, 1e-4, 0.1, 0.36, 1.0, 2.999, 3.001, 50.0, 1e4, 1e8]


@pytest.mark.parametrize("potential", POTENTIALS)
def test_derivatives_agree_with_autograd(potential: RobustPotential) -> None:
    s = torch.tensor(PROBES, dtype=torch.float64)
    value = potential(s)

    def total(s: torch.Tensor) -> torch.Tensor:
        return potential(s).rho.sum()

    first = torch.autograd.functional.jacobian(total, s)
    second = torch.autograd.functional.hessian(total, s).diagonal()
    torch.testing.assert_close(value.first, first, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(value.second, second, rtol=1e-12, atol=1e-14)
    assert (value.first >= 0.0).all()
    assert (value.second <= 0.0).all()


@pytest.mark.parametrize("potential", POTENTIALS)
def test_behaviour_at_zero_and_far_out(potential: RobustPotential) -> None:
    assert isinstance(potential, RobustPotential)
    zero = potential(torch.zeros((), dtype=torch.float64))
    assert zero.rho == 0.0
    assert float(zero.first) == pytest.approx(1.7 / 0.6**2, rel=1e-14)
    rho = potential(torch.tensor(PROBES, dtype=torch.float64)).rho
    assert (rho.diff() >= 0.0).all()
    most = MOST[type(potential)]
    assert (rho <= most).all()
    if math.isfinite(most):
        assert float(rho[-1]) == pytest.approx(most, rel=1e-12)
    far = potential(torch.tensor([1e20, 1e37]))
    assert all(torch.isfinite(tensor).all() for tensor in far)


@pytest.mark.parametrize("potential", POTENTIALS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_shapes_and_dtypes(
    potential: RobustPotential,
    dtype: torch.dtype,
    batch: tuple[int, ...],
    generator: torch.Generator,
) -> None:
    s = 10.0 * torch.rand(batch, dtype=torch.float64, generator=generator)
    for tensor, reference in zip(potential(s.to(dtype)), potential(s), strict=True):
        assert tensor.dtype == dtype
        assert tensor.shape == batch
        torch.testing.assert_close(tensor.double(), reference, rtol=1e-5, atol=1e-6)


def test_small_errors_keep_their_digits() -> None:
    s = torch.tensor([1e-12], dtype=torch.float32)
    for potential in POTENTIALS:
        torch.testing.assert_close(potential(s).rho, s * (1.7 / 0.36), rtol=1e-5, atol=0.0)


def test_kornia_agrees(generator: torch.Generator) -> None:
    """Kornia's losses take a residual and have sigma^2 = 2 in our terms."""
    residual = 5.0 * torch.randn(100, dtype=torch.float64, generator=generator)
    zero, root_two = torch.zeros_like(residual), math.sqrt(2.0)
    torch.testing.assert_close(
        Lorentzian(sigma=root_two)(residual.square()).rho,
        kornia.losses.cauchy_loss(residual, zero, reduction="none"),
    )
    torch.testing.assert_close(
        Leclerc(sigma=root_two)(residual.square()).rho,
        kornia.losses.welsch_loss(residual, zero, reduction="none"),
    )
    torch.testing.assert_close(
        Charbonnier(nu=0.5, power=0.5)(residual.square()).rho,
        kornia.losses.charbonnier_loss(residual, zero, reduction="none"),
    )


def test_charbonnier_lies_between_its_neighbours() -> None:
    s = torch.tensor(PROBES, dtype=torch.float64)
    for power, neighbour in ((1.0, Quadratic), (1e-3, Lorentzian)):
        got, expected = (
            Charbonnier(nu=1.7, sigma=0.6, power=power)(s),
            neighbour(nu=1.7, sigma=0.6)(s),
        )
        torch.testing.assert_close(got.rho, expected.rho, rtol=0.02, atol=0)
        torch.testing.assert_close(got.first, expected.first, rtol=0.03, atol=0)
    for power in (0.0, 1.1, math.nan):
        with pytest.raises(ConfigurationError, match="power"):
            Charbonnier(power=power)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_bad_parameters_are_refused(kind: type, bad: float) -> None:
    for name in ("nu", "sigma"):
        with pytest.raises(ConfigurationError, match=name):
            kind(**{name: bad})
