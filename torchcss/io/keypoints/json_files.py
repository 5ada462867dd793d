"""2D joints in JSON, of whatever program: frames, the people in each, the joints of each person.

Detectors nest the same three things in different words, and `_FORMATS` lists what tells them apart.
*Frames* are a list, or entries by picture or number (AlphaPose, MediaPipe as people save it), or
carry number, time or picture with them (MMPose, openpifpaf), or are a file each in a folder
(OpenPose, EasyMocap, labelme). *People* are a list under `people`, `instances`, `predictions`,
`annots`; a list of detections may also say of each which frame it is from (COCO). *Joints* are
`x, y, confidence` in a row, pairs or triples, objects with `x` and `y`, or rows by name; their
confidences may stand beside them. What is not there is null, empty, or zero.

Call `read_json` or `read_folder`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import load_json, read_text, real_numbers, shortened
from torchcss.io.keypoints.frames import plain_name
from torchcss.io.keypoints.mediapipe import LAYOUT, NAMES
from torchcss.io.keypoints.people import (
    CONFIDENCE_NAMES,
    FRAME_NAMES,
    Key,
    Marked,
    People,
    Person,
    is_there,
    numbers,
    screened,
    track_of,
    united,
)
from torchcss.io.video import natural_order
from torchcss.joint_names import JOINT_NAMES, canonical_joint_name

_FORMATS = {
    "pose_keypoints_2d": "OpenPose", "pose_keypoints": "OpenPose", "bodies": "AlphaPose",
    "instances": "MMPose", "instance_info": "MMPose", "predictions": "openpifpaf",
    "annots": "EasyMocap", "shapes": "labelme", "pose_landmarks": "MediaPipe",
    "keypoint_scores": "MMPose", "image_id": "COCO", "position": "PoseNet",
}  # fmt: skip
"""Whose a file is, by a word in it."""

_FRAMES = ("frames", "instance_info", "results", "data")
_PEOPLE = ("people", "bodies", "instances", "predictions", "annots", "poses", "persons",
           "detections")  # fmt: skip
_JOINTS = ("pose_keypoints_2d", "pose_keypoints", "keypoints", "pose_landmarks", "landmarks",
           "landmark", "joints", "pose", "kps")  # fmt: skip
_SCORES = ("keypoint_scores", "keypoints_scores", "scores", "confidences", "keypoints_conf")
_PICTURES = ("image_id", "file_name", "filename", "image", "image_name", "img_name", "image_path",
             "imagePath", "frame_name")  # fmt: skip
_TIMES = {"timestamp_ms": 1e-3, "time_ms": 1e-3, "timestamp_us": 1e-6, "time_s": 1.0,
          "timestamp": None, "time": None, "t": None}  # fmt: skip
"""Words for a time, and its unit in seconds, where the word says it."""


def read_json(path: Path, image_size_wh: tuple[int, int], num_frames: int | None) -> People:
    """Read a file of one picture or of a video.

    Args:
        path: The file.
        image_size_wh: Size of the video, which clicked joints must fit.
        num_frames: Of the video: a list of people without frames is of one picture if it has one.

    Raises:
        KeypointError: If it is none of the formats; the message says where.
    """
    content = _load(path)
    if isinstance(content, dict):
        if "annotations" in content:
            return _read_coco(path, content)
        if "skeleton" in content and isinstance(content.get("keypoints"), list):
            return _read_vitpose(path, content)
        if _is_clicked(content):
            return _read_clicked(path, content, image_size_wh)
    name = _format_of(content)
    first = 1 if name == "openpifpaf" or _said_from_one(content) else None
    names = _said_names(content)
    frames = _frames(path, content, num_frames)
    size = _said_size(content)
    if isinstance(frames, list):
        counted: dict[Key, list[Marked]] = dict(enumerate(frames))
        found, own = united(path, counted)
        return _people(name, list(found.values()), own or names)._replace(size_wh=size)
    found, own = united(path, frames)
    return _people(name, found, own or names)._replace(first=first, size_wh=size)


def read_folder(path: Path) -> People:
    """Read a folder of one file for every frame.

    Raises:
        KeypointError: If there is none, or one is none of the formats.
    """
    files = sorted(path.glob("*.json"), key=lambda entry: natural_order(entry.name))
    found: dict[Key, list[Marked]] = {}
    size, name = None, "OpenPose"
    for file in files:
        content = _load(file)
        name = _format_of(content) if file is files[0] else name
        size = size or _said_size(content)
        key = plain_name(file.name)
        if key in found:
            raise KeypointError(f"{file}: a second file of the frame {key}; expected one for each")
        found[key] = _people_of(str(file), content)
    frames, names = united(path, found)
    people = _people(f"{name}, {len(files)} files", frames, names)
    # A labelled picture has a file; of a video every frame has one.
    return people._replace(whole=name != "labelme", size_wh=size)


def _people(
    name: str, frames: dict[Key, list[Person]] | list[list[Person]], names: tuple[str, ...] | None
) -> People:
    """People of a format; 33 joints are MediaPipe's, whatever they are called or how ordered."""
    report = [f"format: {name}"]
    each = list(frames.values()) if isinstance(frames, dict) else frames
    if not all(is_there(person.joints) for people in each for person in people):
        # Who is not in a frame keeps his place there (Pose2Sim's): the place says who it is.
        for people in each:
            people[:] = [p._replace(track=p.track or f"{n}") for n, p in enumerate(people)]
    count = next((len(person.joints) for people in each for person in people), 0)
    lower = [re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") for name in names or ()]
    order: list[int] | None = None
    if lower and all(map(str.isdigit, lower)):
        order = sorted(range(count), key=lambda index: int(lower[index]))
    elif set(lower) == set(NAMES):
        order = [lower.index(own) for own in NAMES]
    if order is not None:
        names = None
        each = [[p._replace(joints=p.joints[order]) for p in people] for people in each]
        frames = dict(zip(frames, each, strict=True)) if isinstance(frames, dict) else each
    if names is None and count == len(NAMES):
        return People(frames, None, ["format: MediaPipe landmarks"], LAYOUT, corner_fractions=True)
    return People(frames, names, report)


def _load(path: Path) -> Any:
    """The content of a JSON file, or of one object in every line."""
    try:
        return load_json(path, KeypointError)
    except KeypointError as error:
        if "Extra data" not in str(error):
            raise
    try:
        lines = read_text(path, KeypointError).splitlines()
        return [json.loads(line) for line in lines if line.strip()]
    except (ValueError, RecursionError) as error:
        raise KeypointError(f"{path}: not a JSON file, nor one object in every line") from error


# What a file says of itself.


def _format_of(content: object) -> str:
    """The program that writes such files."""
    words: set[str] = set()
    layer = [content]
    for _ in range(5):
        below: list[object] = []
        for value in layer:
            if isinstance(value, dict):
                words |= value.keys()
                value = list(value.values())
            below += value[:3] if isinstance(value, list) else []
        layer = below
    return next((name for word, name in _FORMATS.items() if word in words), "JSON")


def _said_from_one(content: object) -> bool:
    return isinstance(content, dict) and "instance_info" in content


def _said_names(content: object) -> tuple[str, ...] | None:
    """The joints' names that MMPose writes in the head."""
    head = content.get("meta_info") if isinstance(content, dict) else None
    names = head.get("keypoint_id2name") if isinstance(head, dict) else None
    if not isinstance(names, dict) or not all(str(i) in names for i in range(len(names))):
        return None
    return tuple(str(names[str(i)]) for i in range(len(names)))


def _said_size(content: object) -> tuple[float, float] | None:
    """The size of the image that a file names."""
    if isinstance(content, list) and content:
        content = content[0]
    for keys in (
        ("canvas_width", "canvas_height"),
        ("imageWidth", "imageHeight"),
        ("image_width", "image_height"),
        ("width", "height"),
    ):
        if not isinstance(content, dict) or "x" in content:  # of a box
            return None
        width, height = (content.get(key) for key in keys)
        if isinstance(width, int) and isinstance(height, int) and min(width, height) > 0:
            return float(width), float(height)
    return None


# Frames.


def _frames(
    path: Path, content: Any, num_frames: int | None
) -> list[list[Marked]] | dict[Key, list[Marked]]:
    """The people of every frame, by what the file says of it, or in order."""
    if isinstance(content, dict):
        inner = next(
            (content[k] for k in _FRAMES if isinstance(content.get(k), (list, dict))), None
        )
        if inner is not None:
            return _frames(path, inner, num_frames)
        if content.keys() & {*_PEOPLE, *_JOINTS, "shapes"}:
            return [_people_of(str(path), content)]
        if content and all(isinstance(value, (dict, list)) for value in content.values()):
            found = {key: _people_of(f"{path}: {key}", value) for key, value in content.items()}
            if any(found.values()):
                return found
    if not isinstance(content, list):
        raise KeypointError(
            f"{path}: not a keypoint file; expected what a detector writes (docs/guide.md lists "
            f"the formats), found {shortened(content)}"
        )
    keys = [_key_of(f"{path}: detection {i}", entry) for i, entry in enumerate(content)]
    if all(key is None for key in keys):
        one = num_frames == 1 or _is_joints(content)
        if one or not content:
            return [_people_of(str(path), content)]
        return [_people_of(f"{path}: frame {index}", entry) for index, entry in enumerate(content)]
    found: dict[Key, list[Marked]] = {}
    for index, (key, entry) in enumerate(zip(keys, content, strict=True)):
        if key is None:
            raise KeypointError(
                f"{path}: entry {index}: expected a frame number, image_id, name or time, as the "
                f"others have, found {shortened(entry)}"
            )
        found.setdefault(key, []).extend(_people_of(f"{path}: {key!r}", entry, alone=True))
    return _in_seconds(content, found)


def _key_of(where: str, entry: object) -> Key | None:
    """Which frame an entry says that it is."""
    if not isinstance(entry, dict):
        return None
    if not isinstance(entry.get("image_id", 0), (int, str)):
        raise KeypointError(f"{where}: expected an image_id, found {shortened(entry['image_id'])}")
    for name in FRAME_NAMES:
        value = entry.get(name)
        if isinstance(value, int) and not isinstance(value, bool):
            return value
        if isinstance(value, str) and re.fullmatch("[0-9]{1,9}", value):
            return int(value)
    for name in _TIMES:
        value = entry.get(name)
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
    return next((entry[name] for name in _PICTURES if isinstance(entry.get(name), str)), None)


def _in_seconds(entries: Sequence[Any], found: dict[Key, list[Marked]]) -> dict[Key, list[Marked]]:
    """Times in seconds; where the word does not say the unit, no frame lasts a second."""
    if not all(isinstance(key, float) for key in found):
        return found
    word = next(name for name in _TIMES if name in entries[0])
    unit = _TIMES[word]
    if unit is None:
        gap = float(np.diff(np.sort(np.array(list(found), float))).min(initial=np.inf))
        unit = 1.0 if gap < 1 or not np.isfinite(gap) else 1e-3 if gap < 1000 else 1e-6
    return {unit * float(key): people for key, people in found.items()}


# People.


def _people_of(where: str, value: Any, *, alone: bool = False) -> list[Marked]:
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
            return _labelme(where, value["shapes"])
        for key in _PEOPLE:
            if key in value:
                if not isinstance(value[key], (list, dict, type(None))):
                    raise KeypointError(f"{where}: expected a list {key!r}")
                return _people_of(f"{where}: {key}", value[key])
        for key in _JOINTS:
            if key not in value:
                continue
            inner = value[key]
            if isinstance(inner, dict) and inner.keys() & {*_JOINTS}:
                return _people_of(where, inner)
            if isinstance(inner, list) and inner and not _is_joints(inner) and not _flat(inner):
                return _people_of(f"{where}: {key}", inner)
            person = _person(f"{where}: {key}", inner, value)
            return [] if person is None else [person]
        if _is_by_name(value):
            person = _person(where, value, {})
            return [] if person is None else [person]
        if alone or not all(isinstance(each, (list, dict)) for each in value.values()):
            raise KeypointError(f"{where}: expected keypoints, found {shortened(list(value))}")
        # By the people's own numbers.
        everyone = [
            (key, person)
            for key, each in value.items()
            for person in _people_of(f"{where}: {key}", each)
        ]
        return [person._replace(track=person.track or key) for key, person in everyone]
    if isinstance(value, list):
        if _is_joints(value) or _flat(value):
            person = _person(where, value, {})
            return [] if person is None else [person]
        return [
            person
            for index, each in enumerate(value)
            for person in _people_of(f"{where}[{index}]", each)
        ]
    raise KeypointError(f"{where}: expected people with keypoints, found {shortened(value)}")


def _flat(value: list[Any]) -> bool:
    return isinstance(value[0], (int, float, str))


def _is_joints(value: list[Any]) -> bool:
    """Whether a list is one person's joints: short rows of numbers, or objects with x and y."""
    first = next((each for each in value if each is not None), None)
    if isinstance(first, dict):
        return {"x", "y"} <= first.keys() or "position" in first
    return (
        isinstance(first, list) and 2 <= len(first) <= 4 and not isinstance(first[0], (list, dict))
    )


def _is_by_name(value: Mapping[str, Any]) -> bool:
    return all(_is_joints([each]) for each in value.values())


def _person(where: str, value: Any, around: Mapping[str, Any]) -> Marked | None:
    """One person's joints; None for somebody who is not there."""
    names: list[Any] | None = None
    if isinstance(value, dict):
        if isinstance(value.get("x"), list):  # a list of x, of y, of confidences
            columns = [value["x"], value.get("y")]
            columns += [value[key] for key in CONFIDENCE_NAMES if key in value][:1]
            value = [list(row) for row in zip(*map(_listed, columns), strict=False)]
        else:
            names, value = list(value), list(value.values())
    if value is None or value == []:
        return None
    if not isinstance(value, list):
        raise KeypointError(f"{where}: expected numbers, found {shortened(value)}")
    scores = next((around[key] for key in _SCORES if key in around), None)
    while isinstance(scores, list) and scores and isinstance(scores[0], list):
        scores = [each[0] if isinstance(each, list) and each else each for each in scores]
    if _flat(value) or value[0] is None:
        joints = _in_a_row(where, numbers(value, where), scores)
    else:
        rows = [_row(f"{where}: joint {index}", row) for index, row in enumerate(value)]
        joints = screened(np.array(rows)[:, :2], np.array(rows)[:, 2])
        if names is None and isinstance(value[0], dict):
            said = [row.get("name", row.get("part")) for row in value]
            names = said if all(isinstance(name, str) for name in said) else None
        joints = _with_scores(where, joints, scores)
    return Marked(joints, None if names is None else tuple(map(str, names)), track_of(around))


def _listed(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def _in_a_row(where: str, values: np.ndarray, scores: object) -> np.ndarray:
    """Joints from a row of triples, or of pairs with their confidences beside it."""
    pairs = isinstance(scores, list) and values.size == 2 * len(scores)
    if not values.size or values.size % (2 if pairs else 3):
        raise KeypointError(
            f"{where}: expected x, y, confidence for every joint in one list, found "
            f"{values.size} numbers"
        )
    if pairs:
        return _with_scores(where, screened(values.reshape(-1, 2)), scores)
    return values.reshape(-1, 3)


def _with_scores(where: str, joints: np.ndarray, scores: object) -> np.ndarray:
    if scores is None or np.isnan(joints).any():
        return joints
    confidence = numbers(scores, f"{where}: scores")
    if confidence.shape != joints.shape[:1]:
        raise KeypointError(
            f"{where}: {confidence.size} confidences for {len(joints)} joints; expected as many"
        )
    return screened(joints[:, :2], confidence)


def _row(where: str, row: Any) -> list[float]:
    """x, y and confidence, NaN where it is not said, of a list or an object."""
    if row is None:
        return [np.nan] * 3
    if isinstance(row, dict):
        place = row.get("position", row)
        if not isinstance(place, dict) or not {"x", "y"} <= place.keys():
            raise KeypointError(f"{where}: expected x, y and visibility, found {shortened(row)}")
        given = next((row[key] for key in CONFIDENCE_NAMES if row.get(key) is not None), None)
        row = [place["x"], place["y"], given]
    elif isinstance(row, list) and len(row) == 4:
        row = [row[0], row[1], row[3]]  # x, y, z, visibility
    values = numbers(row, where)
    if values.shape not in ((2,), (3,)):
        raise KeypointError(f"{where}: expected x, y[, confidence], found {shortened(row)}")
    return [*values.tolist(), np.nan][:3]


# Formats that are not of this kind.


def _read_coco(path: Path, content: Mapping[str, Any]) -> People:
    """Read annotations, as COCO, CVAT and their like have them."""
    entries = content["annotations"]
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise KeypointError(f"{path}: expected a list of detections, found {shortened(entries)}")
    report = ["format: COCO"]
    names, category = _coco_names(content, entries, report)
    found: dict[Key, list[Person]] = {}
    for index, entry in enumerate(entries):
        where = f"{path}: detection {index}"
        image = entry.get("image_id")
        if not isinstance(image, (int, str)) or isinstance(image, bool):
            raise KeypointError(f"{where}: expected an image_id, found {shortened(image)}")
        # COCO also annotates things that have no joints, and other skeletons.
        if "keypoints" in entry and category in (None, entry.get("category_id")):
            person = _person(where, entry["keypoints"], entry)
            about = entry.get("attributes")
            track = track_of({**entry, **(about if isinstance(about, dict) else {})}, ("track_id",))
            people = found.setdefault(image, [])
            people += [] if person is None else [Person(person.joints, track)]
    values = {value for people in found.values() for p in people for value in p.joints[:, 2]}
    if 2 in values and values <= {0, 1, 2}:
        # 0 not labelled, 1 labelled but hidden, 2 seen.
        for image, people in found.items():
            found[image] = [p._replace(joints=p.joints * (1.0, 1.0, 0.5)) for p in people]
        report.append("visibility 0, 1, 2 of the annotations taken as confidence 0, 0.5, 1")
    if "images" not in content:
        return People(found, names, report)
    frames, size = _by_images(path, content["images"], found)
    return People(frames, names, report, size_wh=size, whole=True)


def _coco_names(
    content: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], report: list[str]
) -> tuple[tuple[str, ...] | None, Any]:
    """Names of the joints; of several skeletons that are used the one with most joints of ours."""
    used = {str(entry.get("category_id")) for entry in entries if entry.get("keypoints")}
    listed = content.get("categories")
    skeletons: list[tuple[int, tuple[str, ...], Any]] = []
    for category in listed if isinstance(listed, list) else ():
        names = category.get("keypoints") if isinstance(category, dict) else None
        if isinstance(names, list) and names and all(isinstance(name, str) for name in names):
            known = sum(canonical_joint_name(name) is not None for name in names)
            skeletons.append((known, tuple(names), category.get("id")))
    several = [each for each in skeletons if str(each[2]) in used]
    if len(several) < 2:
        return (several or skeletons or [(0, None, None)])[0][1], None
    chosen = max(several, key=lambda each: each[0])
    report.append(f"{len(several)} skeletons: the one of category {chosen[2]} is read")
    return chosen[1], chosen[2]


def _by_images(
    path: Path, images: object, found: Mapping[Key, list[Person]]
) -> tuple[dict[Key, list[Person]], tuple[float, float] | None]:
    """People by the names of their pictures, and the size that all of these have."""
    if not isinstance(images, list) or not all(
        isinstance(image, dict) and isinstance(image.get("id"), (int, str)) for image in images
    ):
        raise KeypointError(f"{path}: expected 'images' to be a list with an id each")
    identifiers = {image["id"] for image in images}
    if unknown := [image for image in found if image not in identifiers]:
        raise KeypointError(f"{path}: detection of image {unknown[0]!r}, which is not in 'images'")
    ordered = sorted(images, key=lambda each: natural_order(str(each.get("file_name", each["id"]))))
    frames: dict[Key, list[Person]] = {
        str(image.get("file_name", image["id"])): found.get(image["id"], []) for image in ordered
    }
    sizes = {_said_size(image) for image in images}
    if len(sizes) > 1:
        raise KeypointError(f"{path}: pictures of several sizes; expected those of one video")
    return frames, next(iter(sizes), None)


def _read_vitpose(path: Path, content: Mapping[str, Any]) -> People:
    """Read easy_ViTPose's: per frame people by number, their joints y, x, score."""
    names = content["skeleton"]
    names = tuple(map(str, names.values() if isinstance(names, dict) else _listed(names)))
    frames: list[list[Person]] = []
    for index, entry in enumerate(content["keypoints"]):
        people = _people_of(f"{path}: frame {index}", entry)
        swapped = [Person(person.joints[:, [1, 0, 2]], person.track) for person in people]
        frames.append(swapped)
    return People(frames, names or None, ["format: easy_ViTPose (y before x)"])


def _labelme(where: str, shapes: object) -> list[Marked]:
    """People whose joints are labelled as points, by the number of their group."""
    people: dict[str, dict[str, list[float]]] = {}
    for index, shape in enumerate(_listed(shapes)):
        if not isinstance(shape, dict) or shape.get("shape_type") != "point":
            continue
        place = f"{where}: shape {index}"
        point = numbers(shape.get("points"), place)
        if point.shape != (1, 2):
            raise KeypointError(f"{place}: expected one point, found {shortened(point.tolist())}")
        group = people.setdefault(str(shape.get("group_id")), {})
        label = str(shape.get("label"))
        if label in group:
            raise KeypointError(f"{place}: {label!r} twice; give people a group_id of their own")
        group[label] = [*point[0].tolist(), 1.0]
    return [
        Marked(np.array(list(joints.values())), tuple(joints), None if key == "None" else key)
        for key, joints in people.items()
    ]


def _is_clicked(content: Mapping[str, Any]) -> bool:
    """Whether a file is of our own format: joints by name, of one frame or of some."""
    if "joints" in content:
        return True
    frames = content.get("frames")
    detected = {*_PEOPLE, *_JOINTS} - {"joints"}
    return isinstance(frames, dict) and not any(
        each.keys() & detected
        if isinstance(each, dict)
        else isinstance(each, list) and bool(each) and isinstance(each[0], (dict, list))
        for each in frames.values()
    )


def _read_clicked(path: Path, content: Mapping[str, Any], image_size_wh: tuple[int, int]) -> People:
    """Read joints by name, for one frame or for some."""
    size = content.get("image_size_wh")
    if size is not None and size != list(image_size_wh):
        raise KeypointError(
            f"{path}: clicked in images of {shortened(size)} pixels, "
            f"the video has {list(image_size_wh)}; click in this video"
        )
    frames = content.get("frames", {"0": content.get("joints")})
    if not isinstance(frames, dict) or not frames:
        raise KeypointError(f"{path}: expected 'frames' to name frames, found {shortened(frames)}")
    clicked: dict[Key, list[Marked]] = {}
    for key, joints in frames.items():
        if not re.fullmatch(r"[0-9]{1,6}", key):
            raise KeypointError(f"{path}: expected a frame number, found {shortened(key)}")
        named = _clicked_joints(f"{path}: frame {key}", joints)
        rows = np.array(list(named.values())).reshape(-1, 3)
        clicked[int(key)] = [Marked(rows, tuple(named))] if named else []
    found, names = united(path, clicked)
    return People(found, names, ["format: clicked joints"], first=0)


def _clicked_joints(where: str, joints: object) -> dict[str, list[float]]:
    """u, v and confidence of the joints of a frame, by name."""
    if isinstance(joints, dict) and isinstance(joints.get("joints"), dict):
        joints = joints["joints"]
    if not isinstance(joints, dict):
        raise KeypointError(f"{where}: expected joints by name, found {shortened(joints)}")
    found = {}
    for name, place in joints.items():
        values = real_numbers(place, f"{where}: {name}", KeypointError)
        if values.shape not in ((2,), (3,)):
            raise KeypointError(
                f"{where}: {name}: expected [u, v] or [u, v, confidence], found {shortened(place)}"
            )
        if canonical_joint_name(name) is None:
            raise KeypointError(
                f"{where}: unknown joint {name!r}; the known ones are {', '.join(JOINT_NAMES)}"
            )
        found[name] = [*values.tolist(), 1.0][:3]
    return found
