"""Stages two and three of initialisation: the parts' shape, then everything (section 5 [IJRR]).

The second stage fits cross-sections and tapers of all parts, left and right tied, to joints and
outlines in the image while pose and lengths are held; the third fits all parameters to the same.
Each is the bound-constrained robust optimisation of section 4.1 on `ShapedCost`.

One camera leaves several poses open that cost the joints the same. A shape fitted to one of them
speaks for it: an arm believed to be too close to the camera is made thin, and whatever is compared
with the image afterwards then prefers it there. So every pose gets a shape of its own first, and
that of the cheapest is what the third stage goes on with.
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
from torchcss.types import Bounds, Vector, Vectors


class ShapeFit(NamedTuple):
    """Pose, lengths and shape after a stage.

    Attributes:
        state: State of the body with free lengths.
        start: Which of the poses the shape was fitted to.
        shape: Offsets of the shape parameters.
        cost: Nats.
    """

    state: Vector
    start: int
    shape: Float[Tensor, " z"]
    cost: float


def fit_shape(
    base: TrackingCost,
    states: Vectors,
    parameters: ShapeParameters,
    outlines: tuple[Outline, ...],
    *,
    bounds: Bounds | None = None,
) -> tuple[ShapeFit, ShapeFit]:
    """Run the second stage from all poses, and the third from the cheapest.

    Args:
        base: Joints and priors on the working image; its body has free lengths.
        states: Fits of the first stage that the joints do not tell apart.
        parameters: Which shape numbers are free.
        outlines: What of the working image the outline is compared with.
        bounds: Limits of the state; by default the body's.

    Returns:
        The fits after the second and after the third stage.
    """
    cost = ShapedCost(base=base, parameters=parameters, outlines=outlines)
    optimiser = TrustRegionNewton(max_steps=25, tolerance=1e-2)
    n = states.shape[-1]
    y = torch.cat([states, states.new_zeros(len(states), len(parameters.names))], dim=-1)
    volume = [name.endswith(CROSS_SECTIONS) for name in parameters.names]
    own = torch.tensor(volume, device=states.device).to(states)
    sections = [
        optimiser.minimise(
            cost,
            start[None],
            Bounds(*(torch.cat([start[:n], own * bound]) for bound in parameters.bounds)),
        )
        for start in y
    ]
    best = min(range(len(sections)), key=lambda k: float(sections[k].cost[0]))
    second = sections[best]
    pairs = zip(bounds or base.body.bounds, parameters.bounds, strict=True)
    whole = optimiser.minimise(cost, second.mean, Bounds(*(torch.cat(pair) for pair in pairs)))
    return tuple(  # type: ignore[return-value]
        ShapeFit(fit.mean[0, :n], best, fit.mean[0, n:], float(fit.cost[0]))
        for fit in (second, whole)
    )
