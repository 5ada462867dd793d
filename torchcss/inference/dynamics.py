"""From one frame's posterior to the next frame's prior, `p(x_t | x_{t-1})` of eq. 10 [IJRR].

The paper uses trivial driftless diffusion and leaves the search to the covariances: `Diffusion`.
`ConstantVelocity` moves every mode on as it moved last; it helps on smooth motion and misleads on
sudden turns. What to call by default: `Diffusion(deviation=...)`.

Both are of one interval between frames, the usual one. A frame that comes later, because those
before it were dropped, is predicted as if they had been there and had shown nothing (`over`): over
r intervals variances are r times as large, and a mode goes on by `p + p^2 + ... + p^r` of its
velocity, p being the share that it keeps.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.errors import check_range
from torchcss.inference.mixture import GaussianMixture
from torchcss.types import Matrices, Vectors, frozen

Deviation = float | tuple[float, ...]
"""Standard deviation of every parameter, or one number for all."""


def noise_covariance(deviation: Deviation, like: Matrices) -> Float[Tensor, "n n"]:
    """Covariance of independent dynamical noise, in the type of other covariances."""
    noise = torch.as_tensor(deviation, dtype=like.dtype, device=like.device)
    return torch.diag_embed(noise.square().expand(like.shape[-1]))


def summed(deviation: Deviation, intervals: float) -> Deviation:
    """Standard deviation of the noise of so many intervals together."""
    factor = math.sqrt(intervals)
    many = isinstance(deviation, tuple)
    return tuple(factor * each for each in deviation) if many else factor * deviation


class Dynamics(Protocol):
    """Anything that predicts a mixture one frame ahead."""

    def predict(self, mixture: GaussianMixture, velocity: Vectors) -> GaussianMixture:
        """Return the prior of the next frame.

        Args:
            mixture: Posterior of this frame.
            velocity: How far each mode moved in the last interval; zero for a new mode.
        """
        ...

    def over(self, intervals: float) -> Dynamics:
        """The same of a frame that comes so many intervals after the one before it."""
        ...


@frozen
class Diffusion:
    """Modes stay and spread: `Sigma + diag(deviation^2)`.

    Attributes:
        deviation: Standard deviation of the motion in one frame, one number or one per parameter.
            Zero, the default, leaves the mixture as it is.
    """

    deviation: Deviation = 0.0

    def __post_init__(self) -> None:
        check_range(self, "deviation")

    def predict(self, mixture: GaussianMixture, velocity: Vectors) -> GaussianMixture:
        """Add the variance of the motion; the velocity is not used."""
        motion = noise_covariance(self.deviation, mixture.covariance)
        return mixture._replace(covariance=mixture.covariance + motion)

    def over(self, intervals: float) -> Diffusion:
        """See `Dynamics.over`."""
        return replace(self, deviation=summed(self.deviation, intervals))


@frozen
class ConstantVelocity:
    """Modes move on as they moved last, and spread.

    Attributes:
        deviation: Standard deviation of the change of velocity, as in `Diffusion`.
        persistence: Share of the velocity that is kept, from 0 (diffusion) to 1; over several
            intervals it is in units of one, and may be more.
    """

    deviation: Deviation = 0.0
    persistence: float = 1.0

    def __post_init__(self) -> None:
        check_range(self, "deviation", "persistence")

    def predict(self, mixture: GaussianMixture, velocity: Vectors) -> GaussianMixture:
        """Add the velocity to the means and the variance of its change to the covariances."""
        moved = mixture._replace(mean=mixture.mean + self.persistence * velocity)
        return Diffusion(deviation=self.deviation).predict(moved, velocity)

    def over(self, intervals: float) -> ConstantVelocity:
        """See `Dynamics.over`."""
        kept, whole = self.persistence, intervals
        if kept != 1:
            whole = (1 - kept**intervals) / (1 - kept)
        return ConstantVelocity(
            deviation=summed(self.deviation, intervals), persistence=kept * whole
        )
