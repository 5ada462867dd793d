"""The page of results: what is in the repository is what the reports say."""

from __future__ import annotations

import datetime
import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from torchcss.errors import TrackFileError
from torchcss.tracking.presets import PRESETS

DOCS = Path(__file__).resolve().parents[2] / "docs"


def report(**table: Any) -> str:
    return json.dumps({
        "command": "python a.py", "version": "v1", "date": "2026-01-02",
        "table": {"title": "A", "columns": ["clip", "mm"], **table},
    })  # fmt: skip


def test_the_page_is_that_of_the_reports(script: ModuleType) -> None:
    assert (DOCS / "results.md").read_text(encoding="utf-8") == script.page_of(DOCS / "results")


def test_every_row_says_how_it_was_made(script: ModuleType) -> None:
    names = []
    for path in (DOCS / "results").glob("*.json"):
        found = json.loads(path.read_text(encoding="utf-8"))
        names.append(path.stem)
        for row in found["table"]["rows"]:
            own = row if isinstance(row, dict) else {}
            made = {name: own.get(name, found.get(name)) for name in script.MADE_BY}
            assert all(made.values()), path
            assert datetime.date.fromisoformat(made["date"])
    assert len(names) > 10


def test_trackers_go_by_their_present_names() -> None:
    table = json.loads((DOCS / "results" / "failure_modes.json").read_text("utf-8"))["table"]
    for row in table["rows"]:
        first = (row["cells"] if isinstance(row, dict) else row)[0]
        assert re.sub(r"^[\w, -]+: | \(first 1 s\)$", "", first) in PRESETS


def test_tables_come_in_their_order_with_their_commands(script: ModuleType, tmp_path: Path) -> None:
    last = report(rows=[["turn", 12.345], ["beam", None]], picture="a.png")
    (tmp_path / "last.json").write_text(last)
    rows = [["turn", "x"], {"cells": ["beam", 2], "command": "python b.py", "version": "v2"}]
    (tmp_path / "other.json").write_text(report(title="B", order=1, about="Both.", rows=rows))
    (tmp_path / "none.json").write_text('{"rows": []}')
    page = script.page_of(tmp_path)
    assert re.findall(r"^## (\w)$", page, flags=re.MULTILINE) == ["B", "A"]
    assert "\nBoth.\n\n1. `python a.py`\n2. `python b.py`\n" in page
    assert "| beam | 2 | 2 | v2 | 2026-01-02 |" in page
    assert "\n`python a.py`\n" in page
    assert page.endswith("\n\n![A](../notebooks/pictures/a.png)\n")
    assert "| turn | 12.3 | v1 | 2026-01-02 |\n| beam |  | v1 | 2026-01-02 |" in page


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (report(rows=[["turn"]]), "expected 2 cells in every row"),
        (report(rows=[["turn", 1]]).replace('"v1"', '""'), "version missing of row"),
    ],
)
def test_a_report_that_says_too_little(
    script: ModuleType, tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(TrackFileError, match=message):
        script.page_of(tmp_path)
