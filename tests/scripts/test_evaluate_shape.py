"""The evaluation of fitted shapes in its small mode."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from torchcss.errors import ConfigurationError

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from made_sequences import write_arm

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "evaluate_shape.py"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    specification = importlib.util.spec_from_file_location("evaluate_shape", SCRIPT)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    monkeypatch.setitem(sys.modules, "evaluate_shape", module)
    specification.loader.exec_module(module)
    return module


def test_small_mode(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    arm, out = tmp_path / "arm", tmp_path / "tables" / "shape.json"
    write_arm(arm, 2)
    script.main(script.Config(sequences=(arm,), body="arm8", small=True, out=out))
    rows = json.loads(out.read_text())["rows"]
    assert [row["by"] for row in rows] == ["joints", "edges", "edges, colours"]
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
