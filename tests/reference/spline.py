"""Twin of the edge-energy field: a cubic B-spline, summed over every pixel of the image."""

from __future__ import annotations

import torch
from torch import Tensor


def bump(x: Tensor) -> Tensor:
    """The cubic B-spline about zero."""
    # Squares, not powers of |x|: autograd takes the kink of |x| at zero for flat.
    near = 2 / 3 - x * x + x * x * x.abs() / 2
    far = (2 - x.abs()).clamp(min=0) ** 3 / 6
    return torch.where(x.abs() < 1, near, far)


def spline(coefficients: Tensor, uv: Tensor) -> Tensor:
    """Values at points `[..., 2]` of the spline with the coefficients `[h, w]`, zero outside."""
    height, width = coefficients.shape
    columns = torch.arange(width, dtype=uv.dtype)
    rows = torch.arange(height, dtype=uv.dtype)
    along_u = bump(uv[..., 0, None] - columns)
    along_v = bump(uv[..., 1, None] - rows)
    return ((along_v @ coefficients) * along_u).sum(-1)
