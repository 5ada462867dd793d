"""The fuzz of the engines in its small mode."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import fuzz_engines as script
import pytest
import torch
from torch import Tensor

from torchcss.cost.fused.engine import FusedEngine
from torchcss.cost.total import TrackingCost
from torchcss.types import LocalModel


def test_engines_agree_at_random(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "fuzz.json"
    script.compare_engines(script.Config(cases=5, states=6, out=out))
    assert json.loads(out.read_text())["failed"] == []
    assert "5 cases, 0 differ" in capsys.readouterr().out


def test_parts_that_taper_to_a_point(shared_data: Path) -> None:
    """Next to a tip points are dozens of sections away."""
    panda = str(shared_data / "robot_models" / "panda.urdf")
    found, _ = script.run_case(51007, panda, 8)
    assert not any(row.fails for row in found)


def test_a_lens_that_throws_points_far_away() -> None:
    """The square of such a pixel is no number in single precision."""
    found, _ = script.run_case(73001043, "body32", 16)
    assert not any(row.fails for row in found)


def test_a_difference_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(script.NATS, "float32", 1e-12)
    monkeypatch.setitem(script.RELATIVE, "float32", 0.0)
    report = script.compare_engines(script.Config(cases=1, states=4, bodies=("arm8",)))
    (row,) = report["failed"]
    assert row["dtype"] == "float32"
    assert row["terms"]


@pytest.mark.parametrize("which", ["value", "derivatives", "held"])
def test_what_is_no_number_differs(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def local_model(self: FusedEngine, cost: TrackingCost, x: Tensor) -> LocalModel:
        found = replace(cost, engine=None).local_model(x)
        if which == "derivatives":
            found = found._replace(hessian=torch.full_like(found.hessian, torch.nan))
        return found

    def value(self: FusedEngine, cost: TrackingCost, x: Tensor, *found_at: Tensor) -> Tensor:
        eager = replace(cost, engine=None)
        found = eager.held_value(x, *found_at) if found_at else eager.value(x)
        return found if which != ("held" if found_at else "value") else torch.nan * found

    monkeypatch.setattr(FusedEngine, "local_model", local_model)
    monkeypatch.setattr(FusedEngine, "value", value)
    monkeypatch.setattr(FusedEngine, "held_value", value)
    double = script.run_case(1, "arm8", 2)[0][0]
    assert double.fails
    assert double.terms


def test_states_at_the_end_of_a_search_window_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    cost, x = script.make_case(2, "body30", 8)
    assert "contour" in {term.name for term in cost.choice.terms}
    monkeypatch.setattr(script, "NEAR_END_PX", 100.0)
    assert not script.apart_from_ends(cost, x).all()
    monkeypatch.setattr(script, "NEAR_END_PX", 0.0)
    assert script.apart_from_ends(cost, x).all()
    assert torch.isfinite(cost.value(x)).all()
