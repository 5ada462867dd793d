"""Robust potentials by number; the twin of `torchcss.robust`."""

from __future__ import annotations

from torchcss.cost.fused.projection import Slope
from torchcss.cost.fused.records import Potential
from torchcss.kernels.compiler import exp, inlined, log
from torchcss.robust import Leclerc, Lorentzian, Quadratic

KINDS = (Lorentzian, Leclerc, Quadratic)
"""The potentials that kernels know; `Potential.kind` is a place in this list."""


@inlined
def potential_of(potential: Potential, s: float) -> tuple[float, float, float]:
    """The potential at a squared weighted error, and its first two derivatives."""
    nu, variance = potential.nu, potential.variance
    if potential.kind == 0:
        inverse = 1.0 / (s + variance)
        first = nu * inverse
        return nu * log(1.0 + s / variance), first, -first * inverse
    if potential.kind == 1:
        rest = exp(-s / variance)
        first = nu / variance * rest
        return nu * (1.0 - rest), first, -first / variance
    return nu * s / variance, nu / variance, 0.0 * s


@inlined
def robust_slope(potential: Potential, weight: float, du: float, dv: float) -> tuple[float, Slope]:
    """The potential of an error in the image, and the derivatives of half of it."""
    rho, first, second = potential_of(potential, weight * (du * du + dv * dv))
    stiffness, bend = weight * first, 2.0 * weight * weight * second
    return rho, Slope(
        stiffness * du,
        stiffness * dv,
        stiffness + bend * du * du,
        bend * du * dv,
        stiffness + bend * dv * dv,
    )
