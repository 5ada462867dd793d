"""Temporal prior: `p(x_t | R_{t-1})` of eq. 10 [IJRR] in the cost.

The papers start each search from it but leave it out of the cost; in directions that no image term
sees, modes then drift. `MixturePrior`, the default, is the density of the whole previous mixture,
moved one frame ahead, correlations and all: what no image has shown for many frames drifts apart as
a random walk does. `TemporalPrior` is the driftless diffusion about each sample's own parent mode,
which forgets how well that was known. Both are long-tailed, so that a fast motion is unlikely and
not impossible.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.cost.context import FrameContext
from torchcss.cost.stabiliser import long_tailed
from torchcss.cost.term import OnStates, Term
from torchcss.inference.mixture import GaussianMixture
from torchcss.types import LocalModel, Vectors, frozen

_LEAST_VARIANCE = 1e-12


@frozen
class TemporalPrior(Term):
    """Long-tailed prior about the parent mode.

    Attributes:
        nu: Height of the tails, nats.
    """

    name = "temporal"
    kind = "prior"
    of_past = True

    nu: float = 4.0

    def prepare(self, context: FrameContext) -> OnStates | None:
        """Bind the prior to the modes before; None without them or without a known motion."""
        prior, deviation = context.prior, context.deviation
        if prior is None or deviation is None:
            return None
        return OnStates(
            lambda posed, _: long_tailed(posed.x, posed.of_parent(prior.mean), deviation, self.nu)
        )


class MixtureDensity(NamedTuple):
    """The previous mixture, one frame ahead, ready to be evaluated many times.

    Attributes:
        mean: Means of the modes.
        precision: Inverse covariances, motion included.
        log_amplitude: Logarithm of each mode's density at its mean; that of the highest is zero.
    """

    mean: Float[Tensor, "k n"]
    precision: Float[Tensor, "k n n"]
    log_amplitude: Float[Tensor, " k"]


@frozen
class MixturePrior(Term):
    """The whole of `p(x_t | R_{t-1})`: the modes of the previous frame, widened by the motion.

        f(x) = -log( e^-nu + sum_k a_k exp(-1/2 (x - mu_k)^T P_k (x - mu_k)) )

    with `a_k` the density of mode k at its mean, relative to the highest. A sample may move from
    one mode to another for what their weights differ by; far from all of them the cost is nu and
    there is no pull, so that a fast motion is unlikely and not impossible.

    Attributes:
        nu: Height of the tails, nats; None: the number n of parameters. A mode that moved as is
            expected is at n / 2 on average; twice that is new.
    """

    name = "temporal_mixture"
    kind = "prior"
    of_past = True

    nu: float | None = None

    def height(self, size: int) -> float:
        """Height of the tails in a space of so many parameters, nats."""
        return float(size) if self.nu is None else self.nu

    def prepare(self, context: FrameContext) -> OnStates | None:
        """Bind the prior to the modes before; None without them."""
        if context.prior is None:
            return None
        return OnStates(
            lambda posed, _: self.local_model(posed.x, posed.context.of(self.density_in))
        )

    def density_in(self, context: FrameContext) -> MixtureDensity:
        """The prior of a frame that has modes before."""
        assert context.prior is not None
        return self.density(context.prior)

    def density(self, predicted: GaussianMixture) -> MixtureDensity:
        """Prepare the prior of a frame.

        Args:
            predicted: The previous posterior, one frame ahead (`Dynamics.predict`).
        """
        like = predicted.covariance
        identity = torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)
        # A variance of zero (a frozen parameter) is as good as a very small one.
        variance = predicted.covariance.diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None]
        least = torch.finfo(identity.dtype).eps * variance.clamp(min=_LEAST_VARIANCE)
        root = torch.linalg.cholesky_ex(predicted.covariance + least * identity)[0]
        height = predicted.log_weight - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return MixtureDensity(predicted.mean, torch.cholesky_inverse(root), height - height.max())

    def local_model(self, x: Vectors, density: MixtureDensity) -> LocalModel:
        """Cost, gradient and Hessian.

        Args:
            x: States.
            density: What `density` made.
        """
        # The square of a larger number would overflow; the share of a mode is nil there anyway.
        limit = 1e-4 * (torch.finfo(x.dtype).max / density.precision.amax()).sqrt()
        offset = (x[..., None, :] - density.mean).clamp(-limit, limit)
        pull = (density.precision @ offset[..., None])[..., 0]
        exponent = density.log_amplitude - 0.5 * (offset * pull).sum(-1)
        tail = exponent.new_full((*exponent.shape[:-1], 1), -self.height(x.shape[-1]))
        everything = torch.cat([exponent, tail], dim=-1)
        share = everything.softmax(-1)[..., :-1]
        gradient = (share[..., None] * pull).sum(-2)
        hessian = (share[..., None, None] * density.precision).sum(-3)
        hessian = hessian - (share[..., None] * pull).transpose(-1, -2) @ pull
        hessian = hessian + gradient[..., :, None] * gradient[..., None, :]
        return LocalModel(-everything.logsumexp(-1), gradient, hessian)
