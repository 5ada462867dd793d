"""Where to look next: proposals that turn a mixture into starts for the optimiser.

The paper's answer is `CovarianceScaled` (Fig. 6, steps 1 to 2.2): sample each mode's own Gaussian,
inflated, so that most samples fall along the valleys in which other minima are likely, at low cost.
`HeavyTailed` replaces the Gaussian by a Student t. `Spherical` is the paper's control with the same
volume and no shape; `EigenDirectionGrid` is the regular pattern of Fig. 4 [RR].

A scale is always named: `covariance_scale = s` multiplies the covariance (Fig. 6, s = 4 to 14),
`deviation_scale = d` the standard deviations (Table 1; `d = sqrt(s)`). Exactly one is given.

Samples outside the bounds are projected onto them (design decision 10). What to call by default:
`CovarianceScaled(covariance_scale=8)`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.errors import ConfigurationError
from torchcss.inference.mixture import GaussianMixture, draw_components, standard_normal
from torchcss.linalg import covariance_factor, log_determinant
from torchcss.types import Bounds


class Samples(NamedTuple):
    """Starts for the optimiser.

    Attributes:
        x: Admissible states.
        parent: The mixture component that each came from.
    """

    x: Float[Tensor, "s n"]
    parent: Int[Tensor, " s"]


class Proposal(Protocol):
    """Anything that draws starts from a mixture."""

    def sample(
        self, mixture: GaussianMixture, num: int, bounds: Bounds, *, generator: torch.Generator
    ) -> Samples:
        """Draw `num` admissible samples (a regular pattern may give fewer)."""
        ...


def _deviation_factor(
    covariance_scale: float | None, deviation_scale: float | None, name: str
) -> float:
    """Return the one factor on standard deviations that two named parameters stand for."""
    given = [s for s in (covariance_scale, deviation_scale) if s is not None]
    if len(given) != 1 or not (math.isfinite(given[0]) and given[0] > 0):
        raise ConfigurationError(
            f"{name}: expected exactly one positive scale, got covariance_scale="
            f"{covariance_scale} and deviation_scale={deviation_scale}; give one of the two"
        )
    return given[0] if covariance_scale is None else math.sqrt(given[0])


def _capped(
    covariance: Float[Tensor, "k n n"], max_deviation: float | tuple[float, ...] | None
) -> Float[Tensor, "k n n"]:
    """Shrink parameters whose standard deviation exceeds a limit; correlations stay."""
    if max_deviation is None:
        return covariance
    limit = torch.as_tensor(max_deviation, dtype=covariance.dtype, device=covariance.device)
    deviation = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    shrink = torch.where(deviation > limit, limit / deviation, 1.0)
    return covariance * shrink[..., :, None] * shrink[..., None, :]


def _scatter(
    mixture: GaussianMixture,
    covariance: Float[Tensor, "k n n"],
    num: int,
    bounds: Bounds,
    draw: Callable[[int], Float[Tensor, "s n"]],
    *,
    include_modes: bool,
    stratified: bool,
    generator: torch.Generator,
) -> Samples:
    """Perturb modes by covariances, each chosen with its weight."""
    own = mixture.log_weight[:0].long()
    if include_modes:
        own = mixture.log_weight.argsort(descending=True, stable=True)[:num]
    count = num - len(own)
    parent = draw_components(mixture.log_weight, count, generator=generator, stratified=stratified)
    offset = (covariance_factor(covariance)[parent] @ draw(count)[..., None])[..., 0]
    parent = torch.cat([own, parent])
    x = mixture.mean[parent] + torch.cat([torch.zeros_like(mixture.mean[own]), offset])
    return Samples(bounds.project(x), parent)


@dataclass(frozen=True, kw_only=True)
class CovarianceScaled:
    """Sample every mode's Gaussian, inflated: `N(mu_i, s Sigma_i)`, Fig. 6 step 1.

    Attributes:
        covariance_scale: `s`, the factor on the covariance.
        deviation_scale: The factor on the standard deviations, instead of `covariance_scale`.
        include_modes: Have the modes themselves, unperturbed, first among the samples, so that what
            was found once is followed however small its weight.
        stratified: See `draw_components`.
        max_deviation: Limit on the standard deviation of the samples, one number or one per
            parameter; None for none.
    """

    covariance_scale: float | None = None
    deviation_scale: float | None = None
    include_modes: bool = True
    stratified: bool = False
    max_deviation: float | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        _deviation_factor(self.covariance_scale, self.deviation_scale, type(self).__name__)

    def sample(
        self, mixture: GaussianMixture, num: int, bounds: Bounds, *, generator: torch.Generator
    ) -> Samples:
        """Draw samples, projected onto the bounds."""
        factor = _deviation_factor(self.covariance_scale, self.deviation_scale, type(self).__name__)

        def draw(count: int) -> Tensor:
            return standard_normal(
                (count, mixture.mean.shape[-1]), mixture.mean, generator=generator
            )

        return _scatter(
            mixture,
            _capped(factor**2 * mixture.covariance, self.max_deviation),
            num,
            bounds,
            draw,
            include_modes=self.include_modes,
            stratified=self.stratified,
            generator=generator,
        )


@dataclass(frozen=True, kw_only=True)
class HeavyTailed:
    """Sample a Student t of every mode: mostly near, sometimes very far.

    Attributes:
        degrees_of_freedom: 1 for Cauchy; the tails thin out as it grows. The covariance of the
            samples is `degrees / (degrees - 2)` times the scaled one where that exists.
        covariance_scale: Factor on the covariance that shapes the t.
        deviation_scale: The factor on its standard deviations, instead.
        include_modes: As in `CovarianceScaled`.
        stratified: As in `CovarianceScaled`.
        max_deviation: As in `CovarianceScaled`, on the shape.
    """

    degrees_of_freedom: int = 3
    covariance_scale: float | None = None
    deviation_scale: float | None = None
    include_modes: bool = True
    stratified: bool = False
    max_deviation: float | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        _deviation_factor(self.covariance_scale, self.deviation_scale, type(self).__name__)
        if self.degrees_of_freedom < 1:
            raise ConfigurationError(
                f"HeavyTailed.degrees_of_freedom: expected at least 1, "
                f"got {self.degrees_of_freedom}; 3 is usual"
            )

    def sample(
        self, mixture: GaussianMixture, num: int, bounds: Bounds, *, generator: torch.Generator
    ) -> Samples:
        """Draw samples, projected onto the bounds."""
        factor = _deviation_factor(self.covariance_scale, self.deviation_scale, type(self).__name__)
        degrees, n = self.degrees_of_freedom, mixture.mean.shape[-1]

        def draw(count: int) -> Tensor:
            normal = standard_normal((count, n), mixture.mean, generator=generator)
            # A sum of squared normals is chi-squared; it is zero with probability zero only.
            chi = standard_normal((count, degrees), mixture.mean, generator=generator)
            least = torch.finfo(normal.dtype).eps
            return normal / (chi.square().mean(-1, keepdim=True)).clamp(min=least).sqrt()

        return _scatter(
            mixture,
            _capped(factor**2 * mixture.covariance, self.max_deviation),
            num,
            bounds,
            draw,
            include_modes=self.include_modes,
            stratified=self.stratified,
            generator=generator,
        )


@dataclass(frozen=True, kw_only=True)
class Spherical:
    """Sample a ball of the same volume as each mode's ellipsoid: the paper's control, Table 1.

    The ball's standard deviation is the geometric mean of those along the covariance's
    eigen-directions (design decision 3).

    Attributes:
        covariance_scale: Factor on the variance.
        deviation_scale: The factor on the standard deviation, instead.
        include_modes: As in `CovarianceScaled`.
        stratified: As in `CovarianceScaled`.
    """

    covariance_scale: float | None = None
    deviation_scale: float | None = None
    include_modes: bool = True
    stratified: bool = False

    def __post_init__(self) -> None:
        _deviation_factor(self.covariance_scale, self.deviation_scale, type(self).__name__)

    def sample(
        self, mixture: GaussianMixture, num: int, bounds: Bounds, *, generator: torch.Generator
    ) -> Samples:
        """Draw samples, projected onto the bounds."""
        n = mixture.mean.shape[-1]
        variance = (log_determinant(mixture.covariance) / n).exp()
        eye = torch.eye(n, dtype=variance.dtype, device=variance.device)
        ball = GaussianMixture(mixture.mean, variance[:, None, None] * eye, mixture.log_weight)
        return CovarianceScaled(
            covariance_scale=self.covariance_scale,
            deviation_scale=self.deviation_scale,
            include_modes=self.include_modes,
            stratified=self.stratified,
        ).sample(ball, num, bounds, generator=generator)


@dataclass(frozen=True, kw_only=True)
class EigenDirectionGrid:
    """Step along each mode's most uncertain directions: the regular pattern of Fig. 4 [RR].

    Per mode: the mode, then `p deviation_scale sigma_j v_j` from it for `p = ±1, ..., ±num_steps`
    along the directions of greatest variance, one direction after another. The defaults give the
    seven hypotheses of section 6 [RR] (design decision 7).

    Attributes:
        num_directions: How many directions, `ns`.
        num_steps: Steps to each side, `pf`.
        deviation_scale: Length of a step in standard deviations of the direction.
    """

    num_directions: int = 3
    num_steps: int = 1
    deviation_scale: float = 1.0

    def sample(
        self, mixture: GaussianMixture, num: int, bounds: Bounds, *, generator: torch.Generator
    ) -> Samples:
        """Lay out the pattern of every mode, the best modes first; at most `num` samples.

        Nothing is random; `generator` is not used.
        """
        values, vectors = torch.linalg.eigh(mixture.covariance)
        axes = vectors * values.clamp(min=0).sqrt()[:, None, :]
        axes = axes.flip(-1)[..., : self.num_directions].mT  # [k ns n], the widest first
        steps = torch.arange(1, self.num_steps + 1, device=axes.device).to(axes)
        steps = self.deviation_scale * torch.stack([-steps, steps], -1).flatten()
        offset = (axes[:, :, None] * steps[:, None]).flatten(1, 2)
        offset = torch.cat([torch.zeros_like(offset[:, :1]), offset], 1)
        order = mixture.log_weight.argsort(descending=True, stable=True)
        x = (mixture.mean[:, None] + offset)[order].flatten(0, 1)
        parent = order.repeat_interleave(offset.shape[1])
        return Samples(bounds.project(x[:num]), parent[:num])
