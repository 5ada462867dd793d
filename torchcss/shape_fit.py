"""Stages two and three of initialisation: the flesh, then everything (section 5 [IJRR]).

The second stage fits cross-sections and tapers of all parts, left and right tied, to joints and
outlines in the image while pose and lengths are held; the third fits all parameters to the same.
Each is the bound-constrained robust optimisation of section 4.1 on `ShapedCost`, from the best fit
so far.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.shape import CROSS_SECTIONS, ShapeParameters
from torchcss.cost.shaped import Outline, ShapedCost
from torchcss.cost.total import TrackingCost
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.types import Bounds


class ShapeFit(NamedTuple):
    """Pose, lengths and shape after a stage.

    Attributes:
        state: State of the body with free lengths.
        shape: Offsets of the shape parameters.
        cost: Nats.
    """

    state: Float[Tensor, " n"]
    shape: Float[Tensor, " z"]
    cost: float


def fit_shape(
    base: TrackingCost,
    state: Float[Tensor, " n"],
    parameters: ShapeParameters,
    outlines: tuple[Outline, ...],
    *,
    bounds: Bounds | None = None,
    max_steps: int = 25,
) -> tuple[ShapeFit, ShapeFit]:
    """Run the second and the third stage.

    Args:
        base: Joints and priors on the working image; its body has free lengths.
        state: The best fit of the first stage.
        parameters: Which shape numbers are free.
        outlines: What of the working image the outline is compared with.
        bounds: Limits of the state; by default the body's.
        max_steps: Iterations of each stage.

    Returns:
        The fits after the second and after the third stage.
    """
    cost = ShapedCost(base=base, parameters=parameters, outlines=outlines)
    optimiser = TrustRegionNewton(max_steps=max_steps, tolerance=1e-2)
    n = len(state)
    y = torch.cat([state, state.new_zeros(len(parameters.names))])[None]
    volume = [name.endswith(CROSS_SECTIONS) for name in parameters.names]
    own = torch.tensor(volume, device=state.device).to(state)
    held = Bounds(*(torch.cat([state, own * bound]) for bound in parameters.bounds))
    flesh = optimiser.minimise(cost, y, held)
    pairs = zip(bounds or base.body.bounds, parameters.bounds, strict=True)
    whole = optimiser.minimise(cost, flesh.mean, Bounds(*(torch.cat(pair) for pair in pairs)))
    return tuple(  # type: ignore[return-value]
        ShapeFit(fit.mean[0, :n], fit.mean[0, n:], float(fit.cost[0])) for fit in (flesh, whole)
    )
