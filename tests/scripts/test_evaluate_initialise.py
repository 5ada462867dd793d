"""The evaluation of initialisation in its small mode."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest


def test_small_mode(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "tables" / "initialise.json"
    script.main(script.Config(small=True, out=out))
    rows = json.loads(out.read_text())["rows"]
    assert [row["variant"] for row in rows] == ["full", "single start"]
    for row in rows:
        assert row["pa_best_mm"] >= row["pa_best_of_7_mm"] >= row["pa_best_of_50_mm"] > 0
        assert row["limit_violations_percent"] == 0
        assert 0 <= row["parameters_inside_percent"] <= 100
        assert row["length_ratio_error_percent"] < 10
        assert row["seconds"] > 0
        assert len(row["per_case"]) == row["count"] == 1
    assert "single start" in capsys.readouterr().out


def test_left_and_right_may_be_fitted_apart(script: ModuleType):
    config = script.Config(small=True)
    ((_, case),) = script.cases(config, "noise 2 px")
    tied, free = (script.loose_body(case, tied=tied) for tied in (True, False))
    assert "thigh_length" in tied.state_names
    assert {"l_thigh_length", "r_thigh_length"} < set(free.state_names)
    x = free.rest.clone()
    x[free.state_index("l_thigh_length")] = 0.02
    assert script.mean_lengths(free, x)["thigh"] == pytest.approx(free.lengths["thigh"] + 0.01)
    for variant in ("sides equal", "sides free"):
        row = script.fit(case, variant, config, 0)
        assert row["pa_best_mm"] < 250
        assert row["length_ratio_error_percent"] < 10


def test_frames_of_the_clips(script: ModuleType, shared_data: Path):
    config = script.Config(data=shared_data, frames=2)
    (first, case), (last, _) = script.cases(config, "beam, camera 1")
    assert (first, last) == (0, 99)
    assert case.joints.shape == (12, 3)
    assert 0.38 < case.lengths["thigh"] < 0.44
    assert case.person is None
