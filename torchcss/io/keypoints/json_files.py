"""2D joints in JSON, of whatever program: which frame holds which people.

Detectors nest the same things in different words, and `_FORMATS` lists what tells them apart.
Frames are a list, or entries by picture or number (AlphaPose, MediaPipe as people save it), or
carry number, time or picture with them (MMPose, openpifpaf, COCO's detections), or are a file each
in a folder (OpenPose, EasyMocap, labelme). What is in them: `torchcss.io.keypoints.json_people`.

Call `read_json` or `read_folder`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import load_json, read_text, shortened, unexpected
from torchcss.io.keypoints import annotated
from torchcss.io.keypoints.arrays import is_movenet, read_arrays
from torchcss.io.keypoints.clicked import is_clicked, read_clicked
from torchcss.io.keypoints.coco import read_coco
from torchcss.io.keypoints.frames import check_one_video, files_of, in_seconds, plain_name
from torchcss.io.keypoints.json_people import (
    JOINTS,
    PEOPLE,
    heads,
    is_joints,
    listed,
    people_of,
    said_size,
    scored,
)
from torchcss.io.keypoints.mediapipe import LAYOUT, NUM_LANDMARKS, reordered
from torchcss.io.keypoints.people import (
    Frames,
    Key,
    Names,
    People,
    Person,
    Size,
    joint_counts,
    keep_places,
    number_array,
    one_size,
    united,
    with_joints,
)
from torchcss.io.keypoints.tables import people_of_rows, rows_of_json
from torchcss.io.keypoints.words import (
    FRAMES,
    ORDER_NAMES,
    PICTURES,
    TIMES,
    VIDEOS,
    first_of,
    key_of,
    seconds_in,
    time_word,
)
from torchcss.io.pictures import natural_order
from torchcss.joint_names import canonical_joint_name

_FORMATS = {
    "pose_keypoints_2d": "OpenPose", "pose_keypoints": "OpenPose", "bodies": "AlphaPose",
    "instances": "MMPose", "instance_info": "MMPose", "predictions": "openpifpaf",
    "annots": "EasyMocap", "shapes": "labelme", "pose_landmarks": "MediaPipe",
    "keypoint_scores": "MMPose", "image_id": "COCO", "position": "PoseNet",
}  # fmt: skip
"""Whose a file is, by a word in it."""

_OTHERS = {
    "categories items": "Datumaro's; datum convert -if datumaro -f coco_person_keypoints -i FOLDER "
    "makes COCO's of it",
    "objects tags size": "Supervisely's; export the project as COCO keypoints",
    "shapes tracks tags": "CVAT's backup of a task; export the task as 'CVAT for video 1.1' or "
    "'COCO Keypoints 1.0'",
    "annotations item": "V7 Darwin's; export the dataset as COCO",
    "data_row projects": "Labelbox's; convert it to COCO",
    "bodyparts bboxes": "DeepLabCut's before it makes a table of it; give the .h5 beside it",
    "bone_list frames": "Azure Kinect's joints in space; expected pixels",
    "univTime bodies": "CMU Panoptic's joints in space; expected pixels",
    "annolist": "annotations as MPII and PoseTrack had them before COCO's; convert them to these",
}
"""Files of other kinds by words in them, and what to do."""

_BY_LINES = (".jsonl", ".ndjson", ".txt")

_HUGE = 1e19
"""No number of a frame is so large, nor a time, were it in nanoseconds since 1970."""

_PERSON = re.compile("(person|human|subject|player|individual|track)[ _-]?(id)?[ _-]?[0-9]+", re.I)
"""A key that is somebody, and no frame."""

_TIME = re.compile(r"[0-9]+\.[0-9]+")
"""A key that is a time, and no number of a frame."""

_FRAMES = ("frames", "instanceinfo", "results", "data")


def read_json(path: Path, image_size_wh: Size, num_frames: int | None) -> People:
    """Read a file of one picture or of a video.

    Args:
        path: The file.
        image_size_wh: Size of the video, which clicked joints must fit.
        num_frames: Of the video: a list of people without frames is of one picture if it has one.

    Raises:
        KeypointError: If it is none of the formats; the message says where.
    """
    return read_content(path, _load(path), image_size_wh, num_frames)


def read_content(path: Path, content: Any, image_size_wh: Size, num_frames: int | None) -> People:
    """The same of what a file of JSON holds."""
    if (array := _plain_array(content)) is not None and is_movenet(array):
        return read_arrays(path, {path.name: array})
    if annotated.is_label_studio(content):
        return annotated.read_label_studio(content)
    if (rows := rows_of_json(content)) is not None:
        return people_of_rows(rows)
    if isinstance(content, dict):
        if annotated.is_via(content):
            return annotated.read_via(content)
        if "annotations" in content:
            return read_coco(content)
        if "skeleton" in content and isinstance(content.get("keypoints"), list):
            return _read_vitpose(path, content)
        if is_clicked(content):
            return read_clicked(content, image_size_wh)
    name = _format_of(content)
    from_one = name == "openpifpaf" or (isinstance(content, dict) and "instance_info" in content)
    frames = _frames(path, content, num_frames)
    in_order = isinstance(frames, list)
    found, own = united(dict(enumerate(frames)) if in_order else frames)
    people = _people(name, found, own or _said_names(content, found))
    first = 1 if from_one else None
    return people._replace(in_order=in_order, first=first, size_wh=_size(content))


def read_folder(path: Path) -> People:
    """Read a folder of one file for every frame.

    Raises:
        KeypointError: If there is none, or one is none of the formats.
    """
    files = sorted(files_of(path, ".json"), key=lambda entry: natural_order(entry.name))
    contents = [_load(file) for file in files]
    name = _format_of(contents[0])
    sizes = {said_size(content) for content in contents}
    size = one_size(sizes - {None})
    # Who labels pictures may call the files otherwise than the pictures.
    said = [first_of(each, PICTURES) if isinstance(each, dict) else None for each in contents]
    keys = [plain_name(each) for each in said if isinstance(each, str)]
    if len(set(keys)) < len(files):
        keys = [plain_name(file.name) for file in files]
    found: Frames = {}
    for file, key, content in zip(files, keys, contents, strict=True):
        if key in found:
            raise KeypointError(f"{file}: a second file of the frame {key}; expected one for each")
        found[key] = people_of(str(file), content)
    frames, names = united(found)
    names = names or _said_names(contents[0], frames)
    people = _people(f"{name}, {len(files)} files", frames, names)
    # A labelled picture has a file; of a video every frame has one. OpenPose's names count from 0.
    first = 0 if re.search("_[0-9]{12}_keypoints.json$", files[0].name) else None
    return people._replace(whole=name != "labelme", size_wh=size, first=first)


def _people(name: str, frames: Frames, names: Names | None) -> People:
    """People of a format; 33 joints are MediaPipe's, whatever they are called or how ordered."""
    if keep_places([person.joints for person in people] for people in frames.values()):
        for people in frames.values():
            people[:] = [p._replace(track=p.track or f"{n}") for n, p in enumerate(people)]
    frames, names = reordered(frames, names or ())
    report, layout = [f"format: {name}"], None
    if names is None and NUM_LANDMARKS in joint_counts(frames):
        report, layout = ["format: MediaPipe landmarks"], LAYOUT
    return People(frames, names, report, layout, corner_fractions=layout == LAYOUT)


def _plain_array(content: object) -> np.ndarray | None:
    """Lists of lists of numbers alone, as what MoveNet returns."""
    inner, depth = content, 0
    while isinstance(inner, list) and inner and depth < 5:
        inner, depth = inner[0], depth + 1
    with suppress(KeypointError):
        return number_array(content, "") if depth > 2 and isinstance(inner, float) else None
    return None


def _load(path: Path) -> Any:
    """The content of a JSON file, or of one object in every line or text."""
    try:
        content = load_json(path, KeypointError)
        first = content[0] if isinstance(content, list) and content else content
        for words, what in _OTHERS.items():
            if isinstance(first, dict) and {*words.split()} <= first.keys():
                raise KeypointError(f"{path}: {what}")
        if not isinstance(content, list) or not all(isinstance(each, str) for each in content):
            return content
        lines = content
    except KeypointError as error:
        if "Extra data" not in str(error) and path.suffix.lower() not in _BY_LINES:
            raise
        lines = read_text(path, KeypointError).splitlines()
    try:
        return [json.loads(line) for line in lines if line.strip()]
    except (ValueError, RecursionError) as error:
        raise KeypointError(f"{path}: not a JSON file, nor one object in every line") from error


# What a file says of itself.


def _format_of(content: object) -> str:
    """The program that writes such files."""
    words: set[str] = set()
    layer: list[Any] = [content]
    for _ in range(5):
        words |= {key for each in layer if isinstance(each, dict) for key in each}
        below = ([*each.values()] if isinstance(each, dict) else each for each in layer)
        layer = [one for each in below if isinstance(each, list) for one in each[:3]]
    return next((name for word, name in _FORMATS.items() if word in words), "JSON")


def _said_names(content: object, frames: Frames) -> Names | None:
    """As many names as joints that stand in the head, as a list or by number (MMPose's)."""
    counts = joint_counts(frames)
    for head in heads(content):
        names = first_of(head, ORDER_NAMES)
        if isinstance(names, dict) and all(str(i) in names for i in range(len(names))):
            names = [names[str(i)] for i in range(len(names))]
        if isinstance(names, list) and {len(names)} == counts and isinstance(names[0], str):
            return tuple(map(str, names))
    return None


# Frames.


def _not_keypoints(path: Path, content: Any) -> KeypointError:
    """What a file looks like that holds no list of people."""
    if isinstance(content, dict) and {"cameras", "K", "camera_matrix"} & content.keys():
        return KeypointError(f"{path}: a calibration, not keypoints; give it with --camera")
    return KeypointError(
        f"{path}: not a keypoint file; expected what a detector writes (docs/guide.md lists the "
        f"formats), found {shortened(content)}"
    )


def _frames(path: Path, content: Any, num_frames: int | None) -> list[list[Person]] | Frames:
    """The people of every frame, by what the file says of it, or in order."""
    if isinstance(content, dict):
        if (inner := first_of(content, _FRAMES, (list, dict))) is not None:
            return _frames(path, inner, num_frames)
        inner = content.get(key_of(content, (*PEOPLE, *JOINTS)) or "")
        if isinstance(inner, list) and 1 < len(inner) == num_frames and not is_joints(inner):
            return _frames(path, scored(inner, content), num_frames)
        if (rows := _by_joint(content)) is not None:
            return _frames(path, rows, num_frames)
        told = [each for each in content.values() if isinstance(each, list) and _say_frames(each)]
        if len(told) == 1 and _key_of("", content) is None:
            return _frames(path, told[0], num_frames)
        if inner is not None or "shapes" in content:
            return [people_of(str(path), content)]
        if content and (all(map(_PERSON.fullmatch, content)) or _are_people(content, num_frames)):
            return _of_people({who: _frames(path, own, num_frames) for who, own in content.items()})
        if content and all(isinstance(value, (dict, list)) for value in content.values()):
            found = {key: people_of(f"{path}: {key}", value) for key, value in content.items()}
            if any(found.values()):
                are_times = all(map(_TIME.fullmatch, content))
                frames: Frames = {float(k) if are_times else k: p for k, p in found.items()}
                return in_seconds("t", frames) if are_times else frames
    if not isinstance(content, list):
        raise _not_keypoints(path, content)
    videos = [first_of(entry, VIDEOS) for entry in content if isinstance(entry, dict)]
    check_one_video({video for video in videos if isinstance(video, (str, int))})
    keys = [_key_of(f"{path}: detection {i}", entry) for i, entry in enumerate(content)]
    if len(set(keys)) == 1 < len(keys) == num_frames:  # such as the name of the video
        keys = [None] * len(keys)
    if len(set(keys)) == len(keys) and _are_durations(keys):
        keys = [None] * len(keys)
    if all(key is None for key in keys):
        if num_frames == 1 or is_joints(content) or not content:
            return [people_of(str(path), content)]
        return [people_of(f"{path}: frame {index}", entry) for index, entry in enumerate(content)]
    found: Frames = {}
    for index, (key, entry) in enumerate(zip(keys, content, strict=True)):
        if key is None:
            raise KeypointError(
                f"{path}: entry {index}: expected a frame number, image_id, name or time, as the "
                f"others have, found {shortened(entry)}"
            )
        found.setdefault(key, []).extend(people_of(f"{path}: {key!r}", entry, alone=True))
    time = time_word(content[0]) if all(isinstance(key, float) for key in found) else None
    if isinstance(first_of(content[0], (time or "",)), str):
        time = "seconds"
    return found if time is None else in_seconds(time, found)


def _by_joint(content: Mapping[str, Any]) -> list[dict[str, Any]] | None:
    """The frames of a file that has joints by name, and each in all frames; None: it is another."""
    if not content or not all(map(canonical_joint_name, content)):
        return None
    columns = [_of_columns(each) for each in content.values()]
    if len({*map(len, columns)}) != 1 or not is_joints(columns[0]):
        columns = [[each] for each in content.values()]  # in one frame
        if not is_joints([*content.values()]):
            return None
    rows = (zip(content, row, strict=True) for row in zip(*columns, strict=True))
    return [{"keypoints": {name: joint for name, joint in row if joint}} for row in rows]


def _of_columns(joint: Any) -> list[Any]:
    """A joint's places in all frames, which may be lists of x, of y and of confidences."""
    columns = [*joint.values()] if isinstance(joint, dict) else []
    if not columns or not all(isinstance(each, list) for each in columns):
        return listed(joint)
    return [dict(zip(joint, row, strict=True)) for row in zip(*columns, strict=False)]


def _are_people(content: Mapping[str, Any], num_frames: int | None) -> bool:
    """Whether people have numbers, and below them more frames than there are people (AlphaPose)."""
    people = [own if isinstance(own, dict) else {"": own} for own in content.values()]
    frames = {key: each for own in people for key, each in own.items()}
    numbered = all(re.fullmatch("[0-9]{1,9}", key) for key in (*content, *frames))
    if not numbered or any(is_joints([each]) for each in frames.values()):
        return False
    fewer = num_frames is None or len(frames) <= num_frames
    return fewer and sum(map(len, people)) > len(content) ** 2


def _of_people(found: Mapping[str, list[list[Person]] | Frames]) -> list[list[Person]] | Frames:
    """The people of every frame, of each person's frames."""
    every: Frames = {}
    for who, frames in found.items():
        for key, people in enumerate(frames) if isinstance(frames, list) else frames.items():
            own = [person._replace(track=person.track or who) for person in people]
            every.setdefault(key, []).extend(own)
    counts = {len(frames) if isinstance(frames, list) else 0 for frames in found.values()}
    if counts == {0}:
        return every
    if len(counts) > 1:
        raise KeypointError(
            f"{', '.join(found)}: expected as many frames of everybody, or numbered ones"
        )
    return [*every.values()]


_UNEVEN = 0.1
"""Of a step between frames: by how much times of frames may miss it."""


def _are_durations(keys: Sequence[Key | None]) -> bool:
    """Whether times are how long something took.

    Those of frames rise from entry to entry, or are whole steps apart in their order.
    """
    times = [key for key in keys if isinstance(key, float)]
    if len(times) < len(keys) or times == sorted(times):
        return False
    gaps = np.diff(np.sort(times))
    steps = gaps / np.median(gaps)
    return len(gaps) < 2 or bool((abs(steps - steps.round()) > _UNEVEN).any())


def _key_of(where: str, entry: object) -> Key | None:
    """Which frame an entry says that it is."""
    if not isinstance(entry, dict):
        return None
    if not isinstance(entry.get("image_id", 0), (int, float, str)):
        raise unexpected(KeypointError, where, "an image_id", entry["image_id"])
    counts = {
        k: v
        for k, v in entry.items()
        if isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) < _HUGE
    }
    texts = {k: v for k, v in entry.items() if isinstance(v, str)}
    frame = first_of(counts, FRAMES)
    if frame is not None and float(frame).is_integer():
        return int(frame)
    counted = first_of({k: v for k, v in texts.items() if re.fullmatch("[0-9]{1,9}", v)}, FRAMES)
    if counted is not None:
        return int(counted)
    codes = {k: code for k, text in texts.items() if (code := seconds_in(text)) is not None}
    time = first_of({**counts, **codes}, tuple(TIMES))
    return float(time) if time is not None else first_of(texts, PICTURES)


def _say_frames(entries: Sequence[Any]) -> bool:
    """Whether entries hold people, and say of which frames they are."""
    return bool(entries) and all(
        isinstance(each, dict)
        and key_of(each, (*PEOPLE, *JOINTS)) is not None
        and _key_of("", each) is not None
        for each in entries
    )


def _size(content: Any) -> tuple[float, float] | None:
    """The size of the images that the file or its first frame names."""
    inner = None
    if isinstance(content, dict):
        inner = first_of(content, _FRAMES, (list, dict))
        if inner is None and key_of(content, (*PEOPLE, *JOINTS)) is None:
            inner = content  # by picture
    frames = [*inner.values()] if isinstance(inner, dict) else inner
    return said_size(content) or said_size(frames)


def _read_vitpose(path: Path, content: Mapping[str, Any]) -> People:
    """Read easy_ViTPose's: per frame people by number, their joints y, x, score."""
    names = content["skeleton"]
    names = tuple(map(str, names.values() if isinstance(names, dict) else listed(names)))
    frames: Frames = {}
    for index, entry in enumerate(content["keypoints"]):
        frames[index] = people_of(f"{path}: frame {index}", entry)
    frames = with_joints(frames, lambda joints: joints[:, [1, 0, 2]])
    return People(frames, names or None, ["format: easy_ViTPose (y before x)"], in_order=True)
