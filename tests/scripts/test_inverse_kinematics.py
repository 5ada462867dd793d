"""The study of inverse kinematics in its small mode, on arms made here."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from made_robots import SIX, write_arm

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "inverse_kinematics.py"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("inverse_kinematics_study", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "inverse_kinematics_study", module)
    spec.loader.exec_module(module)
    write_arm(tmp_path / "six.urdf", SIX)
    write_arm(tmp_path / "seven.urdf")
    cases = {
        "six": ("six.urdf", "tip", None),
        "seven, one fixed": ("seven.urdf", "tip", "joint3"),
        "seven": ("seven.urdf", "tip", None),
    }
    monkeypatch.setattr(module, "CASES", cases)
    return module


def small(script: ModuleType, folder: Path, **options):
    search = script.Search(num_samples=64, patience=2, spacing=0.2)
    return script.Config(
        data=folder, cases=tuple(script.CASES), poses=1, restarts=100, search=search, **options
    )


def test_small_mode(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "tables" / "study.json"
    report = script.main(small(script, tmp_path, repeats=1, out=out))
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
    assert "100.00%" in capsys.readouterr().out


def test_a_welded_joint_keeps_the_poses(script: ModuleType, tmp_path: Path) -> None:
    config = small(script, tmp_path)
    problem = script.make_problem(config, "seven, one fixed", 3)
    assert list(problem.fixed) == ["joint3"]
    chain = problem.chain()
    assert "joint3" not in chain.get_joint_parameter_names()
    generator = torch.Generator().manual_seed(3)
    share = torch.rand(7, generator=generator, dtype=torch.float64)
    x = problem.body.lower + share * (problem.body.upper - problem.body.lower)
    assert problem.fixed["joint3"] == float(x[2])
    pose = chain.forward_kinematics(x[None, problem.columns]).get_matrix()[0]
    assert float((pose - problem.pose).abs().max()) < 1e-6
