"""Motion capture files: both formats against twins, one take in both, and all that is wrong."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from made_tracks import export_as, make_track
from reference.bvh import read_bvh, rotation

from torchcss import load_body
from torchcss.body.files.bvh import UNITS
from torchcss.errors import ConfigurationError, MotionCaptureError
from torchcss.io.motion.positions import (
    LIMB_JOINTS,
    MotionCapture,
    limb_positions,
    read_motion_capture,
    resample_motion,
)
from torchcss.joint_names import skeleton_joint_names

BVH = """HIERARCHY
ROOT Hips
{
	OFFSET 0.0 0.0 0.0
	CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
	JOINT Chest
	{
		OFFSET 0.0 60.0 0.0
		CHANNELS 3 Xrotation Zrotation Yrotation
		End Site
		{
			OFFSET 10.0 0.0 80.0
		}
	}
	JOINT Left Leg
	{
		OFFSET 10.0 -80.0 0.0
		CHANNELS 3 Zrotation Yrotation Xrotation
		End Site
		{
			OFFSET 0.0 0.0 20.0
		}
	}
}
MOTION
Frames: 2
Frame Time: .0083333
1 2 3 10 20 30 40 50 60 -10 -20 -30
1 2 4 11 20 31 40 52 60 -10 -25 -30
"""

ASF = """# made by hand
:version 1.10
:name test
:units
  mass 1.0
  length 0.45
  angle deg
:documentation
  begin and end mean nothing here
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name hip
    direction 0.6 -0.8 0
    length 5
    axis 0 0 0 XYZ
  end
  begin
    id 2
    name leg
    direction 0 -1 0
    length 14
    axis 10 20 30 XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
    id 3
    name back
    direction 0 1 0
    length 18
    axis -20 0 5 ZYX
    dof rx rz
  end
:hierarchy
  begin
    root hip back
    hip leg
  end
"""

AMC = """#!OML:ASF made.asf
:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 10 20 30
leg 40 50 60
back -10 -20
2
root 1 2 4 11 21 31
leg 41 52 60
back -10 -25
"""


def write_bvh(folder: Path, text: str = BVH) -> Path:
    path = folder / "motion.bvh"
    path.write_text(text)
    return path


def write_acclaim(folder: Path, asf: str = ASF, amc: str = AMC) -> Path:
    (folder / "motion.asf").write_text(asf)
    path = folder / "motion.amc"
    path.write_text(amc)
    return path


# The formats, when all is well.


def test_bvh_against_its_twin(tmp_path: Path) -> None:
    found = read_motion_capture(write_bvh(tmp_path), units="cm")
    twin = read_bvh(BVH.replace("Left Leg", "LeftLeg"))
    assert found.joint_names == ("Hips", "Chest", "Chest_end", "Left Leg", "Left Leg_end")
    assert found.parents == (-1, 0, 1, 0, 3)
    np.testing.assert_allclose(found.joints[:, [0, 1, 3]], 0.01 * twin.positions(), atol=1e-12)
    # Ends are rigid in their parents.
    np.testing.assert_allclose(
        np.linalg.norm(found.joints[:, 2] - found.joints[:, 1], axis=-1), math.hypot(0.1, 0.8)
    )
    np.testing.assert_allclose(found.rest[3], [0.1, -0.8, 0.0])
    assert found.frame_rate == 120
    assert found.duration == pytest.approx(1 / 120)


def test_positions_take_the_place_of_offsets(tmp_path: Path) -> None:
    """Suits write six channels for every joint, the offset among them."""
    text = BVH.replace("CHANNELS 3 Xrotation", "CHANNELS 6 Xposition Yposition Zposition Xrotation")
    text = text.replace("10 20 30 40", "10 20 30 0 60 0 40").replace(
        "11 20 31 40", "11 20 31 0 66 0 40"
    )
    text = text.replace("	OFFSET 0.0 0.0 0.0\n", "	OFFSET 5.0 90.0 -7.0\n", 1)
    plain = read_motion_capture(write_bvh(tmp_path))
    found = read_motion_capture(write_bvh(tmp_path, text))
    np.testing.assert_allclose(found.joints[0], plain.joints[0])
    np.testing.assert_allclose(found.rest, plain.rest)
    stretched = found.joints[1, 1] - found.joints[1, 0]
    np.testing.assert_allclose(stretched, 1.1 * (plain.joints[1, 1] - plain.joints[1, 0]))


def test_positions_that_are_all_zero_leave_the_offsets(tmp_path: Path) -> None:
    """Other programs write them for every joint, and nothing into them."""
    six = "CHANNELS 6 Xposition Yposition Zposition Xrotation"
    text = BVH.replace("CHANNELS 3 Xrotation", six)
    text = text.replace("10 20 30 40", "10 20 30 0 0 0 40")
    text = text.replace("11 20 31 40", "11 20 31 0 0 0 40")
    plain = read_motion_capture(write_bvh(tmp_path))
    found = read_motion_capture(write_bvh(tmp_path, text))
    np.testing.assert_allclose(found.joints, plain.joints)
    assert any("positions of joints are all zero" in line for line in found.report)
    assert not any("all zero" in line for line in plain.report)


def test_acclaim_by_its_definition(tmp_path: Path) -> None:
    """Each bone turns about fixed axes of its own: x, then y, then z."""
    found = read_motion_capture(write_acclaim(tmp_path), units="cmu")
    assert found.joint_names == ("root", "hip", "back", "leg")
    assert found.parents == (-1, 0, 0, 1)
    unit = 0.0254 / 0.45

    def turns(angles: tuple[float, ...], order: str) -> np.ndarray:
        matrix = np.eye(3)
        for angle, letter in zip(angles, order, strict=True):
            matrix = rotation("XYZ".index(letter), math.radians(angle)) @ matrix
        return matrix

    def moved(axis: tuple[float, ...], order: str, dof: str, angles: tuple[float, ...]):
        own = turns(axis, order)
        return own @ turns(angles, dof) @ own.T

    for frame, (root, turn, leg, back) in enumerate(
        [
            ((1, 2, 3), (10, 20, 30), (40, 50, 60), (-10, -20)),
            ((1, 2, 4), (11, 21, 31), (41, 52, 60), (-10, -25)),
        ]
    ):
        pelvis = turns(turn, "XYZ")
        hip = np.array(root) + pelvis @ (3, -4, 0)
        foot = hip + pelvis @ moved((10, 20, 30), "XYZ", "XYZ", leg) @ (0, -14, 0)
        neck = np.array(root) + pelvis @ moved((-20, 0, 5), "ZYX", "XZ", back) @ (0, 18, 0)
        expected = unit * np.stack([np.array(root), hip, neck, foot])
        np.testing.assert_allclose(found.joints[frame], expected, atol=1e-12)
    np.testing.assert_allclose(found.rest[3], unit * np.array([3.0, -18.0, 0.0]), atol=1e-12)


def test_radians_are_radians(tmp_path: Path) -> None:
    degrees = read_motion_capture(write_acclaim(tmp_path))
    lines = []
    for line in AMC.replace(":DEGREES", ":RADIANS").splitlines():
        name, *numbers = line.split()
        first = 3 if name == "root" else 0
        if name in ("root", "leg", "back"):
            numbers = [
                number if i < first else repr(math.radians(float(number)))
                for i, number in enumerate(numbers)
            ]
        lines.append(" ".join([name, *numbers]))
    radians = read_motion_capture(write_acclaim(tmp_path, amc="\n".join(lines)))
    np.testing.assert_allclose(degrees.joints, radians.joints, atol=1e-12)


def test_our_own_export_comes_back(tmp_path: Path) -> None:
    body = load_body("body34", lengths={"thigh": 0.44, "trunk": 0.51})
    track = make_track(body, spread=1.0)
    options = {"to": "bvh", "out": tmp_path, "frame": "world"}
    for scale in (1.0, 100.0):
        path = export_as(track, scale=scale, **options).paths[0]
        found = read_motion_capture(path)
        assert any("unit: m " in line or "unit: cm " in line for line in found.report)
        index = [found.joint_names.index(name) for name in body.joint_names]
        np.testing.assert_allclose(found.joints[:, index], track.joints_world[:, 0], atol=1e-5)
        names, _, limbs = limb_positions(found)
        assert names == LIMB_JOINTS
        where = [body.joint_names.index(name) for name in names]
        np.testing.assert_allclose(limbs, track.joints_world[:, 0, where], atol=1e-5)


# Of one take of the CMU database there are both formats, and the conversion to BVH left out two
# bones: thorax, and the distal third of the forearm.

BONES = {
    "lhipjoint": "LeftUpLeg", "lfemur": "LeftLeg", "ltibia": "LeftFoot", "lfoot": "LeftToeBase",
    "ltoes": "LeftToeBase_end", "rhipjoint": "RightUpLeg", "rfemur": "RightLeg",
    "rtibia": "RightFoot", "rfoot": "RightToeBase", "rtoes": "RightToeBase_end",
    "lowerback": "Spine", "upperback": "Spine1", "thorax": "Neck", "lowerneck": "Neck1",
    "upperneck": "Head", "head": "Head_end", "lclavicle": "LeftArm", "lhumerus": "LeftForeArm",
    "lradius": "LeftHand", "lwrist": "LeftFingerBase", "lhand": "LFingers",
    "lfingers": "LFingers_end", "rclavicle": "RightArm", "rhumerus": "RightForeArm",
    "rradius": "RightHand", "rwrist": "RightFingerBase", "rhand": "RFingers",
    "rfingers": "RFingers_end", "root": "Hips",
}  # fmt: skip
LEGS = [f"{side}{bone}" for side in "lr" for bone in ("hipjoint", "femur", "tibia", "foot", "toes")]
IN_PLACE = ("root", "lowerback", "upperback", *LEGS)
LEFT_OUT = ("thorax", "lwrist", "rwrist")


def test_one_take_in_both_formats(shared_data: Path) -> None:
    folder = shared_data / "mocap_cmu"
    amc = read_motion_capture(folder / "01_01.amc", skeleton=folder / "01.asf")
    bvh = read_motion_capture(folder / "01_01.bvh")
    assert amc.frame_rate == bvh.frame_rate == 120
    assert len(bvh.joints) == len(amc.joints) + 1  # it begins with a T-pose

    def of_bvh(name: str) -> np.ndarray:
        return bvh.joints[1:, bvh.joint_names.index(BONES[name])]

    for index, name in enumerate(amc.joint_names):
        if name in LEFT_OUT or name not in BONES:
            continue
        above = amc.joint_names[amc.parents[index]]
        own = amc.joints[:, index]
        if name != "root":
            bone = own - amc.joints[:, amc.parents[index]]
            np.testing.assert_allclose(of_bvh(name) - of_bvh(above), bone, atol=1e-5)
        # Pelvis and legs are in place to 0.01 mm; everything on the thorax is lower by its length.
        apart = np.linalg.norm(of_bvh(name) - own, axis=-1)
        if name in IN_PLACE:
            assert apart.max() < 1e-5
        elif name in ("lclavicle", "rhumerus", "head"):
            np.testing.assert_allclose(apart, 0.11655, atol=1e-5)


def test_one_take_in_two_units(shared_data: Path) -> None:
    folder = shared_data / "mocap_cmu"
    cmu = read_motion_capture(folder / "131_01.bvh")
    metres = read_motion_capture(folder / "scaled_131_01.bvh")
    assert any("unit: cmu" in line for line in cmu.report)
    assert any("unit: m " in line for line in metres.report)
    np.testing.assert_allclose(metres.joints[: len(cmu.joints)], cmu.joints, atol=1e-4)


@pytest.mark.parametrize(
    ("file", "skeleton", "frames"),
    [
        ("07_05-walk.amc", "07-walk.asf", 517),
        ("131_04-dance.amc", "131-dance.asf", 1086),
        ("pirouette.amc", None, 591),
        ("14_08.bvh", None, 2626),
    ],
)
def test_real_recordings(shared_data: Path, file: str, skeleton: str | None, frames: int) -> None:
    folder = shared_data / "mocap_cmu"
    motion = read_motion_capture(folder / file, skeleton=skeleton and folder / skeleton)
    assert len(motion.joints) == frames
    assert motion.frame_rate == 120
    height = motion.joints[..., 1].max(1) - motion.joints[..., 1].min(1)
    assert 1.3 < np.median(height) < 2.1
    names, _, limbs = limb_positions(motion)
    assert names == LIMB_JOINTS
    at = dict(zip(names, np.moveaxis(limbs, 1, 0), strict=True))
    for side in "lr":
        thigh = np.linalg.norm(at[f"{side}_hip"] - at[f"{side}_knee"], axis=-1)
        assert thigh.std() < 1e-6
        assert 0.35 < thigh.mean() < 0.5


# Units, rates, names.


def test_units(tmp_path: Path) -> None:
    path = write_bvh(tmp_path)
    metres = read_motion_capture(path, units="m").joints
    for units, scale in [*UNITS.items(), (0.02, 0.02), ("0.02", 0.02)]:
        np.testing.assert_allclose(read_motion_capture(path, units=units).joints, scale * metres)
    guessed = read_motion_capture(path)
    np.testing.assert_allclose(guessed.joints, 0.01 * metres)
    assert any("cm (10.000 mm), guessed" in line for line in guessed.report)
    for units in ("yard", 0.0, -1, "nan", math.inf):
        with pytest.raises(ConfigurationError, match="units"):
            read_motion_capture(path, units=units)
    path = write_bvh(tmp_path, BVH.replace("0.0 60.0 0.0", "0.0 6e7 0.0"))
    with pytest.raises(MotionCaptureError, match="no person's"):
        read_motion_capture(path)
    assert read_motion_capture(path, units=1).joints.max() > 1e6


def test_what_a_skeleton_says_of_units_counts_if_a_person_results(tmp_path: Path) -> None:
    said = read_motion_capture(write_acclaim(tmp_path))
    assert any("as the skeleton says" in line for line in said.report)
    other = read_motion_capture(write_acclaim(tmp_path, ASF.replace("length 0.45", "length 45")))
    assert any("cmu (56.444 mm), guessed" in line for line in other.report)
    np.testing.assert_allclose(said.joints, other.joints)


@pytest.mark.parametrize(
    ("time", "rate"),
    [
        (".0083333", 120),
        ("0.008333", 120),
        ("0.00833333", 120),
        ("0.0333667", 1 / 0.0333667),  # 29.97
        ("0.04", 25),
        ("8.3333333e-3", 1 / 8.3333333e-3),
        ("1", 1),
    ],
)
def test_rate(tmp_path: Path, time: str, rate: float) -> None:
    path = write_bvh(tmp_path, BVH.replace(".0083333", time))
    assert read_motion_capture(path).frame_rate == rate
    assert read_motion_capture(path, frame_rate=30).frame_rate == 30


@pytest.mark.parametrize("time", ["30", "33.3333"])
def test_what_is_no_frame_time(tmp_path: Path, time: str) -> None:
    path = write_bvh(tmp_path, BVH.replace(".0083333", time))
    with pytest.raises(MotionCaptureError, match=f"frames last {time} seconds each.*frame_rate"):
        read_motion_capture(path)
    assert read_motion_capture(path, frame_rate=30).frame_rate == 30


@pytest.mark.parametrize("rate", [0.0, -1.0, math.nan, math.inf])
def test_rates_that_make_no_sense(tmp_path: Path, rate: float) -> None:
    with pytest.raises(ConfigurationError, match="rate"):
        read_motion_capture(write_bvh(tmp_path), frame_rate=rate)


def a_motion(names: tuple[str, ...]) -> MotionCapture:
    joints = np.random.default_rng(0).normal(size=(3, len(names), 3))
    return MotionCapture(names, (-1, *range(len(names) - 1)), joints[0], joints, 30.0, ())


@pytest.mark.parametrize(
    "names",
    [
        ("LeftUpLeg", "RightUpLeg", "LeftShoulder", "RightShoulder", "LeftArm", "RightArm"),
        ("mixamorig:LeftUpLeg", "mixamorig:RightUpLeg", "x", "y", "mixamorig:LeftArm",
         "mixamorig:RightArm"),
        ("lhipjoint", "rhipjoint", "root", "thorax", "lclavicle", "rclavicle"),
        ("left_hip", "right_hip", "neck", "head", "LShoulder", "r_shoulder"),
    ],
)  # fmt: skip
def test_names_of_limbs(names: tuple[str, ...]) -> None:
    motion = a_motion(names)
    found, index, positions = limb_positions(motion)
    assert found == ("l_shoulder", "r_shoulder", "l_hip", "r_hip")
    assert index == (4, 5, 0, 1)
    np.testing.assert_array_equal(positions, motion.joints[:, [4, 5, 0, 1]])


def test_a_leg_above_a_shin_is_the_thigh() -> None:
    """SOMA's skeleton, whose thigh is called as others call the shin."""
    names = ("Hips", "LeftLeg", "LeftShin", "LeftFoot", "RightLeg", "RightShin", "LeftArm",
             "LeftForeArm")  # fmt: skip
    expected = (None, "l_hip", "l_knee", "l_ankle", "r_hip", "r_knee", "l_shoulder", "l_elbow")
    assert skeleton_joint_names(names) == expected
    usual = ("LeftUpLeg", "LeftLeg", "LeftFoot", "LeftForeArm")
    assert skeleton_joint_names(usual) == ("l_hip", "l_knee", "l_ankle", "l_elbow")


@pytest.mark.parametrize(
    "limbs",
    [
        "leg_{} knee_{} ankle_{} arm_{} elbow_{} wrist_{} shoulder_{}",  # MikuMikuDance
        "thigh_stretch.{} leg_stretch.{} foot.{} arm_stretch.{} forearm_stretch.{} hand.{} "
        "shoulder.{}",  # Auto-Rig Pro
        "{}_Thigh {}_Shin {}_Foot {}_Bicep {}_Forearm {}_Hand {}_Shoulder",  # Softimage
    ],
)
def test_the_shoulder_of_a_skeleton_with_an_arm_is_the_collar_bone(limbs: str) -> None:
    for side in "lr":
        names = limbs.format(*7 * [side]).split()
        found = skeleton_joint_names(["Hips", *names])[1:]
        places = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
        assert found == (*(f"{side}_{place}" for place in places), None)


def test_without_hips_there_is_nothing_to_follow() -> None:
    with pytest.raises(MotionCaptureError, match="hips and shoulders"):
        limb_positions(a_motion(("l_hip", "l_shoulder", "r_shoulder", "head")))


# Resampling.


def of_times(function, rate: float = 120.0, count: int = 121) -> MotionCapture:
    times = np.arange(count) / rate
    joints = np.stack([function(times), -function(times), 0 * times], axis=-1)[:, None]
    return MotionCapture(("a",), (-1,), np.zeros((1, 3)), joints, rate, ())


def test_resampling_is_exact_for_cubics_inside() -> None:
    def cubic(t: np.ndarray) -> np.ndarray:
        return 1 + 2 * t - 3 * t**2 + t**3

    found = resample_motion(of_times(cubic), rate=50, start=0.1, stop=0.9)
    times = 0.1 + np.arange(40) / 50
    assert found.joints.shape == (40, 1, 3)
    assert found.frame_rate == 50
    np.testing.assert_allclose(found.joints[:, 0, 0], cubic(times), atol=1e-12)


def test_resampling_follows_a_fast_limb() -> None:
    """A hand that swings half a metre twice a second: to a few micrometres, ends included."""

    def swing(t: np.ndarray) -> np.ndarray:
        return 0.25 * np.sin(4 * np.pi * t + 0.3)

    found = resample_motion(of_times(swing), rate=50)
    times = np.arange(len(found.joints)) / 50
    assert times[-1] == 1.0
    error = np.abs(found.joints[:, 0, 0] - swing(times))
    assert error[3:-3].max() < 5e-6
    assert error.max() < 5e-5


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_resampling_short_motions(count: int) -> None:
    def line(t: np.ndarray) -> np.ndarray:
        return 3 * t

    found = resample_motion(of_times(line, rate=10, count=count), rate=20)
    assert len(found.joints) == 2 * count - 1
    np.testing.assert_allclose(found.joints[:, 0, 0], 3 * np.arange(2 * count - 1) / 20)


@pytest.mark.parametrize(
    "options",
    [
        {"rate": 0},
        {"rate": math.nan},
        {"rate": 50, "start": -1},
        {"rate": 50, "start": 2},
        {"rate": 50, "start": 0.5, "stop": 0.5},
        {"rate": 50, "start": math.nan},
    ],
)
def test_parts_that_are_none(options: dict) -> None:
    with pytest.raises(ConfigurationError, match="expected"):
        resample_motion(of_times(np.sin), **options)


# Whatever is wrong with a file is one error that says where.


def check_error(path: Path, match: str, **options) -> None:
    with pytest.raises(MotionCaptureError, match=match) as caught:
        read_motion_capture(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert path.stem in message


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("HIERARCHY", "HIERARCHIE", "line 1: expected HIERARCHY"),
        ("ROOT", "JOINT", "line 2: expected ROOT"),
        ("ROOT Hips", "ROOT", "line 3: expected a name"),
        ("JOINT Chest", "JOINT Hips", "line 6: expected a name of its own"),
        ("OFFSET 0.0 60.0 0.0", "OFFSET 0.0 60.0", "line 8: expected three numbers"),
        ("OFFSET 0.0 60.0 0.0", "OFFSET 0.0 nan 0.0", "line 8: expected three numbers"),
        ("OFFSET 0.0 60.0 0.0", "0.0 60.0 0.0", "line 8: expected OFFSET"),
        ("CHANNELS 3 Xrotation", "CHANNELS 4 Xrotation", "line 9: expected Xposition"),
        ("CHANNELS 3 Xrotation", "CHANNELS three Xrotation", "line 9: expected a number"),
        ("CHANNELS 3 Xrotation", "CHANNELS 3 Zrotation", "line 9: expected every channel once"),
        ("CHANNELS 3 Xrotation", "CHANNELS 3 Wrotation", "line 9: expected Xposition"),
        ("End Site", "End", "line 11: expected a name"),
        ("MOTION", "}", "line 25: expected MOTION"),
        ("Frames: 2", "Frames: 3", "3 frames, as Frames: says"),
        ("Frames: 2", "Frames: 1", "1 frames, as Frames: says"),
        ("Frames: 2", "Frames: two", "line 26: expected a number of frames"),
        ("Frames: 2", "Frames: " + "9" * 5000, "line 26: expected a number of frames"),
        ("Frames: 2", "Frame: 2", "line 26: expected Frames"),
        ("Frame Time: .0083333", "Frame Time: 0", "line 27: expected the seconds"),
        ("Frame Time: .0083333", "Frame Time: x", "line 27: expected the seconds"),
        ("Frame Time: .0083333", "Time: 1", "line 27: expected Frame Time"),
        ("-20 -30\n1", "-20\n1", "line 28: expected 12 numbers"),
        ("-20 -30\n1", "-20 -30 5\n1", "line 28: expected 12 numbers"),
        ("-20 -30\n1", "-20 inf\n1", "line 28: expected numbers"),
        ("-20 -30\n1", "-20 0x3\n1", "line 28: expected numbers"),
        ("1 2 4", "1e308 1e308 1e308", "line 29: expected numbers"),
    ],
)
def test_bad_bvh(tmp_path: Path, old: str, new: str, match: str) -> None:
    assert old in BVH
    # In a unit of its own, so that a number near the greatest overflows.
    options = {"units": 100.0} if "308" in new else {}
    check_error(write_bvh(tmp_path, BVH.replace(old, new, 1)), match, **options)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        (":bonedata", ":bones", "expected a section :bonedata"),
        (":hierarchy", "", "expected a section :hierarchy"),
        (":root", "", "expected a section :root"),
        ("order TX", "# order TX", "line 10: expected an order"),
        ("order TX TY TZ", "order TX TY TW", "line 11: expected degrees of freedom"),
        ("order TX TY TZ", "order TX TY TY", "line 11: expected every degree of freedom once"),
        ("position 0 0 0", "position 0 0", "line 13: expected three numbers"),
        ("name leg", "name hip", "line 23: expected a name of its own"),
        ("name leg", "name foot", "bones of :bonedata, each once"),
        ("length 14", "length nan", "line 27: expected 1 numbers"),
        ("length 14", "", "line 23: expected length of a bone"),
        ("direction 0 -1 0", "direction 0 -1", "line 23: expected direction of a bone"),
        ("axis 10 20 30 XYZ", "axis 10 20 30 XXZ", "line 28: expected an order"),
        ("dof rx ry rz", "dof rx ry l", "line 29: expected degrees of freedom"),
        ("dof rx ry rz", "dof tx ry rz", "line 29: expected degrees of freedom"),
        ("    axis 0 0 0 XYZ\n  end", "    axis 0 0 0 XYZ", "line 22: expected begin ... end"),
        ("root hip back\n    hip leg", "hip leg\n root hip back", "bones after their parents"),
        ("hip leg", "", "none for leg"),
        ("length 0.45", "length x", "line 6: expected a length"),
    ],
)
def test_bad_asf(tmp_path: Path, old: str, new: str, match: str) -> None:
    assert old in ASF
    check_error(write_acclaim(tmp_path, ASF.replace(old, new, 1)), match)


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("leg 40 50 60", "leg 40 50", "line 6: expected 3 numbers for leg"),
        ("leg 40 50 60", "leg 40 50 60 70", "line 6: expected 3 numbers for leg"),
        ("leg 40 50 60", "leg 40 50 nan", "line 6: expected numbers"),
        ("leg 40 50 60", "arm 40 50 60", "line 6: expected a bone of the skeleton"),
        ("leg 40 50 60", "hip 40 50 60", "line 6: expected a bone of the skeleton"),
        ("leg 40 50 60", "root 1 2 3 4 5 6", "line 6: expected every bone once"),
        ("leg 40 50 60\n", "", "line 7: expected all bones in the frame before, .* leg"),
        ("back -10 -25\n", "", "line 10: expected all bones in the frame before, .* back"),
        ("\n2\n", "\n4\n", "line 8: expected the frame after 1"),
        ("\n1\n", "\n", "line 4: expected the number of the first frame"),
        ("\n1\n", "\n" + "9" * 5000 + "\n", "a frame number"),
    ],
)
def test_bad_amc(tmp_path: Path, old: str, new: str, match: str) -> None:
    assert old in AMC
    check_error(write_acclaim(tmp_path, amc=AMC.replace(old, new, 1)), match)


def test_no_frames(tmp_path: Path) -> None:
    check_error(write_acclaim(tmp_path, amc="#\n:DEGREES\n"), "expected frames")
    head = BVH[: BVH.index("1 2 3")]
    check_error(write_bvh(tmp_path, head), "2 frames, as Frames: says")
    check_error(
        write_bvh(tmp_path, head.replace("Frames: 2", "Frames: 0")), "skeleton without motion"
    )
    check_error(write_bvh(tmp_path, BVH[: BVH.index("Frames")]), "line 25: expected Frames")


@pytest.mark.parametrize("suffix", ["bvh", "asf", "amc"])
def test_bad_files(tmp_path: Path, suffix: str) -> None:
    write_acclaim(tmp_path)
    write_bvh(tmp_path)
    path = tmp_path / f"motion.{suffix}"
    text = path.read_text()

    def check(match: str) -> None:
        with pytest.raises(MotionCaptureError, match=match) as caught:
            read_motion_capture(path if suffix == "bvh" else tmp_path / "motion.amc")
        assert str(path) in str(caught.value)

    path.write_bytes(b" \n")
    check("empty")
    path.write_bytes(b"\xe4" + text.encode())
    check("line 1: not text in UTF-8")
    path.write_bytes(text.encode()[:30] + b"\0" + text.encode()[30:])
    check("not text in UTF-8")
    path.write_text("# H\xfcfte\n" + text, encoding="latin-1")
    check("line 1: not text in UTF-8")
    path.write_text({"bvh": ASF, "asf": BVH, "amc": BVH}[suffix])
    check("expected")
    path.write_text("PK\x03\x04 nothing of this kind")
    check("expected")
    path.unlink()
    if suffix == "asf":
        with pytest.raises(MotionCaptureError, match=r"no motion\.asf beside it"):
            read_motion_capture(tmp_path / "motion.amc")
    path.mkdir()
    if suffix != "asf":
        check("expected a file, found a folder")


def test_other_files_are_refused(tmp_path: Path) -> None:
    check_error(tmp_path / "absent.bvh", "no such file")
    check_error(tmp_path / "motion.fbx", r"expected a \.bvh file")
    check_error(write_acclaim(tmp_path).with_suffix(".asf"), r"expected a \.bvh file")
    with pytest.raises(MotionCaptureError, match="no such file"):
        read_motion_capture(tmp_path / "motion.amc", skeleton=tmp_path / "absent.asf")
    with pytest.raises(MotionCaptureError, match="cannot be read"):
        read_motion_capture("a\0.bvh")


def test_line_ends_and_byte_order_mark_do_not_matter(tmp_path: Path) -> None:
    plain = read_motion_capture(write_bvh(tmp_path))
    path = tmp_path / "motion.bvh"
    for ends in ("\r\n", "\r"):
        path.write_bytes(b"\xef\xbb\xbf" + BVH.replace("\n", ends).encode())
        np.testing.assert_array_equal(read_motion_capture(path).joints, plain.joints)


# Anything at all may be in a file.

WORDS = st.sampled_from(
    ["{", "}", "JOINT", "ROOT", "OFFSET", "CHANNELS", "MOTION", "End Site", "Frames: 1", "begin",
     "end", ":root", ":bonedata", ":hierarchy", "root", "leg", "dof", "rx", "1", "-1", "0", "nan",
     "1e999", "1e308", "99999999999", "name", "axis", "", "\n", "\0", "\x85", "٣"]
)  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, text: str) -> str:
    """A text with words replaced, lines dropped or doubled, and its end cut off."""
    for _ in range(draw(st.integers(0, 3))):
        lines = text.split("\n")
        row = draw(st.integers(0, len(lines) - 1))
        action = draw(st.sampled_from(["word", "drop", "double", "swap", "insert"]))
        if action == "word":
            words = lines[row].split(" ")
            words[draw(st.integers(0, len(words) - 1))] = draw(WORDS | st.text(max_size=5))
            lines[row] = " ".join(words)
        elif action == "drop":
            del lines[row]
        elif action == "double":
            lines.insert(row, lines[row])
        elif action == "swap":
            other = draw(st.integers(0, len(lines) - 1))
            lines[row], lines[other] = lines[other], lines[row]
        else:
            lines.insert(row, draw(WORDS | st.text(max_size=10)))
        text = "\n".join(lines)
    return text[: draw(st.integers(len(text) // 2, len(text)))] if draw(st.booleans()) else text


def read_or_refuse(path: Path) -> None:
    refused, motion = "", None
    try:
        motion = read_motion_capture(path)
    except MotionCaptureError as error:
        refused = str(error)
    if motion is None:
        assert "\n" not in refused
        assert str(path.with_suffix("")) in refused
    else:
        assert np.isfinite(motion.joints).all()
        assert motion.joints.shape[1:] == (len(motion.joint_names), 3)
        assert all(parent < index for index, parent in enumerate(motion.parents))


FUZZ = settings(deadline=None, max_examples=150, suppress_health_check=list(HealthCheck))


@FUZZ
@given(text=damaged(BVH))
def test_any_bvh_is_read_or_refused(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "motion.bvh"
        path.write_text(text, encoding="utf-8", errors="surrogatepass")
        read_or_refuse(path)


@FUZZ
@given(asf=damaged(ASF), amc=damaged(AMC))
def test_any_acclaim_is_read_or_refused(asf: str, amc: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "motion.amc"
        path.write_text(amc, encoding="utf-8", errors="surrogatepass")
        path.with_suffix(".asf").write_text(asf, encoding="utf-8", errors="surrogatepass")
        read_or_refuse(path)


@FUZZ
@given(data=st.binary(max_size=200), suffix=st.sampled_from(["bvh", "amc", "asf"]))
def test_any_bytes_are_refused(data: bytes, suffix: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write_acclaim(Path(folder))
        path = Path(folder) / f"motion.{suffix}"
        path.write_bytes(data)
        with pytest.raises(MotionCaptureError):
            read_motion_capture(path if suffix == "bvh" else path.with_suffix(".amc"))
