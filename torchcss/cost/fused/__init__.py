"""Compiled kernels of the default terms: the fused engine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal

import torch

if TYPE_CHECKING:
    from torchcss.cost.total import Engine


def engine_for(
    name: Literal["fused", "eager"],
    device: torch.device | str,
    dtype: Literal["float32", "float64"] = "float64",
    threads: int = 1,
) -> Engine | None:
    """What evaluates costs on a device; None: the terms as they are written.

    Args:
        name: Which engine is wanted; the fused one works on a CPU where numba is installed.
        device: Where the states lie.
        dtype: Precision of the kernels.
        threads: Among how many threads the kernels share out the states.
    """
    if name == "eager" or torch.device(device).type != "cpu":
        return None
    # Importing the kernels takes a third of a second.
    from torchcss.cost.fused.engine import fused_engine

    return fused_engine(dtype, threads)


@contextmanager
def threads_for(engine: Engine | None) -> Iterator[None]:
    """Leave torch a single thread of the calling one's, where kernels evaluate the cost.

    What torch then does beside them is small: threads cost more than they gain, and with another
    number of them sums round otherwise.

    Args:
        engine: What evaluates the cost; None: torch keeps the threads that it has.
    """
    before = torch.get_num_threads()
    if engine is None or before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
