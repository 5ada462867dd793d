"""The bodies that ship: arm7, arm8, body30, body32 and body34, from one table.

Names are H-Anim's (ISO/IEC 19774), the rest pose is H-Anim's: standing, arms hanging, Y up, facing
+Z, left is +X; the origin is the middle of the hips. Lengths are those of the H-Anim 1.1 standard
humanoid of 1.75 m stature (the source of the papers' proportions, section 3.2.1 [IJRR]), except
that shoulder joints stand at the glenohumeral centre (0.185 m from the midline; H-Anim's 0.203 m is
nearer to the acromion) and limbs are straight at rest.

Joint limits are the ranges of motion of the American Academy of Orthopaedic Surgeons (*Joint
Motion: Method of Measuring and Recording*, 1965). At the shoulder, whose three angles start from an
oblique axis (below), the box encloses that range.

Internal proportions `x_i` (section 2 [IJRR]) are prismatic joints of the same tree, free only while
a body is fitted; `PROPORTIONS` names them. Left and right share one parameter.

| body | parameters |
|---|---|
| body30 | root 6, lumbar 3, neck 3, shoulder 2 x 3, elbow 2, hip 2 x 3, knee 2, ankle 2 |
| body32 | body30 and clavicle elevation, 2 |
| body34 | body32 and clavicle protraction, 2 |
| arm7 | right shoulder 3, elbow 1, forearm twist 1, wrist 2; hangs from a placed shoulder |
| arm8 | arm7 and clavicle protraction; hangs from a placed sternoclavicular joint |
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from torchcss.body.chain import JointSpecification
from torchcss.errors import BodyError

Vector = tuple[float, float, float]

LENGTHS: dict[str, float] = {
    "hip_width": 0.0961,
    "trunk": 0.525,
    "shoulder_width": 0.155,
    "neck": 0.065,
    "head": 0.248,
    "upper_arm": 0.302,
    "forearm": 0.269,
    "hand": 0.180,
    "thigh": 0.426,
    "shank": 0.421,
    "foot": 0.170,
}
"""Lengths of the standard humanoid, metres: hip joint from the midline, hips to shoulder line,
sternoclavicular joint to shoulder (sideways), shoulder line to vc7, vc7 to skull tip, and limbs."""

PROPORTIONS = tuple(LENGTHS)
"""The lengths that may be fitted, each a parameter of a body with free proportions."""

PROPORTION_RANGE = 0.10
"""Fitted lengths stay within this fraction of the standard humanoid (section 3.2.3 [IJRR])."""

BODY_NAMES = ("arm7", "arm8", "body30", "body32", "body34")
ARM_NAMES = tuple(name for name in BODY_NAMES if name.startswith("arm"))
"""Those that are an arm on a place in the world; the others move about."""

_SHOULDER_AXIS = (0.70, 0.35, -0.62)
"""First axis of the left shoulder. The three angles are singular where the arm points along it:
backwards-up-outwards, or forwards-down across the chest, both at the edge of what a shoulder can
reach, unlike the sideways, forward or hanging arm of the usual orders."""

_DEGREE = math.pi / 180

HABITS: dict[str, tuple[float, float, float]] = {
    "lumbar_flexion": (0, 15, 1.0),
    "lumbar_bending": (0, 12, 1.0),
    "lumbar_twist": (0, 15, 1.0),
    "neck_flexion": (0, 20, 1.0),
    "neck_bending": (0, 15, 1.0),
    "neck_twist": (0, 25, 1.5),
    "clavicle_elevation": (0, 10, 0.7),
    "clavicle_protraction": (0, 10, 0.7),
    "shoulder_swing": (-10, 70, 3.0),
    "shoulder_raising": (10, 50, 2.5),
    "shoulder_twist": (0, 45, 2.5),
    "elbow_flexion": (30, 45, 3.5),
    "forearm_twist": (0, 40, 3.0),
    "wrist_flexion": (0, 20, 2.5),
    "wrist_deviation": (0, 15, 1.5),
    "hip_flexion": (15, 40, 2.5),
    "hip_abduction": (5, 18, 1.5),
    "hip_twist": (0, 20, 1.5),
    "knee_flexion": (20, 40, 3.0),
    "ankle_flexion": (0, 15, 2.0),
}
"""Of every angle: rest value and deviation, degrees; deviation of its speed, radians per second.

The first two are the sticky priors of section 3.2.2 [IJRR]: narrow for the joints that are hard to
see, wide for the rest. The papers give no numbers; these are a third to a half of each joint's
range, about a relaxed upright stance. The speed is that of everyday motion: the scale of the
diffusion dynamics (section 4.2 [IJRR]). Brisk, not athletic; the tails of the temporal prior leave
room for more."""

_ROOT_RATES = {
    "root_x": 0.7,
    "root_y": 0.5,
    "root_z": 0.7,
    "root_yaw": 1.5,
    "root_pitch": 0.8,
    "root_roll": 0.8,
}
"""The same of the root, metres or radians per second."""

DEFAULT_RATE = 2.0
"""Speed assumed for any other parameter, such as a robot's joint."""


def motion_rate(parameter: str) -> float:
    """Deviation of the speed of a parameter, metres or radians per second."""
    habit = HABITS.get(without_side(parameter))
    return _ROOT_RATES.get(parameter, DEFAULT_RATE) if habit is None else habit[2]


def without_side(name: str) -> str:
    """A name without the prefix that says left or right."""
    return name.removeprefix("l_").removeprefix("r_")


@dataclass(frozen=True, kw_only=True)
class PartSpecification:
    """One superquadric part: where it sits and its nine shape numbers (see `body.surface`).

    Attributes:
        name: Name of the part.
        link: The link that carries it.
        translation: Centre of the part in the link's frame, metres.
        rotation: Part frame in the link's frame; the part's z axis runs along the part.
        shape: The nine shape numbers.
    """

    name: str
    link: str
    translation: Vector
    rotation: tuple[Vector, Vector, Vector]
    shape: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class MarkerSpecification:
    """A named joint centre or landmark, fixed in a link.

    Attributes:
        name: Canonical (H-Anim) name.
        link: The link that carries it.
        translation: Position in the link's frame, metres.
    """

    name: str
    link: str
    translation: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class BodySpecification:
    """Everything that `BodyModel` needs: joints, parts, landmarks, ties and weak parameters.

    Attributes:
        name: Name of the body.
        joints: The tree.
        parts: Their shapes.
        markers: Named joint centres.
        ties: Joint name to (state parameter, factor): joints that share one parameter.
        sticky: State parameter to (rest value, standard deviation): the stabilisers of section
            3.2.2 [IJRR].
        neighbours: Pairs of parts that touch in every pose.
        lengths: The lengths that the body was built with, metres.
        notes: What was assumed when it was read from a file, one line each.
    """

    name: str
    joints: tuple[JointSpecification, ...]
    parts: tuple[PartSpecification, ...]
    markers: tuple[MarkerSpecification, ...]
    ties: Mapping[str, tuple[str, float]]
    sticky: Mapping[str, tuple[float, float]]
    neighbours: tuple[tuple[str, str], ...]
    lengths: Mapping[str, float]
    notes: tuple[str, ...] = ()


_DOWN = ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0))
_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
_FORWARD = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
"""Rotations (rows) that lay a part's z axis along -Y, +Y and +Z of its link."""


class _Builder:
    """Collects the rows of the table for one body."""

    def __init__(self, lengths: Mapping[str, float], free_proportions: bool) -> None:
        self.lengths = lengths
        self.free = free_proportions
        self.joints: list[JointSpecification] = []
        self.parts: list[PartSpecification] = []
        self.markers: list[MarkerSpecification] = []
        self.ties: dict[str, tuple[str, float]] = {}
        self.sticky: dict[str, tuple[float, float]] = {}
        self.neighbours: list[tuple[str, str]] = []

    def joint(
        self,
        name: str,
        parent: str | None,
        offset: Vector = (0.0, 0.0, 0.0),
        axis: Vector | None = None,
        limits: tuple[float, float] = (-math.inf, math.inf),
        kind: str = "revolute",
    ) -> str:
        """Add a joint (fixed when it has no axis) and return the link below it."""
        scale = _DEGREE if kind == "revolute" else 1.0
        self.joints.append(
            JointSpecification(
                name=name,
                link=f"{name}_link",
                parent=parent,
                kind="fixed" if axis is None else kind,
                translation=offset,
                axis=axis or (0.0, 0.0, 1.0),
                lower=limits[0] * scale,
                upper=limits[1] * scale,
            )
        )
        if (habit := HABITS.get(without_side(name))) is not None:
            self.sticky[name] = (habit[0] * _DEGREE, habit[1] * _DEGREE)
        return f"{name}_link"

    def stretch(self, length: str, parent: str, direction: Vector, prefix: str = "") -> str:
        """Add the prismatic joint of a proportion, if proportions are free."""
        if not self.free:
            return parent
        margin = PROPORTION_RANGE * LENGTHS[length]
        # Limits are absolute: a body that is already fitted may not drift further.
        offset = LENGTHS[length] - self.lengths[length]
        name = f"{prefix}{length}_length"
        if prefix:
            self.ties[name] = (f"{length}_length", 1.0)
        self.sticky[f"{length}_length"] = (offset, 0.5 * margin)
        return self.joint(
            name, parent, (0, 0, 0), direction, (offset - margin, offset + margin), "prismatic"
        )

    def part(
        self,
        name: str,
        link: str,
        centre: Vector,
        rotation: tuple[Vector, Vector, Vector],
        axes: Vector,
        *,
        square: tuple[float, float] = (0.7, 1.0),
        taper: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.parts.append(
            PartSpecification(
                name=name,
                link=link,
                translation=centre,
                rotation=rotation,
                shape=(*axes, *square, *taper, 0.0, 0.0),
            )
        )

    def marker(self, name: str, link: str, offset: Vector = (0.0, 0.0, 0.0)) -> None:
        self.markers.append(MarkerSpecification(name=name, link=link, translation=offset))


def _side(axis: Vector, sign: float) -> Vector:
    """Mirror a rotation axis so that equal angles mean mirrored motion."""
    return axis if sign > 0 else (axis[0], -axis[1], -axis[2])


def _arm(
    build: _Builder,
    side: str,
    parent: str,
    sign: float,
    *,
    clavicle: tuple[str, ...],
    hand: bool,
    chest: str | None,
) -> None:
    """Clavicle to fingertip; `clavicle` names its free angles, `hand` frees forearm and wrist."""
    size, p = build.lengths, f"{side}_"
    link = parent
    if "elevation" in clavicle:
        link = build.joint(
            p + "clavicle_elevation", link, (0, 0, 0), _side((0, 0, 1), sign), (-10, 40)
        )
    if "protraction" in clavicle:
        axis = _side((0, -1, 0), sign)
        link = build.joint(p + "clavicle_protraction", link, (0, 0, 0), axis, (-25, 30))
    half = size["shoulder_width"] / 2
    drop = 0.015 if chest else 0.0
    if chest or clavicle:
        along = ((0.0, 0.0, -sign), (0.0, 1.0, 0.0), (sign, 0.0, 0.0))
        build.part(
            p + "clavicle", link, (sign * half, drop - 0.025, -0.015), along, (0.05, 0.05, 0.10)
        )
        if chest:
            build.neighbours += [(p + "clavicle", chest), (p + "clavicle", "neck")]
        build.neighbours.append((p + "clavicle", p + "upper_arm"))
        link = build.stretch("shoulder_width", link, (sign, 0, 0), p)
        offset: Vector = (sign * size["shoulder_width"], drop, -0.03)
    else:
        offset = (0.0, 0.0, 0.0)
    first = np.array(_SHOULDER_AXIS) / np.linalg.norm(_SHOULDER_AXIS)
    down = np.array([0.0, -1.0, 0.0])
    rest = down - first * (first @ down)
    second = np.cross(rest / np.linalg.norm(rest), first)
    tilt = math.degrees(math.asin(first @ down))  # of the hanging arm, from the plane of rest
    axes = [tuple(first.tolist()), tuple(second.tolist()), (0.0, 1.0, 0.0)]
    swing, raising, twist = (_side(axis, sign) for axis in axes)
    link = build.joint(p + "shoulder_swing", link, offset, swing, (-195, 60))
    link = build.joint(p + "shoulder_raising", link, (0, 0, 0), raising, (-80 - tilt, 80 - tilt))
    link = build.joint(p + "shoulder_twist", link, (0, 0, 0), twist, (-90, 90))
    build.marker(p + "shoulder", link)
    length = size["upper_arm"]
    build.part(p + "upper_arm", link, (0, -0.48 * length, 0), _DOWN, (0.049, 0.051, 0.57 * length),
               taper=(-0.12, -0.12))  # fmt: skip
    link = build.stretch("upper_arm", link, (0, -1, 0), p)
    link = build.joint(p + "elbow_flexion", link, (0, -length, 0), (-1, 0, 0), (0, 150))
    build.marker(p + "elbow", link)
    length = size["forearm"]
    if hand:
        link = build.joint(p + "forearm_twist", link, (0, 0, 0), _side((0, 1, 0), sign), (-80, 80))
    build.part(p + "forearm", link, (0, -0.5 * length, 0), _DOWN, (0.040, 0.042, 0.57 * length),
               taper=(-0.25, -0.25))  # fmt: skip
    link = build.stretch("forearm", link, (0, -1, 0), p)
    link = build.joint(p + "wrist", link, (0, -length, 0))
    if hand:
        link = build.joint(p + "wrist_flexion", link, (0, 0, 0), _side((0, 0, -1), sign), (-70, 80))
        link = build.joint(p + "wrist_deviation", link, (0, 0, 0), (1, 0, 0), (-30, 20))
    build.marker(p + "wrist", link)
    length = size["hand"]
    build.part(p + "hand", link, (0, -0.48 * length, 0), _DOWN, (0.020, 0.040, 0.54 * length))
    build.marker(p + "hand_tip", link, (0, -length, 0))
    build.neighbours += [(p + "upper_arm", p + "forearm"), (p + "forearm", p + "hand")]
    if chest:
        build.neighbours.append((p + "upper_arm", chest))


def _leg(build: _Builder, side: str, parent: str, sign: float) -> None:
    size, p = build.lengths, f"{side}_"
    link = build.stretch("hip_width", parent, (sign, 0, 0), p)
    offset = (sign * size["hip_width"], 0.0, 0.0)
    link = build.joint(p + "hip_flexion", link, offset, (-1, 0, 0), (-30, 120))
    link = build.joint(p + "hip_abduction", link, (0, 0, 0), _side((0, 0, 1), sign), (-30, 45))
    link = build.joint(p + "hip_twist", link, (0, 0, 0), _side((0, 1, 0), sign), (-45, 45))
    build.marker(p + "hip", link)
    length = size["thigh"]
    build.part(p + "thigh", link, (0, -0.47 * length, 0), _DOWN, (0.075, 0.082, 0.55 * length),
               taper=(-0.25, -0.25))  # fmt: skip
    link = build.stretch("thigh", link, (0, -1, 0), p)
    link = build.joint(p + "knee_flexion", link, (0, -length, 0), (1, 0, 0), (0, 135))
    build.marker(p + "knee", link)
    length = size["shank"]
    build.part(p + "shank", link, (0, -0.5 * length, -0.008), _DOWN, (0.052, 0.056, 0.54 * length),
               taper=(-0.33, -0.33))  # fmt: skip
    link = build.stretch("shank", link, (0, -1, 0), p)
    link = build.joint(p + "ankle_flexion", link, (0, -length, 0), (1, 0, 0), (-20, 50))
    build.marker(p + "ankle", link)
    length = size["foot"]
    build.part(
        p + "foot", link, (0, -0.038, 0.32 * length), _FORWARD, (0.042, 0.034, 0.75 * length)
    )
    build.marker(p + "heel", link, (0, -0.050, -0.055))
    build.marker(p + "midtarsal", link, (0, -0.030, 0.4 * length))
    build.marker(p + "toe", link, (sign * -0.01, -0.050, length))
    build.neighbours += [
        ("pelvis", p + "thigh"),
        (p + "thigh", p + "shank"),
        (p + "shank", p + "foot"),
    ]


def specification(
    name: str,
    *,
    lengths: Mapping[str, float] | None = None,
    scale: float = 1.0,
    free_proportions: bool = False,
    free_root: bool | None = None,
) -> BodySpecification:
    """Rows of the table for one of the bodies that ship.

    Args:
        name: One of `BODY_NAMES`.
        lengths: Lengths that differ from `LENGTHS`, metres (before `scale`).
        scale: Overall scale; stature is 1.75 m times this.
        free_proportions: Make the lengths parameters of the body (for fitting).
        free_root: Give the body six root parameters; by default the bodies have them and the arms
            do not.

    Raises:
        BodyError: If the name or a length is unknown, or a length or the scale is not positive.
    """
    if name not in BODY_NAMES:
        raise BodyError(f"no body {name!r}; the bodies are {', '.join(BODY_NAMES)}")
    unknown = set(lengths or {}) - set(LENGTHS)
    if unknown:
        raise BodyError(f"unknown lengths {sorted(unknown)}; known are {', '.join(LENGTHS)}")
    size = {**LENGTHS, **(lengths or {})}
    if not all(0 < value < math.inf for value in (*size.values(), scale)):
        raise BodyError("lengths and scale must be positive and finite")
    build = _Builder(size, free_proportions)
    is_arm = name in ARM_NAMES
    if free_root if free_root is not None else not is_arm:
        build.joints += root_joints()
        link = build.joints[-1].link
    else:
        link = build.joint("world", None)
    if is_arm:
        clavicle = ("protraction",) if name == "arm8" else ()
        _arm(build, "r", link, -1.0, clavicle=clavicle, hand=True, chest=None)
    else:
        _torso(build, name, link)
    return scaled(
        BodySpecification(
            name=name,
            joints=tuple(build.joints),
            parts=tuple(build.parts),
            markers=tuple(build.markers),
            ties=build.ties,
            sticky=build.sticky,
            neighbours=tuple(build.neighbours),
            lengths=size,
        ),
        scale,
    )


def root_joints() -> tuple[JointSpecification, ...]:
    """The world's link and the six joints by which a body moves in it (`torchcss.body.root`)."""
    build = _Builder({}, free_proportions=False)
    link = build.joint("world", None)
    for axis, letter in (((1.0, 0, 0), "x"), ((0, 1.0, 0), "y"), ((0, 0, 1.0), "z")):
        link = build.joint(f"root_{letter}", link, (0, 0, 0), axis, kind="prismatic")
    # The middle angle is the one that locks at a right angle: leaning forward, the rarest.
    link = build.joint("root_yaw", link, (0, 0, 0), (0, 1, 0), (-360, 360))
    link = build.joint("root_pitch", link, (0, 0, 0), (1, 0, 0), (-85, 85))
    build.joint("root_roll", link, (0, 0, 0), (0, 0, 1), (-360, 360))
    return tuple(build.joints)


def _torso(build: _Builder, name: str, root: str) -> None:
    size = build.lengths
    clavicle = {
        "body30": (),
        "body32": ("elevation",),
        "body34": ("elevation", "protraction"),
    }[name]
    build.marker("HumanoidRoot", root)
    build.part("pelvis", root, (0, 0.035, -0.005), _UP, (0.160, 0.105, 0.125), square=(0.8, 0.8))
    link = build.joint("lumbar_flexion", root, (0, 0.12, -0.03), (1, 0, 0), (-25, 80))
    link = build.joint("lumbar_bending", link, (0, 0, 0), (0, 0, 1), (-35, 35))
    link = build.joint("lumbar_twist", link, (0, 0, 0), (0, 1, 0), (-45, 45))
    build.marker("vl5", link)
    trunk = size["trunk"]
    build.part("chest", link, (0, 0.40 * trunk, 0.025), _UP, (0.150, 0.105, 0.475 * trunk),
               square=(0.7, 0.8), taper=(0.06, 0.0))  # fmt: skip
    link = build.stretch("trunk", link, (0, 1, 0))
    top = trunk - 0.12
    build.marker("vt1", link, (0, top, 0.0))
    build.neighbours += [
        ("pelvis", "chest"),
        ("chest", "neck"),
        ("chest", "head"),
        ("neck", "head"),
    ]
    for side, sign in (("l", 1.0), ("r", -1.0)):
        start = build.joint(f"{side}_sternoclavicular", link, (sign * 0.03, top - 0.015, 0.03))
        _arm(build, side, start, sign, clavicle=clavicle, hand=False, chest="chest")
    chest = link
    link = build.stretch("neck", chest, (0, 1, 0))
    link = build.joint("neck_flexion", link, (0, top + size["neck"], 0.02), (1, 0, 0), (-45, 45))
    link = build.joint("neck_bending", link, (0, 0, 0), (0, 0, 1), (-45, 45))
    link = build.joint("neck_twist", link, (0, 0, 0), (0, 1, 0), (-60, 60))
    head = size["head"]
    build.marker("vc7", link)
    build.part("neck", link, (0, 0.15 * head, 0.0), _UP, (0.055, 0.058, 0.085))
    build.part(
        "head", link, (0, 0.54 * head, 0.03), _UP, (0.073, 0.093, 0.48 * head), square=(1, 1)
    )
    build.marker("skullbase", link, (0, 0.44 * head, 0.02))
    build.marker("nose", link, (0, 0.46 * head, 0.125))
    for side, sign in (("l", 1.0), ("r", -1.0)):
        build.marker(f"{side}_eye", link, (sign * 0.033, 0.58 * head, 0.105))
        build.marker(f"{side}_ear", link, (sign * 0.072, 0.50 * head, 0.02))
    link = build.stretch("head", link, (0, 1, 0))
    build.marker("skull_tip", link, (0, head, 0.02))
    for side, sign in (("l", 1.0), ("r", -1.0)):
        _leg(build, side, root, sign)


def scaled(body: BodySpecification, scale: float) -> BodySpecification:
    """The same body with all lengths times `scale`."""
    if scale == 1.0:
        return body

    def times(vector: Vector) -> Vector:
        return (vector[0] * scale, vector[1] * scale, vector[2] * scale)

    unit = {joint.name: scale if joint.kind == "prismatic" else 1.0 for joint in body.joints}

    def scale_joint(joint: JointSpecification) -> JointSpecification:
        stretch, mimic = unit[joint.name], joint.mimic
        if mimic is not None:
            driver, factor, offset = mimic
            mimic = driver, factor * stretch / unit.get(driver, 1.0), offset * stretch
        return replace(
            joint,
            translation=times(joint.translation),
            lower=joint.lower * stretch,
            upper=joint.upper * stretch,
            mimic=mimic,
        )

    prismatic = {
        body.ties.get(j.name, (j.name, 1))[0] for j in body.joints if j.kind == "prismatic"
    }
    return replace(
        body,
        joints=tuple(scale_joint(joint) for joint in body.joints),
        parts=tuple(
            replace(
                part,
                translation=times(part.translation),
                shape=(
                    *(a * scale for a in part.shape[:3]),
                    *part.shape[3:7],
                    part.shape[7] / scale,
                    part.shape[8],
                ),
            )
            for part in body.parts
        ),
        markers=tuple(replace(m, translation=times(m.translation)) for m in body.markers),
        sticky={
            name: (rest * scale, deviation * scale) if name in prismatic else (rest, deviation)
            for name, (rest, deviation) in body.sticky.items()
        },
        lengths={name: length * scale for name, length in body.lengths.items()},
    )
