"""Calibration files: which camera, in which unit, for which images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchcss.errors import CameraError
from torchcss.io.calibrations.read import read_entries
from torchcss.io.cameras import (
    camera_findings,
    check_image_size,
    load_camera,
    read_camera,
    read_cameras,
    rotation_matrix,
)
from torchcss.io.video import VideoWriter
from torchcss.vision.camera import Camera

K = [[800.0, 0.0, 319.5], [0.0, 810.0, 239.5], [0.0, 0.0, 1.0]]
VECTOR = [0.3, -1.2, 0.7]
R = Rotation.from_rotvec(VECTOR).as_matrix().tolist()


def entry(**more: Any) -> dict[str, Any]:
    values = {
        "video": "a.mp4", "image_size_wh": [640, 480], "K": K,
        "distortion": [0.1, -0.2, 0.001, 0.002, 0.05], "R": R, "t": [0.1, 0.2, 3.0],
    }  # fmt: skip
    values.update(more)
    return {key: value for key, value in values.items() if value is not None}


def write(path: Path, cameras: Any, units: str | None = "metre, pixel") -> Path:
    content = {"cameras": cameras} | ({} if units is None else {"units": units})
    path.write_text(json.dumps(content))
    return path


POSE2SIM = """
[cam_01]
name = "cam_01"
size = [ 640.0, 480.0,]
matrix = [ [ 800.0, 0.0, 319.5,], [ 0.0, 810.0, 239.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.1, -0.2, 0.001, 0.002,]
rotation = [ 0.3, -1.2, 0.7,]
translation = [ 0.1, 0.2, 3.0,]
fisheye = false

[cam_02]
name = "cam_02"
size = [ 1280.0, 720.0,]
matrix = [ [ 900.0, 0.0, 640.0,], [ 0.0, 900.0, 360.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ 0.0, 0.0, 0.0, 0.0, 0.0,]
rotation = [ 0.0, 0.0, 0.0,]
translation = [ 0.0, 0.0, 0.0,]
fisheye = true

[metadata]
adjusted = false
error = 0.0
"""


def test_json_camera(tmp_path: Path) -> None:
    loaded = load_camera(write(tmp_path / "a.json", {"one": entry()}))
    camera = loaded.camera
    assert (loaded.metric, loaded.units_note) == (True, None)
    assert camera.name == "one"
    assert tuple(camera.image_size_wh) == (640, 480)
    torch.testing.assert_close(camera.K, torch.tensor(K, dtype=camera.K.dtype))
    torch.testing.assert_close(
        camera.R_camera_world, torch.tensor(R, dtype=camera.R_camera_world.dtype)
    )
    assert camera.t_camera_world.tolist() == pytest.approx([0.1, 0.2, 3.0])
    assert camera.distortion.tolist() == pytest.approx([0.1, -0.2, 0.001, 0.002, 0.05])


def test_distortion_may_be_absent_or_short(tmp_path: Path) -> None:
    camera = load_camera(write(tmp_path / "a.json", {"one": entry(distortion=None)})).camera
    assert camera.distortion.tolist() == [0.0] * 5
    camera = load_camera(write(tmp_path / "a.json", {"one": entry(distortion=[1, 0, 0, 0])})).camera
    assert camera.distortion.tolist() == [1.0, 0, 0, 0, 0]


@pytest.mark.parametrize("units", ["metre, pixel", "meters", "m", " Metres , px"])
def test_metres(tmp_path: Path, units: str) -> None:
    assert load_camera(write(tmp_path / "a.json", {"one": entry()}, units)).metric


@pytest.mark.parametrize(
    ("units", "factor"), [("mm, pixel", 0.001), ("Centimetres", 0.01), (0.015, 0.015), (2, 2.0)]
)
def test_other_units_that_are_said(tmp_path: Path, units: Any, factor: float) -> None:
    metres = load_camera(write(tmp_path / "a.json", {"one": entry()})).camera
    found = load_camera(write(tmp_path / "b.json", {"one": entry()}, units))
    assert (found.metric, found.units_note) == (True, None)
    torch.testing.assert_close(found.camera.t_camera_world, factor * metres.t_camera_world)
    torch.testing.assert_close(found.camera.R_camera_world, metres.R_camera_world)


@pytest.mark.parametrize(
    ("units", "more", "words"),
    [
        ("board square, pixel", {}, "'board square'"),
        ("inch", {}, "'inch'"),
        (-1.0, {}, "unknown unit"),
        (None, {}, "unknown unit"),
        ("metre", {"R": None}, "no extrinsics"),
        ("metre", {"t": None}, "no extrinsics"),
    ],
)
def test_own_frame_where_the_world_is_not_metric(
    tmp_path: Path, units: str | None, more: dict[str, Any], words: str
) -> None:
    loaded = load_camera(write(tmp_path / "a.json", {"one": entry(**more)}, units))
    assert not loaded.metric
    assert loaded.units_note is not None
    assert words in loaded.units_note
    assert "own frame" in loaded.units_note
    torch.testing.assert_close(loaded.camera.R_camera_world, torch.eye(3).to(loaded.camera.K))
    assert not loaded.camera.t_camera_world.any()
    torch.testing.assert_close(loaded.camera.K, torch.tensor(K, dtype=loaded.camera.K.dtype))


def test_choice_of_the_camera(tmp_path: Path) -> None:
    cameras = {
        "left": entry(video="a.mp4"),
        "right": entry(video="b.mp4"),
        "cam_03": entry(video=None),
    }
    path = write(tmp_path / "a.json", cameras)
    assert load_camera(path, video="somewhere/b.mp4").camera.name == "right"
    assert load_camera(path, video="somewhere/cam03.mov").camera.name == "cam_03"
    assert load_camera(path, video="a.mp4", name="right").camera.name == "right"
    with pytest.raises(CameraError, match=r"several cameras, left, right, cam_03"):
        load_camera(path)
    with pytest.raises(CameraError, match=r"c\.mp4.*left, right, cam_03"):
        load_camera(path, video="c.mp4")
    with pytest.raises(CameraError, match=r"no camera 'up'.*left, right, cam_03"):
        load_camera(path, name="up")
    twice = write(tmp_path / "b.json", {"left": entry(), "right": entry()})
    with pytest.raises(CameraError, match="no single camera"):
        load_camera(twice, video="a.mp4")
    single = write(tmp_path / "c.json", {"only": entry()})
    assert load_camera(single, video="other.mp4").camera.name == "only"
    with pytest.raises(CameraError, match="no camera"):
        load_camera(single, name="other")


def test_pose2sim(tmp_path: Path) -> None:
    path = tmp_path / "Calib.toml"
    path.write_text(POSE2SIM)
    loaded = load_camera(path, video="cam01.mp4")
    expected = Camera(
        K, (640, 480), distortion=[0.1, -0.2, 0.001, 0.002, 0.0],
        R_camera_world=R, t_camera_world=[0.1, 0.2, 3.0],
    )  # fmt: skip
    assert (loaded.metric, loaded.camera.name) == (True, "cam_01")
    points = torch.randn(7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(loaded.camera.project(points).uv, expected.project(points).uv)
    with pytest.raises(CameraError, match=r"cam_02.*fisheye"):
        load_camera(path, name="cam_02")


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3.6, 3.6), min_size=3, max_size=3))
def test_rotation_vector_against_scipy(vector: list[float]) -> None:
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_matrix(np.array(vector)), expected, atol=1e-12)


def test_image_size() -> None:
    camera = Camera(K, (1080, 1920), name="cam")
    check_image_size(camera, 1080, 1920)
    with pytest.raises(CameraError, match=r"1080 x 1920.*540 x 960.*resized\(540, 960\)"):
        check_image_size(camera, 540, 960)
    with pytest.raises(CameraError, match=r"K's first two rows by 0\.5 "):
        check_image_size(camera, 540, 960)
    with pytest.raises(CameraError, match="another scale"):
        check_image_size(camera, 360, 641)
    with pytest.raises(CameraError, match=r"1080 x 1920.*1920 x 1080.*right angle"):
        check_image_size(camera, 1920, 1080)
    with pytest.raises(CameraError, match=r"1080 x 1920.*1088 x 1920.*another shape"):
        check_image_size(camera, 1088, 1920)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"K": [[2.0, 0, 320], [0, 2, 240], [0, 0, 1]]}, "sees 179 degrees"),
        ({"K": [[90000.0, 0, 320], [0, 90000, 240], [0, 0, 1]]}, "degrees"),
        ({"K": [[800.0, 0, -320], [0, 800, 240], [0, 0, 1]]}, "outside the image"),
        ({"distortion": [-3.5, 0, 0, 0, 0]}, "distortion reaches"),
        ({"distortion": [0.02, -0.03, 0.05, -0.01]}, "tangential distortion"),
        ({"t": [100.0, 200.0, 3000.0]}, "stands 3008 m"),
    ],
)
def test_cameras_that_look_odd(tmp_path: Path, more: dict[str, Any], words: str) -> None:
    path = write(tmp_path / "a.json", {"one": entry()})
    assert camera_findings(load_camera(path).camera) == []
    path = write(tmp_path / "b.json", {"one": entry(**more)})
    (line,) = camera_findings(load_camera(path).camera)
    assert "camera 'one' looks odd" in line
    assert words in line


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"K": None}, "K"),
        ({"K": [[1, 0], [0, 1]]}, "K"),
        ({"K": "a"}, "K"),
        ({"K": [[1, 0, 0], [0, 1]]}, "K"),
        ({"K": [[float("nan"), 0, 0], [0, 1, 0], [0, 0, 1]]}, "K"),
        ({"K": [[-5, 0, 0], [0, 1, 0], [0, 0, 1]]}, "."),
        ({"image_size_wh": None}, "image_size_wh"),
        ({"image_size_wh": [640]}, "image size"),
        ({"image_size_wh": [640.5, 480]}, "whole"),
        ({"image_size_wh": [0, 480]}, "."),
        ({"image_size_wh": [float("inf"), 480]}, "image size"),
        ({"distortion": [0.1] * 8}, "distortion of 8"),
        ({"distortion": [float("nan")] * 5}, "distortion"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "."),
        ({"R": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "."),
        ({"R": [[1, 0], [0, 1]]}, "."),
        ({"R": [float("nan"), 0, 0]}, "rotation"),
        ({"t": [1, 2]}, "t"),
        ({"t": [1, 2, float("nan")]}, "t"),
        ({"t": [1, 2, True]}, "translation: expected numbers"),
    ],
)  # fmt: skip
def test_bad_values(tmp_path: Path, more: dict[str, Any], words: str) -> None:
    path = write(tmp_path / "a.json", {"one": entry(**more)})
    with pytest.raises(CameraError, match=words) as caught:
        load_camera(path)
    message = str(caught.value)
    assert message.count(f"{path}: ") == 1  # a command may name it, too
    assert "one" in message
    assert "\n" not in message


@pytest.mark.parametrize("content", ["", "{", "[]", "3", '{"cameras": 3}', '{"cameras": {}}',
                                     '{"cameras": {"a": 3}}'])  # fmt: skip
def test_bad_json(tmp_path: Path, content: str) -> None:
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(CameraError, match=r"a.json"):
        load_camera(tmp_path / "a.json")


@pytest.mark.parametrize(
    "content", ["", "a = [", "[metadata]\nerror = 1.0", "[a]\nname = 3", "\xff", '[a]\nname="b"',
                '[a]\nname="c"\n[b]\nname="c"', "a = " + "[" * 5000]
)  # fmt: skip
def test_bad_toml(tmp_path: Path, content: str) -> None:
    (tmp_path / "a.toml").write_bytes(content.encode("latin-1"))
    with pytest.raises(CameraError, match=r"a.toml"):
        load_camera(tmp_path / "a.toml")


def test_missing(tmp_path: Path) -> None:
    for name in ("a.json", "a.toml"):
        with pytest.raises(CameraError, match="no such file"):
            load_camera(tmp_path / name)
        (tmp_path / "folder" / name).mkdir(parents=True)
        with pytest.raises(CameraError):
            load_camera(tmp_path / "folder" / name)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_only_camera_errors_come_from_bad_bytes(tmp_path: Path, data: st.DataObject) -> None:
    good = write(tmp_path / "good.json", {"one": entry()}).read_bytes()
    content = bytearray(data.draw(st.sampled_from([good, POSE2SIM.encode()])))
    for _ in range(data.draw(st.integers(0, 8))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    del content[data.draw(st.integers(0, len(content))) :]
    path = tmp_path / data.draw(st.sampled_from(["a.json", "a.toml"]))
    path.write_bytes(content)
    message = ""
    try:
        loaded = load_camera(path, video="cam01.mp4")
    except CameraError as error:
        message = str(error)
    else:
        assert loaded.camera.K.isfinite().all()
    assert "\n" not in message


@pytest.mark.parametrize(
    ("video", "metric"),
    [
        ("balance_beam_4cam/cam01.mp4", True),
        ("balance_beam_4cam/cam03.mp4", True),
        ("handheld_board/cam_2.mp4", True),
        ("rendered_turn/video.mp4", True),
        ("arm_pointing/cam0.mp4", False),
        ("walk_sit_mono/cam0.mp4", False),
    ],
)
def test_real_calibrations(shared_data: Path, video: str, metric: bool) -> None:
    path = shared_data / video
    loaded = load_camera(path.parent / "cameras.json", video=path)
    entries = read_entries(path.parent / "cameras.json")
    assert entries[loaded.camera.name].video == path.name
    assert loaded.metric is metric
    assert ("board square" in (loaded.units_note or "")) is not metric
    values = json.loads((path.parent / "cameras.json").read_text())["cameras"][loaded.camera.name]
    check_image_size(loaded.camera, *values["image_size_wh"])
    if metric:
        torch.testing.assert_close(
            loaded.camera.centre_world,
            torch.tensor(values["centre_world"], dtype=torch.float64),
            atol=1e-6,
            rtol=0.0,
        )


def test_real_calibration_needs_a_name(shared_data: Path) -> None:
    with pytest.raises(CameraError, match="cam01, static_cam01, cam03, static_cam03"):
        load_camera(shared_data / "balance_beam_4cam" / "cameras.json")


def test_all_cameras_of_a_file(tmp_path: Path) -> None:
    path = write(tmp_path / "a.json", {"left": entry(), "right": entry(video="b.mp4", R=None)})
    cameras = read_cameras(path)
    assert list(cameras) == ["left", "right"]
    for name, camera in cameras.items():
        assert camera.name == name
        assert torch.equal(camera.K, read_camera(path, name).K)
    assert not cameras["right"].t_camera_world.any()


# The first two cameras of a file of others (the numbers of a data set for A-NeRF).
INTRI = """%YAML:1.0
---
names:
   - "2"
   - "3"
K_2: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1.2705470221290213e+03, 0., 960., 0., 1.2918693479263814e+03,
       540., 0., 0., 1. ]
dist_2: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.1, -0.02, 0., 0., 0. ]
K_3: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1.2803090021884900e+03, 0., 960., 0., 1.3033885156746885e+03,
       540., 0., 0., 1. ]
dist_3: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
H_3: 1080.
W_3: 1920.
"""
EXTRI = """%YAML:1.0
---
names:
   - "2"
   - "3"
R_2: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 1.2, 0.4, -0.3 ]
T_2: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 0.1, 0.9, 3.2 ]
Rot_3: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 0., -1., 0., 1., 0., 0., 0., 0., 1. ]
T_3: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 0., 0., 4. ]
"""

RECORDED = """[cam_01]
name = "cam_01"
size = [ 1088.0, 1920.0]
matrix = [ [ 1681.244873046875, 0.0, 532.97369384375],
 [ 0.0, 1681.075439453125, 948.137390140625], [ 0.0, 0.0, 1.0]]
distortions = [ -0.000721609375, 0.002187234375, 9.5e-06, 1.078125e-05]
rotation = [ 1.6882754799999993, 1.0483220499999997, -0.41955852000000016]
translation = [ 0.3211048899999996, 0.9563320600000009, 2.8907130499999996]
fisheye = false

[metadata]
adjusted = false
error = 0.0
"""


@pytest.fixture
def easymocap(tmp_path: Path) -> Path:
    (tmp_path / "intri.yml").write_text(INTRI)
    (tmp_path / "extri.yml").write_text(EXTRI)
    return tmp_path


@pytest.mark.parametrize("name", ["", "intri.yml", "extri.yml"])
def test_easymocap(easymocap: Path, name: str) -> None:
    found = load_camera(easymocap / name, name="3")
    assert found.metric
    camera = found.camera
    assert camera.image_size_wh == (1920, 1080)
    assert float(camera.K[1, 1]) == 1303.3885156746885
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    torch.testing.assert_close(camera.R_camera_world, expected)
    assert camera.t_camera_world.tolist() == [0, 0, 4]


def test_easymocap_in_millimetres(easymocap: Path) -> None:
    """The unit is that of the board that somebody typed."""
    (easymocap / "extri.yml").write_text(EXTRI.replace("0., 0., 4. ]", "100., 200., 4000. ]"))
    found = load_camera(easymocap, name="3")
    np.testing.assert_allclose(found.camera.t_camera_world, [0.1, 0.2, 4])
    assert "millimetres" in str(found.units_note)


def test_easymocap_without_sizes_takes_the_videos(easymocap: Path) -> None:
    with pytest.raises(CameraError, match="does not say the image size; give the video"):
        load_camera(easymocap, name="2")
    with VideoWriter(easymocap / "2.mp4", 25) as film:
        film.write(np.zeros((108, 192, 3), np.uint8))
    found = load_camera(easymocap, video=easymocap / "2.mp4")
    assert found.camera.name == "2"
    assert found.camera.image_size_wh == (192, 108)
    assert found.camera.distortion[:2].tolist() == [0.1, -0.02]
    turn = rotation_matrix(np.array([1.2, 0.4, -0.3]))
    np.testing.assert_allclose(found.camera.R_camera_world, turn)


def test_easymocap_without_extrinsics(easymocap: Path) -> None:
    (easymocap / "extri.yml").unlink()
    found = load_camera(easymocap, name="3")
    assert not found.metric
    assert "no extrinsics" in str(found.units_note)


@pytest.mark.parametrize(
    ("name", "old", "new", "words"),
    [
        ("intri.yml", INTRI, "", "empty"),
        ("intri.yml", INTRI, "names: [", "cannot be read as YAML"),
        ("intri.yml", INTRI, "- 1", "expected names"),
        ("intri.yml", INTRI, "a: 1", "expected 'names'"),
        ("intri.yml", 'names:\n   - "2"', "names:\n   - [2]", "expected 'names'"),
        ("intri.yml", "rows: 3", "rows: 4", "line 5: an opencv-matrix of 4 rows"),
        ("intri.yml", "960.", "wide", "K: expected numbers"),
        ("intri.yml", "960.", ".nan", "camera 3: "),
        ("intri.yml", "!!opencv-matrix", "!!python/object:os.system", "cannot be read as YAML"),
        ("intri.yml", "K_3", "K_4", "K .matrix. is missing"),
        ("intri.yml", "W_3: 1920.", "W_3: 1920.5", "image size"),
        ("extri.yml", "[ 0., 0., 4. ]", "[ 0., 0. ]", "opencv-matrix of 3 rows"),
        ("extri.yml", "[ 0., -1., 0., 1.,", "[ 0., -1., 0., 7.,", "camera 3: "),
    ],
)  # fmt: skip
def test_bad_easymocap(easymocap: Path, name: str, old: str, new: str, words: str) -> None:
    text = (easymocap / name).read_text()
    assert old in text
    (easymocap / name).write_text(text.replace(old, new))
    with pytest.raises(CameraError, match=words) as caught:
        load_camera(easymocap, name="3")
    assert "\n" not in str(caught.value)
    assert str(easymocap) in str(caught.value)


def test_pose2sim_of_a_recording(shared_data: Path, tmp_path: Path) -> None:
    """What its authors published lies within 30 mm and 2 degrees of the refined calibration."""
    (tmp_path / "Calib.toml").write_text(RECORDED)
    published = load_camera(tmp_path / "Calib.toml")
    assert published.metric
    refined = load_camera(shared_data / "balance_beam_4cam" / "cameras.json", name="cam01").camera
    gap = published.camera.centre_world - refined.centre_world
    assert float(gap.norm()) < 0.03
    turn = published.camera.R_camera_world @ refined.R_camera_world.T
    assert float(torch.rad2deg(torch.acos((turn.trace() - 1) / 2))) < 2.0
