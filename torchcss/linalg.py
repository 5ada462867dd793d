"""Batched helpers for symmetric matrices: Hessians and covariances.

Two kinds of matrix occur. *Hessians* inside the search are symmetric and often indefinite; they are
damped and factored by Cholesky, item by item, and an item whose factor does not exist is reported,
never raised. *Covariances* are positive semi-definite, may be singular (a parameter that is known
exactly), and may spread over many orders of magnitude or mix metres with radians. Every function on
covariances therefore first divides by the standard deviations, so that the answer depends neither
on the units nor on the overall size, and then treats a direction whose share of the variance is
below the numerical resolution as one of exactly that resolution.

What to call: `damped_cholesky` and `mask_free` inside iterations (cheap), `inverse_on_free` once at
convergence, `covariance_factor` to sample, `squared_mahalanobis` and `log_determinant` to compare.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def symmetric_part(matrix: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """Return the mean of a matrix and its transpose."""
    return 0.5 * (matrix + matrix.mT)


def mask_free(
    matrix: Float[Tensor, "*batch n n"], free: Bool[Tensor, "*batch n"]
) -> Float[Tensor, "*batch n n"]:
    """Replace the rows and columns of variables that are not free by those of the identity.

    A system with this matrix and a right-hand side that is zero on the fixed variables leaves them
    where they are and solves for the free ones.
    """
    both = free[..., :, None] & free[..., None, :]
    identity = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    return torch.where(both, matrix, identity)


def damped_cholesky(
    matrix: Float[Tensor, "*batch n n"], damping: Float[Tensor, "*batch n"]
) -> tuple[Float[Tensor, "*batch n n"], Bool[Tensor, "*batch"]]:
    """Factor `matrix + diag(damping)` item by item.

    Args:
        matrix: Symmetric matrices, definite or not.
        damping: What is added to each diagonal.

    Returns:
        The lower factors, and which of them exist. A factor that does not exist holds no
        meaningful number.
    """
    damped = matrix.clone()
    damped.diagonal(dim1=-2, dim2=-1).add_(damping)
    factor, failed = torch.linalg.cholesky_ex(damped)
    return factor, failed == 0


def cholesky_apply(
    factor: Float[Tensor, "*batch n n"], vector: Float[Tensor, "*batch n"]
) -> Float[Tensor, "*batch n"]:
    """Multiply a vector by the inverse of `factor factor^T`."""
    return torch.cholesky_solve(vector[..., None], factor)[..., 0]


def inverse_on_free(
    hessian: Float[Tensor, "*batch n n"],
    free: Bool[Tensor, "*batch n"],
    prior_variance: Float[Tensor, " n"],
) -> Float[Tensor, "*batch n n"]:
    """Covariance of a mode: the inverse Hessian on the free variables, never wider than the prior.

    In units of the prior's standard deviations, an eigen-direction of curvature `e > 1` gets the
    variance `1 / e`. A direction of smaller, zero or negative curvature, about which the cost says
    less than the prior does, gets the prior's variance, 1; so does every variable that is not free
    (design decision 9). The result is positive definite whatever the Hessian. It is computed in
    float64, by Cholesky where every curvature exceeds 1 and by eigenvectors for the other items.

    Args:
        hessian: Second derivative of the cost in nats; need not be definite.
        free: Variables that no bound holds.
        prior_variance: Positive variance of each parameter before the image is seen.

    Returns:
        Covariances in the Hessian's dtype.
    """
    n = hessian.shape[-1]
    deviation = prior_variance.to(device=hessian.device, dtype=torch.float64).sqrt()
    scaled = symmetric_part(hessian.detach().to(torch.float64)) * torch.outer(deviation, deviation)
    scaled = mask_free(scaled, free).reshape(-1, n, n)
    above_one = scaled.clone()
    # Fixed variables have the curvature 1 exactly; adding 1 keeps them from deciding the test.
    above_one.diagonal(dim1=-2, dim2=-1).add_((~free).reshape(-1, n).to(scaled) - 1)
    informed = torch.linalg.cholesky_ex(above_one)[1] == 0
    inverse = torch.empty_like(scaled)
    inverse[informed] = torch.cholesky_inverse(torch.linalg.cholesky_ex(scaled[informed])[0])
    if not bool(informed.all()):
        values, vectors = torch.linalg.eigh(scaled[~informed])
        inverse[~informed] = (vectors / values.clamp(min=1)[:, None, :]) @ vectors.mT
    inverse = inverse.reshape(hessian.shape) * torch.outer(deviation, deviation)
    return symmetric_part(inverse).to(hessian.dtype)


def _standardised(
    covariance: Float[Tensor, "*batch n n"],
) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n n"]]:
    """Split a covariance into standard deviations and correlations; never a zero deviation."""
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    smallest = torch.finfo(covariance.dtype).tiny
    deviation = variance.clamp(min=smallest).sqrt()
    correlation = covariance / deviation[..., :, None] / deviation[..., None, :]
    return deviation, symmetric_part(correlation)


def covariance_factor(covariance: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """Return `A` with `A A^T = covariance`, also where the covariance is singular.

    Negative eigenvalues, which only rounding can cause, count as zero.
    """
    deviation, correlation = _standardised(covariance)
    values, vectors = torch.linalg.eigh(correlation)
    return deviation[..., :, None] * vectors * values.clamp(min=0).sqrt()[..., None, :]


def _resolved_eigen(
    covariance: Float[Tensor, "*batch n n"],
) -> tuple[Float[Tensor, "*batch n"], Float[Tensor, "*batch n"], Float[Tensor, "*batch n n"]]:
    """Deviations, then eigenvalues (no smaller than the resolution) and vectors of correlations."""
    deviation, correlation = _standardised(covariance)
    values, vectors = torch.linalg.eigh(correlation)
    resolution = covariance.shape[-1] * torch.finfo(covariance.dtype).eps
    return deviation, values.clamp(min=resolution), vectors


def log_determinant(covariance: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch"]:
    """Log-determinant of a covariance; finite where it is singular, as the module page says."""
    deviation, values, _ = _resolved_eigen(covariance)
    return 2 * deviation.log().sum(-1) + values.log().sum(-1)


def squared_mahalanobis(
    difference: Float[Tensor, "*batch n"], covariance: Float[Tensor, "*batch n n"]
) -> Float[Tensor, "*batch"]:
    """Squared distance in the metric of a covariance.

    Args:
        difference: Vectors; leading dimensions broadcast with those of the covariance.
        covariance: Positive semi-definite. Along a direction of no variance the distance is very
            large, as it ought to be, but finite as long as the dtype can hold it.
    """
    return (whitener(covariance) @ difference[..., None])[..., 0].square().sum(-1)


def whitener(covariance: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """Return `A` such that `|A d|^2` is the squared Mahalanobis distance of `d`.

    For many differences under one covariance, multiply by this rather than calling
    `squared_mahalanobis` again.
    """
    deviation, values, vectors = _resolved_eigen(covariance)
    return vectors.mT / values.sqrt()[..., :, None] / deviation[..., None, :]
