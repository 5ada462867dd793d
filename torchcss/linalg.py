"""Batched helpers for symmetric matrices: Hessians and covariances.

Two kinds of matrix occur. *Hessians* inside the search are symmetric and often indefinite; they are
damped and factored by Cholesky, item by item, and an item whose factor does not exist is reported,
never raised. *Covariances* are positive semi-definite, may be singular (a parameter that is known
exactly), and may spread over many orders of magnitude or mix metres with radians. Every function on
covariances therefore first divides by the standard deviations, so that the answer depends neither
on the units nor on the overall size, and then treats a direction whose share of the variance is
below the numerical resolution as one of exactly that resolution.

What to call: `damped_cholesky` and `mask_free` inside iterations (cheap), `inverse_on_free` or
`constrained_inverse` once at convergence, `covariance_factor` to sample, `squared_mahalanobis` and
`log_determinant` to compare.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.types import Matrices, Numbers, Vector, Vectors

MATRICES_AT_ONCE = 256
"""Matrices inverted at a time: a few copies of them stay in the caches."""


LEAST_CURVATURE = 100.0
"""Floor on the eigenvalues of a Hessian that is not positive definite on the free variables, nats
per squared deviation of the prior: such a direction is a tenth as wide as the prior, some degrees,
about what a joint moves in a frame. Ours: the papers invert the Hessian and say nothing of this.
With 1, samples of the printed cost, of which most ends need the floor, go all over the limits."""

LEAST_DEVIATION = 1e-2
"""Metres or radians within which a parameter that a bound holds counts as the same, where modes of
`constrained_inverse` are compared. Ours."""


def symmetric_part(matrix: Matrices) -> Matrices:
    """Return the mean of a matrix and its transpose."""
    return 0.5 * (matrix + matrix.mT)


def multiply(
    matrix: Float[Tensor, "*#batch m n"], vector: Float[Tensor, "*#batch n"]
) -> Float[Tensor, "*batch m"]:
    """Multiply a vector by a matrix, item by item."""
    return (matrix @ vector[..., None])[..., 0]


def mask_free(matrix: Matrices, free: Bool[Tensor, "*batch n"]) -> Matrices:
    """Replace the rows and columns of variables that are not free by those of the identity.

    A system with this matrix and a right-hand side that is zero on the fixed variables leaves them
    where they are and solves for the free ones.
    """
    both = free[..., :, None] & free[..., None, :]
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return torch.where(both, matrix, identity)


def damped_cholesky(
    matrix: Matrices, damping: Vectors, *, overwrite: bool = False
) -> tuple[Matrices, Bool[Tensor, "*batch"]]:
    """Factor `matrix + diag(damping)` item by item.

    Args:
        matrix: Symmetric matrices, definite or not.
        damping: What is added to each diagonal.
        overwrite: Whether the matrices may be changed, which saves a copy.

    Returns:
        The lower factors, and which of them exist. A factor that does not exist holds no
        meaningful number.
    """
    damped = matrix if overwrite else matrix.clone()
    torch.linalg.diagonal(damped).add_(damping)
    # The upper factor, transposed: on a CPU it takes a sixth less time than the lower one.
    factor, failed = torch.linalg.cholesky_ex(damped, upper=True)
    return factor.mT, failed == 0


def wall(dtype: torch.dtype) -> float:
    """A damping that keeps a variable where it is, as if its row and column were not there.

    Its square root, by which a factorisation divides, makes any number of use vanish in rounding.
    """
    return torch.finfo(dtype).max ** 0.75


def solve_lower(factor: Matrices, vector: Vectors) -> Vectors:
    """Multiply a vector by the inverse of a lower factor."""
    return torch.linalg.solve_triangular(factor, vector[..., None], upper=False)[..., 0]


def cholesky_apply(factor: Matrices, vector: Vectors) -> Vectors:
    """Multiply a vector by the inverse of `factor factor^T`."""
    lower = solve_lower(factor, vector)[..., None]
    return torch.linalg.solve_triangular(factor.mT, lower, upper=True)[..., 0]


def prior_units(prior_variance: Vector) -> Float[Tensor, "n n"]:
    """What turns a Hessian into one in units of the prior's deviations, entry by entry."""
    deviation = prior_variance.sqrt()
    return torch.outer(deviation, deviation)


def inverse_on_free(
    hessian: Matrices,
    free: Bool[Tensor, "*batch n"],
    prior_variance: Vector,
    gradient: Vectors | None = None,
) -> Matrices:
    """Covariance of a mode: the inverse Hessian on the free variables, never wider than the prior.

    In units of the prior's standard deviations, an eigen-direction of curvature `e > 1` gets the
    variance `1 / e`. A direction of smaller, zero or negative curvature, about which the cost says
    less than the prior does, gets the prior's variance, 1. A variable that a bound holds may leave
    it to one side alone, against the slope g of the cost: its density falls as `exp(-|g| t)`, with
    the deviation `1 / |g|` (decision "active bounds"). It is uncorrelated with the others, and no
    wider than the widest of them. The result is positive definite whatever the Hessian. It is
    computed in float64, by Cholesky where every curvature exceeds 1 and by eigenvectors for the
    other items.

    Args:
        hessian: Second derivative of the cost in nats; need not be definite.
        free: Variables that no bound holds.
        prior_variance: Positive variance of each parameter before the image is seen.
        gradient: First derivative; None: what a bound holds keeps the prior's variance.

    Returns:
        Covariances in the Hessian's dtype.
    """
    batch, n = hessian.shape[:-2], hessian.shape[-1]
    units = prior_units(prior_variance.to(device=hessian.device, dtype=torch.float64))
    pairs = zip(
        hessian.detach().reshape(batch.numel(), n, n).split(MATRICES_AT_ONCE),
        free.expand(*batch, n).reshape(batch.numel(), n).split(MATRICES_AT_ONCE),
        strict=True,
    )
    parts = [_inverse_at_least_one(part.double() * units, loose) * units for part, loose in pairs]
    covariance = torch.cat(parts).reshape(hessian.shape)
    if gradient is not None:
        variance = torch.linalg.diagonal(covariance)
        widest = torch.where(free, variance, 0.0).amax(-1, keepdim=True)
        one_sided = variance.minimum(gradient.detach().double() ** -2)
        one_sided = torch.where(widest > 0, one_sided.minimum(widest), one_sided)
        variance.copy_(torch.where(free, variance, one_sided))
    return covariance.to(hessian.dtype)


def _inverse_at_least_one(matrix: Matrices, free: Bool[Tensor, "b n"]) -> Matrices:
    """Inverse on the free variables with every eigenvalue below one raised to one."""
    scaled = mask_free(symmetric_part(matrix), free)
    above_one = scaled.clone()
    # Fixed variables have the curvature 1 exactly; adding 1 keeps them from deciding the test.
    torch.linalg.diagonal(above_one).add_((~free).to(scaled) - 1)
    informed = torch.linalg.cholesky_ex(above_one)[1] == 0
    inverse = torch.empty_like(scaled)
    inverse[informed] = torch.cholesky_inverse(torch.linalg.cholesky_ex(scaled[informed])[0])
    if not bool(informed.all()):
        values, vectors = torch.linalg.eigh(scaled[~informed])
        inverse[~informed] = (vectors / values.clamp(min=1)[:, None, :]) @ vectors.mT
    return symmetric_part(inverse)


def constrained_inverse(
    hessian: Matrices, free: Bool[Tensor, "*batch n"], prior_variance: Vector
) -> tuple[Matrices, Bool[Tensor, "*batch"]]:
    """Covariance of a mode as the papers print it: `H^-1` on the free variables, zero elsewhere.

    Note 8 and Fig. 6 step 2.3 [IJRR], section 4.2 [RR]; nothing is capped. Where the Hessian is not
    positive definite on the free variables, its eigenvalues in units of the prior's deviations are
    raised to `LEAST_CURVATURE`. Computed in float64.

    Args:
        hessian: Second derivative of the cost in nats, finite; need not be definite.
        free: Variables that no bound holds.
        prior_variance: Positive variance of each parameter before the image is seen.

    Returns:
        Covariances in the Hessian's dtype, and for which of them the floor was needed.
    """
    units = prior_units(prior_variance.to(device=hessian.device, dtype=torch.float64))
    scaled = mask_free(symmetric_part(hessian.detach().double()) * units, free)
    values, vectors = torch.linalg.eigh(scaled)
    rounding = hessian.shape[-1] * torch.finfo(hessian.dtype).eps * values.abs().amax(-1)
    floored = values[..., 0] <= rounding
    values = torch.where(floored[..., None], values.clamp(min=LEAST_CURVATURE), values)
    inverse = symmetric_part((vectors / values[..., None, :]) @ vectors.mT) * units
    both = free[..., :, None] & free[..., None, :]
    return torch.where(both, inverse, 0.0).to(hessian.dtype), floored


def with_least_width(covariance: Matrices, deviation: float = LEAST_DEVIATION) -> Matrices:
    """Give parameters without any width a little, so that the covariance has an inverse."""
    without = torch.linalg.diagonal(covariance) <= 0
    return covariance + deviation**2 * torch.diag_embed(without).to(covariance)


def _standardised(covariance: Matrices) -> tuple[Vectors, Matrices]:
    """Split a covariance into standard deviations and correlations; never a zero deviation."""
    variance = torch.linalg.diagonal(covariance)
    smallest = torch.finfo(covariance.dtype).tiny
    deviation = variance.clamp(min=smallest).sqrt()
    correlation = covariance / deviation[..., :, None] / deviation[..., None, :]
    return deviation, symmetric_part(correlation)


def covariance_factor(covariance: Matrices) -> Matrices:
    """Return `A` with `A A^T = covariance`, also where the covariance is singular.

    Negative eigenvalues, which only rounding can cause, count as zero.
    """
    deviation, correlation = _standardised(covariance)
    values, vectors = torch.linalg.eigh(correlation)
    return deviation[..., :, None] * vectors * values.clamp(min=0).sqrt()[..., None, :]


def _resolved_eigen(covariance: Matrices) -> tuple[Vectors, Vectors, Matrices]:
    """Deviations, then eigenvalues (no smaller than the resolution) and vectors of correlations."""
    deviation, correlation = _standardised(covariance)
    values, vectors = torch.linalg.eigh(correlation)
    resolution = covariance.shape[-1] * torch.finfo(covariance.dtype).eps
    return deviation, values.clamp(min=resolution), vectors


def _factored(covariance: Matrices) -> tuple[Vectors, Matrices, Bool[Tensor, "*batch"]]:
    """Deviations, lower factors of the resolved correlations, and which of these exist."""
    deviation, correlation = _standardised(covariance)
    resolution = deviation.new_tensor(covariance.shape[-1] * torch.finfo(covariance.dtype).eps)
    factor, found = damped_cholesky(correlation, resolution)
    return deviation, factor, found


def log_determinant(covariance: Matrices) -> Numbers:
    """Log-determinant of a covariance; finite where it is singular, as the module page says."""
    deviation, factor, found = _factored(covariance)
    result = 2 * (deviation * torch.linalg.diagonal(factor)).log().sum(-1)
    if bool(found.all()):
        return result
    deviation, values, _ = _resolved_eigen(covariance)
    return torch.where(found, result, 2 * deviation.log().sum(-1) + values.log().sum(-1))


def squared_mahalanobis(difference: Vectors, covariance: Matrices) -> Numbers:
    """Squared distance in the metric of a covariance.

    Args:
        difference: Vectors; leading dimensions broadcast with those of the covariance.
        covariance: Positive semi-definite. Along a direction of no variance the distance is very
            large, as it ought to be, but finite as long as the dtype can hold it.
    """
    return squared_lengths(difference[..., None, :], covariance)[..., 0]


def squared_lengths(
    differences: Float[Tensor, "*#batch s n"], covariance: Matrices
) -> Float[Tensor, "*batch s"]:
    """Squared Mahalanobis distances of several vectors under each covariance.

    Args:
        differences: Vectors; leading dimensions broadcast with those of the covariance.
        covariance: See `squared_mahalanobis`.
    """
    deviation, factor, found = _factored(covariance)
    standard = (differences / deviation[..., None, :]).mT
    result = torch.linalg.solve_triangular(factor, standard, upper=False).square().sum(-2)
    if bool(found.all()):
        return result
    others = (differences @ whitener(covariance).mT).square().sum(-1)
    return torch.where(found[..., None], result, others)


def whitener(covariance: Matrices) -> Matrices:
    """Return `A` such that `|A d|^2` is the squared Mahalanobis distance of `d`.

    For many differences under one covariance, multiply by this rather than calling
    `squared_mahalanobis` again.
    """
    deviation, values, vectors = _resolved_eigen(covariance)
    return vectors.mT / values.sqrt()[..., :, None] / deviation[..., None, :]
