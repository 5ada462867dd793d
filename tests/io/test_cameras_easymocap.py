"""Calibrations of EasyMocap and Pose2Sim, as those programs write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from torchcss.errors import CameraError
from torchcss.io.cameras import read_camera, rotation_matrix
from torchcss.io.video import VideoWriter

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

POSE2SIM = """[cam_01]
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
def folder(tmp_path: Path) -> Path:
    (tmp_path / "intri.yml").write_text(INTRI)
    (tmp_path / "extri.yml").write_text(EXTRI)
    return tmp_path


@pytest.mark.parametrize("name", ["", "intri.yml", "extri.yml"])
def test_easymocap(folder: Path, name: str) -> None:
    found = read_camera(folder / name, camera_name="3")
    assert found.metric
    camera = found.camera
    assert camera.image_size_wh == (1920, 1080)
    assert float(camera.K[1, 1]) == 1303.3885156746885
    expected = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double()
    torch.testing.assert_close(camera.R_camera_world, expected)
    assert camera.t_camera_world.tolist() == [0, 0, 4]


def test_easymocap_without_sizes_takes_the_videos(folder: Path) -> None:
    with pytest.raises(CameraError, match="does not say the image size; give the video"):
        read_camera(folder, camera_name="2")
    with VideoWriter(folder / "2.mp4", 25) as film:
        film.write(np.zeros((108, 192, 3), np.uint8))
    found = read_camera(folder, video=folder / "2.mp4")
    assert found.camera.name == "2"
    assert found.camera.image_size_wh == (192, 108)
    assert found.camera.distortion[:2].tolist() == [0.1, -0.02]
    turn = rotation_matrix(np.array([1.2, 0.4, -0.3]))
    np.testing.assert_allclose(found.camera.R_camera_world, turn)


def test_easymocap_without_extrinsics(folder: Path) -> None:
    (folder / "extri.yml").unlink()
    found = read_camera(folder, camera_name="3")
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
def test_bad_files(folder: Path, name: str, old: str, new: str, words: str) -> None:
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new))
    with pytest.raises(CameraError, match=words) as caught:
        read_camera(folder, camera_name="3")
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)


def test_pose2sim_of_a_recording(shared_data: Path, tmp_path: Path) -> None:
    """What its authors published lies within 30 mm and 2 degrees of the refined calibration."""
    (tmp_path / "Calib.toml").write_text(POSE2SIM)
    published = read_camera(tmp_path / "Calib.toml")
    assert published.metric
    refined = read_camera(
        shared_data / "balance_beam_4cam" / "cameras.json", camera_name="cam01"
    ).camera
    gap = published.camera.centre_world - refined.centre_world
    assert float(gap.norm()) < 0.03
    turn = published.camera.R_camera_world @ refined.R_camera_world.T
    assert float(torch.rad2deg(torch.acos((turn.trace() - 1) / 2))) < 2.0
