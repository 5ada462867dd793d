"""The retargeting script: what it writes, what reads it, and how it refuses."""

from __future__ import annotations

import json
import math
import runpy
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from made_tracks import export_as, modes_at, writer_of

from torchcss import load_body
from torchcss.errors import ConfigurationError, MotionCaptureError, OutputError
from torchcss.io.motion.positions import LIMB_JOINTS
from torchcss.studies.sequences import read_reference

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture(scope="module")
def motion(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A BVH of our own: ten frames at 20 Hz of a body that turns and bends its arms."""
    body = load_body("body34", lengths={"thigh": 0.41})
    writer = writer_of(body)
    for index in range(10):
        state = body.bounds.project(body.sticky_mean.clone())
        state[body.state_index("root_yaw")] = 0.2 * index
        state[body.state_index("root_y")] = 0.9
        state[body.state_index("l_elbow_flexion")] = 0.5 + 0.1 * math.sin(0.5 * index)
        for side in "lr":
            state[body.state_index(f"{side}_shoulder_raising")] = 0.6
        writer.append(modes_at(body, index, state[None], torch.eye(len(state)), rate=20.0))
    folder = tmp_path_factory.mktemp("motion")
    done = export_as(writer.track(), to="bvh", out=folder, frame="world")
    return done.paths[0]


def test_files_and_table(
    script: ModuleType, motion: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, reference = tmp_path / "new" / "motion.npz", tmp_path / "reference.npz"
    report, picture = tmp_path / "report.json", tmp_path / "picture.png"
    config = script.Config(
        file=motion, out=out, reference=reference, report=report, picture=picture,
        rate=40, start=0.1, stop=0.3,
    )  # fmt: skip
    script.main(config)
    with np.load(out) as arrays:
        found = {name: arrays[name] for name in arrays.files}
    lengths = json.loads(str(found["lengths"]))
    assert lengths["thigh"] == pytest.approx(0.41, abs=2e-3)
    body = load_body(str(found["body"]), lengths=lengths)
    assert tuple(found["state_names"]) == body.state_names
    assert found["states"].shape == (8, body.num_parameters)
    assert float(found["frame_rate"]) == 40
    assert float(found["start_s"]) == 0.1
    assert str(found["source"]) == motion.name
    base = torch.from_numpy(found["base_transform"])
    body = body.with_base(base[:3, :3], base[:3, 3])
    joints = body.pose(torch.from_numpy(found["states"])).joints
    np.testing.assert_allclose(joints, found["joints_world"], atol=1e-12)
    assert tuple(found["joint_names"]) == body.joint_names
    assert found["error_mm"].shape == (8,)
    assert found["error_mm"].max() < 5

    positions, names = read_reference(reference, "joints")
    assert set(names) == {*LIMB_JOINTS, "HumanoidRoot", "vt1"}
    index = body.joint_columns(names)
    assert 1000 * np.linalg.norm(positions - joints[:, index].numpy(), axis=-1).mean() < 10
    with np.load(reference) as arrays:
        assert float(arrays["frame_rate"]) == 40

    written = json.loads(report.read_text())
    table = capsys.readouterr().out
    for name in (*LIMB_JOINTS, "all"):
        row = written["error_mm"][name]
        assert row["mean"] <= row["worst"]
        assert name in table
    assert written["num_frames"] == 8
    assert written["frames_per_second"] > 0
    assert set(written["share_of_frames_at_limit"]) <= set(body.state_names)
    assert "unit: m" in table
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_units_and_rate_of_the_file(script: ModuleType, motion: Path, tmp_path: Path) -> None:
    """A file that lies about both."""
    out = tmp_path / "motion.npz"
    options = {"units": "0.95", "source_rate": 10.0, "rate": 10.0, "stop": 0.3}
    report = script.main(script.Config(file=motion, out=out, **options))
    assert report["num_frames"] == 3
    assert report["lengths_m"]["shank"] == pytest.approx(0.95 * 0.421, abs=2e-3)


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"body": "arm7"}, ConfigurationError, "body30"),
        ({"start": 7.0}, ConfigurationError, "expected a part"),
        ({"rate": 0.0}, ConfigurationError, "rate"),
        ({"units": "ell"}, ConfigurationError, "units"),
        ({"file": Path("absent.bvh")}, MotionCaptureError, "no such file"),
        ({"file": Path("motion.amc")}, MotionCaptureError, "ASF"),
        ({"report": Path()}, ConfigurationError, "found a folder"),
        ({"out": Path("/proc/none/motion.npz")}, OutputError, "cannot be written"),
    ],
)
def test_bad_input(
    script: ModuleType, motion: Path, tmp_path: Path, options: dict, error: type, match: str
) -> None:
    config = script.Config(**{"file": motion, "out": tmp_path / "motion.npz", **options})
    with pytest.raises(error, match=match) as caught:
        script.main(config)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "motion.npz").exists()


def test_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "motion.bvh"
    path.write_text("HIERARCHY\nROOT Hips\n{\n")
    script = str(SCRIPTS / "retarget.py")
    monkeypatch.setattr(sys, "argv", [script, str(path), "--out", str(tmp_path / "m.npz")])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(script, run_name="__main__")
    assert ended.value.code == 2
    place = f"error: {path}: line 3: expected OFFSET, found 'the end of the file'"
    assert capsys.readouterr().err == f"{place}; get a complete copy\n"
