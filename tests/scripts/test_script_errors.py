"""What a user gets wrong on a script's command line is one line of an error, not a traceback."""

from __future__ import annotations

import datetime
import importlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import pytest

from torchcss.errors import TorchcssError

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
NOWHERE = Path("/nonexistent")


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a script may be asked."""

    seed: int = 0
    """A seed."""


@pytest.mark.parametrize("path", sorted(SCRIPTS.glob("*.py")), ids=lambda path: path.stem)
def test_every_script_prints_its_errors_and_explains_itself(path: Path) -> None:
    _, ending = path.read_text(encoding="utf-8").split('if __name__ == "__main__":')
    assert ending == "\n    start(main, Config, __doc__)\n"


def test_an_error_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(config: Options) -> None:
        raise TorchcssError(f"seed {config.seed}: no such luck")

    monkeypatch.setattr("sys.argv", ["script.py", "--seed", "3"])
    with pytest.raises(SystemExit) as left:
        common.start(fails, Options, "A page.")
    assert left.value.code == 2
    assert capsys.readouterr().err == "error: seed 3: no such luck\n"


def test_a_report_says_how_it_was_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", [str(SCRIPTS / "table1.py"), "--seed", "3"])
    table = common.Table("Errors", ("clip", "mm"), [["turn", 12.34], ["beam", math.nan]])
    common.write_report(tmp_path / "new" / "report.json", {"rows": [1]}, table)
    report = json.loads((tmp_path / "new" / "report.json").read_text())
    assert report["command"] == "python scripts/table1.py --seed 3"
    assert report["version"]
    assert datetime.date.fromisoformat(report["date"])
    assert report["table"]["rows"] == [["turn", 12.34], ["beam", None]]
    monkeypatch.setenv("PATH", "")  # without git
    assert common.made_by()["version"] == "unknown"
    table.print()
    assert capsys.readouterr().out == "Errors\nclip    mm\nturn  12.3\nbeam      \n"
    common.write_report(None, {})
    with pytest.raises(TorchcssError, match="expected a file to write, found a folder"):
        common.write_report(tmp_path, {})


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
        ("failure_modes", {"sequence": NOWHERE}, "is no folder"),
        ("cost_slices", {"frame": 0}, r"^frames \[0\]"),
        ("sampler_slices", {"body": "foo"}, "no body 'foo'; expected one of"),
        ("compare_solvers", {"solvers": ("foo",)}, r"no solvers \['foo'\]; there are torchcss"),
        ("compare_solvers", {"solvers": ("scipy trf",)}, "all are compared with torchcss"),
        ("benchmark", {"frames": (NOWHERE / "a.png", NOWHERE / "b.png")}, "a.png: not an image"),
        ("evaluate_flow", {"data": NOWHERE}, "no folder in it holds flow10.flo"),
        ("profile_step", {"device": "mps"}, "expected cpu or cuda, got 'mps'"),
        ("profile_step", {"device": "cuda:99"}, "'cuda:99' is not available here"),
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
