"""How large the package is, and how it hangs together: lines, tokens, long functions, arrows.

    python scripts/code_figures.py
    python scripts/code_figures.py --tree ../another_checkout --out figures.json

Lines and tokens of code by folder (docstrings, comments and blank lines not counted), functions of
more than 50 lines of code and of more than 8 parameters, and the arrows between folders: which
imports which, the modules at the top (the ground) left out. `tests/test_house.py` uses the same.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from common import REPOSITORY, Table, start, write_report

from torchcss.types import frozen

MOST_LINES = 50
MOST_PARAMETERS = 8

_LAYOUT = (
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE),
    *(tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER),
)
Function = ast.FunctionDef | ast.AsyncFunctionDef


@frozen
class Config:
    """What to measure."""

    tree: Path = REPOSITORY
    """A checkout."""
    out: Path | None = None
    """JSON file to write."""


class Counted(NamedTuple):
    """A module's code.

    Attributes:
        lines: The lines that hold code, by number.
        tokens: How many tokens they have.
    """

    lines: frozenset[int]
    tokens: int


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    package = config.tree / "torchcss"
    figures: dict[str, Any] = {"folders": {}, "long_functions": [], "many_parameters": []}
    for path in sorted(package.rglob("*.py")):
        source, name = path.read_text(encoding="utf-8"), str(path.relative_to(package))
        counted = count(source)
        folder = figures["folders"].setdefault(folder_of(path, package) or "ground", [0, 0])
        folder[0] += len(counted.lines)
        folder[1] += counted.tokens
        for function in functions(source):
            where = f"{name}:{function.lineno} {function.name}"
            end = function.end_lineno or function.lineno
            length = len(counted.lines & set(range(function.lineno, end + 1)))
            if length > MOST_LINES:
                figures["long_functions"].append([where, length])
            if (number := num_parameters(function)) > MOST_PARAMETERS:
                figures["many_parameters"].append([where, number])
    figures["lines"], figures["tokens"] = map(sum, zip(*figures["folders"].values(), strict=True))
    figures["arrows"] = sorted(f"{own} -> {other}" for own, other in arrows(package))
    print_figures(figures)
    write_report(config.out, figures)
    return figures


def count(source: str) -> Counted:
    """Lines and tokens of code in a text."""
    texts: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        text = node.value if isinstance(node, ast.Expr) else None
        if isinstance(text, ast.Constant) and isinstance(text.value, str):
            texts |= set(range(text.lineno, (text.end_lineno or text.lineno) + 1))
    lines: set[int] = set()
    tokens = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _LAYOUT and token.start[0] not in texts:
            lines |= set(range(token.start[0], token.end[0] + 1))
            tokens += 1
    return Counted(frozenset(lines), tokens)


def functions(source: str) -> Iterator[Function]:
    """All functions and methods of a text."""
    return (node for node in ast.walk(ast.parse(source)) if isinstance(node, Function))


def num_parameters(function: Function) -> int:
    """Parameters of a function, `self` and `cls` not counted."""
    arguments = function.args
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return len(named) - (bool(named) and named[0].arg in ("self", "cls"))


def folder_of(path: Path, package: Path) -> str:
    """The folder that a file of the package counts with; '' for the ground."""
    parts = path.relative_to(package).parts
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


def imports_of(path: Path, package: Path) -> set[str]:
    """Dotted names of all modules that a file of the package imports."""
    above = ["torchcss", *path.relative_to(package).parts[:-1]]
    return imported(path.read_text(encoding="utf-8"), above)


def arrows(package: Path) -> dict[tuple[str, str], set[str]]:
    """Which folder imports which, and the files in which it does; the ground is no folder.

    What imports the package's own page is an arrow to `__init__`.
    """
    found: dict[tuple[str, str], set[str]] = {}
    for path in sorted(package.rglob("*.py")):
        own = folder_of(path, package)
        for name in imports_of(path, package) if path != package / "__init__.py" else ():
            top, *below = name.split(".")
            if top != "torchcss":
                continue
            other = below[0] if below else "__init__"
            if (package / f"{other}.py").is_file() and other != "__init__":
                continue
            if not (package / other).is_dir():
                other = "__init__"  # a name of the package's own page
            if other != own:
                found.setdefault((own or "ground", other), set()).add(
                    str(path.relative_to(package))
                )
    return found


def print_figures(figures: dict[str, Any]) -> None:
    """A line a folder, and the lists."""
    rows = [[folder, *numbers] for folder, numbers in figures["folders"].items()]
    total = ["all", figures["lines"], figures["tokens"]]
    Table("Code by folder", ("folder", "lines", "tokens"), [*rows, total]).print()
    for name, rows in (
        (f"functions of more than {MOST_LINES} lines", figures["long_functions"]),
        (f"functions of more than {MOST_PARAMETERS} parameters", figures["many_parameters"]),
    ):
        print(f"{name}: {len(rows)}")
        for where, number in rows:
            print(f"    {where} {number}")
    print(f"arrows between folders: {len(figures['arrows'])}")


if __name__ == "__main__":
    start(main, Config, __doc__)
