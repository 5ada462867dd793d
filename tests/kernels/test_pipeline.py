"""Where compiled kernels are kept, and what spoils them."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchcss.kernels import compiler

pytestmark = pytest.mark.skipif(not compiler.COMPILED, reason="numba is not installed")

ENTRY = """
from torchcss.kernels.compiler import entry
from {numbers} import FACTOR
from {helpers} import twice

@entry
def scale(numbers, result):
    for i in range(len(numbers)):
        result[i] = FACTOR * twice(numbers[i])
"""
HELPERS = """
from torchcss.kernels.compiler import inlined

@inlined
def twice(x):
    return 2.0 * x
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache folder of a test."""
    monkeypatch.setenv("TORCHCSS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path / "cache" / "torchcss" / "kernels"


Make = Callable[..., Callable[..., Any]]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """Makes the entry anew from modules on disk, as another process would."""

    def made(factor: str = "3.0", helpers: str = HELPERS) -> Callable[..., Any]:
        names = {"numbers": "made_numbers", "helpers": "made_helpers"}
        texts = {
            "made_numbers": f"FACTOR = {factor}\n",
            "made_helpers": helpers,
            "made_entry": ENTRY.format(**names),
        }
        for name, text in texts.items():
            path = tmp_path / f"{name}.py"
            path.write_text(text)
            spec = importlib.util.spec_from_file_location(name, path)
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            monkeypatch.setitem(sys.modules, name, module)
            # Not from the byte code beside, which goes by the second.
            exec(compile(text, path, "exec"), vars(module))
        return sys.modules["made_entry"].scale

    return made


def compiles(scale: Callable[..., Any], capsys: pytest.CaptureFixture[str], to: float) -> bool:
    """Whether an entry had to be compiled; it multiplies."""
    from torchcss.kernels.pipeline import _Cache

    _Cache._said = False
    result = np.zeros(3)
    scale(np.arange(3.0), result)
    assert result.tolist() == [0.0, to, 2 * to]
    told = capsys.readouterr().err
    assert told in ("", "torchcss: compiling for this processor, once (about a minute)\n")
    return bool(told)


def test_another_process_finds_them(make: Make, capsys: Any, folder: Path) -> None:
    assert compiles(make(), capsys, 6.0)
    assert not compiles(make(), capsys, 6.0)
    (kept,) = folder.iterdir()
    assert kept.name.startswith("made_entry.scale-")


def test_each_version_of_the_source_has_its_own(make: Make, capsys: Any, folder: Path) -> None:
    other = HELPERS.replace("2.0", "4.0")
    for _ in range(2):
        found = [
            compiles(make(), capsys, 6.0),
            compiles(make("5.0"), capsys, 10.0),
            compiles(make("3.0", other), capsys, 12.0),
        ]
    assert not any(found)
    assert len(list(folder.iterdir())) == 3


@pytest.mark.parametrize("damage", ["empty", "cut", "zeros", "one bit"])
def test_what_is_damaged_is_made_anew(damage: str, make: Make, capsys: Any, folder: Path) -> None:
    assert compiles(make(), capsys, 6.0)
    (kept,) = folder.iterdir()
    data = kept.read_bytes()
    flipped = data[:-99] + bytes([data[-99] ^ 1]) + data[-98:]
    spoilt = {"empty": b"", "cut": data[:1000], "zeros": bytes(len(data)), "one bit": flipped}
    kept.write_bytes(spoilt[damage])
    assert compiles(make(), capsys, 6.0)
    assert not compiles(make(), capsys, 6.0)


def test_a_temporary_folder_stands_in(
    make: Make, capsys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHCSS_CACHE", "/dev/null/cache")
    assert compiles(make(), capsys, 6.0)
    assert not compiles(make(), capsys, 6.0)
    own = tmp_path / (f"torchcss-{os.getuid()}" if sys.platform != "win32" else "torchcss")
    assert list((own / "kernels").iterdir())


def test_a_user_without_a_home(make: Make, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", nowhere)
    assert compiles(make(), capsys, 6.0)
    assert not compiles(make(), capsys, 6.0)


def test_nowhere_to_write(make: Make, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCHCSS_CACHE", "/dev/null/cache")
    monkeypatch.setattr(tempfile, "tempdir", "/dev/null")
    assert compiles(make(), capsys, 6.0)
    assert compiles(make(), capsys, 6.0)


def test_a_full_disk(
    make: Make, capsys: Any, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, data: bytes) -> int:
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    assert compiles(make(), capsys, 6.0)
    assert not list(folder.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="its temporary folder is the user's own")
def test_a_temporary_folder_of_another_user_is_left_alone(
    make: Make, capsys: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHCSS_CACHE", "/dev/null/cache")
    uid = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: uid)
    trap = tmp_path / f"torchcss-{uid}"
    trap.mkdir()
    for _ in range(2):
        assert compiles(make(), capsys, 6.0)
    assert not list(trap.iterdir())


def test_processes_that_start_at_once(make: Make, tmp_path: Path, folder: Path) -> None:
    make()
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "import numpy as np\n"
        "from made_entry import scale\n"
        "for kind in (np.float32, np.float64)[:: 1 - 2 * int(sys.argv[1])]:\n"
        "    result = np.zeros(3, kind)\n"
        "    scale(np.arange(3, dtype=kind), result)\n"
        "    print(result.tolist())\n"
    )
    command = [sys.executable, "-c", code]
    start = [
        subprocess.Popen([*command, str(number)], stdout=subprocess.PIPE, text=True)
        for number in (0, 1)
    ]
    assert [one.communicate()[0] for one in start] == ["[0.0, 6.0, 12.0]\n" * 2] * 2
    assert len(list(folder.iterdir())) == 2


SMALL = """
import torch
from torchcss.body.load import load_body
body = load_body("arm8")
print(body.pose(body.rest).joints.sum().item())
"""


def small(**variables: str) -> subprocess.CompletedProcess[str]:
    """A process of its own that poses an arm."""
    path = os.pathsep.join([variables.pop("path", ""), str(Path(__file__).parents[2])])
    environment = {**os.environ, "PYTHONPATH": path.strip(os.pathsep), **variables}
    run = [sys.executable, "-c", SMALL]
    return subprocess.run(run, env=environment, capture_output=True, text=True, check=False)


def test_without_compiling_kernels_are_plain_python(folder: Path) -> None:
    done = small(NUMBA_DISABLE_JIT="1")
    assert done.returncode == 0, done.stderr
    assert not folder.exists()


def test_a_numba_that_cannot_be_imported_is_told(tmp_path: Path) -> None:
    (tmp_path / "numba").mkdir()
    text = "raise ImportError('Numba needs NumPy 2.0 or less')\n"
    (tmp_path / "numba" / "__init__.py").write_text(text)
    done = small(path=str(tmp_path))
    assert "ConfigurationError: numba is installed but cannot be imported" in done.stderr
    assert "Numba needs NumPy 2.0 or less" in done.stderr
