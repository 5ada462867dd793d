"""What is done to kernels on their way through numba, and where compiled ones are kept.

They are kept in the user's cache folder. A folder of the package has its own folder there, whose
name is a digest of its modules, of these here and of the versions that compile them: a change of
any of them compiles its kernels anew, another process finds them, and the package's own folder may
be read-only. `TORCHCSS_CACHE` names another place.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite import binding as llvm
from numba.core import caching, compiler, ir, types
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.untyped_passes import IRProcessing

_FREEDOM = {"contract", "nsz", "arcp", "reassoc"}
"""What the compiler may do to sums and products; it depends on the code alone. Infinities and NaN
keep their meaning."""


def compiled(function: Any, role: str) -> Any:
    """A function, compiled where it is first called.

    Args:
        function: The function.
        role: "entry": Python calls it, and it is kept on disk; "kernel": other kernels call it;
            "inlined": it becomes a part of these.
    """
    # Registers how numba makes the functions of `compiler`; it needs `compiled` itself.
    from torchcss.kernels import instructions as _  # noqa: F401

    _ROLES[function] = role
    njit: Any = numba.njit  # its stubs lack some options
    made = njit(
        nogil=True,
        _nrt=False,  # no kernel takes memory, so that no references are counted
        fastmath=_FREEDOM,
        error_model="numpy",
        forceinline=role == "inlined",
        # What kernels alone call needs no way in from Python.
        no_cpython_wrapper=role != "entry",
        no_cfunc_wrapper=True,
        pipeline_class=_Pipeline,
    )(function)
    template = made.get_call_template
    # One version for all numbers that a caller may write down.
    made.get_call_template = lambda args, kws: template(map(types.unliteral, args), kws)
    if role == "entry":
        with contextlib.suppress(OSError):  # nowhere to write: it is compiled in every process
            made._cache = _Cache(function)
    return made


@cache
def cache_folder(kernels: Path) -> Path:
    """Where the compiled kernels of a folder of the package are kept.

    In the user's cache, or else in a temporary folder. Kernels call those of their own folder only.
    """
    own = sorted({*kernels.glob("*.py"), *Path(__file__).parent.glob("*.py")})
    made_by = f"{numba.__version__} {llvmlite.__version__} {sys.version_info[:2]}"
    text = b"".join(path.read_bytes() for path in own) + made_by.encode()
    name = f"{kernels.name}-{hashlib.sha256(text).hexdigest()[:16]}"
    root = os.environ.get("TORCHCSS_CACHE") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    with contextlib.suppress(OSError, RuntimeError):
        folder = Path(root).expanduser() / "torchcss" / name
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
        return folder
    return Path(tempfile.gettempdir()) / f"torchcss-{Path.home().name}" / name


class _Locator(caching._CacheLocator):
    """Tells numba where the cache is, and that its name says what is in it."""

    def __init__(self, path: Path) -> None:
        self._name = self._py_file = path.stem
        self._kernels = path.parent

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _Locator:
        return cls(Path(py_file))

    def get_cache_path(self) -> Any:
        return str(cache_folder(self._kernels))

    def get_source_stamp(self) -> Any:
        return ""

    def get_disambiguator(self) -> Any:
        return self._name


class _CacheFiles(caching.CompileResultCacheImpl):
    _locator_classes = (_Locator,)


class _Cache(caching.FunctionCache):
    """Says so when kernels have to be compiled."""

    _impl_class = _CacheFiles
    _said = False

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is None and not _Cache._said:
            _Cache._said = True
            print("torchcss: compiling for this processor, once (about a minute)", file=sys.stderr)
        return found


@register_pass(mutates_CFG=False, analysis_only=False)
class _Precision(FunctionPass):
    """Gives literals the precision of the arguments, and says that arrays do not overlap."""

    _name = "torchcss_precision"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> Any:
        state.flags.noalias = True
        if not any(_is_single(argument) for argument in state.args):
            return False
        for block in state.func_ir.blocks.values():
            for assign in block.find_insts(ir.Assign):
                source = assign.value
                constant = isinstance(source, ir.Const | ir.Global)
                if constant and isinstance(source.value, float | tuple):
                    assign.value = ir.Const(_single(source.value), source.loc)
        return True


@register_pass(mutates_CFG=False, analysis_only=False)
class _Whole(FunctionPass):
    """Makes machine code of entries alone, and all that they call a part of them.

    A function that is compiled by itself, for its own sake, can be other instructions than the one
    within an entry, and has the same name. Which of them ran would depend on what the process has
    compiled before, and sums would round as that has it.
    """

    _name = "torchcss_whole"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> Any:
        role = _ROLES[state.func_id.func]
        codegen = state.targetctx.codegen()
        state.library = library = codegen.create_library(state.func_id.func_qualname)
        library.enable_object_caching()
        if role == "entry":
            optimize = library._optimize_final_module

            def optimize_as_one() -> None:
                for function in library._final_module.functions:
                    if function.linkage == llvm.Linkage.linkonce_odr:
                        function.linkage = "internal"
                optimize()

            library._optimize_final_module = optimize_as_one
            return False
        library._optimize_final_module = lambda: None  # entries do, with all that they call
        library._finalize_final_module = lambda: _add_environment(library)
        return False


def _add_environment(library: Any) -> None:
    """Finish the library of a function that is for others: of the process it needs one pointer."""
    library._finalized = True
    for variable in library._final_module.global_variables:
        if variable.name.startswith("_ZN08NumbaEnv"):
            module = llvm.parse_assembly(f'@"{variable.name}" = common global i8* null')
            library._codegen._add_module(module)


class _Pipeline(compiler.CompilerBase):
    def define_pipelines(self) -> list[Any]:
        passes = compiler.DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_Precision, IRProcessing)
        passes.add_pass_after(_Whole, _Precision)
        passes.finalize()
        return [passes]


_ROLES: dict[Any, str] = {}
"""What each compiled function is for; see `compiled`."""


def _single(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(_single(part) for part in value)
    return np.float32(value) if isinstance(value, float) else value


def _is_single(kind: Any) -> bool:
    if isinstance(kind, types.Array):
        return kind.dtype == types.float32
    if isinstance(kind, types.BaseTuple):
        parts: Any = kind
        return any(_is_single(part) for part in parts)
    return kind == types.float32
