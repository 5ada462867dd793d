"""From one frame's posterior to the next frame's prior, `p(x_t | x_{t-1})` of eq. 10 [IJRR].

The paper uses trivial driftless diffusion and leaves the search to the covariances: `Diffusion`.
`ConstantVelocity` moves every mode on as it moved last; it helps on smooth motion and misleads on
sudden turns. What to call by default: `Diffusion(deviation=...)`.
"""

from __future__ import annotations

from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.inference.mixture import GaussianMixture
from torchcss.types import Matrices, Vectors, frozen

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
