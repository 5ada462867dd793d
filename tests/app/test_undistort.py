"""A film of a fisheye lens is made straight, and is then tracked like any other."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from made_clip import write_film

import torchcss
from torchcss.app.undistort import undistort_video
from torchcss.cli import main as cli
from torchcss.errors import CameraError, KeypointError
from torchcss.io.cameras import load_camera, load_lens
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.io.view_files import ViewFiles

SIZE = (128, 96)
K = [[50.0, 0, 63.5], [0, 50.0, 47.5], [0, 0, 1]]
POINTS = np.array([[0.1, -0.3, 1], [0.3, 0.1, 1], [-0.6, 0.3, 1], [-0.8, -0.2, 1]]) * 2.0
NAMES = ["r_shoulder", "r_elbow", "r_wrist", "r_hand_tip"]


def dots(pixels: np.ndarray) -> np.ndarray:
    rows, columns = np.indices((SIZE[1], SIZE[0]))
    grey = sum(180 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 4.5) for u, v in pixels)
    return np.repeat((20 + np.asarray(grey)).round().astype(np.uint8)[..., None], 3, axis=-1)


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """A film of four dots by a fisheye lens, its calibration and its keypoints."""
    entry = {"K": K, "image_size_wh": SIZE, "fisheye": True, "distortion": [0.02, 0.01, 0, 0]}
    entry |= {"R": np.eye(3).tolist(), "t": [0, 0, 0]}
    (tmp_path / "lens.json").write_text(json.dumps({"units": "m", "cameras": {"wide": entry}}))
    _, lens = load_lens(tmp_path / "lens.json")
    pixels = lens.pixels(POINTS[:, :2] / POINTS[:, 2:])
    write_film(tmp_path / "wide.mp4", [dots(pixels)] * 3)
    np.savez(
        tmp_path / "keypoints.npz",
        keypoints=np.tile(pixels, (3, 1, 1)),
        confidence=np.ones((3, 4)),
        joint_names=NAMES,
    )
    return tmp_path


def files(folder: Path) -> ViewFiles:
    return ViewFiles(video=folder / "wide.mp4", keypoints=folder / "keypoints.npz")


def test_camera_pictures_and_keypoints_agree(recorded: Path) -> None:
    out = recorded / "straight"
    paths, notes = undistort_video(files(recorded), recorded / "lens.json", out)
    assert [path.name for path in paths] == ["wide.mp4", "cameras.json", "wide.npz"]
    assert any("4 names" in note for note in notes)
    loaded = load_camera(out / "cameras.json", video=out / "wide.mp4")
    assert loaded.metric
    assert not loaded.camera.has_distortion
    expected = loaded.camera.project(loaded.camera.K.new_tensor(POINTS)).uv.numpy()
    found = torchcss.read_keypoints(out / "wide.npz", image_size_wh=SIZE, num_frames=3)
    assert list(found.names) == NAMES
    np.testing.assert_allclose(found.positions[1], expected, atol=1e-6)
    image = next(iter(VideoReader(out / "wide.mp4"))).image[..., 1]
    for u, v in expected:
        window = image[round(v) - 3 : round(v) + 4, round(u) - 3 : round(u) + 4].astype(float) - 20
        rows, columns = np.indices(window.shape)
        middle = (columns * window).sum() / window.sum(), (rows * window).sum() / window.sum()
        np.testing.assert_allclose(middle, (u - round(u) + 3, v - round(v) + 3), atol=0.35)


def test_the_command_that_the_refusal_gives(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Refused, made straight as the message says, and tracked as that says."""
    given = ["track", f"{recorded}/wide.mp4", "--keypoints", f"{recorded}/keypoints.npz"]
    small = ["--body", "arm7", "--samples", "3", "--modes", "2", "--no-overlay"]
    out = ["--out", f"{recorded}/out"]
    assert cli.main([*given, "--camera", f"{recorded}/lens.json", *small, *out]) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    folder = recorded / "made straight"
    command = told[told.index("torchcss undistort") : told.index(" makes straight")]
    command = [str(folder) if word == "FOLDER" else word for word in command.split()]
    more = ["--keypoints", f"{recorded}/keypoints.npz", "--fov", "100"]
    assert cli.main([*command[1:], *more]) == 0
    said = shlex.split(capsys.readouterr().out.strip().splitlines()[-1])
    assert said[:3] == ["torchcss", "track", f"{folder / 'wide.mp4'}"]
    assert cli.main([*said[1:], *small, *out]) == 0
    assert float(load_camera(folder / "cameras.json").camera.K[0, 0]) == pytest.approx(
        64 / np.tan(np.radians(50))
    )


def test_frames_keep_their_times(recorded: Path) -> None:
    """Of a film that drops frames the straight one drops as many."""
    times = [0.0, 0.04, 0.12]
    images = [frame.image for frame in VideoReader(recorded / "wide.mp4")]
    with VideoWriter(recorded / "wide.mp4", 25) as film:
        for image, time in zip(images, times, strict=True):
            film.write(image, time)
    paths, notes = undistort_video(files(recorded), recorded / "lens.json", recorded / "straight")
    assert VideoReader(paths[0]).frame_times() == pytest.approx(times, abs=1e-4)
    assert any("variable frame rate" in note for note in notes)


def test_masks_are_made_straight_too(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They cover what they covered."""
    rows, columns = np.indices((SIZE[1], SIZE[0]))
    covered = (np.hypot(columns - 90, rows - 40) < 15)[..., None] & np.ones(3, bool)
    write_film(recorded / "masks.mp4", [255 * covered.astype(np.uint8)] * 3)
    given = ["undistort", f"{recorded}/wide.mp4", "--camera", f"{recorded}/lens.json"]
    more = ["--masks", f"{recorded}/masks.mp4", "--out", f"{recorded}/straight"]
    assert cli.main([*given, *more]) == 0
    path = recorded / "straight" / "wide_masks.mp4"
    assert f"--masks {path}" in capsys.readouterr().out.splitlines()[-1]
    loaded, lens = load_lens(recorded / "lens.json")
    mask = next(iter(VideoReader(path))).image[..., 0] > 127
    found = np.argwhere(mask)[:, ::-1].astype(float)
    assert len(found) > 500
    K_straight = loaded.camera.K.numpy()
    places = (found - K_straight[:2, 2]) / np.diagonal(K_straight)[:2]
    away = np.hypot(*(lens.pixels(places) - (90, 40)).T)
    assert away.max() < 17
    assert away.max() > 13


def test_several_cameras_in_one_folder(recorded: Path) -> None:
    content = json.loads((recorded / "lens.json").read_text())
    content["cameras"]["other"] = {**content["cameras"]["wide"], "t": [0.5, 0, 0]}
    (recorded / "lens.json").write_text(json.dumps(content))
    (recorded / "b").mkdir()
    for name in ("other.mp4", "b/wide.mp4"):
        (recorded / name).write_bytes((recorded / "wide.mp4").read_bytes())
    out = recorded / "straight"
    for name in ("wide", "other", "wide"):
        undistort_video(
            ViewFiles(video=recorded / f"{name}.mp4", keypoints=None), recorded / "lens.json", out
        )
    for name, place in (("wide", 0.0), ("other", -0.5)):
        camera = load_camera(out / "cameras.json", video=out / f"{name}.mp4").camera
        assert (camera.name, float(camera.centre_world[0])) == (name, place)
    files = ViewFiles(video=recorded / "b" / "wide.mp4", keypoints=None, camera_name="other")
    with pytest.raises(CameraError, match=r"wide\.mp4 is camera 'wide' there"):
        undistort_video(files, recorded / "lens.json", out)
    (out / "cameras.json").write_text("[]")
    with pytest.raises(CameraError, match="not of torchcss undistort; name another --out"):
        undistort_video(
            ViewFiles(video=recorded / "wide.mp4", keypoints=None), recorded / "lens.json", out
        )


def test_a_camera_without_a_place_stays_without(recorded: Path) -> None:
    entry = {"K": K, "image_size_wh": SIZE, "dist": [0.1, 0, 0, 0, 0, 0.2, 0, 0]}
    (recorded / "lens.json").write_text(json.dumps(entry))
    with pytest.raises(CameraError, match="torchcss undistort"):
        load_camera(recorded / "lens.json")
    paths, notes = undistort_video(files(recorded), recorded / "lens.json", recorded / "straight")
    assert not load_camera(paths[1]).metric
    assert any("no extrinsics" in note for note in notes)


def test_what_cannot_be_made_straight(recorded: Path) -> None:
    calibration = recorded / "lens.json"
    with pytest.raises(CameraError, match="the folder of the video itself"):
        undistort_video(files(recorded), calibration, recorded)
    with pytest.raises(KeypointError, match=r"none\.npz"):
        undistort_video(
            ViewFiles(video=recorded / "wide.mp4", keypoints=recorded / "none.npz"),
            calibration,
            recorded / "straight",
        )
    assert not (recorded / "straight").exists()
    calibration.write_text(json.dumps({"K": K, "image_size_wh": [64, 48], "fisheye": True}))
    with pytest.raises(CameraError, match="these have 128 x 96"):
        undistort_video(files(recorded), calibration, recorded / "straight")


def test_a_keypoint_that_the_lens_cannot_show_is_left_out(recorded: Path) -> None:
    arrays = dict(np.load(recorded / "keypoints.npz"))
    arrays["keypoints"][1, 3] = [-100.0, -90.0]
    np.savez(recorded / "keypoints.npz", **arrays)
    entry = {"K": K, "image_size_wh": SIZE, "fisheye": True, "distortion": [-0.1, 0, 0, 0]}
    (recorded / "lens.json").write_text(json.dumps(entry))
    paths, notes = undistort_video(files(recorded), recorded / "lens.json", recorded / "straight")
    assert any("1 keypoints are where the lens shows nothing" in note for note in notes)
    found = torchcss.read_keypoints(paths[2], image_size_wh=SIZE)
    assert found.confidence[:, 3].tolist() == [1, 0, 1]
