"""Sequence folders: what is read, from whom, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from made_sequences import NOISE_PX, write_arm

from torchcss.body.load import load_body
from torchcss.errors import CameraError, KeypointError, TrackFileError, VideoError
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.studies.sequences import read_motion, read_sequence

T = 3


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SyntheticSequence]:
    folder = tmp_path_factory.mktemp("sequences") / "arm"
    return folder, write_arm(folder, T)


def test_everything_is_read(made: tuple[Path, SyntheticSequence]) -> None:
    folder, arm = made
    sequence = read_sequence(folder)
    assert sequence.name == "arm"
    assert (sequence.num_frames, sequence.frame_rate) == (T, 25.0)
    assert sequence.keypoint_noise_px == NOISE_PX
    assert sequence.joint_names == sequence.keypoints.names == arm.body.joint_names
    truth, mask = sequence.truth, sequence.mask
    assert truth is not None
    assert mask is not None
    torch.testing.assert_close(truth.body.pose(truth.states).joints, arm.joints_world)
    np.testing.assert_allclose(sequence.joints_world, arm.joints_world.numpy())
    exact = sequence.camera.project(torch.from_numpy(sequence.joints_world)).uv
    assert float((sequence.keypoints.positions - exact).abs().max()) < 5 * NOISE_PX
    # The mask is where the body is: all joints inside the image lie on it.
    assert mask.shape == (T, 480, 640)
    column, row = exact[0].round().long().T.tolist()
    for u, v in zip(column, row, strict=True):
        if 0 <= u < 640 and 0 <= v < 480:
            assert mask[0, v, u]


def copy(folder: Path, to: Path) -> Path:
    shutil.copytree(folder, to)
    return to


def change(path: Path, **arrays: Any) -> None:
    """Replace or, with None, remove arrays of a file."""
    with np.load(path) as old:
        content = {**old, **arrays}
    np.savez(path, **{name: np.asarray(a) for name, a in content.items() if a is not None})


def test_what_a_recording_lacks_is_none(
    made: tuple[Path, SyntheticSequence], tmp_path: Path
) -> None:
    folder = copy(made[0], tmp_path / "bare")
    (folder / "truth.npz").unlink()
    (folder / "mask.npz").unlink()
    change(folder / "keypoints2d.npz", in_image=None, noise_px=None)
    sequence = read_sequence(folder)
    assert sequence.truth is sequence.mask is sequence.keypoint_noise_px is None


def test_joints_outside_the_image_are_missing(
    made: tuple[Path, SyntheticSequence], tmp_path: Path
) -> None:
    folder = copy(made[0], tmp_path / "outside")
    inside = np.ones((T, 4), bool)
    inside[1, 2] = False
    change(folder / "keypoints2d.npz", in_image=inside)
    marks = read_sequence(folder).keypoints
    assert marks.confidence.tolist() == inside.astype(float).tolist()
    assert marks.positions[1, 2].tolist() == [0, 0]


def test_a_view_of_several(made: tuple[Path, SyntheticSequence], tmp_path: Path) -> None:
    folder = copy(made[0], tmp_path / "views")
    for name in ("video.mp4", "keypoints2d.npz", "mask.npz"):
        file = folder / name
        stem = "cam01" if name == "video.mp4" else f"{file.stem}_cam01"
        file.rename(folder / f"{stem}{file.suffix}")
    sequence = read_sequence(folder, view="cam01")
    assert sequence.name == "views:cam01"
    assert sequence.mask is not None
    with pytest.raises(VideoError, match="has the views cam01: choose one"):
        read_sequence(folder)


@pytest.mark.parametrize(
    ("file", "arrays", "error", "message"),
    [
        ("keypoints2d.npz", {"in_image": np.ones((T, 3), bool)}, KeypointError, "in_image"),
        ("keypoints2d.npz", {"noise_px": -1.0}, KeypointError, "one positive number"),
        ("keypoints2d.npz", {"keypoints": None}, KeypointError, "keypoints"),
        ("reference3d.npz", {"units": "mm"}, TrackFileError, "expected metres"),
        ("reference3d.npz", {"joints": np.zeros((T + 1, 4, 3))}, TrackFileError, "as many frames"),
        ("reference3d.npz", {"joint_names": None}, TrackFileError, "joint_names missing"),
        ("mask.npz", {"mask": np.zeros((T, 48, 64), bool)}, TrackFileError, "480, 640"),
        ("mask.npz", {"mask": np.zeros((T, 480, 640))}, TrackFileError, "truth values"),
        ("truth.npz", {"states": None}, TrackFileError, "states missing"),
        ("truth.npz", {"states": np.zeros((T, 7))}, TrackFileError, "states: expected numbers"),
        ("truth.npz", {"states": np.full((T, 8), np.nan)}, TrackFileError, "finite"),
        ("truth.npz", {"state_names": [*"abcdefgh"]}, TrackFileError, "those of arm8"),
        ("truth.npz", {"body": "octopus"}, TrackFileError, "no body 'octopus'"),
        ("truth.npz", {"lengths": "[1]"}, TrackFileError, "no motion of a body of ours"),
        ("truth.npz", {"lengths": "{"}, TrackFileError, "no motion of a body of ours"),
    ],
)
def test_bad_files_are_typed_errors(
    made: tuple[Path, SyntheticSequence],
    tmp_path: Path,
    file: str,
    arrays: dict[str, Any],
    error: type[Exception],
    message: str,
) -> None:
    folder = copy(made[0], tmp_path / "bad")
    change(folder / file, **arrays)
    with pytest.raises(error, match=message) as caught:
        read_sequence(folder)
    assert "\n" not in str(caught.value)
    assert file in str(caught.value)


@pytest.mark.parametrize(
    ("file", "error"),
    [
        ("video.mp4", VideoError),
        ("cameras.json", CameraError),
        ("keypoints2d.npz", KeypointError),
        ("reference3d.npz", TrackFileError),
    ],
)
def test_missing_files_are_typed_errors(
    made: tuple[Path, SyntheticSequence], tmp_path: Path, file: str, error: type[Exception]
) -> None:
    folder = copy(made[0], tmp_path / "lacking")
    (folder / file).unlink()
    with pytest.raises(error, match=f"{file}: there is no such"):
        read_sequence(folder)


def test_no_folder_and_a_camera_without_a_world(
    made: tuple[Path, SyntheticSequence], tmp_path: Path
) -> None:
    with pytest.raises(VideoError, match="is no folder"):
        read_sequence(tmp_path / "absent")
    folder = copy(made[0], tmp_path / "lost")
    path = folder / "cameras.json"
    calibration = json.loads(path.read_text())
    del calibration["cameras"]["cam01"]["R"]
    path.write_text(json.dumps(calibration))
    with pytest.raises(CameraError, match="the reference's world"):
        read_sequence(folder)


@pytest.mark.parametrize(
    ("name", "view", "frames", "joints"),
    [
        ("rendered_turn", None, 103, 14),
        ("rendered_upper_body", None, 98, 14),
        ("balance_beam_4cam", "cam01", 100, 25),
    ],
)
def test_recordings_of_others(
    shared_data: Path, name: str, view: str | None, frames: int, joints: int
) -> None:
    sequence = read_sequence(shared_data / name, view=view)
    assert sequence.joints_world.shape == (frames, joints, 3)
    assert sequence.truth is None
    assert (sequence.mask is None) == (view is not None)
    # Reference, camera and 2D joints belong together.
    names = [n for n in ("l_wrist", "r_ankle", "l_hip") if n in sequence.joint_names]
    for joint in names:
        points = torch.from_numpy(sequence.joints_world[:, sequence.joint_names.index(joint)])
        column = sequence.keypoints.names.index(joint)
        seen = (sequence.keypoints.confidence[:, column] > 0.5) & points.isfinite().all(-1)
        away = sequence.camera.project(points[seen]).uv - sequence.keypoints.positions[seen, column]
        if bool(seen.any()):
            assert float(away.norm(dim=-1).median()) < 0.01 * max(sequence.camera.image_size_wh)


def test_a_motion_file_is_read_as_it_was_meant(tmp_path: Path) -> None:
    body = load_body("body34", lengths={"thigh": 0.4})
    base = torch.eye(4, dtype=torch.float64)
    base[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
    arrays = {
        "body": np.array("body34"),
        "state_names": np.array(body.state_names),
        "states": np.zeros((5, body.num_parameters)),
        "frame_rate": np.array(60.0),
        "lengths": np.array(json.dumps({"thigh": 0.4})),
        "base_transform": base.int().numpy(),
        "description": np.array("standing"),
    }
    np.savez(tmp_path / "file.npz", **arrays)
    motion = read_motion(tmp_path / "file.npz")
    assert motion.body.lengths == body.lengths
    assert motion.body.base_translation.tolist() == [1.0, 2.0, 3.0]
    assert (len(motion.states), motion.frame_rate, motion.description) == (5, 60.0, "standing")
    for change, message in (
        ({"states": None}, "states missing"),
        ({"body": np.array("body99")}, "no body 'body99'"),
        ({"state_names": np.array(("a", "b"))}, "state_names: expected those of body34"),
        ({"states": np.zeros((5, 3))}, "frames', 34\\]"),
        ({"frame_rate": np.array(0.0)}, "positive frame_rate"),
        ({"lengths": np.array("no json")}, "no motion of a body of ours"),
        ({"base_transform": np.diag([2.0, 1, 1, 1])}, "broken.npz: no motion.*a rotation"),
        ({"base_transform": np.full((4, 4), np.inf)}, "broken.npz: no motion.*a rotation"),
        (
            {"base_transform": base.numpy() + np.diag([0, 0, 0, np.nan])},
            "base_transform: expected finite",
        ),
    ):
        broken = {k: v for k, v in {**arrays, **change}.items() if v is not None}
        np.savez(tmp_path / "broken.npz", **broken)
        with pytest.raises(TrackFileError, match=message):
            read_motion(tmp_path / "broken.npz")
