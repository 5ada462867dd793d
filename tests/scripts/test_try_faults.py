"""Batches that are disturbed lose nothing: the small mode of `scripts/try_faults.py`."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "try_faults.py"


def test_nothing_is_lost(script: ModuleType, tmp_path: Path) -> None:
    faults = ("kill", "sleep", "end", "disk", "folder", "group")
    config = script.Config(
        rounds=len(faults), clips=1, frames=4, patience=1.0, faults=faults, folder=tmp_path,
        processes=1,
    )  # fmt: skip
    report = script.main(config)
    assert report["lost"] == 0, report["rows"]
    assert [row[1] for row in report["rows"]] == list(faults)
