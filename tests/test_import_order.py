"""The architecture: an import only points down the list in the contributors' guide.

Every module is parsed, not imported, so that imports inside functions count too.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "torchcss"

LAYERS = (
    {"types", "errors", "joint_names", "stopwatch", "reading"},
    {"linalg", "robust"},
    {"raster"},
    {"body"},
    {"vision"},
    {"inference"},
    {"cost"},
    {
        "carry",
        "presets",
        "first_pose",
        "gross_marks",
        "hypotheses",
        "initialise",
        "inverse_kinematics",
        "interpretations",
        "jumps",
        "limbs",
        "marks",
        "reprojection",
        "synthetic",
        "figure",
        "mesh_truth",
        "motions",
        "render",
        "rooms",
        "metrics",
        "published",
        "self_motion",
        "slices",
        "shape_fit",
        "random_person",
        "recovery",
        "robots",
    },
    {"sampling_study"},
    {"settings"},
    {"io"},
    {"views"},
    {"pipeline", "initialise_image", "first_frame", "smooth", "retarget"},
    {"yardstick", "side_by_side"},
    {"recorder", "view_files", "live"},
    {"track_files", "smooth_video"},
    {"demo", "scenes", "cli", "cli_init", "cli_export", "cli_smooth", "cli_view"},
)
"""Lowest first; a folder counts as one entry."""

STRANGERS = ("body", "vision", "inference")
"""Parts that must not know of each other."""


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def entry_of(module: str) -> str:
    """The part of the package that a dotted module name belongs to; '' for the package itself."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else ""


def imports_of(path: Path) -> set[str]:
    """Dotted names of all modules that a file of the package imports."""
    package = ["torchcss", *path.relative_to(PACKAGE).parts[:-1]]
    return imported_modules(path.read_text(encoding="utf-8"), package)


def imported_modules(source: str, package: list[str]) -> set[str]:
    """The same for a text, relative imports resolved from the package that it stands in."""
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


def rank(entry: str) -> int:
    for level, layer in enumerate(LAYERS):
        if entry in layer:
            return level
    raise AssertionError(f"torchcss.{entry} has no place in LAYERS: give it one")


def own_entry(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path: Path) -> None:
    own = own_entry(path)
    for module in imports_of(path):
        if not (module == "torchcss" or module.startswith("torchcss.")):
            continue
        # The package's own page re-exports from every layer, and nobody below it imports it.
        if own == "__init__":
            continue
        entry = entry_of(module)
        # `torchcss.load_body`, say, is a name of the package's page and not a module.
        is_module = bool(entry) and (
            (PACKAGE / entry).is_dir() or (PACKAGE / f"{entry}.py").is_file()
        )
        assert is_module, f"{path.name}: imports the package's own page ({module})"
        assert rank(entry) <= rank(own), f"{own} imports {module}, which is above it"
        if own in STRANGERS and entry in STRANGERS:
            assert own == entry, f"{own} and {entry} must not know of each other"


def test_only_the_kinematics_know_pytorch_kinematics() -> None:
    users = {
        path.relative_to(PACKAGE).as_posix()
        for path in modules()
        if any(name.split(".")[0] == "pytorch_kinematics" for name in imports_of(path))
    }
    assert users == {"body/kinematics.py"}


def test_costs_and_below_do_not_read_files() -> None:
    for path in modules():
        if own_entry(path) != "__init__" and rank(own_entry(path)) < rank("io"):
            assert not any(name.split(".")[0] == "av" for name in imports_of(path)), path


def test_the_parser_sees_every_kind_of_import() -> None:
    source = (
        "import torchcss.io.video as v\nfrom torchcss import cli\nfrom . import total\n"
        "from ..body.model import X\ndef f():\n    from torchcss.pipeline import y\n"
    )
    assert imported_modules(source, ["torchcss", "cost"]) == {
        "torchcss.io.video",
        "torchcss.cli",
        "torchcss.cost",
        "torchcss.body.model",
        "torchcss.pipeline",
    }
