"""Compiled kernels of the default terms: the fused engine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch

if TYPE_CHECKING:
    from torchcss.cost.total import Engine


def engine_for(
    name: Literal["fused", "eager"],
    device: torch.device | str,
    dtype: Literal["float32", "float64"] = "float64",
) -> Engine | None:
    """What evaluates costs on a device; None: the terms as they are written.

    Args:
        name: Which engine is wanted; the fused one works on a CPU where numba is installed.
        device: Where the states lie.
        dtype: Precision of the kernels.
    """
    if name == "eager" or torch.device(device).type != "cpu":
        return None
    # Importing the kernels takes a third of a second.
    from torchcss.cost.fused.engine import fused_engine

    return fused_engine(dtype)
