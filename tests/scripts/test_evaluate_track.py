"""The evaluation script on made-up tracks and on a real reference."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from made_tracks import modes_at, writer_of

import torchcss
from torchcss.body.load import load_body
from torchcss.errors import ConfigurationError, ShapeError, TrackFileError
from torchcss.io.tracks import FrameModes, Track, TrackWriter, load_track, save_track
from torchcss.io.view_files import RecordedCamera, ViewFiles
from torchcss.joint_names import LIMB_JOINTS
from torchcss.vision.camera import Camera

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "evaluate_track.py"


def write_track(
    folder: Path,
    joints: np.ndarray,
    names: tuple[str, ...],
    *,
    frames: list[int] | None = None,
    modes: list[int] | None = None,
) -> Path:
    """A track whose modes are at `joints [T K J 3]`; `modes[i]` of them exist in frame i."""
    folder.mkdir(exist_ok=True)
    writer = TrackWriter(folder / "track.npz", Track.empty(("a", "b"), names))
    for row in range(len(joints)):
        k = joints.shape[1] if modes is None else modes[row]
        writer.append(
            FrameModes(
                frame=row if frames is None else frames[row],
                time_s=row / 25,
                state=np.zeros((k, 2)),
                covariance=np.tile(np.eye(2), (k, 1, 1)),
                log_weight=np.log(np.arange(k, 0, -1) / (k * (k + 1) / 2)),
                cost=np.arange(k),
                parent=np.full(k, -1),
                joints_world=joints[row, :k],
            )
        )
    writer.save()
    return folder


def write_reference(path: Path, joints: np.ndarray, names: list[str], **more: object) -> Path:
    arrays = {"joints": joints, "joint_names": np.array(names), **more}
    np.savez(path, **{name: np.asarray(array) for name, array in arrays.items()})
    return path


@pytest.fixture
def joints() -> np.ndarray:
    return np.random.default_rng(0).normal(scale=0.4, size=(10, len(LIMB_JOINTS), 3))


def detector_name(name: str) -> str:
    return name[0].upper() + name[2:].capitalize()


def test_frames_names_and_modes_are_matched(
    script: ModuleType, joints: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [detector_name(name) for name in LIMB_JOINTS]  # l_wrist -> LWrist
    order = np.random.default_rng(1).permutation(len(names))
    holes = joints.copy()
    holes[4, LIMB_JOINTS.index("l_wrist")] = np.nan
    reference = write_reference(
        tmp_path / "reference.npz", holes[:, order], [names[i] for i in order], units="m"
    )
    frames = [2, 4, 6, 9]
    tracked = np.stack([joints[frames] + 0.1, joints[frames] + [0.03, 0, 0.04]], axis=1)
    tracked[3, 0] += 5 * joints[9]
    track = write_track(tmp_path / "run", tracked, LIMB_JOINTS, frames=frames, modes=[2, 2, 2, 1])
    out = tmp_path / "table" / "errors.json"
    report = script.main(script.Config(track=track, reference=reference, out=out))
    written = json.loads(out.read_text())
    assert written["num_frames"] == written["num_frames_measured"] == 4
    assert written["num_modes"] == 2
    assert written["frames"] == frames
    assert written["mpjpe_mm"] == report["mpjpe_mm"]
    per_frame = written["per_frame_mm"]
    assert per_frame["mpjpe"][:3] == pytest.approx([1000 * 0.03**0.5] * 3)
    # The mode that only pads the last frame is at the origin: nobody may choose it.
    assert per_frame["mpjpe_best_of_modes"][:3] == pytest.approx([50.0] * 3)
    assert per_frame["mpjpe_best_of_modes"][3] == pytest.approx(per_frame["mpjpe"][3])
    assert per_frame["root_aligned_mpjpe"][:3] == pytest.approx([0.0] * 3, abs=1e-9)
    assert per_frame["pa_mpjpe"] == pytest.approx([0.0] * 4, abs=1e-9)  # the last is scaled only
    assert written["frames_lost"] == [9]
    assert written["num_frames_lost"] == 1
    assert set(written["per_joint_mm"]["pa_mpjpe"]) == set(LIMB_JOINTS)
    assert "left out" not in (table := capsys.readouterr().out)
    assert "l_wrist" in table
    assert "1 of 4 measured frames lost" in table
    assert "world frame" in table


def test_joints_array_and_root_can_be_chosen(
    script: ModuleType, joints: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm = ("l_shoulder", "l_elbow", "l_wrist")
    index = [LIMB_JOINTS.index(name) for name in arm]
    reference = write_reference(
        tmp_path / "r.npz", joints + 1, list(LIMB_JOINTS), joints_smooth=joints
    )
    track = write_track(tmp_path / "run", joints[:, None, index] + 0.01, arm)
    config = script.Config(
        track=track / "track.npz",
        reference=reference,
        reference_array="joints_smooth",
        root="LShoulder",
        joints=("left_wrist", "l_elbow", "nose"),
    )
    report = script.main(config)
    assert report["joint_names"] == ("l_wrist", "l_elbow")
    assert report["joints_left_out"] == ("nose",)
    assert report["mpjpe_mm"] == pytest.approx(10 * 3**0.5)
    assert report["root_aligned_mpjpe_mm"] == pytest.approx(0.0, abs=1e-9)
    assert "left out, not in both: nose" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"joints": ("nose",)}, ConfigurationError, "no common joints"),
        ({"root": "nose"}, ConfigurationError, "--root"),
        ({"reference_array": "joint"}, TrackFileError, "--reference-array"),
        ({"reference_array": "joint_names"}, TrackFileError, "expected numbers of the shape"),
        ({"reference_array": "nothing"}, ShapeError, "all is NaN"),
        ({"reference_array": "short"}, ConfigurationError, "has 5 frames"),
        ({"reference": Path("absent.npz")}, TrackFileError, "no such file"),
        ({"track": Path("absent")}, TrackFileError, "no such file"),
        ({"out": Path()}, ConfigurationError, "found a folder"),
    ],
)
def test_bad_input_is_a_typed_error(
    script: ModuleType,
    joints: np.ndarray,
    tmp_path: Path,
    change: dict[str, object],
    error: type[Exception],
    message: str,
) -> None:
    reference = write_reference(
        tmp_path / "r.npz",
        joints,
        list(LIMB_JOINTS),
        nothing=np.full_like(joints, np.nan),
        short=joints[:5],
    )
    track = write_track(tmp_path / "run", joints[:, None], LIMB_JOINTS)
    options = {"track": track, "reference": reference, **change}
    with pytest.raises(error, match=message) as caught:
        script.main(script.Config(**options))
    assert "\n" not in str(caught.value)


def test_calibration_is_told_of_a_run_that_knows_its_body(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Errors drawn from the stated covariance lie inside its regions as often as they should."""
    generator = torch.Generator().manual_seed(0)
    body, count = load_body("body34", dtype=torch.float64), 300
    n = body.num_parameters
    # Where the whole body is, in depth above all, is not what errors from the hips are of.
    root = torch.tensor([0.04, 0.04, 0.09, 1e-8, 1e-8, 1e-8])
    spread = torch.diag(torch.cat([root, torch.full((n - 6,), 4e-4)]).double())
    writer = writer_of(body, tmp_path / "track.npz")
    for row in range(count):
        writer.append(modes_at(body, row, body.rest[None], spread))
    writer.save()
    noise = torch.randn(count, n, generator=generator, dtype=torch.float64) @ spread.sqrt()
    joints = body.pose(body.rest + noise).joints.numpy()
    reference = write_reference(tmp_path / "r.npz", joints, list(body.joint_names))
    shares = torchcss.evaluate(tmp_path, reference, deviation_m=0.001).inside()
    assert set(shares) == {0.5, 0.9, 0.95}
    # Limbs' ends move on surfaces, whose third direction has no error.
    assert 0.5 < shares[0.5] < 0.85
    assert 0.85 < shares[0.9] < 1
    report = script.main(script.Config(track=tmp_path, reference=reference))
    assert report["inside"]["90 %"] >= shares[0.9]
    assert "inside the stated regions" in capsys.readouterr().out


def test_a_run_in_other_axes_is_turned_as_a_whole(
    script: ModuleType, joints: np.ndarray, tmp_path: Path
) -> None:
    """One turn for all frames: what is wrong within it stays wrong, and mirrors stay mirrors."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) @ np.diag([1.0, -1, -1])
    off = joints + np.random.default_rng(0).normal(scale=0.02, size=joints.shape)
    off[0, 0] = np.nan
    reference = write_reference(tmp_path / "r.npz", off, list(LIMB_JOINTS))
    straight = write_track(tmp_path / "straight", joints[:, None], LIMB_JOINTS)
    moved = write_track(tmp_path / "moved", joints[:, None] @ turn.T, LIMB_JOINTS)
    wanted = torchcss.evaluate(straight, reference).errors.root_aligned.mean_mm
    assert torchcss.evaluate(moved, reference).errors.root_aligned.mean_mm > 10 * wanted
    for track in (straight, moved):
        found = torchcss.evaluate(track, reference, turned=True).errors
        assert found.root_aligned.mean_mm == pytest.approx(wanted, rel=0.02)
    report = script.main(script.Config(track=moved, reference=reference, turned=True))
    assert report["root_aligned_mpjpe_mm"] == pytest.approx(wanted, rel=0.02)
    mirrored = write_track(tmp_path / "mirrored", joints[:, None] * [-1, 1, 1], LIMB_JOINTS)
    assert torchcss.evaluate(mirrored, reference, turned=True).errors.root_aligned.mean_mm > wanted


def test_stated_regions_turn_with_the_run(tmp_path: Path) -> None:
    """Thin regions along one axis of the camera hold errors along that axis of the world."""
    body = load_body("body34", dtype=torch.float64)
    spread = 1e-8 * torch.eye(body.num_parameters, dtype=torch.float64)
    spread[body.state_index("root_yaw")] *= 1e5
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    writer = writer_of(body, tmp_path / "track.npz")
    writer.append(modes_at(body, 0, body.rest[None], spread))
    writer.save()
    places = body.pose(body.rest[None]).joints.numpy() @ turn.T
    reference = write_reference(tmp_path / "r.npz", places, list(body.joint_names))
    straight, turned = (torchcss.evaluate(tmp_path, reference, turned=t) for t in (False, True))
    assert straight.covariance is not None
    assert turned.covariance is not None
    np.testing.assert_allclose(turned.covariance, turn @ straight.covariance @ turn.T, atol=1e-12)


def test_other_units_are_refused(script: ModuleType, joints: np.ndarray, tmp_path: Path) -> None:
    reference = write_reference(tmp_path / "r.npz", joints, list(LIMB_JOINTS), units="mm")
    track = write_track(tmp_path / "run", joints[:, None], LIMB_JOINTS)
    with pytest.raises(TrackFileError, match="expected metres"):
        script.main(script.Config(track=track, reference=reference))


def test_command_line(
    joints: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    track = write_track(tmp_path / "run", joints[:, None], LIMB_JOINTS)
    reference = write_reference(tmp_path / "r.npz", joints, list(LIMB_JOINTS))
    command = [str(SCRIPT), str(track), str(reference), "--joints"]
    monkeypatch.setattr(sys, "argv", [*command, "l_wrist", "l_knee", "r_ankle"])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    assert "r_ankle" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", [*command, "nose"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith("error: no common joints")


def test_real_reference(script: ModuleType, shared_data: Path, tmp_path: Path) -> None:
    """A track that is the smoothed reference is a few millimetres from the raw one."""
    path = shared_data / "balance_beam_4cam" / "reference3d.npz"
    with np.load(path) as arrays:
        smooth = arrays["joints_smooth"]
        names = tuple(str(name) for name in arrays["joint_names"])
    track = write_track(tmp_path / "run", smooth[:, None], names)
    report = script.main(script.Config(track=track, reference=path))
    assert len(report["joint_names"]) == 12
    assert report["num_frames"] == report["num_frames_measured"] == 100
    assert report["num_frames_lost"] == 0
    assert 0 < report["pa_mpjpe_mm"] < report["mpjpe_mm"] < 30


def test_its_detector_is_a_peer(
    script: ModuleType, joints: np.ndarray, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Points in a camera's axes, turned against the world's, of which one frame has none."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    points = (1.02 * joints[:3] - [1, 2, 3]) @ turn.T
    points[1] = np.nan
    places = np.random.default_rng(2).uniform(5, 40, (3, 1, len(LIMB_JOINTS), 2))
    path = files / "found.npz"
    np.savez(
        path,
        keypoints=places,
        confidence=np.ones(places.shape[:3]),
        joint_names=np.array(LIMB_JOINTS),
        points=points[:, None],
    )
    camera = Camera(np.diag([60.0, 60.0, 1.0]), (64, 48), R_camera_world=turn)
    seen = RecordedCamera(camera, ViewFiles(video=files / "video.mp4", keypoints=path))
    tracked = joints[:3] + np.random.default_rng(3).normal(scale=0.05, size=joints[:3].shape)
    track = write_track(files / "run", tracked[:, None], LIMB_JOINTS)
    save_track(track / "track.npz", load_track(track / "track.npz")._replace(cameras=(seen,)))
    reference = write_reference(files / "r.npz", joints, list(LIMB_JOINTS))
    report = script.main(script.Config(track=track, reference=reference))
    assert report["detector"]["num_frames"] == 2
    assert report["detector"]["pa_mpjpe_mm"] == pytest.approx(0, abs=1e-6)
    assert 0 < report["detector"]["root_aligned_mpjpe_mm"] < 40
    assert report["num_frames"] == 3
    assert "its detector" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("stated", "found"), [(None, 0.02), (np.array(0.0), 0.005), (np.array(0.03), 0.03)]
)
def test_references_say_how_far_they_are_off(
    joints: np.ndarray, tmp_path: Path, stated: np.ndarray | None, found: float
) -> None:
    more = {} if stated is None else {"deviation_m": stated}
    reference = write_reference(tmp_path / "r.npz", joints, list(LIMB_JOINTS), **more)
    track = write_track(tmp_path / "run", joints[:, None], LIMB_JOINTS)
    assert torchcss.evaluate(track, reference).deviation_m == found
    assert torchcss.evaluate(track, reference, deviation_m=0.01).deviation_m == 0.01


@pytest.mark.parametrize("stated", [np.array(-1.0), np.array(np.nan), np.zeros(3)])
def test_no_deviation_is_refused(joints: np.ndarray, tmp_path: Path, stated: np.ndarray) -> None:
    reference = write_reference(tmp_path / "r.npz", joints, list(LIMB_JOINTS), deviation_m=stated)
    track = write_track(tmp_path / "run", joints[:, None], LIMB_JOINTS)
    with pytest.raises(TrackFileError, match="deviation_m: expected a number of metres"):
        torchcss.evaluate(track, reference)
