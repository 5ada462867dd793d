"""Gaussian mixtures over the state: what the tracker believes, section 3.3 of [IJRR].

A posterior is a set of separate modes with means, covariances and weights,

    p(x) = sum_i pi_i N(x; mu_i, Sigma_i).

Weights are kept as logarithms: the product over frames of Fig. 6, step 5, would underflow.
Covariances may be singular, huge or tiny (see `torchcss.linalg`).

What to call: `GaussianMixture.prune` to keep the best modes, `distinct_modes` to discard modes
found before (step 2.3; `torchcss.studies.minima` counts them more strictly), `match_to_prior` or
`prior_at` for step 5.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.errors import ShapeError
from torchcss.linalg import (
    covariance_factor,
    log_determinant,
    multiply,
    prior_units,
    squared_lengths,
    squared_mahalanobis,
    symmetric_part,
    whitener,
    with_least_width,
)
from torchcss.types import Items, Matrices, Numbers, Vector, Vectors

_MODES_AT_ONCE = 32
"""Modes whose distances from all that are worse are found together; most of them are kept."""

_STATES_AT_ONCE = 1024
"""States whose differences from all components are held in memory together."""


class GaussianMixture(NamedTuple):
    """A weighted set of Gaussian modes.

    Attributes:
        mean: Mode centres.
        covariance: Positive semi-definite.
        log_weight: Logarithms of the weights; `-inf` marks an empty place.
    """

    mean: Float[Tensor, "k n"]
    covariance: Float[Tensor, "k n n"]
    log_weight: Float[Tensor, " k"]

    @property
    def weight(self) -> Numbers:
        """Weights that sum to one."""
        return self.normalise().log_weight.exp()

    def normalise(self) -> GaussianMixture:
        """Scale the weights to sum to one; equal weights if every one is zero."""
        total = self.log_weight.logsumexp(0)
        equal = torch.full_like(self.log_weight, -math.log(max(len(self.log_weight), 1)))
        shifted = self.log_weight - torch.where(total.isfinite(), total, 0.0)
        return self._replace(log_weight=torch.where(total.isfinite(), shifted, equal))

    def take(self, modes: Items) -> GaussianMixture:
        """Keep some modes, in the order given, with the weights that they have."""
        return GaussianMixture(self.mean[modes], self.covariance[modes], self.log_weight[modes])

    @property
    def best_first(self) -> Items:
        """The modes by descending weight."""
        return self.log_weight.argsort(descending=True, stable=True)

    def prune(self, num_modes: int) -> GaussianMixture:
        """Keep the modes of greatest weight, the best first, and normalise (Fig. 6, step 4)."""
        return self.take(self.best_first[:num_modes]).normalise()

    def squared_distance(self, x: Vectors) -> Float[Tensor, "*batch k"]:
        """Squared Mahalanobis distance from every component, in that component's own metric."""
        shape, n = x.shape[:-1], x.shape[-1]
        # Component by component for many states at once, a few at a time to bound the memory.
        parts = [
            squared_lengths(part - self.mean[:, None], self.covariance).mT
            for part in x.reshape(-1, n).split(_STATES_AT_ONCE)
        ]
        return torch.cat(parts).reshape(*shape, len(self.mean))

    def component_log_density(self, x: Vectors) -> Float[Tensor, "*batch k"]:
        """Log-density of every component, without its weight."""
        normaliser = x.shape[-1] * math.log(2 * math.pi) + log_determinant(self.covariance)
        return -0.5 * (self.squared_distance(x) + normaliser)

    def log_density(self, x: Vectors) -> Numbers:
        """Log-density of the mixture, its weights normalised."""
        return (self.component_log_density(x) + self.normalise().log_weight).logsumexp(-1)

    def sample(
        self,
        num: int,
        *,
        generator: torch.Generator,
        stratified: bool = False,
        degrees_of_freedom: int | None = None,
    ) -> MixtureSamples:
        """Draw samples.

        Args:
            num: How many.
            generator: Source of randomness.
            stratified: See `draw_components`.
            degrees_of_freedom: Draw from Student t's of these shapes; None: from Gaussians.
        """
        component = draw_components(
            self.log_weight, num, generator=generator, stratified=stratified
        )
        normal = standard_normal((num, self.mean.shape[-1]), self.mean, generator=generator)
        if degrees_of_freedom is not None:
            # A sum of squared normals is chi-squared; it is zero with probability zero only.
            size = (num, degrees_of_freedom)
            chi = standard_normal(size, self.mean, generator=generator)
            least = torch.finfo(normal.dtype).eps
            normal = normal / (chi.square().mean(-1, keepdim=True)).clamp(min=least).sqrt()
        factor = covariance_factor(self.covariance)[component]
        return MixtureSamples(self.mean[component] + multiply(factor, normal), component)

    def moments(self) -> tuple[Vector, Float[Tensor, "n n"]]:
        """Mean and covariance of the whole mixture."""
        weight = self.weight
        mean = weight @ self.mean
        apart = self.mean - mean
        spread = self.covariance + apart[:, :, None] * apart[:, None, :]
        return mean, symmetric_part((weight[:, None, None] * spread).sum(0))


class MixtureSamples(NamedTuple):
    """Samples of a mixture.

    Attributes:
        x: The samples.
        component: The component that each came from.
    """

    x: Float[Tensor, "s n"]
    component: Int[Tensor, " s"]


class Prior(NamedTuple):
    """What is expected of a frame: the modes before, one frame ahead, and where moves lead.

    Attributes:
        mixture: The components; those of the modes come first, in their order.
        parent: The mode before that each component was made from.
    """

    mixture: GaussianMixture
    parent: Int[Tensor, " k"]

    @staticmethod
    def of(modes: GaussianMixture) -> Prior:
        """A component for every mode."""
        return Prior(modes, torch.arange(len(modes.mean), device=modes.mean.device))

    def joined(self, others: Prior | None) -> Prior:
        """These components and others of the same modes."""
        if others is None or not len(others.parent):
            return self
        fields = zip(self.mixture, others.mixture, strict=True)
        joined = GaussianMixture(*(torch.cat(pair) for pair in fields))
        return Prior(joined, torch.cat([self.parent, others.parent]))


class Past(NamedTuple):
    """What modes inherit from the prior, Fig. 6 step 5.

    Attributes:
        log_weight: What the prior multiplies into the weight of each mode.
        parent: The prior component of each mode; -1 for a mode that none is left for, or none near.
    """

    log_weight: Float[Tensor, " k"]
    parent: Int[Tensor, " k"]


def standard_normal(
    shape: tuple[int, ...], like: Tensor, *, generator: torch.Generator
) -> Float[Tensor, "..."]:
    """Draw standard normal numbers on the generator's device, returned like another tensor."""
    noise = torch.randn(shape, generator=generator, device=generator.device, dtype=like.dtype)
    return noise.to(like.device)


def draw_components(
    log_weight: Float[Tensor, " k"],
    num: int,
    *,
    generator: torch.Generator,
    stratified: bool = False,
) -> Items:
    """Choose components with the probability of their weight.

    Args:
        log_weight: Unnormalised; all `-inf` means equal weights.
        num: How many to choose.
        generator: Source of randomness.
        stratified: Choose at equal steps of the cumulated weight from one random offset: the same
            expectation, and every component gets its share to within one sample.
    """
    top = log_weight.max()
    weight = (log_weight - torch.where(top.isfinite(), top, 0.0)).to(torch.float64).exp()
    weight = torch.where(top.isfinite(), weight, torch.ones_like(weight))
    cumulated = weight.cumsum(0)
    uniform = torch.rand(
        1 if stratified else num,
        generator=generator,
        device=generator.device,
        dtype=torch.float64,
    ).to(log_weight.device)
    if stratified:
        uniform = (torch.arange(num, device=log_weight.device) + uniform) / max(num, 1)
    chosen = torch.searchsorted(cumulated, uniform * cumulated[-1], right=True)
    # Rounding must not run past the last component that has a weight.
    return chosen.clamp(max=int(torch.nonzero(weight)[-1, 0]))


def cheapest_first(cost: Numbers) -> Items:
    """Those of finite cost, by ascending cost."""
    order = cost.argsort(stable=True)
    return order[cost[order].isfinite()]


def distinct_modes(
    mean: Vectors,
    covariance: Matrices,
    cost: Numbers,
    *,
    distance: float = 1.0,
    most: int | None = None,
) -> Items:
    """Discard modes that have been found before, Fig. 6 step 2.3.

    The paper gives no threshold (decision "distinct minima"). Here a mode is a duplicate of one of
    lower cost if its Mahalanobis distance under that mode's own covariance is at most `distance`:
    minima closer than one standard deviation are one mode for every purpose of a mixture. Descents
    must have converged for this; ends of curved valleys that were not followed out look distinct.

    Args:
        mean: Candidates, in any order.
        covariance: Their covariances.
        cost: Their costs, nats. A candidate whose cost is not finite is discarded.
        distance: Threshold in standard deviations.
        most: Keep so many at most, those of least cost; by default all.

    Returns:
        Indices of the modes kept, by ascending cost.
    """

    def is_far(some: Items, others: Items) -> Tensor:
        apart = mean[others] - mean[some, None]
        return squared_lengths(apart, with_least_width(covariance[some])) > distance**2

    return _unlike_better(cheapest_first(cost), is_far, len(cost) if most is None else most)


def _unlike_better(
    order: Items, is_far: Callable[[Items, Items], Bool[Tensor, "b m"]], most: int
) -> Items:
    """Choose modes in their order, each far from all that were chosen before.

    Args:
        order: The modes, the best first.
        is_far: Tells of some modes which of others are far from each of them.
        most: Choose so many at most.
    """
    kept = [order[:0]]
    while len(order) and most:
        block = order[: min(most, _MODES_AT_ONCE)]
        far = is_far(block, order).cpu().numpy()  # one transfer for all of the block
        left, own = np.ones(len(order), dtype=bool), []
        for place, others in enumerate(far):
            if left[place] and len(own) < most:
                own.append(place)
                left &= others
        most -= len(own)
        later = len(block) + np.flatnonzero(left[len(block) :])
        chosen, later = (torch.tensor(places, device=order.device) for places in (own, later))
        kept.append(block[chosen])
        order = order[later]
    return torch.cat(kept)


def tempered(covariance: Matrices, power: float, prior_variance: Vector) -> Matrices:
    """Covariances of modes if the likelihood counts with a power below one.

    A mode's covariance is that of likelihood and prior together, and never wider than the prior P
    (`inverse_on_free`). With the likelihood to the power e it is

        (e (C^-1 - P^-1) + P^-1)^-1  =  D S (e (1 - S) + S)^-1 D,   P = D^2,  C = D S D:

    wider by 1 / e where the image says much, and as wide as the prior where it says nothing.

    Args:
        covariance: Covariances C of the modes.
        power: e, `SequenceTracker.stated_power`; at one they stay as they are.
        prior_variance: Variance of each parameter before the image is seen.
    """
    if power == 1.0:
        return covariance
    units = prior_units(prior_variance.to(covariance))
    own = covariance / units
    one = torch.eye(own.shape[-1], dtype=own.dtype, device=own.device)
    return symmetric_part(torch.linalg.solve(power * (one - own) + own, own)) * units


def separated(
    landmarks: Float[Tensor, "k m d"], distance: float, num: int, *, fill: bool = True
) -> Items:
    """Choose modes that are unlike each other, best first.

    Args:
        landmarks: Points of each mode, the best mode first.
        distance: Two modes are alike if no landmark is this far from where it is in the other.
        num: How many to choose.
        fill: Whether places that are left go to modes that are like a better one, best first.

    Returns:
        Indices of the modes, in the order given.
    """
    places = landmarks.transpose(0, 1)  # of one landmark in all modes

    def is_far(some: Items, others: Items) -> Tensor:
        # By differences: products would lose what is small.
        mode = "donot_use_mm_for_euclid_dist"
        return torch.cdist(places[:, some], places[:, others], 2.0, mode).amax(0) >= distance

    every = torch.arange(len(landmarks), device=landmarks.device)
    chosen = _unlike_better(every, is_far, num)
    if not fill:
        return chosen
    alike = every[torch.isin(every, chosen, invert=True)][: num - len(chosen)]
    return torch.cat([chosen, alike]).sort().values


def representatives(
    landmarks: Float[Tensor, "k m d"],
    distance: float,
    chosen: Int[Tensor, " c"],
    score: Float[Tensor, " k"],
) -> Int[Tensor, " c"]:
    """The member of highest score of each explanation that `separated` chose.

    Args:
        landmarks: Points of each mode, as for `separated`.
        distance: As for `separated`.
        chosen: What that chose. Every other mode belongs to the first of these that it is like.
        score: Of each mode.

    Returns:
        Indices of the modes, one for each that was chosen, in that order.
    """
    apart = (landmarks[:, None] - landmarks[chosen]).norm(dim=-1).amax(-1)
    member = apart < distance
    member &= member.int().cumsum(-1) == 1
    member[chosen] = torch.eye(len(chosen), dtype=torch.bool, device=chosen.device)
    score = score.clamp(min=torch.finfo(score.dtype).min)  # even the worst is more than nobody
    return torch.where(member, score[:, None], -torch.inf).argmax(0)


def _same_state(name: str, first: GaussianMixture, second: GaussianMixture) -> int:
    """Number of parameters of both."""
    n, other = first.mean.shape[-1], second.mean.shape[-1]
    if n != other:
        raise ShapeError(
            f"{name}: expected mixtures over the same state, got {n} and {other} parameters; map "
            "one onto the other first"
        )
    return n


def bhattacharyya(first: GaussianMixture, second: GaussianMixture) -> Float[Tensor, "k m"]:
    """Bhattacharyya distance between the components of two mixtures, as printed in Fig. 6 [IJRR].

    That is `d^T S^-1 d + log(|A + B| / sqrt(|A| |B|)) / 2` with `S = (A + B) / 2`, without the
    literature's factor 1/8 (decision "mode weights").

    Args:
        first: Rows of the result.
        second: Columns of the result.
    """
    n = _same_state("bhattacharyya", first, second)
    one, other = with_least_width(first.covariance), with_least_width(second.covariance)
    between = 0.5 * (one[:, None] + other[None, :])
    apart = first.mean[:, None] - second.mean[None, :]
    squared = multiply(whitener(between), apart).square().sum(-1)
    own = log_determinant(one)[:, None] + log_determinant(other)[None, :]
    overlap = 0.5 * (log_determinant(between) - 0.5 * own)
    return squared + overlap + 0.5 * n * math.log(2)


def match_to_prior(posterior: GaussianMixture, prior: GaussianMixture) -> Past:
    """The weight of the closest prior component for each mode, Fig. 6 step 5.

    The modes choose in their order, and a prior component is used once. A mode for which no
    component is left is new; it takes the least weight of the prior, so that it is not favoured
    over any mode that has a past. (With a single prior component that is a factor of one: all the
    modes are its children.) Prior components of weight zero are not there.

    Args:
        posterior: The modes of this frame, in the order in which they choose.
        prior: The modes of the frame before, one frame ahead.
    """
    prior = prior.normalise()
    present = torch.nonzero(prior.log_weight > -torch.inf)[:, 0]
    prior = prior.take(present)
    distance = bhattacharyya(posterior, prior)
    parent = torch.full_like(posterior.log_weight, -1, dtype=torch.long)
    factor = prior.log_weight.min().repeat(len(parent))
    unused = torch.ones_like(present, dtype=torch.bool)
    for mode in range(min(len(parent), len(present))):
        choices = torch.nonzero(unused)[:, 0]
        closest = choices[distance[mode, choices].argmin()]
        parent[mode], factor[mode] = present[closest], prior.log_weight[closest]
        unused[closest] = False
    return Past(factor, parent)


def prior_at(
    posterior: GaussianMixture, prior: GaussianMixture, surprise: float = math.inf
) -> Past:
    """The prior's weight at the place of each mode: Fig. 6 step 5, without a choice.

    A mode (mu, Sigma) inherits from every prior component (pi_j, mu_j, Sigma_j), by how near it is,

        sum_j  pi_j exp(-c min(d_j, 1)),   d_j = (mu - mu_j)^T (Sigma + Sigma_j)^-1 (mu - mu_j) / 2n

    with c = n: for small d_j p(x_t | R_{t-1}) of eq. 10 [IJRR] smoothed by the mode, but for the
    components' volumes. d_j is a squared distance, and 1/2 on average for a mode that moved as the
    prior expects. A mode with twice that, d_j of 1 or more for every component, is new and has no
    parent; it is unlikely, not impossible. A smaller c takes p(x_t | R_{t-1}) to the power
    c / n: what the prior on motion lacks is wrong for many frames, as an acceleration is.

    Other than in `match_to_prior`, no mode can take a component's weight from another, and none is
    handed the weight of a component that merely was left over. Prior components of weight zero are
    not there.

    Args:
        posterior: The modes of this frame.
        prior: The modes of the frame before, one frame ahead.
        surprise: c, nats, where that is less than n.

    Raises:
        ShapeError: If the mixtures are over different states.
    """
    n, prior = _same_state("prior_at", posterior, prior), prior.normalise()
    apart = posterior.mean[:, None] - prior.mean[None, :]
    both = posterior.covariance[:, None] + prior.covariance[None, :]
    distance = (squared_mahalanobis(apart, both) / (2 * n)).clamp(max=1.0)
    nearest = torch.where(prior.log_weight > -torch.inf, distance, 1.0).min(-1)
    return Past(
        (prior.log_weight - min(n, surprise) * distance).logsumexp(-1),
        torch.where(nearest.values < 1, nearest.indices, -1),
    )
