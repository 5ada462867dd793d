"""2D joints in COCO's annotations, of COCO itself, CVAT and their like.

`annotations` of images, `images` with names and sizes, `categories` with the joints' names.
Call `read_coco`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchcss.errors import KeypointError
from torchcss.files import unexpected
from torchcss.io.keypoints.json_people import listed, one_person, said_size
from torchcss.io.keypoints.people import (
    Frames,
    Key,
    Names,
    People,
    Person,
    one_size,
    track_of,
)
from torchcss.io.keypoints.words import FRAMES, TRACKS, first_of
from torchcss.io.pictures import natural_order
from torchcss.joint_names import canonical_joint_name

_TRACKS = tuple(word for word in TRACKS if word != "id")
"""Words for a track; `id` numbers the detections."""


def read_coco(content: Mapping[str, Any]) -> People:
    """Read annotations, as COCO, CVAT and their like have them."""
    entries = content["annotations"]
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise unexpected(KeypointError, "", "a list of detections", entries)
    report = ["format: COCO"]
    names, category = _coco_names(content, entries, report)
    found: Frames = {}
    for index, entry in enumerate(entries):
        where = f"detection {index}"
        image = _identifier(entry.get("image_id"))
        if image is None:
            raise unexpected(KeypointError, where, "an image_id", entry.get("image_id"))
        # COCO also annotates things that have no joints, and other skeletons.
        if "keypoints" in entry and category in (None, entry.get("category_id")):
            about = entry.get("attributes")
            track = track_of({**entry, **(about if isinstance(about, dict) else {})}, _TRACKS)
            joints = _in_threes(entry["keypoints"], names)
            people = one_person(where, joints, entry)
            found.setdefault(image, []).extend(person._replace(track=track) for person in people)
    if "images" not in content:
        return People(found, names, report)
    frames, size = _by_images(content["images"], found)
    return People(frames, names, report, size_wh=size, whole=True)


def _in_threes(joints: Any, names: Names | None) -> Any:
    """A row of three numbers for each of the names by joints: 36 numbers may be 18 pairs else."""
    if names is None or not isinstance(joints, list) or len(joints) != 3 * len(names):
        return joints
    rows = [joints[place : place + 3] for place in range(0, len(joints), 3)]
    return joints if isinstance(joints[0], (list, dict)) else rows


def _identifier(value: object) -> int | str | None:
    """A picture's number, maybe with a decimal point (pandas), or name; None: it is none."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value if isinstance(value, (int, str)) and not isinstance(value, bool) else None


def _coco_names(
    content: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], report: list[str]
) -> tuple[Names | None, Any]:
    """Names of the joints; of several skeletons that are used the one with most joints of ours."""
    used = {str(entry.get("category_id")) for entry in entries if entry.get("keypoints")}
    skeletons: list[tuple[int, Names, Any]] = []
    for category in listed(content.get("categories")):
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
    images: object, found: Mapping[Key, list[Person]]
) -> tuple[Frames, tuple[float, float] | None]:
    """People by the names of their pictures, and the size that all of these have."""
    names: dict[Key, str] = {}
    numbers: dict[Key, int] = {}
    for image in listed(images):
        if isinstance(image, dict) and (own := _identifier(image.get("id"))) is not None:
            names[own] = str(image.get("file_name", own))
            if type(number := first_of(image, FRAMES)) is int:
                numbers[own] = number
    if not isinstance(images, list) or len(set(names.values())) < len(images):
        raise KeypointError(
            "expected 'images' to be a list with an id and file_name of their own each"
        )
    if unknown := [image for image in found if image not in names]:
        raise KeypointError(f"detection of image {unknown[0]!r}, which is not in 'images'")
    ordered = sorted(names, key=lambda image: natural_order(names[image]))
    if len({*numbers.values()}) == len(names):
        ordered.sort(key=numbers.__getitem__)
    frames: Frames = {names[image]: found.get(image, []) for image in ordered}
    return frames, one_size({said_size(image) for image in images})
