"""The one place that knows what every program calls a joint."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcss.joint_names import (
    ALIASES,
    JOINT_NAMES,
    LIMB_WORDS,
    canonical_joint_name,
    layout_of_names,
    skeleton_joint_names,
)


def test_tables_hold_catalogue_names_once() -> None:
    assert len(set(JOINT_NAMES)) == len(JOINT_NAMES)
    for names in ALIASES.values():
        known = [name for name in names if name is not None]
        assert set(known) <= set(JOINT_NAMES)
        assert len(set(known)) == len(known)


@pytest.mark.parametrize(
    ("layout", "size"),
    [
        ("BODY_25", 25), ("BODY_25B", 25), ("COCO-17", 17), ("COCO-18", 18),
        ("MediaPipe-33", 33), ("H36M-17", 17), ("SMPL-24", 24), ("H-Anim", len(JOINT_NAMES)),
        ("Halpe-26", 26), ("Halpe-136", 136),
    ],
)  # fmt: skip
def test_sizes_and_symmetry(layout: str, size: int) -> None:
    names = ALIASES[layout]
    assert len(names) == size
    left = {name[2:] for name in names if name and name.startswith("l_")}
    right = {name[2:] for name in names if name and name.startswith("r_")}
    assert left == right


def test_body_25_gives_coco_by_openpose_table() -> None:
    # The list that the field uses to turn one into the other.
    order = [0, 16, 15, 18, 17, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11]
    assert tuple(ALIASES["BODY_25"][index] for index in order) == ALIASES["COCO-17"]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("LShoulder", "l_shoulder"), ("left_shoulder", "l_shoulder"), ("l_shoulder", "l_shoulder"),
        ("L.Shoulder", "l_shoulder"), ("shoulder_l", "l_shoulder"), ("lshoulder", "l_shoulder"),
        ("leftShoulder", "l_shoulder"), ("Left Shoulder", "l_shoulder"), ("REar", "r_ear"),
        ("RIGHT_ANKLE", "r_ankle"), ("heel_right", "r_heel"), ("RBigToe", "r_toe"),
        ("right_foot_index", "r_toe"), ("left_foot", "l_midtarsal"), ("leye", "l_eye"),
        ("Head", "skull_tip"), ("HeadTop", "skull_tip"), ("UpperNeck", "vc7"),
        ("skullbase", "skullbase"),
        ("Neck", "vt1"), ("thorax", "vt1"), ("MidHip", "HumanoidRoot"), ("Hip", "HumanoidRoot"),
        ("pelvis", "HumanoidRoot"), ("RHip", "r_hip"), ("nose", "nose"),
        ("LSmallToe", None), ("left_hand", None), ("shoulder", None), ("LNeck", None),
        ("left_eye_inner", None), ("", None), ("left", None), ("tail", None),
    ],
)  # fmt: skip
def test_free_spellings(name: str, expected: str | None) -> None:
    assert canonical_joint_name(name) == expected


def test_catalogue_names_are_fixed_points() -> None:
    assert layout_of_names(JOINT_NAMES) == JOINT_NAMES


def test_second_of_the_same_place_stays_unknown() -> None:
    assert layout_of_names(("LWrist", "left_wrist", "tail")) == ("l_wrist", None, None)


@given(st.text(max_size=30))
def test_any_text_is_a_name_or_none(name: str) -> None:
    assert canonical_joint_name(name) in (None, *JOINT_NAMES)


def test_names_of_the_real_file(shared_data) -> None:
    with np.load(shared_data / "balance_beam_4cam" / "keypoints2d_cam01.npz") as archive:
        names = tuple(str(name) for name in archive["joint_names"])
    assert layout_of_names(names) == ALIASES["BODY_25B"]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (
            ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot", "LeftToeBase", "LeftToeBase_end",
             "LeftShoulder", "LeftArm", "LeftForeArm", "LeftHand", "Neck", "Head", "Head_end"),
            (None, "l_hip", "l_knee", "l_ankle", "l_midtarsal", "l_toe",
             None, "l_shoulder", "l_elbow", "l_wrist", "vt1", "skullbase", "skull_tip"),
        ),
        (
            ("mixamorig:RightUpLeg", "mixamorig:RightLeg", "mixamorig:RightArm"),
            ("r_hip", "r_knee", "r_shoulder"),
        ),
        (("lfemur", "ltibia", "lhumerus", "lradius"), ("l_hip", "l_knee", "l_shoulder", "l_elbow")),
        (("right_thigh", "right_shin", "left_upper_arm", "left_lower_arm"),
         ("r_hip", "r_knee", "l_shoulder", "l_elbow")),
        (("lThigh", "lShin", "rShldr", "rForeArm"), ("l_hip", "l_knee", "r_shoulder", "r_elbow")),
        (("thigh.L", "shin.L", "upper_arm.R"), ("l_hip", "l_knee", "r_shoulder")),
        (("LeftHip", "LeftKnee", "LeftShoulder", "link3"),
         ("l_hip", "l_knee", "l_shoulder", None)),
        (("panda_link1", "panda_hand"), (None, None)),
        (("hips_JNT", "l_upleg_JNT", "l_leg_JNT", "l_shoulder_JNT", "l_arm_JNT", "l_forearm_JNT"),
         (None, "l_hip", "l_knee", None, "l_shoulder", "l_elbow")),
        (("l_shoulder", "l_up_arm", "l_low_arm", "l_up_leg", "l_low_leg"),
         (None, "l_shoulder", "l_elbow", "l_hip", "l_knee")),
        (("LeftArmUpper", "LeftArmLower", "LeftHandWrist", "LeftLegLower", "LeftFootAnkle"),
         ("l_shoulder", "l_elbow", "l_wrist", "l_knee", "l_ankle")),
        # Unreal; twists and inverse kinematics beside the limbs.
        (("pelvis", "spine_01", "clavicle_l", "upperarm_l", "upperarm_twist_01_l", "lowerarm_l",
          "hand_l", "index_01_l", "thigh_l", "calf_l", "foot_l", "ball_l", "ik_hand_l", "neck_01"),
         (None, None, None, "l_shoulder", None, "l_elbow", "l_wrist", None, "l_hip", "l_knee",
          "l_ankle", "l_midtarsal", None, "vt1")),
        # Rigify's second halves, Genesis' twists.
        (("DEF-upper_arm.R", "DEF-upper_arm.R.001", "DEF-forearm.R", "DEF-hand.R", "DEF-thigh.R"),
         ("r_shoulder", None, "r_elbow", "r_wrist", "r_hip")),
        (("lThighBend", "lThighTwist", "lShin", "lFoot", "lShldrBend", "lForearmBend", "lHand"),
         ("l_hip", None, "l_knee", "l_ankle", "l_shoulder", "l_elbow", "l_wrist")),
        # Xsens and Kinect name joints, and have feet beside ankles, hands beside wrists.
        (("Hips", "RightCollar", "RightShoulder", "RightElbow", "RightWrist", "RightHip",
          "RightKnee", "RightAnkle", "RightToe", "Head"),
         (None, None, "r_shoulder", "r_elbow", "r_wrist", "r_hip", "r_knee", "r_ankle",
          "r_midtarsal", "skullbase")),
        (("AnkleLeft", "FootLeft", "WristLeft", "HandLeft", "SpineBase"),
         ("l_ankle", "l_midtarsal", "l_wrist", None, None)),
        (("leftUpperLeg", "leftLowerLeg", "leftFoot", "leftShoulder", "leftUpperArm"),
         ("l_hip", "l_knee", "l_ankle", None, "l_shoulder")),
        (("upperarmleft", "lowerarmleft", "handleft", "thighright", "calfright", "footright"),
         ("l_shoulder", "l_elbow", "l_wrist", "r_hip", "r_knee", "r_ankle")),
        (("lf_hip", "lf_knee", "rt_hip", "rt_ankle"), ("l_hip", "l_knee", "r_hip", "r_ankle")),
        (("Lft_Hip", "Rgt_Knee", "Rgt_Shoulder"), ("l_hip", "r_knee", "r_shoulder")),
        (("femur_l", "tibia_l", "talus_l", "humerus_r", "radius_r", "hand_r"),
         ("l_hip", "l_knee", "l_ankle", "r_shoulder", "r_elbow", "r_wrist")),
        (("LThigh", "LShin", "LFoot", "LShoulder", "LUArm", "LFArm", "LHand"),
         ("l_hip", "l_knee", "l_ankle", None, "l_shoulder", "l_elbow", "l_wrist")),
        # Robots: NAO, Atlas; digitigrade Digit, whose toe turns below a tarsus.
        (("LHip", "LThigh", "LTibia", "LAnklePitch", "l_ankle", "LBicep", "LElbow", "LForeArm"),
         (None, "l_hip", "l_knee", None, "l_ankle", "l_shoulder", "l_elbow", None)),
        (("l_lglut", "l_uleg", "l_lleg", "l_talus", "l_foot", "l_clav", "l_uarm", "l_larm"),
         (None, "l_hip", "l_knee", None, "l_ankle", None, "l_shoulder", "l_elbow")),
        (("left_knee", "left_shin", "left_tarsus", "left_toe_pitch"), ("l_knee", None, None, None)),
        (("Hip_Roll_Left", "Shank_Left", "left_foot_link", "left_hand_link"),
         ("l_hip", "l_knee", "l_ankle", None)),
        (("lleg", "rleg", "lfoot"), (None, None, "l_ankle")),
    ],
)  # fmt: skip
def test_skeletons_name_joints_by_what_they_move(
    names: tuple[str, ...], expected: tuple[str | None, ...]
) -> None:
    assert skeleton_joint_names(names) == expected


TURNS = {
    # Unitree's G1 and H1, Booster's T1, OP3, Apollo, Fourier's GR1, EngineAI's, Valkyrie.
    "hip_pitch hip_roll* hip_yaw knee* ankle_pitch ankle_roll* shoulder_pitch shoulder_roll* "
    "shoulder_yaw elbow* wrist_roll wrist_pitch* wrist_yaw": "left_{0}_link",
    "hip_yaw hip_roll hip_pitch* knee* ankle* shoulder_pitch shoulder_roll* shoulder_yaw "
    "elbow_pitch* elbow_roll": "{0}_left",
    "Hip_Pitch Hip_Roll* Hip_Yaw Shank* Ankle_Cross": "{0}_Left",
    "sho_pitch sho_roll* el* hip_yaw hip_roll hip_pitch* knee* ank_pitch ank_roll*": "l_{0}_link",
    "shoulder_aa shoulder_ie shoulder_fe* elbow_fe* hip_ie hip_aa hip_fe* knee_fe*": "l_{0}_link",
    "thigh_roll thigh_yaw thigh_pitch* shank_pitch* foot_pitch foot_roll* upper_arm_pitch "
    "upper_arm_roll* upper_arm_yaw lower_arm_pitch* hand_yaw hand_pitch*": "left_{0}_link",
    "HIP_PITCH HIP_ROLL* HIP_YAW KNEE_PITCH* ELBOW_PITCH* ELBOW_YAW": "LINK_{0}_L",
    "HipYawLink HipRollLink HipPitchLink* KneePitchLink* ElbowPitchLink* ForearmLink": "left{0}",
}
"""Links that turn one joint about an axis each; with a star those where it is."""


@pytest.mark.parametrize("links", TURNS)
def test_a_joint_of_several_links_is_where_the_limb_starts_to_swing(links: str) -> None:
    form = TURNS[links]
    names = [f.format(each) for f in (form, other_side(form)) for each in links.split()]
    found = skeleton_joint_names([name.replace("*", "") for name in names])
    assert [name is not None for name in found] == ["*" in name for name in names]
    half = len(found) // 2
    assert [name and name.replace("l_", "r_", 1) for name in found[:half]] == list(found[half:])


@given(st.lists(st.text(max_size=12), max_size=6))
def test_any_skeleton_has_names_or_none(names: list[str]) -> None:
    found = skeleton_joint_names(names)
    assert len(found) == len(names)
    assert len([name for name in found if name]) == len({name for name in found if name})


SIDES = {
    "left_{0}": str, "l_{0}": str, "L_{0}": str, "{0}_l": str, "{0}.L": str, "{0}_Left": str,
    "l{0}": str, "left{0}": str, "Left{0}": str.title, "L{0}": str.title, "l{0} ": str.title,
    "{0}Left": str.title, "{0} L": str.title, "Bip01 L {0}": str.title,
    "ValveBiped.Bip01_L_{0}": str.title, "J_Bip_L_{0}": str.title, "CC_Base_L_{0}": str.title,
    "mixamorig:Left{0}": str.title, "mixamorigLeft{0}": str.title, "DEF-{0}.L": str,
    "m{0}Left": str.title, "Actor:Left{0}": str.title,
}  # fmt: skip
"""Where programs put the side, here the left one, and how they write the rest."""


def other_side(form: str) -> str:
    """The same way of writing for the right side."""
    for left, right in (("Left", "Right"), ("left", "right"), ("_L_", "_R_"), (" L ", " R ")):
        if left in form:
            return form.replace(left, right)
    for left, right in (("L_", "R_"), ("l_", "r_"), ("_l", "_r"), (".L", ".R"), (" L", " R"),
                        ("_L", "_R")):  # fmt: skip
        if left in form:
            return form.replace(left, right)
    return form.replace("l{", "r{").replace("L{", "R{")


@pytest.mark.parametrize("form", SIDES)
@pytest.mark.parametrize("choice", range(max(map(len, LIMB_WORDS.values()))))
def test_every_name_of_a_limb_with_every_side(form: str, choice: int) -> None:
    """Both sides alike, whichever words a program uses and wherever the side stands."""
    words = {place: names[min(choice, len(names) - 1)] for place, names in LIMB_WORDS.items()}
    expected, names = [], []
    for side, spelling in (("l", form), ("r", other_side(form))):
        for place, word in words.items():
            names.append(spelling.format(SIDES[form](word)))
            expected.append(f"{side}_{place}")
    assert len(set(names)) == 12
    if {"arm", "leg"} & set(words.values()) and not {"upleg", "forearm"} & set(words.values()):
        return  # alone they mean a whole limb
    assert skeleton_joint_names(names) == tuple(expected)
