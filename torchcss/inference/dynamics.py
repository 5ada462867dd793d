"""From one frame's posterior to the next frame's prior, `p(x_t | x_{t-1})` of eq. 10 [IJRR].

The paper uses trivial driftless diffusion and leaves the search to the covariances: `Diffusion`.
`ConstantVelocity` moves every mode on as it moved last; it helps on smooth motion and misleads on
sudden turns. `Learned` wraps any function from a state and its velocity to the next state, such as
a network that knows how people walk. What to call by default: `Diffusion(deviation=...)`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.inference.mixture import GaussianMixture
from torchcss.linalg import symmetric_part
from torchcss.types import Matrices, Vector, Vectors, frozen

Deviation = float | tuple[float, ...]
"""Standard deviation of every parameter, or one number for all."""


def noise_covariance(deviation: Deviation, like: Matrices) -> Float[Tensor, "n n"]:
    """Covariance of independent dynamical noise, in the type of other covariances."""
    noise = torch.as_tensor(deviation, dtype=like.dtype, device=like.device)
    return torch.diag_embed(noise.square().expand(like.shape[-1]))


class Dynamics(Protocol):
    """Anything that predicts a mixture one frame ahead."""

    def predict(self, mixture: GaussianMixture, velocity: Vectors) -> GaussianMixture:
        """Return the prior of the next frame.

        Args:
            mixture: Posterior of this frame.
            velocity: How far each mode moved since the last frame; zero for a new mode.
        """
        ...


@frozen
class Diffusion:
    """Modes stay and spread: `Sigma + diag(deviation^2)`.

    Attributes:
        deviation: Standard deviation of the motion in one frame, one number or one per parameter.
            Zero, the default, leaves the mixture as it is.
    """

    deviation: Deviation = 0.0

    def predict(self, mixture: GaussianMixture, velocity: Vectors) -> GaussianMixture:
        """Add the variance of the motion; the velocity is not used."""
        motion = noise_covariance(self.deviation, mixture.covariance)
        return mixture._replace(covariance=mixture.covariance + motion)


@frozen
class ConstantVelocity:
    """Modes move on as they moved last, and spread.

    Attributes:
        deviation: Standard deviation of the change of velocity, as in `Diffusion`.
        persistence: Share of the velocity that is kept, from 0 (diffusion) to 1.
    """

    deviation: Deviation = 0.0
    persistence: float = 1.0

    def predict(self, mixture: GaussianMixture, velocity: Vectors) -> GaussianMixture:
        """Add the velocity to the means and the variance of its change to the covariances."""
        moved = mixture._replace(mean=mixture.mean + self.persistence * velocity)
        return Diffusion(deviation=self.deviation).predict(moved, velocity)


ExpectedMotion = Callable[[Vector, Vector], Vector]
"""Next state, expected, from one state and how far it moved in the last frame. It must be made of
operations that `torch.func` can map over modes and differentiate."""


@frozen
class Learned:
    """Modes move by any differentiable transition, their covariances by its derivative, and spread.

    `mu' = g(mu, v)` and `Sigma' = G Sigma G^T + diag(deviation^2)` with `G = dg/dmu`: exact for a
    linear g, the extended Kalman filter's prediction for others. Particles have no covariance and
    move by g alone.

    Attributes:
        transition: g, see `ExpectedMotion`.
        deviation: Standard deviation of what g does not predict, as in `Diffusion`.
    """

    transition: ExpectedMotion
    deviation: Deviation = 0.0

    def predict(self, mixture: GaussianMixture, velocity: Vectors) -> GaussianMixture:
        """Apply the transition to every mode."""
        mean = torch.func.vmap(self.transition)(mixture.mean, velocity).detach()
        covariance = mixture.covariance
        if bool(covariance.any()):
            slope = torch.func.vmap(torch.func.jacrev(self.transition))(mixture.mean, velocity)
            covariance = symmetric_part(slope @ covariance @ slope.mT).detach()
        moved = mixture._replace(mean=mean, covariance=covariance)
        return Diffusion(deviation=self.deviation).predict(moved, velocity)
