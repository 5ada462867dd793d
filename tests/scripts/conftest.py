"""The script that a test file is about, as a module: `test_x.py` gets `scripts/x.py`."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


def load_script(name: str) -> ModuleType:
    """A script as a module of its own, which no other test has changed."""
    specification = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module
    specification.loader.exec_module(module)
    return module


@pytest.fixture
def script(request: pytest.FixtureRequest) -> Iterator[ModuleType]:
    """The script that the test file is named after."""
    name = request.path.stem.removeprefix("test_")
    before = sys.modules.get(name)
    yield load_script(name)
    if before is not None:
        sys.modules[name] = before
    else:
        sys.modules.pop(name, None)
