"""What is done to kernels on their way through numba, and where compiled ones are kept.

They are kept in the user's cache folder, or else in a temporary folder of the user's own; the
package's own folder may be read-only. `TORCHCSS_CACHE` names another place. Each compiled entry is
a file by itself, whose name is a digest of what it is made from, for which arguments and which
processor: a change of any of them compiles it anew, and another process finds it. Files appear at
once and whole, so that processes that start together do not disturb each other; a damaged one is
made anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import sys
import tempfile
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite import binding as llvm
from numba.core import compiler, ir, serialize, types
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.dispatcher import Dispatcher
from numba.core.untyped_passes import IRProcessing

from torchcss.files import replace_file

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
    if role == "entry" and Path(function.__code__.co_filename).is_file():  # not typed in
        made._cache = _Cache(function)
    return made


def cache_folders() -> Iterator[Path]:
    """Where compiled kernels may be kept, the best place first."""
    root = os.environ.get("TORCHCSS_CACHE") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    with contextlib.suppress(RuntimeError):  # a user without a home
        yield Path(root).expanduser() / "torchcss" / "kernels"
    with contextlib.suppress(OSError):
        own = Path(tempfile.gettempdir()) / "torchcss"
        if sys.platform != "win32":
            # Anybody may write there, and what is kept is run: it has to be the user's own.
            own = own.with_name(f"torchcss-{os.getuid()}")
            own.mkdir(mode=0o700, exist_ok=True)
            if own.lstat().st_uid != os.getuid():
                return
        yield own / "kernels"


def source_digest(entry: Any) -> bytes:
    """Digest of all that an entry is made from.

    These are the modules of the kernels and records that it can reach, the numbers that those
    import, the modules here, and the versions that compile them.
    """
    todo, reached = [entry.__module__], set()
    while todo:
        name = todo.pop()
        if name not in reached and name in sys.modules:
            reached.add(name)
            for value in vars(sys.modules[name]).values():
                if isinstance(value, Dispatcher):
                    todo.append(value.py_func.__module__)
                elif isinstance(value, type) and issubclass(value, tuple):
                    todo.append(value.__module__)
    made_by = (numba.__version__, llvmlite.__version__, np.__version__, *sys.version_info[:2])
    digest = hashlib.sha256(repr(made_by).encode())
    paths = sorted(Path(__file__).parent.glob("*.py"))
    for module in (sys.modules[name] for name in sorted(reached)):
        if file := vars(module).get("__file__"):
            paths.append(Path(file))
        numbers = {
            name: value
            for name, value in vars(module).items()
            if isinstance(value, int | float | str | tuple) and not name.startswith("__")
        }
        digest.update(repr(sorted(numbers.items())).encode())
    for path in paths:
        digest.update(path.read_bytes())
    return digest.digest()


class _Cache:
    """Compiled versions of an entry on disk, as numba asks for them."""

    _said = False

    def __init__(self, entry: Any) -> None:
        self._entry = entry

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """The version for some types of arguments; None, and a line that says so: there is none."""
        target_context.refresh()
        name = self._file(signature, target_context.codegen())
        for folder in cache_folders():
            with contextlib.suppress(OSError, ValueError):
                data = _checked((folder / name).read_bytes())
                return compiler.CompileResult._rebuild(target_context, *pickle.loads(data))
        if not _Cache._said:
            _Cache._said = True
            print("torchcss: compiling for this processor, once (about a minute)", file=sys.stderr)
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep a version; where nothing can be written it is compiled in every process."""
        data = serialize.dumps(result._reduce())
        name = self._file(signature, result.codegen)
        for folder in cache_folders():
            with contextlib.suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                with replace_file(folder / name) as partial:
                    partial.write_bytes(hashlib.sha256(data).digest() + data)
                return

    @cached_property
    def _source(self) -> bytes:
        return source_digest(self._entry)

    def _file(self, signature: Any, codegen: Any) -> str:
        """Name of the file of a version, for this processor."""
        made_for = repr((signature, codegen.magic_tuple())).encode()
        digest = hashlib.sha256(self._source + made_for).hexdigest()
        return f"{self._entry.__module__}.{self._entry.__name__}-{digest[:16]}"


def _checked(data: bytes) -> bytes:
    """What follows its own digest.

    Raises:
        ValueError: If it is not what was written.
    """
    digest, rest = data[:32], data[32:]
    if hashlib.sha256(rest).digest() != digest:
        raise ValueError("damaged")
    return rest


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
