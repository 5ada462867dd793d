"""Temporal prior: each sample near the mode that it descends from.

This is `p(x_t | R_{t-1})` of eq. 10 [IJRR]. The papers start each search from it but leave it out
of the cost; in directions that no image term sees, modes then drift. Here the driftless diffusion
about the parent mode may join the cost, long-tailed so that a fast motion is unlikely and not
impossible. It is evaluated per sample against its own parent.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from torchcss.cost.stabiliser import long_tailed
from torchcss.types import LocalModel


@dataclass(frozen=True, kw_only=True)
class TemporalPrior:
    """Long-tailed prior about the parent mode.

    Attributes:
        nu: Height of the tails, nats.
    """

    nu: float = 4.0

    def local_model(
        self,
        x: Float[Tensor, "*batch n"],
        parent: Float[Tensor, "*#batch n"],
        deviation: Float[Tensor, " n"],
    ) -> LocalModel:
        """Cost, gradient and (diagonal) Hessian.

        Args:
            x: States.
            parent: The state of each sample's parent mode at the previous frame.
            deviation: Expected motion per frame; infinite where nothing is known.
        """
        return long_tailed(x, parent, deviation, self.nu)
