"""The architecture: which folder may import which, as a matrix with nothing allowed by default.

Every module is parsed, not imported, so that imports inside functions count too.
"""

from __future__ import annotations

import ast
import importlib
import inspect
from pathlib import Path

import pytest
from typing_extensions import is_protocol

PACKAGE = Path(__file__).resolve().parents[1] / "torchcss"

GROUND = {"types", "errors", "joint_names", "linalg", "robust", "files", "stopwatch"}
"""Single modules at the top, which every folder may import."""

ALLOWED: dict[str, set[str]] = {
    "inference": set(),
    "body": set(),
    "vision": set(),
    "cost": {"inference", "body", "vision"},
    "initialise": {"inference", "body", "vision", "cost"},
    "io": {"inference", "body", "vision", "cost", "initialise"},
    "tracking": {"inference", "body", "vision", "cost", "initialise", "io"},
    "show": {"inference", "body", "vision", "cost", "initialise", "io", "tracking"},
    "solve": {"inference", "body", "vision", "cost", "initialise", "io", "tracking"},
    "app": {
        *("inference", "body", "vision", "cost", "initialise", "io", "tracking", "show", "solve"),
    },
    "studies": {
        *("inference", "body", "vision", "cost", "initialise", "io", "tracking", "show", "solve"),
        "app",
    },
    "cli": {
        *("inference", "body", "vision", "cost", "initialise", "io", "tracking", "show", "solve"),
        *("app", "studies"),
    },
}
"""Folder by folder, from the ground up: what it may import besides itself and the ground. A
subfolder counts with its parent."""

MOST_FOLDERS = 21
MOST_LEVELS = 10


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    """The folder that a file of the package counts with; '' for the ground."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


def imported(source: str, package: list[str]) -> set[str]:
    """Dotted names of all modules that a text imports, relative ones resolved from its package."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            # `from torchcss import x` may mean the module torchcss.x.
            found |= {
                f"{base}.{alias.name}" if base == "torchcss" else base for alias in node.names
            }
    return found


def imports_of(path: Path) -> set[str]:
    package = ["torchcss", *path.relative_to(PACKAGE).parts[:-1]]
    return imported(path.read_text(encoding="utf-8"), package)


def arrows() -> dict[tuple[str, str], set[str]]:
    """Which folder imports which, and the files in which it does; the ground is '' ."""
    found: dict[tuple[str, str], set[str]] = {}
    for path in modules():
        own = room_of(path)
        if path == PACKAGE / "__init__.py":
            continue
        for name in imports_of(path):
            parts = name.split(".")
            if parts[0] != "torchcss":
                continue
            other = parts[1] if len(parts) > 1 else "__init__"
            if not ((PACKAGE / other).is_dir() or other in GROUND):
                other = "__init__"  # a name of the package's own page
            other = "" if other in GROUND else other
            if other != own:
                found.setdefault((own, other), set()).add(str(path.relative_to(PACKAGE)))
    return found


def test_every_module_is_in_a_folder_but_the_ground() -> None:
    loose = {path.stem for path in PACKAGE.glob("*.py")}
    assert loose == {*GROUND, "__init__"}
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and list(path.glob("*.py"))}
    assert folders == set(ALLOWED)


def test_a_folder_imports_what_the_matrix_allows() -> None:
    allowed = {(own, other) for own, others in ALLOWED.items() for other in others}
    allowed |= {(own, "") for own in ALLOWED}
    forbidden = {arrow: sorted(files) for arrow, files in arrows().items() if arrow not in allowed}
    assert not forbidden


def test_the_matrix_is_an_order() -> None:
    order = list(ALLOWED)
    for own, others in ALLOWED.items():
        assert all(order.index(other) < order.index(own) for other in others)


def test_folders_are_few_and_chains_short() -> None:
    folders = {path.parent for path in modules()}
    assert len(folders) <= MOST_FOLDERS
    level: dict[str, int] = {}
    used = {arrow for arrow in arrows() if arrow[1]}
    for own in ALLOWED:  # from the ground up
        below = [level[other] for mine, other in used if mine == own]
        level[own] = 1 + max(below, default=0)
    assert max(level.values()) <= MOST_LEVELS


def test_every_module_says_what_it_is() -> None:
    for path in modules():
        page = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        assert page, path
        assert page.splitlines()[0].endswith((".", ":", "?")), path


def test_only_the_chain_knows_pytorch_kinematics() -> None:
    users = {
        path.relative_to(PACKAGE).as_posix()
        for path in modules()
        if any(name.split(".")[0] == "pytorch_kinematics" for name in imports_of(path))
    }
    assert users == {"body/chain.py"}


@pytest.mark.parametrize("library", ["av"])
def test_costs_and_below_do_not_read_files(library: str) -> None:
    for path in modules():
        if room_of(path) in ("inference", "body", "vision", "cost", "initialise"):
            assert not any(name.split(".")[0] == library for name in imports_of(path)), path


def test_the_parser_sees_every_kind_of_import() -> None:
    source = (
        "import torchcss.io.video as v\nfrom torchcss import cli\nfrom . import total\n"
        "from ..body.model import X\ndef f():\n    from torchcss.tracking.session import y\n"
    )
    assert imported(source, ["torchcss", "cost"]) == {
        *("torchcss.io.video", "torchcss.cli", "torchcss.cost"),
        *("torchcss.body.model", "torchcss.tracking.session"),
    }


def test_searches_and_costs_have_complete_interfaces() -> None:
    """Nothing asks at run time whether an object happens to have a method."""
    found = []
    for path in modules():
        if room_of(path) not in ("inference", "cost", "tracking"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                name = node.func.id
                if name == "hasattr" or (name == "getattr" and len(node.args) > 2):
                    found.append((path.name, node.lineno))
            if isinstance(node, ast.ExceptHandler) and "AttributeError" in ast.dump(node):
                found.append((path.name, node.lineno))
    assert not found


def test_concrete_classes_are_not_subclassed() -> None:
    """A class of the package is derived from only if it is abstract: a protocol, or with gaps."""
    wrong = set()
    for path in modules():
        if room_of(path) not in ("inference", "body", "vision", "cost", "initialise", "tracking"):
            continue
        name = ".".join(["torchcss", *path.relative_to(PACKAGE).with_suffix("").parts])
        for one in vars(importlib.import_module(name)).values():
            if inspect.isclass(one) and one.__module__ == name:
                wrong |= {
                    (one.__name__, base.__name__)
                    for base in one.__bases__
                    if base.__module__.startswith("torchcss.")
                    and not (inspect.isabstract(base) or is_protocol(base))
                }
    assert not wrong
