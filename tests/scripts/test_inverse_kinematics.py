"""The study of inverse kinematics in its small mode, on arms made here."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest
import torch
from made_robots import SIX, write_arm


@pytest.fixture
def study(script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The script, on arms made here."""
    write_arm(tmp_path / "six.urdf", SIX)
    write_arm(tmp_path / "seven.urdf")
    cases = {
        "six": ("six.urdf", "tip", None),
        "seven, one fixed": ("seven.urdf", "tip", "joint3"),
        "seven": ("seven.urdf", "tip", None),
    }
    monkeypatch.setattr(script, "CASES", cases)
    return script


def small(study: ModuleType, folder: Path, **options):
    search = study.Search(num_samples=64, patience=2, spacing=0.2)
    return study.Config(
        data=folder, cases=tuple(study.CASES), poses=1, restarts=100, search=search, **options
    )


def test_small_mode(study: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "tables" / "study.json"
    report = study.main(small(study, tmp_path, repeats=1, out=out))
    for case in report["cases"].values():
        assert case["solutions"] >= 1
        assert case["recall"] == 1
        assert case["error"] < 1e-6
        assert case["our_error"] < 1e-10
        assert case["peer_solutions"] > 0
        low, middle, high = case["ratio_quantiles"]
        assert 0 < low <= middle <= high
    saved = json.loads(out.read_text())["cases"]
    assert saved["six"]["reference"] == report["cases"]["six"]["reference"]
    assert "rate over peer" in capsys.readouterr().out


def test_a_welded_joint_keeps_the_poses(study: ModuleType, tmp_path: Path) -> None:
    config = small(study, tmp_path)
    problem = study.make_problem(config, "seven, one fixed", 3)
    assert list(problem.fixed) == ["joint3"]
    chain = problem.chain()
    assert "joint3" not in chain.get_joint_parameter_names()
    generator = torch.Generator().manual_seed(3)
    share = torch.rand(7, generator=generator, dtype=torch.float64)
    x = problem.body.lower + share * (problem.body.upper - problem.body.lower)
    assert problem.fixed["joint3"] == float(x[2])
    pose = chain.forward_kinematics(x[None, problem.columns]).get_matrix()[0]
    assert float((pose - problem.pose).abs().max()) < 1e-6
