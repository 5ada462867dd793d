"""What a user gets wrong on a script's command line is one line of an error, not a traceback."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest

from torchcss.errors import TorchcssError

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
NOWHERE = Path("/nonexistent")


@pytest.mark.parametrize("path", sorted(SCRIPTS.glob("*.py")), ids=lambda path: path.stem)
def test_every_script_prints_its_errors_and_explains_itself(path: Path) -> None:
    _, ending = path.read_text(encoding="utf-8").split('if __name__ == "__main__":')
    assert "except TorchcssError as error:" in ending
    assert "tyro.cli(Config, description=__doc__)" in ending


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("track_robot", {"robot": "foo"}, "no robot 'foo'; there are panda"),
        ("track_robot", {"data": NOWHERE}, "panda.urdf: there is no such file"),
        ("track_quadruped", {"urdf": NOWHERE / "a.urdf"}, "a.urdf: there is no such file"),
        ("inverse_kinematics", {"data": NOWHERE}, "ur5.urdf: there is no such file"),
        ("inverse_kinematics", {"cases": ("foo",)}, r"no cases \['foo'\]; there are ur5"),
        ("table1", {"body": "foo"}, "no body 'foo'; expected one of"),
        ("table1", {"pose": NOWHERE / "pose.json"}, "pose.json: there is no such file"),
        ("sampler_slices", {"body": "foo"}, "no body 'foo'; expected one of"),
        ("compare_solvers", {"solvers": ("foo",)}, r"no solvers \['foo'\]; there are torchcss"),
        ("compare_solvers", {"solvers": ("scipy trf",)}, "all are compared with torchcss"),
        ("benchmark", {"frames": (NOWHERE / "a.png", NOWHERE / "b.png")}, "a.png: not an image"),
        ("evaluate_flow", {"data": NOWHERE}, "no folder in it holds flow10.flo"),
    ],
)
def test_bad_choices_are_refused(
    name: str,
    options: dict[str, Any],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(SCRIPTS)
    if name == "inverse_kinematics":
        pytest.importorskip("pytorch_kinematics")
    script = importlib.import_module(name)
    with pytest.raises(TorchcssError, match=message) as caught:
        script.main(script.Config(**options))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [("[1]", "expected an object of parameter names"), ('{"root_x": "far"}', "number")],
)
def test_a_pose_that_is_none(
    content: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(SCRIPTS)
    path = tmp_path / "pose.json"
    path.write_text(content)
    with pytest.raises(TorchcssError, match=message):
        importlib.import_module("table1").read_pose(path)
