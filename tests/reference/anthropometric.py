"""Twin of the anthropometric prior: the covariance written out, and a library's Gaussian."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcss.body.catalog import LENGTHS
from torchcss.body.model import BodyModel


def negative_log_density(
    body: BodyModel, x: Tensor, stature: float, individual: dict[str, float], scale: float
) -> Tensor:
    """`-log N(lengths; standard, Sigma)` of one state, less its least value."""
    names = [name for name in LENGTHS if f"{name}_length" in body.state_names]
    if not names:
        return 0 * x.sum()
    size = len(names)
    lengths, mean = [], torch.zeros(size, dtype=x.dtype)
    covariance = torch.zeros(size, size, dtype=x.dtype)
    for i, a in enumerate(names):
        lengths.append(body.lengths[a] + x[body.state_names.index(f"{a}_length")])
        mean[i] = scale * LENGTHS[a]
        for j, b in enumerate(names):
            covariance[i, j] = stature**2 * scale**2 * LENGTHS[a] * LENGTHS[b]
            if i == j:
                covariance[i, j] += (individual[a] * scale * LENGTHS[a]) ** 2
    normal = torch.distributions.MultivariateNormal(mean, covariance)
    return normal.log_prob(mean) - normal.log_prob(torch.stack(lengths))
