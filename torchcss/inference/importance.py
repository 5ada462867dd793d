"""Importance weights: what samples of a proposal say about the prior and the posterior.

A proposal q puts samples where minima are likely, not where the prior p has its mass. Section 8
[IJRR] notes that fair statements remain possible: weigh every sample by

    w_i = p(x_i) / q(x_i)                 for the prior,
    w_i = exp(-f(x_i)) p(x_i) / q(x_i)    for the posterior, f the cost in nats.

Proposals return log p - log q with their samples (`Samples.log_weight`), taken where the sample was
drawn, before it was projected onto the bounds: the weighted samples then represent the prior
projected in the same way, exactly.

How far such weights can be trusted is what footnote 12 [IJRR] is about: `survival` gives the
effective sample size (the "survival diagnostic") and its share of the samples (the "survival
rate"). In many dimensions, inflation in all of them leaves no
survivors: for s = 8 and n Gaussian directions the survival rate is about (15 / 64)^(n / 2), that is
3e-3 for n = 8 and 2e-11 for n = 34. That is why the tracker descends from its samples instead.

What to call: `posterior_log_weight`, then `fair_samples` or `survival`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.inference.mixture import draw_components
from torchcss.inference.proposals import Samples
from torchcss.types import CostFunction, Items, Numbers


class Survival(NamedTuple):
    """How evenly weights are spread; all zero if there is no weight at all.

    Attributes:
        effective_sample_size: `1 / sum w^2`, from 1 (one sample has all) to the number of samples.
        survival_rate: The same as a share of the samples.
    """

    effective_sample_size: Float[Tensor, ""]
    survival_rate: Float[Tensor, ""]


def normalised_log_weight(log_weight: Numbers) -> Numbers:
    """Scale weights to sum to one; equal weights if every one is zero."""
    if not len(log_weight):
        return log_weight
    # The largest is taken off first: a common factor as large as exp(1e6) then costs no digits.
    top = log_weight.max()
    shifted = log_weight - torch.where(top.isfinite(), top, 0.0)
    equal = torch.full_like(log_weight, -math.log(len(log_weight)))
    return torch.where(top.isfinite(), shifted - shifted.logsumexp(0), equal)


def survival(log_weight: Numbers) -> Survival:
    """Survival diagnostics of unnormalised weights.

    Balanced weights do not prove that all modes were found: samples trapped in one mode have them
    too (footnote 12 [IJRR]).
    """
    num = max(len(log_weight), 1)
    weight = normalised_log_weight(log_weight).exp()
    some = (log_weight > -torch.inf).any()
    effective = torch.where(some, 1 / weight.square().sum(), 0.0)
    return Survival(effective, effective / num)


def posterior_log_weight(samples: Samples, cost: CostFunction) -> Numbers:
    """Unnormalised log-weights that turn samples of a proposal into samples of the posterior.

    Args:
        samples: With their weights towards the prior; what was not drawn at random has none.
        cost: Negative log-likelihood, nats; a sample whose cost is not finite gets no weight.
    """
    value = cost.value(samples.x)
    return samples.log_weight - torch.where(value.isfinite(), value, torch.inf)


def tempered_log_weight(log_weight: Numbers, survival_rate: float) -> tuple[Numbers, float]:
    """Raise weights to the power that leaves a given survival rate.

    Args:
        log_weight: Unnormalised.
        survival_rate: Between 0 and 1; weights that survive better are left as they are.

    Returns:
        The weights to that power, and the power, from 0 to 1.
    """
    if float(survival(log_weight).survival_rate) >= survival_rate:
        return log_weight, 1.0
    low, high = -60.0, 0.0  # of the power's logarithm: costs may be as large as 1e20 nats
    for _ in range(40):
        middle = 0.5 * (low + high)
        if float(survival(math.exp(middle) * log_weight).survival_rate) >= survival_rate:
            low = middle
        else:
            high = middle
    return math.exp(low) * log_weight, math.exp(low)


def resample(log_weight: Numbers, num: int, *, generator: torch.Generator) -> Items:
    """Draw samples again by their weight, at equal steps of the cumulated weight.

    Args:
        log_weight: Weights of the samples, unnormalised.
        num: How many to draw.
        generator: Where randomness comes from.

    Returns:
        Indices of the samples drawn.
    """
    return draw_components(log_weight, num, generator=generator, stratified=True)


def fair_samples(
    samples: Samples, log_weight: Numbers, num: int, *, generator: torch.Generator
) -> Samples:
    """Draw equally weighted samples of what the weights stand for, the prior or the posterior.

    Args:
        samples: What a proposal returned.
        log_weight: Its weights, `samples.log_weight` or `posterior_log_weight`.
        num: How many to draw; a sample may come several times.
        generator: Source of randomness.
    """
    chosen = resample(log_weight, num, generator=generator)
    return samples.take(chosen)._replace(log_weight=torch.zeros_like(log_weight[chosen]))
