"""CVAT's own XML of pictures and of videos, in which people are skeletons or single points.

A `skeleton` is a person, its `points` are the joints, and so is an element of several points, which
have an order only. Without those a label is a joint of the only person there is. A video has a
`track` for each of them, with a line for every frame, in which it may be `outside`; pictures have
names.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

from torchcss.body.files.xml import parse_xml
from torchcss.errors import KeypointError
from torchcss.files import unexpected
from torchcss.io.keypoints.annotated import Point, people_of_points
from torchcss.io.keypoints.frames import plain_name
from torchcss.io.keypoints.mediapipe import reordered
from torchcss.io.keypoints.people import Frames, Key, People, one_size, united

_HIDDEN = 0.5
"""Confidence of a joint that is marked as occluded: where it is was guessed."""


def read_cvat(path: Path) -> People:
    """Read annotations of pictures or of a video.

    Raises:
        KeypointError: If it is another XML, or a point is none.
    """
    root = parse_xml(path, "CVAT's XML", KeypointError)
    if root.tag == "annotation":
        raise KeypointError(
            "a picture's XML, of LabelMe on the web or Pascal VOC; expected CVAT's, labelme's JSON "
            "or COCO's"
        )
    if root.tag != "annotations":
        raise KeypointError(f"expected CVAT's annotations, found <{root.tag}>")
    pictures = [*root.iter("image")]
    found: dict[Key, list[Point]] = {_name(each): [] for each in pictures}
    for place, who, element, outside in _shapes(root):
        own = found.setdefault(place, [])
        for point in element.findall("points") if element.tag == "skeleton" else [element]:
            name = point.get("label", element.get("label", ""))
            several = point.get("points", "").split(";")
            if not outside and point.get("outside") != "1":
                labels = [name] if len(several) == 1 else map(str, range(len(several)))
                own += [(who, n, _joint(point, n, t)) for n, t in zip(labels, several, strict=True)]
    frames: Frames = {place: people_of_points(f"{place}", own) for place, own in found.items()}
    people, names = united(frames)
    people, names = reordered(people, names or ())
    said = [
        (each.findtext("width"), each.findtext("height")) for each in root.iter("original_size")
    ]
    sizes = {*said, *((each.get("width"), each.get("height")) for each in pictures)}
    width, height = (int(n) if n and n.isdecimal() else 0 for n in one_size(sizes) or ("", ""))
    return People(
        people, names, ["format: CVAT's XML"], first=None if pictures else 0, whole=bool(pictures),
        size_wh=(width, height) if width and height else None,
    )  # fmt: skip


def _name(image: Element) -> str:
    return plain_name(image.get("name", image.get("id", "")))


def _shapes(root: Element) -> Iterator[tuple[Key, str | None, Element, bool]]:
    """The frame, the person, the skeleton or point, and whether it is out of the picture."""
    for image in root.iter("image"):
        for index, element in enumerate(image):
            if element.tag in ("skeleton", "points"):
                said = element.find("attribute[@name='track_id']")
                who = f"#{index}" if said is None else said.text or f"#{index}"
                yield _name(image), who if _is_person(element) else None, element, False
    for track in root.iter("track"):
        for element in track:
            if element.tag in ("skeleton", "points"):
                if element.tag == "points" and "label" not in element.attrib:
                    element.set("label", track.get("label", ""))
                who = track.get("id", "0") if _is_person(element) else None
                place = element.get("frame", "")
                if not place.isdecimal():
                    raise KeypointError(f"track {who}: expected a frame's number, found {place!r}")
                yield int(place), who, element, element.get("outside") == "1"


def _is_person(element: Element) -> bool:
    """Whether an element is somebody, and not a joint of the only one."""
    return element.tag == "skeleton" or ";" in element.get("points", "")


def _joint(point: Element, name: str, text: str) -> list[float]:
    """u, v and confidence of a point."""
    try:
        u, v = map(float, text.split(","))
    except ValueError:
        raise unexpected(KeypointError, name, "one point, u,v", text) from None
    return [u, v, _HIDDEN if point.get("occluded") == "1" else 1.0]
