"""The architecture: which folder may import which, as a matrix with nothing allowed by default.

Every module is parsed, not imported, so that imports inside functions count too.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from code_figures import arrows, folder_of, imported, imports_of

PACKAGE = Path(__file__).resolve().parents[1] / "torchcss"

GROUND = {"types", "errors", "joint_names", "linalg", "robust", "files", "stopwatch"}
"""Single modules at the top, which every folder may import."""

ALLOWED: dict[str, set[str]] = {
    "kernels": set(),
    "inference": {"kernels"},
    "body": {"kernels"},
    "vision": {"kernels"},
    "cost": {"kernels", "inference", "body", "vision"},
    "initialise": {"inference", "body", "vision", "cost"},
    "io": {"inference", "body", "vision", "cost", "initialise"},
    "tracking": {"inference", "body", "vision", "cost", "initialise"},
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


def test_every_module_is_in_a_folder_but_the_ground() -> None:
    loose = {path.stem for path in PACKAGE.glob("*.py")}
    assert loose == {*GROUND, "__init__"}
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and list(path.glob("*.py"))}
    assert folders == set(ALLOWED)


def test_a_folder_imports_what_the_matrix_allows() -> None:
    allowed = {(own, other) for own, others in ALLOWED.items() for other in others}
    found = arrows(PACKAGE)
    forbidden = {arrow: sorted(files) for arrow, files in found.items() if arrow not in allowed}
    assert not forbidden


def test_the_matrix_is_an_order() -> None:
    order = list(ALLOWED)
    for own, others in ALLOWED.items():
        assert all(order.index(other) < order.index(own) for other in others)


def test_folders_are_few_and_chains_short() -> None:
    folders = {path.parent for path in modules()}
    assert len(folders) <= MOST_FOLDERS
    level: dict[str, int] = {}
    used = set(arrows(PACKAGE))
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
        if any(name.split(".")[0] == "pytorch_kinematics" for name in imports_of(path, PACKAGE))
    }
    assert users == {"body/chain.py"}


@pytest.mark.parametrize("library", ["av"])
def test_costs_and_below_do_not_read_files(library: str) -> None:
    for path in modules():
        if folder_of(path, PACKAGE) in ("inference", "body", "vision", "cost", "initialise"):
            assert not any(name.split(".")[0] == library for name in imports_of(path, PACKAGE)), (
                path
            )


def test_the_parser_sees_every_kind_of_import() -> None:
    source = (
        "import torchcss.io.video as v\nfrom torchcss import cli\nfrom . import total\n"
        "from ..body.model import X\ndef f():\n    from torchcss.tracking.session import y\n"
    )
    assert imported(source, ["torchcss", "cost"]) == {
        *("torchcss.io.video", "torchcss.cli", "torchcss.cost"),
        *("torchcss.body.model", "torchcss.tracking.session"),
    }
