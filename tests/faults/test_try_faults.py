"""Batches that are disturbed lose nothing: the small mode of `scripts/try_faults.py`."""

from __future__ import annotations

from pathlib import Path

from try_faults import Config, main, summed


def test_nothing_is_lost(tmp_path: Path) -> None:
    faults = ("kill", "crash", "sleep", "end", "disk", "folder", "group")
    config = Config(
        rounds=len(faults), clips=1, frames=4, patience=1.0, faults=faults, folder=tmp_path,
        processes=1,
    )  # fmt: skip
    report = main(config)
    assert report["lost"] == 0, report["rows"]
    assert [row[1] for row in report["rows"]] == list(faults)


def test_rounds_are_summed() -> None:
    rows = [[0, "kill", "nothing lost"], [1, "disk", "left out: no disk"], [2, "kill", "lost: all"]]
    assert summed(rows) == [["kill", 2, 1], ["disk", 1, "left out: no disk"], ["all", 2, 1]]
