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
from collections.abc import Container, Mapping, Sequence
from typing import Final


def names_in(text: str) -> tuple[str, ...]:
    """The names in a text, which spaces part."""
    return tuple(text.split())


def _columns(text: str) -> tuple[str | None, ...]:
    """The same; `-` is a place that has none."""
    return tuple(None if name == "-" else name for name in names_in(text))


def by_word(places: Mapping[str, str]) -> dict[str, str]:
    """The place that every word means, of the words of every place."""
    return {word: place for place, words in places.items() for word in names_in(words)}


JOINT_NAMES: Final = names_in(
    """
    HumanoidRoot
    l_hip r_hip l_knee r_knee l_ankle r_ankle
    l_midtarsal r_midtarsal l_toe r_toe l_heel r_heel
    vl5 vt1 vc7 skullbase skull_tip
    nose l_eye r_eye l_ear r_ear
    l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist
    l_hand_tip r_hand_tip
    """
)
"""Every joint and landmark that the bodies of this package name."""

_PAIRED: Final = tuple(name[2:] for name in JOINT_NAMES if name.startswith("l_"))
_SINGLE: Final = tuple(name for name in JOINT_NAMES if name[:2] not in ("l_", "r_"))

_COCO = _columns(
    "nose l_eye r_eye l_ear r_ear l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist "
    "l_hip r_hip l_knee r_knee l_ankle r_ankle"
)
_COCO_FEET = _columns("l_toe - l_heel r_toe - r_heel")
_OPENPOSE_ARMS = _columns("nose vt1 r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist")
_OPENPOSE_LEGS = _columns("r_hip r_knee r_ankle l_hip l_knee l_ankle")
_OPENPOSE_HEAD = _columns("r_eye l_eye r_ear l_ear")
_BODY_19 = (*_OPENPOSE_ARMS, "HumanoidRoot", *_OPENPOSE_LEGS, *_OPENPOSE_HEAD)
_COCO_18 = (*_OPENPOSE_ARMS, *_OPENPOSE_LEGS, *_OPENPOSE_HEAD)
_H36M = _columns("HumanoidRoot r_hip r_knee r_ankle l_hip l_knee l_ankle - vt1")
_H36M_END = _columns("skull_tip l_shoulder l_elbow l_wrist r_shoulder r_elbow r_wrist")
# AlphaPose's body with feet: COCO's order, then MPII's head top, upper neck and hips' middle, then
# big toes, small toes and heels. Face and hands follow in the layout of 136.
_HALPE = (*_COCO, *_columns("skull_tip vc7 HumanoidRoot l_toe r_toe - - l_heel r_heel"))
_MHR = (
    *(*_COCO[:9], *_COCO[11:], *_COCO_FEET),
    *(*20 * (None,), "r_wrist", *20 * (None,), "l_wrist", *6 * (None,), "vt1"),
)
_FACE_AND_HANDS = (None,) * 110
# The eyes' inner and outer corners, the mouth and the knuckles are no joints of ours.
_MEDIAPIPE = _columns(
    "nose - l_eye - - r_eye - l_ear r_ear - - "
    "l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist - - - - - - "
    "l_hip r_hip l_knee r_knee l_ankle r_ankle l_heel r_heel l_toe r_toe"
)

ALIASES: Final[dict[str, tuple[str | None, ...]]] = {
    # OpenPose's default: 1 Neck, 8 MidHip, 19 to 24 the feet (big toe, small toe, heel).
    "BODY_25": (*_BODY_19, *_COCO_FEET),
    # OpenPose's experimental model: COCO's order, upper neck and head top, then the feet.
    "BODY_25B": (*_COCO, "vc7", "skull_tip", *_COCO_FEET),
    "COCO-17": _COCO,
    "COCO-18": _COCO_18,
    # MMPose, RTMPose and DWPose: COCO's order and the feet, then face and hands.
    "COCO-133": (*_COCO, *_COCO_FEET, *_FACE_AND_HANDS),
    # SAM 3D Body, and Sapiens with a face: wrists stand behind their fingers.
    "MHR-70": _MHR,
    "Goliath-308": (*_MHR, *238 * (None,)),
    "MPII-16": _columns(
        "r_ankle r_knee r_hip l_hip l_knee l_ankle HumanoidRoot vt1 vc7 skull_tip "
        "r_wrist r_elbow r_shoulder l_shoulder l_elbow l_wrist"
    ),
    # The head's place is its middle, which is none of ours.
    "HumanEva-15": _columns(
        "HumanoidRoot vt1 l_shoulder l_elbow l_wrist r_shoulder r_elbow r_wrist "
        "l_hip l_knee l_ankle r_hip r_knee r_ankle -"
    ),
    # OpenPose's model of MPII: the last is the middle of the trunk.
    "MPI-15": (
        *_columns("skull_tip vt1 r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist"),
        *_OPENPOSE_LEGS,
        None,
    ),
    "LSP-14": _columns(
        "r_ankle r_knee r_hip l_hip l_knee l_ankle "
        "r_wrist r_elbow r_shoulder l_shoulder l_elbow l_wrist vt1 skull_tip"
    ),
    "CrowdPose-14": (*_COCO[5:], *_columns("skull_tip vt1")),
    "AIC-14": _columns(
        "r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist "
        "r_hip r_knee r_ankle l_hip l_knee l_ankle skull_tip vt1"
    ),
    # The first 18 of BODY_25, the middle of the hips among them.
    "BODY_18": _BODY_19[:18],
    "Halpe-26": _HALPE,
    "Halpe-136": (*_HALPE, *_FACE_AND_HANDS),
    "MediaPipe-33": _MEDIAPIPE,
    # Its first model, of the upper body.
    "MediaPipe-25": _MEDIAPIPE[:25],
    # 7 is the middle of the spine and 9 lies between nose and neck: neither is a place of ours.
    "H36M-17": (*_H36M, None, *_H36M_END),
    # Without the place between nose and neck.
    "H36M-16": (*_H36M, *_H36M_END),
    # MPI-INF-3DHP's test sequences.
    "3DHP-17": (
        *_columns("skull_tip vt1 r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist"),
        *_OPENPOSE_LEGS,
        *_columns("HumanoidRoot - -"),
    ),
    # The second is the neck above the collar bones; the ears are never marked.
    "PoseTrack-17": (*_columns("nose - skull_tip"), *_COCO[3:]),
    # Kinect's second version, NTU RGB+D: 3 is the middle of the head.
    "Kinect-25": _columns(
        "HumanoidRoot - - - l_shoulder l_elbow l_wrist - r_shoulder r_elbow r_wrist - "
        "l_hip l_knee l_ankle - r_hip r_knee r_ankle - vt1 - - - -"
    ),
    # 'foot' is the ball of the foot, 'hand' the knuckles, 'head' the joint under the skull.
    "SMPL-24": _columns(
        "HumanoidRoot l_hip r_hip vl5 l_knee r_knee - l_ankle r_ankle - l_midtarsal r_midtarsal "
        "vt1 - - skullbase l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist - -"
    ),
    # DWPose as ControlNet has it: OpenPose's body, the feet, then face and hands.
    "DWPose-24": (*_COCO_18, *_COCO_FEET),
    "DWPose-134": (*_COCO_18, *_COCO_FEET, *_FACE_AND_HANDS),
    "H-Anim": JOINT_NAMES,
}
"""Layout name to the catalogue's name of every column, `None` for a place that has none."""

# What the places are called, written without side, case and separators.
_PLACES: Final[dict[str, str]] = {
    **{name.replace("_", "").lower(): name for name in (*_PAIRED, *_SINGLE)},
    **by_word(
        {
            "toe": "bigtoe footindex",
            "midtarsal": "foot forefoot ballfoot balloffoot",
            "hand_tip": "fingertip middletip middlefinger4 middlefingertip",
            "HumanoidRoot": "pelvis root midhip hipcenter",
            "vl5": "lumbar spine1",
            "vt1": "neck neckbase thorax",
            "vc7": "upperneck",
            "skull_tip": "head headtop tophead",
        }
    ),
}
_PAIRED_WORDS: Final = {word for word, place in _PLACES.items() if place in _PAIRED}
CASE: Final = r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])"
"""Where a word begins by its case."""

_SIDES: Final[dict[str, str]] = {
    "left": "l_", "right": "r_", "l": "l_", "r": "r_", "lt": "l_", "rt": "r_", "lft": "l_",
    "rgt": "r_",
}  # fmt: skip


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
    spaced = re.sub(CASE, " ", name)
    words = [word for word in re.split(r"[^a-z0-9]+", spaced.lower()) if word]
    side = ""
    for end in (0, -1):
        if len(words) > 1 and words[end] in _SIDES:
            side = _SIDES[words.pop(end)]
            break
    place = "".join(words)
    if not side:
        side, place = _unglued(place, _PAIRED_WORDS)
    if not side and place == "hip":
        return "HumanoidRoot"
    known = _PLACES.get(place)
    if known is None or (known in _PAIRED) != bool(side):
        return None
    return side + known


def _unglued(word: str, known: Container[str]) -> tuple[str, str]:
    """Side and place of a word that may begin or end with the side: lshoulder, shoulderleft."""
    for spelt, side in _SIDES.items():
        for place in (word.removeprefix(spelt), word.removesuffix(spelt)):
            if place != word and place in known:
                return side, place
    return "", word


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
        canonical = (
            canonical_joint_name(name)
            or _numbered_side(name, names)
            or canonical_joint_name(re.sub(r"(?i)(.)[\W_]*(joint|jnt|keypoint|kpt)$", r"\1", name))
        )
        found.append(None if canonical in found else canonical)
    if "l_knee" in found and not any(name and name.endswith("ankle") for name in found):
        # MMPose's names of Human3.6M end the leg in its foot, which is the ankle.
        return tuple(name.replace("midtarsal", "ankle") if name else None for name in found)
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

LIMB_JOINTS: Final[tuple[str, ...]] = tuple(
    f"{side}_{place}" for place in (*LIMB_PLACES[3:], *LIMB_PLACES[:3]) for side in "lr"
)
"""The twelve joints of the limbs, which every body, skeleton, detector and data set has."""


def _of_limbs(*words: str) -> dict[str, tuple[str, ...]]:
    """What the places of the limbs are called."""
    return dict(zip(LIMB_PLACES, map(names_in, words), strict=True))


LIMB_WORDS: Final = _of_limbs(
    "upleg upperleg legupper uleg thigh thighbend hip",
    "knee lowerleg lowleg leglower lleg leg calf shin shank tibia",
    "ankle ank footankle foot",
    "upperarm uparm armupper uarm bicep arm shldr shldrbend shoulder sho",
    "elbow el forearm lowerarm lowarm armlower farm larm forearmbend",
    "wrist handwrist hand",
)
"""What skeletons call the joint in which a limb's segment starts, without side and prefix; of
several that are there the first: MotionBuilder, Mixamo, Rokoko; Unity, VRM and Xsens; Unreal,
Biped and Character Creator; Rigify and Auto-Rig Pro; Poser and DAZ Studio; OptiTrack; mocopi; Meta;
MikuMikuDance in English; Softimage; Kinect, SMPL and robots."""

_TURNS: Final = names_in("pitch roll yaw fe aa ie")
"""What robots call the links of a joint of several axes (`l_hip_pitch`): by its turns, or by
flexion, abduction and rotation of the limb."""
_ABOUT_ITSELF: Final = ("yaw", "ie")
"""Turns of a limb about itself: where along the limb their links start says nothing."""

_SEGMENTS: Final = frozenset(
    word for place, words in LIMB_WORDS.items() for word in words if word not in (place, "foot")
) - {"hand"}
"""Words of a limb's parts; files that use them call no joint after itself."""

_ACCLAIM: Final = _of_limbs("femur", "tibia", "foot talus", "humerus", "radius", "hand")
"""Acclaim's bones by their starts, as in models for MuJoCo, and OpenSim's."""

_ENDS: Final = _of_limbs("hipjoint", "femur", "tibia", "clavicle", "humerus", "wrist")
"""The same where joints are the ends of Acclaim's bones. `radius` and `wrist` together are the
forearm, cut where it twists."""

_SKELETON_PLACES: Final = by_word(
    {
        "vt1": "neck",
        "skullbase": "head",
        "skull_tip": "headend headtopend",
        "midtarsal": "toebase toes toe ball",
        "toe": "toebaseend toesend toeend ballend",
    }
)
"""Other joints of skeletons that are places of ours; `head` is where it turns, not its top."""


def skeleton_joint_names(names: Sequence[str], *, ends: bool = False) -> tuple[str | None, ...]:
    """Return which of the catalogue's joints the joints of a skeleton are.

    A skeleton's joint is called after what it moves: `LeftArm` and `lhumerus` are shoulders, and
    then `LeftShoulder` is the collar bone's joint. Where its names are those of joints, they are
    read as by `canonical_joint_name`. The side may stand anywhere; what most names begin with is
    the character's. Of several links that turn one joint of a robot about an axis each, a knee or
    an elbow is the first, and another joint the last that swings the limb: it starts there.

    Args:
        names: The skeleton's joint names.
        ends: Whether Acclaim's joints are the ends of the bones that they are called after.

    Returns:
        A member of `JOINT_NAMES`, each once, or `None`, for every joint.
    """
    spelt = _spelt(names)
    tables = (*((_ENDS,) if ends else ()), LIMB_WORDS, _ACCLAIM)
    table = max(tables, key=lambda table: len(_limbs(spelt, table)))
    found = _limbs(spelt, table)
    segments = table is not LIMB_WORDS or any(place in _SEGMENTS for _, place, _ in spelt)
    result: list[str | None] = [None] * len(names)
    for name, index in found.items():
        result[index] = name
    for index, (side, place, turn) in enumerate(spelt):
        known = _SKELETON_PLACES.get(place)
        if known is not None and (known in _PAIRED) == bool(side) and not (side and turn):
            name = side + known
        else:
            name = None if segments else canonical_joint_name(names[index])
        if result[index] is None and name not in result:
            result[index] = name
    return tuple(result)


def _limbs(
    spelt: Sequence[tuple[str, str, str]], table: Mapping[str, Sequence[str]]
) -> dict[str, int]:
    """Which joints are those of the limbs, by the catalogue's names."""
    places = {place for _, place, _ in spelt}
    # `arm` and `leg` are a limb's upper or lower part only beside words for the other.
    alone = not places & {"upleg", "upperleg", "thigh", "forearm", "lowerarm", "elbow"}
    # Beside a shin or knee, and no word for what is above it, `leg` is the thigh (SOMA).
    is_thigh = bool(places & {"shin", "shank", "calf", "knee"}) and not any(
        side and place in table["hip"] for side, place, _ in spelt
    )
    found: dict[str, int] = {}
    for limb, words in table.items():
        if is_thigh and limb in ("hip", "knee"):
            words = ("leg",) if limb == "hip" else tuple(word for word in words if word != "leg")
        elif alone:
            words = tuple(word for word in words if word not in ("arm", "leg"))
        for side in ("l_", "r_"):
            turns = {word: [k for k, each in enumerate(spelt) if each[:2] == (side, word)]
                     for word in words}  # fmt: skip
            if there := next(filter(None, turns.values()), None):
                whole = [k for k in there if not spelt[k][2]]
                swings = [k for k in there if spelt[k][2] not in _ABOUT_ITSELF]
                is_hinge = bool(whole) or limb in ("knee", "elbow")
                found[side + limb] = (whole or there)[0] if is_hinge else (swings or there)[-1]
    for side in ("l_", "r_"):
        # Below no elbow a hand may be the whole forearm, and start there (Booster's T1).
        hand = found.get(side + "wrist")
        if hand is not None and spelt[hand][1] == "hand" and side + "elbow" not in found:
            del found[side + "wrist"]
    return found


def _spelt(names: Sequence[str]) -> list[tuple[str, str, str]]:
    """Side, place and turn of every name, in small letters, without what they begin or end with."""
    known = {*_SKELETON_PLACES, *_PLACES}
    known.update(
        word for table in (LIMB_WORDS, _ACCLAIM, _ENDS) for ws in table.values() for word in ws
    )
    # Changes of case and digits part words; what stands before a colon is a namespace.
    spaced = (re.sub(CASE, " ", name.split(":")[-1]).lower() for name in names)
    parted = [[word for word in re.split(r"[^a-z]+", text) if word] for text in spaced]
    # Beside `rt` that is the left side; else OptiTrack's LFArm is a forearm.
    known_sides = {**_SIDES, "lf": "l_"} if any("rt" in words for words in parted) else _SIDES
    split: list[tuple[str, list[str]]] = []
    for words in parted:
        sides = [index for index, word in enumerate(words) if word in known_sides]
        split.append((known_sides[words.pop(sides[0])] if len(sides) == 1 else "", words))
    every = [word for _, words in split for word in set(words)]
    common = {word for word in every if 2 * every.count(word) >= len(names)}
    common |= {"def", "stretch", "link", *_TURNS}
    result: list[tuple[str, str, str]] = []
    for side, words in split:
        turn = ""
        while words and words[-1] in common - known and "".join(words) not in known:
            turn = words[-1] if words[-1] in _TURNS else turn
            words = words[:-1]
        while words and words[0] in common and "".join(words) not in known:
            words = words[1:]
        place = "".join(words)
        if not side:
            side, place = _unglued(place, known)
        result.append((side, place, turn))
    return result
