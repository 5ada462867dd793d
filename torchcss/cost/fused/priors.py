"""Priors on the state, in double precision.

Twins of `torchcss.cost.stabiliser`, `anthropometric` and `temporal`.
"""

from __future__ import annotations

import math

from torchcss.cost.fused.records import Array, Gaussian, LongTails, Mixture, PriorScratch, Result
from torchcss.kernels.compiler import entry, inlined, kernel

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
        result.value[b] += long_tails(x[b], mode[b], tails, gradient, hessian)
        result.value[b] += _gaussian(x[b], gaussian, scratch.pull, gradient, hessian)
        if mixture.weight > 0.0:
            value = _mixture(x[b], mixture, scratch)
            result.value[b] += mixture.weight * value
            if len(gradient):
                _mixture_slopes(mixture, scratch, gradient, hessian)


@kernel
def long_tails(x: Array, mode: int, tails: LongTails, gradient: Array, hessian: Array) -> float:
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
def _mixture(x: Array, mixture: Mixture, scratch: PriorScratch) -> float:
    """Cost about the mixture before; its modes' shares, and their pulls."""
    share, offset, most = scratch.share, scratch.pull, -mixture.nu
    for k in range(len(share)):
        exponent, mean, pull = mixture.height[k], mixture.mean[k], scratch.pulls[k]
        for i in range(len(x)):
            offset[i] = min(max(x[i] - mean[i], -mixture.far), mixture.far)
            pull[i] = 0.0
        for j in range(len(x)):
            # Symmetric: the rows are the columns.
            _add(offset[j], mixture.precision[k, j], pull)
        for i in range(len(x)):
            exponent -= 0.5 * offset[i] * pull[i]
        share[k] = exponent
        most = max(most, exponent)
    total = math.exp(-mixture.nu - most)
    for k in range(len(share)):
        share[k] = math.exp(share[k] - most)
        total += share[k]
    for k in range(len(share)):
        share[k] /= total
    return -(most + math.log(total))


@kernel
def _mixture_slopes(
    mixture: Mixture, scratch: PriorScratch, gradient: Array, hessian: Array
) -> None:
    """Add the derivatives of the cost about the mixture before."""
    weight, share, pulls, slope = mixture.weight, scratch.share, scratch.pulls, scratch.pull
    row = scratch.row
    slope[:] = 0.0
    for k in range(len(share)):
        _add(share[k], pulls[k], slope)
    _add(weight, slope, gradient)
    for i in range(len(slope)):
        for j in range(len(slope)):
            row[j] = slope[i] * slope[j]
        for k in range(len(share)):
            precision, pull, own, part = mixture.precision[k, i], pulls[k], pulls[k, i], share[k]
            for j in range(len(row)):
                row[j] += part * (precision[j] - own * pull[j])
        _add(weight, row, hessian[i])


@inlined
def _add(share: float, one: Array, total: Array) -> None:
    """Add a row in its share."""
    for i in range(len(total)):
        total[i] += share * one[i]
