"""Where the flow has carried the trunk: a prediction from the image instead of from the past.

A search looks about where a mode is expected, which is where it was, or where its own last motion
leads (`ConstantVelocity`). Who begins to turn is farther on by some degrees in every frame; the
flow on the shirt tells, but its term forgives what is off by pixels, and the arms that hang on the
trunk are off by tens. Here each mode's trunk, taken alone, is fitted to the flow at its nodes
before the search, from where its last motion leads:

    min_z  sum_j 1/2 rho(W_j |target_j - r_j(z)|^2)  +  1/2 sum_i ((z_i - z'_i) / (s d_i))^2

over the parameters z of root and spine, with the nodes j on the trunk, targets and weights of the
flow term (`torchcss.cost.flow`) but a wider rho, z' what the last motion expects and d the motion
expected in a frame. Limbs, neck and head come along as they hang: what is small is soon off its
nodes, and the wall beside it stands still. The papers' trackers follow the flow in the cost alone
(section 3.1.2 [IJRR]).

What to call: `carried`, once a frame, and `Displaced` for the tracker's dynamics.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.body.catalog import PROPORTIONS
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.cost.temporal import TemporalPrior
from torchcss.cost.total import TrackingCost
from torchcss.cost.view import View
from torchcss.inference.dynamics import Dynamics
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.types import Bounds, CostFunction, LocalModel

_SIGMA = 3.0
"""Scale of the flow's error, pixels: what the expected trunk is off by, not what the flow is."""

_SPREAD = 8.0
"""s: how many times the motion expected in a frame the flow may add to the last motion."""

_QUADRATIC = 1e6
"""Tails so high, nats, that the prior on the motion has none."""


@dataclass(frozen=True)
class Displaced:
    """Dynamics that have been told how far each mode moves, and spread as others do.

    Attributes:
        dynamics: The others.
        displacement: How far each mode moves.
    """

    dynamics: Dynamics
    displacement: Float[Tensor, "k n"]

    def predict(self, mixture: GaussianMixture, velocity: Float[Tensor, "k n"]) -> GaussianMixture:
        """Return the prior of the next frame.

        Args:
            mixture: Posterior of this frame.
            velocity: How far each mode moved since the last frame.
        """
        spread = self.dynamics.predict(mixture, velocity)
        return spread._replace(mean=mixture.mean + self.displacement)


def carried(
    cost: TrackingCost, before: Float[Tensor, "k n"], expected: Float[Tensor, "k n"]
) -> Float[Tensor, "k n"]:
    """Poses with the trunk where the flow has carried it.

    Args:
        cost: The frame's, with a flow target for the nodes of every mode.
        before: The modes of the frame before.
        expected: Where they are expected in this frame.

    Returns:
        The expected poses, the trunk moved; as they are without flow, without a motion that is
        expected (`FrameCosts`), and for bodies without root, trunk or flesh.
    """
    body, interior, term = cost.body, cost.interior, cost.choice.flow
    columns, parts = trunk_of(body)
    told = [view for view in cost.views if view.targets is not None]
    if interior is None or term is None or cost.deviation is None or not told or not len(columns):
        return expected
    nodes = parts[interior.node_part].to(before)

    def alone(view: View) -> View:
        targets = view.targets
        if targets is not None:
            targets = targets._replace(weight=targets.weight * nodes)
        return View(camera=view.camera, targets=targets)

    first, *others = (alone(view) for view in cost.views)
    choice = replace(
        cost.choice.without_images(),
        flow=replace(term, sigma=_SIGMA),
        flow_weight=term.nu * interior.num_nodes,
        temporal=TemporalPrior(nu=_QUADRATIC),
        temporal_mixture=None,
        stabiliser=None,
        anthropometric=None,
        interpenetration=None,
        weights={},
    )
    deviation = _SPREAD * cost.deviation
    start = before.index_copy(-1, columns, expected[:, columns])
    trunk = TrackingCost(
        body=body,
        camera=first.camera,
        choice=choice,
        interior=interior,
        targets=first.targets,
        others=tuple(others),
        parent=start,
        deviation=deviation,
    )
    found = TrustRegionNewton().minimise(
        _Restricted(trunk, columns, start),
        start[:, columns],
        Bounds(body.lower[columns].to(before), body.upper[columns].to(before)),
        scale=deviation[columns],
    )
    return expected.index_copy(-1, columns, found.mean)


def trunk_of(body: BodyModel) -> tuple[Int[Tensor, " m"], Bool[Tensor, " parts"]]:
    """What limbs of both sides hang on: the parameters that move these, and the parts between.

    Neither has entries for a body without root, or without sides.

    Args:
        body: The body.
    """
    sides = [
        torch.tensor([name.startswith(side) for name in body.part_names], device=body.tie.device)
        for side in ("l_", "r_")
    ]
    # Which parameter moves which part.
    moves = (body.tie != 0).mT.double() @ body.tree.ancestors[:, body.part_link].double() > 0
    # Lengths move parts as well, but not in time.
    angles = torch.tensor([name not in PROPORTIONS for name in body.state_names]).to(moves)
    both = (moves & sides[0]).any(-1) & (moves & sides[1]).any(-1)
    shared = both & angles & has_root(body)
    parts = ~moves[angles & ~shared].any(0) & shared.any()
    return torch.nonzero(shared)[:, 0], parts


@dataclass(frozen=True)
class _Restricted:
    """A cost of some parameters, the others held; each item has its own."""

    cost: CostFunction
    columns: Int[Tensor, " m"]
    held: Float[Tensor, "b n"]

    def take(self, items: Int[Tensor, " s"]) -> _Restricted:
        return replace(self, cost=self.cost.take(items), held=self.held[items])  # type: ignore[attr-defined]

    def value(self, x: Float[Tensor, "b m"]) -> Float[Tensor, " b"]:
        return self.cost.value(self._whole(x))

    def local_model(self, x: Float[Tensor, "b m"]) -> LocalModel:
        value, gradient, hessian = self.cost.local_model(self._whole(x))
        columns = self.columns
        return LocalModel(
            value, gradient[:, columns], hessian[:, columns[:, None], columns[None, :]]
        )

    def _whole(self, x: Tensor) -> Tensor:
        return self.held.index_copy(-1, self.columns, x)
