"""The version of a kernel for the types of its arguments, looked up once instead of in each call.

numba looks it up whenever a kernel is called, by the types of all arguments down to each array: 19
µs for the 150 arrays of a view, beside 80 for what the view says of one state. The plain twin is
`torchcss.kernels.checked.run`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from torchcss.kernels import compiler
from torchcss.kernels.checked import run

_KNOWN: dict[tuple[Any, bytes], Callable[..., None]] = {}


def version_of(kernel: Any, *arguments: Any) -> Callable[..., None]:
    """A kernel for arguments of the types of these: arrays, numbers, and tuples of them.

    Nobody looks at the types again. Whoever calls it passes arrays of the same types, dimensions
    and order in memory, as writable as these: with others it reads nonsense.
    """
    if not compiler.COMPILED:
        return partial(run, kernel)
    from numba import _dispatcher  # compiled: only where it is used

    key = kernel, _dispatcher.compute_fingerprint(arguments)
    if key not in _KNOWN:
        _KNOWN[key] = kernel.compile(tuple(map(kernel.typeof_pyval, arguments)))
    return _KNOWN[key]
