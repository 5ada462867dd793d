"""Joints of one picture from every kind of file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from torchcss.errors import KeypointError
from torchcss.io.keypoints.mediapipe import MEDIAPIPE_NAMES
from torchcss.io.keypoints.one_image import read_joints
from torchcss.joint_names import ALIASES

SIZE = (640, 480)


def test_csv_with_and_without_heading(tmp_path: Path):
    path = tmp_path / "joints.csv"
    rows = "left wrist, 10.5, 20\n\nr_knee,30,40,0.5\nnose,,\n"
    for text in (rows, "joint,u,v,confidence\n" + rows):
        path.write_text(text)
        found = read_joints(path, image_size_wh=SIZE)
        assert found.names == ("l_wrist", "r_knee", "nose")
        assert found.positions.tolist() == [[10.5, 20], [30, 40], [0, 0]]
        assert found.confidence.tolist() == [1, 0.5, 0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("a,b,c\n", "nothing below it"),
        ("l_wrist,10,20\ntentacle,10,20\n", "unknown joint 'tentacle'"),
        ("l_wrist,1\n", "row 1"),
        ("l_wrist,1,2\nr_wrist,1,x\n", "row 2"),
        ("l_wrist,1O,2\nr_wrist,1,2\n", "row 1: .* found 'l_wrist, 1O, 2'"),
        ("l_wrist,1,inf\n", "row 1"),
        ("l_wrist,10,20\nleft_wrist,10,20\n", "'left_wrist', or it is there twice"),
    ],
)
def test_spoilt_csv(tmp_path: Path, text: str, message: str):
    (tmp_path / "joints.csv").write_text(text)
    with pytest.raises(KeypointError, match=message):
        read_joints(tmp_path / "joints.csv", image_size_wh=SIZE)


DEEPLABCUT = (
    "scorer,net,net,net,net,net,net\n"
    "bodyparts,l_hip,l_hip,l_hip,r_knee,r_knee,r_knee\n"
    "coords,x,y,likelihood,x,y,likelihood\n"
    "0,100,200,0.9,300,400,0.5\n"
)
WIDE = "frame,l_hip_x,l_hip_y,l_hip_conf,r_knee_x,r_knee_y,r_knee_conf\n0,100,200,0.9,300,400,0.5\n"


@pytest.mark.parametrize("text", [DEEPLABCUT, WIDE])
def test_other_csv_goes_to_its_reader(tmp_path: Path, text: str):
    path = tmp_path / "joints.csv"
    path.write_text(text)
    found = read_joints(path, image_size_wh=SIZE)
    assert found.names == ("l_hip", "r_knee")
    assert found.positions.tolist() == [[100, 200], [300, 400]]
    assert found.confidence.tolist() == [0.9, 0.5]


@pytest.mark.parametrize("named", [True, False])
def test_csv_of_landmarks(tmp_path: Path, named: bool):
    """A row for each of MediaPipe's, of which the catalogue knows some."""
    path = tmp_path / "joints.csv"
    rows = [f"{name if named else i},0.5,0.25,-0.1,0.8" for i, name in enumerate(MEDIAPIPE_NAMES)]
    path.write_text("\n".join(["landmark,x,y,z,visibility", *rows]))
    found = read_joints(path, image_size_wh=SIZE)
    assert len(found.names) == len(MEDIAPIPE_NAMES)
    assert found.positions[found.names.index("l_wrist")].tolist() == [319.5, 119.5]


def test_rows_of_joints_may_be_fractions(tmp_path: Path):
    path = tmp_path / "joints.csv"
    path.write_text("l_wrist,0.5,0.5\n")
    with pytest.raises(KeypointError, match="--normalised zero-one"):
        read_joints(path, image_size_wh=SIZE)
    found = read_joints(path, image_size_wh=SIZE, normalised="zero-one")
    assert found.positions.tolist() == [[319.5, 239.5]]


def test_mediapipe(tmp_path: Path):
    rows = [{"x": 0.5, "y": i / 33, "z": 0.1, "visibility": 0.9} for i in range(33)]
    for content in (rows, {"landmarks": rows}):
        path = tmp_path / "pose.json"
        path.write_text(json.dumps(content))
        found = read_joints(path, image_size_wh=SIZE)
        wrist = found.names.index("l_wrist")
        assert wrist == ALIASES["MediaPipe-33"].index("l_wrist")
        np.testing.assert_allclose(found.positions[wrist], [319.5, 480 * wrist / 33 - 0.5])
        assert float(found.confidence[wrist]) == 0.9
    for spoilt in (
        rows[:5],
        [{**row, "x": "left"} for row in rows],
        [{**rows[0], "x": 1e400}] * 33,
    ):
        path.write_text(json.dumps(spoilt))
        with pytest.raises(KeypointError, match=r"pose\.json"):
            read_joints(path, image_size_wh=SIZE)


def test_other_formats_go_to_their_reader(tmp_path: Path):
    path = tmp_path / "clicked.json"
    path.write_text(json.dumps({"joints": {"l_wrist": [100, 200], "r_hip": [150, 220, 0.7]}}))
    found = read_joints(path, image_size_wh=SIZE)
    assert found.names == ("l_wrist", "r_hip")
    person = np.tile([[320.0, 240.0, 1.0]], (25, 1)) + np.arange(25)[:, None] * [[3, 4, 0]]
    path.write_text(json.dumps({"people": [{"pose_keypoints_2d": person.flatten().tolist()}]}))
    assert "l_wrist" in read_joints(path, image_size_wh=SIZE, layout="BODY_25").names


def test_coco_detections_of_a_picture_with_any_number(tmp_path: Path):
    person = np.tile([[320.0, 240.0, 0.9]], (17, 1)) + np.arange(17)[:, None] * [[3, 4, 0]]
    row = {"category_id": 1, "keypoints": person.flatten().tolist(), "score": 0.8}
    path = tmp_path / "detections.json"
    for number in (0, 1, 785, "000785.jpg"):
        path.write_text(json.dumps([{**row, "image_id": number}]))
        found = read_joints(path, image_size_wh=SIZE)
        wrist = found.names.index("l_wrist")
        assert found.positions[wrist].tolist() == person[wrist, :2].tolist()
    path.write_text(json.dumps([{**row, "image_id": number} for number in (1, 2)]))
    with pytest.raises(KeypointError, match="nobody in the first frame"):
        read_joints(path, image_size_wh=SIZE)


def test_numbers_that_leave_out_a_day_are_refused_before_they_take_memory(tmp_path: Path):
    path, wrist = tmp_path / "a.json", {"l_wrist": [100, 200]}
    path.write_text(json.dumps({"frames": {"0": wrist, "900000": wrist}}))
    with pytest.raises(KeypointError, match="2 frames are in the file, the last is number 900000"):
        read_joints(path, image_size_wh=SIZE)


def test_a_picture_with_any_number_that_somebody_annotated(tmp_path: Path):
    path, size = tmp_path / "a.json", {"original_width": 640, "original_height": 480}
    value = {"x": 50, "y": 25, "keypointlabels": ["left_wrist"]}
    mark = {"type": "keypointlabels", "value": value, **size}
    point = {"shape_attributes": {"name": "point", "cx": 319.5, "cy": 119.5},
             "region_attributes": {"joint": {"left_wrist": True}}}  # fmt: skip
    for content in (
        [{"data": {"image": "s3://bucket/p7.jpg"}, "annotations": [{"result": [mark]}]}],
        {"p7.jpg9": {"filename": "p7.jpg", "regions": [point]}},
    ):
        path.write_text(json.dumps(content))
        found = read_joints(path, image_size_wh=SIZE)
        assert found.names == ("l_wrist",)
        assert found.positions.tolist() == [[319.5, 119.5]]
