"""How deep the parts of posed bodies are inside each other: what is measured of collisions."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchcss.body.model import BodyModel
from torchcss.cost.interpenetration import InterpenetrationPairs

_STATES_AT_ONCE = 64


class Penetration(NamedTuple):
    """The deepest collision of every posed body.

    Attributes:
        depth: Distance of the deepest node of a part to the surface of the part that it is in,
            metres; 0 where nothing collides.
        parts: These two parts, by index; -1 where nothing collides.
    """

    depth: Float[Tensor, " n"]
    parts: Int[Tensor, "n 2"]


class PenetrationDepth(nn.Module):
    """Measures collisions between parts that are not neighbours (`BodyModel.neighbours`).

    Args:
        body: The body; its base may move afterwards, its shape may not.
    """

    surface: Tensor

    def __init__(self, body: BodyModel) -> None:
        super().__init__()
        self.pairs = InterpenetrationPairs(body, rings=8, meridians=12)
        points = body.mesh(48, 64).points.flatten(1, 2)
        self.register_buffer("surface", points, persistent=False)

    def forward(self, body: BodyModel, states: Float[Tensor, "n m"]) -> Penetration:
        """Measure.

        Args:
            body: The body.
            states: Some states.
        """
        found = [self._measured(body, some) for some in states.split(_STATES_AT_ONCE)]
        return Penetration(*map(torch.cat, zip(*found, strict=True)))

    def _measured(self, body: BodyModel, states: Tensor) -> Penetration:
        pairs = self.pairs
        near = pairs.near(body, body.pose(states), 1.0)
        square, _, _ = pairs.radial_square(near)
        near, _ = near.select(square < 1)
        pair, item = near.pair[near.owner], near.item[near.owner]
        depth = torch.zeros_like(near.points[:, 0])
        for part in pairs.second[pair].unique().tolist():
            own = pairs.second[pair] == part
            depth[own] = torch.cdist(near.points[own], self.surface[part]).amin(-1)
        deepest = depth.new_zeros(len(states)).scatter_reduce(0, item, depth, "amax")
        parts = item.new_full((len(states), 2), -1)
        last = depth == deepest[item]
        parts[item[last]] = torch.stack([pairs.first[pair], pairs.second[pair]], -1)[last]
        return Penetration(deepest, parts)
