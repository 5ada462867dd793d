"""Keypoints named as the links of a robot, or as a skeleton's."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from made_robots import write_arm

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.errors import KeypointError
from torchcss.io.keypoints.links import joints_named, names_links
from torchcss.io.keypoints.read import read_keypoints

SIZE = (640, 480)
MOTION_BUILDER = {  # LeftShoulder is the collar bone's
    "LeftShoulder": "LeftShoulder", "LeftArm": "l_shoulder", "LeftForeArm": "l_elbow",
    "LeftHand": "l_wrist", "Head": "skullbase", "l_shoulder": "l_shoulder", "l_elbow": "l_elbow",
    "l_wrist": "l_wrist", "skullbase": "skullbase",
}  # fmt: skip


@pytest.fixture(scope="module")
def digger(tmp_path_factory: pytest.TempPathFactory) -> BodyModel:
    path = write_arm(tmp_path_factory.mktemp("robots") / "digger.urdf")
    text = path.read_text()
    for number, name in enumerate(("Löffel 1", "boom.lift", "stick/2", "斗杆", "Arm_A", "arm a")):
        text = text.replace(f'"link{number}"', f'"{name}"')
    path.write_text(text)
    return load_body(path)


def write(path: Path, joints: list[str]) -> Path:
    heading = ",".join(f"{name}_x,{name}_y" for name in joints)
    row = ",".join(f"{100 + 20 * n},{90 + 10 * n}" for n in range(len(joints)))
    path.write_text(f"{heading}\n{row}\n", encoding="utf-8")
    return path


def test_links_as_they_are_spelt_and_otherwise(digger: BodyModel, tmp_path: Path) -> None:
    links = digger.joint_of_name
    assert joints_named(("löffel_1", "Boom Lift", "stick/2", "斗杆"), links) == (
        "Löffel 1", "boom.lift", "stick/2", "斗杆",
    )  # fmt: skip
    # Only exact names tell these apart.
    assert joints_named(("Arm_A", "arm a", "arm-a"), links) == ("Arm_A", "arm a", None)
    assert joints_named(("tip", "Tip", "tap"), links) == ("tip", None, None)
    path = write(tmp_path / "a.csv", ["Löffel 1", "boom_lift", "stick 2", "斗杆", "tap"])
    found = read_keypoints(path, image_size_wh=SIZE, layout=digger)
    assert found.names == ("Löffel 1", "boom.lift", "stick/2", "斗杆", "tap")
    assert "joints that the body has not: tap" in found.report
    torch.testing.assert_close(found.positions[0, 3], torch.tensor([160.0, 120.0]).double())


def test_names_that_the_body_has_not_are_told(digger: BodyModel, tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", ["nose", "tail", "paw"])
    with pytest.raises(KeypointError, match=r"no joint of the body among.*it has Löffel 1, boom"):
        read_keypoints(path, image_size_wh=SIZE, layout=digger)
    path = tmp_path / "clicked.json"
    path.write_text('{"joints": {"Löffel 1": [20, 30], "bom": [40, 40]}}', encoding="utf-8")
    with pytest.raises(KeypointError, match=r"unknown joint 'bom'.*Löffel 1"):
        read_keypoints(path, image_size_wh=SIZE, layout=digger)


def test_a_detector_of_people_names_no_links() -> None:
    assert not names_links(("left_shoulder", "left_elbow", "left_wrist", "nose"), MOTION_BUILDER)
    assert not names_links(("left_shoulder",), {})
    own = ("LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "Head")
    assert names_links(own, MOTION_BUILDER)
    assert joints_named(own, MOTION_BUILDER)[:3] == ("LeftShoulder", "l_shoulder", "l_elbow")
