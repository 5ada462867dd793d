"""The people of one frame in JSON, and the joints of each, however they are nested.

*People* are a list, or stand under `people`, `instances`, `predictions`, `annots`, or by their own
numbers. *Joints* are `x, y, confidence` in a row, pairs or triples, objects with `x` and `y`, lists
of x, of y and of confidences, or rows by name; their confidences may stand beside them. What is not
there is null, empty, or zero.

Call `people_of`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import unexpected
from torchcss.io.keypoints.annotated import labelme_people
from torchcss.io.keypoints.mediapipe import FOURS
from torchcss.io.keypoints.people import (
    LAYOUT_SIZES,
    MOST_JOINTS,
    Person,
    number_array,
    screened,
    track_of,
)
from torchcss.io.keypoints.words import (
    CONFIDENCES,
    JOINT_WORDS,
    SCORES,
    SHAPES,
    SIDES,
    SIZES,
    first_of,
    key_of,
    plain_word,
)
from torchcss.joint_names import ALIASES, names_in

PEOPLE = names_in(
    "people bodies instances instanceinfo predictions annots poses persons players detections body"
)
_OBJECTS = names_in("bodylist objects skeletons skeleton result results")
"""The same, where no joints stand beside it: other programs' objects are boxes."""

JOINTS = names_in(
    "posekeypoints2d posekeypoints predkeypoints keypoints poselandmarks landmarks landmark joints "
    "pose kps kpts keypointsxy keypoints2d keypoint2d joints2d predkeypoints2d kp2d"
)
_AXES = tuple(
    names_in(f"pixel{axis} color{axis} image{axis} {axis}2d {axis}px {axis}") for axis in "xy"
)
"""What the coordinates of a joint are called; pixels come before points in space (Kinect)."""

_PLACES = names_in("position coordinate coordinates point location")
"""What both together are called."""

_BOX = frozenset(names_in("x left x1 xmin"))
"""What has a word of these has the size of a box."""

_OF_COCO = len(ALIASES["COCO-17"])

_HEADS = names_in("meta_info metadata meta info header video video_info image")


def people_of(where: str, value: Any, *, alone: bool = False) -> list[Person]:
    """The people of a frame, out of whatever they are wrapped in.

    Args:
        where: For messages.
        value: What the file has.
        alone: It must hold people, and not be empty in words of its own.
    """
    if value is None or value == [] or value == {}:
        return []
    if isinstance(value, dict):
        if "shapes" in value:
            return labelme_people(where, value["shapes"])
        if (key := key_of(value, PEOPLE)) is not None:
            if not isinstance(value[key], (list, dict, type(None))):
                raise KeypointError(f"{where}: expected a list {key!r}")
            if isinstance(value[key], dict) and {"candidate", "subset"} <= value[key].keys():
                return _of_candidates(f"{where}: {key}", value[key])
            return people_of(f"{where}: {key}", value[key])
        if (key := key_of(value, JOINTS)) is not None:
            inner = value[key]
            if isinstance(inner, dict) and isinstance(inner.get("xy"), list):  # Ultralytics' own
                return people_of(where, {"keypoints": inner["xy"], "scores": inner.get("conf")})
            if isinstance(inner, dict) and key_of(inner, JOINTS) is not None:
                return people_of(where, inner)
            if isinstance(inner, list) and inner and not is_joints(inner) and not _flat(inner):
                return people_of(f"{where}: {key}", scored(inner, value))
            return one_person(f"{where}: {key}", inner, value)
        if (key := key_of(value, _OBJECTS)) is not None and isinstance(value[key], (list, dict)):
            return people_of(f"{where}: {key}", value[key])
        named = {key: each for key, each in value.items() if is_joints([each])}
        rest = [each for key, each in value.items() if key not in named]
        if named and not any(isinstance(each, (list, dict)) for each in rest):
            return one_person(where, named, value)
        if alone or not all(isinstance(each, (list, dict)) for each in value.values()):
            what = "keypoints (docs/guide.md lists the formats; most programs export COCO's)"
            raise unexpected(KeypointError, where, what, list(value))
        if space := [key for key in value if re.search("world|3d", plain_word(key))]:
            raise KeypointError(f"{where}: {space[0]!r} are points in space; expected pixels")
        # By the people's own numbers.
        return [
            person._replace(track=person.track or key)
            for key, each in value.items()
            for person in people_of(f"{where}: {key}", each)
        ]
    if isinstance(value, list):
        if is_joints(value) or _flat(value):
            return one_person(where, value)
        return [
            person
            for index, each in enumerate(value)
            for person in people_of(f"{where}[{index}]", each)
        ]
    raise unexpected(KeypointError, where, "people with keypoints", value)


def _of_candidates(where: str, value: Mapping[str, Any]) -> list[Person]:
    """The people of DWPose as it returns them, who have a number below 0 where a place is none."""
    if not value["candidate"]:
        return []
    places = number_array(value["candidate"], f"{where}: candidate")
    numbers = number_array(value["subset"], f"{where}: subset")
    if numbers.shape[1:] != (18,) or places.shape != (numbers.size, 2):
        raise KeypointError(
            f"{where}: expected a candidate x, y for each of the 18 numbers of everyone in subset, "
            f"found {list(places.shape)} for {list(numbers.shape)}"
        )
    places = np.where(numbers.reshape(-1, 1) < 0, np.nan, places)
    return [Person(screened(own)) for own in np.split(places, len(numbers))]


def scored(people: list[Any], around: Mapping[str, Any]) -> list[Any]:
    """People, or frames of them, whose joints are pairs, with what stands beside all as scores."""
    scores, joint = first_of(around, SCORES, list), people
    while isinstance(joint, list) and isinstance(next(filter(None, joint), None), list):
        joint = next(filter(None, joint))
    if scores is None or len(joint) == 3 or len(scores) != len(people):
        return people
    beside = [(each or [], own or []) for each, own in zip(people, scores, strict=True)]
    if not all(
        isinstance(each, list) and isinstance(own, list)
        and len(each) in (len(own), 2 * len(own))  # pairs, or in a row
        for each, own in beside
    ):  # fmt: skip
        return people
    return [{"keypoints": each, "scores": own} for each, own in beside]


def _flat(value: list[Any]) -> bool:
    return isinstance(value[0], (int, float, str))


def is_joints(value: list[Any]) -> bool:
    """Whether a list is one person's joints: short rows of numbers, or objects with x and y."""
    first = next((each for each in value if each is not None), None)
    if isinstance(first, dict):
        key = key_of(first, JOINTS)  # of a person, who may have a box with x and y
        if key is not None and isinstance(first[key], (list, dict)):
            return False
        return _has_place(_place_of(first))
    return (
        isinstance(first, list) and 2 <= len(first) <= 4 and not isinstance(first[0], (list, dict))
    )


def _place_of(row: Mapping[str, Any]) -> Mapping[str, Any]:
    """What of a joint has x and y: itself, or its place."""
    place = first_of(row, _PLACES)
    if isinstance(place, list) and len(place) == 2:
        return dict(zip("xy", place, strict=True))
    return place if isinstance(place, dict) else row


def _has_place(entry: Mapping[str, Any]) -> bool:
    """Whether an object has x and y."""
    return all(key_of(entry, words) is not None for words in _AXES)


def one_person(where: str, value: Any, around: Mapping[str, Any] | None = None) -> list[Person]:
    """One person by the joints, and what the file says around them; nobody where there are none."""
    around = around or {}
    names: list[Any] | None = None
    if isinstance(value, dict):
        if isinstance(value.get("x"), list):  # a list of x, of y, of confidences
            columns = [value["x"], value.get("y")]
            given = first_of(value, CONFIDENCES)
            columns += [] if given is None else [given]
            value = [list(row) for row in zip(*map(listed, columns), strict=False)]
        else:
            names, value = list(value), list(value.values())
    if value is None or value == []:
        return []
    if not isinstance(value, list):
        raise unexpected(KeypointError, where, "numbers", value)
    scores = first_of(around, SCORES, list)
    while isinstance(scores, list) and scores and isinstance(scores[0], list):
        scores = [each[0] if isinstance(each, list) and each else each for each in scores]
    if _flat(value) or value[0] is None:
        if names is not None:
            raise unexpected(KeypointError, where, "x and y of every joint", around or value)
        joints = _in_a_row(where, number_array(value, where), scores)
    else:
        if len(sizes := {len(row) for row in value if isinstance(row, list)}) > 1:
            found = " and ".join(map(str, sorted(sizes)))
            raise KeypointError(f"{where}: expected as many numbers for every joint, found {found}")
        rows = np.array([_row(f"{where}: joint {n}", row) for n, row in enumerate(value)])
        joints = _joints(where, rows[:, :2], rows[:, 2], scores)
        if names is None:
            names = _said_by_rows(value)
            joints = joints if names else _by_labels(joints, listed(around.get("labels")))
    return [Person(joints, track_of(around), None if names is None else tuple(map(str, names)))]


def _said_by_rows(rows: list[Any]) -> list[str] | None:
    """The joints' names, or else their numbers, where every row has its own."""
    if not all(isinstance(row, dict) for row in rows):
        return None
    for kind in (str, int):
        said = [
            first_of({k: v for k, v in row.items() if type(v) is kind}, JOINT_WORDS) for row in rows
        ]
        found = [str(each) for each in said if each is not None]
        if len(found) == len(rows) and (kind is str or _are_numbers(found)):
            return found
    return None


def _by_labels(joints: np.ndarray, labels: list[Any]) -> np.ndarray:
    """All joints of one of whom Transformers keeps those above a threshold, by their numbers."""
    whole = all(type(each) is int and 0 <= each < _OF_COCO for each in labels)
    if not whole or len(labels) != len(joints) or len({*labels}) < len(labels):
        return joints
    found = np.zeros((_OF_COCO, 3))
    found[labels] = joints
    return found


def _are_numbers(found: list[str]) -> bool:
    """Whether these are the numbers of joints, and not of people or of entries."""
    return len({*found}) == len(found) and all(0 <= int(each) < MOST_JOINTS for each in found)


def listed(value: object) -> list[Any]:
    """A list, empty if the value is none."""
    return value if isinstance(value, list) else []


def _in_a_row(where: str, values: np.ndarray, scores: object) -> np.ndarray:
    """Joints from a row of triples, of MediaPipe's fours, or of pairs with confidences beside."""
    if values.shape == FOURS[1]:  # x, y, z, visibility
        return values.reshape(FOURS[0])[:, [0, 1, 3]]
    triples = values.size % 3 == 0 and values.size // 3 in LAYOUT_SIZES
    alone = not triples and values.size % 2 == 0 and values.size // 2 in LAYOUT_SIZES
    pairs = values.size == 2 * len(scores) if isinstance(scores, list) else alone
    if not values.size or values.size % (2 if pairs else 3):
        raise KeypointError(
            f"{where}: expected x, y, confidence for every joint in one list, found "
            f"{values.size} numbers"
        )
    if pairs:
        return _joints(where, values.reshape(-1, 2), None, scores)
    return values.reshape(-1, 3)


def _joints(
    where: str, places: np.ndarray, confidence: np.ndarray | None, scores: object
) -> np.ndarray:
    """Joints with their confidences, those beside them if there are some."""
    if scores is not None:
        confidence = number_array(scores, f"{where}: scores")
        if confidence.shape != places.shape[:1]:
            raise KeypointError(
                f"{where}: {confidence.size} confidences for {len(places)} joints; expected as many"
            )
    return screened(places, confidence)


def _row(where: str, row: Any) -> list[float]:
    """x, y and confidence, NaN where it is not said, of a list or an object."""
    if row is None:
        return [np.nan] * 3
    if isinstance(row, dict):
        place = _place_of(row)
        if not _has_place(place):
            raise unexpected(KeypointError, where, "x, y and visibility", row)
        given = first_of(row, CONFIDENCES)
        x, y = (first_of(place, words) for words in _AXES)
        row = [x, y, float(given) if isinstance(given, bool) else given]
    elif isinstance(row, list) and len(row) == 4:
        row = [row[0], row[1], row[3]]  # x, y, z, visibility
    values = number_array(row, where)
    if values.shape not in ((2,), (3,)):
        raise unexpected(KeypointError, where, "x, y[, confidence]", row)
    return [*values.tolist(), np.nan][:3]


def heads(content: object) -> list[dict[str, Any]]:
    """What a file says of itself: in its outermost object, and in one that is called so."""
    if not isinstance(content, dict) or not _BOX.isdisjoint(content):
        return []
    inner = (each for key, each in content.items() if key in _HEADS)
    return [content, *(each for each in inner if isinstance(each, dict))]


def said_size(content: object) -> tuple[float, float] | None:
    """The size of the image that a file names, in its head or its first entry."""
    if isinstance(content, list) and content:
        content = content[0]
    for head in heads(content):
        size, shape = first_of(head, SIZES), first_of(head, SHAPES)
        sizes = [size if isinstance(size, list) else []]
        sizes += [shape[1::-1] if isinstance(shape, list) else []]
        sizes += [[first_of(head, (side,)) for side in pair] for pair in SIDES]
        for pair in sizes:
            if len(pair) == 2 and all(isinstance(n, (int, float)) and n > 0 for n in pair):
                return float(pair[0]), float(pair[1])
    return None
