"""What a mapping of a calibration file says of a lens: which model, and its coefficients.

Call `lens_of`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from torchcss.errors import CameraError
from torchcss.files import real_numbers
from torchcss.io.calibrations.matrices import K_WORDS, as_lists, nested_shape
from torchcss.io.keypoints.json_people import listed
from torchcss.io.keypoints.words import first_of, plain_word
from torchcss.io.lenses import MIRRORS, Mirror
from torchcss.joint_names import names_in

DISTORTION = re.compile("(lens)?dist(?!ance)|(d|kc|coeffs|coefficients|dvec)$")
"""How the name of a lens's coefficients begins, or all of it."""

_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_RADIAL = names_in("radialdistortion radial rdistort k")
_TANGENTIAL = names_in("tangentialdistortion tangential tdistort p")

_MODELS = names_in(
    "distortionmodel cameramodel modeltype model cameratype distortiontype lensmodel lens lenstype "
    "projection type"
)
_IS_FISHEYE = names_in("fisheye isfisheye usefisheye fisheyemodel")
_IS_OTHER = names_in("mappingcoefficients xi")

_MIRRORS = {"eucm": "ucm", "ds": "double|^ds$|^ds-|-ds$", "omni": "omni|mei$"}
"""Models by which of `torchcss.io.lenses` they are."""

_FISHEYE = "equi|fish_?eye|kannala|^kb[48]?$"
_OTHER = "|".join((*_MIRRORS.values(), "fov|theta|prism_fish|scaramuzza|ocam|division"))
"""Models of lenses that are OpenCV's fisheye lens, and others that see as much."""


def lens_of(values: Mapping[str, Any]) -> tuple[Any, bool | str | Mirror]:
    """Coefficients in OpenCV's order, or what stands in their place, and `Entry.fisheye`."""
    models = "\n".join(str(first_of(values, (word,))) for word in _MODELS).lower()
    fisheye = _fisheye(values, models)
    coefficients = _coefficients(values, fisheye)
    # RealSense's inverse model undoes the distortion.
    is_inverse = "inverse" in models and np.any(np.array(coefficients, dtype=object))
    return coefficients, "inverse" if is_inverse else fisheye


def _fisheye(values: Mapping[str, Any], models: str) -> bool | str | Mirror:
    """Which lens that follows no pinhole's model, out of its models' names, one a line."""
    if (mirror := _mirror(values, models)) is not None:
        return mirror
    said = [str(first_of(values, words)).lower() for words in (_IS_FISHEYE, _IS_OTHER)]
    is_fisheye, is_other = (word not in ("none", "false", "0", "0.0") for word in said)
    if is_other or _names(models, _OTHER):
        return True
    return "equidistant" if is_fisheye or _names(models, _FISHEYE) else False


def _names(models: str, pattern: str) -> bool:
    return re.search(pattern, models, re.MULTILINE) is not None


def _mirror(values: Mapping[str, Any], models: str) -> Mirror | None:
    """A mirror with its numbers; None: it is none, or has none."""
    kind = next((kind for kind, pattern in _MIRRORS.items() if _names(models, pattern)), "omni")
    ucm = {"beta": 1.0} if _names(models, "^ucm$") else {}
    numbers = [{**ucm, **values}.get(word) for word in MIRRORS[kind]]
    every = first_of(values, K_WORDS)
    if None in numbers and nested_shape(every) == (4 + len(numbers),):
        numbers = listed(every)[: len(numbers)]
    with suppress(CameraError):
        given = [real_numbers(as_lists(each), "", CameraError).ravel() for each in numbers]
        if all(each.size == 1 and np.isfinite(each).all() for each in given):
            return Mirror(kind, tuple(float(each[0]) for each in given))
    return None


def _coefficients(values: Mapping[str, Any], fisheye: bool | str | Mirror) -> Any:
    """The coefficients of the lens in OpenCV's order, or whatever stands in their place."""
    lenses = [
        as_lists(each)
        for word, each in values.items()
        if DISTORTION.match(plain_word(word))
        # Others describe a model.
        and (isinstance(each, (list, dict)) or re.match(r"[\[(]?[-+.\d]", f"{each}"))
    ]
    names = [
        each for each in lenses if isinstance(each, list) and {*map(str, each)} <= {*_COEFFICIENTS}
    ]
    lens = next((each for each in lenses if each not in names), None)
    if names and isinstance(lens, list) and len(names[0]) == len(lens):
        values, lens = {**values, **dict(zip(names[0], lens, strict=True))}, None
    if lens is not None:
        return lens
    if any(each in values for each in _COEFFICIENTS):
        if fisheye == "equidistant" and not any(values.get(each) for each in ("p1", "p2")):
            first = 1 if "k1" in values or "mu" not in values else 2  # camodocal's first is k2
            return [values.get(f"k{first + n}", 0.0) for n in range(4)]
        if values.get("k4") and not fisheye and not {"k5", "k6"} & values.keys():
            raise CameraError(
                "k4 without k5 and k6 is that of the radius to the eighth power (Metashape, "
                "Nerfstudio), which no lens of OpenCV has: calibrate again without it, or track "
                "pictures that the program has undistorted"
            )
        return [values.get(each, 0.0) for each in _COEFFICIENTS]
    radial, tangential = (first_of(values, words) for words in (_RADIAL, _TANGENTIAL))
    if not isinstance(radial, list) or nested_shape(radial) not in [(n,) for n in range(1, 7)]:
        return None
    k1, k2, *more = [*radial, 0.0, 0.0]
    p1, p2 = tangential if isinstance(tangential, list) and len(tangential) == 2 else (0.0, 0.0)
    return [k1, k2, p1, p2, *more]
