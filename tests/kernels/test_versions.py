"""A kernel's version for types of arguments does what the kernel does."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from torchcss.kernels import compiler
from torchcss.kernels.checked import run
from torchcss.kernels.versions import version_of

pytestmark = pytest.mark.skipif(not compiler.COMPILED, reason="numba is not installed")


class Line(NamedTuple):
    """A record as kernels have them."""

    slope: Any
    offset: Any


@compiler.entry
def follow(x: Any, line: Line, y: Any) -> None:
    """y = slope x + offset, item by item."""
    for i in range(len(x)):
        y[i] += line.slope[0] * x[i] + line.offset


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHCSS_CACHE", str(tmp_path))


def arguments(size: int, real: Any = np.float64) -> tuple[Any, ...]:
    """What `follow` is called with."""
    x = np.arange(size, dtype=real)
    return x, Line(np.full(1, 2.0, real), real(0.5)), np.zeros_like(x)


@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_it_does_what_the_kernel_does(real: Any) -> None:
    ours, theirs = arguments(4, real), arguments(4, real)
    version_of(follow, *ours)(*ours)
    run(follow, *theirs)
    assert np.array_equal(ours[2], theirs[2])
    assert ours[2].dtype == real


def test_types_have_one_version_whatever_the_sizes() -> None:
    version = version_of(follow, *arguments(4))
    assert version_of(follow, *arguments(9)) is version
    assert version_of(follow, *arguments(4, np.float32)) is not version
    nothing = arguments(0)
    version(*nothing)
    x, line, y = arguments(8)
    version(x[2:5], line, y[2:5])
    assert y.tolist() == [0, 0, 4.5, 6.5, 8.5, 0, 0, 0]
    x.setflags(write=False)
    assert version_of(follow, x, line, y) is not version


def test_plain_python_where_nothing_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiler, "COMPILED", False)
    monkeypatch.setattr(compiler, "CHECKED", True)
    x, line, y = arguments(3)
    version_of(follow.py_func, x, line, y)(x, line, y)  # type: ignore[attr-defined]
    assert y.tolist() == [0.5, 2.5, 4.5]
    with pytest.raises(IndexError, match="index 2 of an axis of 2"):
        version_of(follow.py_func, x, line, y)(x, line, y[:2])  # type: ignore[attr-defined]
