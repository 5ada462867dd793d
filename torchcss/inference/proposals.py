"""Where to look next: proposals that turn a mixture into starts for the optimiser.

The paper's answer is `CovarianceScaled` (Fig. 6, steps 1 to 2.2): sample each mode's own Gaussian,
inflated, so that most samples fall along the valleys in which other minima are likely, at low cost.
All proposals share one interface, `Proposal`, and differ in what a mode (mu, Sigma) becomes:

| proposal | samples of a mode | where from |
|---|---|---|
| `CovarianceScaled` | N(mu, s Sigma) | Fig. 6 [IJRR] |
| `HeavyTailed` | Student t of shape s Sigma | Fig. 8d (3) [IJRR], "heavy tail sampling" |
| `Spherical` | N(mu, r^2 I), r^2 the geometric mean of s Sigma's eigenvalues | Table 1 [IJRR] |
| `EigenDirectionGrid` | steps along the widest eigenvectors of Sigma | Fig. 4 [RR] |
| `Condensation` | N(mu, Q), the modes randomised by dynamical noise Q | Fig. 8d (1) [IJRR] |
| `ChamRehg` | N(mu, Sigma + Q) where no other mode's is higher | Fig. 8d (2) [IJRR] |
| `InflatedPosterior` | N(mu, s Sigma + Q), weights diluted to pi^(1/s) | section 9 [IJRR] |
| `MixtureOfProposals` | those of its members, in given shares | |
| `Move` | components elsewhere, where what is known of the body leads | |

A scale is always named: `covariance_scale = s` multiplies the covariance (Fig. 6, s = 4 to 14),
`deviation_scale = d` the standard deviations (Table 1; `d = sqrt(s)`). Exactly one is given
(decision "two scales").

Samples outside the bounds are projected onto them (decision "inadmissible samples"): each parameter
for itself, or with `correlated_projection` to the nearest admissible state in the metric of the
covariance, in which the others make up for what a bound takes. The latter keeps samples in their
valley, at far lower cost, and therefore finds fewer minima
(`scripts/table1.py --correlated-projection`).

Every sample carries its importance weight back to the mixture that it was drawn from (see
`torchcss.inference.importance`). What to call by default: `CovarianceScaled(covariance_scale=8)`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate, pairwise
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.errors import ConfigurationError, check_positive, check_range
from torchcss.inference.dynamics import Deviation, noise_covariance, summed
from torchcss.inference.mixture import GaussianMixture, MixtureSamples, Prior
from torchcss.linalg import cholesky_apply, log_determinant, mask_free, multiply
from torchcss.types import Bounds, Items, Matrices, Numbers, Vectors, frozen


class Samples(NamedTuple):
    """Starts for the optimiser.

    Attributes:
        x: Admissible states.
        parent: The component that each came from: of the mixture, or of the jumps that follow it.
        log_weight: Importance weight, log of the mixture's density over the proposal's, where the
            sample was drawn, before it was projected onto the bounds. `-inf` for what was not
            drawn at random from the mixture: the modes themselves, regular patterns, jumps.
        jumps: Components that moves add to the mixture, weighed as its own are; None: none.
        drawn: Where they were before they were projected onto the bounds; None: where they are.
    """

    x: Float[Tensor, "s n"]
    parent: Int[Tensor, " s"]
    log_weight: Float[Tensor, " s"]
    jumps: Prior | None = None
    drawn: Float[Tensor, "s n"] | None = None

    def take(self, items: Items) -> Samples:
        """Some of the samples."""
        drawn = None if self.drawn is None else self.drawn[items]
        parts = self.x[items], self.parent[items], self.log_weight[items]
        return Samples(*parts, self.jumps, drawn)


class Proposal(ABC):
    """Anything that draws starts from a mixture."""

    @abstractmethod
    def sample(
        self, mixture: GaussianMixture, num: int, bounds: Bounds, *, generator: torch.Generator
    ) -> Samples:
        """Draw admissible samples.

        Args:
            mixture: The prior, one frame ahead.
            num: How many; a regular pattern may give fewer.
            bounds: Limits onto which samples are projected; with infinite ones the samples are as
                they were drawn.
            generator: Where randomness comes from.
        """

    def log_density(self, mixture: GaussianMixture, x: Vectors) -> Numbers:
        """Log-density of what is drawn at random, before projection; `-inf` if nothing is."""
        return torch.full_like(x[..., 0], -math.inf)

    def over(self, intervals: float) -> Proposal:
        """The same of a frame so many intervals after the one before: its own noise adds up."""
        return self


def unbounded(like: Vectors) -> Bounds:
    """No limits on states like these."""
    limit = torch.full_like(like.reshape(-1, like.shape[-1])[0], math.inf)
    return Bounds(-limit, limit)


_STATES_AT_ONCE = 1024
"""Samples whose covariances are held in memory together."""

_PROJECTION_ROUNDS = 60
"""Rounds in which the bounds that hold may be found; few items take more than five."""

_PATIENCE = 3
"""Rounds in which the parameters that are wrong need not become fewer."""


def project_in_metric(x: Vectors, covariance: Matrices, bounds: Bounds) -> Vectors:
    """Nearest admissible states in the metric of their covariances.

    Parameters that are outside are held at their bounds and the others take their means given that,
    `x_f + Sigma_fh Sigma_hh^-1 (b - x_h)`; what is outside then is held too, and what a bound holds
    against its will is let go, until nothing changes: block principal pivoting (Júdice and Pires
    1994), all such parameters at once as long as they become fewer, else the last of them alone. An
    item that has not settled in time keeps what is held, and the rest is moved each for itself.

    Args:
        x: Any states.
        covariance: Positive semi-definite. Where it leaves parameters no choice, they are moved
            each for itself.
        bounds: The box; equal bounds hold a parameter on one plane.
    """
    # What is held is compared with its bound, so that the two must be rounded alike.
    bounds = Bounds(bounds.lower.to(x), bounds.upper.to(x))
    pinned = bounds.lower == bounds.upper
    scale = torch.linalg.diagonal(covariance).clamp(min=torch.finfo(x.dtype).tiny).sqrt()
    correlation = covariance / scale[:, :, None] / scale[:, None, :]
    target, held, moved = bounds.project(x), torch.zeros_like(x, dtype=torch.bool), x.clone()
    change, items = bounds.project(x) != x, torch.arange(len(x), device=x.device)
    fewest = torch.full_like(items, x.shape[-1] + 1)
    patience = torch.zeros_like(items)
    for _ in range(_PROJECTION_ROUNDS):
        items = items[change[items].any(-1)]
        if not len(items):
            break
        flip = change[items]
        number = flip.sum(-1)
        fewer = number < fewest[items]
        fewest[items] = torch.where(fewer, number, fewest[items])
        patience[items] = torch.where(fewer, _PATIENCE, patience[items] - 1)
        last = flip & (flip.flip(-1).cumsum(-1).flip(-1) == 1)
        held[items] ^= torch.where((patience[items] < 0)[:, None], last, flip)
        some, part = held[items], correlation[items]
        inside = bounds.project(moved[items])
        target[items] = torch.where(inside != moved[items], inside, target[items])
        gap = torch.where(some, target[items] - x[items], 0.0)
        factor, failed = torch.linalg.cholesky_ex(mask_free(part, some))
        pull = torch.where(some, cholesky_apply(factor, gap / scale[items]), 0.0)
        shift = torch.where(some, gap, scale[items] * multiply(part, pull))
        sound = (failed == 0)[:, None] & shift.isfinite()
        moved[items] = x[items] + torch.where(sound, shift, gap)
        # A bound may pull inwards only: downwards from an upper one, upwards from a lower one. One
        # that is both may pull either way.
        inwards = torch.where(target[items] >= bounds.upper, pull <= 0, pull >= 0) | pinned
        change[items] = torch.where(some, ~inwards, bounds.project(moved[items]) != moved[items])
    return bounds.project(moved)


_ROUNDS = 64
"""Rounds of rejection: more than half of the draws of a round are kept unless many modes coincide,
and then one in the number of modes."""

_NORMALISER_DRAWS = 4096
"""Draws from which the normaliser of a piecewise density is found, to within 1 %."""


class _Law(NamedTuple):
    """What a proposal draws from: a mixture of Gaussians or of Student t's.

    Attributes:
        mixture: Centres, shapes (the covariances of the Gaussians) and weights.
        degrees_of_freedom: Of the t; None for Gaussians.
        piecewise: At each state, only the component that is highest there counts.
    """

    mixture: GaussianMixture
    degrees_of_freedom: int | None = None
    piecewise: bool = False

    def draw(self, num: int, *, stratified: bool, generator: torch.Generator) -> MixtureSamples:
        """Draw samples, not projected."""
        sample = partial(
            self.mixture.sample,
            generator=generator,
            stratified=stratified,
            degrees_of_freedom=self.degrees_of_freedom,
        )
        if not self.piecewise:
            return sample(num)
        parts, found = [], 0
        for _ in range(_ROUNDS):
            own = self._take_own(sample(num))
            if stratified and found + len(own.x) > num:
                # These are in the order of the components: a cut would take the first ones' alone.
                order = torch.randperm(len(own.x), generator=generator, device=generator.device)
                own = MixtureSamples(*(field[order.to(field.device)] for field in own))
            parts.append(own)
            found += len(own.x)
            if found >= num:
                break
        else:
            parts.append(sample(num - found))
        x, component = (torch.cat(field)[:num] for field in zip(*parts, strict=True))
        return MixtureSamples(x, component)

    def log_density(self, x: Vectors) -> Numbers:
        """Log-density of what is drawn."""
        components = self._component_log_density(x)
        if not self.piecewise:
            return components.logsumexp(-1)
        if len(self.mixture.mean) == 1:
            return components[..., 0]
        # The share of the mixture's draws that are kept is the mass below the highest components.
        fixed = torch.Generator().manual_seed(0)
        kept = len(
            self._take_own(
                self.mixture.sample(_NORMALISER_DRAWS, generator=fixed, stratified=True)
            ).x
        )
        return components.amax(-1) - math.log(max(kept, 1) / _NORMALISER_DRAWS)

    def _take_own(self, samples: MixtureSamples) -> MixtureSamples:
        """Keep the samples at which their own component is the highest."""
        density = self._component_log_density(samples.x)
        own = density.gather(-1, samples.component[:, None])[:, 0] >= density.amax(-1)
        return MixtureSamples(samples.x[own], samples.component[own])

    def _component_log_density(self, x: Vectors) -> Float[Tensor, "*batch k"]:
        """Log-densities of the components with their weights."""
        mixture, degrees, n = self.mixture, self.degrees_of_freedom, x.shape[-1]
        log_weight = mixture.normalise().log_weight
        if degrees is None:
            return mixture.component_log_density(x) + log_weight
        peak = math.lgamma((degrees + n) / 2) - math.lgamma(degrees / 2)
        peak = peak - 0.5 * (n * math.log(degrees * math.pi) + log_determinant(mixture.covariance))
        tail = torch.log1p(mixture.squared_distance(x) / degrees)
        return peak - 0.5 * (degrees + n) * tail + log_weight


@frozen
class _RandomProposal(Proposal):
    """A proposal that draws independent samples from a law made of the mixture's modes.

    Attributes:
        include_modes: Have the modes themselves, unperturbed, first among the samples, so that what
            was found once is followed however small its weight.
        stratified: Give every mode its share to within one sample, see `draw_components`.
        correlated_projection: Move samples that are outside the bounds along their covariances, see
            `project_in_metric`.
    """

    include_modes: bool = True
    stratified: bool = False
    correlated_projection: bool = False

    @abstractmethod
    def law(self, mixture: GaussianMixture) -> _Law:
        """What is drawn from, before projection; of the same mixture object if that is its law."""

    def log_density(self, mixture: GaussianMixture, x: Vectors) -> Numbers:
        """Log-density of what is drawn at random, before projection."""
        return self.law(mixture).log_density(x)

    def sample(
        self, mixture: GaussianMixture, num: int, bounds: Bounds, *, generator: torch.Generator
    ) -> Samples:
        """Draw samples, the modes themselves first, the best of all; and project them."""
        law = self.law(mixture)
        own = mixture.log_weight[:0].long()
        if self.include_modes:
            own = mixture.best_first[:num]
        x, component = law.draw(num - len(own), stratified=self.stratified, generator=generator)
        if law.mixture is mixture:  # drawn from the mixture as it is
            log_weight = torch.zeros_like(x[:, 0])
        else:
            log_weight = mixture.log_density(x) - law.log_density(x)
        drawn = torch.cat([mixture.mean[own], x])
        if self.correlated_projection:
            parts = zip(x.split(_STATES_AT_ONCE), component.split(_STATES_AT_ONCE), strict=True)
            shapes = law.mixture.covariance
            x = torch.cat([project_in_metric(part, shapes[of], bounds) for part, of in parts])
        return Samples(
            bounds.project(torch.cat([mixture.mean[own], x])),
            torch.cat([own, component]),
            torch.cat([torch.full_like(mixture.mean[own, 0], -math.inf), log_weight]),
            drawn=drawn,
        )


@frozen
class ScaledProposal(_RandomProposal):
    """A random proposal with one factor on the modes' spread.

    Attributes:
        covariance_scale: `s`, the factor on the covariance.
        deviation_scale: The factor on the standard deviations, instead of `covariance_scale`.
    """

    covariance_scale: float | None = None
    deviation_scale: float | None = None

    def __post_init__(self) -> None:
        _ = self._factor

    @property
    def _factor(self) -> float:
        """The one factor on standard deviations that the two parameters stand for."""
        given = [s for s in (self.covariance_scale, self.deviation_scale) if s is not None]
        if len(given) != 1 or not 0 < given[0] < math.inf:
            raise ConfigurationError(
                f"{type(self).__name__}: expected exactly one positive scale, got covariance_scale="
                f"{self.covariance_scale} and deviation_scale={self.deviation_scale}; give one of "
                "the two"
            )
        return given[0] if self.covariance_scale is None else math.sqrt(given[0])


@frozen
class _CappedProposal(ScaledProposal):
    """A scaled proposal that goes no farther than a limit.

    Attributes:
        max_deviation: Limit on the standard deviation, one number or one per parameter; None for
            none.
    """

    max_deviation: Deviation | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "max_deviation", finite=False)

    def _scaled(self, mixture: GaussianMixture) -> GaussianMixture:
        """The mixture, inflated; parameters beyond the limit shrink, and correlations stay."""
        covariance = self._factor**2 * mixture.covariance
        if self.max_deviation is not None:
            limit = covariance.new_tensor(self.max_deviation)
            deviation = torch.linalg.diagonal(covariance).clamp(min=0).sqrt()
            shrink = torch.where(deviation > limit, limit / deviation, 1.0)
            covariance = covariance * shrink[..., :, None] * shrink[..., None, :]
        return mixture._replace(covariance=covariance)


@frozen
class CovarianceScaled(_CappedProposal):
    """Sample every mode's Gaussian, inflated: `N(mu_i, s Sigma_i)`, Fig. 6 step 1.

    Attributes:
        covariance_scale: `s`, the factor on the covariance.
        deviation_scale: The factor on the standard deviations, instead of `covariance_scale`.
        include_modes: Have the modes themselves, unperturbed, first among the samples, so that what
            was found once is followed however small its weight.
        stratified: See `draw_components`.
        correlated_projection: Move samples that are outside the bounds along their covariances, see
            `project_in_metric`.
        max_deviation: Limit on the standard deviation of the samples, one number or one per
            parameter; None for none.
    """

    def law(self, mixture: GaussianMixture) -> _Law:
        """Gaussians, inflated."""
        if self._factor == 1 and self.max_deviation is None:
            return _Law(mixture)
        return _Law(self._scaled(mixture))


@frozen
class HeavyTailed(_CappedProposal):
    """Sample a Student t of every mode: mostly near, sometimes very far.

    Attributes:
        covariance_scale: Factor on the covariance that shapes the t.
        deviation_scale: The factor on its standard deviations, instead.
        include_modes: As in `CovarianceScaled`.
        stratified: As in `CovarianceScaled`.
        correlated_projection: As in `CovarianceScaled`.
        max_deviation: As in `CovarianceScaled`, on the shape.
        degrees_of_freedom: 1 for Cauchy; the tails thin out as it grows. The covariance of the
            samples is `degrees / (degrees - 2)` times the scaled one where that exists.
    """

    degrees_of_freedom: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "degrees_of_freedom", least=1, hint="; 3 is usual")

    def law(self, mixture: GaussianMixture) -> _Law:
        """Student t's, inflated."""
        return _Law(self._scaled(mixture), self.degrees_of_freedom)


@frozen
class Spherical(ScaledProposal):
    """Sample a ball of the same volume as each mode's ellipsoid: the paper's control, Table 1.

    The ball's standard deviation is the geometric mean of those along the covariance's
    eigen-directions (decision "matched volume"). It lies in the parameters that have any width.

    Attributes:
        covariance_scale: Factor on the variance.
        deviation_scale: The factor on the standard deviation, instead.
        include_modes: As in `CovarianceScaled`.
        stratified: As in `CovarianceScaled`.
        correlated_projection: As in `CovarianceScaled`.
    """

    def law(self, mixture: GaussianMixture) -> _Law:
        """Balls."""
        free = torch.linalg.diagonal(mixture.covariance) > 0
        volume = log_determinant(mask_free(mixture.covariance, free))
        variance = (volume / free.sum(-1).clamp(min=1)).exp()
        ball = torch.diag_embed(torch.where(free, variance[:, None], 0.0))
        return _Law(mixture._replace(covariance=self._factor**2 * ball))


@frozen
class _NoisyProposal(_RandomProposal):
    """A random proposal with dynamical noise of its own.

    Attributes:
        deviation: Standard deviation of the noise, one number or one per parameter: `Q` is the
            diagonal matrix of their squares.
    """

    deviation: Deviation

    def __post_init__(self) -> None:
        check_range(self, "deviation")

    def over(self, intervals: float) -> Self:
        """See `Proposal.over`."""
        return replace(self, deviation=summed(self.deviation, intervals))


@frozen
class Condensation(_NoisyProposal):
    """Randomise the modes by dynamical noise alone: `N(mu_i, Q)`, Fig. 8d (1) [IJRR].

    How CONDENSATION searches, and Heap and Hogg's tracker before its descents: the noise is the
    same for every mode and knows nothing of what the image leaves open. For the particle filter
    itself see `torchcss.inference.particle`.

    Attributes:
        deviation: Standard deviation of the noise, one number or one per parameter: `Q` is the
            diagonal matrix of their squares.
        include_modes: As in `CovarianceScaled`.
        stratified: As in `CovarianceScaled`.
        correlated_projection: As in `CovarianceScaled`.
    """

    def law(self, mixture: GaussianMixture) -> _Law:
        """Noise about every mode."""
        noise = noise_covariance(self.deviation, mixture.covariance)
        return _Law(mixture._replace(covariance=noise.expand_as(mixture.covariance)))


@frozen
class ChamRehg(_NoisyProposal):
    """Sample within the modes' covariances, and add dynamical noise: Fig. 8d (2) [IJRR].

    The sampler of Cham and Rehg's multiple-hypothesis tracker, as [IJRR] describes it: modes with
    Gauss-Newton covariances, a piecewise Gaussian density because their modes come in clusters
    (section 3.3), and a search region widened by exaggerated dynamical noise (section 1.2). Here
    the density is proportional to `max_i pi_i N(x; mu_i, Sigma_i + Q)`: where the Gaussians of a
    cluster overlap they do not add up, so that the cluster does not take all the samples. The
    constant velocity is the dynamics' (`ConstantVelocity`), which moves the modes beforehand.

    Attributes:
        deviation: As in `Condensation`.
        piecewise: False for the plain mixture.
        include_modes: As in `CovarianceScaled`.
        stratified: As in `CovarianceScaled`, before the draws of overlapped pieces are rejected.
        correlated_projection: As in `CovarianceScaled`.
    """

    piecewise: bool = True

    def law(self, mixture: GaussianMixture) -> _Law:
        """Gaussians widened by noise, each in its own piece of the state space."""
        covariance = mixture.covariance + noise_covariance(self.deviation, mixture.covariance)
        return _Law(mixture._replace(covariance=covariance), piecewise=self.piecewise)


@frozen
class InflatedPosterior(ScaledProposal, _NoisyProposal):
    """Sample the posterior raised to the power 1/s, then noise: section 9 [IJRR].

    To that power, a mode's Gaussian `pi N(mu, Sigma)` has the covariance `s Sigma` and the weight
    `pi^(1/s)`: inflated and diluted. `Samples.log_weight` turns the samples back into fair ones.
    `ParticleFilter(dilution=...)` is the same for a posterior of particles.

    Attributes:
        covariance_scale: `s`.
        deviation_scale: `sqrt(s)`, instead.
        deviation: Dynamical noise added to the inflated posterior, as in `Condensation`; zero if
            the mixture is the prior of this frame already.
        include_modes: As in `CovarianceScaled`.
        stratified: As in `CovarianceScaled`.
        correlated_projection: As in `CovarianceScaled`.
    """

    deviation: Deviation = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range(self, "deviation")

    def law(self, mixture: GaussianMixture) -> _Law:
        """Inflated Gaussians with diluted weights."""
        scale = self._factor**2
        covariance = scale * mixture.covariance + noise_covariance(
            self.deviation, mixture.covariance
        )
        return _Law(GaussianMixture(mixture.mean, covariance, mixture.log_weight / scale))


@frozen
class EigenDirectionGrid(Proposal):
    """Step along each mode's most uncertain directions: the regular pattern of Fig. 4 [RR].

    Per mode: the mode, then `p deviation_scale sigma_j v_j` from it for `p = ±1, ..., ±num_steps`
    along the directions of greatest variance, one direction after another. The defaults give the
    seven hypotheses of section 6 [RR]. The patterns of all modes form one pool
    (decision "regular sampling").

    Attributes:
        num_directions: How many directions, `ns`.
        num_steps: Steps to each side, `pf`.
        deviation_scale: Length of a step in standard deviations of the direction.
    """

    num_directions: int = 3
    num_steps: int = 1
    deviation_scale: float = 1.0

    def __post_init__(self) -> None:
        check_range(self, "num_directions", "num_steps", least=1)
        check_positive(self, "deviation_scale", finite=True)

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
        order = mixture.best_first
        x = (mixture.mean[:, None] + offset)[order].flatten(0, 1)
        parent = order.repeat_interleave(offset.shape[1])
        x, parent = bounds.project(x[:num]), parent[:num]
        return Samples(x, parent, torch.full_like(x[:, 0], -math.inf))


@frozen
class MixtureOfProposals(Proposal):
    """Several proposals in fixed shares: local and far samples, random and regular ones.

    Every random sample is weighed by the density of all members together, each by the number of
    samples that it drew, whichever of them drew this one: a member that is close to the prior then
    bounds all the weights. Members project their samples as they do alone, and say where these
    were before (`Samples.drawn`). Give `include_modes` to the first member only.

    What a member leaves, such as a regular pattern of fewer states, the first one draws.

    Attributes:
        proposals: The members.
        shares: Their shares of the samples, not negative; equal by default.
    """

    proposals: tuple[Proposal, ...]
    shares: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        shares = self._shares
        if not self.proposals or len(shares) != len(self.proposals):
            raise ConfigurationError(
                f"MixtureOfProposals: expected one share for each of at least one proposal, got "
                f"{len(self.proposals)} proposals and {len(shares)} shares"
            )
        if not (min(shares) >= 0 and 0 < sum(shares) < math.inf):
            raise ConfigurationError(
                f"MixtureOfProposals.shares: expected positive numbers, got {shares}"
            )

    def over(self, intervals: float) -> MixtureOfProposals:
        """See `Proposal.over`."""
        return replace(self, proposals=tuple(each.over(intervals) for each in self.proposals))

    @property
    def _shares(self) -> tuple[float, ...]:
        return (1.0,) * len(self.proposals) if self.shares is None else self.shares

    def _counts(self, num: int) -> list[int]:
        """Samples of each member, `num` in all: its share, the first members' rounded up."""
        ends = list(accumulate(self._shares, initial=0.0))
        # Less than a sample's millionth is rounding, not a share.
        whole = [math.ceil(num * end / ends[-1] - 1e-6) for end in ends]
        return [after - before for before, after in pairwise(whole)]

    def log_density(self, mixture: GaussianMixture, x: Vectors) -> Numbers:
        """Log-density of the random members together, in their shares of each other."""
        return self._joint_log_density(mixture, x, self._shares)

    def _joint_log_density(
        self, mixture: GaussianMixture, x: Tensor, shares: tuple[float, ...] | list[int]
    ) -> Tensor:
        densities, random_shares = [], []
        for proposal, share in zip(self.proposals, shares, strict=True):
            density = proposal.log_density(mixture, x)
            if share and bool((density > -math.inf).any()):
                densities.append(density)
                random_shares.append(share)
        if not densities:
            return torch.full_like(x[..., 0], -math.inf)
        part = torch.tensor(random_shares, dtype=x.dtype, device=x.device)
        return (torch.stack(densities, -1) + (part / part.sum()).log()).logsumexp(-1)

    def sample(
        self, mixture: GaussianMixture, num: int, bounds: Bounds, *, generator: torch.Generator
    ) -> Samples:
        """Draw from the members; the first draws what others leave."""
        (first, *others), (count, *counts) = self.proposals, self._counts(num)
        parts = [
            member.sample(mixture, wanted, bounds, generator=generator)
            for member, wanted in zip(others, counts, strict=True)
        ]
        left = sum(counts) - sum(len(part.x) for part in parts)
        parts.insert(0, first.sample(mixture, count + left, bounds, generator=generator))
        log_weight = torch.cat([part.log_weight for part in parts])
        drawn = torch.cat([part.x if part.drawn is None else part.drawn for part in parts])
        jumps, parents, num_modes = None, [], len(mixture.mean)
        for part in parts:
            before = 0 if jumps is None else len(jumps.parent)
            parents.append(part.parent + before * (part.parent >= num_modes))
            jumps = part.jumps if jumps is None else jumps.joined(part.jumps)
        random = [int((part.log_weight > -math.inf).sum()) for part in parts]
        joint = mixture.log_density(drawn) - self._joint_log_density(mixture, drawn, random)
        log_weight = torch.where(log_weight > -math.inf, joint, -math.inf)
        x = torch.cat([part.x for part in parts])
        return Samples(x, torch.cat(parents), log_weight, jumps, drawn)


@frozen
class Move(Proposal):
    """A proposal that knows where else to look: it adds components to the prior.

    What is known of the body or of the picture leads from the heaviest component to other states,
    far from it and as plausible. Each becomes a component, as uncertain as the one that it was made
    from, and is sampled as that would be. To use with others, in a `MixtureOfProposals`.

    Attributes:
        search: How samples of the new components are drawn.
        log_odds: Weight of each against that of the component it was made from, nats. Low odds make
            the image's evidence outweigh a jump before it leads.
    """

    search: Proposal
    log_odds: float = -5.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.log_odds):
            where = f"{type(self).__name__}.log_odds"
            raise ConfigurationError(f"{where}: expected a finite number, got {self.log_odds}")

    @abstractmethod
    def states(self, best: GaussianMixture, bounds: Bounds) -> Vectors:
        """Other states, the most plausible first.

        Args:
            best: The heaviest component.
            bounds: Limits of the state.
        """

    def sample(
        self, mixture: GaussianMixture, num: int, bounds: Bounds, *, generator: torch.Generator
    ) -> Samples:
        """Draw from the new components; nothing if there are none, or none are wanted."""
        best = mixture.log_weight.argmax()[None]
        mean = self.states(mixture.take(best), bounds) if num > 0 else mixture.mean[:0]
        parent = best.expand(len(mean))
        like = mixture.take(parent)
        jumps = GaussianMixture(mean, like.covariance, like.log_weight + self.log_odds)
        if not len(mean):
            return Samples(mean, parent, jumps.log_weight)
        found = self.search.sample(jumps, num, bounds, generator=generator)
        return Samples(
            found.x,
            len(mixture.mean) + found.parent,
            torch.full_like(found.log_weight, -math.inf),
            Prior(jumps, parent),
        )


_MOST_OF_MOVES = 0.75
"""Share of the samples that moves get at the most."""


def with_moves(
    proposal: Proposal, moves: Sequence[tuple[Move, float]], num_samples: int
) -> Proposal:
    """A proposal and moves as one; the samples that moves do not need are the proposal's.

    Args:
        proposal: Where the other samples go.
        moves: Each with the number of samples wanted of it; together they get at most three
            quarters of all.
        num_samples: Samples in all.
    """
    wanted = sum(number for _, number in moves)
    if not wanted:
        return proposal
    share = min(1.0, _MOST_OF_MOVES * num_samples / wanted)
    return MixtureOfProposals(
        proposals=(proposal, *(move for move, _ in moves)),
        shares=(num_samples - share * wanted, *(share * number for _, number in moves)),
    )
