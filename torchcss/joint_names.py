"""Joint names: the catalogue's own, and what every other program calls the same places.

The package speaks H-Anim (ISO/IEC 19774) names, completed by a few landmarks that detectors give
and H-Anim does not name as joints (nose, eyes, ears, toes, heels, fingertips). `JOINT_NAMES` lists
them all; `ALIASES` says, for the fixed orders in which detectors and data sets store joints, which
of ours each column is; `canonical_joint_name` recognises a free spelling.

A column that is no place of ours (small toe, knuckle, inner eye, mid-spine) is `None`: a joint
that lies some centimetres off is worse than a missing one. Two namings need care:

* `vt1` is the base of the neck, what OpenPose calls Neck: the midpoint of the shoulders.
* `vc7` is the lowest neck vertebra, 5 to 7 cm above the shoulder line, what BODY_25B calls upper
  neck; `skullbase` is where the head turns on the neck; `skull_tip` is the top of the head.

By default call `canonical_joint_name` for files with names, `ALIASES` for files without, and
`skeleton_joint_names` for the joints of an animator's or a robot's skeleton, whose names differ.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

_PAIRED = (
    "hip", "knee", "ankle", "midtarsal", "toe", "heel",
    "eye", "ear", "shoulder", "elbow", "wrist", "hand_tip",
)  # fmt: skip
_SINGLE = ("HumanoidRoot", "vl5", "vt1", "vc7", "skullbase", "skull_tip", "nose")

JOINT_NAMES: Final[tuple[str, ...]] = (
    "HumanoidRoot",
    "l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle",
    "l_midtarsal", "r_midtarsal", "l_toe", "r_toe", "l_heel", "r_heel",
    "vl5", "vt1", "vc7", "skullbase", "skull_tip",
    "nose", "l_eye", "r_eye", "l_ear", "r_ear",
    "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist",
    "l_hand_tip", "r_hand_tip",
)  # fmt: skip
"""Every joint and landmark that the bodies of this package name."""

# AlphaPose's body with feet: COCO's order, then MPII's head top, upper neck and hips' middle, then
# big toes, small toes and heels. Face and hands follow in the layout of 136.
_HALPE_26: Final[tuple[str | None, ...]] = (
    "nose", "l_eye", "r_eye", "l_ear", "r_ear",
    "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist",
    "l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle",
    "skull_tip", "vc7", "HumanoidRoot",
    "l_toe", "r_toe", None, None, "l_heel", "r_heel",
)  # fmt: skip

ALIASES: Final[dict[str, tuple[str | None, ...]]] = {
    # OpenPose's default: 1 Neck, 8 MidHip, 19 to 24 the feet (big toe, small toe, heel).
    "BODY_25": (
        "nose", "vt1",
        "r_shoulder", "r_elbow", "r_wrist", "l_shoulder", "l_elbow", "l_wrist",
        "HumanoidRoot", "r_hip", "r_knee", "r_ankle", "l_hip", "l_knee", "l_ankle",
        "r_eye", "l_eye", "r_ear", "l_ear",
        "l_toe", None, "l_heel", "r_toe", None, "r_heel",
    ),
    # OpenPose's experimental model: COCO's order, upper neck and head top, then the feet.
    "BODY_25B": (
        "nose", "l_eye", "r_eye", "l_ear", "r_ear",
        "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist",
        "l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle",
        "vc7", "skull_tip",
        "l_toe", None, "l_heel", "r_toe", None, "r_heel",
    ),
    "COCO-17": (
        "nose", "l_eye", "r_eye", "l_ear", "r_ear",
        "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist",
        "l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle",
    ),
    "COCO-18": (
        "nose", "vt1",
        "r_shoulder", "r_elbow", "r_wrist", "l_shoulder", "l_elbow", "l_wrist",
        "r_hip", "r_knee", "r_ankle", "l_hip", "l_knee", "l_ankle",
        "r_eye", "l_eye", "r_ear", "l_ear",
    ),
    # MMPose, RTMPose and DWPose: COCO's order and the feet, then face and hands.
    "COCO-133": (
        "nose", "l_eye", "r_eye", "l_ear", "r_ear",
        "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist",
        "l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle",
        "l_toe", None, "l_heel", "r_toe", None, "r_heel",
        *(None,) * 110,
    ),
    "MPII-16": (
        "r_ankle", "r_knee", "r_hip", "l_hip", "l_knee", "l_ankle",
        "HumanoidRoot", "vt1", "vc7", "skull_tip",
        "r_wrist", "r_elbow", "r_shoulder", "l_shoulder", "l_elbow", "l_wrist",
    ),
    # The head's place is its middle, which is none of ours.
    "HumanEva-15": (
        "HumanoidRoot", "vt1", "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow",
        "r_wrist", "l_hip", "l_knee", "l_ankle", "r_hip", "r_knee", "r_ankle", None,
    ),
    # The first 18 of BODY_25, the middle of the hips among them.
    "BODY_18": (
        "nose", "vt1",
        "r_shoulder", "r_elbow", "r_wrist", "l_shoulder", "l_elbow", "l_wrist",
        "HumanoidRoot", "r_hip", "r_knee", "r_ankle", "l_hip", "l_knee", "l_ankle",
        "r_eye", "l_eye", "r_ear",
    ),
    "Halpe-26": _HALPE_26,
    "Halpe-136": (*_HALPE_26, *(None,) * 110),
    # The eyes' inner and outer corners, the mouth and the knuckles are no joints of ours.
    "MediaPipe-33": (
        "nose", None, "l_eye", None, None, "r_eye", None, "l_ear", "r_ear", None, None,
        "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist",
        None, None, None, None, None, None,
        "l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle",
        "l_heel", "r_heel", "l_toe", "r_toe",
    ),
    # 7 is the middle of the spine and 9 lies between nose and neck: neither is a place of ours.
    "H36M-17": (
        "HumanoidRoot", "r_hip", "r_knee", "r_ankle", "l_hip", "l_knee", "l_ankle",
        None, "vt1", None, "skull_tip",
        "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow", "r_wrist",
    ),
    # Without the place between nose and neck.
    "H36M-16": (
        "HumanoidRoot", "r_hip", "r_knee", "r_ankle", "l_hip", "l_knee", "l_ankle",
        None, "vt1", "skull_tip",
        "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow", "r_wrist",
    ),
    # 'foot' is the ball of the foot, 'hand' the knuckles, 'head' the joint under the skull.
    "SMPL-24": (
        "HumanoidRoot", "l_hip", "r_hip", "vl5", "l_knee", "r_knee", None, "l_ankle", "r_ankle",
        None, "l_midtarsal", "r_midtarsal", "vt1", None, None, "skullbase",
        "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist", None, None,
    ),
    "H-Anim": JOINT_NAMES,
}  # fmt: skip
"""Layout name to the catalogue's name of every column, `None` for a place that has none."""

# What else the places are called, written without side, case and separators.
_PLACES: Final[dict[str, str]] = {
    **{name.replace("_", "").lower(): name for name in (*_PAIRED, *_SINGLE)},
    "bigtoe": "toe",
    "footindex": "toe",
    "foot": "midtarsal",
    "forefoot": "midtarsal",
    "ballfoot": "midtarsal",
    "balloffoot": "midtarsal",
    "fingertip": "hand_tip",
    "middletip": "hand_tip",
    "middlefinger4": "hand_tip",
    "middlefingertip": "hand_tip",
    "hip": "hip",
    "pelvis": "HumanoidRoot",
    "root": "HumanoidRoot",
    "midhip": "HumanoidRoot",
    "hipcenter": "HumanoidRoot",
    "lumbar": "vl5",
    "spine1": "vl5",
    "neck": "vt1",
    "neckbase": "vt1",
    "thorax": "vt1",
    "upperneck": "vc7",
    "head": "skull_tip",
    "headtop": "skull_tip",
    "tophead": "skull_tip",
    "skulltip": "skull_tip",
}
_SIDES: Final[dict[str, str]] = {"l": "l_", "left": "l_", "r": "r_", "right": "r_"}


def canonical_joint_name(name: str) -> str | None:
    """Return the catalogue's name for a freely spelt joint.

    Case, separators and the place of the side do not matter: `LShoulder`, `left_shoulder`,
    `L.Shoulder`, `shoulder_l` and `l_shoulder` are one. `Head` alone is the top of the head
    (a detector's meaning); `Hip` alone is the middle of the hips.

    Args:
        name: A joint name of any program.

    Returns:
        A member of `JOINT_NAMES`, or `None` if the place is none of the catalogue's.
    """
    # Words: at every change from lower to upper case, before the last capital of a run of them
    # (LBigToe is L Big Toe), and at everything that is neither letter nor digit.
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", name)
    words = [word for word in re.split(r"[^a-z0-9]+", spaced.lower()) if word]
    side = ""
    for end in (0, -1):
        if len(words) > 1 and words[end] in _SIDES:
            side = _SIDES[words.pop(end)]
            break
    place = "".join(words)
    if not side:
        # lshoulder, leftshoulder: the side is glued to the word.
        for prefix in ("left", "right", "l", "r"):
            if place.startswith(prefix) and _PLACES.get(place.removeprefix(prefix)) in _PAIRED:
                side, place = _SIDES[prefix], place.removeprefix(prefix)
                break
    if not side and place == "hip":
        return "HumanoidRoot"
    known = _PLACES.get(place)
    if known is None or (known in _PAIRED) != bool(side):
        return None
    return side + known


def layout_of_names(names: tuple[str, ...]) -> tuple[str | None, ...]:
    """Return the catalogue's name of every column of a file that names its columns.

    Where two columns are the same place, the first has it and the others stay unknown.

    Args:
        names: The file's own joint names.

    Returns:
        A catalogue name or `None` for every column.
    """
    found: list[str | None] = []
    for name in names:
        canonical = canonical_joint_name(name) or _numbered_side(name, names)
        found.append(None if canonical in found else canonical)
    return tuple(found)


def _numbered_side(name: str, names: Sequence[str]) -> str | None:
    """DeepLabCut's human model numbers the sides: ankle1 is the right one, ankle2 the left."""
    pairs = [re.fullmatch(r"([a-z]+)[ _]?([12])", each.lower()) for each in names]
    numbered = {match[1] for match in pairs if match}
    if not {"ankle", "knee", "hip", "wrist", "elbow", "shoulder"} <= numbered:
        return None
    match = re.fullmatch(r"([a-z]+)[ _]?([12])", name.lower())
    return None if match is None else canonical_joint_name(f"{'rl'[int(match[2]) - 1]}_{match[1]}")


LIMB_PLACES: Final[tuple[str, ...]] = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
_SKELETONS: Final[tuple[dict[str, str], ...]] = tuple(
    dict(zip(names, LIMB_PLACES, strict=True))
    for names in (
        # MotionBuilder, Mixamo, the BVH conversions of the CMU database.
        ("upleg", "leg", "foot", "arm", "forearm", "hand"),
        # Acclaim's bones by their starts, as in models for MuJoCo.
        ("femur", "tibia", "foot", "humerus", "radius", "hand"),
        ("thigh", "shin", "foot", "upperarm", "lowerarm", "hand"),
        # Poser and DAZ Studio, and the BVH conversions of the CMU database that were made for them.
        ("thigh", "shin", "foot", "shldr", "forearm", "hand"),
    )
)
"""What skeletons call the joint in which a limb's segment starts, without side and prefix."""

_ENDS: Final[dict[str, str]] = dict(
    zip(("hipjoint", "femur", "tibia", "clavicle", "humerus", "wrist"), LIMB_PLACES, strict=True)
)
"""The same where joints are the ends of Acclaim's bones. `radius` and `wrist` together are the
forearm, cut where it twists."""

_SKELETON_PLACES: Final[dict[str, str]] = {
    "neck": "vt1",
    "head": "skullbase",
    "headend": "skull_tip",
    "headtopend": "skull_tip",
    "toebase": "midtarsal",
    "toes": "midtarsal",
    "toebaseend": "toe",
    "toeend": "toe",
}
"""Other joints of skeletons that are places of ours; `head` is where it turns, not its top."""


def skeleton_joint_names(names: Sequence[str], *, ends: bool = False) -> tuple[str | None, ...]:
    """Return which of the catalogue's joints the joints of a skeleton are.

    A skeleton's joint is called after what it moves: `LeftArm` and `lhumerus` are shoulders, and
    then `LeftShoulder` is the collar bone's joint. Which way of naming a file follows is what most
    of its names fit; a file that follows none is read as by `canonical_joint_name`.

    Args:
        names: The skeleton's joint names.
        ends: Whether Acclaim's joints are the ends of the bones that they are called after.

    Returns:
        A member of `JOINT_NAMES`, each once, or `None`, for every joint.
    """
    candidates: list[list[str | None]] = [
        [_skeleton_place(name, layout) for name in names]
        for layout in (*((_ENDS,) if ends else ()), *_SKELETONS, None)
    ]
    best = max(candidates, key=lambda found: len({name for name in found if name}))
    return tuple(
        name if name is not None and best.index(name) == index else None
        for index, name in enumerate(best)
    )


def _skeleton_place(name: str, layout: Mapping[str, str] | None) -> str | None:
    bare = re.sub(r"[^a-z]", "", name.lower().split(":")[-1].removeprefix("mixamorig"))
    for side in ("left", "right", "l", "r", ""):
        place = bare.removeprefix(side)
        if side and place == bare:
            # Blender's names end in the side: upper_arm.L.
            words = re.split(r"[^a-z]+", name.lower().split(":")[-1])
            place = "".join(words[:-1]) if words[-1] == side else bare
            if place == bare:
                continue
        known = _SKELETON_PLACES.get(place) or (layout or {}).get(place)
        if known is not None and (known in _PAIRED) == bool(side):
            return f"{side[0]}_{known}" if side else known
    return canonical_joint_name(name) if layout is None else None
