"""A descent iteration of fixed shape: no branch looks at a number, so that it compiles whole.

`TrustRegionNewton` searches the damping of every step and drops items as they finish. Both decide
by what the tensors hold (`bool(stuck.any())`, `torch.nonzero`, loops that end early), and every
such decision breaks a graph. What remains without them is the Levenberg-Marquardt form of eq. 13
[IJRR], for all samples at once:

    (H + lambda W) dx = -g  on the free variables,    candidate = project(x + dx)

with one `lambda` per item, carried from iteration to iteration: it falls where the model predicted
the decrease well, rises where a candidate was refused, and by `RAISE` or more where the damped
matrix is not definite, `factorisations - 1` times at most. As in `TrustRegionNewton.step`
an iteration evaluates `cost.local_model` once, at the step planned before, accepts or refuses it
item by item, and plans the next; an item that waits for its first evaluation has the cost `inf`.

    state = start(x0)
    step = torch.compile(fixed_step, fullgraph=True)      # or fixed_step itself
    for _ in range(30):
        state, accepted = step(cost, state, bounds)

The cost must be traceable too: `TrackingCost` of keypoints and priors is. Items are never dropped,
saddles are not left along negative curvature, and nothing says when an item is done, so that the
search of the tracker stays with `TrustRegionNewton`. Give the same number of items in every call,
and every number that changes from frame to frame as a tensor: then nothing is compiled again.
`refill` puts new samples into the places of old ones, `scaled_draw` makes them (Fig. 6 [IJRR],
step 2.1).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.linalg import cholesky_apply, damped_cholesky, wall
from torchcss.types import Bounds, CostFunction, LocalModel

RAISE = 10.0
"""Factor on a damping with which the matrix is not definite."""
_GUESS = 1e-3
"""The damping tried next is no less than this share of the largest diagonal entry."""
REFUSED = 4.0
"""Factor on the damping of a refused step."""
_EASED = 1 / 3
"""Least factor on the damping of an accepted step (Nielsen 1999)."""
_LEAST_RATIO = 1e-4
"""Share of the predicted decrease below which a step is not worth taking."""
_LEAST, _MOST = 1e-9, 1e12
"""Limits of the damping."""


class FixedStepState(NamedTuple):
    """Where every item stands, and the step that it will try next.

    Attributes:
        x: Current states, admissible.
        model: Cost and derivatives there; the cost of an item not evaluated yet is `inf`.
        damping: `lambda` of eq. 13 of the planned step.
        step: The planned step; it ends inside the bounds.
        predicted: Decrease that the quadratic model predicts for it, nats.
    """

    x: Float[Tensor, "b n"]
    model: LocalModel
    damping: Float[Tensor, " b"]
    step: Float[Tensor, "b n"]
    predicted: Float[Tensor, " b"]


def start(x: Float[Tensor, "b n"], *, damping: float = 1.0) -> FixedStepState:
    """Items that wait for their first evaluation.

    Args:
        x: Starts; the first step moves them into the bounds.
        damping: First `lambda`, in nats per squared unit of `scale`.
    """
    b, n = x.shape
    zero = x.new_zeros(b)
    return FixedStepState(
        # A copy: tensors that are one and the same in one call only make a second graph.
        x=x.detach().clone(),
        model=LocalModel(zero + torch.inf, torch.zeros_like(x), x.new_zeros(b, n, n)),
        damping=zero + damping,
        step=torch.zeros_like(x),
        predicted=zero,
    )


def refill(
    state: FixedStepState,
    fresh: Bool[Tensor, " b"],
    x: Float[Tensor, "b n"],
    *,
    damping: float = 1.0,
) -> FixedStepState:
    """Put new starts into some places.

    Args:
        state: Items at work.
        fresh: Places that are to be filled anew.
        x: A start for every place; those of the other places are not used.
        damping: See `start`.
    """
    rows = fresh[:, None]
    return FixedStepState(
        x=torch.where(rows, x, state.x),
        # A start that is not finite keeps these derivatives; those of the last item would move it.
        model=LocalModel(
            torch.where(fresh, torch.inf, state.model.value),
            torch.where(rows, 0.0, state.model.gradient),
            torch.where(rows[..., None], 0.0, state.model.hessian),
        ),
        damping=torch.where(fresh, damping, state.damping),
        step=torch.where(rows, 0.0, state.step),
        predicted=torch.where(fresh, 0.0, state.predicted),
    )


def scaled_draw(
    mean: Float[Tensor, "b n"],
    factor: Float[Tensor, "b n n"],
    noise: Float[Tensor, "b n"],
    deviation_scale: float | Tensor,
) -> Float[Tensor, "b n"]:
    """Samples of inflated Gaussians, `mean + deviation_scale L z`, where they were drawn.

    The random numbers come from outside, since a generator does not go through a compiled graph.

    Args:
        mean: Mode of each sample.
        factor: Its `L` with `L L^T` the covariance.
        noise: Standard normal numbers `z`.
        deviation_scale: Factor on standard deviations, the root of that on covariances.
    """
    return mean + deviation_scale * (factor @ noise[..., None])[..., 0]


def fixed_step(
    cost: CostFunction,
    state: FixedStepState,
    bounds: Bounds,
    *,
    scale: Float[Tensor, " n"] | None = None,
    factorisations: int = 3,
) -> tuple[FixedStepState, Bool[Tensor, " b"]]:
    """Evaluate the planned steps once, keep those that lower the cost, and plan the next.

    Args:
        cost: What to minimise.
        state: From `start`, or from the last call.
        bounds: Box limits; infinite where there are none.
        scale: Positive length of each parameter that counts as one, `W = diag(1 / scale^2)`; ones
            by default, which suits radians and metres.
        factorisations: Dampings that may be tried for one step. All are factored for every item.

    Returns:
        The state, and which items moved (or were evaluated for the first time). No item's cost
        rises. An item that is not finite at its start stays there with the cost `inf`.
    """
    x = state.x
    weight = x.new_ones(x.shape[-1]) if scale is None else scale.to(x).square().reciprocal()
    candidate = bounds.project(x + state.step)
    # Contiguous, because the next call would see another layout as a reason to compile again.
    model = LocalModel(*(part.contiguous() for part in cost.local_model(candidate)))
    total = model.value + model.gradient.sum(-1) + model.hessian.flatten(1).sum(-1)
    finite = total.isfinite() & candidate.isfinite().all(-1)

    first = state.model.value.isinf()
    decrease = torch.where(finite, state.model.value - model.value, -torch.inf)
    promised = state.predicted > 0
    ratio = decrease / torch.where(promised, state.predicted, 1.0)
    accepted = finite & (first | (promised & (decrease >= 0) & (ratio > _LEAST_RATIO)))
    # Nielsen's rule: the factor is 1 at half of the predicted decrease.
    eased = (1 - (2 * ratio.clamp(0, 2) - 1) ** 3).clamp(_EASED, REFUSED)
    factor = torch.where(accepted, torch.where(first, 1.0, eased), REFUSED)
    damping = (state.damping * factor).clamp(_LEAST, _MOST)

    x = torch.where(accepted[:, None], candidate, x)
    model = LocalModel(
        torch.where(accepted, model.value, state.model.value),
        torch.where(accepted[:, None], model.gradient, state.model.gradient),
        torch.where(accepted[:, None, None], model.hessian, state.model.hessian),
    )
    step, damping = _planned(x, model, damping, bounds, weight, factorisations)
    times = (step[:, None, :] @ model.hessian)[:, 0]
    predicted = -(step * (model.gradient + 0.5 * times)).sum(-1)
    return FixedStepState(x, model, damping, step, predicted), accepted


def _planned(
    x: Float[Tensor, "b n"],
    model: LocalModel,
    damping: Float[Tensor, " b"],
    bounds: Bounds,
    weight: Float[Tensor, " n"],
    factorisations: int,
) -> tuple[Float[Tensor, "b n"], Float[Tensor, " b"]]:
    """Solve eq. 13 on the free variables, cut the step off at the bounds; steps and dampings.

    An item whose matrix is not definite with any damping tried gets the step zero, which will be
    refused, and goes on with the next damping.
    """
    gradient = model.gradient
    held = ((x <= bounds.lower.to(x)) & (gradient > 0)) | (
        (x >= bounds.upper.to(x)) & (gradient < 0)
    )
    force = torch.where(held, 0.0, gradient)
    curvature = model.hessian.diagonal(dim1=-2, dim2=-1).abs() / weight
    guess = _GUESS * torch.where(held, 0.0, curvature).amax(-1)
    step, ok = torch.zeros_like(x), torch.zeros_like(damping, dtype=torch.bool)
    for attempt in range(factorisations):
        diagonal = torch.where(held, wall(x.dtype), damping[:, None] * weight)
        factor, definite = damped_cholesky(model.hessian, diagonal)
        solved = -cholesky_apply(factor, force)
        now = definite & ~ok
        step = torch.where(now[:, None] & ~held, solved, step)
        ok = ok | definite
        if attempt < factorisations - 1:
            raised = torch.maximum(RAISE * damping, guess).clamp(max=_MOST)
            damping = torch.where(ok, damping, raised)
    return bounds.project(x + step) - x, damping
