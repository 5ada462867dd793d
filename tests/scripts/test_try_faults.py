"""Batches that are disturbed lose nothing: the small mode of `scripts/try_faults.py`."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "try_faults.py"


@pytest.mark.parametrize("fault", ["kill", "sleep", "end", "disk", "folder", "group"])
def test_nothing_is_lost(fault: str, script: ModuleType, tmp_path: Path) -> None:
    config = script.Config(
        rounds=1, clips=1, frames=4, patience=1.0, faults=(fault,), folder=tmp_path, processes=1
    )
    report = script.main(config)
    assert report["lost"] == 0, report["rows"]
