"""How a kernel is compiled: `@kernel`, `@inlined`, `@entry`, and the functions of one number.

A kernel is a plain Python function under `@kernel`. It is compiled on its first call for the types
of its arguments, for the processor at hand (`torchcss.kernels.pipeline`):

- **Literals take the precision of the arguments.** If any argument is in single precision, then so
  are the floating-point literals and constants of the function; else a literal would turn all that
  it meets into double precision. Whole numbers that meet others have to be turned into them.
- **Arrays of one call are never the same memory**; loops over several then become vector code.
- **Kernels take no memory**: the caller passes what they need, and arrays are written by element.
- The lock of Python is released. Nothing is parallel, and sums run in the order of the code's
  making, whatever the pool: an item's result depends on that item alone.

With `TORCHCSS_CHECK_KERNELS=1` kernels are not compiled. They run as plain Python on arrays that
refuse any index out of range (`torchcss.kernels.checked`): slow, for tests. With numba's own
`NUMBA_DISABLE_JIT=1` they are plain Python as well.

Where numba is not installed `AVAILABLE` is False, and nobody calls a kernel.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, TypeVar

import numpy as np

from torchcss.errors import ConfigurationError

AVAILABLE = find_spec("numba") is not None  # a plain install has it; some platforms do not
"""Whether kernels can be compiled."""

CHECKED = os.environ.get("TORCHCSS_CHECK_KERNELS", "") == "1"
"""Whether kernels run as plain Python with every index checked."""

COMPILED = AVAILABLE and not CHECKED and os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0")
"""Whether kernels are compiled: where they are not, they are of use for tests alone."""

_Function = TypeVar("_Function", bound=Callable[..., Any])


def kernel(function: _Function) -> _Function:
    """Compile a function where it is called; see the module."""
    return _compiled(function, "kernel")


def inlined(function: _Function) -> _Function:
    """The same for a function that belongs into the loops that call it."""
    return _compiled(function, "inlined")


def entry(function: _Function) -> _Function:
    """The same for a function that Python calls, kept in the cache on disk."""
    return _compiled(function, "entry")


def _compiled(function: _Function, role: str) -> _Function:
    if not COMPILED:
        return function
    try:
        from torchcss.kernels import pipeline
    except ImportError as error:  # most often a numpy that this numba does not know
        raise ConfigurationError(
            f"numba is installed but cannot be imported ({error}); update it, or uninstall it and "
            "costs are evaluated more slowly"
        ) from error
    return pipeline.compiled(function, role)


# Functions of one number. In kernels they are instructions, see `torchcss.kernels.instructions`:
# numba's own are calls, which keep a loop from becoming vector code.


def sqrt(x: float) -> float:
    """Square root."""
    return x**0.5


def floor(x: float) -> float:
    """The next whole number below, in the type of the number."""
    return x - x % 1


def log(x: float) -> float:
    """Logarithm of a positive number."""
    return 0 * x + math.log(x)


def exp(x: float) -> float:
    """Exponential; its argument is limited to what the type of the number holds."""
    most = by_precision(x, 87.0, 700.0)
    return 0 * x + math.exp(min(max(x, -most), most))


def by_precision(x: float, single: float, double: float) -> float:
    """One of two constants, by the precision of a number."""
    return single if isinstance(x, np.floating) and x.itemsize == 4 else double
