"""The fuzz of the engines in its small mode."""

from __future__ import annotations

import json
from pathlib import Path

import fuzz_engines as script
import pytest
import torch


def test_engines_agree_at_random(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "fuzz.json"
    script.compare_engines(script.Config(cases=5, states=6, out=out))
    assert json.loads(out.read_text())["failed"] == []
    assert "5 cases, 0 differ" in capsys.readouterr().out


def test_parts_that_taper_to_a_point(shared_data: Path) -> None:
    """Next to a tip points are dozens of sections away."""
    panda = str(shared_data / "robot_models" / "panda.urdf")
    found, _ = script.run_case(51007, panda, 8)
    assert max(row.value for row in found) < 1


def test_a_difference_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(script.NATS, "float32", 1e-12)
    monkeypatch.setitem(script.RELATIVE, "float32", 0.0)
    report = script.compare_engines(script.Config(cases=1, states=4, bodies=("arm8",)))
    (row,) = report["failed"]
    assert row["dtype"] == "float32"
    assert row["terms"]


def test_states_at_the_end_of_a_search_window_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    cost, x = script.make_case(2, "body30", 8)
    assert "contour" in {term.name for term in cost.choice.terms}
    monkeypatch.setattr(script, "NEAR_END_PX", 100.0)
    assert not script.apart_from_ends(cost, x).all()
    monkeypatch.setattr(script, "NEAR_END_PX", 0.0)
    assert script.apart_from_ends(cost, x).all()
    assert torch.isfinite(cost.value(x)).all()
