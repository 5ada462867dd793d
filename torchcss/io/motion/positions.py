"""Motion capture files as joint positions: Acclaim's skeleton and motion (ASF, AMC), and BVH.

Both formats hold a tree of rigid segments and, frame by frame, the angles between them. What is
read is what both agree on: where every joint of the tree is in the world. World and zero pose are
Y up in both, but some programs write BVH that is Z up: where rest pose and motion stand along Z,
they are turned. Distances become metres, angles never leave this module.

*BVH.* A joint stands at `OFFSET` in its parent's frame. Its rotations apply in the order of its
channels, about the axes turned by those before: `R = R_parent R_1 R_2 R_3`. Position channels take
the place of the offset, as in Blender and in the suits whose files have them in every joint.

*Acclaim.* A bone has a direction and length in the zero pose, and its own axes C. Its rotations
apply about fixed axes, first x, then y, then z, and turn the bone itself:
`R = R_parent C (R_z R_y R_x) C^T`; it ends at `R direction length` from its parent's end. The joint
called "lfemur" here is thus the end of that bone, the left knee.

Neither format is sure to say its unit. An ASF states a fraction of an inch (that of the CMU
database 1 / 0.45 inch, 56.4 mm); a BVH states none. Without `units`, the statement is taken if a
person results, else the unit that makes the skeleton as large as one; the report says which.

Call `read_motion_capture`, then `resample_motion` for a part of it at another rate, and
`limb_positions` for the joints that the catalogue names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from torchcss.body.files.bvh import (
    Z_UP_NOTE,
    metres_per_unit,
    rest_positions,
    stands_along_z,
)
from torchcss.body.files.bvh_parser import Segment, parse_bvh, without_empty_positions
from torchcss.body.rotations import about
from torchcss.errors import ConfigurationError, MotionCaptureError
from torchcss.files import StrPath, naming, shortened
from torchcss.io.motion.acclaim import parse_acclaim
from torchcss.joint_names import LIMB_JOINTS, skeleton_joint_names

ACCLAIM_RATE = 120.0
"""Frames per second of an AMC, which does not say: those of the CMU database."""

_SLOWEST = 1.0
"""Frames per second that somebody's motion has at least."""

_Z_TO_Y: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Turns rows of places that are Z up to Y up."""


class MotionCapture(NamedTuple):
    """What a file says about the motion of one skeleton.

    Attributes:
        joint_names: Names of the joints, those of the file; the tip of a BVH chain is `NAME_end`.
        parents: Parent of every joint, which stands before it; -1 for the root.
        rest: Joint positions in the zero pose, root at the origin, metres.
        joints: Joint positions in the world, Y up, metres.
        frame_rate: Frames per second.
        report: What was assumed, one line each.
    """

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: Float[np.ndarray, "j 3"]
    joints: Float[np.ndarray, "t j 3"]
    frame_rate: float
    report: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Seconds from the first to the last frame."""
        return (len(self.joints) - 1) / self.frame_rate


def read_motion_capture(
    path: StrPath,
    *,
    skeleton: StrPath | None = None,
    units: str | float | None = None,
    frame_rate: float | None = None,
    up: Literal["y", "z"] | None = None,
) -> MotionCapture:
    """Read a motion: a `.bvh`, or an `.amc` with its `.asf`.

    Args:
        path: The file.
        skeleton: The ASF of an AMC; by default the file of the same name beside it.
        units: Metres per unit of the file, or a name of `UNITS`; None: as stated, or guessed.
        frame_rate: Frames per second, instead of what the file says (BVH) or 120 (AMC).
        up: The file's vertical axis; None: Y, unless a BVH stands along Z at rest and in motion.

    Raises:
        MotionCaptureError: If a file is missing, damaged or of another format, or the unit cannot
            be guessed. The message says where.
        ConfigurationError: If `units` or `frame_rate` is not positive or unknown.
    """
    path = Path(path)
    if frame_rate is not None and not 0 < frame_rate < math.inf:
        raise ConfigurationError(f"frame rate: expected a positive number, got {frame_rate}")
    segments, values, rate, stated, report = _parse(path, skeleton)
    if not len(values):
        raise MotionCaptureError(
            f"{path}: a skeleton without motion; it is a body (load_body), not a motion"
        )
    if frame_rate is not None:
        rate, report = frame_rate, [line for line in report if "rate assumed" not in line]
    elif rate < _SLOWEST:
        raise MotionCaptureError(
            f"{path}: frames last {1 / rate:g} seconds each, which looks like frames per second or "
            "milliseconds: give frame_rate"
        )
    report = [f"{len(values)} frames, {rate:g} per second", *report]
    with np.errstate(all="ignore"):  # whatever overflows is found below
        rest, joints = rest_positions(segments), _positions(segments, values)
        scale, line = metres_per_unit(path, segments, units, stated)
        report.append(line)
        rest, joints = scale * rest, scale * joints
        along_z = (up == "z",) * 2
        if up is None and path.suffix.lower() == ".bvh":
            along_z = stands_along_z(segments, values)
        if all(along_z):
            rest, joints = rest @ _Z_TO_Y, joints @ _Z_TO_Y
            report.append(Z_UP_NOTE if up is None else "Z up, as given: turned to Y up")
        elif along_z[1]:
            report.append(
                "the person lies along Z, not at rest: if Z is the file's vertical, say up='z'"
            )
    if not (np.isfinite(rest).all() and np.isfinite(joints).all()):
        frame = int(np.argmin(np.isfinite(joints).all((1, 2))))
        raise MotionCaptureError(
            f"{path}: frame {frame + 1}: the positions are beyond all bounds; the file is damaged"
        )
    names, parents = zip(*((each.name, each.parent) for each in segments), strict=True)
    return MotionCapture(names, parents, rest, joints, rate, tuple(report))


def _parse(
    path: Path, skeleton: StrPath | None
) -> tuple[list[Segment], Float[np.ndarray, "t c"], float, float | None, list[str]]:
    """What either format says: segments, their numbers, rate, metres per unit, and notes."""
    suffix = path.suffix.lower()
    if suffix == ".bvh":
        with naming(path, MotionCaptureError):
            segments, values, rate = parse_bvh(path)
        segments, empty = without_empty_positions(segments, values)
        return segments, values, rate, None, empty
    if suffix != ".amc":
        raise MotionCaptureError(
            f"{path}: expected a .bvh file, or an .amc file with its .asf, found {suffix!r}"
        )
    beside = Path(skeleton) if skeleton is not None else path.with_suffix(".asf")
    if skeleton is None and not beside.is_file():
        raise MotionCaptureError(
            f"{path}: an AMC holds no skeleton, and there is no {beside.name} beside it; name "
            "its ASF file"
        )
    segments, values, stated = parse_acclaim(beside, path)
    return segments, values, ACCLAIM_RATE, stated, ["rate assumed: an AMC does not say it"]


def resample_motion(
    motion: MotionCapture, *, rate: float, start: float = 0.0, stop: float | None = None
) -> MotionCapture:
    """A part of a motion at another rate, every coordinate interpolated on its own.

    By cubic pieces that meet in value and slope, the slopes from five frames; bones change length
    by a few micrometres where limbs move at everyday speed. Nothing is filtered: people move below
    ten hertz.

    Args:
        motion: The motion.
        rate: Frames per second.
        start: Seconds after the first frame.
        stop: End of the part, exclusive; None: the end of the motion, inclusive.

    Raises:
        ConfigurationError: If the rate is not positive, or no frame lies in the part.
    """
    if not 0 < rate < math.inf:
        raise ConfigurationError(f"rate: expected a positive number, got {rate}")
    end = motion.duration
    stop_at = end + 1e-9 if stop is None else stop
    if not (0 <= start <= end and start < stop_at):
        raise ConfigurationError(
            f"expected a part of the motion, 0 to {end:.3f} s, got {start:g} to {stop_at:g} s"
        )
    last = min(stop_at - 1e-9 / rate, end + 1e-9)
    times = start + np.arange(math.floor((last - start) * rate) + 1) / rate
    place = np.clip(times * motion.frame_rate, 0, len(motion.joints) - 1)
    return motion._replace(joints=_interpolate(motion.joints, place), frame_rate=rate)


def limb_positions(
    motion: MotionCapture,
) -> tuple[tuple[str, ...], tuple[int, ...], Float[np.ndarray, "t limbs 3"]]:
    """The joints of a motion that the catalogue names too.

    Args:
        motion: The motion, its names such as `skeleton_joint_names` knows.

    Returns:
        Those of `LIMB_JOINTS` that there are, which joint of the motion each is, and their places.

    Raises:
        MotionCaptureError: If hips or shoulders are not among them.
    """
    places = skeleton_joint_names(motion.joint_names, ends=True)
    found = {name: index for index, name in enumerate(places) if name in LIMB_JOINTS}
    if not {"l_hip", "r_hip", "l_shoulder", "r_shoulder"} <= set(found):
        raise MotionCaptureError(
            "expected hips and shoulders of both sides among the joints, found "
            f"{shortened(', '.join(motion.joint_names))}; rename the joints"
        )
    names = tuple(name for name in LIMB_JOINTS if name in found)
    index = tuple(found[name] for name in names)
    return names, index, motion.joints[:, list(index)]


def _positions(
    segments: Sequence[Segment], values: Float[np.ndarray, "t c"]
) -> Float[np.ndarray, "t j 3"]:
    """Forward kinematics of both formats, in the file's unit; angles in radians."""
    joints = np.zeros((len(values), len(segments), 3))
    rotations: list[np.ndarray] = []
    for index, segment in enumerate(segments):
        above = rotations[segment.parent] if index else np.eye(3)
        start = joints[:, segment.parent] if index else 0.0
        local = np.broadcast_to(segment.axes, (len(values), 3, 3))
        shift = np.tile(segment.offset, (len(values), 1))
        for turn in segment.turns:
            if turn.is_rotation:
                local = local @ about(turn.axis, values[:, turn.column])
            else:
                shift[:, turn.axis] = values[:, turn.column]
        turned = above @ local @ segment.axes.T
        rotations.append(turned)
        carried = turned if segment.turns_itself else above
        joints[:, index] = start + (carried @ shift[..., None])[..., 0]
    return joints


def _interpolate(
    samples: Float[np.ndarray, "t *rest"], place: Float[np.ndarray, " s"]
) -> Float[np.ndarray, "s *rest"]:
    """Cubic Hermite interpolation at fractional indices."""
    from scipy.interpolate import CubicHermiteSpline  # takes a second to import

    if len(samples) == 1:
        return np.repeat(samples, len(place), axis=0)
    slope = np.gradient(samples, axis=0, edge_order=2 if len(samples) > 2 else 1)
    if len(samples) > 4:
        ahead, behind = samples[4:] - samples[:-4], samples[3:-1] - samples[1:-3]
        slope[2:-2] = (8 * behind - ahead) / 12
    return CubicHermiteSpline(np.arange(len(samples)), samples, slope)(place)
