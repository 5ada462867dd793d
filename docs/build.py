"""Build the site: the guide, the notebooks and the API, as static pages in one folder.

    pip install -c constraints.txt -e ".[docs]" && python docs/build.py --out build/site

Then open `build/site/index.html`; nothing is fetched, neither to build it nor to read it. The API
comes from the docstrings (pdoc). A page of the guide is Markdown: from this folder, from sections
of the README, from the docstrings of the scripts, or a notebook. To pdoc each is a module without
members, so that pages and API share their look, their search and their cross-links. Notebooks that
hold no outputs are executed; formulas become MathML. Any warning, and any link within the site that
leads nowhere, is an error.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import os
import re
import shutil
import tempfile
import types
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from html.parser import HTMLParser
from inspect import get_annotations
from pathlib import Path
from pkgutil import walk_packages
from typing import get_type_hints
from urllib.parse import unquote, urlsplit

import nbformat
from latex2mathml.converter import convert as mathml
from nbconvert import MarkdownExporter
from nbconvert.preprocessors import ExecutePreprocessor
from pdoc import render
from pdoc.doc import Module
from traitlets.config import Config

import torchcss

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
README_PAGES = {"contributing": "Contributing"}
"""Sections of the README that are pages of their own; all others make up the front page."""
RECORD = (
    *("results", "findings", "tried", "recordings"),
    *("from_the_papers_to_the_code", "decisions"),
)
"""What was measured, learnt and decided, in the order in which the site lists it."""

_JAXTYPING = re.compile(
    r'jaxtyping\.(?=\w+\[)|<span class=\\?"n\\?">jaxtyping</span><span class=\\?"o\\?">.</span>'
)
"""Where a type comes from, which readers of `Float[Tensor, "n"]` need not be told."""

_FORMULA = re.compile(
    r"(```.*?```|`[^`]*`)|\$\$(.+?)\$\$|\$(?=\S)([^$\n]+?)(?<=\S)\$", flags=re.DOTALL
)
"""Code, which is left as it is, or a formula that stands by itself, or one in the text."""


def main() -> None:
    """Build what the command line asks for."""
    parser = argparse.ArgumentParser(description="Build the site.")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "build" / "site")
    parser.add_argument("--modules", nargs="*", help="only these modules of the API (default: all)")
    parser.add_argument(
        "--no-execute", action="store_true", help="leave notebooks without outputs as they are"
    )
    arguments = parser.parse_args()
    build(arguments.out, modules=arguments.modules, execute=not arguments.no_execute)
    print(arguments.out / "index.html")


def build(out: Path, *, modules: Iterable[str] | None = None, execute: bool = True) -> None:
    """Write the site into an emptied folder.

    Args:
        out: The folder; what is in it is removed, if a site is.
        modules: Names of the modules to document; None for all that are public.
        execute: Execute the notebooks that hold no outputs.

    Raises:
        SystemExit: A link within the site leads nowhere, or the folder holds something else.
        UserWarning: Whatever pdoc warns of.
    """
    if out.exists() and any(out.iterdir()) and not (out / "search.js").exists():
        raise SystemExit(f"{out} holds something other than a site; name another folder with --out")
    shutil.rmtree(out, ignore_errors=True)
    (out / "pictures").mkdir(parents=True)
    (out / "search.js").touch()  # from now on this is known as a site, even if the build breaks
    pages = {name: page(name, text) for name, text in guide(out, execute=execute)}
    names = list(modules) if modules is not None else public_modules()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        resolve_inherited(names)
        everything = pages | {name: Module.from_name(name) for name in names}
        render.configure(docformat="google", template_directory=DOCS / "templates")
        render.env.globals["pages"] = {name: each.obj.title for name, each in pages.items()}
        for name, module in everything.items():
            target = out / f"{name.replace('.', '/')}.html"
            target.parent.mkdir(parents=True, exist_ok=True)
            text = render.html_module(module, everything)
            target.write_text(_JAXTYPING.sub("", text), encoding="utf-8")
        index = _JAXTYPING.sub("", render.search_index(everything))
        (out / "search.js").write_text(index, encoding="utf-8")
    if broken := list(broken_links(out)):
        raise SystemExit("\n".join(["links that lead nowhere:", *broken]))


def resolve_inherited(names: Iterable[str]) -> None:
    """Resolve the types of dataclass fields that a class has from a base in another module.

    pdoc looks them up where the class is, but their names are those of the module of the base.
    """
    for name in names:
        for cls in vars(importlib.import_module(name)).values():
            if isinstance(cls, type) and is_dataclass(cls) and cls.__module__ == name:
                own = get_annotations(cls)
                taken = {field.name for field in fields(cls) if field.init} - own.keys()
                if taken:
                    hints = get_type_hints(cls)
                    cls.__init__.__annotations__.update({each: hints[each] for each in taken})


def public_modules() -> list[str]:
    """The package and all its modules, by name."""
    below = walk_packages(torchcss.__path__, "torchcss.")
    return ["torchcss", *sorted(module.name for module in below)]


def guide(out: Path, *, execute: bool) -> Iterator[tuple[str, str]]:
    """Names and Markdown of the guide's pages, in the order in which the site lists them."""
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    front, sections = readme_sections(readme)
    shutil.copytree(REPOSITORY / "notebooks" / "pictures", out / "pictures", dirs_exist_ok=True)
    apart = set(README_PAGES.values())
    rest = "".join(text for heading, text in sections.items() if heading not in apart)
    yield "index", front + rest
    for name in ("guide", "mathematics"):
        yield name, (DOCS / f"{name}.md").read_text(encoding="utf-8")
    for notebook in sorted((REPOSITORY / "notebooks").glob("*.ipynb")):
        yield notebook.stem, notebook_text(notebook, out / "pictures", execute=execute)
    for name in RECORD:
        yield name, (DOCS / f"{name}.md").read_text(encoding="utf-8")
    yield "scripts", scripts_text()
    for name, heading in README_PAGES.items():
        yield name, re.sub("^#(#+ )", r"\1", sections[heading], flags=re.MULTILINE)
    yield "changelog", (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")


def readme_sections(readme: str) -> tuple[str, dict[str, str]]:
    """What stands before the first section, and the sections by their headings."""
    front, *parts = re.split(r"^(?=## )", readme, flags=re.MULTILINE)
    return front, {part.splitlines()[0].removeprefix("## "): part for part in parts}


def scripts_text() -> str:
    """The docstrings of the scripts, as one page."""
    parts = [
        "# Scripts\n\nOne experiment or table each; `python SCRIPT --help` lists the options.\n"
    ]
    for path in sorted((REPOSITORY / "scripts").glob("*.py")):
        docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
        parts.append(f"## {path.stem}\n\n`scripts/{path.name}`\n\n{docstring}\n")
    return "\n".join(parts)


def notebook_text(path: Path, pictures: Path, *, execute: bool) -> str:
    """A notebook with its outputs as Markdown; its pictures are written into a folder."""
    notebook = nbformat.read(path, as_version=4)
    bare = not any(cell.get("outputs") for cell in notebook.cells)
    if bare and execute:
        print(f"executing {path.name}")
        run(notebook, path.parent)
    notebook.metadata["language_info"] = {"name": "python"}  # else its code has no colours
    text, resources = MarkdownExporter().from_notebook_node(
        notebook, {"unique_key": path.stem, "output_files_dir": "pictures"}
    )
    for name, data in resources["outputs"].items():
        (pictures / Path(name).name).write_bytes(data)
    return text


def run(notebook: nbformat.NotebookNode, folder: Path) -> None:
    """Execute a notebook in a folder; its outputs are put into it."""
    with tempfile.TemporaryDirectory() as sockets:
        # Over TCP, which is all that Windows has, Jupyter warns that others may listen.
        own = {"transport": "ipc", "ip": f"{sockets}/kernel"} if os.name == "posix" else {}
        ExecutePreprocessor(
            timeout=None, startup_timeout=600, config=Config({"KernelManager": own})
        ).preprocess(notebook, {"metadata": {"path": str(folder)}})


def page(name: str, text: str) -> Module:
    """A page of Markdown as a module for pdoc: its text is the docstring."""
    # As files of the repository refer to each other, and as pages of the site do.
    text = re.sub(r"\]\((?:\.\./)?notebooks/(pictures/[^)]*)\)", r"](\1)", text)
    text = re.sub(r"\]\((?:\.\./)?README\.md\)", "](index.html)", text)
    text = re.sub(r"\]\((?:\.\./)?scripts/(\w+)\.py\)", r"](scripts.html#\1)", text)
    text = re.sub(
        r"\]\((?:\.\./|docs/)?(?:notebooks/)?(\w+)\.(?:md|ipynb)(#[\w-]+)?\)", r"](\1.html\2)", text
    )
    text = _FORMULA.sub(_set, text)
    module = types.ModuleType(name, text)
    heading = re.search(r"^# (.+)$", text, flags=re.MULTILINE)
    if heading is None:
        raise SystemExit(f"the page {name} has no heading")
    module.__dict__.update(title=heading[1], __docformat__="markdown", __all__=[])
    return Module(module)


def _set(match: re.Match[str]) -> str:
    """Set a formula as MathML, which browsers draw without help."""
    code, alone, within = match.groups()
    if code:
        return code
    if alone:
        return f"<div>{mathml(alone, display='block')}</div>"
    return f"<span>{mathml(within)}</span>"


class _Links(HTMLParser):
    """Collects where a page may be entered, and where it leads to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors, self.targets = {""}, set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take note of one tag's identifier and of what it refers to."""
        values = dict(attrs)
        self.anchors |= {values[key] for key in ("id", "name") if values.get(key)}
        self.targets |= {values[key] for key in ("href", "src") if values.get(key)}


def broken_links(site: Path) -> Iterator[str]:
    """Links from page to page, or to a picture, whose target or anchor is not there."""
    parsed: Mapping[Path, _Links] = {
        path.resolve(): _Links(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")
    }
    for path, links in parsed.items():
        for target in sorted(links.targets):
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            found = file.exists()
            if found and file in parsed:
                found = unquote(parts.fragment) in parsed[file].anchors
            if not found:
                yield f"{path.relative_to(site.resolve())}: {target}"


if __name__ == "__main__":
    main()
