"""The slices by terms in their small mode."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest
from made_sequences import write_arm

from torchcss.studies.sequences import read_sequence


def test_small_mode(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "slices"
    script.main(script.Config(small=True, out=out))
    report = json.loads((out / "cost_slices.json").read_text())
    assert list(report["frames"]) == ["arm, frame 3"]
    frame = report["frames"]["arm, frame 3"]
    assert (out / "slices_arm_frame_3.png").stat().st_size > 10_000
    drawn = (out / "limit_arm_frame_3.png").exists()
    assert drawn == (frame["displaced_minimum"] is not None)
    lines = [row["line"] for row in frame["slices"] if row["scale"] == "far"]
    assert lines == ["r_shoulder_swing", "r_elbow_flexion", "eigen 0", "eigen 1", "eigen 7"]
    names = set(frame["slices"][0]["terms"])
    assert {"contour", "flow", "stabiliser", "sum"} <= names
    for row in frame["slices"]:
        low, high = row["interval"]
        assert low <= 0 <= high
        if row["scale"] == "close":
            assert max(-low, high) <= 4.0 * row["deviation"] * (1 + 1e-9)
        for term in row["terms"].values():
            assert term["num_minima"] <= term["num_minima_raw"]
            # A sample more between two may be in a dip, and parts their difference otherwise.
            assert term["largest_jump"] <= 1.0
            assert term["largest_jump"] <= 2 * term["largest_jump_twice_density"] * (1 + 1e-9)
    table = {(row["term"], row["scale"]): row for row in frame["table"]}
    # Smooth terms: what is left of their steepest steps is nothing.
    for name in ("flow", "stabiliser"):
        assert table[name, "far"]["discontinuity"] < 1e-3
    # The mode is a minimum of the sum, and the slices are no noise, which would have a minimum at
    # every third of the 51 samples; with seeds 0 to 4 they have 3.8 to 7.4.
    assert 1 <= table["sum", "close"]["num_minima"] < 51 / 5
    first, *lines = report["table"]["rows"]
    assert first[:2] == ["arm, frame 3, mean of all lines", table["sum", "close"]["num_minima_raw"]]
    assert [row[0] for row in lines] == [f"arm, frame 3, eigen {k}" for k in (0, 1)]
    printed = capsys.readouterr().out
    assert all(name in printed for name in names)


def test_real_frames_are_left_out_without_data(script: ModuleType) -> None:
    assert script.Config().data is None
    assert script.Config(small=True, data=Path("absent")).small


def test_frames_are_those_at_the_papers_times(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_arm(tmp_path, 4)
    monkeypatch.setattr(script, "arm_scenes", lambda *_, **__: iter(()))
    rate = read_sequence(tmp_path).frame_rate
    config = script.Config(sequence=tmp_path, times=(1 / rate, 3 / rate))
    names = [scene.name for scene in script.scenes(config)]
    assert names == [f"{tmp_path.name}, frame {frame}" for frame in (1, 3)]
