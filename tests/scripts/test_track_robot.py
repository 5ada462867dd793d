"""The tracking of a robot in its small mode, on an arm made here and on one of the data folder."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from made_robots import write_arm

from torchcss.errors import ConfigurationError


def test_small_mode(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = script.main(
        script.Config(
            urdf=write_arm(tmp_path / "seven.urdf"),
            link="tip",
            frames=2,
            tracking=replace(script.Config().tracking, samples=6, modes=2, working_size=240),
            out=tmp_path / "out",
        )
    )
    (row,) = report["runs"]
    # Two frames after a first pose from exact lengths and marks of 1.5 pixels.
    assert row["best"]["links_mm"] < 40
    assert row["nearest"]["links_mm"] <= row["best"]["links_mm"]
    assert set(row["best"]["joints_degrees"]) == {f"joint{n}" for n in range(1, 8)}
    assert len(row["best"]["end_effector_mm_by_frame"]) == 2
    assert "seed" in capsys.readouterr().out
    for name in ("track.npz", "overlay.mp4", "video.mp4", "summary.json"):
        assert (tmp_path / "out" / "seed0" / name).stat().st_size > 0
    saved = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert saved["runs"][0]["best"]["links_mm"] == pytest.approx(row["best"]["links_mm"])


def test_robots_of_the_data_folder_swing_within_their_limits(
    script: ModuleType, shared_data: Path
) -> None:
    from torchcss.studies.render.robots import robot_arm, swing

    folder = shared_data / "robot_models"
    if not folder.is_dir():
        pytest.skip("the robots' files are not in the shared data")
    for name, (link, usual) in script.ROBOTS.items():
        middle = torch.tensor(usual, dtype=torch.float64)
        body = robot_arm(folder / f"{name}.urdf", usual=middle)
        body.tree.link_index(link)
        times = torch.linspace(0, 5, 40, dtype=torch.float64)
        states = swing(body, times, generator=torch.Generator().manual_seed(1), middle=middle)
        assert bool(((states >= body.lower) & (states <= body.upper)).all())
        # No joint moves faster than these arms can, 2.2 radians a second.
        assert float((states[1:] - states[:-1]).abs().max() / (5 / 39)) < 2.2


def test_bad_choices_are_told(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="there are panda, iiwa7, ur5"):
        script.main(script.Config(robot="scara", out=tmp_path))
    with pytest.raises(ConfigurationError, match="name its end effector"):
        script.main(script.Config(urdf=tmp_path / "a.urdf", out=tmp_path))
