"""Robust error potentials, section 3.1.1 [IJRR].

A residual r enters the cost as e = 1/2 rho(s), where s = r W r^T >= 0 is its squared weighted
length. Every potential satisfies

    rho(0) = 0,    rho'(0) = nu / sigma^2,    rho increasing,

so that all of them agree on small residuals: a central peak of scale sigma against a spread of
outliers nu. They differ in what a large residual costs.

| potential | rho(s), with z = s / sigma^2 | rho saturates at |
|---|---|---|
| `Quadratic` | nu z (Gaussian errors) | never |
| `Lorentzian` | nu log(1 + z) | never, but only logarithmically |
| `Charbonnier` | nu ((1 + z)^a - 1) / a, 0 < a < 1 | never, but more slowly than `Quadratic` |
| `Leclerc` | nu (1 - exp(-z)) | nu |

The cost, half of rho, reaches nu / 2 at most with `Leclerc`. Eq. 5 [IJRR] counts a node that faces
away with nu, and a hidden one with k nu, without the half.

By default: `Lorentzian` for correspondences, which pull from afar; `Leclerc` where what is far off
must not pull.

The derivatives are with respect to s. Those of the cost e with respect to the residual are, with
v = W r, the gradient rho' v and the Hessian rho' W + 2 rho'' v v^T (eq. 9 [RR]).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.errors import check_positive, check_range
from torchcss.types import Numbers, frozen


class RobustValue(NamedTuple):
    """A potential and its derivatives with respect to the squared weighted error s.

    Attributes:
        rho: The potential, in the unit of nu; a residual costs half of it.
        first: First derivative, never negative.
        second: Second derivative, never positive.
    """

    rho: Numbers
    first: Numbers
    second: Numbers


@frozen
class RobustPotential(ABC):
    """An increasing function of the squared weighted error with its first two derivatives.

    Attributes:
        nu: Spread of the outliers, positive; the unit in which costs are normalised, eq. 5 [IJRR].
        sigma: Scale of the central peak in the unit of the weighted residual, positive.
    """

    nu: float = 1.0
    sigma: float = 1.0

    def __post_init__(self) -> None:
        check_positive(self, "nu", "sigma", finite=True)
        check_range(self, "sigma", most=1e100, hint=", whose square is a number too")

    @abstractmethod
    def __call__(self, s: Numbers) -> RobustValue:
        """Evaluate at squared weighted errors, none negative."""


@frozen
class Quadratic(RobustPotential):
    """The Gaussian error model, rho = nu s / sigma^2: no outliers expected.

    Attributes:
        nu: Spread of the outliers, here a mere factor.
        sigma: Scale of the central peak in the unit of the weighted residual.
    """

    def __call__(self, s: Numbers) -> RobustValue:
        """Evaluate at squared weighted errors."""
        slope = self.nu / self.sigma**2
        return RobustValue(slope * s, torch.full_like(s, slope), torch.zeros_like(s))


@frozen
class Lorentzian(RobustPotential):
    """The Lorentzian potential of section 3.1.1 [IJRR], rho = nu log(1 + s / sigma^2).

    Attributes:
        nu: Spread of the outliers.
        sigma: Scale of the central peak in the unit of the weighted residual.
    """

    def __call__(self, s: Numbers) -> RobustValue:
        """Evaluate at squared weighted errors."""
        variance = self.sigma**2
        inverse = (s + variance).reciprocal()
        first = self.nu * inverse
        return RobustValue(self.nu * torch.log1p(s / variance), first, -first * inverse)


@frozen
class Charbonnier(RobustPotential):
    """The generalised Charbonnier potential, rho = nu ((1 + s / sigma^2)^a - 1) / a.

    Between `Lorentzian`, its limit for a = 0, and `Quadratic`, a = 1; with a = 1/2 it is the one of
    Charbonnier et al. (1994). Sun, Roth and Black (2010) find a = 0.45 best for optical flow.

    Attributes:
        nu: Spread of the outliers, here a mere factor.
        sigma: Scale of the central peak in the unit of the weighted residual.
        power: The power a, between 0 and 1.
    """

    power: float = 0.45

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "power", least=1e-3, most=1.0)

    def __call__(self, s: Numbers) -> RobustValue:
        """Evaluate at squared weighted errors."""
        variance, power = self.sigma**2, self.power
        growth = torch.log1p(s / variance)
        first = (self.nu / variance) * torch.exp((power - 1) * growth)
        second = (power - 1) * first / (s + variance)
        return RobustValue(self.nu / power * torch.expm1(power * growth), first, second)


@frozen
class Leclerc(RobustPotential):
    """The Leclerc potential of section 3.1.1 [IJRR], rho = nu (1 - exp(-s / sigma^2)).

    Attributes:
        nu: Spread of the outliers; also what rho rises to, so that no residual costs more than
            nu / 2.
        sigma: Scale of the central peak in the unit of the weighted residual.
    """

    def __call__(self, s: Numbers) -> RobustValue:
        """Evaluate at squared weighted errors."""
        variance = self.sigma**2
        z = s / variance
        first = (self.nu / variance) * torch.exp(-z)
        return RobustValue(-self.nu * torch.expm1(-z), first, -first / variance)


def residual_cost(
    potential: RobustPotential,
    residual: Float[Tensor, "*batch c"],
    weight: Float[Tensor, "*#batch"],
    share: Float[Tensor, "*#batch"] | float = 1.0,
) -> tuple[Numbers, Float[Tensor, "*batch c"], Float[Tensor, "*batch c c"]]:
    """Costs of residuals with their derivatives in the residuals.

    Args:
        potential: The potential.
        residual: The residuals.
        weight: W, the same for all components.
        share: Factor on the derivatives, for residuals that count in part.

    Returns:
        1/2 rho, and `share` times gradient and Hessian.
    """
    rho, first, second = potential(weight * residual.square().sum(-1))
    stiffness = share * weight * first
    bend = (2 * share * weight.square() * second)[..., None, None]
    hessian = residual[..., :, None] * residual[..., None, :] * bend
    torch.linalg.diagonal(hessian).add_(stiffness[..., None])
    return 0.5 * rho, stiffness[..., None] * residual, hessian
