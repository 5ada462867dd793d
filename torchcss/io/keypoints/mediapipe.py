"""MediaPipe's 33 landmarks, in the ways in which people save them: JSON and arrays.

MediaPipe itself writes no file. What is found in the wild, and read here:

* a list of frames (alone, or under `frames`), each a list of landmarks, or an object that holds
  one under `landmarks`, `pose_landmarks`, `pose` or `keypoints`; or an object of frames by number;
* landmarks as `{"x", "y", "z", "visibility"}` in order, or by name or number; one list of them, or
  one for every person, as the newer interface returns them; null or nothing where nobody is seen;
* arrays `[T 33 4]` or `[T 132]` (x, y, z, visibility) and `[T 33 3]` or `[T 99]` (x, y, z), as NPY
  or in an NPZ.

Coordinates are fractions of the image from its corner, or pixels where people multiplied them:
the file tells. z is unreliable, and not used.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import real_numbers, shortened
from torchcss.io.keypoints.people import FRAME_NAMES, People, Person, frame_number, screened
from torchcss.joint_names import ALIASES

LAYOUT = "MediaPipe-33"
NUM_LANDMARKS = len(ALIASES[LAYOUT])

NAMES = (
    "nose", "left_eye_inner", "left_eye", "left_eye_outer",
    "right_eye_inner", "right_eye", "right_eye_outer", "left_ear", "right_ear",
    "mouth_left", "mouth_right", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist", "left_pinky", "right_pinky", "left_index", "right_index",
    "left_thumb", "right_thumb", "left_hip", "right_hip", "left_knee", "right_knee",
    "left_ankle", "right_ankle", "left_heel", "right_heel", "left_foot_index", "right_foot_index",
)  # fmt: skip
"""MediaPipe's own names, in its order."""

_HOLDERS = ("landmarks", "pose_landmarks", "pose", "keypoints", "landmark")
_CONFIDENCES = ("visibility", "confidence", "score", "presence")


def is_mediapipe(content: object) -> bool:
    """Whether a piece of JSON holds landmarks in one of these ways."""
    content = _frames_of(content)
    frames = list(content.values()) if isinstance(content, dict) else content
    return isinstance(frames, list) and (
        _is_landmarks(frames) or any(_is_landmarks(_landmarks_of(frame)) for frame in frames)
    )


def read_landmarks(path: Path, content: Any) -> People:
    """Read JSON of landmarks."""
    content = _frames_of(content)
    if isinstance(content, dict):
        places = [frame_number(path, key) for key in content]
        entries = list(content.values())
    else:
        entries = content
        places = [_place_of(path, entry, index) for index, entry in enumerate(entries)]
    if len(set(places)) < len(places):
        raise KeypointError(f"{path}: the same frame number twice; expected each frame once")
    found: dict[int, list[Person]] = {}
    for place, entry in zip(places, entries, strict=True):
        where = f"{path}: frame {place}"
        people = enumerate(_people_of(where, _landmarks_of(entry)))
        found[place] = [_triples(where, person, index) for index, person in people]
    return People(found, None, ["format: MediaPipe landmarks"], LAYOUT, corner_fractions=True)


def read_landmark_array(name: str, array: np.ndarray) -> People:
    """Read an array of landmarks, if it is one (see `is_landmark_array`)."""
    size = array.shape[-1] if array.ndim == 3 else array.shape[-1] // NUM_LANDMARKS
    values = array.astype(np.float64).reshape(len(array), NUM_LANDMARKS, size)
    seen = np.isfinite(values[..., :2]).all(-1) & (values[..., :2] != 0).any(-1)
    places = np.where(seen[..., None], values[..., :2], np.nan)
    found = screened(places, values[..., 3] if size == 4 else 1.0)
    report = [f"format: MediaPipe landmarks, array {name}"]
    if size == 3:
        report.append(
            "three numbers per landmark taken as x, y, z: confidence 1 where there is one"
        )
    return People([[person] for person in found], None, report, LAYOUT, corner_fractions=True)


def is_landmark_array(array: np.ndarray) -> bool:
    """Whether an array may be landmarks of every frame, by its shape."""
    n = NUM_LANDMARKS
    is_numbers = array.dtype.kind in "iuf" and array.ndim > 0 and len(array) > 0
    return is_numbers and array.shape[1:] in ((n, 4), (n, 3), (4 * n,), (3 * n,))


def _frames_of(content: Any) -> Any:
    """The frames in whatever holds them: a list, or an object of frames by number."""
    if isinstance(content, dict) and isinstance(content.get("frames"), (list, dict)):
        content = content["frames"]
    # A list of lists is one of frames, not of the people of one.
    whole = isinstance(content, list) and content and isinstance(content[0], dict)
    one_frame = isinstance(content, dict) and any(holder in content for holder in _HOLDERS)
    return [content] if one_frame or (whole and _is_landmarks(content)) else content


def _landmarks_of(entry: object) -> object:
    """What a frame holds, out of whatever it is wrapped in."""
    for _ in range(3):
        holder = next((key for key in _HOLDERS if isinstance(entry, dict) and key in entry), None)
        if holder is None:
            break
        entry = entry[holder]  # type: ignore[index]
    return entry


def _is_landmarks(value: object) -> bool:
    """Whether this is one person's landmarks, or a list of people."""
    if isinstance(value, dict):
        value = list(value.values())
    if not isinstance(value, list) or not value:
        return False
    first = value[0]
    if isinstance(first, list):
        return _is_landmarks(first)
    return isinstance(first, dict) and {"x", "y"} <= set(first)


def _people_of(where: str, landmarks: object) -> list[Any]:
    if landmarks is None or landmarks == [] or landmarks == {}:
        return []
    if not _is_landmarks(landmarks):
        raise KeypointError(
            f"{where}: expected landmarks with x and y, found {shortened(landmarks)}"
        )
    if isinstance(landmarks, list) and isinstance(landmarks[0], list):
        return [person for person in landmarks if person]
    return [landmarks]


def _triples(where: str, landmarks: object, person: int) -> Person:
    where = f"{where}: person {person}" if person else where
    found = np.zeros((NUM_LANDMARKS, 3))
    if isinstance(landmarks, Mapping):
        rows = [(_landmark_index(where, key), value) for key, value in landmarks.items()]
    elif isinstance(landmarks, list) and len(landmarks) == NUM_LANDMARKS:
        rows = list(enumerate(landmarks))
    else:
        size = len(landmarks) if isinstance(landmarks, list) else 0
        raise KeypointError(f"{where}: expected {NUM_LANDMARKS} landmarks, found {size}")
    for index, row in rows:
        if not isinstance(row, dict) or not {"x", "y"} <= set(row):
            raise KeypointError(
                f"{where}: landmark {index}: expected x, y and visibility, found {shortened(row)}"
            )
        confidence = next((row[key] for key in _CONFIDENCES if row.get(key) is not None), 1.0)
        numbers = real_numbers(
            [row["x"], row["y"], confidence], f"{where}: landmark {index}", KeypointError
        )
        found[index] = numbers
    return found


def _landmark_index(where: str, key: str) -> int:
    """Which landmark a name or number is."""
    name = re.sub(r"[^a-z0-9]+", "_", key.lower()).strip("_")
    if name in NAMES:
        return NAMES.index(name)
    if re.fullmatch(r"[0-9]{1,2}", name) and int(name) < NUM_LANDMARKS:
        return int(name)
    raise KeypointError(f"{where}: expected a landmark of MediaPipe, found {shortened(key)}")


def _place_of(path: Path, entry: object, index: int) -> int:
    """Number of a frame in a list: its own, or its place."""
    if isinstance(entry, dict):
        for key in (*FRAME_NAMES, "index"):
            value = entry.get(key)
            if isinstance(value, int) and not isinstance(value, bool):
                return frame_number(path, str(value))
    return index
