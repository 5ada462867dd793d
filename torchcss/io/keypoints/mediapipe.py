"""MediaPipe's 33 landmarks: their names, and arrays of them.

MediaPipe itself writes no file. People save JSON (`torchcss.io.keypoints.json_files`), tables, or
arrays `[T 33 4]` or `[T 132]` (x, y, z, visibility) and `[T 33 3]` or `[T 99]` (x, y, z).
Coordinates are fractions of the image from its corner, or pixels where people multiplied them:
the file tells. z is unreliable, and not used.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from torchcss.errors import KeypointError
from torchcss.io.keypoints.people import (
    LAYOUT_SIZES,
    Frames,
    Names,
    joint_counts,
    with_joints,
)
from torchcss.joint_names import ALIASES, CASE, names_in

LAYOUT = "MediaPipe-33"
NUM_LANDMARKS = len(ALIASES[LAYOUT])
FOURS = (NUM_LANDMARKS, 4), (4 * NUM_LANDMARKS,)
"""Shapes of a frame's landmarks with z and visibility."""

_FACE, _HAND = 468, 21
_HOLISTIC = 4 * NUM_LANDMARKS + 3 * (_FACE + 2 * _HAND)
"""Numbers of the landmarks of body, face and hands in a row, the body's first."""

_HIPS, _AT_ORIGIN = [23, 24], 2e-3
"""The hips, and how far their middle may be from the origin: people round numbers."""

MEDIAPIPE_NAMES = names_in(
    "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer "
    "left_ear right_ear mouth_left mouth_right left_shoulder right_shoulder left_elbow right_elbow "
    "left_wrist right_wrist left_pinky right_pinky left_index right_index left_thumb right_thumb "
    "left_hip right_hip left_knee right_knee left_ankle right_ankle left_heel right_heel "
    "left_foot_index right_foot_index"
)
"""MediaPipe's own names, in its order."""


def reordered(frames: Frames, names: Sequence[str]) -> tuple[Frames, Names | None]:
    """The people and the names of their joints; numbered joints and MediaPipe's in their order.

    Args:
        frames: The people.
        names: Names of their joints, or none; what comes in an order has none any more.
    """
    spaced = (re.sub(CASE, " ", name).lower() for name in names)
    plain = [re.sub(r"[^a-z0-9]+", "_", name).strip("_") for name in spaced]
    # Of Python's enumeration, and of ML Kit's.
    plain = [re.sub("^pose_landmark_(type_)?", "", name) for name in plain]
    plain = [re.sub("^(left|right)_mouth$", r"mouth_\1", name) for name in plain]
    if plain and all(map(str.isdecimal, plain)):
        frames = _by_number(frames, [int(number) for number in plain])
        order = [*range(NUM_LANDMARKS)]
        if joint_counts(frames) != {NUM_LANDMARKS + _FACE}:  # body and face
            return frames, None
    elif set(plain) == set(MEDIAPIPE_NAMES):
        order = [plain.index(name) for name in MEDIAPIPE_NAMES]
    else:
        return frames, tuple(names) or None
    return with_joints(frames, lambda joints: joints[order]), None


def _by_number(frames: Frames, numbers: Sequence[int]) -> Frames:
    """People whose joints are in the order of their numbers; joints that are left out are zero.

    Raises:
        KeypointError: If it is not clear whether 0 or 1 is the first, or one has no number.
    """
    low, high = min(numbers), max(numbers)
    first = low
    numbered_on = low % 100 == 0 and len(numbers) in LAYOUT_SIZES  # the second person's: 100, 101
    if high - low + 1 != len(numbers) or (low > 1 and not numbered_on):  # some are left out
        firsts = [f for f in (0, 1) if f <= low and high - f + 1 in LAYOUT_SIZES]
        if len(firsts) != 1:
            raise KeypointError(
                f"{len(numbers)} joints numbered from {low} to {high}: which they are is not "
                "known; number all of them, or name them"
            )
        first = firsts[0]
    place = [number - first for number in numbers]

    def in_place(joints: np.ndarray) -> np.ndarray:
        found = np.zeros((high - first + 1, 3))
        found[place] = joints
        return found

    return with_joints(frames, in_place)


def check_not_in_space(frames: Sequence[np.ndarray]) -> None:
    """Refuse `pose_world_landmarks`, whose origin is the middle of the hips.

    Args:
        frames: The people of every frame, `[p 33 3]`.

    Raises:
        KeypointError: If most people's hips are about the origin.
    """
    middles = np.concatenate([frame[:, _HIPS, :2].mean(1) for frame in frames])
    if len(middles) and np.median(np.abs(middles).max(-1)) < _AT_ORIGIN:
        raise KeypointError(
            "these landmarks are points in space about the middle of the hips, MediaPipe's "
            "pose_world_landmarks; expected its pose_landmarks, which are places in the picture"
        )


def landmark_places(array: np.ndarray) -> np.ndarray:
    """x, y and visibility, if there is one, of an array of landmarks (see `is_landmark_array`)."""
    if array.shape[1:] == (_HOLISTIC,):
        array = array[:, : 4 * NUM_LANDMARKS]
    values = array.astype(np.float64).reshape(len(array), NUM_LANDMARKS, -1)
    return values[..., [0, 1, 3]] if values.shape[2] == 4 else values[..., :2]


def is_landmark_array(array: np.ndarray) -> bool:
    """Whether an array may be landmarks of every frame, by its shape."""
    n = NUM_LANDMARKS
    is_numbers = array.dtype.kind in "iuf" and array.ndim > 0 and len(array) > 0
    return is_numbers and array.shape[1:] in ((n, 4), (n, 3), (4 * n,), (3 * n,), (_HOLISTIC,))
