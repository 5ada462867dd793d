"""Functions of one number as instructions, so that loops with them become vector code.

In single precision logarithm and exponential are S. Moshier's polynomials (Cephes), with an error
of about one in the last place.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload

from torchcss.kernels import compiler
from torchcss.kernels.compiler import inlined


def _unary(name: str) -> Any:
    """An instruction of the processor, by the name that LLVM gives it."""

    def instruction(typing: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            function = builder.module.declare_intrinsic(name, [arguments[0].type])
            return builder.call(function, arguments)

        return x(x), generate

    return intrinsic(instruction)


def _cast(to: Any, bits: Any) -> Any:
    """The bits of a number in single precision as those of another type."""

    def instruction(typing: Any, x: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.bitcast(arguments[0], bits)

        return to(x), generate

    return intrinsic(instruction)


_sqrt, _floor = _unary("llvm.sqrt"), _unary("llvm.floor")
_bits_of = _cast(types.int32, ir.IntType(32))
_number_of = _cast(types.float32, ir.FloatType())


@inlined
def _log_single(x: Any) -> Any:
    bits = _bits_of(x)
    whole = np.int32((bits - np.int32(0x3F3504F3)) >> np.int32(23))
    f = _number_of(np.int32(bits - (whole << np.int32(23)))) - 1.0
    e, z = np.float32(whole), f * f
    # By pairs of terms (Estrin): a shorter chain of sums that wait for each other.
    a, b = 3.3333331174e-1 - 2.4999993993e-1 * f, 2.0000714765e-1 - 1.6668057665e-1 * f
    c, d = 1.4249322787e-1 - 1.2420140846e-1 * f, 1.1676998740e-1 - 1.1514610310e-1 * f
    y = ((d + 7.0376836292e-2 * z) * z + c) * (z * z) + (b * z + a)
    y = y * f * z
    return 0.693359375 * e + (f + (y - 2.12194440e-4 * e - 0.5 * z))


@inlined
def _exp_single(x: Any) -> Any:
    x = min(max(x, -87.0), 88.0)
    n = _floor(1.44269504088896341 * x + 0.5)
    f = x - n * 0.693359375 + n * 2.12194440e-4
    z = f * f
    a, b = 1.6666665459e-1 * f + 5.0000001201e-1, 8.3334519073e-3 * f + 4.1665795894e-2
    y = (1.9875691500e-4 * f + 1.3981999507e-3) * (z * z) + (b * z + a)
    scale = _number_of(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))
    return (y * z + (f + 1.0)) * scale


def _sqrt_of(x: Any) -> Any:
    return lambda x: _sqrt(x)


def _floor_of(x: Any) -> Any:
    return lambda x: _floor(x)


def _log_of(x: Any) -> Any:
    if x == types.float32:
        return lambda x: _log_single(x)
    return lambda x: math.log(x)


def _exp_of(x: Any) -> Any:
    if x == types.float32:
        return lambda x: _exp_single(x)
    return lambda x: math.exp(min(max(x, -700.0), 700.0))


def _one_of(x: Any, single: Any, double: Any) -> Any:
    if x == types.float32:
        return lambda x, single, double: single
    return lambda x, single, double: double


for _name, _implementation in (
    ("sqrt", _sqrt_of),
    ("floor", _floor_of),
    ("log", _log_of),
    ("exp", _exp_of),
    ("by_precision", _one_of),
):
    _register: Any = overload
    _register(vars(compiler)[_name], inline="always", strict=False)(_implementation)
