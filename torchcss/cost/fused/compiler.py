"""How a kernel is compiled: precision of its literals, fast powers, the cache on disk.

A kernel is a plain Python function under `@kernel`. It is compiled on its first call for the types
of its arguments, for the processor at hand, and kept in the user's cache folder under a name that
holds the versions and a digest of all kernels: a change of any of them compiles all anew, a second
process finds them, and the package's own folder may be read-only.

- **Literals take the precision of the arguments.** If any argument is in single precision, then so
  are the floating-point literals and constants of the function; else a literal would turn all that
  it meets into double precision.
- **Arrays of one call are never the same memory**; loops over several then become vector code.
- The lock of Python is released. Nothing is parallel, and sums run in the order of the code's
  making, whatever the pool: an item's result depends on that item alone.
- With `TORCHCSS_CHECK_KERNELS=1` kernels are not compiled. They run as plain Python on arrays that
  refuse any index out of range (`torchcss.cost.fused.checked`): slow, for tests.

Where numba cannot be imported `AVAILABLE` is False, and nobody calls a kernel.
"""

from __future__ import annotations

import hashlib
import math
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

CHECKED = os.environ.get("TORCHCSS_CHECK_KERNELS", "") == "1"
"""Whether kernels run as plain Python with every index checked."""

try:
    import numba
    from llvmlite import ir as llvm
    from numba.core import caching, compiler, types
    from numba.core import ir as numba_ir
    from numba.core.compiler_machinery import FunctionPass, register_pass
    from numba.core.untyped_passes import IRProcessing
    from numba.extending import intrinsic, overload

    AVAILABLE = True
except ImportError:  # a plain install has it; some platforms do not
    AVAILABLE = False

_Function = TypeVar("_Function", bound=Callable[..., Any])

_FAST = {"contract", "nsz", "arcp", "reassoc"}
"""Freedom of the compiler that depends on the code alone. Infinities and NaN keep their meaning."""


def cache_folder() -> Path:
    """Where compiled kernels are kept: the user's cache, or a temporary folder."""
    root = os.environ.get("TORCHCSS_CACHE") or os.environ.get("XDG_CACHE_HOME")
    folder = Path(root) if root else Path.home() / ".cache"
    folder = folder / "torchcss" / f"kernels-{_digest()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):
        user = os.getuid() if sys.platform != "win32" else os.environ.get("USERNAME", "user")
        folder = Path(tempfile.gettempdir()) / f"torchcss-{user}" / folder.name
    return folder


def _digest() -> str:
    """What all kernels depend on."""
    own = sorted(Path(__file__).parent.glob("*.py"))
    text = b"".join(path.read_bytes() for path in own)
    versions = f"{numba.__version__} {sys.version_info[:2]}" if AVAILABLE else ""
    return hashlib.sha256(text + versions.encode()).hexdigest()[:16]


if AVAILABLE:

    class _Locator(caching._CacheLocator):
        """Tells numba where the cache is, and that its name says what is in it."""

        folder: Path | None = None

        def __init__(self, name: str, line: int) -> None:
            self._name, self._py_file = f"{name}-{line}", name
            type(self).folder = type(self).folder or cache_folder()

        @classmethod
        def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _Locator:
            return cls(Path(py_file).stem, py_func.__code__.co_firstlineno)

        def get_cache_path(self) -> str:
            return str(self.folder)

        def get_source_stamp(self) -> str:
            return "0"

        def get_disambiguator(self) -> str:
            return self._name

    class _CacheFiles(caching.CompileResultCacheImpl):
        _locator_classes = (_Locator,)

    class _Cache(caching.FunctionCache):
        _impl_class = _CacheFiles

    @register_pass(mutates_CFG=False, analysis_only=False)
    class _Precision(FunctionPass):
        """Gives literals the precision of the arguments, and says that arrays do not overlap."""

        _name = "torchcss_precision"

        def __init__(self) -> None:
            FunctionPass.__init__(self)

        def run_pass(self, state: Any) -> bool:
            state.flags.noalias = True
            if not any(_is_single(argument) for argument in state.args):
                return False
            for block in state.func_ir.blocks.values():
                for assign in block.find_insts(numba_ir.Assign):
                    source = assign.value
                    constant = isinstance(source, numba_ir.Const | numba_ir.Global)
                    if constant and isinstance(source.value, float | tuple):
                        assign.value = numba_ir.Const(_single(source.value), source.loc)
            return True

    @register_pass(mutates_CFG=False, analysis_only=False)
    class _Plainly(FunctionPass):
        """Leaves it to the entries to make machine code fast, once for all that they call."""

        _name = "torchcss_plainly"

        def __init__(self) -> None:
            FunctionPass.__init__(self)

        def run_pass(self, state: Any) -> bool:
            codegen = state.targetctx.codegen()
            state.library = codegen.create_library(state.func_id.func_qualname)
            state.library.enable_object_caching()
            state.library._optimize_final_module = lambda: None
            return False

    class _Entry(compiler.CompilerBase):
        def define_pipelines(self) -> list[Any]:
            passes = compiler.DefaultPassBuilder.define_nopython_pipeline(self.state)
            passes.add_pass_after(_Precision, IRProcessing)
            passes.finalize()
            return [passes]

    class _Pipeline(compiler.CompilerBase):
        def define_pipelines(self) -> list[Any]:
            passes = compiler.DefaultPassBuilder.define_nopython_pipeline(self.state)
            passes.add_pass_after(_Precision, IRProcessing)
            passes.add_pass_after(_Plainly, _Precision)
            passes.finalize()
            return [passes]

    def _single(value: Any) -> Any:
        if type(value) is tuple:
            return tuple(_single(part) for part in value)
        return np.float32(value) if type(value) is float else value

    def _is_single(kind: Any) -> bool:
        if isinstance(kind, types.Array):
            kind = kind.dtype
        if isinstance(kind, types.BaseTuple):
            return any(_is_single(part) for part in kind)
        return kind == types.float32


def kernel(function: _Function) -> _Function:
    """Compile a function where it is called; see the module."""
    return _compiled(function, entry=False)


def inlined(function: _Function) -> _Function:
    """The same for a function that belongs into the loops that call it."""
    return _compiled(function, entry=False, inline=True)


def entry(function: _Function) -> _Function:
    """The same for a function that Python calls, kept in the cache on disk."""
    compiled: Any = _compiled(function, entry=True)
    if AVAILABLE and not CHECKED:
        try:
            compiled._cache = _Cache(function)
        except OSError:  # nowhere to write
            pass
    return compiled


def _compiled(function: _Function, *, entry: bool, inline: bool = False) -> _Function:
    if not AVAILABLE or CHECKED:
        return function
    return numba.njit(
        nogil=True,
        fastmath=_FAST,
        error_model="numpy",
        forceinline=inline,
        # What is called by kernels alone needs no way in from Python, and is made fast with them.
        no_cpython_wrapper=not entry,
        no_cfunc_wrapper=True,
        pipeline_class=_Pipeline if inline else _Entry,
    )(function)


# Functions of one number. numba's own are calls, which keep a loop from becoming vector code.


def sqrt(x: float) -> float:
    """Square root."""
    return x**0.5


def floor(x: float) -> float:
    """The next whole number below."""
    return math.floor(x) * (x / x) if x else x


def log(x: float) -> float:
    """Logarithm of a positive number."""
    return math.log(x)


def exp(x: float) -> float:
    """Exponential; its argument is limited to what single precision holds."""
    return math.exp(min(max(x, -87.0), 88.0))


if AVAILABLE and not CHECKED:

    def _unary(name: str) -> Any:
        """An instruction of the processor, by the name that LLVM gives it."""

        @intrinsic
        def instruction(typing: Any, x: Any) -> Any:
            def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
                function = builder.module.declare_intrinsic(name, [arguments[0].type])
                return builder.call(function, arguments)

            return x(x), generate

        return instruction

    @intrinsic
    def _bits(typing: Any, x: Any) -> Any:
        """The bits of a number in single precision."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.bitcast(arguments[0], llvm.IntType(32))

        return types.int32(x), generate

    @intrinsic
    def _number(typing: Any, bits: Any) -> Any:
        """The number in single precision with these bits."""

        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return builder.bitcast(arguments[0], llvm.FloatType())

        return types.float32(bits), generate

    _sqrt, _floor = _unary("llvm.sqrt"), _unary("llvm.floor")

    @overload(sqrt, inline="always", strict=False)
    def _sqrt_of(x: Any) -> Any:
        return lambda x: _sqrt(x)

    @overload(floor, inline="always", strict=False)
    def _floor_of(x: Any) -> Any:
        return lambda x: _floor(x)

    @inlined
    def _log_single(x: Any) -> Any:
        # S. Moshier's polynomials (Cephes); an error of one in the last place.
        bits = _bits(x)
        whole = np.int32((bits - np.int32(0x3F3504F3)) >> np.int32(23))
        f = _number(np.int32(bits - (whole << np.int32(23)))) - 1.0
        e, z = np.float32(whole), f * f
        y = 7.0376836292e-2 * f - 1.1514610310e-1
        y = (y * f + 1.1676998740e-1) * f - 1.2420140846e-1
        y = (y * f + 1.4249322787e-1) * f - 1.6668057665e-1
        y = (y * f + 2.0000714765e-1) * f - 2.4999993993e-1
        y = (y * f + 3.3333331174e-1) * f * z
        return 0.693359375 * e + (f + (y - 2.12194440e-4 * e - 0.5 * z))

    @inlined
    def _exp_single(x: Any) -> Any:
        x = min(max(x, -87.0), 88.0)
        n = _floor(1.44269504088896341 * x + 0.5)
        f = x - n * 0.693359375 + n * 2.12194440e-4
        y = (1.9875691500e-4 * f + 1.3981999507e-3) * f + 8.3334519073e-3
        y = ((y * f + 4.1665795894e-2) * f + 1.6666665459e-1) * f + 5.0000001201e-1
        scale = _number(np.int32((np.int32(n) + np.int32(127)) << np.int32(23)))
        return (y * f * f + f + 1.0) * scale

    @overload(log, inline="always", strict=False)
    def _log_of(x: Any) -> Any:
        if x == types.float32:
            return lambda x: _log_single(x)
        return lambda x: math.log(x)

    @overload(exp, inline="always", strict=False)
    def _exp_of(x: Any) -> Any:
        if x == types.float32:
            return lambda x: _exp_single(x)
        return lambda x: math.exp(min(max(x, -87.0), 88.0))
