"""A body from the skeleton of a BVH file: its tree, limits from its motion, its unit guessed.

A rotation channel becomes a revolute joint `NAME_x`, `NAME_y` or `NAME_z`, in the file's order. The
root's six channels become the six root parameters of every body (`torchcss.body.root`), which turn
in an order of their own: yaw, pitch, roll. Other positions are held where the file's first frame
has them.

A BVH states no joint limits. Its motion, where it has one, says what is usual: a channel that never
changes is held, the others may turn `MARGIN` beyond what they do in the file, and their mean and
deviation are the body's stabilisers. A file of one pose lets all turn by `MARGIN` twice. The middle
one of three angles stays within a right angle, where the three lock. `BodySpecification.notes` says
all of this.

Call `read_bvh_skeleton`; `torchcss.load_body("x.bvh")` does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from torchcss.body.catalog import PartSpecification
from torchcss.body.chain import JointSpecification
from torchcss.body.files.bvh_parser import Segment, parse_bvh, without_empty_positions
from torchcss.body.rotations import about, as_rows, as_vector
from torchcss.errors import ConfigurationError, MotionCaptureError
from torchcss.joint_names import skeleton_joint_names

BASE: Final = "world_frame"
"""Name of the root link of a tree from a file that has none itself."""

UNITS: Final[dict[str, float]] = {
    "m": 1.0,
    "cm": 0.01,
    "mm": 0.001,
    "inch": 0.0254,
    "cmu": 0.0254 / 0.45,
}
"""Metres per unit of the files, by name; "cmu" is the unit of the CMU database."""

Z_UP_NOTE: Final = "the file is Z up, as rest pose and motion show: turned to Y up"

MARGIN = math.radians(60)
"""How far a joint may turn beyond what it does in the file."""

_LEAST_DEVIATION = math.radians(20)
"""Stabilisers are no narrower than this: one clip is not all that a person does."""

_PERSON_SPAN = 2.4
"""Metres along the tree between the two joints farthest apart, from toes to fingertips."""
_LEAST_PERSON, _LARGEST_PERSON = 0.5, 1.6
"""Shares of that span that still are a person's: from a small child to an outsize figure."""


class HungTree(NamedTuple):
    """A tree that a file describes, hung on a root link of its own, and what it says of its shape.

    Attributes:
        joints: The joints, parents first; the first entry is the root link `BASE`.
        sticky: Rest value and deviation of the joints where the file's motion shows them.
        notes: What was assumed, one line each.
        places: The links that the file names, the joint of each standing at its link's origin.
        has_root: Whether the file lets the whole body move freely.
        is_z_up: Whether the file's world is Z up where others of its kind are Y up.
        solids: Parts of the links for which the file has solids.
    """

    joints: tuple[JointSpecification, ...]
    sticky: dict[str, tuple[float, float]]
    notes: tuple[str, ...]
    places: tuple[str, ...]
    has_root: bool
    is_z_up: bool = False
    solids: tuple[PartSpecification, ...] = ()


def read_bvh_skeleton(path: Path, *, units: str | float | None = None) -> HungTree:
    """Read the skeleton of a BVH file.

    Args:
        path: The file.
        units: Metres per unit, or a name of `UNITS`; None: guessed, for a person.

    Raises:
        MotionCaptureError: If the file is bad, or its unit cannot be guessed.
        ConfigurationError: If the units are none.
    """
    segments, values, _ = parse_bvh(path)
    segments, empty = without_empty_positions(segments, values)
    num_frames, is_z_up = len(values), all(stands_along_z(segments, values))
    if not num_frames:  # a skeleton alone: one pose, all channels zero
        values = np.zeros((1, values.shape[1]))
    scale, unit_line = metres_per_unit(path, segments, units)
    moves = np.ptp(values, axis=0) > 1e-6
    angles = [turn.column for segment in segments[1:] for turn in segment.turns if turn.is_rotation]
    has_motion = bool(moves[angles].any())
    joints = [JointSpecification(name=BASE, link=BASE, parent=None)]
    sticky: dict[str, tuple[float, float]] = {}
    held: list[str] = []
    for index, segment in enumerate(segments):
        parent = segments[segment.parent].name if index else BASE
        turns = segment.turns if index else ()
        place = scale * np.asarray(segment.offset) if index else np.zeros(3)
        for turn in turns:
            if not turn.is_rotation:
                place[turn.axis] = scale * values[0, turn.column]
        turns = [turn for turn in turns if turn.is_rotation]
        locks = len({turn.axis for turn in turns}) == 3
        for number, turn in enumerate(turns):
            name, angle = f"{segment.name}_{'xyz'[turn.axis]}", values[:, turn.column]
            link = segment.name if turn is turns[-1] else f"{name}_link"
            joint = JointSpecification(
                name=name, link=link, parent=parent, translation=as_vector(place)
            )
            if has_motion and not moves[turn.column]:
                held.append(name)
                joint = replace(joint, rotation=as_rows(about(turn.axis, angle[0])))
            else:
                lower, upper = _limits(angle, has_motion, locks and number == 1)
                axis = as_vector(np.eye(3)[turn.axis])
                joint = replace(joint, kind="revolute", axis=axis, lower=lower, upper=upper)
                if has_motion:
                    mean = float(angle.mean().clip(lower, upper))
                    sticky[name] = (mean, max(float(angle.std()), _LEAST_DEVIATION))
            joints.append(joint)
            parent, place = link, np.zeros(3)
        if not turns:
            name, at = f"{segment.name}_fixed", as_vector(place)
            joints.append(
                JointSpecification(name=name, link=segment.name, parent=parent, translation=at)
            )
    notes = [unit_line, _limits_line(num_frames, has_motion, held), *empty]
    if is_z_up:
        notes.append(Z_UP_NOTE)
    names = tuple(segment.name for segment in segments)
    return HungTree(tuple(joints), sticky, tuple(notes), names, True, is_z_up)


def metres_per_unit(
    path: Path,
    segments: Sequence[Segment],
    units: str | float | None,
    stated: float | None = None,
) -> tuple[float, str]:
    """Metres per unit of a motion capture file, and a line that says how that is known.

    Args:
        path: The file, for the message.
        segments: Its skeleton.
        units: Metres per unit, or a name of `UNITS`; None: as stated, or guessed.
        stated: Metres per unit, if the file says so; taken if a person results.

    Raises:
        ConfigurationError: If the units are none.
        MotionCaptureError: If the skeleton is no person's in any unit.
    """
    if isinstance(units, str):
        try:
            units = UNITS[units] if units in UNITS else float(units)
        except ValueError:
            raise ConfigurationError(
                f"units: expected {', '.join(UNITS)} or metres per unit, got {units!r}"
            ) from None
    if units is not None:
        if not 0 < units < math.inf:
            raise ConfigurationError(f"units: expected a positive number of metres, got {units}")
        return units, f"unit: {1000 * units:.3f} mm, as given"
    with np.errstate(all="ignore"):  # what overflows is no person's
        span = skeleton_span(segments)

    def is_person(metres: float) -> bool:
        return _LEAST_PERSON < span * metres / _PERSON_SPAN < _LARGEST_PERSON

    if stated is not None and is_person(stated):
        return stated, f"unit: {1000 * stated:.3f} mm, as the skeleton says"
    if 0 < span < math.inf:
        name = min(UNITS, key=lambda name: abs(math.log(span * UNITS[name] / _PERSON_SPAN)))
        if is_person(UNITS[name]):
            return UNITS[name], (
                f"unit: {name} ({1000 * UNITS[name]:.3f} mm), guessed: the skeleton is then "
                f"{span * UNITS[name]:.2f} m long from toes to fingertips"
            )
    raise MotionCaptureError(
        f"{path}: the skeleton spans {span:.4g} units from end to end, which is no person's in any "
        f"of {', '.join(UNITS)}; say the metres per unit"
    )


def skeleton_span(segments: Sequence[Segment]) -> float:
    """Greatest distance between two joints along the tree, whatever the pose."""
    rest, deepest = rest_positions(segments), np.zeros(len(segments))
    span = 0.0
    for index in range(len(segments) - 1, 0, -1):
        parent = segments[index].parent
        reach = deepest[index] + float(np.linalg.norm(rest[index] - rest[parent]))
        span = max(span, deepest[parent] + reach)
        deepest[parent] = max(deepest[parent], reach)
    return span


def rest_positions(segments: Sequence[Segment]) -> Float[np.ndarray, "j 3"]:
    """Joint positions in the zero pose, in the file's unit, root at the origin."""
    rest = np.zeros((len(segments), 3))
    for index, segment in enumerate(segments[1:], start=1):
        rest[index] = rest[segment.parent] + segment.offset
    return rest


def stands_along_z(
    segments: Sequence[Segment], values: Float[np.ndarray, "t c"]
) -> tuple[bool, bool]:
    """Whether head and feet of a person lie above each other along Z: at rest, in the motion.

    Args:
        segments: The skeleton.
        values: Its numbers, of which the root's turn the person.
    """
    rest = rest_positions(segments)
    names = skeleton_joint_names([segment.name for segment in segments])
    high, low = (
        [index for index, name in enumerate(names) if name in wanted]
        for wanted in (
            ("skullbase", "vt1", "l_shoulder", "r_shoulder"),
            ("l_ankle", "r_ankle", "l_knee", "r_knee"),
        )
    )
    if not high or not low:
        return False, False
    up = rest[high].mean(0) - rest[low].mean(0)
    turned = np.broadcast_to(np.eye(3), (max(len(values), 1), 3, 3))
    for turn in segments[0].turns if len(values) else ():
        if turn.is_rotation:
            turned = turned @ about(turn.axis, values[:, turn.column])
    mean = (turned @ up).mean(0)
    with np.errstate(all="ignore"):
        share = [float(v[2] / np.linalg.norm(v)) for v in (up, mean)]
    return share[0] > 0.9, share[1] > 0.7


def _limits(angles: np.ndarray, has_motion: bool, locks: bool) -> tuple[float, float]:
    margin = MARGIN if has_motion else 2 * MARGIN
    low, high = float(angles.min()), float(angles.max())
    end = 0.5 * math.pi if locks else math.pi
    return min(max(low - margin, -end), low), max(min(high + margin, end), high)


def _limits_line(num_frames: int, has_motion: bool, held: Sequence[str]) -> str:
    degrees = round(math.degrees(MARGIN))
    if not has_motion:
        return f"limits: a BVH has none, and this one no motion: {2 * degrees} degrees both ways"
    line = (
        f"limits: a BVH has none; each joint may turn {degrees} degrees beyond what it does in the "
        f"{num_frames} frames of the file, whose mean and deviation are the stabilisers"
    )
    return line + (f"; {len(held)} that never move are held" if held else "")
