"""2D joints of one person in every frame, from the files of the usual detectors or a few clicks.

| format | recognised by |
|---|---|
| OpenPose | a folder of `*_keypoints.json` (or other JSON with `people`), one file per frame |
| COCO, AlphaPose | JSON: `annotations`, or a list of `{image_id, keypoints, score}` |
| NPZ | arrays `keypoints [T J 2]`, `confidence [T J]`, `joint_names [J]` |
| clicked | JSON: `{"joints": {"l_wrist": [u, v]}}` for one frame, or `{"frames": {"0": {...}}}` |

Files that name their joints are read by name; the others by layout, which their number of joints
tells (25 is BODY_25 or BODY_25B: the places of the points decide). Out come the catalogue's names
(`torchcss.joint_names`); a joint that has none keeps its own. A missing joint has confidence 0 and
stands at (0, 0). Of several people, one is followed by continuity. Every such choice is a line of
`Keypoints.report`, to be shown to the user.

By default: `read_keypoints(path, image_size_wh=(w, h), num_frames=t)`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.errors import KeypointError
from torchcss.io.safe_load import load_arrays, load_json, real_numbers, shortened
from torchcss.io.video import natural_order
from torchcss.joint_names import ALIASES, JOINT_NAMES, canonical_joint_name, layout_of_names

Scale = Literal["pixels", "zero-one", "plus-minus-one"]
"""What the coordinates of a file count: pixels, or fractions of the image from 0 or -1 to 1."""

# Which layout a number of unnamed joints means; the first is the default.
_LAYOUTS_BY_COUNT: dict[int, tuple[str, ...]] = {}
for _name in ("COCO-17", "COCO-18", "BODY_25", "BODY_25B", "MediaPipe-33", "SMPL-24", "H36M-17"):
    _LAYOUTS_BY_COUNT.setdefault(len(ALIASES[_name]), ())
    _LAYOUTS_BY_COUNT[len(ALIASES[_name])] += (_name,)

_NORMALISED_EXTENT = 2.0
"""No person is so few pixels large: coordinates that all lie within are fractions of the image."""

_OUTSIDE = 3.0
"""How many times the longer image side a joint may lie outside before the file is refused."""

_INSIDE_SHARE = 0.1
"""Least share of the confident joints that must lie inside the image."""

_JUMP = 0.5
"""How far (in sizes of the person) a person may move from one frame to the next and be the same."""


class Keypoints(NamedTuple):
    """The joints of one person in an image sequence.

    Attributes:
        keypoints: Pixels (centres at integers); (0, 0) where the confidence is 0.
        confidence: From 0, missing, to 1.
        joint_names: The catalogue's names, the file's own for a place that has none.
        report: What was recognised, chosen or corrected, one line each.
    """

    keypoints: Float[Tensor, "t j 2"]
    confidence: Float[Tensor, "t j"]
    joint_names: tuple[str, ...]
    report: tuple[str, ...]


class _People(NamedTuple):
    """All detections of a file: per frame `[people, joints, 3]` with u, v, confidence."""

    frames: list[np.ndarray]
    names: tuple[str, ...] | None
    """The file's own joint names, or None where it has only an order."""
    report: list[str]


def read_keypoints(
    path: str | os.PathLike[str],
    *,
    image_size_wh: tuple[int, int],
    num_frames: int | None = None,
    layout: str | None = None,
    normalised: bool | Scale = False,
    first_frame: int = 0,
) -> Keypoints:
    """Read the 2D joints of one person from any of the formats above.

    Args:
        path: A file, or OpenPose's folder.
        image_size_wh: Size of the video's images in pixels.
        num_frames: Number of frames of the video, which the file must match (a clicked file need
            not). None: as many as the file has.
        layout: A key of `torchcss.joint_names.ALIASES`, for files that do not name their joints.
            None: recognise it.
        normalised: True, `"zero-one"` or `"plus-minus-one"` for coordinates that are fractions of
            the image, which are then converted: the range ends at the centres of the border pixels.
        first_frame: The frame in which tracking starts; there somebody must be seen.

    Returns:
        Joints of the person chosen, float64.

    Raises:
        KeypointError: If the file is missing, damaged, of unknown format or layout, has another
            number of frames, nobody in the first frame, coordinates that cannot be pixels, or a
            confident joint that is not a number.
    """
    path = Path(path)
    if layout is not None and layout not in ALIASES:
        raise KeypointError(
            f"{path}: unknown layout {layout!r}; the known ones are {', '.join(ALIASES)}"
        )
    people = _read(path, num_frames, image_size_wh)
    if num_frames is not None and len(people.frames) != num_frames:
        raise KeypointError(
            f"{path}: expected {num_frames} frames, as the video has, found {len(people.frames)}; "
            "make the keypoints from this very video"
        )
    if not 0 <= first_frame < max(1, len(people.frames)):
        raise KeypointError(
            f"{path}: the first frame {first_frame} is beyond the file, "
            f"which has {len(people.frames)} frames"
        )
    report = list(people.report)
    _check_names(path, people)
    _check_numbers(path, people, report)
    _check_somebody(path, people, first_frame)
    _to_pixels(path, people, image_size_wh, normalised, report)
    _check_places(path, people, image_size_wh)
    chosen = _follow(people, first_frame, report)
    names = _joint_names(path, people, chosen, layout, report)
    keypoints = np.where(chosen[..., 2:] > 0.0, chosen[..., :2], 0.0)
    return Keypoints(
        torch.from_numpy(keypoints), torch.from_numpy(chosen[..., 2].copy()), names, tuple(report)
    )


# The formats.


def _read(path: Path, num_frames: int | None, image_size_wh: tuple[int, int]) -> _People:
    if path.is_dir():
        return _read_openpose_folder(path)
    if path.suffix.lower() == ".npz":
        return _read_arrays(path)
    content = load_json(path, KeypointError)
    if isinstance(content, list):
        return _read_coco(path, content, {}, num_frames)
    if isinstance(content, dict):
        if "annotations" in content:
            return _read_coco(path, content["annotations"], content, num_frames)
        if "people" in content:
            people = _openpose_people(path, content)
            return _People([people], None, ["format: OpenPose, one frame"])
        if "joints" in content or "frames" in content:
            return _read_clicked(path, content, num_frames, image_size_wh)
    raise KeypointError(
        f"{path}: not a keypoint file; expected OpenPose's 'people', COCO's 'annotations' or list "
        f"of detections, or clicked 'joints' or 'frames', found {shortened(content)}"
    )


def _read_openpose_folder(path: Path) -> _People:
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
    frames = [_openpose_people(file, load_json(file, KeypointError)) for file in files]
    _check_counts(path, frames)
    return _People(frames, None, [f"format: OpenPose, {len(files)} files"])


def _openpose_people(path: Path, content: object) -> np.ndarray:
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, list):
        raise KeypointError(f"{path}: not an OpenPose file; expected a list 'people'")
    return _stack(
        path,
        [
            _triples(
                person.get("pose_keypoints_2d") if isinstance(person, dict) else None,
                f"{path}: people[{index}].pose_keypoints_2d",
            )
            for index, person in enumerate(people)
        ],
    )


def _read_coco(
    path: Path, entries: object, content: Mapping[str, Any], num_frames: int | None
) -> _People:
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
        detections.setdefault(image, []).append(_triples(entry["keypoints"], where))
    order, note = _coco_order(path, content.get("images"), list(detections), num_frames)
    frames = [_stack(path, detections.get(image, [])) for image in order]
    _check_counts(path, frames)
    report = ["format: COCO, " + note]
    confidence = np.concatenate([np.zeros(0), *(frame[..., 2].ravel() for frame in frames)])
    if np.isin(confidence, (0, 1, 2)).all() and (confidence == 2).any():
        # Annotations: 0 not labelled, 1 labelled but hidden, 2 seen.
        frames = [frame * (1.0, 1.0, 0.5) for frame in frames]
        report.append("visibility 0, 1, 2 of the annotations taken as confidence 0, 0.5, 1")
    return _People(frames, _coco_names(content), report)


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


def _read_arrays(path: Path) -> _People:
    arrays = load_arrays(path, KeypointError)
    if "keypoints" not in arrays:
        raise KeypointError(
            f"{path}: expected the arrays keypoints, confidence and joint_names, "
            f"found {', '.join(arrays) or 'none'}"
        )
    keypoints = arrays["keypoints"]
    if keypoints.ndim != 3 or keypoints.shape[2] != 2 or keypoints.dtype.kind not in "iuf":
        raise KeypointError(
            f"{path}: keypoints: expected numbers [frames, joints, 2], "
            f"got {keypoints.dtype} {list(keypoints.shape)}"
        )
    shape = keypoints.shape[:2]
    if 0 in shape:
        raise KeypointError(f"{path}: keypoints: expected frames and joints, got {list(shape)}")
    finite = np.isfinite(keypoints[..., 0]) & np.isfinite(keypoints[..., 1])
    confidence = arrays.get("confidence", finite.astype(np.float64))
    if confidence.shape != shape or confidence.dtype.kind not in "biuf":
        raise KeypointError(
            f"{path}: confidence: expected numbers {list(shape)}, "
            f"got {confidence.dtype} {list(confidence.shape)}"
        )
    names = arrays.get("joint_names")
    if names is not None and (names.shape != shape[1:] or names.dtype.kind != "U"):
        raise KeypointError(
            f"{path}: joint_names: expected {shape[1]} names, got {names.dtype} {list(names.shape)}"
        )
    triples = np.dstack([keypoints, confidence]).astype(np.float64)
    report = ["format: NPZ"]
    if "confidence" not in arrays:
        report.append("no confidence in the file: 1 for every joint that is a number")
    return _People(
        [frame[None] for frame in triples],
        None if names is None else tuple(str(name) for name in names),
        report,
    )


def _read_clicked(
    path: Path, content: Mapping[str, Any], num_frames: int | None, image_size_wh: tuple[int, int]
) -> _People:
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
    return _People([frame[None] for frame in triples], names, ["format: clicked joints"])


def _triples(value: object, where: str) -> np.ndarray:
    """Return `[joints, 3]` from x, y, confidence in a row."""
    numbers = real_numbers(value, where, KeypointError)
    if numbers.ndim != 1 or not numbers.size or numbers.size % 3:
        raise KeypointError(
            f"{where}: expected x, y, confidence for every joint in one list, "
            f"found {numbers.size} numbers"
        )
    return numbers.reshape(-1, 3)


def _stack(path: Path, people: list[np.ndarray]) -> np.ndarray:
    if len({person.shape for person in people}) > 1:
        raise KeypointError(
            f"{path}: people with {' and '.join(sorted({str(len(person)) for person in people}))} "
            "joints; expected one layout in the whole file"
        )
    return np.stack(people) if people else np.zeros((0, 0, 3))


def _check_counts(path: Path, frames: list[np.ndarray]) -> None:
    """Refuse a change of layout between frames; give empty frames the layout of the others."""
    counts = sorted({frame.shape[1] for frame in frames if len(frame)})
    if len(counts) > 1:
        raise KeypointError(
            f"{path}: people with {' and '.join(map(str, counts))} joints; "
            "expected one layout in the whole file"
        )
    for index, frame in enumerate(frames):
        if not len(frame):
            frames[index] = np.zeros((0, counts[0] if counts else 0, 3))


# What is checked and decided.


def _check_names(path: Path, people: _People) -> None:
    num_joints = max((frame.shape[1] for frame in people.frames), default=0)
    if people.names is None or not num_joints:  # nobody in the whole file: another check says so
        return
    if len(people.names) != num_joints:
        raise KeypointError(
            f"{path}: {len(people.names)} joint names for {num_joints} joints; expected as many"
        )
    if len(set(people.names)) < num_joints:
        raise KeypointError(f"{path}: the same joint name twice in {shortened(people.names)}")


def _check_numbers(path: Path, people: _People, report: list[str]) -> None:
    """Refuse numbers that are not finite where they count; bring confidences into their range."""
    clipped = 0
    for index, frame in enumerate(people.frames):
        confidence = frame[..., 2]
        finite = np.isfinite(frame[..., 0]) & np.isfinite(frame[..., 1])
        bad = np.isnan(confidence) | (~finite & (confidence != 0.0))
        if bad.any():
            joint = int(np.argwhere(bad)[0, -1])
            name = repr(people.names[joint]) if people.names else str(joint)
            found = float(np.extract(bad, confidence)[0])
            raise KeypointError(
                f"{path}: frame {index}: joint {name} is not a number though its confidence is "
                f"{found:g}; expected confidence 0 where a joint is missing"
            )
        if (confidence > 10.0).any():
            raise KeypointError(
                f"{path}: frame {index}: confidence {confidence.max():g}; expected 0 to 1"
            )
        clipped += int(((confidence < 0.0) | (confidence > 1.0)).sum())
        people.frames[index] = np.concatenate(
            [
                np.where(finite[..., None], frame[..., :2], 0.0),
                confidence.clip(0.0, 1.0)[..., None],
            ],
            axis=-1,
        )
    if clipped:
        report.append(f"{clipped} confidences outside 0 to 1 were moved to the nearer end")


def _check_somebody(path: Path, people: _People, first_frame: int) -> None:
    seen = [index for index, frame in enumerate(people.frames) if (frame[..., 2] > 0.0).any()]
    if first_frame in seen:
        return
    later = next((index for index in seen if index > first_frame), None)
    advice = (
        f"the first frame with somebody is {later}: start there"
        if later is not None
        else "there is none later either"
    )
    raise KeypointError(
        f"{path}: nobody in the first frame ({first_frame}), where tracking starts; {advice}"
    )


def _confident(people: _People) -> np.ndarray:
    """All confident points `[n, 2]` of all people."""
    return np.concatenate([frame[frame[..., 2] > 0.0][:, :2] for frame in people.frames])


def _to_pixels(
    path: Path,
    people: _People,
    image_size_wh: tuple[int, int],
    normalised: bool | Scale,
    report: list[str],
) -> None:
    points = _confident(people)
    fractions = bool((np.abs(points) <= _NORMALISED_EXTENT).all())
    if normalised is False or normalised == "pixels":
        if fractions:
            raise KeypointError(
                f"{path}: expected pixels, but all coordinates lie between {points.min():.3g} and "
                f"{points.max():.3g}: they seem to be fractions of the image; if so, set normalised"
            )
        return
    if not fractions:
        raise KeypointError(
            f"{path}: expected fractions of the image, but coordinates reach "
            f"{np.abs(points).max():.4g}: they seem to be pixels; if so, leave normalised out"
        )
    if normalised is True and (points < 0.0).any():
        raise KeypointError(
            f"{path}: some coordinates are negative: say whether they run from 0 to 1 with joints "
            "outside the image (normalised 'zero-one') or from -1 to 1 ('plus-minus-one')"
        )
    largest = np.asarray(image_size_wh, dtype=np.float64) - 1.0
    signed = normalised == "plus-minus-one"
    for frame in people.frames:
        frame[..., :2] = (0.5 * (frame[..., :2] + 1.0) if signed else frame[..., :2]) * largest
    report.append(f"coordinates from {-1 if signed else 0} to 1 converted to pixels")


def _check_places(path: Path, people: _People, image_size_wh: tuple[int, int]) -> None:
    points = _confident(people)
    size = np.asarray(image_size_wh, dtype=np.float64)
    outside = np.maximum(-points, points - size).max(axis=1)
    if (outside > _OUTSIDE * size.max()).any():
        u, v = points[outside.argmax()]
        raise KeypointError(
            f"{path}: a joint at ({u:.5g}, {v:.5g}) is far outside the image of "
            f"{image_size_wh[0]} x {image_size_wh[1]} pixels; expected pixels of this video"
        )
    inside = float((outside <= 0.0).mean())
    if inside < _INSIDE_SHARE:
        raise KeypointError(
            f"{path}: only {inside:.0%} of the joints lie inside the image of {image_size_wh[0]} x "
            f"{image_size_wh[1]} pixels; expected keypoints of this video, at its size"
        )


def _follow(people: _People, first_frame: int, report: list[str]) -> np.ndarray:
    """Return `[t j 3]`: the person that continuity chooses among those of every frame."""
    frames = people.frames
    num_joints = frames[first_frame].shape[1]
    chosen = np.zeros((len(frames), num_joints, 3))
    most = max(len(frame) for frame in frames)
    if most <= 1:
        for index, frame in enumerate(frames):
            if len(frame):
                chosen[index] = frame[0]
        return chosen
    start = frames[first_frame]
    chosen[first_frame] = start[int(np.argmax([_prominence(person) for person in start]))]
    lost = []
    for order in (range(first_frame + 1, len(frames)), range(first_frame - 1, -1, -1)):
        last, missed = chosen[first_frame], 0
        for index in order:
            candidates = [person for person in frames[index] if (person[:, 2] > 0.0).any()]
            distances = [_distance(last, person) for person in candidates]
            # After frames without the person it may have gone farther.
            if distances and min(distances) <= _JUMP * (1.0 + 0.2 * missed):
                last, missed = candidates[int(np.argmin(distances))], 0
                chosen[index] = last
            else:
                missed += 1
                lost.append(index)
    report.append(
        f"up to {most} people in a frame: "
        f"followed the most prominent one of frame {first_frame} by continuity"
    )
    if lost:
        report.append(
            f"in {len(lost)} frames (first: {min(lost)}) nobody was near enough to be that person"
        )
    return chosen


def _size(person: np.ndarray) -> float:
    """The diagonal of the box around a person's confident joints, at least one pixel."""
    points = person[person[:, 2] > 0.0, :2]
    return max(1.0, float(np.linalg.norm(np.ptp(points, axis=0)))) if len(points) else 1.0


def _prominence(person: np.ndarray) -> float:
    """Sum of confidences times size: the largest and most certain person."""
    return float(person[:, 2].sum()) * _size(person)


def _distance(last: np.ndarray, person: np.ndarray) -> float:
    """Mean distance of the joints that both have, in sizes of the person."""
    size = max(_size(last), _size(person))
    both = (last[:, 2] > 0.0) & (person[:, 2] > 0.0)
    if both.any():
        gaps = last[both, :2] - person[both, :2]
    else:
        gaps = (last[last[:, 2] > 0.0, :2].mean(0) - person[person[:, 2] > 0.0, :2].mean(0))[None]
    return float(np.linalg.norm(gaps, axis=1).mean()) / size


def _joint_names(
    path: Path, people: _People, chosen: np.ndarray, layout: str | None, report: list[str]
) -> tuple[str, ...]:
    num_joints = chosen.shape[1]
    if layout is not None and len(ALIASES[layout]) != num_joints:
        fitting = ", ".join(_LAYOUTS_BY_COUNT.get(num_joints, ())) or "none of the known"
        raise KeypointError(
            f"{path}: layout {layout} has {len(ALIASES[layout])} joints, "
            f"the file has {num_joints}; fitting layouts: {fitting}"
        )
    if layout is not None:
        known, own = ALIASES[layout], people.names or ()
        report.append(f"layout: {layout}, as asked for")
    elif people.names is not None and any(layout_of_names(people.names)):
        known, own = layout_of_names(people.names), people.names
        report.append(f"layout: by {num_joints} names")
    elif people.names is None and num_joints in _LAYOUTS_BY_COUNT:
        layout, reason = _recognise(chosen)
        known, own = ALIASES[layout], ()
        report.append(f"layout: {layout}, {reason}")
    else:
        found = f"names {shortened(list(people.names))}" if people.names else "joints without names"
        raise KeypointError(
            f"{path}: unknown layout: found {num_joints} {found}; the known layouts are "
            + ", ".join(f"{name} ({len(joints)})" for name, joints in ALIASES.items())
        )
    names = tuple(
        name or (own[index] if own else f"{layout}[{index}]") for index, name in enumerate(known)
    )
    if own and (unused := [name for name in names if name not in JOINT_NAMES]):
        report.append(f"joints that no body has: {', '.join(unused)}")
    return names


def _recognise(chosen: np.ndarray) -> tuple[str, str]:
    """Return the layout of unnamed joints and why."""
    candidates = _LAYOUTS_BY_COUNT[chosen.shape[1]]
    if len(candidates) == 1:
        return candidates[0], f"by its {chosen.shape[1]} joints"
    if "BODY_25" in candidates:
        # In BODY_25 joint 8 is computed as the middle of the hips, 9 and 12.
        seen = (chosen[:, [8, 9, 12], 2] > 0.0).all(axis=1)
        if seen.any():
            gap = chosen[:, 8, :2] - 0.5 * (chosen[:, 9, :2] + chosen[:, 12, :2])
            sizes = np.array([_size(person) for person in chosen])
            share = float(np.median((np.linalg.norm(gap, axis=1) / sizes)[seen]))
            layout = "BODY_25" if share < 0.08 else "BODY_25B"
            where = "is" if share < 0.08 else "is not"
            return layout, f"by its 25 joints, of which 8 {where} the middle of 9 and 12"
    others = ", ".join(candidates[1:])
    return candidates[0], f"by its {chosen.shape[1]} joints ({others} has as many: set layout)"
