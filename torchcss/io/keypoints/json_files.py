"""2D joints in JSON: OpenPose's folders, COCO's annotations and detections, clicked joints.

*OpenPose.* One file for every frame, `people` with flat triples.

*COCO.* `annotations`, or a list of detections as AlphaPose and many others write them.

*Clicked.* Joints by name, in one frame or some: our own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import load_json, real_numbers, shortened
from torchcss.io.keypoints.people import People, Person, triples
from torchcss.io.video import natural_order
from torchcss.joint_names import JOINT_NAMES, canonical_joint_name


def read_openpose_folder(path: Path) -> People:
    """Read one file for every frame."""
    try:
        files = sorted(path.glob("*.json"), key=lambda entry: natural_order(entry.name))
    except OSError as error:
        raise KeypointError(f"{path}: cannot be read: {error.strerror}") from error
    if not files:
        raise KeypointError(
            f"{path}: no JSON files in this folder; expected OpenPose's, one for every frame"
        )
    numbers = [re.findall(r"[0-9]+", file.stem) for file in files]
    if all(numbers):
        places = [int(found[-1]) for found in numbers]
        for file, before, after in zip(files[1:], places[:-1], places[1:], strict=True):
            if after != before + 1:
                raise KeypointError(
                    f"{path}: expected one file for every frame, but {file.name} follows number "
                    f"{before}; write empty files for frames without people"
                )
    frames = [openpose_people(file, load_json(file, KeypointError)) for file in files]
    return People(frames, None, [f"format: OpenPose, {len(files)} files"])


def openpose_people(path: Path, content: object) -> list[Person]:
    """All people of one file's content."""
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list):
        raise KeypointError(f"{path}: not an OpenPose file; expected a list 'people'")
    return [
        triples(
            person.get("pose_keypoints_2d") if isinstance(person, dict) else None,
            f"{path}: people[{index}].pose_keypoints_2d",
        )
        for index, person in enumerate(people)
    ]


def read_coco(path: Path, entries: object, content: Mapping[str, Any]) -> People:
    """Read annotations or a list of detections; `content` is the object around the former."""
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise KeypointError(f"{path}: expected a list of detections, found {shortened(entries)}")
    found: dict[object, list[Person]] = {}
    for index, entry in enumerate(entries):
        where = f"{path}: detection {index}"
        image = entry.get("image_id")
        if not isinstance(image, (int, str)) or isinstance(image, bool):
            raise KeypointError(f"{where}: expected an image_id, found {shortened(image)}")
        if "keypoints" in entry:
            found.setdefault(image, []).append(triples(entry["keypoints"], where))
        elif not content:  # COCO also annotates things that have no joints
            raise KeypointError(f"{where}: expected keypoints, found {shortened(list(entry))}")
    report = ["format: COCO"]
    confidence = [person[:, 2] for people in found.values() for person in people]
    values = np.unique(np.concatenate([*confidence, []]))
    if 2 in values and np.isin(values, (0, 1, 2)).all():
        # Annotations: 0 not labelled, 1 labelled but hidden, 2 seen.
        found = {
            image: [person * (1.0, 1.0, 0.5) for person in people]
            for image, people in found.items()
        }
        report.append("visibility 0, 1, 2 of the annotations taken as confidence 0, 0.5, 1")
    frames: list[list[Person]] | dict[int, list[Person]]
    if "images" in content:
        frames = _in_order_of_images(path, content["images"], found)
        report.append("frames in the order of the images' names")
    else:
        frames = {_frame_of_image(path, image): people for image, people in found.items()}
        if len(frames) < len(found):
            raise KeypointError(
                f"{path}: two image_id of one frame number; number the images or add COCO's list "
                "'images'"
            )
    return People(frames, _coco_names(content), report)


def _in_order_of_images(
    path: Path, images: object, found: Mapping[object, list[Person]]
) -> list[list[Person]]:
    if not isinstance(images, list) or not all(
        isinstance(image, dict) and isinstance(image.get("id"), (int, str)) for image in images
    ):
        raise KeypointError(f"{path}: expected 'images' to be a list with an id each")
    ordered = sorted(images, key=lambda each: natural_order(str(each.get("file_name", each["id"]))))
    identifiers = [image["id"] for image in ordered]
    if unknown := [image for image in found if image not in identifiers]:
        raise KeypointError(f"{path}: detection of image {unknown[0]!r}, which is not in 'images'")
    return [found.get(image, []) for image in identifiers]


def _frame_of_image(path: Path, image: object) -> int:
    """The number of the frame that an image is, where no list of images tells."""
    text = str(image)
    digits = re.findall(r"[0-9]+", Path(text).stem)
    if not digits or len(digits[-1]) > 9 or text.startswith("-"):
        raise KeypointError(
            f"{path}: image_id {shortened(image)} is not a frame number of its own; "
            "number the images or add COCO's list 'images'"
        )
    return int(digits[-1])


def _coco_names(content: Mapping[str, Any]) -> tuple[str, ...] | None:
    """The joint names of the file's category, where it lists them."""
    categories = content.get("categories")
    for category in categories if isinstance(categories, list) else ():
        names = category.get("keypoints") if isinstance(category, dict) else None
        if isinstance(names, list) and all(isinstance(name, str) for name in names) and names:
            return tuple(names)
    return None


def read_clicked(path: Path, content: Mapping[str, Any], image_size_wh: tuple[int, int]) -> People:
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
    clicked: dict[int, dict[str, list[float]]] = {}
    for key, joints in frames.items():
        if not re.fullmatch(r"[0-9]{1,6}", key):
            raise KeypointError(f"{path}: expected a frame number, found {shortened(key)}")
        clicked[int(key)] = _clicked_joints(f"{path}: frame {key}", joints)
    names = tuple(dict.fromkeys(name for joints in clicked.values() for name in joints))
    found = {
        frame: [np.array([joints.get(name, [0.0] * 3) for name in names]).reshape(-1, 3)]
        for frame, joints in clicked.items()
    }
    return People(found, names, ["format: clicked joints"], from_zero=True)


def _clicked_joints(where: str, joints: object) -> dict[str, list[float]]:
    """u, v and confidence of the joints of a frame, by name."""
    if isinstance(joints, dict) and isinstance(joints.get("joints"), dict):
        joints = joints["joints"]
    if not isinstance(joints, dict):
        raise KeypointError(f"{where}: expected joints by name, found {shortened(joints)}")
    found = {}
    for name, place in joints.items():
        numbers = real_numbers(place, f"{where}: {name}", KeypointError)
        if numbers.shape not in ((2,), (3,)):
            raise KeypointError(
                f"{where}: {name}: expected [u, v] or [u, v, confidence], found {shortened(place)}"
            )
        if canonical_joint_name(name) is None:
            raise KeypointError(
                f"{where}: unknown joint {name!r}; the known ones are {', '.join(JOINT_NAMES)}"
            )
        found[name] = [*numbers.tolist(), 1.0][:3]
    return found
