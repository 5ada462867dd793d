"""Priors on the state, in double precision.

Twins of `torchcss.cost.stabiliser`, `anthropometric` and `temporal`.
"""

from __future__ import annotations

import math

from torchcss.cost.fused.records import Array, Gaussian, LongTails, Mixture, PriorScratch, Result
from torchcss.kernels.compiler import entry, kernel

_FAR = 1e150
"""Deviations whose square does not overflow."""


@entry
def add_priors(
    x: Array,
    mode: Array,
    tails: LongTails,
    gaussian: Gaussian,
    mixture: Mixture,
    scratch: PriorScratch,
    result: Result,
) -> None:
    """Add the priors of all states of a pool.

    Args:
        x: The states, `[b n]`.
        mode: The mode before that each of them is compared with.
        tails: Long-tailed priors.
        gaussian: A Gaussian prior of some parameters.
        mixture: The mixture before.
        scratch: Memory for what is found on the way.
        result: Where they are added.
    """
    for b in range(len(x)):
        gradient, hessian = result.gradient[b], result.hessian[b]
        result.value[b] += _long_tails(x[b], mode[b], tails, gradient, hessian)
        result.value[b] += _gaussian(x[b], gaussian, scratch.pull, gradient, hessian)
        if mixture.weight > 0.0:
            value = _mixture(x[b], mixture, scratch.share, scratch.pulls)
            result.value[b] += mixture.weight * value
            if len(gradient):
                _mixture_slopes(mixture, scratch, gradient, hessian)


@kernel
def _long_tails(x: Array, mode: int, tails: LongTails, gradient: Array, hessian: Array) -> float:
    """Lorentzian priors of single parameters."""
    total = 0.0
    for prior in range(len(tails.nu)):
        nu, weight, centre = tails.nu[prior], tails.weight[prior], tails.centre[prior, mode]
        for i in range(len(x)):
            sharpness = tails.sharpness[prior, i]
            if sharpness == 0.0:
                continue
            z = min(max((x[i] - centre[i]) * sharpness, -_FAR), _FAR)
            square = z * z
            first = nu / (square + nu)
            total += 0.5 * weight * nu * math.log1p(square / nu)
            if len(gradient):
                gradient[i] += weight * first * z * sharpness
                bend = first - 2.0 * first * square / (square + nu)
                hessian[i, i] += weight * bend * sharpness * sharpness
    return total


@kernel
def _gaussian(x: Array, gaussian: Gaussian, pull: Array, gradient: Array, hessian: Array) -> float:
    """A Gaussian prior of some parameters."""
    total, columns = 0.0, gaussian.columns
    for i in range(len(columns)):
        pull[i] = 0.0
        for k in range(len(columns)):
            offset = min(max(x[columns[k]] - gaussian.mean[k], -_FAR), _FAR)
            pull[i] += gaussian.precision[i, k] * offset
        offset = min(max(x[columns[i]] - gaussian.mean[i], -_FAR), _FAR)
        total += 0.5 * offset * pull[i]
        if len(gradient):
            gradient[columns[i]] += pull[i]
            for k in range(len(columns)):
                hessian[columns[i], columns[k]] += gaussian.precision[i, k]
    return total


@kernel
def _mixture(x: Array, mixture: Mixture, share: Array, pulls: Array) -> float:
    """Cost about the mixture before; its modes' shares, and their pulls."""
    most = -mixture.nu
    for k in range(len(mixture.height)):
        exponent = mixture.height[k]
        for i in range(len(x)):
            pull = 0.0
            for j in range(len(x)):
                offset = min(max(x[j] - mixture.mean[k, j], -mixture.far), mixture.far)
                pull += mixture.precision[k, i, j] * offset
            offset = min(max(x[i] - mixture.mean[k, i], -mixture.far), mixture.far)
            pulls[k, i] = pull
            exponent -= 0.5 * offset * pull
        share[k] = exponent
        most = max(most, exponent)
    total = math.exp(-mixture.nu - most)
    for k in range(len(mixture.height)):
        share[k] = math.exp(share[k] - most)
        total += share[k]
    for k in range(len(mixture.height)):
        share[k] /= total
    return -(most + math.log(total))


@kernel
def _mixture_slopes(
    mixture: Mixture, scratch: PriorScratch, gradient: Array, hessian: Array
) -> None:
    """Add the derivatives of the cost about the mixture before."""
    size, weight = len(gradient), mixture.weight
    share, pulls, slope = scratch.share, scratch.pulls, scratch.pull
    for i in range(size):
        slope[i] = 0.0
        for k in range(len(share)):
            slope[i] += share[k] * pulls[k, i]
    for i in range(size):
        gradient[i] += weight * slope[i]
        for j in range(size):
            entry = slope[i] * slope[j]
            for k in range(len(share)):
                bend = mixture.precision[k, i, j] - pulls[k, i] * pulls[k, j]
                entry += share[k] * bend
            hessian[i, j] += weight * entry
