"""The tracking of a quadruped from keypoints, on one made here and on ANYmal if it is there."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from made_robots import write_quadruped

from torchcss.studies.render.robots import trot


@pytest.fixture(params=["made here", "ANYmal"])
def urdf(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    if request.param == "made here":
        return write_quadruped(tmp_path / "quadruped.urdf")
    path = request.getfixturevalue("shared_data") / "robot_models" / "anymal_b.urdf"
    if not path.is_file():
        pytest.skip("ANYmal is not in the shared data")
    return path


def test_three_cameras_tell_places_in_space(script: ModuleType, urdf: Path, tmp_path: Path) -> None:
    out = tmp_path / "out" / "quadruped.json"
    tracking = replace(script.TRACKING, samples=10, working_size=320)
    report = script.main(script.Config(urdf=urdf, frames=2, tracking=tracking, out=out))
    # A pixel and a half of noise at 3.5 m is 6 mm, of three cameras and twelve keypoints.
    assert report["links_mm"] < 9
    assert json.loads(out.read_text())["links_mm"] == pytest.approx(report["links_mm"])


def test_one_camera_tells_depth_less_well(script: ModuleType, tmp_path: Path) -> None:
    urdf = write_quadruped(tmp_path / "quadruped.urdf")
    tracking = replace(script.TRACKING, samples=6, working_size=320)
    report = script.main(script.Config(urdf=urdf, cameras=1, frames=3, tracking=tracking))
    # Depth is known to some 3 cm a frame.
    assert report["links_mm"] < 100


def test_a_trot_moves_diagonal_legs_together_and_obeys_limits(
    script: ModuleType, tmp_path: Path
) -> None:
    body = script.load_quadruped(write_quadruped(tmp_path / "quadruped.urdf"))
    times = torch.linspace(0, 2, 101, dtype=torch.float64)
    states = trot(body, times)
    assert bool(((states >= body.lower) & (states <= body.upper)).all())
    column = {name: states[:, body.state_index(name)] for name in body.state_names}
    knee = {leg: column[f"{leg}_KFE"].abs() for leg in ("LF", "RH", "RF", "LH")}
    torch.testing.assert_close(knee["LF"], knee["RH"])
    assert float((knee["LF"] - knee["RF"]).abs().max()) > 0.3
    # It walks the way that it faces: forwards is +Z at first, and it turns to its left, +X.
    place = body.pose(states).joints[:, body.joint_index("base")]
    assert float(place[-1, 2]) > 0.8
    assert float(place[-1, 0]) > 0.1
    # Feet below the hips all the time.
    feet = body.pose(states).joints[:, body.joint_index("LF_FOOT"), 1]
    assert float(feet.max()) < -0.3
