"""2D joints of one person in every frame, from the files of the usual detectors or a few clicks.

| format | recognised by |
|---|---|
| OpenPose, DWPose, Pose2Sim | a folder of JSON with `people`, a file per frame; or a list |
| EasyMocap, labelme | a folder of JSON with `annots` or `shapes` |
| VIA, Label Studio | see `torchcss.io.keypoints.annotated` |
| YOLO | a folder of text labels; JSON of Ultralytics |
| CVAT | its XML of pictures or a video, with skeletons or single points |
| COCO, CVAT, AlphaPose | JSON: `annotations`, a list of `{image_id, keypoints}`, or by picture |
| MMPose, openpifpaf, easy_ViTPose, TensorFlow.js | JSON, see `torchcss.io.keypoints.json_files` |
| MediaPipe | 33 landmarks as JSON, CSV, NPY or NPZ |
| DeepLabCut, Lightning Pose | CSV with the headings `bodyparts` and `coords`; HDF5 |
| SLEAP | its analysis as CSV or HDF5 |
| VideoPose3D, HumanEva | NPZ with `positions_2d`, `FILE.npz#SUBJECT/ACTION/CAMERA`; detections |
| CSV | any with columns such as `l_hip_x`, `l_hip_y`, see `torchcss.io.keypoints.tables` |
| pandas | JSON of such a table, in any of its forms |
| NPZ, NPY | `keypoints [T J 2]`, `confidence [T J]`, `joint_names [J]`; pairs or triples |
| clicked | JSON: `{"joints": {"l_wrist": [u, v]}}` for one frame, or `{"frames": {"0": {...}}}` |

Frame numbers, times and names of pictures are used where a file has them; a file that only has an
order must have as many entries as the video has frames.

Files that name their joints are read by name; the others by layout, which their number of joints
tells (of 25 the places of the points decide whether it is BODY_25). Out come the catalogue's names
(`torchcss.joint_names`); a joint that has none keeps its own. For a body from a file, such as a
robot, the names of its links count too (`torchcss.io.keypoints.links`). A missing joint has
confidence 0 and stands at (0, 0). Of several people, one is followed, by the file's own tracks
where it has them.
Left and right that change places for some frames are put back (`torchcss.io.keypoints.sides`).
Every such choice, and whatever looks odd, is a line of `Keypoints.report`.

By default: `read_keypoints(path, image_size_wh=(w, h), num_frames=t)`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch

from torchcss.body.model import BodyModel
from torchcss.errors import KeypointError
from torchcss.files import StrPath, load_array, load_arrays, naming, read_text, shortened
from torchcss.io.keypoints.apple import in_plain_words
from torchcss.io.keypoints.arrays import MOST_BYTES, read_arrays
from torchcss.io.keypoints.cvat import read_cvat
from torchcss.io.keypoints.findings import findings
from torchcss.io.keypoints.frames import Film, files_of, in_order, wrong_count
from torchcss.io.keypoints.h36m import is_h36m, read_h36m
from torchcss.io.keypoints.hdf5 import read_hdf5
from torchcss.io.keypoints.json_files import read_content, read_folder, read_json
from torchcss.io.keypoints.labels import read_labels
from torchcss.io.keypoints.links import Links, joints_named, names_links
from torchcss.io.keypoints.mediapipe import LAYOUT as LANDMARKS
from torchcss.io.keypoints.mediapipe import check_not_in_space
from torchcss.io.keypoints.one_person import Whom, follow_person, size_of
from torchcss.io.keypoints.people import Names, People, Person, Size, is_there, screened
from torchcss.io.keypoints.sides import with_sides_put_back
from torchcss.io.keypoints.tables import json_of_rows, people_of_rows, table_rows
from torchcss.io.video import VIDEO_SUFFIXES
from torchcss.joint_names import (
    ALIASES,
    JOINT_NAMES,
    LIMB_JOINTS,
    layout_of_names,
    skeleton_joint_names,
)
from torchcss.types import Keypoints

Scale = Literal["pixels", "zero-one", "plus-minus-one"]
"""What the coordinates of a file count: pixels, or fractions of the image from 0 or -1 to 1."""

_AS_CSV = "save it as CSV"
_OTHERS = {
    ".pkl .pickle .p .pt .pth .joblib": "a pickle, from which code may run: not read; save the "
    "arrays with numpy.savez(FILE, keypoints=..., confidence=..., joint_names=...)",
    " ".join(VIDEO_SUFFIXES): "a video; torchcss detect VIDEO --out "
    "keypoints.npz finds the keypoints in it",
    ".jpg .jpeg .png .bmp .tif .tiff .webp": "a picture; torchcss init PICTURE --click marks its "
    "joints",
    ".trc .c3d .bvh .amc .mot .fbx .glb": "a motion in space; expected the pixels of joints",
    ".xlsx .xls .ods .numbers": f"a spreadsheet; {_AS_CSV}",
    ".parquet .feather .arrow .mat": f"a table that is not read; {_AS_CSV}",
    ".nc": "movement's; movement.io.save_poses.to_dlc_file(dataset, 'keypoints.csv') writes CSV",
    ".nwb": f"Neurodata Without Borders, which is not read; {_AS_CSV}",
    ".zip .gz .bz2 .xz .7z .tar .tgz .rar": "packed; unpack it",
}
"""Files of other kinds by their suffixes, and what to do."""

OWN_NAMES = "own"
"""The layout of files whose names are those of the body."""

# Which layout a number of unnamed joints means; the first is the default.
_LAYOUTS_BY_COUNT: dict[int, tuple[str, ...]] = {}
for _name, _joints in ALIASES.items():
    if _joints is not JOINT_NAMES:
        _LAYOUTS_BY_COUNT[len(_joints)] = (*_LAYOUTS_BY_COUNT.get(len(_joints), ()), _name)

_NORMALISED_EXTENT = 2.0
"""No person is so few pixels large: coordinates that all lie within are fractions of the image."""

_LARGEST_FRACTION = 3.0
"""Landmarks that MediaPipe guesses outside the image stay within this many of its sides."""

_PERCENT = 50.0
"""Confidences that run to more than this, to 100 at most, and mostly above 1, are percent."""

_DEPTHS = 0.1
"""Share of third numbers below 0 from which they are z, as MediaPipe's, and no confidences."""

_OUTSIDE = 3.0
"""How many times the longer image side a joint may lie outside before the file is refused."""

_INSIDE_SHARE = 0.1
"""Least share of the confident joints that must lie inside the image."""


def read_keypoints(
    path: StrPath,
    *,
    image_size_wh: Size,
    num_frames: int | None = None,
    layout: str | BodyModel | None = None,
    normalised: bool | Scale = False,
    first_frame: int = 0,
    frame_names: Sequence[str] | None = None,
    frame_rate: float | None = None,
) -> Keypoints:
    """Read the 2D joints of one person from any of the formats above.

    Args:
        path: A file, or OpenPose's folder; of an archive of several recordings, which follows
            behind a `#`.
        image_size_wh: Size of the video's images in pixels.
        num_frames: Number of frames of the video, which the file must match (a clicked file need
            not). None: as many as the file has.
        layout: A key of `torchcss.joint_names.ALIASES`, for files that do not name their joints;
            "own": the names of the file as they are. A body from a file, such as a robot: its links
            may be named as well as a person's joints. None: recognise it.
        normalised: True, `"zero-one"` or `"plus-minus-one"` for coordinates that are fractions of
            the image, which are then converted: the range ends at the centres of the border pixels.
        first_frame: The frame in which tracking starts; there somebody must be seen.
        frame_names: Names of the video's pictures, if it is a folder of them: a file that names
            pictures is then read by name.
        frame_rate: Frames per second of the video, for files that say times.

    Returns:
        Joints of the person chosen, float64.

    Raises:
        KeypointError: If the file is missing, damaged, of unknown format or layout, has another
            number of frames, nobody in the first frame, coordinates that cannot be pixels, or a
            confident joint that is not a number.
    """
    film = Film(num_frames, frame_names, frame_rate)
    whom = Whom(first_frame, "prominent", image_size_wh)
    links = layout.joint_of_name if isinstance(layout, BodyModel) else {}
    layout = None if isinstance(layout, BodyModel) else layout
    return read_person(
        path, film=film, whom=whom, layout=layout, normalised=normalised, links=links
    )


def read_person(
    path: StrPath,
    *,
    film: Film,
    whom: Whom,
    layout: str | None = None,
    normalised: bool | Scale = False,
    links: Links = MappingProxyType({}),
) -> Keypoints:
    """The same, for a film of which more is known, and a person of choice.

    Args:
        path: As for `read_keypoints`.
        film: The video.
        whom: Who is followed, and the size of the images.
        layout: As for `read_keypoints`.
        normalised: The same.
        links: What the body's file calls its joints.

    Raises:
        KeypointError: The same, or that person is not in the file.
    """
    path = Path(path)
    with naming(path, KeypointError):
        if layout is not None and layout not in (OWN_NAMES, *ALIASES):
            raise KeypointError(
                f"unknown layout {layout!r}; the known ones are {', '.join((*ALIASES, OWN_NAMES))}"
            )
        people = in_plain_words(_read(path, whom.image_size_wh, film.num_frames))
        return _person(people, film, whom, layout, normalised, links)


def _person(
    people: People,
    film: Film,
    whom: Whom,
    layout: str | None,
    normalised: bool | Scale,
    links: Links,
) -> Keypoints:
    """Who is followed, checked and in pixels."""
    first_frame, _, image_size_wh = whom
    report = list(people.report)
    if people.in_order and len(people.frames) == 1:
        (alone,) = people.frames.values()
        if 1 < len(alone) == film.num_frames:
            people = people._replace(frames={n: [person] for n, person in enumerate(alone)})
            report.append("as many people in one frame as the video has frames: one in each")
    everyone = in_order(people, film, report)
    everyone = [[p for p in frame if is_there(p.joints)] for frame in everyone]
    frames = _stacked(everyone)
    _check_counts(frames, people.names, film, first_frame)
    frames = _checked_numbers(frames, people.names, report)
    _check_somebody(frames, first_frame)
    points = np.concatenate([frame[frame[..., 2] > 0.0][:, :2] for frame in frames])
    if people.layout == LANDMARKS:
        check_not_in_space(frames)
    if people.corner_fractions:
        scale, shift, note = _from_corner(points, image_size_wh)
    else:
        scale, shift, note = _from_border_pixels(points, people.size_wh, image_size_wh, normalised)
    report += note
    _check_places(scale * points + shift, image_size_wh)
    for frame in frames:
        frame[..., :2] = scale * frame[..., :2] + shift
    tracks = [[person.track for person in frame] for frame in everyone]
    chosen = follow_person(frames, tracks, whom, report)
    names = _joint_names(people, chosen, layout or people.layout, links, report)
    chosen = with_sides_put_back(chosen, names, report)
    report += findings(chosen, names, image_size_wh, first_frame)
    positions = np.where(chosen[..., 2:] > 0.0, chosen[..., :2], 0.0)
    confidence = torch.from_numpy(chosen[..., 2].copy())
    return Keypoints(
        torch.from_numpy(positions), confidence, names, people.relative_noise, tuple(report)
    )


def _stacked(frames: Sequence[Sequence[Person]]) -> list[np.ndarray]:
    """`[p j 3]` of every frame."""
    counts = sorted({len(person.joints) for frame in frames for person in frame})
    if len(counts) > 1:
        raise KeypointError(
            f"people with {' and '.join(map(str, counts))} joints; "
            "expected one layout in the whole file"
        )
    nobody = np.zeros((0, *counts, 3) if counts else (0, 0, 3))
    return [np.stack([p.joints for p in frame]) if frame else nobody for frame in frames]


# The formats.


def _read(path: Path, size: Size, num: int | None) -> People:
    if path.is_dir():
        return _read_folder(path, size, num)
    archive, mark, selection = str(path).rpartition("#")
    if mark and not path.exists():
        path = Path(archive)
    else:
        selection = ""
    suffix = path.suffix.lower()
    if suffix == ".npz" and is_h36m(path):
        return read_h36m(path, selection)
    if selection:
        raise KeypointError(
            f"{path}#{selection}: there is no such file, and only VideoPose3D's archives hold "
            "several recordings to choose from"
        )
    if suffix == ".npz":
        return read_arrays(path, load_arrays(path, KeypointError, MOST_BYTES))
    if suffix == ".npy":
        return read_arrays(path, {path.name: load_array(path, KeypointError)})
    if suffix in (".csv", ".tsv") or (
        suffix == ".txt" and read_text(path, KeypointError).lstrip()[:1] not in ("{", "[")
    ):
        rows = table_rows(path)
        inner = json_of_rows(rows)
        return people_of_rows(rows) if inner is None else read_content(path, inner, size, num)
    if suffix in (".h5", ".hdf5", ".slp"):
        return read_hdf5(path)
    if suffix == ".xml":
        return read_cvat(path)
    for suffixes, what in _OTHERS.items():
        if suffix in suffixes.split() and path.is_file():
            raise KeypointError(what)
    return read_json(path, size, num)


def _read_folder(path: Path, size: Size, num: int | None) -> People:
    """A file for every frame, or one without a number; or one camera's folder of them."""
    if files := files_of(path, ".json"):
        if len(files) == 1 and not re.search("[0-9]", files[0].stem):
            return read_json(files[0], size, num)
        return read_folder(path)
    if files_of(path, ".txt"):
        return read_labels(path, size)
    if files := files_of(path, ".xml"):
        people = read_cvat(files[0])
        if len(files) == 1:
            return people
    folders = sorted(entry.name for entry in path.iterdir() if entry.is_dir())
    if len(folders) == 1:
        return _read_folder(path / folders[0], size, num)
    raise KeypointError(
        "no keypoints in this folder; expected OpenPose's, EasyMocap's or YOLO's labels, one for "
        "every frame, or one file of another format"
        + (f"; give one of {shortened(', '.join(folders))}" if folders else "")
    )


# What is checked and decided.


def _check_counts(
    frames: list[np.ndarray], names: Names | None, film: Film, first_frame: int
) -> None:
    """Refuse another number of frames than the video's, and of names than joints."""
    if film.num_frames is not None and len(frames) != film.num_frames:
        if {len(frame) for frame in frames} == {film.num_frames}:
            raise KeypointError(
                f"{len(frames)} cameras or people with {film.num_frames} frames each, it seems; "
                "expected frames first, of this camera alone, such as array[0]"
            )
        raise wrong_count(film.num_frames, len(frames))
    if not 0 <= first_frame < max(1, len(frames)):
        raise KeypointError(
            f"the first frame {first_frame} is beyond the file, which has {len(frames)} frames"
        )
    num_joints = max((frame.shape[1] for frame in frames), default=0)
    if names is None or not num_joints:  # nobody in the whole file: another check says so
        return
    if len(names) != num_joints:
        raise KeypointError(f"{len(names)} joint names for {num_joints} joints; expected as many")
    if len(set(names)) < num_joints:
        raise KeypointError(f"the same joint name twice in {shortened(names)}")


def _checked_numbers(
    frames: list[np.ndarray], names: Names | None, report: list[str]
) -> list[np.ndarray]:
    """Refuse numbers that are not finite where they count; bring confidences into their range."""
    checked, clipped = [], 0
    counts = np.concatenate([np.zeros(0), *(frame[..., 2].ravel() for frame in frames)])
    counts = counts[np.isfinite(counts)]
    most = float(np.max(counts, initial=0.0))
    if most == 2.0 and {*counts.tolist()} <= {0.0, 1.0, 2.0}:  # not labelled, hidden, seen
        report.append("visibility 0, 1, 2 taken as confidence 0, 0.5, 1")
        frames = [frame * (1.0, 1.0, 0.5) for frame in frames]
    elif _PERCENT < most <= 100.0 and np.median(counts[counts > 0.0]) > 1.0:
        report.append(f"confidences run to {most:g}: they are taken for percent")
        frames = [frame * (1.0, 1.0, 0.01) for frame in frames]
    elif ((counts < 0) & (counts != -1)).sum() > _DEPTHS * len(counts):
        report.append("no confidence in the file, but z: 1 for every joint")
        frames = [screened(frame[..., :2]) for frame in frames]
    for index, frame in enumerate(frames):
        if not len(frame):  # most of them, of a file of few pictures
            checked.append(frame)
            continue
        # All three not a number is how some programs write a joint that they did not find.
        frame = np.where(np.isnan(frame).all(-1, keepdims=True), 0.0, frame)
        confidence, finite = frame[..., 2], np.isfinite(frame[..., :2]).all(-1)
        bad = np.isnan(confidence) | (~finite & (confidence != 0.0))
        if bad.any():
            joint = int(np.argwhere(bad)[0, -1])
            raise KeypointError(
                f"frame {index}: joint {repr(names[joint]) if names else joint} is not a "
                f"number though its confidence is {float(confidence[bad][0]):g}; expected "
                "confidence 0 where a joint is missing"
            )
        if (confidence > 10.0).any():
            raise KeypointError(f"frame {index}: confidence {confidence.max():g}; expected 0 to 1")
        clipped += int(((confidence < 0.0) | (confidence > 1.0)).sum())
        places = np.where((confidence > 0.0)[..., None], frame[..., :2], 0.0)
        checked.append(np.concatenate([places, confidence.clip(0.0, 1.0)[..., None]], axis=-1))
    if clipped:
        report.append(f"{clipped} confidences outside 0 to 1 were moved to the nearer end")
    return checked


def _check_somebody(frames: list[np.ndarray], first_frame: int) -> None:
    seen = [index for index, frame in enumerate(frames) if (frame[..., 2] > 0.0).any()]
    later = next((index for index in seen if index >= first_frame), None)
    if later == first_frame:
        return
    advice = (
        f"the first frame with somebody is {later}: start there (--start {later}), or mark the "
        "joints of the first one (torchcss init --click)"
    )
    if later is None:
        advice = "there is none later either"
    if first_frame == 0 and later == 1:
        advice += ", or number the frames from 0, if the file counts them from 1"
    raise KeypointError(
        f"nobody in the first frame ({first_frame}), where tracking starts; {advice}"
    )


Change = tuple[np.ndarray | float, np.ndarray | float, list[str]]
"""Factor and shift that make pixels of coordinates, and what to report."""


def _from_corner(points: np.ndarray, image_size_wh: Size) -> Change:
    """Pixels, or fractions of the image from its corner; MediaPipe's numbers tell which."""
    sizes = np.abs(points).max(-1)
    if np.median(sizes) > _LARGEST_FRACTION:
        return 1.0, 0.0, ["coordinates are pixels already"]
    if sizes.max() > 100 * _LARGEST_FRACTION:
        raise KeypointError(
            f"expected fractions of the image, as most are, found {sizes.max():.4g}"
        )
    # Pixel centres are at integers.
    return np.array(image_size_wh), -0.5, ["fractions of the image converted to pixels"]


def _from_other_size(size_wh: tuple[float, float], image_size_wh: Size) -> Change:
    """Pixels of images of another size, if it is the same picture."""
    scale = np.array(image_size_wh) / size_wh
    if abs(scale[0] / scale[1] - 1) > 0.02:
        raise KeypointError(
            f"made from images of {size_wh[0]:g} x {size_wh[1]:g} pixels, the video has "
            f"{image_size_wh[0]} x {image_size_wh[1]}, which is another shape; make the keypoints "
            "from this very video"
        )
    if (scale == 1).all():
        return 1.0, 0.0, []
    note = (
        f"scaled from images of {size_wh[0]:g} x {size_wh[1]:g} pixels, as the file says, to "
        f"{image_size_wh[0]} x {image_size_wh[1]}"
    )
    return scale, 0.0, [note]


def _from_border_pixels(
    points: np.ndarray,
    said_wh: tuple[float, float] | None,
    image_size_wh: Size,
    normalised: bool | Scale,
) -> Change:
    """Pixels, maybe of another size, or fractions from the centres of border pixels, as said."""
    fractions = bool((np.abs(points) <= _NORMALISED_EXTENT).all())
    if normalised in (False, "pixels"):
        if fractions:
            raise KeypointError(
                f"expected pixels, but all coordinates lie between {points.min():.3g} and "
                f"{points.max():.3g}: they seem to be fractions of the image; if so, say "
                "--normalised zero-one (or plus-minus-one); MoveNet's, which have y before x, save "
                "as an array [frames 1 1 17 3]"
            )
        return (1.0, 0.0, []) if said_wh is None else _from_other_size(said_wh, image_size_wh)
    if not fractions:
        raise KeypointError(
            f"expected fractions of the image, but coordinates reach "
            f"{np.abs(points).max():.4g}: they seem to be pixels; if so, leave normalised out"
        )
    if normalised is True and (points < 0.0).any():
        raise KeypointError(
            "some coordinates are negative: say whether they run from 0 to 1 with joints "
            "outside the image (normalised 'zero-one') or from -1 to 1 ('plus-minus-one')"
        )
    largest = np.asarray(image_size_wh, dtype=np.float64) - 1.0
    if normalised == "plus-minus-one":
        return 0.5 * largest, 0.5 * largest, ["coordinates from -1 to 1 converted to pixels"]
    return largest, 0.0, ["coordinates from 0 to 1 converted to pixels"]


def _check_places(points: np.ndarray, image_size_wh: Size) -> None:
    size = np.asarray(image_size_wh, dtype=np.float64)
    outside = np.maximum(-points, points - size).max(axis=1)
    if (outside > _OUTSIDE * size.max()).any():
        u, v = points[outside.argmax()]
        raise KeypointError(
            f"a joint at ({u:.5g}, {v:.5g}) is far outside the image of "
            f"{image_size_wh[0]} x {image_size_wh[1]} pixels; expected pixels of this video"
        )
    inside = float((outside <= 0.0).mean())
    if inside < _INSIDE_SHARE:
        raise KeypointError(
            f"only {inside:.0%} of the joints lie inside the image of {image_size_wh[0]} x "
            f"{image_size_wh[1]} pixels; expected keypoints of this video, at its size"
        )


def _joint_names(
    people: People, chosen: np.ndarray, layout: str | None, links: Links, report: list[str]
) -> Names:
    """Names of the joints: the body's own where the file has them, else those of people."""
    own = people.names or ()
    if layout == OWN_NAMES or (layout is None and names_links(own, links)):
        if not own:
            raise KeypointError(f"layout {OWN_NAMES}: the file does not name its joints")
        report.append(f"layout: {len(own)} names as they are")
        known = zip(own, joints_named(own, links), strict=True)
        names = tuple(joint or name for name, joint in known)
    else:
        names = _names_of_people(people, chosen, report, layout, any_names=bool(links))
    there = tuple(dict.fromkeys(links.values()))
    if layout == OWN_NAMES and not there:
        return names
    unused = [name for name in names if name not in (there or JOINT_NAMES)]
    if people.by_hand and unused:
        raise KeypointError(
            f"unknown joint {unused[0]!r}, or it is there twice; the known ones are "
            f"{', '.join(there or JOINT_NAMES)}"
        )
    if there and len(unused) == len(names):
        raise KeypointError(
            f"no joint of the body among {shortened(list(own or names))}; it has {', '.join(there)}"
        )
    if own and unused:
        report.append(
            f"joints that {'the body has not' if there else 'no body has'}: {', '.join(unused)}"
        )
    return names


def _names_of_people(
    people: People, chosen: np.ndarray, report: list[str], layout: str | None, *, any_names: bool
) -> Names:
    """A person's joints, by their names or by their number."""
    num_joints, own = chosen.shape[1], people.names or ()
    if layout is not None and len(ALIASES[layout]) != num_joints:
        fitting = ", ".join(_LAYOUTS_BY_COUNT.get(num_joints, ())) or "none of the known"
        raise KeypointError(
            f"layout {layout} has {len(ALIASES[layout])} joints, "
            f"the file has {num_joints}; fitting layouts: {fitting}"
        )
    if layout is not None:
        known = ALIASES[layout]
        why = f"{layout}, as {'the file says' if people.layout == layout else 'asked for'}"
    elif own and (any_names or people.by_hand or any(layout_of_names(own))):
        known, why = layout_of_names(own), f"by {num_joints} names"
        skeleton = skeleton_joint_names(own)
        if len({*LIMB_JOINTS} & {*skeleton}) > len({*LIMB_JOINTS} & {*known}):
            known, why = skeleton, f"{why} of a skeleton's joints"
    elif people.names is None and num_joints in _LAYOUTS_BY_COUNT:
        layout, reason = _recognise(chosen)
        known, why = ALIASES[layout], f"{layout}, {reason}"
    else:
        found = f"names {shortened(list(own))}" if own else "joints without names"
        raise KeypointError(
            f"unknown layout: found {num_joints} {found}; the known layouts are "
            + ", ".join(f"{name} ({len(joints)})" for name, joints in ALIASES.items())
            + (
                "; to name a robot's or an animal's joints, give its file as the body"
                if own
                else ""
            )
        )
    report.append(f"layout: {why}")
    return tuple(
        name or (own[index] if own else f"{layout}[{index}]") for index, name in enumerate(known)
    )


_MIDDLES = {
    "BODY_25": ((8, 9, 12),), "BODY_18": ((8, 9, 12),),
    "Kinect-25": ((0, 12, 16), (20, 4, 8)), "DWPose-24": ((1, 2, 5),),
    "H36M-17": ((0, 1, 4), (7, 0, 8), (8, 11, 14)), "3DHP-17": ((14, 8, 11), (1, 2, 5)),
    "H36M-16": ((0, 1, 4), (7, 0, 8), (8, 10, 13)),
    "HumanEva-15": ((0, 8, 11),), "MPI-15": ((1, 2, 5),),
    "LSP-14": ((12, 8, 9),), "CrowdPose-14": ((13, 0, 1),), "AIC-14": ((13, 0, 3),),
}  # fmt: skip
"""Joints of layouts that stand in the middle of two others: hips, shoulders, and spine of both."""


_POSETRACK = "PoseTrack-17"


def _has_head(chosen: np.ndarray) -> bool:
    """Whether joints 0 to 4 are nose, neck, top of the head and no ears; or nose, eyes and ears."""
    seen = chosen[(chosen[:, :3, 2] > 0.0).all(1), :3, :2]
    down, up = (seen[:, end] - seen[:, 0] for end in (1, 2))
    beyond = (down * up).sum(-1) < 0.0
    return bool(len(seen) and not (chosen[:, 3:5, 2] > 0.0).any() and beyond.mean() > 0.5)


def _recognise(chosen: np.ndarray) -> tuple[str, str]:
    """Return the layout of unnamed joints and why.

    Raises:
        KeypointError: If it cannot be told.
    """
    num_joints = chosen.shape[1]
    candidates = _LAYOUTS_BY_COUNT[num_joints]
    if len(candidates) == 1:
        return candidates[0], f"by its {num_joints} joints"
    refuted = ""
    for layout in (each for each in candidates if each in _MIDDLES):
        columns = np.array(_MIDDLES[layout])
        seen = chosen[(chosen[:, columns.ravel(), 2] > 0.0).all(axis=1)]
        if not len(seen):
            continue
        places, size = seen[:, columns, :2], np.array([[size_of(person)] for person in seen])
        gaps = np.linalg.norm(places[:, :, 0] - places[:, :, 1:].mean(2), axis=-1) / size
        is_it, (at, one, other) = (np.median(gaps, axis=0) < 0.08).all(), _MIDDLES[layout][0]
        why = f"of which {at} is {'' if is_it else 'not '}the middle of {one} and {other}"
        if is_it:
            return layout, f"by its {num_joints} joints, {why}"
        refuted = refuted or why
    plain = [each for each in candidates if each not in _MIDDLES]
    if _POSETRACK in plain and _has_head(chosen):
        why = "of which 0 stands between 1 and 2, and 3 and 4, the ears, are never there"
        return _POSETRACK, f"by its {num_joints} joints, {why}"
    if not plain:
        raise KeypointError(
            f"{num_joints} joints without names, of which it is not clear whether they are those "
            f"of {', '.join(candidates)}: say so (--layout)"
        )
    reason = f"by its {num_joints} joints"
    others = [each for each in candidates if each != plain[0]]
    if refuted and plain[0] != candidates[0]:
        reason, others = f"{reason}, {refuted}", plain[1:]
    have = "has" if len(others) == 1 else "have"
    told = f" ({', '.join(others)} {have} as many: set layout, --layout)" if others else ""
    return plain[0], f"{reason}{told}"
