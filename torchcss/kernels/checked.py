"""Arrays that refuse any index out of range, also one that counts from the end.

With `TORCHCSS_CHECK_KERNELS=1` kernels run as plain Python on these; see `compiler`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from torch import Tensor

from torchcss.kernels import compiler

_Record = TypeVar("_Record")


class Checked(np.ndarray):
    """An array whose indices are checked."""

    def __getitem__(self, index: Any) -> Any:
        """What is there."""
        self._check(index)
        return super().__getitem__(index)

    def __setitem__(self, index: Any, value: Any) -> None:
        """Write there."""
        self._check(index)
        super().__setitem__(index, value)

    def _check(self, index: Any) -> None:
        for one, size in zip(
            index if isinstance(index, tuple) else (index,), self.shape, strict=False
        ):
            if isinstance(one, int | np.integer) and not 0 <= one < size:
                raise IndexError(f"index {one} of an axis of {size}")


def checked(record: _Record) -> _Record:
    """A record, or an array, with all its indices checked."""
    if isinstance(record, np.ndarray):
        return record.view(Checked)  # type: ignore[return-value]
    if isinstance(record, tuple):
        parts = [checked(part) for part in record]
        fields: Any = record
        return fields._make(parts)
    return record


def run(kernel: Callable[..., None], *arguments: Any) -> None:
    """Call a kernel, tensors as arrays, which check their indices in the checked mode."""
    arrays = [a.numpy() if isinstance(a, Tensor) else a for a in arguments]
    kernel(*map(checked, arrays) if compiler.CHECKED else arrays)
