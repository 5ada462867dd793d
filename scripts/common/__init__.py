"""What the scripts share: their command line, tables, and reports that say how they were made.

A report is a JSON file with the `command`, the `version` and the `date` of the run beside what was
measured, and a `table` where there is one to show. Reports under `docs/results/` become the page
docs/results.md (`scripts/make_results_page.py`).
"""

from __future__ import annotations

import datetime
import math
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import tyro

from torchcss.errors import ConfigurationError, TorchcssError
from torchcss.files import prepare_output_folder
from torchcss.io.tracks import write_summary

REPOSITORY = Path(__file__).resolve().parents[2]

Config = TypeVar("Config")


def start(main: Callable[[Config], Any], config: type[Config], page: str | None) -> None:
    """Run a script from the command line; what a user got wrong is one line.

    Args:
        main: What it does.
        config: Its options.
        page: What `--help` says.
    """
    try:
        main(tyro.cli(config, description=page))
    except TorchcssError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


QUARTILES = {"lower_quartile": 0.25, "median": 0.5, "upper_quartile": 0.75}


def quartiles(values: Sequence[float]) -> dict[str, float]:
    """The middle of some measurements, and their spread."""
    return {name: float(np.quantile(values, q)) for name, q in QUARTILES.items()}


def peak_mib(maxrss: int) -> float:
    """The most memory that a process ever had, MiB, as its `ru_maxrss` says."""
    return maxrss / (2**20 if sys.platform == "darwin" else 2**10)


class Table(NamedTuple):
    """Rows to be shown.

    Attributes:
        title: What they are.
        columns: Titles of the columns; the first one names the rows.
        rows: Texts, and numbers that are shown with three digits; NaN and None are left blank.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str | float | None]]

    def texts(self) -> list[list[str]]:
        """The cells as they are shown."""
        return [[cell_text(cell) for cell in row] for row in self.rows]

    def print(self) -> None:
        """Print it with columns of equal width."""
        rows = [list(self.columns), *self.texts()]
        widths = [max(len(row[i]) for row in rows) for i in range(len(self.columns))]
        print(self.title)
        for row in rows:
            cells = [f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)]
            print("  ".join([f"{row[0]:{widths[0]}}", *cells[1:]]))


def cell_text(cell: str | float | None) -> str:
    """A cell of a table: words as they are, numbers with three digits or all before the point."""
    if isinstance(cell, str):
        return cell
    if cell is None or math.isnan(cell):
        return ""
    if isinstance(cell, int) or abs(cell) >= 1000:
        return f"{cell:.0f}" if math.isfinite(cell) else str(cell)
    return f"{cell:.1f}" if abs(cell) >= 10 else f"{cell:.3g}"


def write_report(path: Path | None, report: Mapping[str, Any], table: Table | None = None) -> None:
    """Write what was measured, and how; nothing where there is no path.

    Args:
        path: The file.
        report: What was measured.
        table: What of it a page should show.

    Raises:
        ConfigurationError: If the path is a folder.
        OutputError: If it cannot be written.
    """
    if path is None:
        return
    if path.is_dir():
        raise ConfigurationError(f"{path}: expected a file to write, found a folder")
    prepare_output_folder(path.parent)
    shown = {} if table is None else {"table": table._asdict()}
    write_summary(path, {**made_by(), **report, **shown})


def finish(path: Path | None, report: dict[str, Any], table: Table) -> dict[str, Any]:
    """Print a table, and write the report (`write_report`), which is returned."""
    table.print()
    write_report(path, report, table)
    return report


def made_by() -> dict[str, str]:
    """The command of this run, the version of the code, and the date."""
    script = Path(sys.argv[0]).resolve()
    name = script.relative_to(REPOSITORY) if script.is_relative_to(REPOSITORY) else script.name
    version = ""
    with suppress(FileNotFoundError):  # no git here
        version = subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=REPOSITORY, capture_output=True,
            text=True,
        ).stdout.strip()  # fmt: skip
    return {
        "command": shlex.join(["python", str(name), *sys.argv[1:]]),
        "version": version or "unknown",
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }
