"""The minimum of a weighted sum as a differentiable function of the weights.

A tracker returns `x(w) = argmin sum_t w_t f_t(x)` within bounds. Where a loss is put on x, the
weights can be learnt: at a minimum the gradient vanishes in the free variables F, and the implicit
function theorem gives how the minimum moves,

    sum_t w_t grad_F f_t(x(w)) = 0   =>   H_FF dx_F/dw_t = -grad_F f_t,    dx/dw_t = 0 elsewhere,

with H the Hessian of the sum there. Variables that a bound holds stay (their multiplier is positive
on both sides of w); where a multiplier is exactly zero the minimum has a kink, and what is returned
is the derivative of the side on which the variable stays at its bound.

Nothing of the descent is remembered: any optimiser and any number of steps will do, as long as they
end at a minimum. For a cost that finds its matches in the image afresh the theorem holds between
two changes of the matches, in the sense in which its gradient does.

    weights = TermWeights(("contour", "flow"))
    x = weighted_minimum(cost, weights, start, bounds)
    loss(x).backward()
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchcss.errors import ConfigurationError, check_shape
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.linalg import multiply, symmetric_part
from torchcss.types import Bounds, CostFunction, Matrices, Vectors

OPTIMISER = TrustRegionNewton(max_steps=60, tolerance=1e-8)
"""How `weighted_minimum` descends by default: to the end, where the theorem holds."""


class WeighedCost(CostFunction, Protocol):
    """A sum of named terms whose weights can be set; `torchcss.cost.total.TrackingCost` is one."""

    def with_weights(self, weights: Mapping[str, float]) -> Self:
        """The same with other factors on named terms; those that are not named keep theirs."""
        ...

    def gradients(self, x: Vectors) -> Mapping[str, Vectors]:
        """Gradient of every term by name, times its weight."""
        ...


class TermWeights(nn.Module):
    """Positive weights of named terms, learnt as logarithms.

    Args:
        names: The terms and priors to weigh.
        start: Weights to begin with, by name; one by default.

    Attributes:
        names: As given.
        log_weight: The parameters.

    Raises:
        ConfigurationError: If a starting weight is not positive, or belongs to no term.
    """

    def __init__(self, names: Sequence[str], start: Mapping[str, float] | None = None) -> None:
        super().__init__()
        start = dict(start or {})
        if unknown := sorted(set(start) - set(names)):
            raise ConfigurationError(f"TermWeights: no terms {unknown} among {', '.join(names)}")
        for name, weight in start.items():
            if not weight > 0:
                raise ConfigurationError(
                    f"TermWeights: expected a positive weight of {name}, got {weight}"
                )
        self.names = tuple(names)
        first = torch.tensor([start.get(name, 1.0) for name in names], dtype=torch.float64)
        self.log_weight = nn.Parameter(first.log())

    def forward(self) -> Float[Tensor, " t"]:
        """The weights, in the order of the names."""
        return self.log_weight.exp()

    def factors(self) -> dict[str, float]:
        """The weights by name as plain numbers, for `CostChoice.weights`."""
        return dict(zip(self.names, self.forward().tolist(), strict=True))


def weighted_minimum(
    cost: WeighedCost,
    weights: TermWeights,
    x0: Vectors,
    bounds: Bounds,
    *,
    optimiser: TrustRegionNewton = OPTIMISER,
) -> Vectors:
    """Descend on a weighted sum to a minimum that can be differentiated in its weights.

    Args:
        cost: The sum. Terms that `weights` does not name keep the weight that they have; named ones
            that the cost does not have, as flow in a first frame, are silent.
        weights: The weights.
        x0: Where to start.
        bounds: Box limits.
        optimiser: How to descend.
    """
    heavy = cost.with_weights(weights.factors())
    modes = optimiser.minimise(heavy, x0, bounds)
    x = modes.mean
    plain = cost.with_weights(dict.fromkeys(weights.names, 1.0)).gradients(x)
    return differentiable_minimum(
        x,
        heavy.local_model(x).hessian,
        torch.stack([plain.get(name, torch.zeros_like(x)) for name in weights.names], dim=-2),
        modes.active.bool(),
        weights().to(x),
    )


def differentiable_minimum(
    x: Vectors,
    hessian: Matrices,
    gradients: Float[Tensor, "*batch t n"],
    active: Bool[Tensor, "*batch n"],
    weights: Float[Tensor, " t"],
) -> Vectors:
    """Attach to a minimum how it depends on the weights of the terms that were summed.

    Args:
        x: The minimum of the weighted sum.
        hessian: Second derivative of the sum there.
        gradients: First derivative of each term there, not multiplied by its weight.
        active: True where a bound holds a variable (`Modes.active`).
        weights: The weights; the derivatives go to them.

    Returns:
        `x`, with the derivatives of the implicit function theorem. A direction in which the sum
        is flat or curved downwards, so that there is no minimum, gets none.

    Raises:
        ShapeError: If the tensors do not agree.
    """
    check_shape("x", x, None)
    check_shape("hessian", hessian, x.shape[-1], x.shape[-1])
    check_shape("gradients", gradients, len(weights), x.shape[-1])
    check_shape("active", active, x.shape[-1])
    return _Minimum.apply(x, hessian, gradients, active, weights)  # type: ignore[no-any-return]


class _Minimum(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, hessian: Tensor, gradients: Tensor, active: Tensor, weights: Tensor
    ) -> Tensor:
        ctx.save_for_backward(hessian, gradients, active, weights)
        return x.clone()

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor | None, ...]:
        hessian, gradients, active, weights = ctx.saved_tensors
        free = (~active.bool()).to(hessian)
        own = symmetric_part(hessian) * free[..., None] * free[..., None, :]
        value, direction = torch.linalg.eigh(own)
        # Held variables are directions of no curvature here, as are those of no minimum.
        # What eigenvalues are known to is no curvature: float32 resolves far less than `_FLAT`.
        rounding = 8 * value.shape[-1] * torch.finfo(value.dtype).eps
        least = value.abs().amax(-1, keepdim=True) * max(_FLAT, rounding)
        inverse = torch.where(value > least, 1.0 / value.clamp(min=least), 0.0)
        along = multiply(direction.mT, free * outputs[0])
        moved = multiply(direction, inverse * along) * free
        per_term = -(gradients * moved[..., None, :]).sum(-1)
        return None, None, None, None, per_term.reshape(-1, len(weights)).sum(0).to(weights)


_FLAT = 1e-12
"""Curvature relative to the largest below which a direction counts as flat, rounding aside."""
