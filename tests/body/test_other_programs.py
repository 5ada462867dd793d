"""Bodies as other programs write them: what floats, follows, lacks a motion or a declaration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from torchcss.body.load import load_body
from torchcss.errors import BodyError, MotionCaptureError
from torchcss.io.motion.positions import read_motion_capture

JOINT = (
    '<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
    '<origin xyz="0 0 0.3"/><axis xyz="0 1 0"/><limit lower="-1" upper="1.5"/>{more}</joint>'
)


def joint(name: str, parent: str, child: str, kind: str = "revolute", more: str = "") -> str:
    return JOINT.format(name=name, parent=parent, child=child, kind=kind, more=more)


def urdf(folder: Path, *elements: str) -> Path:
    text = "".join(elements)
    links = dict.fromkeys(
        part.split('"')[1] for part in text.split("link=")[1:]
    )  # in the order of their first mention
    path = folder / "a.urdf"
    body = "".join(f'<link name="{link}"/>' for link in links)
    path.write_text(f'<robot name="a">{body}{text}</robot>')
    return path


def mimic(of: str, factor: float = 1.0, offset: float = 0.0) -> str:
    return f'<mimic joint="{of}" multiplier="{factor}" offset="{offset}"/>'


def test_a_floating_joint_is_a_free_root(tmp_path: Path) -> None:
    path = urdf(
        tmp_path,
        joint("base", "world", "trunk", "floating"),
        joint("hip", "trunk", "thigh"),
        joint("pole", "world", "lamp"),
    )
    body = load_body(path)
    assert body.state_names[6:] == ("hip",)
    assert len(body.state_names) == 7
    assert "world" not in body.joint_names
    assert any("lamp" in note for note in body.notes)
    assert load_body(path, free_root=False).state_names == ("hip",)
    below = urdf(tmp_path, joint("a", "base", "b", "fixed"), joint("c", "b", "d", "floating"),
                 joint("hip", "d", "e"))  # fmt: skip
    assert load_body(below).state_names[6:] == ("hip",)
    inside = urdf(tmp_path, joint("a", "base", "b"), joint("c", "b", "d", "floating"))
    with pytest.raises(BodyError, match="floating at the root"):
        load_body(inside)


def test_chains_of_mimic_joints(tmp_path: Path) -> None:
    path = urdf(
        tmp_path,
        joint("one", "a", "b"),
        joint("three", "c", "d", more=mimic("two", 2.0, 0.1)),
        joint("two", "b", "c", more=mimic("one", 0.5, 0.2)),
    )
    body = load_body(path)
    assert body.state_names == ("one",)
    poses = body.pose(torch.tensor([0.4], dtype=torch.float64)).tree
    total = 0.4 + (0.5 * 0.4 + 0.2) + (2 * (0.5 * 0.4 + 0.2) + 0.1)
    place = body.tree.link_names.index("d")
    np.testing.assert_allclose(poses.rotation[place, 0, 0], np.cos(total), atol=1e-12)
    loop = urdf(tmp_path, joint("one", "a", "b", more=mimic("two")),
                joint("two", "b", "c", more=mimic("one")))  # fmt: skip
    with pytest.raises(BodyError, match="in turn"):
        load_body(loop)


def test_a_mimic_joint_of_nothing_is_free(tmp_path: Path) -> None:
    path = urdf(tmp_path, joint("l_a", "a", "b"), joint("l_b", "b", "c", more=mimic("a")))
    body = load_body(path)
    assert body.state_names == ("l_a", "l_b")
    assert any("'l_b' mimics 'a'" in note for note in body.notes)
    path = urdf(tmp_path, joint("a", "a", "b", "fixed"), joint("b", "b", "c", more=mimic("a")),
                joint("c", "c", "d", "fixed", mimic("b")))  # fmt: skip
    assert load_body(path).state_names == ("b",)
    assert [note.rpartition(": it ")[2] for note in load_body(path).notes[1:]] == [
        "is taken as free", "stays fixed",
    ]  # fmt: skip


def test_numbers_in_other_units_are_told(tmp_path: Path) -> None:
    path = urdf(tmp_path, joint("a", "base", "b"), joint("c", "b", "d"))
    assert len(load_body(path).notes) == 1
    path.write_text(path.read_text().replace('"-1" upper="1.5"', '"-90" upper="90"', 1))
    assert "a.urdf: joints whose limits are far apart, ['a']: they" in load_body(path).notes[1]
    path.write_text(path.read_text().replace('xyz="0 0 0.3"', 'xyz="0 0 300"'))
    assert load_body(path).notes[2] == (
        "a.urdf: it reaches 600 m, as its lengths count as metres: write those of a file in "
        "millimetres as metres, or load it in Python by load_body(..., scale=0.001)"
    )


def test_angles_in_degrees_are_told(tmp_path: Path) -> None:
    for angle, is_told in ((1.5708, False), (90, True)):
        text = joint("hip", "base", "thigh").replace("0 0 0.3", f'0 0 0.3" rpy="{angle} 0 0')
        body = load_body(urdf(tmp_path, text))
        assert any("turn more than once around, ['hip']" in note for note in body.notes) == is_told


def test_prefixes_that_nobody_declares(tmp_path: Path) -> None:
    path = urdf(
        tmp_path,
        joint("yaw", "a", "b").replace("<joint ", '<joint xacro:if="1" '),
        "<gazebo><sensor:ray><x:y z:w='1'/></sensor:ray></gazebo>",
    )
    assert load_body(path).state_names == ("yaw",)
    path.write_text(path.read_text().replace("<robot ", '<robot xmlns="http://a" xmlns:x="b" '))
    assert load_body(path).state_names == ("yaw",)


@pytest.mark.parametrize("coefficients", ["0 -1 0 0 0", "0.01 2 0 0 0"])
def test_equality_of_joints(tmp_path: Path, coefficients: str) -> None:
    pytest.importorskip("mujoco")
    path = tmp_path / "a.xml"
    jaw = '<body pos="0 0 .1"><joint name="{0}" type="slide" axis="0 1 0"/><geom size=".1"/></body>'
    path.write_text(
        f"<mujoco><worldbody><body><geom size='0.1'/>{jaw.format('left')}{jaw.format('right')}"
        f"</body></worldbody><equality><joint joint1='right' joint2='left' "
        f"polycoef='{coefficients}'/><connect body1='world' anchor='0 0 0'/></equality></mujoco>"
    )
    offset, factor = map(float, coefficients.split()[:2])
    body = load_body(path)
    assert body.state_names == ("left",)
    joints = body.tie @ torch.tensor([0.3], dtype=torch.float64) + body.offset
    np.testing.assert_allclose(joints, [0.3, offset + 0.3 * factor])
    assert "a.xml: equalities of other things than joints are left out: connect" in body.notes
    path.write_text(path.read_text().replace("0 0 0'/><connect", "5 0 0'/><connect"))
    body = load_body(path)
    assert body.state_names == ("left", "right")
    assert any("'right': its equality is left out" in note for note in body.notes)


def test_soft_bodies_are_told(tmp_path: Path) -> None:
    """MuJoCo refuses the one, and makes joints of every point of the other."""
    pytest.importorskip("mujoco")
    (tmp_path / "a.xml").write_text(
        """<mujoco><worldbody><body><joint name="turn"/><geom size=".02"/>
        <composite prefix="rope" type="cable" curve="s" count="5 1 1" size="1"/>
        <flexcomp name="cloth" type="grid" count="3 3 1" dim="2"><pin id="0 1"/></flexcomp>
        </body></worldbody></mujoco>"""
    )
    body = load_body(tmp_path / "a.xml")
    assert body.state_names == ("turn",)
    assert "a.xml: soft bodies are left out: rope (composite), cloth (flexcomp)" in body.notes


def bvh(up: int = 1, motion: str = "MOTION\nFrames: 1\nFrame Time: 0.04\n{rows}\n") -> str:
    """Somebody who stands along an axis."""

    def offset(side: float, height: float) -> str:
        place = [side, 0.0, 0.0]
        place[up] += height
        return " ".join(map(str, place))

    def limb(names: tuple[str, ...], places: list[str]) -> str:
        text = ""
        for name, place in zip(names, places, strict=True):
            channels = "CHANNELS 3 Zrotation Xrotation Yrotation"
            text += f"JOINT {name}\n{{\nOFFSET {place}\n{channels}\n"
        return text + f"End Site\n{{\nOFFSET {offset(0, 10)}\n}}\n" + "}\n" * len(names)

    text = "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\n"
    text += "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
    for side, sign in (("Left", 10), ("Right", -10)):
        text += limb((f"{side}UpLeg", f"{side}Leg", f"{side}Foot"),
                     [offset(sign, -2), offset(0, -40), offset(0, -40)])  # fmt: skip
    text += limb(("Spine", "Neck", "Head"), [offset(0, 10), offset(0, 40), offset(0, 10)]) + "}\n"
    rows = " ".join(["0"] * 6 + ["0"] * 27)
    return text + motion.format(rows=rows)


@pytest.mark.parametrize(
    "motion",
    [
        "",
        *(f"MOTION\nFrames: 0\n{time}" for time in ("Frame Time: 0.0333\n", "Frame Time: 0\n", "")),
    ],
)
def test_a_skeleton_without_motion(tmp_path: Path, motion: str) -> None:
    path = tmp_path / "a.bvh"
    path.write_text(bvh(motion=motion))
    body = load_body(path)
    assert body.num_parameters == 6 + 27
    assert any("no motion" in note for note in body.notes)
    with pytest.raises(MotionCaptureError, match="without motion"):
        read_motion_capture(path)
    path.write_text(bvh().replace("0.04", "0"))  # of a single pose
    assert read_motion_capture(path).frame_rate == 30


@pytest.mark.parametrize("frames", [0, 2])
def test_a_bvh_whose_positions_are_all_zero(tmp_path: Path, frames: int) -> None:
    """Every joint has six channels, and all positions but the root's are zero."""
    three, six = "CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition "
    rows = "\n".join([" ".join(["0"] * (6 + 54))] * frames)
    motion = f"MOTION\nFrames: {frames}\nFrame Time: 0.04\n{rows}\n"
    path = tmp_path / "a.bvh"
    path.write_text(bvh(motion=motion).replace(three, six))
    body = load_body(path)
    joints = body.pose(torch.zeros(body.num_parameters, dtype=torch.float64)).joints
    gap = joints[body.joint_index("skullbase")] - joints[body.joint_index("l_ankle")]
    assert float(gap[1]) > 0.9
    assert any("positions of joints are all zero" in note for note in body.notes)


def test_a_bvh_of_two_people_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.bvh"
    one = bvh(motion="").partition("\n")[2]
    path.write_text(f"HIERARCHY\n{one}{one.replace('Hips', 'Other')}MOTION\n")
    with pytest.raises(BodyError, match="a second ROOT; save every skeleton"):
        load_body(path)


def test_a_bvh_with_decimal_commas(tmp_path: Path) -> None:
    rows = "MOTION\nFrames: 2\nFrame Time: 0.0333333\n{rows}\n{rows}\n"
    path = tmp_path / "a.bvh"
    path.write_text("\ufeff" + bvh(motion=rows).replace(".", ",").replace("\n", "\r\n"))
    motion = read_motion_capture(path)
    assert motion.frame_rate == 30
    path.write_text(bvh(motion=rows))
    np.testing.assert_array_equal(motion.joints, read_motion_capture(path).joints)


def test_z_up(tmp_path: Path) -> None:
    path = tmp_path / "a.bvh"
    for up in (1, 2):
        path.write_text(bvh(up))
        motion = read_motion_capture(path)
        head, foot = (motion.joint_names.index(name) for name in ("Head", "LeftFoot"))
        height = motion.joints[0, head] - motion.joints[0, foot]
        np.testing.assert_allclose(height / np.linalg.norm(height), [-0.0699, 0.9976, 0], atol=1e-3)
        assert any("Z up" in line for line in motion.report) is (up == 2)
        body = load_body(path)
        joints = body.pose(torch.zeros(body.num_parameters, dtype=torch.float64)).joints
        gap = joints[body.joint_index("skullbase")] - joints[body.joint_index("l_ankle")]
        assert float(gap[1]) > 0.9
    assert read_motion_capture(path, up="y").joints[0, head, 2] > 0.4
    # Somebody who lies, in a file that is Y up.
    path.write_text(bvh(1).replace("\n" + " ".join(["0"] * 33), "\n0 0 0 0 90 0" + " 0" * 27))
    assert not any("Z up" in line for line in read_motion_capture(path).report)
    # Or who stands, in motions of another data set on a skeleton that is Y up at rest.
    told = "the person lies along Z, not at rest: if Z is the file's vertical, say up='z'"
    assert told in read_motion_capture(path).report
    motion = read_motion_capture(path, up="z")
    assert motion.joints[0, head, 1] - motion.joints[0, foot, 1] > 0.9
    assert told not in motion.report
