"""2D joints in JSON: OpenPose's folders, COCO's annotations and detections, clicked joints.

*OpenPose.* One file for every frame, `people` with flat triples.

*COCO.* `annotations`, or a list of detections as AlphaPose and many others write them.

*Clicked.* Joints by name, in one frame or some: our own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from torchcss.errors import KeypointError
from torchcss.files import load_json, real_numbers, shortened
from torchcss.io.keypoints.people import People, check_counts, stack, triples
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
    check_counts(path, frames)
    return People(frames, None, [f"format: OpenPose, {len(files)} files"])


def openpose_people(path: Path, content: object) -> Float[np.ndarray, "p j 3"]:
    """All people of one file's content."""
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list):
        raise KeypointError(f"{path}: not an OpenPose file; expected a list 'people'")
    return stack(
        path,
        [
            triples(
                person.get("pose_keypoints_2d") if isinstance(person, dict) else None,
                f"{path}: people[{index}].pose_keypoints_2d",
            )
            for index, person in enumerate(people)
        ],
    )


def read_coco(
    path: Path, entries: object, content: Mapping[str, Any], num_frames: int | None
) -> People:
    """Read annotations or a list of detections; `content` is the object around the former."""
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise KeypointError(f"{path}: expected a list of detections, found {shortened(entries)}")
    detections: dict[object, list[np.ndarray]] = {}
    for index, entry in enumerate(entries):
        where = f"{path}: detection {index}"
        image = entry.get("image_id")
        if not isinstance(image, (int, str)) or isinstance(image, bool):
            raise KeypointError(f"{where}: expected an image_id, found {shortened(image)}")
        if "keypoints" not in entry and content:
            continue  # COCO's annotations of things that have no joints
        if "keypoints" not in entry:
            raise KeypointError(f"{where}: expected keypoints, found {shortened(list(entry))}")
        detections.setdefault(image, []).append(triples(entry["keypoints"], where))
    order, note = _coco_order(path, content.get("images"), list(detections), num_frames)
    frames = [stack(path, detections.get(image, [])) for image in order]
    check_counts(path, frames)
    report = ["format: COCO, " + note]
    confidence = np.concatenate([np.zeros(0), *(frame[..., 2].ravel() for frame in frames)])
    if np.isin(confidence, (0, 1, 2)).all() and (confidence == 2).any():
        # Annotations: 0 not labelled, 1 labelled but hidden, 2 seen.
        frames = [frame * (1.0, 1.0, 0.5) for frame in frames]
        report.append("visibility 0, 1, 2 of the annotations taken as confidence 0, 0.5, 1")
    return People(frames, _coco_names(content), report)


def _coco_order(
    path: Path, images: object, found: Sequence[object], num_frames: int | None
) -> tuple[list[object], str]:
    """Return the image of every frame, and how that was decided."""
    if images is not None:
        if not isinstance(images, list) or not all(
            isinstance(image, dict) and isinstance(image.get("id"), (int, str)) for image in images
        ):
            raise KeypointError(f"{path}: expected 'images' to be a list with an id each")
        ordered = sorted(
            images, key=lambda image: natural_order(str(image.get("file_name", image["id"])))
        )
        identifiers = [image["id"] for image in ordered]
        unknown = next((image for image in found if image not in identifiers), None)
        if unknown is not None:
            raise KeypointError(f"{path}: detection of image {unknown!r}, which is not in 'images'")
        return identifiers, "frames in the order of the images' names"
    # Without the list of images, frames in which nobody was seen are absent: the number counts.
    places: dict[int, object] = {}
    for image in found:
        text = Path(image).stem if isinstance(image, str) else str(image)
        digits = re.findall(r"[0-9]+", text)
        place = int(digits[-1]) if digits and len(digits[-1]) < 10 and text[0] != "-" else -1
        if place < 0 or place in places:
            raise KeypointError(
                f"{path}: image_id {shortened(image)} is not a frame number of its own; "
                "number the images or add COCO's list 'images'"
            )
        places[place] = image
    last = max(places, default=-1)
    origin = 1 if num_frames is not None and last == num_frames else 0
    total = last + 1 if num_frames is None else num_frames
    if last - origin >= total or (origin and 0 in places):
        raise KeypointError(
            f"{path}: expected images 0 to {total - 1}, as the video has, found image {last}"
        )
    if total > 1_000_000:
        raise KeypointError(f"{path}: image {last} is not a frame number; number the frames from 0")
    order: list[object] = [places.get(index + origin) for index in range(total)]
    return order, f"image {origin} is the first frame"


def _coco_names(content: Mapping[str, Any]) -> tuple[str, ...] | None:
    """The joint names of the file's category, where it lists them."""
    categories = content.get("categories")
    for category in categories if isinstance(categories, list) else ():
        names = category.get("keypoints") if isinstance(category, dict) else None
        if isinstance(names, list) and all(isinstance(name, str) for name in names) and names:
            return tuple(names)
    return None


def read_clicked(
    path: Path, content: Mapping[str, Any], num_frames: int | None, image_size_wh: tuple[int, int]
) -> People:
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
    clicked: dict[int, Mapping[str, Any]] = {}
    for key, joints in frames.items():
        if not re.fullmatch(r"[0-9]{1,6}", key):
            raise KeypointError(f"{path}: expected a frame number, found {shortened(key)}")
        if isinstance(joints, dict) and isinstance(joints.get("joints"), dict):
            joints = joints["joints"]
        if not isinstance(joints, dict):
            raise KeypointError(
                f"{path}: frame {key}: expected joints by name, found {shortened(joints)}"
            )
        clicked[int(key)] = joints
    total = max(clicked) + 1 if num_frames is None else num_frames
    if max(clicked) >= total:
        raise KeypointError(
            f"{path}: frame {max(clicked)} is beyond the video, which has {total} frames"
        )
    names = tuple(dict.fromkeys(name for joints in clicked.values() for name in joints))
    triples = np.zeros((total, len(names), 3))
    for frame, joints in clicked.items():
        for name, place in joints.items():
            where = f"{path}: frame {frame}: {name}"
            numbers = real_numbers(place, where, KeypointError)
            if numbers.shape not in ((2,), (3,)):
                raise KeypointError(
                    f"{where}: expected [u, v] or [u, v, confidence], found {shortened(place)}"
                )
            triples[frame, names.index(name)] = [*numbers, 1.0][:3]
    unknown = [name for name in names if canonical_joint_name(name) is None]
    if unknown:
        raise KeypointError(
            f"{path}: unknown joint {unknown[0]!r}; the known ones are {', '.join(JOINT_NAMES)}"
        )
    return People([frame[None] for frame in triples], names, ["format: clicked joints"])
