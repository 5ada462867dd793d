"""Counts, on a CPU, what would stop an accelerator: numbers that the host waits for.

A tensor of an accelerator whose value or size decides what Python does next (`.item()`, `if`,
`nonzero`, a mask as an index) is copied to the host, and the host waits until all that it had asked
for before is done. `Transfers` counts these calls by the line of the package that makes them, and
tensors that are made without saying on which device.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

import torchcss
from torchcss.cost import contour, visibility
from torchcss.kernels import compiler

_FACTORIES = {
    torch.arange, torch.as_tensor, torch.asarray, torch.empty, torch.eye, torch.from_numpy,
    torch.full, torch.linspace, torch.ones, torch.rand, torch.randint, torch.randn, torch.randperm,
    torch.tensor, torch.tril_indices, torch.triu_indices, torch.zeros,
}  # fmt: skip

_WAITS = {
    Tensor.__bool__, Tensor.__contains__, Tensor.__float__, Tensor.__index__, Tensor.__int__,
    Tensor.argwhere, Tensor.bincount, Tensor.cpu, Tensor.equal, Tensor.item, Tensor.masked_select,
    Tensor.nonzero, Tensor.numpy, Tensor.tolist, Tensor.unique, Tensor.unique_consecutive,
    torch.allclose, torch.argwhere, torch.bincount, torch.equal, torch.masked_select,
    torch.nonzero, torch.unique, torch.unique_consecutive,
}  # fmt: skip

_PACKAGE = Path(torchcss.__file__).parent


class Transfers(TorchFunctionMode):
    """Counts while it is entered.

    Attributes:
        waits: How often the host would have waited, by file and line of the package.
        homeless: How many tensors were made without a device, in the same way.
    """

    def __init__(self) -> None:
        super().__init__()
        self.waits: Counter[str] = Counter()
        self.homeless: Counter[str] = Counter()

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if func in _FACTORIES and kwargs.get("device") is None:
            self.homeless[_site()] += 1
        if func in _WAITS or _is_masked(func, args):
            self.waits[_site()] += 1
        return func(*args, **kwargs)


def _is_masked(func: Callable[..., Any], args: Any) -> bool:
    if func not in (Tensor.__getitem__, Tensor.__setitem__):
        return False
    index = args[1] if isinstance(args[1], tuple) else (args[1],)
    return any(isinstance(part, Tensor) and part.dtype == torch.bool for part in index)


def _site() -> str:
    """The line of the package that called, however far up."""
    frame = sys._getframe(2)
    while frame is not None:
        if module := _module(frame.f_code.co_filename):
            return f"{module}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"


@cache
def _module(filename: str) -> str:
    """A file of the package, as it is called there; empty if it is none."""
    path = Path(filename)
    return str(path.relative_to(_PACKAGE)) if path.is_relative_to(_PACKAGE) else ""


@contextmanager
def as_on_an_accelerator() -> Iterator[Transfers]:
    """Take the ways that tensors of an accelerator take, and count."""
    with pytest.MonkeyPatch.context() as patch, Transfers() as transfers:
        for name in ("AVAILABLE", "COMPILED"):  # kernels are for CPUs
            patch.setattr(compiler, name, False)
        for module in (visibility, contour):
            patch.setattr(module, "places", _places)
        yield transfers


def _places(mask: Tensor) -> Tensor:
    return mask.flatten().nonzero()[:, 0]
