"""Rules of the house that a machine can hold: parameters, options, hidden methods, subclasses."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from code_figures import MOST_PARAMETERS, Function, count, functions, main, num_parameters
from code_figures import Config as Figures
from typing_extensions import is_protocol

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "torchcss"

MODULES = sorted(PACKAGE.rglob("*.py"))
SEARCH = [path for path in MODULES if path.relative_to(PACKAGE).parts[0] in
          ("inference", "cost", "tracking")]  # fmt: skip


def nodes(path: Path) -> Iterator[ast.AST]:
    return ast.walk(ast.parse(path.read_text(encoding="utf-8")))


def of_package(paths: list[Path]) -> pytest.MarkDecorator:
    names = [str(path.relative_to(REPOSITORY)) for path in paths]
    return pytest.mark.parametrize("path", paths, ids=names)


@of_package(MODULES)
def test_no_function_has_more_than_eight_parameters_or_passes_options_on(path: Path) -> None:
    for function in functions(path.read_text(encoding="utf-8")):
        assert num_parameters(function) <= MOST_PARAMETERS, function.name
        assert function.args.kwarg is None, f"{function.name}: name the options"


@of_package(MODULES)
def test_no_bag_of_options(path: Path) -> None:
    """A mapping of anything is what a file holds, never how a function is told what to do."""
    for function in functions(path.read_text(encoding="utf-8")):
        for argument in parameters(function):
            told = argument.arg.endswith(("options", "settings", "choice", "config"))
            kind = "" if argument.annotation is None else ast.unparse(argument.annotation)
            plain = kind.startswith(("dict", "Dict", "Any", "Mapping"))
            if told and plain:
                # `settings` of a run's folder are plain data until `settings_from_plain`.
                assert path.parent.name == "io", f"{function.name}: {argument.arg}: {kind}"


def parameters(function: Function) -> list[ast.arg]:
    arguments = function.args
    return [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]


@of_package([*SEARCH, PACKAGE / "types.py"])
def test_interfaces_are_complete(path: Path) -> None:
    """No method is looked for at run time."""
    assert "runtime_checkable" not in path.read_text(encoding="utf-8")
    for node in nodes(path):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id != "hasattr", node.lineno
            assert not (node.func.id == "getattr" and len(node.args) == 3), node.lineno
        if isinstance(node, ast.ExceptHandler) and node.type is not None:
            assert "AttributeError" not in ast.unparse(node.type), node.lineno


@of_package(MODULES)
def test_no_concrete_class_is_subclassed(path: Path) -> None:
    """A class of the package has a subclass only if it is abstract, a protocol or an error."""
    name = ".".join(["torchcss", *path.relative_to(PACKAGE).with_suffix("").parts])
    for one in vars(importlib.import_module(name.removesuffix(".__init__"))).values():
        if inspect.isclass(one) and one.__module__ == name:
            for base in one.__bases__:
                ours = base.__module__.startswith("torchcss.")
                meant = inspect.isabstract(base) or is_protocol(base)
                assert not ours or meant or issubclass(base, BaseException), (one, base)


@of_package(MODULES)
def test_a_record_is_found_by_its_name(path: Path) -> None:
    """A compiled kernel that is kept on disk knows its records by name, else it is of others."""
    name = ".".join(["torchcss", *path.relative_to(PACKAGE).with_suffix("").parts])
    module = importlib.import_module(name.removesuffix(".__init__"))
    for one in vars(module).values():
        if inspect.isclass(one) and issubclass(one, tuple) and one.__module__ == name:
            assert vars(module).get(one.__name__) is one, one


def test_a_name_means_one_thing() -> None:
    """No function, class or constant is public in two modules.

    Compiled twins have the names of what they are twins of, verbs those of what they make.
    """
    defined: dict[str, list[str]] = {}
    for path in MODULES:
        if path.parent.name in ("fused", "cli") or path.stem == "v01":
            continue
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            named = [node.name] if isinstance(node, Function | ast.ClassDef) else []
            if isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                named = [x.id for x in targets if isinstance(x, ast.Name) and x.id.isupper()]
            for name in named:
                defined.setdefault(name, []).append(str(path.relative_to(PACKAGE)))
    twice = {name: paths for name, paths in defined.items() if len(paths) > 1}
    assert {name: paths for name, paths in twice.items() if name[0] != "_"} == {}


def test_the_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    package = tmp_path / "torchcss"
    many = ", ".join("abcdefghi")
    for name, lines in {
        "__init__.py": ['"""Page."""', "from torchcss.b.y import f"],
        "types.py": ["X = 1"],
        "a/x.py": [
            '"""Two',
            'lines."""',
            "# comment",
            "from torchcss.types import X",
            "y = (X,",
            "2)",
        ],
        "b/y.py": [
            "from torchcss.a.x import y",
            f"def f(self, {many}):",
            "    'Doc.'",
            "    return a",
        ],
    }.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text("\n".join(lines) + "\n")
    figures = main(Figures(tree=tmp_path, out=tmp_path / "new" / "figures.json"))
    assert figures["folders"] == {"ground": [2, 11], "a": [3, 13], "b": [3, 34]}
    assert figures["arrows"] == ["b -> a"]
    assert figures["many_parameters"] == [["b/y.py:2 f", 9]]
    assert "b/y.py:2 f 9" in capsys.readouterr().out
    assert count("x = '''a\nb'''\n").lines == {1, 2}


def test_functions_are_short() -> None:
    assert main(Figures(tree=REPOSITORY))["long_functions"] == []


SLOW = ("av", "kornia", "matplotlib", "numba", "pytorch_kinematics", "scipy")
"""Libraries that take long to import."""


def test_a_command_starts_without_what_it_does_not_use() -> None:
    code = f"import sys, torchcss.cli.main; print([m for m in {SLOW} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY
    )
    assert done.stdout.strip() == "[]", done.stdout


def test_prose_fits_a_screen() -> None:
    """At most 120 signs a line, but for tables, formulas, and the page that is made of reports."""
    pages = [REPOSITORY / "README.md", REPOSITORY / "CHANGELOG.md", *REPOSITORY.glob("docs/*.md")]
    wide = [
        f"{page.name}:{number}"
        for page in pages
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
        if len(line) > 120 and not line.startswith(("|", "$$")) and page.name != "results.md"
    ]
    assert wide == []
