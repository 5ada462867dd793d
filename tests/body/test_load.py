"""Bodies from files of others: tree, limits and shape against what the files say."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from made_robots import planar_arm
from reference.kinematics import lift_by_autograd
from torch import Tensor

from torchcss.body.chain import JointSpecification
from torchcss.body.files.default_shape import bone_parts, rest_poses, solid_shape, touching_parts
from torchcss.body.files.mesh import mesh_points
from torchcss.body.load import FileOptions, load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, has_root
from torchcss.body.rotations import root_angles
from torchcss.body.surface import implicit
from torchcss.cost.visibility import ContourPredictor
from torchcss.errors import BodyError, ConfigurationError, MissingExtraError
from torchcss.io.motion.positions import read_motion_capture
from torchcss.types import PointCost

FILES = {
    "panda.urdf": 8,
    "iiwa7.urdf": 7,
    "ur5.urdf": 6,
    "anymal_b.urdf": 12,
    "poppy_torso.urdf": 13,
    "humanoid_gym.xml": 21,
    "humanoid_CMU.xml": 62,
    "humanoid_CMU_V2019.xml": 56,
}
"""Parameters of the robots of the shared data; both fingers of panda are one."""

BVH = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftUpLeg
  {
    OFFSET 10 -5 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftLeg
    {
      OFFSET 0 -43 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      JOINT LeftFoot
      {
        OFFSET 0 -42 0
        CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
        End Site
        {
          OFFSET 0 -5 17
        }
      }
    }
  }
  JOINT RightUpLeg
  {
    OFFSET -10 -5 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -43 0
    }
  }
  JOINT Spine
  {
    OFFSET 0 50 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftArm
    {
      OFFSET 18 0 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 60 0 0
      }
    }
    JOINT RightArm
    {
      OFFSET -18 0 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET -60 0 0
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
0 90 0 0 0 0  5 10 0  0 20 0  1 -42 2 0 0 0  -5 0 0  0 10 0  0 0 40  0 0 -40
3 91 0 9 8 7  5 40 0  0 70 0  1 -42 2 0 0 0  -9 0 0  0 20 0  0 0 60  0 0 -50
"""

MJCF = """<mujoco>
  <compiler angle="radian" eulerseq="XYZ"/>
  <default>
    <joint range="-1 2"/>
    <default class="big"><geom type="capsule" size=".05 .1"/><joint axis="0 1 0"/></default>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="base" pos="0 0 1" childclass="big">
      <freejoint/>
      <geom name="trunk" fromto="0 0 0 0 0 .4"/>
      <body name="arm" pos=".1 .2 .3" euler=".3 -.4 .5">
        <joint name="turn" pos="0 0 .1"/>
        <joint name="slide" type="slide" axis="1 0 0" limited="false"/>
        <geom type="box" size=".1 .05 .02" quat="1 0 0 1"/>
        <frame pos="0 0 .2" axisangle="0 0 1 1.2">
          <body name="hand" pos=".1 0 0" xyaxes="0 1 0 -1 0 0">
            <joint name="ball" type="ball" range="0 1.2"/>
            <geom class="main" type="mesh" mesh="thumb"/>
            <body name="tip" pos="0 0 .15"/>
          </body>
        </frame>
      </body>
    </body>
    <body name="table" pos="2 0 0"><geom type="box" size="1 1 1"/></body>
  </worldbody>
</mujoco>
"""

FINGER = """<mujoco><compiler angle="radian"/><worldbody><body name="finger" pos="0 0 .1">
  <joint name="curl" axis="0 1 0" range="0 1.5"/><geom type="mesh" mesh="of some file"/>
  <geom name="tip" size=".01" pos="0 0 .05"/></body></worldbody></mujoco>"""
ATTACHED = """<mujoco><asset><model name="finger" file="finger.xml"/></asset><worldbody>
  <body name="palm"><joint name="turn"/>
  <frame pos="-.1 0 0"><attach model="finger" body="finger" prefix="a_"/></frame>
  <frame pos=".1 0 0"><attach model="finger" body="finger" prefix="b_"/></frame>
  </body></worldbody></mujoco>"""
REPLICATED = """<mujoco><worldbody><body name="palm"><joint name="turn"/>
  <replicate count="3" offset=".1 0 0"><body name="finger"><joint name="curl" axis="0 1 0"/>
  <geom size=".01"/></body></replicate></body></worldbody></mujoco>"""


def robot(shared_data: Path, name: str) -> Path:
    return shared_data / "robot_models" / name


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def random_state(body: BodyModel, generator: torch.Generator) -> Tensor:
    x = torch.randn(2, body.num_parameters, generator=generator, dtype=torch.float64)
    return body.bounds.project(0.3 * x)


def check_lift(body: BodyModel, generator: torch.Generator) -> None:
    """The exact Hessian is that of double backward."""
    x = random_state(body, generator)
    link = torch.randint(len(body.tree.link_names), (9,), generator=generator)
    offset = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    pose = body.pose(x)
    points = body.points_on_links(pose.tree, link, offset)
    square = torch.randn(9, 3, 3, generator=generator, dtype=torch.float64)
    cost = PointCost(points.sum(-1), points.sin(), (square + square.mT).expand(2, 9, 3, 3))
    exact = body.lift(pose, points, link, cost)
    reference = lift_by_autograd(body, pose, points, link, cost)
    for found, expected in zip(exact, reference, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def check_shape(body: BodyModel) -> None:
    """Parts exist, are finite, hang on the body, and can be seen."""
    assert body.num_parts
    assert len(set(body.part_names)) == body.num_parts
    assert {name for pair in body.neighbours for name in pair} <= set(body.part_names)
    identity = torch.eye(3, dtype=torch.float64).expand(body.num_parts, 3, 3)
    torch.testing.assert_close(body.part_rotation @ body.part_rotation.mT, identity)
    surface = body.surface(body.pose(body.rest))
    assert bool(surface.points.isfinite().all())
    assert bool((body.part_shape[:, :3] > 0).all())
    predictor = ContourPredictor(body, rings=7, meridians=4)
    eye = surface.points.mean(0) + torch.tensor([0.0, 0.5, 5.0]).double()
    nodes = predictor(body, body.pose(body.rest[None]), eye)
    assert int((nodes.exists * nodes.visible > 0.5).sum()) >= body.num_parts


@pytest.mark.parametrize("name", FILES)
def test_robots_of_others(shared_data: Path, name: str, generator: torch.Generator) -> None:
    body = load_body(robot(shared_data, name))
    assert body.num_parameters == FILES[name]
    assert has_root(body) == (name == "humanoid_CMU.xml")
    assert body.notes
    check_shape(body)
    if body.num_parameters < 25:
        check_lift(body, generator)


@pytest.mark.parametrize("name", ["01_01.bvh", "scaled_131_01.bvh"])
def test_a_bvh_body_moves_as_its_file_does(shared_data: Path, name: str) -> None:
    path = shared_data / "mocap_cmu" / name
    body = load_body(path)
    motion = read_motion_capture(path)
    frames = [0, len(motion.joints) // 2, len(motion.joints) - 1]
    x = states_of(body, path, frames)
    assert bool(((x >= body.lower) & (x <= body.upper)).all())
    joints = {name: i for i, name in enumerate(body.tree.link_names)}
    links = body.pose(x).tree.translation[:, [joints[name] for name in motion.joint_names]]
    np.testing.assert_allclose(links.numpy(), motion.joints[frames], atol=1e-6)
    assert {"l_hip", "r_knee", "l_ankle", "r_shoulder", "l_elbow", "r_wrist", "skull_tip"} <= set(
        body.joint_names
    )
    check_shape(body)


def states_of(body: BodyModel, path: Path, frames: list[int]) -> Tensor:
    """The state of a BVH body in frames of its own file."""
    lines = path.read_text().splitlines()
    channels: list[tuple[str, str]] = []
    name = ""
    for line in lines:
        words = line.split()
        if words[:1] in (["ROOT"], ["JOINT"]):
            name = words[1]
        if words[:1] == ["CHANNELS"]:
            channels += [(name, word) for word in words[2:]]
    first = next(i for i, line in enumerate(lines) if line.startswith("Frame Time")) + 1
    metres = 0.0254 / 0.45 if "scaled" not in path.name else 1.0
    x = torch.zeros(len(frames), body.num_parameters, dtype=torch.float64)
    for row, frame in enumerate(frames):
        turn = torch.eye(3, dtype=torch.float64)
        for (name, kind), word in zip(channels, lines[first + frame].split(), strict=True):
            letter, value = kind[0].lower(), float(word)
            if name == channels[0][0] and kind.endswith("position"):
                x[row, body.state_index(f"root_{letter}")] = metres * value
            elif name == channels[0][0]:
                angle = torch.zeros(3, 3, dtype=torch.float64)
                j, k = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[letter]
                angle[k, j], angle[j, k] = 1.0, -1.0
                turn = turn @ torch.linalg.matrix_exp(math.radians(value) * angle)
            elif f"{name}_{letter}" in body.state_names:
                x[row, body.state_index(f"{name}_{letter}")] = math.radians(value)
        x[row, body.state_columns(ROOT_NAMES[3:])] = root_angles(turn)
    return x


def test_what_a_bvh_does_not_say(tmp_path: Path, generator: torch.Generator) -> None:
    body = load_body(write(tmp_path / "a.bvh", BVH))
    check_lift(body, generator)
    check_shape(body)
    # Only what moves in the file moves, 60 degrees beyond it, and the file's mean is the rest.
    assert body.state_names[6:] == (
        "LeftUpLeg_x", "LeftLeg_x", "RightUpLeg_z", "Spine_x", "LeftArm_y", "RightArm_y",
    )  # fmt: skip
    knee = body.state_index("LeftLeg_x")
    limits = [math.degrees(float(end[knee])) for end in body.bounds]
    assert limits == pytest.approx([-40, 90])  # the middle angle of three ends at a right angle
    assert math.degrees(float(body.sticky_mean[knee])) == pytest.approx(45)
    assert math.degrees(float(body.sticky_deviation[knee])) == pytest.approx(25)
    arm = body.state_index("LeftArm_y")
    assert math.degrees(float(body.upper[arm])) == pytest.approx(120)
    unit, limits_note = body.notes
    assert "a.bvh: unit: cm (10.000 mm), guessed" in unit
    assert "a BVH has none" in limits_note
    assert "60 degrees beyond" in limits_note
    # Held angles are the file's; so are the positions of a joint that has them.
    pose = body.pose(torch.zeros(body.num_parameters, dtype=torch.float64))
    at = {name: joint for name, joint in zip(body.joint_names, pose.joints, strict=True)}
    lean = math.radians(5)
    expected = 0.43 * torch.tensor([math.sin(lean), -math.cos(lean), 0.0]).double()
    torch.testing.assert_close(at["l_knee"] - at["l_hip"], expected)
    assert float((at["l_ankle"] - at["l_knee"]).norm()) == pytest.approx(
        0.01 * math.sqrt(1 + 42**2 + 2**2)
    )
    torch.testing.assert_close(at["HumanoidRoot"], 0.5 * (at["l_hip"] + at["r_hip"]))


def test_a_bvh_without_motion(tmp_path: Path) -> None:
    lines = BVH.replace("Frames: 2", "Frames: 1").splitlines()[:-1]
    body = load_body(write(tmp_path / "a.bvh", "\n".join(lines)), free_root=False)
    assert body.num_parameters == 7 * 3
    degrees = dict(zip(body.state_names, torch.rad2deg(body.upper).tolist(), strict=True))
    assert degrees["LeftUpLeg_z"] == pytest.approx(5 + 120)
    assert degrees["LeftUpLeg_x"] == pytest.approx(90)
    assert bool(body.sticky_deviation.isinf().all())
    assert "no motion" in body.notes[1]


def test_units_of_a_bvh(tmp_path: Path) -> None:
    path = write(tmp_path / "a.bvh", BVH)
    for options, metres in (
        (None, 0.43),
        (FileOptions(units="inch"), 43 * 0.0254),
        (FileOptions(units=2.0), 86.0),
    ):
        body = load_body(path, file=options)
        joints = body.pose(body.rest).joints
        length = joints[body.joint_index("l_knee")] - joints[body.joint_index("l_hip")]
        assert float(length.norm()) == pytest.approx(metres)
    small = write(tmp_path / "b.bvh", BVH.replace("43", "4.3e6"))
    with pytest.raises(BodyError, match="no person's"):
        load_body(small)
    assert load_body(small, file=FileOptions(units="mm")).num_parameters
    with pytest.raises(BodyError, match="units: expected m, cm"):
        load_body(path, file=FileOptions(units="furlong"))
    with pytest.raises(BodyError, match="positive number of metres"):
        load_body(path, file=FileOptions(units=-1.0))


def test_mjcf_by_hand(tmp_path: Path, generator: torch.Generator) -> None:
    body = load_body(write(tmp_path / "a.xml", MJCF), free_root=False)
    check_lift(body, generator)
    assert body.state_names == ("turn", "slide", "ball_x", "ball_y", "ball_z")
    assert body.lower.tolist() == pytest.approx([-1, -math.inf, -1.2, -1.2, -1.2])
    assert body.upper.tolist() == pytest.approx([2, math.inf, 1.2, 1.2, 1.2])
    assert any("not table" in note for note in body.notes)

    def turn(axis: int, angle: float) -> np.ndarray:
        matrix = np.eye(4)
        j, k = (axis + 1) % 3, (axis + 2) % 3
        matrix[j, j] = matrix[k, k] = math.cos(angle)
        matrix[k, j], matrix[j, k] = math.sin(angle), -math.sin(angle)
        return matrix

    def shift(*by: float) -> np.ndarray:
        matrix = np.eye(4)
        matrix[:3, 3] = by
        return matrix

    x = torch.tensor([0.7, 0.05, 0.2, -0.3, 0.4], dtype=torch.float64)
    # Capital letters: fixed axes, the first turn innermost.
    arm = shift(0.1, 0.2, 0.3) @ turn(2, 0.5) @ turn(1, -0.4) @ turn(0, 0.3)
    arm = arm @ shift(0, 0, 0.1) @ turn(1, 0.7) @ shift(0, 0, -0.1) @ shift(0.05, 0, 0)
    hand = arm @ shift(0, 0, 0.2) @ turn(2, 1.2) @ shift(0.1, 0, 0) @ turn(2, math.pi / 2)
    hand = hand @ turn(0, 0.2) @ turn(1, -0.3) @ turn(2, 0.4)
    joints = body.pose(x).joints
    for name, place in (("arm", arm), ("hand", hand), ("tip", hand @ shift(0, 0, 0.15))):
        np.testing.assert_allclose(joints[body.joint_index(name)], place[:3, 3], atol=1e-12)
    # Solids of the file, and a bone where a link has only a mesh.
    assert any(note.startswith("a.xml: meshes are not opened, hand:") for note in body.notes)
    assert body.part_names == ("trunk", "arm", "hand")
    torch.testing.assert_close(
        body.part_shape[:, :3],
        torch.tensor([[0.05, 0.05, 0.25], [0.1, 0.05, 0.02], [0.024, 0.024, 0.0834]]).double(),
        rtol=0.2, atol=0.0,
    )  # fmt: skip
    assert [
        len(load_body(tmp_path / "a.xml", file=FileOptions(shape=how)).part_names)
        for how in ("bones", "none")
    ] == [3, 0]


def test_mjcf_that_the_compiler_expands(tmp_path: Path) -> None:
    write(tmp_path / "finger.xml", FINGER)
    body = load_body(write(tmp_path / "a.xml", ATTACHED))
    assert body.state_names == ("turn", "a_curl", "b_curl")
    assert float(body.upper[1]) == pytest.approx(1.5)
    assert {"a_tip", "b_tip"} <= set(body.part_names)
    joints = body.pose(body.rest).joints
    apart = joints[body.joint_index("b_finger")] - joints[body.joint_index("a_finger")]
    torch.testing.assert_close(apart, torch.tensor([0.2, 0.0, 0.0]).double())
    body = load_body(write(tmp_path / "b.xml", REPLICATED))
    assert body.state_names == ("turn", "curl0", "curl1", "curl2")


def test_mjcf_may_include_a_file_twice(tmp_path: Path) -> None:
    write(tmp_path / "solid.xml", '<mujocoinclude><geom size=".1"/></mujocoinclude>')
    include = '<include file="solid.xml"/>'
    text = f'<mujoco><worldbody><body name="a">{include}<body name="b" pos="0 0 1">{include}'
    body = load_body(write(tmp_path / "a.xml", text + "</body></body></worldbody></mujoco>"))
    assert body.part_names == ("a", "b")


def test_mjcf_without_mujoco(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'torchcss\[mjcf\]'"):
        load_body(write(tmp_path / "a.xml", MJCF))


def test_a_free_root_is_upright_and_at_the_body(tmp_path: Path, shared_data: Path) -> None:
    body = load_body(write(tmp_path / "a.xml", MJCF))
    assert has_root(body)
    joints = body.pose(torch.zeros(body.num_parameters, dtype=torch.float64)).joints
    torch.testing.assert_close(joints[body.joint_index("base")], torch.zeros(3).double())
    # Robots' x forward, y left, z up are z, x and y.
    expected = torch.tensor([0.2, 0.3, 0.1]).double()
    torch.testing.assert_close(joints[body.joint_index("arm")], expected)
    fixed = load_body(robot(shared_data, "humanoid_gym.xml"))
    free = load_body(robot(shared_data, "humanoid_gym.xml"), free_root=True)
    assert free.num_parameters == fixed.num_parameters + 6
    at = free.pose(torch.zeros(free.num_parameters, dtype=torch.float64)).joints
    torso, knee = (at[free.joint_index(name)] for name in ("torso", "l_knee"))
    torch.testing.assert_close(torso, torch.zeros(3).double())
    assert float(knee[1]) < -0.5
    assert float(knee[0]) > 0.05


SIDES = {"left": 0.06, "right": -0.06}


def test_limits_and_names_of_the_humanoids(shared_data: Path) -> None:
    gym = load_body(robot(shared_data, "humanoid_gym.xml"))
    knee = gym.state_index("right_knee")
    assert [math.degrees(float(end[knee])) for end in gym.bounds] == pytest.approx([-160, -2])
    limbs = {f"{s}_{p}" for s in "lr" for p in ("hip", "knee", "ankle", "shoulder", "elbow")}
    assert limbs <= set(gym.joint_names)
    cmu = load_body(robot(shared_data, "humanoid_CMU.xml"))
    assert limbs | {"l_wrist", "r_wrist", "HumanoidRoot"} <= set(cmu.joint_names)
    tibia = cmu.state_index("ltibiarx")
    assert [math.degrees(float(end[tibia])) for end in cmu.bounds] == pytest.approx([1, 170])
    joints = cmu.pose(torch.zeros(cmu.num_parameters, dtype=torch.float64)).joints
    thigh = joints[cmu.joint_index("l_hip")] - joints[cmu.joint_index("l_knee")]
    assert float(thigh.norm()) == pytest.approx(0.404945)


def test_a_robot_meets_the_keypoints_of_people(tmp_path: Path) -> None:
    """Legs whose hips are three links; a pelvis above the hips; a link that is no shoulder."""
    rows = [("pelvis", f"{side}_hip_pitch", f"0 {y} -0.1") for side, y in SIDES.items()]
    for side, y in SIDES.items():
        rows += [(f"{side}_hip_pitch", f"{side}_hip_roll", f"0 {y} -0.03"),
                 (f"{side}_hip_roll", f"{side}_hip_yaw", "0 0 -0.12"),
                 (f"{side}_hip_yaw", f"{side}_knee", "0 0 -0.18"),
                 ("pelvis", f"{side[0]}_shoulder", f"0 {y} 0.4"),
                 (f"{side[0]}_shoulder", f"{side}_upper_arm", f"0 {y} 0"),
                 (f"{side}_upper_arm", f"{side}_forearm", "0 0 -0.2")]  # fmt: skip
    joints = "".join(
        f'<link name="{child}_link"/><joint name="{child}" type="revolute"><axis xyz="0 1 0"/>'
        f'<parent link="{parent}_link"/><child link="{child}_link"/><origin xyz="{place}"/></joint>'
        for parent, child, place in rows
    )
    text = f'<robot name="r"><link name="pelvis_link"/>{joints}</robot>'
    text = text.replace("_shoulder_link", "_shoulder")
    body = load_body(write(tmp_path / "robot.urdf", text))
    assert len(set(body.joint_names)) == len(body.joint_names)
    places = body.pose(torch.zeros(body.num_parameters, dtype=torch.float64)).joints
    at = {name: place.tolist() for name, place in zip(body.joint_names, places, strict=True)}
    for side, y in SIDES.items():
        assert at[f"{side[0]}_hip"] == pytest.approx([0, 2 * y, -0.13])
        assert at[f"{side[0]}_knee"] == pytest.approx([0, 2 * y, -0.43])
        assert at[f"{side[0]}_shoulder"] == pytest.approx([0, 2 * y, 0.4])
        assert at[f"{side[0]}_shoulder_2"] == pytest.approx([0, y, 0.4])
    assert at["pelvis_link"] == pytest.approx([0, 0, 0])
    assert "HumanoidRoot" not in at  # no link carries both hips: the first turn moves them
    assert body.joint_of_name["l_shoulder"] == "l_shoulder"
    for y in SIDES.values():  # three axes that meet
        text = text.replace(f'"0 {y} -0.03"', '"0 0 0"')
    body = load_body(write(tmp_path / "robot.urdf", text.replace('"0 0 -0.12"', '"0 0 0"')))
    places = body.pose(torch.zeros(body.num_parameters, dtype=torch.float64)).joints
    assert places[body.joint_index("HumanoidRoot")].tolist() == pytest.approx([0, 0, -0.1])


def test_primitives_of_a_urdf(tmp_path: Path) -> None:
    text = """<robot name="r"><link name="a"><visual><origin xyz="0 0 .1" rpy="0 1.5707963 0"/>
      <geometry><cylinder radius=".05" length=".4"/></geometry></visual></link>
      <link name="b"><collision><geometry><box size=".2 .4 .6"/></geometry></collision></link>
      <link name="c"/><joint name="j" type="revolute"><parent link="a"/><child link="b"/>
      <axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint>
      <joint name="k" type="fixed"><parent link="b"/><child link="c"/><origin xyz="0 0 1"/></joint>
      </robot>"""
    body = load_body(write(tmp_path / "a.urdf", text))
    assert body.part_names == ("a", "b")
    assert body.part_shape[:, :3].tolist() == [[0.05, 0.05, 0.2], [0.1, 0.2, 0.3]]
    torch.testing.assert_close(
        body.part_rotation[0] @ torch.tensor([0.0, 0.0, 1.0]).double(),
        torch.tensor([1.0, 0.0, 0.0]).double(), rtol=0.0, atol=1e-6,
    )  # fmt: skip
    bones = load_body(tmp_path / "a.urdf", file=FileOptions(shape="bones"))
    assert bones.part_names == ("b",)
    assert load_body(tmp_path / "a.urdf", file=FileOptions(shape="none")).num_parts == 0
    double = load_body(tmp_path / "a.urdf", scale=2.0)
    torch.testing.assert_close(double.part_shape[:, :3], 2 * body.part_shape[:, :3])
    # In an xml file it is still a URDF.
    assert load_body(write(tmp_path / "a.xml", text)).state_names == ("j",)


def test_solids_of_a_urdf_have_names_of_their_own(tmp_path: Path) -> None:
    """The second solid of a link may not take the name of another link, wherever that stands."""
    solid = "<visual><geometry><sphere radius='.05'/></geometry></visual>"
    text = f"""<robot name="r"><link name="arm">{3 * solid}</link><link name="arm_2">{2 * solid}
      </link><link name="arm_4"/><joint name="j" type="revolute"><parent link="arm"/>
      <child link="arm_2"/><origin xyz="0 0 .5"/></joint><joint name="k" type="fixed">
      <parent link="arm_2"/><child link="arm_4"/><origin xyz="0 0 .5"/></joint></robot>"""
    body = load_body(write(tmp_path / "a.urdf", text))
    assert body.part_names == ("arm", "arm_3", "arm_5", "arm_2", "arm_2_2")
    assert ("arm", "arm_3") in body.neighbours


def test_bones_hold_what_they_join() -> None:
    """A part along every bone, on the bone, on the link that carries it; a trunk between limbs."""

    def joint(name: str, parent: str | None, *at: float) -> JointSpecification:
        return JointSpecification(
            name=name, link=name, parent=parent, kind="fixed" if parent is None else "revolute",
            translation=at if at else (0.0, 0.0, 0.0),  # type: ignore[arg-type]
        )  # fmt: skip

    joints = [
        joint("pelvis", None), joint("twist", "pelvis"), joint("chest", "twist", 0.0, 0.5, 0.0),
        joint("lleg", "pelvis", 0.2, -0.1, 0.0), joint("lfoot", "lleg", 0.0, -0.8, 0.0),
        joint("rleg", "pelvis", -0.2, -0.1, 0.0), joint("rfoot", "rleg", 0.0, -0.8, 0.0),
        joint("larm", "chest", 0.3, 0.0, 0.0), joint("lhand", "larm", 0.0, -0.6, 0.0),
        joint("rarm", "chest", -0.3, 0.0, 0.0), joint("rhand", "rarm", 0.0, -0.6, 0.0),
    ]  # fmt: skip
    parts = bone_parts(joints, {})
    poses = rest_poses(joints)
    bones = [(a, b) for a in joints for b in joints if b.parent == a.link and b.link != "twist"]
    assert len(parts) == len(bones)
    for above, below in bones:
        middle = 0.5 * (poses[above.link] + poses[below.link])[:3, 3]
        part = next(
            part
            for part in parts
            if part.link == above.link
            and np.allclose(poses[part.link][:3, 3] + part.translation, middle)
        )
        along = np.array(part.rotation)[:, 2]
        bone = (poses[below.link] - poses[above.link])[:3, 3]
        assert np.allclose(along, bone / np.linalg.norm(bone))
        assert part.shape[2] > 0.5 * np.linalg.norm(bone)
    trunk = next(part for part in parts if part.link == "twist")
    assert np.allclose(np.abs(np.array(trunk.rotation)[:, 0]), [1, 0, 0])
    assert 0.2 < trunk.shape[0] < 0.3
    assert trunk.shape[1] < trunk.shape[0]
    pairs = {frozenset(pair) for pair in touching_parts(joints, parts)}
    assert frozenset(("lleg", "rleg")) not in pairs
    assert frozenset(("twist", "chest")) in pairs


@pytest.mark.parametrize(("kind", "size"), [("capsule", (0.1, 0.3)), ("cylinder", (0.1, 0.3))])
def test_solids_have_their_length_girth_and_volume(kind: str, size: tuple[float, float]) -> None:
    shape = torch.tensor(solid_shape(kind, size)).double()
    radius, half = size
    assert shape[:3].tolist() == pytest.approx(
        [radius, radius, half + radius * (kind == "capsule")]
    )
    axis = torch.linspace(-0.4, 0.4, 81).double()
    x, y, z = torch.meshgrid(axis / 3, axis / 3, axis, indexing="ij")
    points = torch.stack([x, y, z], -1)
    inside = (implicit(shape.expand(*points.shape[:-1], 9), points) < 0).double()
    volume = float(inside.sum()) * 0.01**3 / 9
    true = math.pi * radius**2 * 2 * half + (4 / 3 * math.pi * radius**3) * (kind == "capsule")
    assert volume == pytest.approx(true, rel=0.02 if kind == "capsule" else 0.12)


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("a.bvh", "", "the file is empty"),
        ("a.bvh", MJCF, "line 1: expected HIERARCHY"),
        ("a.bvh", BVH.replace("OFFSET 10", "OFFSET ten"), "line 8: expected three numbers"),
        ("a.xml", "", "the file is empty"),
        ("a.xml", BVH, "the XML does not parse"),
        ("a.xml", "<html/>", "expected <robot> with links, found <html>"),
        ("a.urdf", f"<!DOCTYPE r [<!ENTITY a 'b'>]>{MJCF}", "declares XML entities"),
        ("a.xml", f"<!DOCTYPE r [<!ENTITY a 'b'>]>{MJCF}", "declares XML entities"),
        ("a.xml", "<mujoco/>", "no <body>"),
        ("a.xml", "<mujoco><worldbody/></mujoco>", "no <body>"),
        ("a.xml", MJCF.replace(".1 .2 .3", ".1 .2"), "'pos' does not have enough data"),
        ("a.xml", MJCF.replace(".1 .2 .3", ".1 nan .3"), "'arm'>: pos: expected num"),
        ("a.xml", MJCF.replace(".1 .2 .3", ".1 inf .3"), "expected places"),
        ("a.xml", MJCF.replace(".1 .2 .3", ".1 1e30 .3"), "below 1e.06 metres"),
        ("a.xml", MJCF.replace('type="slide"', 'type="screw"'), "invalid keyword: 'screw'"),
        ("a.xml", MJCF.replace('axis="1 0 0"', 'axis="0 0 0"'), "axis too small .*'slide'"),
        ("a.xml", MJCF.replace('"-1 2"', '"2 -1"'), "joint 'turn': expected a range"),
        ("a.xml", MJCF.replace("XYZ", "XYW"), "euler sequence can only"),
        ("a.xml", MJCF.replace("childclass=\"big\"", 'childclass="small"'), "default childclass"),
        ("a.xml", MJCF.replace('size=".1 .05 .02"', 'size=".1 0 .02"'), "size 1 must be positive"),
        ("a.xml", MJCF.replace(' size=".05 .1"', ""), "size 0 must be positive .*'trunk'"),
        ("a.xml", MJCF.replace('type="box"', 'type="cone"', 1), "invalid keyword: 'cone'"),
        ("a.xml", MJCF.replace('name="slide"', 'name="turn"'), "repeated name 'turn' in joint"),
        ("a.xml", MJCF.replace("frame", "replicate"), "missing: 'count'"),
        ("a.xml", '<mujoco><include file="b.xml"/></mujoco>', "b.xml: there is no such file"),
        ("a.xml", '<mujoco><include file="a.xml"/></mujoco>', "includes: do they loop"),
        ("a.xml", '<mujoco><include file="../b.xml"/></mujoco>', "which is not in its folder"),
        ("a.xml", REPLICATED.replace("3", "100000"), "expands to more than 10,000 bodies"),
        ("a.xml", ATTACHED.replace("finger.xml", "a.xml"), "expands to more than 10,000 bodies"),
        ("a.xml", MJCF.replace('size=".1 .05 .02"', 'size=".1 1e-9 .02"'), "sizes above 1e-6"),
        ("a.xml", MJCF.replace("<freejoint/>", "<freejoint/><joint/>"), "more than 6 dofs"),
    ],
)  # fmt: skip
def test_bad_files(tmp_path: Path, name: str, text: str, match: str) -> None:
    path = write(tmp_path / name, text)
    with pytest.raises(BodyError, match=match) as caught:
        load_body(path)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_bad_requests(tmp_path: Path) -> None:
    path = write(tmp_path / "a.xml", MJCF)
    with pytest.raises(BodyError, match="shape: expected file, bones or none"):
        load_body(path, file=FileOptions(shape="muscle"))  # type: ignore[arg-type]
    with pytest.raises(BodyError, match="scale must be positive"):
        load_body(path, scale=0.0)
    with pytest.raises(BodyError, match="units are for BVH"):
        load_body(path, file=FileOptions(units="cm"))
    with pytest.raises(BodyError, match="own lengths"):
        load_body(path, lengths={"thigh": 0.4})
    for dtype in (torch.float16, torch.int32, "float32"):
        with pytest.raises(ConfigurationError, match=r"dtype: expected torch\.float32"):
            load_body(path, dtype=dtype)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="device 'nope' is not available"):
        load_body(path, device="nope")
    path.write_bytes(MJCF.encode("utf-16"))
    assert load_body(path).num_parameters == 11  # XML says its encoding itself


def arm_with(path: Path, **content: str) -> Path:
    """A planar arm some of whose links have content."""
    text = planar_arm(path, 0.5, 0.4).read_text()
    for link, inside in content.items():
        text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{inside}</link>')
    return write(path, text)


def visual(mesh: str) -> str:
    return f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'


@pytest.mark.parametrize("end", [None, b"", b"\n", b"obj"])
def test_a_link_is_as_large_as_the_box_around_its_mesh(tmp_path: Path, end: bytes | None) -> None:
    name = "a.obj" if end == b"obj" else "a.stl"
    corners = np.array([[[-50, -30, 0], [50, 30, 0], [0, 0, 400]]], "<f4")
    if end == b"obj":
        rows = "".join(f"v {x} {y:e} {z}\n" for x, y, z in corners[0])
        content = f"# made by a program\n{rows}vn 0 0 1\nf 1//1 2//1 3//1\n".encode()
    elif end is not None:  # binary
        record = np.concatenate([np.zeros((1, 1, 3), "<f4"), corners], 1).tobytes() + bytes(2)
        content = b"solid in millimetres".ljust(80) + (1).to_bytes(4, "little") + record + end
    else:
        rows = "".join(f"vertex {x} {y:e} {z}\n" for x, y, z in corners[0])
        content = f"solid a\nfacet normal 0 0 1\nouter loop\n{rows}endloop\nendfacet\n".encode()
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / name).write_bytes(content)
    mesh = (
        '<visual><origin xyz="0.2 0 0" rpy="0 1.5707963267948966 0"/><geometry>'
        f'<mesh filename="package://arm/meshes/{name}" scale="0.001 0.001 0.001"/>'
        "</geometry></visual>"
    )
    body = load_body(arm_with(tmp_path / "arm.urdf", link2=mesh))
    assert "arm.urdf: as large as the boxes around their meshes: 'link2'" in body.notes
    part = body.part_names.index("link2")
    np.testing.assert_allclose(body.part_shape[part, :3], [0.03, 0.05, 0.2], atol=1e-12)
    np.testing.assert_allclose(body.part_translation[part], [0.4, 0, 0], atol=1e-12)
    np.testing.assert_allclose(body.part_rotation[part].abs()[:, 2], [1, 0, 0], atol=1e-12)


COLLADA = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="millimeter" meter="0.001"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="9">-5 -3 0 5 3 0 0 0 40</float_array></source>
<source id="n"><float_array id="na" count="3">0 0 9e9</float_array></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
</mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s">
<node><translate>200 0 0</translate><node><rotate>0 2 0 90</rotate><scale>10 10 10</scale>
<instance_geometry url="#g"/></node></node></visual_scene></library_visual_scenes></COLLADA>"""


def test_collada_says_its_unit_and_where_a_mesh_stands(tmp_path: Path) -> None:
    write(tmp_path / "a.dae", COLLADA)
    body = load_body(arm_with(tmp_path / "arm.urdf", link2=visual("a.dae")))
    part = body.part_names.index("link2")
    np.testing.assert_allclose(body.part_shape[part, :3], [0.03, 0.05, 0.2], atol=1e-12)
    np.testing.assert_allclose(body.part_translation[part], [0.4, 0, 0], atol=1e-12)
    np.testing.assert_allclose(body.part_rotation[part].abs()[:, 2], [1, 0, 0], atol=1e-12)
    (tmp_path / "a.dae").write_text(COLLADA.replace("instance_geometry", "instance_node"))
    assert "places a node by reference" in load_body(tmp_path / "arm.urdf").notes[1]
    for spoilt in ("40<", "#g", "</node>", "200 0 0", "0.001"):
        (tmp_path / "a.dae").write_text(COLLADA.replace(spoilt, "x"))
        assert any("a.dae: not COLLADA" in note for note in load_body(tmp_path / "arm.urdf").notes)


def test_a_link_of_many_metres_is_told(tmp_path: Path) -> None:
    write(tmp_path / "a.obj", "v 0 0 0\nv 50 90 400\n")
    path = arm_with(tmp_path / "arm.urdf", link2=visual("a.obj"))
    note = "link 'link2' is 400 m large by its mesh, more than links are: if that is in millimetres"
    assert any(note in each for each in load_body(path).notes)


def test_meshes_that_stand_for_a_link_are_told(tmp_path: Path) -> None:
    mesh = visual("package://arm/meshes/a.dae")
    ball = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
    path = arm_with(tmp_path / "arm.urdf", link1=mesh + ball, link2=mesh, tip="")
    notes = load_body(path).notes
    assert notes[0] == "arm.urdf: limits, axes and solids: as the URDF says"
    assert len(notes) == 2
    assert notes[1].startswith("arm.urdf: meshes are not opened, link2 ('a.dae'): ")


def test_a_mesh_of_many_links_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []

    def points(path: Path) -> np.ndarray:
        read.append(path)
        return mesh_points(path)

    monkeypatch.setattr("torchcss.body.files.urdf.mesh_points", points)
    write(tmp_path / "a.obj", "v 0 0 0\nv 1 2 3\n")
    path = arm_with(tmp_path / "arm.urdf", link1=visual("a.obj"), link2=visual("a.obj"))
    assert {"link1", "link2"} <= {*load_body(path).part_names}
    assert len(read) == 1


@pytest.mark.parametrize(
    "text", ["<xacro:arm/>", '<link name="${prefix}a"/>', '<link name="a"/><xacro:if value="1"/>']
)
def test_xacro_is_told_apart(tmp_path: Path, text: str) -> None:
    for name in ("a.urdf", "a.urdf.xacro"):
        (tmp_path / name).write_text(f"<robot>{text}</robot>")
        with pytest.raises(BodyError, match=f"{name}: a xacro file, .* expand it"):
            load_body(tmp_path / name)
