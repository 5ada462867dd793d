"""The page docs/results.md from the reports under docs/results.

    python scripts/make_results_page.py

Every JSON file there is a report as the scripts write them (`--out docs/results/NAME.json`): a
`table` with `title`, `columns` and `rows`, and the `command`, `version` and `date` of the run. A
table may also have `about`, a sentence or two that stand above it, `picture`, a file of
`notebooks/pictures` that stands below it, and `order`, its place on the page. A row is a list of
cells, or an object of `cells` with a `command`, `version` or `date` of its own.
"""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

from common import REPOSITORY, cell_text, start

from torchcss.errors import TrackFileError
from torchcss.files import load_json, replace_file
from torchcss.types import frozen

HEAD = """# Results

Made by `scripts/make_results_page.py` from the reports in `docs/results`: mend those, not this
page. Millimetres where no unit is given. What these and other runs taught is in the
[findings](findings.md), where the recordings are from in [recordings](recordings.md).
"""
WIDTH = 118
"""Longest line of prose."""
MADE_BY = ("command", "version", "date")
LAST = 1000
"""Place of a table that names none."""


@frozen
class Config:
    """Where the reports are and where the page goes."""

    reports: Path = REPOSITORY / "docs" / "results"
    """Folder of the reports."""
    page: Path = REPOSITORY / "docs" / "results.md"
    """The page to write."""


def main(config: Config) -> None:
    """Write the page."""
    with replace_file(config.page) as partial:
        partial.write_text(page_of(config.reports), encoding="utf-8")
    print(config.page)


def page_of(folder: Path) -> str:
    """All tables, in their order."""
    reports = {path: load_json(path, TrackFileError) for path in sorted(folder.glob("*.json"))}
    shown = [path for path, report in reports.items() if "table" in report]
    shown.sort(key=lambda path: reports[path]["table"].get("order", LAST))
    return "\n".join([HEAD, *(section(path, reports[path]) for path in shown)])


def section(path: Path, report: dict[str, Any]) -> str:
    """One table with what is said of it."""
    table = report["table"]
    rows = [row if isinstance(row, dict) else {"cells": row} for row in table["rows"]]
    made = [{name: str(row.get(name) or report.get(name, "")) for name in MADE_BY} for row in rows]
    for row, how in zip(rows, made, strict=True):
        if len(row["cells"]) != len(table["columns"]):
            raise TrackFileError(
                f"{path}: expected {len(table['columns'])} cells in every row, got {row['cells']}"
            )
        if absent := [name for name in MADE_BY if not how[name]]:
            raise TrackFileError(f"{path}: {' and '.join(absent)} missing of row {row['cells']}")
    commands = list(dict.fromkeys(how["command"] for how in made))
    several = len(commands) > 1
    columns = [*table["columns"], *(["command"] if several else []), "version", "date"]
    lines = [f"## {table['title']}", "", *textwrap.wrap(table.get("about", ""), WIDTH), ""]
    for number, command in enumerate(commands, 1):
        lines.append(f"{number}. `{command}`" if several else f"`{command}`")
    lines += ["", "| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    for row, how in zip(rows, made, strict=True):
        cells = [cell_text(cell) for cell in row["cells"]]
        cells += [str(commands.index(how["command"]) + 1)] if several else []
        lines.append("| " + " | ".join([*cells, how["version"], how["date"]]) + " |")
    if "picture" in table:
        lines += ["", f"![{table['title']}](../notebooks/pictures/{table['picture']})"]
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    start(main, Config, __doc__)
