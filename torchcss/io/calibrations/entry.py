"""One camera of a calibration file, and what makes it of a mapping in whatever words.

Call `entry_of`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from torchcss.errors import CameraError
from torchcss.files import real_numbers, shortened
from torchcss.io.calibrations.lens import DISTORTION, lens_of
from torchcss.io.calibrations.matrices import (
    K_WORDS,
    POSE_WORDS,
    as_lists,
    counted_from_one,
    matrices_of,
    nested_shape,
)
from torchcss.io.keypoints.words import SIDES, SIZES, first_of, plain_word
from torchcss.io.lenses import Mirror

_INNER = (*K_WORDS, *POSE_WORDS, "projectionparameters", "mirrorparameters")

_SHAPES = ("img_shape", "image_shape", "ImageSize", "shape")
"""What height and width are called where they are given in this order; the third is MATLAB's."""

_SIDES = (*SIDES, ("w", "h"), ("imgw", "imgh"), ("resw", "resh"), ("cols", "rows"), ("nx", "ny"))


class Entry(NamedTuple):
    """One camera of a file, whatever the format; `None` for what the file does not have.

    Attributes:
        K: Intrinsic matrix, its nine numbers, or fx, fy, cx, cy; pixel centres at integers.
        image_size_wh: Width and height.
        distortion: In OpenCV's order; this and the next two in rows, columns or one list.
        rotation: World to camera, a matrix or axis times angle.
        translation: World to camera.
        units: Unit of the world and of pixels.
        video: Name of the video.
        fisheye: What a lens is that follows no pinhole's model: "equidistant" (k1 k2 k3 k4 of
            OpenCV's fisheye lens are its distortion), a `torchcss.io.lenses.Mirror` (before the
            distortion), "inverse", or True of another kind.
        note: What was assumed, for the user.
        name: What the camera calls itself.
        is_picture: It is a camera where one of many pictures was taken, by that picture's name.
    """

    K: Any
    image_size_wh: Any = None
    distortion: Any = None
    rotation: Any = None
    translation: Any = None
    units: Any = "metre"
    video: Any = None
    fisheye: Any = False
    note: str | None = None
    name: Any = None
    is_picture: bool = False

    def standing(self, rotation: np.ndarray, place: Any) -> Entry:
        """The camera at a place of the world, its rotation from the world `[3, 3]`."""
        return self._replace(rotation=rotation.tolist(), translation=(-rotation @ place).tolist())

    @property
    def has_one_place(self) -> bool:
        """Whether it has one rotation, as a matrix or a vector, and one translation."""
        rotation, translation = (np.prod(nested_shape(each)) for each in self[3:5])
        return rotation in (3, 9) and translation == 3


def entry_of(values: Mapping[str, Any], units: Any = "metre", *, is_matlab: bool = False) -> Entry:
    """A camera of a mapping, by whatever words it uses.

    Args:
        values: The numbers of one camera, by name.
        units: Unit of the world, if the camera does not say its own.
        is_matlab: Its pixels count from 1, whatever its words.

    Raises:
        CameraError: If no camera can have such numbers.
    """
    values = {key: None if each == "null" else each for key, each in values.items()}
    inner = [word for word, each in values.items() if _is_inner(word, each)]
    for word in inner:  # a mapping of its own
        values = {**{key: each for key, each in values.items() if key != word}, **values[word]}
    found = matrices_of(values)
    lens, fisheye = lens_of(values)
    if (is_matlab or "RadialDistortion" in values) and not fisheye:
        found = {"K": counted_from_one(found["K"]), "rotation": None, "translation": None}
    if isinstance(fisheye, Mirror):
        most = len(fisheye.parameters)
        if nested_shape(found["K"]) == (4 + most,):
            found["K"] = found["K"][most:]  # Kalibr has all in one
    notes = []
    if turned := first_of(values, ("rotationcount",)):  # Caliscope's
        notes.append(turned_note("rotation_count", turned))
    if nested_shape(lens) == (4, 1) and not fisheye:
        notes.append(
            "its four coefficients stand in a column, as cv2.fisheye writes them, and are taken as "
            'k1 k2 p1 p2: of a fisheye lens say so in a cameras.json, "fisheye": true'
        )
    return Entry(
        **found,
        image_size_wh=_image_size(values),
        distortion=lens,
        units=units if (own := first_of(values, ("units", "unit"))) is None else own,
        video=values.get("video"),
        fisheye=fisheye,
        name=values.get("name"),
        note="; ".join(notes) or None,
    )


def turned_note(word: str, value: object) -> str:
    """What is told of a camera whose file says by a word that its pictures are shown turned."""
    return (
        f"its pictures are shown turned ({word} {shortened(value)}), its numbers are those of the "
        "pictures as recorded: track them as recorded"
    )


def _is_inner(word: str, value: Any) -> bool:
    """Whether intrinsics, extrinsics or coefficients are objects of their own."""
    plain = plain_word(word)
    named = plain in _INNER or bool(DISTORTION.match(plain))
    return named and isinstance(value, Mapping) and "data" not in value


def _image_size(values: Mapping[str, Any]) -> Any:
    """The image size, of height and width or width and height."""
    shape = next((values[word] for word in _SHAPES if isinstance(values.get(word), list)), None)
    if shape is not None:
        return shape[1::-1]
    size = first_of(values, (*SIZES, "size", "imageresolution"))
    if isinstance(size, Mapping):
        values = size
    elif isinstance(size, str):
        return [int(n) if n.isdecimal() else n for n in re.split("[^0-9]+", size)]
    elif size is not None:
        return as_lists(size)
    sizes = ([first_of(values, (side,)) for side in pair] for pair in _SIDES)
    return next((size for size in sizes if None not in size), None)


def in_metres(entries: dict[str, Entry], *, is_anipose: bool) -> dict[str, Entry]:
    """Cameras of a file that says no unit, by how far they stand from the origin.

    Millimetres where they would stand a kilometre away, else as they are, or unknown.
    """
    places: dict[str, np.ndarray] = {}
    for name, entry in entries.items():
        with suppress(CameraError):  # said to whoever wants that camera
            places[name] = real_numbers(entry.translation, name, CameraError).ravel()
    farthest = max((float(np.hypot.reduce(place)) for place in places.values()), default=0.0)
    if farthest >= 1000:
        note = (
            f"its world is taken to be in millimetres: in metres a camera would stand "
            f"{farthest:.0f} m from the origin"
        )
        for name, place in places.items():
            metres = (0.001 * place).tolist()
            entries[name] = entries[name]._replace(translation=metres, note=note)
    elif farthest > (12 if is_anipose else 100):  # centimetres, or a desk in millimetres
        return {name: entry._replace(units=None) for name, entry in entries.items()}
    return entries


def by_pictures(
    entries: Mapping[str, Entry], placed: Mapping[str, Mapping[str, Entry]]
) -> dict[str, Entry]:
    """Cameras, where they stand if they have one place, and their pictures by name.

    Args:
        entries: Cameras by name.
        placed: By a camera's name its pictures by theirs.
    """
    cameras, pictures = dict(entries), {}
    for name, own in placed.items():
        first = next(iter(own.values()))
        if name in cameras and all(each[3:5] == first[3:5] for each in own.values()):
            cameras[name] = first._replace(is_picture=False)
        pictures |= own
    return {**pictures, **cameras}
