"""Joints that somebody marked as points of pictures, in labelme, VIA or Label Studio.

*labelme.* `shapes` of a picture; `group_id` says of whom a point is. *VIA*, JSON or CSV. `regions`
of every picture, from version 3 on `metadata` of pictures or times of a video; what an attribute is
called is the annotator's choice, and the one with most names of joints is the joint's. *Label
Studio.* Tasks with `annotations`, or its short JSON; percent of the picture; people are the boxes
that points hang on.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from torchcss.errors import KeypointError
from torchcss.files import real_numbers, refusing, unexpected
from torchcss.io.keypoints.people import (
    Frames,
    Key,
    People,
    Person,
    number_array,
    one_size,
    track_of,
    united,
)
from torchcss.joint_names import canonical_joint_name

VIA_SHAPE = "region_shape_attributes"
"""A column of VIA's tables."""

Point = tuple[str | None, str, Sequence[float]]
"""Of whom a point is, which joint, and u, v and maybe confidence. None is the only one; who begins
with # may be another one in the next picture."""

Regions = dict[Key, list[tuple[Any, ...]]]
"""Shape and attributes of every region, by picture or time."""

_MARK = ("x", "y", "original_width", "original_height")
"""What is known of a point in Label Studio: percent of the picture, and its size."""


def people_of_points(where: str, points: Iterable[Point]) -> list[Person]:
    """The people whose joints are these points."""
    people: dict[str | None, dict[str, list[float]]] = {}
    for who, label, place in points:
        joints = people.setdefault(who, {})
        if label in joints:
            raise KeypointError(f"{where}: {label!r} twice; tell people apart, as by a group_id")
        joints[label] = real_numbers([*place, 1.0][:3], where, KeypointError).tolist()
    return [
        Person.by_name(joints, None if (who or "#").startswith("#") else who)
        for who, joints in people.items()
    ]


def labelme_people(where: str, shapes: object) -> list[Person]:
    """The people of labelme's shapes."""
    points: list[Point] = []
    for index, shape in enumerate(shapes if isinstance(shapes, list) else []):
        if isinstance(shape, dict) and shape.get("shape_type") == "point":
            place = f"{where}: shape {index}"
            point = number_array(shape.get("points"), place)
            if point.shape != (1, 2):
                raise unexpected(KeypointError, place, "one point", point.tolist())
            group = shape.get("group_id")
            points.append(
                (None if group is None else f"{group}", f"{shape.get('label')}", point[0])
            )
    return people_of_points(where, points)


# VIA.


def is_via(content: Mapping[str, Any]) -> bool:
    """Whether JSON is a project or the annotations of VIA."""
    if {"metadata", "attribute", "view", "file"} <= content.keys():
        return True
    pictures = content.get("_via_img_metadata", content)
    return isinstance(pictures, dict) and any(
        isinstance(each, dict) and {"filename", "regions"} <= each.keys()
        for each in pictures.values()
    )


def read_via(content: Mapping[str, Any]) -> People:
    """Read VIA's JSON."""
    found: Regions = {}
    with refusing(KeypointError, "not VIA's pictures"):
        if "metadata" in content:
            return _via_people(_of_version_3(content))
        for each in content.get("_via_img_metadata", content).values():
            regions = each["regions"]
            regions = regions.values() if isinstance(regions, dict) else regions  # of version 1
            found[each["filename"]] = [
                (region["shape_attributes"], region["region_attributes"]) for region in regions
            ]
    return _via_people(found)


def _of_version_3(content: Mapping[str, Any]) -> Regions:
    """The regions of a project of version 3, as those before it have them."""
    names = {
        view: content["file"][f"{shown['fid_list'][0]}"]["fname"]
        for view, shown in content["view"].items()
    }
    marks = [*content["metadata"].values()]
    found: Regions = {} if any(mark["z"] for mark in marks) else {n: [] for n in names.values()}
    if not found and len({mark["vid"] for mark in marks}) > 1:
        raise KeypointError("points of several videos; give a project of one")
    for mark in marks:
        about = {}
        for key, value in mark["av"].items():
            attribute = content["attribute"][key]
            about[attribute["aname"]] = (attribute.get("options") or {}).get(value, value)
        if mark["xy"] and mark["xy"][0] == 1:  # a point
            shape = {"name": "point", "cx": mark["xy"][1], "cy": mark["xy"][2]}
            key = float(mark["z"][0]) if mark["z"] else names[f"{mark['vid']}"]
            found.setdefault(key, []).append((shape, about))
    return found


def read_via_table(heading: Sequence[str], rows: Iterable[tuple[int, Sequence[str]]]) -> People:
    """Read VIA's CSV."""
    found: Regions = {}
    for number, row in rows:
        with refusing(KeypointError, f"row {number}: not VIA's"):
            cells = dict(zip(heading, row, strict=True))
            texts = cells[VIA_SHAPE], cells["region_attributes"]
            found.setdefault(cells["filename"], []).append(tuple(map(json.loads, texts)))
    return _via_people(found)


def _via_people(found: Regions) -> People:
    """People of the points of pictures, each with its attributes."""
    values: dict[str, set[str]] = {}
    marks: dict[Key, list[tuple[dict[str, str], Sequence[float]]]] = {}
    with refusing(KeypointError, "not VIA's regions"):
        for name, regions in found.items():
            marks[name] = [
                ({key: _ticked(each) for key, each in about.items()}, (shape["cx"], shape["cy"]))
                for shape, about in regions
                if shape.get("name") == "point"
            ]
            for key, value in (item for about, _ in marks[name] for item in about.items()):
                values.setdefault(key, set()).add(value)
    known = {key: sum(map(bool, map(canonical_joint_name, own))) for key, own in values.items()}
    joint = max(values, key=lambda key: (known[key], len(values[key])), default="")
    frames: Frames = {
        name: people_of_points(
            f"{name}",
            [(track_of({**about, joint: ""}), about.get(joint, ""), uv) for about, uv in own],
        )
        for name, own in marks.items()
    }
    people, names = united(frames)
    return People(people, names, [f"format: VIA, joints by {joint!r}"], whole=True)


def _ticked(value: object) -> str:
    """The value of an attribute, or the options that are ticked."""
    return ",".join(key for key in value if value[key]) if isinstance(value, dict) else f"{value}"


# Label Studio.


def is_label_studio(content: object) -> bool:
    """Whether JSON is a list of Label Studio's tasks, in the long or the short form."""
    return isinstance(content, list) and any(
        isinstance(task, dict)
        and ("annotator" in task or ("data" in task and {"annotations", "completions"} & {*task}))
        for task in content
    )


def read_label_studio(content: Sequence[Any]) -> People:
    """Read Label Studio's tasks; of several annotations of a picture the first counts."""
    frames: Frames = {}
    sizes: set[tuple[float, float]] = set()
    for index, task in enumerate(content):
        where = f"task {index}"
        with refusing(KeypointError, f"{where}: not Label Studio's"):
            points: list[Point] = []
            for mark in _marks(task):
                x, y, *size = real_numbers([mark.get(key) for key in _MARK], where, KeypointError)
                sizes.add((size[0], size[1]))
                # From the corner; the centres of pixels are at integers.
                place = (0.01 * x * size[0] - 0.5, 0.01 * y * size[1] - 0.5)
                points.append((f"#{mark.get('hangs_on')}", mark["keypointlabels"][0], place))
                if mark.get("image_rotation"):
                    raise KeypointError(f"{where}: annotated in a turned picture; export COCO's")
            frames[_picture(where, task)] = people_of_points(where, points)
    people, names = united(frames)
    first = 0 if any(isinstance(key, int) for key in frames) else None
    size = one_size(sizes)
    return People(people, names, ["format: Label Studio"], first=first, size_wh=size)


def _marks(task: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The points of a picture, and what each hangs on."""
    done = task.get("annotations", task.get("completions", ()))
    results = next((each["result"] for each in done if not each.get("was_cancelled")), [])
    ends = [(each["from_id"], each["to_id"]) for each in results if each["type"] == "relation"]
    hung = {**{b: a for a, b in ends}, **dict(ends)}
    marks = [
        {**each, **each["value"], "hangs_on": each.get("parentID", hung.get(each.get("id")))}
        for each in results
        if each["type"] == "keypointlabels"
    ]
    if not done:  # of the short form
        lists = (each for key, each in task.items() if isinstance(each, list) and key != "result")
        marks = [mark for each in lists for mark in each if "keypointlabels" in mark]
    return marks


def _picture(where: str, task: Mapping[str, Any]) -> Key:
    """A task's picture, without what is put before it when it is uploaded; or its frame (SLEAP)."""
    meta = task.get("meta") or {}
    if (frame := meta.get("video", {}).get("frame_idx")) is not None:
        return int(frame)
    data = task["data"] if isinstance(task.get("data"), dict) else task
    for value in data.values():
        if isinstance(value, str) and re.search(r"(?i)\.(jpe?g|png|bmp|tiff?|webp)$", value):
            return re.sub("^[0-9a-f]{8}-", "", re.split(r"[/\\=]", value)[-1])
    raise unexpected(KeypointError, where, "the name of a picture", data)
