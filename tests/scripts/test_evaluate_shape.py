"""The evaluation of fitted shapes in its small mode."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest
from made_sequences import write_arm

from torchcss.errors import ConfigurationError


def test_small_mode(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    arm, out = tmp_path / "arm", tmp_path / "tables" / "shape.json"
    write_arm(arm, 2)
    script.main(script.Config(sequences=(arm,), body="arm8", small=True, out=out))
    rows = json.loads(out.read_text())["rows"]
    assert [row["by"] for row in rows] == ["joints", "edges", "edges, colours", "and bends"]
    for row in rows:
        assert (row["sequence"], row["frame"]) == ("arm", 0)
        assert 0 < row["overlap"] < 1
        assert row["root_mm"] >= row["of_all_mm"] > 0
    assert rows[0]["overlap"] != rows[1]["overlap"] != rows[2]["overlap"]
    assert "edges, colours" in capsys.readouterr().out


def test_a_sequence_without_masks_is_refused(script: ModuleType, tmp_path: Path):
    write_arm(tmp_path / "arm", 2)
    (tmp_path / "arm" / "mask.npz").unlink()
    with pytest.raises(ConfigurationError, match="no masks"):
        script.main(script.Config(sequences=(tmp_path / "arm",), body="arm8"))
