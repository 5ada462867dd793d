"""Derivatives of a cost point by point, by double backward."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcss.types import PointCost


def differentiated(value: Tensor, leaf: Tensor) -> PointCost:
    """Independent values with their derivatives in the points that they were made of."""
    (gradient,) = torch.autograd.grad(value.sum(), leaf, create_graph=True)
    rows = [
        torch.autograd.grad(column.sum(), leaf, retain_graph=True)[0]
        for column in gradient.unbind(-1)
    ]
    return PointCost(value.detach(), gradient.detach(), torch.stack(rows, dim=-2))
