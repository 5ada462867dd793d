"""The bodies that ship: arm7, arm8, body30, body32 and body34, from one table, `humanoid.toml`.

The table holds lengths, joints with their limits and habits, parts and landmarks, and says where
its numbers come from. Internal proportions `x_i` (section 2 [IJRR]) are prismatic joints of the
same tree, free only while a body is fitted; `PROPORTIONS` names our choice of them, `PLACES` those
that the papers have besides. Left and right share one parameter.

| body | parameters |
|---|---|
| body30 | root 6, lumbar 3, neck 3, shoulder 2 x 3, elbow 2, hip 2 x 3, knee 2, ankle 2 |
| body32 | body30 and clavicle elevation, 2 |
| body34 | body32 and clavicle protraction, 2 |
| arm7 | right shoulder 3, elbow 1, forearm twist 1, wrist 2; hangs from a placed shoulder |
| arm8 | arm7 and clavicle protraction; hangs from a placed sternoclavicular joint |

Call `specification` for the rows of one body, and `scaled` for another size of any.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchcss.body.chain import JointSpecification
from torchcss.body.rotations import Vector3, as_rows, as_vector
from torchcss.errors import BodyError
from torchcss.types import frozen

_TABLE = tomllib.loads(Path(__file__).with_name("humanoid.toml").read_text(encoding="utf-8"))

LENGTHS: dict[str, float] = _TABLE["lengths"]
"""Lengths of the standard humanoid, metres."""

PROPORTIONS = tuple(LENGTHS)
"""The lengths that may be fitted, each a parameter of a body with free proportions."""

PLACES: dict[str, str] = _TABLE["places"]
"""Places of joints that may be fitted, zero in the standard humanoid, and the length of each."""

PROPORTION_RANGE = 0.10
"""Fitted lengths stay within this fraction of the standard humanoid (section 3.2.3 [IJRR]), and
fitted places within this fraction of their length."""

Proportions = bool | Collection[str]
"""Which lengths and places are parameters: all `PROPORTIONS` or none, or those named."""

BODY_NAMES = ("arm7", "arm8", "body30", "body32", "body34")
ARM_NAMES = tuple(name for name in BODY_NAMES if name.startswith("arm"))
"""Those that are an arm on a place in the world; the others move about."""

HABITS: dict[str, tuple[float, float, float]] = _TABLE["habits"]
"""Of every angle: rest value and deviation, degrees; deviation of its speed, radians per second."""

LENGTH_RATE = 0.01
"""Speed of lengths and places: they stay as they are, and are learnt by a centimetre a second."""

DEFAULT_RATE = 2.0
"""Speed assumed for any other parameter, such as a robot's joint."""

_DEGREE = math.pi / 180


def motion_rate(parameter: str) -> float:
    """Deviation of the speed of a parameter, metres or radians per second."""
    if parameter.removesuffix("_length") in {*LENGTHS, *PLACES}:
        return LENGTH_RATE
    habit = HABITS.get(without_side(parameter))
    return _TABLE["root_speeds"].get(parameter, DEFAULT_RATE) if habit is None else habit[2]


def without_side(name: str) -> str:
    """A name without the prefix that says left or right."""
    return name.removeprefix("l_").removeprefix("r_")


@frozen
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
    translation: Vector3
    rotation: tuple[Vector3, Vector3, Vector3]
    shape: tuple[float, ...]


@frozen
class MarkerSpecification:
    """A named joint centre or landmark, fixed in a link.

    Attributes:
        name: Canonical (H-Anim) name.
        link: The link that carries it.
        translation: Position in the link's frame, metres.
    """

    name: str
    link: str
    translation: Vector3 = (0.0, 0.0, 0.0)


@frozen
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


_ALONG = {
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "forwards": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "inwards": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
}
"""Rotations (rows) that lay a part's z axis along a direction, on the left side."""

_LEFT, _RIGHT = np.array([1.0, 1.0, 1.0]), np.array([-1.0, 1.0, 1.0])
"""What the coordinates of the table are multiplied by."""


class _Row(NamedTuple):
    """A row of the table, which says what the columns mean."""

    joint: str = ""
    length: str = ""
    part: str = ""
    marker: str = ""
    touch: Sequence[str] = ()
    on: str = ""
    only: Sequence[str] = ("",)
    at: Sequence[float | str] = (0.0, 0.0, 0.0)
    turn: Sequence[float] = ()
    slide: Sequence[float] = ()
    degrees: Sequence[float] = (-math.inf, math.inf)
    along: str = ""
    axes: Sequence[float | str] = ()
    square: Sequence[float] = (0.7, 1.0)
    taper: Sequence[float] = (0.0, 0.0)


_ROWS = {limb: [_Row(**row) for row in rows] for limb, rows in _TABLE["rows"].items()}


class _Builder:
    """Collects what the rows of the table say, one after the other."""

    def __init__(self, lengths: Mapping[str, float], free_proportions: Proportions) -> None:
        self.lengths = {**dict.fromkeys(PLACES, 0.0), **lengths}
        every = PROPORTIONS if free_proportions else ()
        self.free = every if isinstance(free_proportions, bool) else tuple(free_proportions)
        self.joints: list[JointSpecification] = []
        self.parts: list[PartSpecification] = []
        self.markers: list[MarkerSpecification] = []
        self.ties: dict[str, tuple[str, float]] = {}
        self.sticky: dict[str, tuple[float, float]] = {}
        self.neighbours: list[tuple[str, str]] = []
        self.link = ""
        """Where the next row hangs."""
        self.links: dict[str, str] = {}
        """Where the rows after a joint or length hang."""

    def limb(self, body: str, limb: str, mirror: np.ndarray = _LEFT) -> None:
        """Add the rows of a limb that a body has, as they stand or mirrored."""
        for row in _ROWS[limb]:
            if body.startswith(tuple(row.only)):
                self._add(row, mirror)

    def _add(self, row: _Row, mirror: np.ndarray) -> None:

        def named(name: str) -> str:
            return name if mirror is _LEFT else re.sub("^l_", "r_", name)

        if row.on:
            self.link = self.links[row.on]
        place = as_vector(mirror * [self._metres(number) for number in row.at])
        if row.joint:
            self._joint(named(row.joint), row, place, mirror)
        elif without_side(row.length) in self.free:
            self._length(named(row.length), mirror * row.slide)
        elif row.part:
            square = (*row.square, *row.taper, 0.0, 0.0)
            self.parts.append(
                PartSpecification(
                    name=named(row.part),
                    link=self.link,
                    translation=place,
                    rotation=as_rows(np.outer(mirror, mirror) * _ALONG[row.along]),
                    shape=(*map(self._metres, row.axes), *square),
                )
            )
        elif row.marker:
            marker = MarkerSpecification(name=named(row.marker), link=self.link, translation=place)
            self.markers.append(marker)
        elif row.touch:
            first, second = map(named, row.touch)
            self.neighbours.append((first, second))
        self.links[row.joint or row.length] = self.link

    def _metres(self, number: float | str) -> float:
        """A number, or a sum of products of numbers and lengths: "0.5 * trunk - 0.1"."""
        total = 0.0
        for term in str(number).replace("- ", "+ -").split(" + "):
            words = term.split(" * ")
            total += math.prod(self.lengths[w] if w in self.lengths else float(w) for w in words)
        return total

    def _joint(self, name: str, row: _Row, place: Vector3, mirror: np.ndarray) -> None:
        """Add a joint that turns, slides, or is fixed."""
        kind, axis = "fixed", np.array([0.0, 0.0, 1.0])
        if row.slide:
            kind, axis = "prismatic", mirror * row.slide
        elif row.turn:  # so that equal angles mean mirrored motion
            kind, axis = "revolute", mirror[0] * mirror * row.turn / np.linalg.norm(row.turn)
        self._hang(name, kind, axis, [end * _DEGREE for end in row.degrees], place)
        if (habit := HABITS.get(without_side(name))) is not None:
            self.sticky[name] = (habit[0] * _DEGREE, habit[1] * _DEGREE)

    def _length(self, name: str, axis: np.ndarray) -> None:
        """Add the prismatic joint of a proportion."""
        length = without_side(name)
        margin = PROPORTION_RANGE * LENGTHS[PLACES.get(length, length)]
        # Limits are absolute: a body that is already fitted may not drift further.
        offset = LENGTHS.get(length, 0.0) - self.lengths[length]
        if length != name:
            self.ties[f"{name}_length"] = (f"{length}_length", 1.0)
        self.sticky[f"{length}_length"] = (offset, 0.5 * margin)
        self._hang(f"{name}_length", "prismatic", axis, [offset - margin, offset + margin])

    def _hang(
        self,
        name: str,
        kind: str,
        axis: np.ndarray,
        limits: Sequence[float],
        place: Vector3 = (0.0, 0.0, 0.0),
    ) -> None:
        """Hang a joint on the present link, and go on below it."""
        joint = JointSpecification(
            name=name,
            link=f"{name}_link",
            parent=self.link or None,
            kind=kind,
            translation=place,
            axis=as_vector(axis),
            lower=limits[0],
            upper=limits[1],
        )
        self.joints.append(joint)
        self.link = joint.link


def specification(
    name: str,
    *,
    lengths: Mapping[str, float] | None = None,
    scale: float = 1.0,
    free_proportions: Proportions = False,
    free_root: bool | None = None,
) -> BodySpecification:
    """Rows of the table for one of the bodies that ship.

    Args:
        name: One of `BODY_NAMES`.
        lengths: Lengths that differ from `LENGTHS`, and `PLACES` that are not zero, metres (before
            `scale`).
        scale: Overall scale; stature is 1.75 m times this.
        free_proportions: Make the lengths parameters of the body (for fitting), or the lengths and
            places that are named.
        free_root: Give the body six root parameters; by default the bodies have them and the arms
            do not.

    Raises:
        BodyError: If the name or a length is unknown, or a length or the scale is not positive.
    """
    if name not in BODY_NAMES:
        raise BodyError(f"no body {name!r}; the bodies are {', '.join(BODY_NAMES)}")
    size = {**LENGTHS, **(lengths or {})}
    named = size if isinstance(free_proportions, bool) else {*size, *free_proportions}
    known = (*LENGTHS, *PLACES)
    if unknown := set(named) - set(known):
        raise BodyError(f"unknown lengths {sorted(unknown)}; known are {', '.join(known)}")
    if not all(0 < size[name] < math.inf for name in LENGTHS) or not 0 < scale < math.inf:
        raise BodyError("lengths and scale must be positive and finite")
    if not all(map(math.isfinite, size.values())):
        raise BodyError("places must be finite")
    is_arm = name in ARM_NAMES
    build = _Builder(size, free_proportions)
    moves = not is_arm if free_root is None else free_root
    build.limb(name, "root" if moves else "world")
    build.links["root"] = build.link
    if is_arm:
        build.limb(name, "arm", _RIGHT)
    else:
        build.limb(name, "trunk")
        build.limb(name, "arm")
        build.limb(name, "arm", _RIGHT)
        build.limb(name, "head")
        build.limb(name, "leg")
        build.limb(name, "leg", _RIGHT)
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
    build = _Builder(LENGTHS, free_proportions=False)
    build.limb("body", "root")
    return tuple(build.joints)


def scaled(body: BodySpecification, scale: float) -> BodySpecification:
    """The same body with all lengths times `scale`."""
    if scale == 1.0:
        return body

    def times(vector: Vector3) -> Vector3:
        return as_vector(scale * np.array(vector))

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
                    *(bend / scale for bend in part.shape[7:]),
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
