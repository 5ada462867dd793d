"""What calibration files say of their cameras, format by format, before anything is checked.

| format | recognised by |
|---|---|
| ours | JSON: `cameras`, by name or in a list, or the cameras by name alone |
| RealSense, Nerfstudio | JSON: `fx` or `fl_x` and the rest, number by number |
| Pose2Sim, Anipose, FreeMoCap, Caliscope | `.toml`: a table for each camera |
| EasyMocap | `intri.yml` with `names`, beside it `extri.yml` |
| OpenCV, ROS | YAML, JSON or XML with `camera_matrix`; `M1`, `D1`, `M2`, `D2` of a pair |
| OpenPose, Metashape | XML with `Intrinsics`, or with `f`, `cx`, `cy` from the middle |
| Kalibr | YAML: `cam0` with `intrinsics` |
| COLMAP | `cameras.txt` or `cameras.bin`, or their folder; `images` beside say places |
| KITTI, ROS | `.txt`: numbers below or behind what they are |
| Qualisys, Vicon | `.qca.txt`, `.xcp` |
| MATLAB | `.mat`: `cameraParams` as a structure; JSON; Bouguet's `fc`, `cc`, `kc`, `.m` too |
| arrays | `.npz`: `mtx`, `dist`, and the like; `.txt`, `.npy`: K or P alone; of several cameras |

Most of them are the same few things in other words (`_WORDS`). COLMAP's principal point counts from
the corner of the image, MATLAB's from 1; both are brought to pixel centres at integers. A 3 x 4
matrix P that projects points of the world is taken apart; matrices by columns are turned. A folder
may hold a file for every camera. Places from which single pictures were taken (COLMAP, Nerfstudio)
are entries by the pictures' names.

Call `read_entries`.
"""

from __future__ import annotations

import json
import re
import struct
import tomllib
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from torchcss.body.files.xml import parse_xml
from torchcss.body.rotations import from_quaternion
from torchcss.errors import CameraError
from torchcss.files import (
    load_array,
    load_arrays,
    load_json,
    naming,
    read_bytes,
    read_text,
    real_numbers,
    refusing,
    shortened,
    unexpected,
)
from torchcss.io.keypoints.json_people import listed
from torchcss.io.keypoints.words import SIDES, SIZES, first_of, plain_word
from torchcss.io.lenses import MIRRORS, Mirror
from torchcss.joint_names import names_in

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
_OF_COLMAP = "cameras.txt", "cameras.bin"


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


_WORDS = {
    "K": names_in(
        "k matrix cameramatrix cammatrix camatrix mtx cammtx cameramtx kmatrix intrinsicmatrix "
        "intrinsicsmatrix m kmx intrinsic intrinsics cameraintrinsic cameraintrinsics "
        "cameraintrinsicmatrix calibrationmatrix"
    ),
    "rotation": names_in("r rotation rot rvec rotationmatrix rotationvector"),
    "translation": names_in("t translation tvec translationvector"),
    "focal": names_in("focallength focal fc f"),
    "centre": names_in("principalpoint center centre cc c"),
    "radial": names_in("radialdistortion radial rdistort k"),
    "tangential": names_in("tangentialdistortion tangential tdistort p"),
}  # fmt: skip
"""What a camera's numbers are called (`torchcss.io.keypoints.words`), the first that is there."""

_PROJECTIONS = names_in("p projectionmatrix pmatrix projmat projection proj")
_POSES = names_in("extrinsic extrinsics extrinsicmatrix extrinsicsmatrix rt w2c worldtocamera")
"""What all numbers together are called, and rotation and translation."""

_DISTORTION = re.compile("(lens)?dist(?!ance)|(d|kc|coeffs|coefficients|dvec)$")
"""How the name of a lens's coefficients begins, or all of it."""

_ONE_BY_ONE = (
    ("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"), ("mu", "mv", "u0", "v0"),
    ("gamma1", "gamma2", "u0", "v0"), ("fl_x", "fl_y", "cx", "cy"),
)  # fmt: skip
"""What the numbers of K are called where each has a name; the last are Nerfstudio's."""

_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_NAMED = {*_COEFFICIENTS}

_SHAPES = ("img_shape", "image_shape", "ImageSize", "shape")
"""What height and width are called where they are given in this order; the third is MATLAB's."""

_SIDES = (*SIDES, ("w", "h"), ("imgw", "imgh"), ("resw", "resh"), ("cols", "rows"), ("nx", "ny"))
_NAMES = names_in("name cameraname cameraid camid id serial serialnumber")
_MODELS = names_in(
    "distortionmodel cameramodel modeltype model cameratype distortiontype lensmodel lens lenstype "
    "projection type"
)
_IS_FISHEYE = names_in("fisheye isfisheye usefisheye fisheyemodel")
_IS_OTHER = names_in("mappingcoefficients xi")
_FISHEYE = re.compile("equi|fish_?eye|kannala|^kb[48]?$", re.IGNORECASE)
_OTHER = re.compile(
    "omni|ucm|fov|theta|prism_fish|scaramuzza|ocam|mei$|double|^ds$|^ds-|-ds$|division",
    re.IGNORECASE,
)
"""Models of lenses that are OpenCV's fisheye lens, and others that see as much."""

_MIRRORS = {
    "eucm": re.compile("ucm", re.IGNORECASE),
    "ds": re.compile("double|^ds$|^ds-|-ds$", re.IGNORECASE),
    "omni": re.compile("omni|mei$", re.IGNORECASE),
}
"""Models by which of `torchcss.io.lenses` they are."""

_ROUNDING = 1e-3
"""Skew that is taken for rounding, in focal lengths."""

_INVERSE = re.compile("inverse", re.IGNORECASE)
"""RealSense's model whose coefficients undo the distortion."""

_OPENCV = re.compile("mtx$|cameramatrix$|dist(ortion)?(coef|$)")
"""OpenCV's names of K and of a lens's coefficients."""

_NUMBERS = re.compile(r"[-+0-9.eE\s]+")

_FISHEYE_NUMBERS = re.compile("fish_?eye_?(param|model|coeff)", re.IGNORECASE)

_MOST_BYTES = 2**26
"""Bytes of the largest calibration, unpacked; MATLAB's hold the pictures' corners too."""

_MOST_YAML = 2**22
"""Bytes of one in YAML, whose parser takes seconds and fifty times the room for a million."""

_DEEPEST = 50
"""Brackets in brackets of a calibration in YAML."""

_BY_HAND = "give K, image_size_wh and distortion in a cameras.json, or COLMAP's cameras.txt"
_OTHERS = {
    r"\.(sfm|abc)$": f"Meshroom's; {_BY_HAND}",
    r"\.(pickle|pkl|p)$": "a pickle, from which code may run: not read; save K, dist, R and t with "
    "numpy.savez",
    "Camera-system parameters": "Kalibr's report; give the camchain.yaml beside it",
    r"<document[^>]*>\s*<chunk": "Metashape's cameras of a project; save each camera's calibration "
    "as Agisoft's XML (Tools, Camera Calibration)",
    "capturingreality|^#? ?name,x,y,": f"RealityCapture's; {_BY_HAND}",
    "sfm_data_version": f"openMVG's; {_BY_HAND}",
    '"projection_type"[^}]*"focal': f"OpenSfM's; {_BY_HAND} (opensfm export_colmap)",
    "^# Bundle file": f"Bundler's; {_BY_HAND}",
    r"camera matrix K \[3x3\]": f"Pix4D's; {_BY_HAND}",
}
"""Files of other kinds by how their names end, or by what they begin with, and what to do."""

_DLT = 11
"""Coefficients of a camera in the direct linear transformation."""

_KINDS_OF_VICON = names_in("TYPE DISPLAY_TYPE SYSTEM")
"""Where it says whether a camera films or sees markers alone."""

_MOST_OFF = 1.0
"""Pixels by which Vicon's distortion, as ours, may be off in a corner."""

_COLMAP = {
    "SIMPLE_PINHOLE": "f cx cy", "PINHOLE": "fl_x fl_y cx cy", "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2", "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4", "RADIAL_FISHEYE": "f cx cy k1 k2",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
}  # fmt: skip
"""The parameters of COLMAP's camera models, in the words of Nerfstudio, which counts from the same
corner; f is both focal lengths."""

_COLMAP_MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
)  # fmt: skip
"""The models by their number in a binary file, and how many parameters each has."""


def read_entries(path: Path) -> dict[str, Entry]:
    """The cameras of a calibration file by name.

    Raises:
        CameraError: If the file is missing, damaged or none of the formats.
    """
    if path.is_dir():
        return _read_folder(path)
    said = read_bytes(path, CameraError, 2048).decode(errors="replace")
    for pattern, what in _OTHERS.items():
        if re.search(pattern, path.name.lower() if "$" in pattern else said):
            raise CameraError(f"{path}: {what}")
    if path.name.lower().endswith(".qca.txt"):
        return _read_qualisys(path)
    with naming(path, CameraError):
        return _READERS.get(path.suffix.lower(), _read_json)(path)


def _read_folder(path: Path) -> dict[str, Entry]:
    """The cameras of a program's folder, or of a file for each of them."""
    places = [path / n for n in (INTRINSICS, *_OF_COLMAP)]
    places += [path / inner / n for inner in ("sparse/0", "0", "sparse") for n in _OF_COLMAP]
    files = [place for place in places if place.is_file()][:1]
    kinds = iter((".xml", ".toml", ".yaml", ".yml", ".json", ".npz", ".npy", ".txt", ".xcp"))
    while not files and (suffix := next(kinds, None)) is not None:
        files = [file for file in sorted(path.iterdir()) if file.suffix.lower() == suffix]
    if not files:
        names = ", ".join((INTRINSICS, *_OF_COLMAP))
        raise CameraError(
            f"{path}: no calibration in this folder; expected {names} or a file for every camera"
        )
    if len(files) > 1 and files[0].suffix.lower() == ".npy":  # an array each
        with naming(path, CameraError):
            arrays = {file.stem: load_array(file, CameraError).tolist() for file in files}
            return _read_content(path, arrays)
    found: dict[str, Entry] = {}
    for file in files:
        for name, entry in read_entries(file).items():
            # Some programs call every camera the same.
            found[name if name not in found else f"{file.stem}/{name}"] = entry
    return found


# The same things in other words.


def _entry(values: Mapping[str, Any], units: Any = "metre", *, is_matlab: bool = False) -> Entry:
    """A camera of a mapping, by whatever words it uses."""
    values = {key: None if each == "null" else each for key, each in values.items()}
    inner = [word for word, each in values.items() if _is_inner(word, each)]
    for word in inner:  # a mapping of its own
        values = {**{key: each for key, each in values.items() if key != word}, **values[word]}
    found = {n: _plain(first_of(values, _WORDS[n])) for n in ("K", "rotation", "translation")}
    if found["rotation"] is None and (pose := _square(first_of(values, _POSES), 4)) is not None:
        found |= {"rotation": pose[:3, :3].tolist(), "translation": pose[:3, 3].tolist()}
    if (K := _square(found["K"], 3)) is not None:
        found["K"] = K.tolist()
    elif (numbers := _one_by_one(values)) is not None:
        found["K"] = numbers
    if (projection := _projection(values)) is not None:
        parts = _parts_of(projection)
        # Of K with a column of zeros the place is not known.
        found |= parts if projection[:, 3].any() else {"K": parts["K"]}
    models = [str(first_of(values, (word,))) for word in _MODELS]
    fisheye = _fisheye(values, models)
    if (is_matlab or "RadialDistortion" in values) and not fisheye:
        found = {"K": _from_one(found["K"]), "rotation": None, "translation": None}
    lens, size, video = _lens(values, fisheye), _said_size(values), values.get("video")
    if isinstance(fisheye, Mirror) and _shape(found["K"]) == (4 + len(fisheye.parameters),):
        found["K"] = found["K"][len(fisheye.parameters) :]  # Kalibr has all in one
    if any(map(_INVERSE.search, models)) and np.any(np.array(lens, dtype=object)):
        fisheye = "inverse"
    notes = []
    if turned := first_of(values, ("rotationcount",)):  # Caliscope's
        notes.append(
            f"its pictures are shown turned (rotation_count {shortened(turned)}), its numbers are "
            "those of the pictures as recorded: track them as recorded"
        )
    if _shape(lens) == (4, 1) and not fisheye:
        notes.append(
            "its four coefficients stand in a column, as cv2.fisheye writes them, and are taken as "
            'k1 k2 p1 p2: of a fisheye lens say so in a cameras.json, "fisheye": true'
        )
    return Entry(
        **found,
        image_size_wh=size,
        distortion=lens,
        units=units if (own := first_of(values, ("units", "unit"))) is None else own,
        video=video,
        fisheye=fisheye,
        name=values.get("name"),
        note="; ".join(notes) or None,
    )


def _fisheye(values: Mapping[str, Any], models: Sequence[str]) -> bool | str | Mirror:
    """Which lens that follows no pinhole's model: see `Entry`."""
    if (mirror := _mirror(values, models)) is not None:
        return mirror
    said = [str(first_of(values, words)).lower() for words in (_IS_FISHEYE, _IS_OTHER)]
    is_fisheye, is_other = (word not in ("none", "false", "0", "0.0") for word in said)
    if is_other or any(map(_OTHER.search, models)):
        return True
    return "equidistant" if is_fisheye or any(map(_FISHEYE.search, models)) else False


def _mirror(values: Mapping[str, Any], models: Sequence[str]) -> Mirror | None:
    """A mirror with its numbers; None: it is none, or has none."""
    kind = next((k for k, pattern in _MIRRORS.items() if any(map(pattern.search, models))), "omni")
    ucm = {"beta": 1.0} if any(model.lower() == "ucm" for model in models) else {}
    numbers = [{**ucm, **values}.get(word) for word in MIRRORS[kind]]
    every = first_of(values, _WORDS["K"])
    if None in numbers and _shape(every) == (4 + len(numbers),):
        numbers = listed(every)[: len(numbers)]
    with suppress(CameraError):
        given = [real_numbers(_plain(each), "", CameraError).ravel() for each in numbers]
        if all(each.size == 1 and np.isfinite(each).all() for each in given):
            return Mirror(kind, tuple(float(each[0]) for each in given))
    return None


def _is_inner(word: str, value: Any) -> bool:
    """Whether intrinsics, extrinsics or coefficients are objects of their own."""
    plain = plain_word(word)
    words = (*_WORDS["K"], *_POSES, "projectionparameters", "mirrorparameters")
    named = plain in words or bool(_DISTORTION.match(plain))
    return named and isinstance(value, Mapping) and "data" not in value


def _projection(values: Mapping[str, Any]) -> np.ndarray | None:
    """The 3 x 4 matrix that projects points of the world; None: there is none, or K beside it."""
    given = first_of(values, _WORDS["K"])
    matrix = _square(first_of(values, _PROJECTIONS) if given is None else given, 4)
    return None if matrix is None else matrix[:3]


def _one_by_one(values: Mapping[str, Any]) -> list[Any] | None:
    """fx, fy, cx, cy where each has a name, or focal lengths and principal point have."""
    for names in _ONE_BY_ONE:
        if None not in (numbers := [values.get(each) for each in names]):
            return _from_corner(numbers) if names[0] == "fl_x" else numbers
    focal, centre = (_plain(first_of(values, _WORDS[word])) for word in ("focal", "centre"))
    if isinstance(focal, (int, float)):
        focal = [focal, focal]
    given = isinstance(focal, list) and isinstance(centre, list)
    return [*focal, *centre] if given and len(focal) == len(centre) == 2 else None


def _lens(values: Mapping[str, Any], fisheye: bool | str | Mirror = False) -> Any:
    """The coefficients of the lens in OpenCV's order, or whatever stands in their place."""
    lenses = [
        _plain(each)
        for word, each in values.items()
        if _DISTORTION.match(plain_word(word))
        # Others describe a model.
        and (isinstance(each, (list, dict)) or re.match(r"[\[(]?[-+.\d]", f"{each}"))
    ]
    names = [each for each in lenses if isinstance(each, list) and {*map(str, each)} <= _NAMED]
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
    radial, tangential = (first_of(values, _WORDS[word]) for word in ("radial", "tangential"))
    if len(shape := _shape(radial)) != 1 or not 0 < shape[0] <= 6 or radial is None:
        return None
    k1, k2, *more = [*radial, 0.0, 0.0]
    p1, p2 = tangential if isinstance(tangential, list) and len(tangential) == 2 else (0.0, 0.0)
    return [k1, k2, p1, p2, *more]


def _shape(value: Any) -> tuple[int, ...]:
    """The shape of nested lists; none of what is no array."""
    with suppress(ValueError):
        return np.shape(value)
    return ()


def _square(value: Any, size: int) -> np.ndarray | None:
    """A square matrix given by rows or by columns, or by rows without the last; None: it is none.

    Its last row is 0, ..., 0, 1.
    """
    with suppress(CameraError):
        numbers = real_numbers(_plain(value), "", CameraError).ravel()
        if numbers.size == size * (size - 1) and size == 4:
            return np.vstack([numbers.reshape(3, 4), [0, 0, 0, 1]])
        if numbers.size == size * size:
            matrix = numbers.reshape(size, size)
            by_columns = matrix[-1, :-1].any() and not matrix[:-1, -1].any()
            return matrix.T if by_columns else matrix
    return None


def _parts_of(projection: np.ndarray) -> dict[str, Any]:
    """K, rotation and translation of a 3 x 4 matrix that projects points of the world."""
    with refusing(CameraError, "not a camera's projection matrix"), np.errstate(all="ignore"):
        projection = projection * np.sign(np.linalg.det(projection[:, :3]))
        turn, inverse = np.linalg.qr(np.linalg.inv(projection[:, :3]))
        signs = np.diag(np.sign(np.diag(inverse)))
        inverse = signs @ inverse
        K = np.triu(np.linalg.inv(inverse))
        K /= K[2, 2]
        if abs(K[0, 1]) < _ROUNDING * K[0, 0]:
            K[0, 1] = 0
        rotation, translation = (turn @ signs).T, inverse @ projection[:, 3]
    return {
        "K": K.tolist(), "rotation": rotation.tolist(), "translation": translation.tolist()
    }  # fmt: skip


def _said_size(values: Mapping[str, Any]) -> Any:
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
        return _plain(size)
    sizes = ([first_of(values, (side,)) for side in pair] for pair in _SIDES)
    return next((size for size in sizes if None not in size), None)


def _plain(value: Any) -> Any:
    """A matrix as OpenCV's JSON and ROS have it, as lists."""
    if isinstance(value, dict) and isinstance(value.get("data"), list):
        rows, columns = value.get("rows"), value.get("cols")
        data = value["data"]
        if isinstance(rows, int) and isinstance(columns, int) and rows * columns == len(data):
            return [data[i : i + columns] for i in range(0, len(data), columns)] if columns else []
        if rows is None and columns is None:
            return data
    return value


def _from_corner(numbers: Sequence[Any]) -> list[Any]:
    """fx, fy, cx, cy of pixels that are squares from (0, 0) on, as of such with integer centres."""
    try:
        fx, fy, cx, cy = map(float, numbers)
    except (TypeError, ValueError):
        return list(numbers)  # what is no number is told where the camera is made
    return [fx, fy, cx - 0.5, cy - 0.5]


def _has_camera(values: object) -> bool:
    if not isinstance(values, Mapping):
        return False
    K = first_of(values, (*_WORDS["K"], "projectionparameters"))
    if isinstance(K, Mapping) and "data" not in K:
        return _has_camera(K)
    ways = (_projection(values), _one_by_one(values), first_of(values, ("mappingcoefficients",)))
    return K is not None or any(each is not None for each in ways)


def _stacked(values: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Cameras whose numbers are arrays of all of them."""
    shape = _shape(first_of(values, (*_WORDS["K"], *_PROJECTIONS)))
    count = shape[0] if len(shape) == 3 else 0
    names = listed(first_of(values, names_in("names cameranames cameras ids")))
    each = [
        {
            word: value[i] if len(_shape(value)) > 1 and len(value) == count else value
            for word, value in values.items()
        }
        for i in range(count)
    ]
    return dict(zip(map(str, names if len(names) == count else range(count)), each, strict=True))


def _matrices(values: object) -> dict[str, Mapping[str, Any]]:
    """Cameras that are 3 x 4 matrices by name, with what stands beside them."""
    entries = values.items() if isinstance(values, Mapping) else ()
    rest = {name: each for name, each in entries if _shape(each) != (3, 4)}
    return {str(name): {**rest, "P": each} for name, each in entries if name not in rest}


def _cameras_in(values: object, depth: int = 4) -> dict[str, Mapping[str, Any]]:
    """Cameras by name, whatever stands beside them or, some levels deep, above."""
    if not isinstance(values, Mapping) or not depth:
        return {}
    found = {str(name): each for name, each in values.items() if _has_camera(each)}
    for name, each in found.items():
        if _FISHEYE_NUMBERS.match(name):
            found[name] = {**each, "fisheye": True}
    for name, each in values.items():
        if str(name) not in found:
            below = _cameras_in(each, depth - 1).items()
            found |= {f"{name}/{n}" if n in found else n: camera for n, camera in below}
    return found


def _numbered(values: object) -> dict[str, dict[str, Any]]:
    """Cameras whose number or side ends the names of their numbers, as in `M1`, `distL`."""
    found: dict[str, dict[str, Any]] = {}
    for key, value in values.items() if isinstance(values, Mapping) else ():
        if match := re.fullmatch(
            r"([A-Za-z]\w*?)_?([0-9]+|[LRlr]|(?<=_)left|(?<=_)right)", str(key)
        ):
            found.setdefault(match[2], {})[match[1]] = value
    # Beside K projections are of the rectified pictures; Bouguet's have focal lengths.
    for words in (_WORDS["K"], _PROJECTIONS, _WORDS["focal"]):
        named = [n for n, own in found.items() if isinstance(first_of(own, words), (list, dict))]
        if named:
            return {n: {**values, **found[n]} for n in named}  # type: ignore[dict-item]
    return {}


def _is_one_place(entry: Entry) -> bool:
    """Whether these are one rotation, as a matrix or a vector, and one translation."""
    rotation, translation = (np.prod(_shape(each)) for each in entry[3:5])
    return rotation in (3, 9) and translation == 3


def _alone(path: Path, values: Mapping[str, Any]) -> dict[str, Entry]:
    """The one camera of a file, or a numbered pair; the board's places are not the camera's."""
    cameras: Mapping[str, Mapping[str, Any]] = _numbered(values)
    if not cameras and not _has_camera(values):
        raise unexpected(CameraError, path, "a calibration with camera_matrix", list(values))
    alone = str(values.get("camera_name", values.get("name", path.stem)))
    entries: dict[str, Entry] = {}
    for name, own in (cameras or {alone: values}).items():
        entry = _entry(own, first_of(values, ("units", "unit")))
        # A pair's R and T lead from one to the other; several are those of the board.
        is_place = _projection(own) is not None or (not cameras and _is_one_place(entry))
        entries[name] = entry if is_place else entry._replace(rotation=None, translation=None)
    return entries


# Formats.


def _read_json(path: Path) -> dict[str, Entry]:
    content = load_json(path, CameraError)
    return _read_content(path, {"cameras": content} if isinstance(content, list) else content)


def _read_content(path: Path, content: Any, units: Any = None) -> dict[str, Entry]:
    """The only camera of a file, or cameras by name or in a list; their unit if none is said."""
    if not isinstance(content, dict):
        raise unexpected(CameraError, path, "an object 'cameras' with one under each name", content)
    frames = listed(content.get("frames"))
    if pictures := [each for each in frames if isinstance(each, dict) and _OF_NERF in each]:
        return _nerf_entries(path, content, pictures)
    cameras = _stacked(content) or first_of(content, ("cameras",))
    if cameras is None and (_has_camera(content) or _numbered(content)):
        return _alone(path, content)
    if isinstance(cameras, list) and all(isinstance(each, dict) for each in cameras):
        names = [str(first_of({**each, "#": n}, (*_NAMES, "#"))) for n, each in enumerate(cameras)]
        if len(set(names)) < len(names):
            raise CameraError(f"{path}: two cameras of one name among {', '.join(names)}")
        cameras = dict(zip(names, cameras, strict=True))
    # Others are not calibrated.
    inside = content if cameras is None else cameras
    cameras = _cameras_in(inside) or _matrices(inside) or cameras
    if not isinstance(cameras, dict):
        if {"keypoints", "annotations", "people"} & content.keys():
            raise CameraError(f"{path}: keypoints, not a calibration; give them with --keypoints")
        known = "'names' (EasyMocap), camera_matrix (OpenCV, ROS), cam0 (Kalibr) or cameras by name"
        raise unexpected(CameraError, path, known, list(content))
    for name, values in cameras.items():
        if not isinstance(values, Mapping):
            raise unexpected(CameraError, f"{path}: camera {name!r}", "an object", values)
    said = first_of(content, ("units", "unit"))
    return {
        str(name): _entry(each, units if said is None else said) for name, each in cameras.items()
    }


_OF_NERF = "transform_matrix"
"""Where a picture was taken, camera to world, with OpenGL's axes: y up, z backwards."""


def _nerf_entries(
    path: Path, content: Mapping[str, Any], pictures: Sequence[Mapping[str, Any]]
) -> dict[str, Entry]:
    """Nerfstudio's camera and pictures, each of which may have numbers of its own."""
    rest = {word: each for word, each in content.items() if word != "frames"}
    cameras = _alone(path, rest) if _has_camera(rest) else {}
    own: dict[str, Entry] = {}
    for index, picture in enumerate(pictures):
        name = str(picture.get("file_path", index))
        pose = _square(picture[_OF_NERF], 4)
        if pose is None or not _has_camera({**rest, **picture}):
            raise CameraError(
                f"{path}: {name}: expected fl_x, fl_y, cx, cy and a {_OF_NERF} of 4 x 4 numbers"
            )
        R = np.diag([1.0, -1.0, -1.0]) @ pose[:3, :3].T
        own[name] = _entry({**rest, **picture}, rest.get("units"))._replace(
            rotation=R.tolist(), translation=(-R @ pose[:3, 3]).tolist(), is_picture=True
        )
    return _by_pictures(cameras, dict.fromkeys(cameras, own) or {"": own})


def _read_toml(path: Path) -> dict[str, Entry]:
    """Pose2Sim's metres, Caliscope's, or Anipose's unit, which is that of the board."""
    text = read_text(path, CameraError)
    with refusing(CameraError, f"{path}: cannot be read as TOML"):
        content = tomllib.loads(text)
    entries: dict[str, Entry] = {}
    for table, entry in _read_content(path, content, "metre").items():
        name = table if entry.name is None else entry.name
        if not isinstance(name, str) or name in entries:
            raise unexpected(CameraError, f"{path}: table {table!r}", "a name of its own", name)
        entries[name] = entry
    metadata = content.get("metadata", {})
    if isinstance(metadata, dict) and "units" in metadata:
        units = metadata["units"]
        return {name: entry._replace(units=units) for name, entry in entries.items()}
    if any(entry.units != "metre" for entry in entries.values()):
        return entries  # which say their own
    return _in_metres(entries, "metadata" in content)


def _in_metres(entries: dict[str, Entry], is_anipose: bool) -> dict[str, Entry]:
    """Millimetres where the cameras would stand a kilometre away, else as they are, or unknown."""
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


def _read_text(path: Path) -> dict[str, Entry]:
    """COLMAP's cameras, a matrix alone, or numbers below or behind what they are (ROS, KITTI)."""
    text = read_text(path, CameraError)
    lines = {
        f"{path}: line {number}": line.strip(" \t,;[]")
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    }
    found: dict[str, list[float]] = {}
    word = ""
    for line in lines.values():
        if match := re.fullmatch(r"([A-Za-z]\w*+(?: \w++)*+)?+:?([-+0-9.eE\s,;]*)", line):
            word = match[1] or word
            with suppress(ValueError):
                numbers = map(float, re.split(r"[\s,;]+", match[2].strip(" \t,;")))
                found.setdefault(word, []).extend(numbers)
    values: dict[str, Any] = {w: n[0] if len(n) == 1 else n for w, n in found.items()}
    if len(found) == 1 and len(*found.values()) in (9, 12):
        values = {"K": next(iter(found.values()))}
    if _has_camera(values) or _numbered(values):
        return _alone(path, values)
    rows = {w: re.split(r"[\s,;]+", line) for w, line in lines.items()}
    if not any(re.search("[A-Z]{3}", row[1]) for row in rows.values() if len(row) > 3):
        what = f"found {len(rows)} rows such as {shortened(next(iter(lines.values()), ''))}"
        numbers = re.fullmatch(r"[-+0-9.eE\s,;]+", "".join(lines.values()))
        if numbers and _DLT in (len(rows), *map(len, rows.values())):
            what = "it looks like the 11 coefficients of a DLT, which tell of no image size"
        known = "K, P (3 x 4), numbers below their names (KITTI) or COLMAP's cameras"
        raise CameraError(f"{path}: expected {known}; {what}; {_BY_HAND}")
    return _with_places(path, _colmap_entries(rows), _said_unit(text))


def _colmap_entries(rows: Mapping[str, Sequence[str]]) -> dict[str, Entry]:
    """COLMAP's cameras, of the words of its text by where they stand."""
    entries: dict[str, Entry] = {}
    for where, row in rows.items():
        model = row[1] if len(row) > 1 else ""
        try:
            size, values = [int(each) for each in row[2:4]], [float(each) for each in row[4:]]
        except ValueError:
            size = values = []
        names = _COLMAP.get(model, "").split()
        if not names and ("FISHEYE" in model or model == "FOV"):  # the other cameras are read
            entries[row[0]] = Entry([], size, fisheye=True)
            continue
        if not names or len(values) != len(names) or len(size) != 2:
            raise CameraError(
                f"{where}: expected COLMAP's camera, CAMERA_ID MODEL WIDTH HEIGHT and the "
                f"parameters of {', '.join(_COLMAP)} (of others colmap image_undistorter makes "
                f"straight pictures); found {shortened(' '.join(row))}"
            )
        given = dict(zip(names, values, strict=True))
        focal = {word: given["f"] for word in ("fl_x", "fl_y") if "f" in given}
        entries[row[0]] = _entry({**given, **focal, "image_size_wh": size, "model": model})
    return entries


def _read_binary(path: Path) -> dict[str, Entry]:
    """COLMAP's binary file, by the words that its text has."""
    data, at = read_bytes(path, CameraError), 8
    rows: dict[str, list[str]] = {}
    with refusing(CameraError, f"{path}: expected COLMAP's cameras.bin"):
        (count,) = struct.unpack_from("<Q", data)
        for _ in range(count):
            number, model, *size = struct.unpack_from("<iiQQ", data, at)
            if not 0 <= model < len(_COLMAP_MODELS):
                raise CameraError(
                    f"{path}: camera {number} has COLMAP's model {model}, which is not read; "
                    "undistort the pictures by colmap image_undistorter"
                )
            name, length = _COLMAP_MODELS[model]
            values = struct.unpack_from(f"<{length}d", data, at + 24)
            words = [str(number), name, *map(str, size), *map(repr, values)]
            rows[f"{path}: camera {number}"] = words
            at += 24 + 8 * length
    return _with_places(path, _colmap_entries(rows), None)


def _said_unit(text: str) -> Any:
    """The unit that a comment says, `# units: mm` or metres per unit: COLMAP has no word for it."""
    if (match := re.search(r"(?im)^#\s*units?\s*[:=]\s*(\S+)", text)) is None:
        return None
    with suppress(ValueError):
        return float(match[1])
    return match[1]


def _with_places(path: Path, entries: dict[str, Entry], unit: Any) -> dict[str, Entry]:
    """COLMAP's cameras with their pictures: places of `images.txt` or `images.bin` beside.

    A camera that took all its pictures from one place stands there.
    """
    beside = [path.with_name(f"images{suffix}") for suffix in (path.suffix, ".bin", ".txt")]
    images = next((each for each in beside if each.exists()), None)
    if images is None:
        return entries
    if images.suffix == ".bin":
        found = _binary_images(images)
    else:
        text = read_text(images, CameraError)
        unit = _said_unit(text) if unit is None else unit
        # The lines between are of points: numbers alone.
        rows = [line.split(maxsplit=9) for line in text.splitlines() if line.strip()[:1] != "#"]
        found = [row for row in rows if len(row) == 10 and not _NUMBERS.fullmatch(row[9])]
    placed: dict[str, dict[str, Entry]] = {}
    for row in found:
        with refusing(CameraError, f"{images}: picture {shortened(row[0])}: not COLMAP's"):
            *pose, camera, picture = row[1:]
            numbers = real_numbers([*map(float, pose)], picture, CameraError)
            R = from_quaternion(numbers[:4] / np.linalg.norm(numbers[:4]))
            placed.setdefault(str(camera), {})[str(picture)] = entries[str(camera)]._replace(
                rotation=R.tolist(),
                translation=numbers[4:7].tolist(),
                units=unit,
                is_picture=True,
                note=None if unit is None else "its world need not have an axis upwards (COLMAP)",
            )
    return _by_pictures(entries, placed)


def _by_pictures(
    entries: Mapping[str, Entry], placed: Mapping[str, Mapping[str, Entry]]
) -> dict[str, Entry]:
    """Cameras, where they stand if they have one place, and their pictures by name."""
    cameras, pictures = dict(entries), {}
    for name, own in placed.items():
        first = next(iter(own.values()))
        if name in cameras and all(each[3:5] == first[3:5] for each in own.values()):
            cameras[name] = first._replace(is_picture=False)
        pictures |= own
    return {**pictures, **cameras}


def _binary_images(path: Path) -> list[list[Any]]:
    """The rows of COLMAP's binary images, as its text has them."""
    data, at = read_bytes(path, CameraError), 8
    rows: list[list[Any]] = []
    with refusing(CameraError, f"{path}: expected COLMAP's images.bin"):
        (count,) = struct.unpack_from("<Q", data)
        for _ in range(count):
            number, *pose, camera = struct.unpack_from("<I7dI", data, at)
            end = data.index(0, at + 64)
            name = data[at + 64 : end].decode()
            rows.append([number, *pose, camera, name])
            (points,) = struct.unpack_from("<Q", data, end + 1)
            at = end + 9 + 24 * points
    return rows


def _read_yaml(path: Path) -> dict[str, Entry]:
    """EasyMocap's pair, Kalibr's chain, or one camera of OpenCV or ROS."""
    content = _load(path)
    if path.name == EXTRINSICS or "names" in content:
        return _read_easymocap(path)
    chain = {name: each for name, each in content.items() if re.fullmatch(r"cam[0-9]+", name)}
    if chain and all(map(_has_camera, chain.values())):
        return _kalibr(path, chain)
    return _read_content(path, content)


def _kalibr(path: Path, chain: Mapping[str, Mapping[str, Any]]) -> dict[str, Entry]:
    """Cameras whose places are given one from the other; the first is the world."""
    entries: dict[str, Entry] = {}
    pose = np.eye(4)
    for name, values in sorted(chain.items(), key=lambda item: int(item[0][3:])):
        entry = _entry(values)
        step = values.get("T_cn_cnm1")
        if len(chain) > 1 and (step is not None or not entries):
            with refusing(CameraError, f"{path}: {name}: T_cn_cnm1: not 4 rows of 4 numbers"):
                pose = np.asarray(step, float) @ pose if step is not None else pose
            entry = entry._replace(rotation=pose[:3, :3].tolist(), translation=pose[:3, 3].tolist())
        entries[name] = entry
    return entries


def _read_easymocap(path: Path) -> dict[str, Entry]:
    """EasyMocap's cameras: `path` is either file; the other is beside it."""
    intrinsics = path if path.name != EXTRINSICS else path.parent / INTRINSICS
    extrinsics = path.parent / EXTRINSICS
    first = _load(intrinsics)
    second = _load(extrinsics) if extrinsics.is_file() else {}
    names = first.get("names")
    if not isinstance(names, list) or not all(isinstance(name, (str, int)) for name in names):
        raise unexpected(CameraError, intrinsics, "'names', as EasyMocap writes them", names)
    entries = {}
    for name in map(str, names):
        both, end = [*first.items(), *second.items()], f"_{name}"
        own = {key.removesuffix(end): each for key, each in both if key.endswith(end)}
        entries[name] = _entry({**own, "R": own.get("Rot", own.get("R"))})  # the same as a vector
    return _in_metres(entries, is_anipose=False)


def _read_matlab(path: Path) -> dict[str, Entry]:
    """MATLAB's camera parameters; its pixels count from 1, and old matrices are transposed."""
    from scipy.io import loadmat  # takes a second to import

    data = read_bytes(path, CameraError, 128)
    if b"HDF" in data[:16] or data.startswith(b"MATLAB 7.3"):
        raise CameraError(f"{path}: of version 7.3; save it with save('-v7')")
    _check_matlab_size(path)
    # SciPy raises whatever the damage leads to.
    with refusing(CameraError, f"{path}: cannot be read as MATLAB's"):
        content = loadmat(path, simplify_cells=True)
    values = {key: _listed(each) for key, each in content.items() if not key.startswith("__")}
    for each in [each for each in values.values() if isinstance(each, dict)]:
        pair = {n: each.get(f"CameraParameters{n}") for n in "12"}
        if all(map(_has_camera, pair.values())):
            return {n: _entry(each, is_matlab=True) for n, each in pair.items() if each is not None}
        values = each if _has_camera(each) else values
    # Bouguet's toolbox and OpenCV's words, whose pixels count from 0.
    if {"fc", "fc_left"} & values.keys() or any(map(_OPENCV.match, map(plain_word, values))):
        return _alone(path, values)
    if not _has_camera(values):
        raise unexpected(
            CameraError, f"{path}", "toStruct(cameraParams) or Bouguet's fc and cc", list(values)
        )
    return {path.stem: _entry(values, is_matlab=True)}


def _read_bouguet(path: Path) -> dict[str, Entry]:
    """What Bouguet's toolbox saves as a script: `fc = [ 657.4 ; 657.8 ];`."""
    text, lists = re.sub(r"%.*", "", read_text(path, CameraError)), {}
    # A list ends before the next one begins, and no line is looked at twice.
    for name, said in re.findall(r"(?m)^[ \t]*(\w+)[ \t]*=[ \t]*(\[[^][=]*\]|[^;\n]*)", text):
        with suppress(ValueError):  # a word, or a call
            lists[name] = [float(number) for number in re.split(r"[][;,\s]+", said) if number]
    return _alone(
        path, {name: each if each[1:] else each[0] for name, each in lists.items() if each}
    )


def _check_matlab_size(path: Path) -> None:
    """Refuse a file that unpacks to more than a calibration, before any of it is unpacked."""
    data, at, total = read_bytes(path, CameraError), 128, 0
    order = ">" if data[126:128] == b"MI" else "<"
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        packed, at = data[at + 8 : at + 8 + size], at + 8 + size
        if kind == 15:
            with refusing(CameraError, f"{path}: damaged", advice="get a complete copy"):
                packed = zlib.decompressobj().decompress(packed, _MOST_BYTES)
        total += len(packed)
        if total >= _MOST_BYTES:
            raise CameraError(f"{path}: more than {_MOST_BYTES:,} bytes; not a calibration")


def _from_one(K: Any) -> list[Any]:
    """MATLAB's intrinsic matrix, or fx, fy, cx, cy, with pixels that count from 0."""
    with refusing(CameraError, "expected cameraParams"):
        K = real_numbers(K, "K", CameraError)
        K = K - (0, 0, 1, 1) if K.shape == (4,) else K - [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
    return K.tolist()


def _listed(value: Any) -> Any:
    """Arrays as lists, in structures too."""
    if isinstance(value, dict):
        return {key: _listed(each) for key, each in value.items()}
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def _read_xml(path: Path) -> dict[str, Entry]:
    """What OpenCV and OpenPose store as XML."""
    root = parse_xml(path, "OpenCV's XML", CameraError)
    found: dict[str, Any] = {}
    for element in root:
        parts = {part.tag: (part.text or "").split() for part in element}
        try:
            if parts.get("data"):
                sides = {side: int(parts[side][0]) for side in ("rows", "cols") if side in parts}
                data = [float(word) for word in parts["data"]]
                found[element.tag] = _plain({**sides, "data": data})
            else:
                found[element.tag] = json.loads((element.text or "").strip() or "null")
        except (ValueError, IndexError):
            found[element.tag] = (element.text or "").strip()
    return _alone(path, _from_the_middle(found) if root.tag == "calibration" else found)


def _from_the_middle(found: Mapping[str, Any]) -> dict[str, Any]:
    """Metashape's numbers in OpenCV's words: it has p2 before p1, and a middle where we have 0."""
    words = names_in("f cx cy b1 b2 k1 k2 k3 k4 p1 p2 width height")
    f, cx, cy, b1, b2, k1, k2, k3, k4, p2, p1, width, height = (found.get(w) or 0 for w in words)
    with refusing(CameraError, "not Metashape's calibration"):
        K = [[f + b1, b2, cx + 0.5 * (width - 1)], [0, f, cy + 0.5 * (height - 1)], [0, 0, 1]]
    return {"K": K, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3, "k4": k4,
            "image_size_wh": [width, height], "projection": found.get("projection")}  # fmt: skip


def _read_qualisys(path: Path) -> dict[str, Entry]:
    """Cameras of QTM by serial number, of its video cameras if it has some.

    It counts 64ths of pixels of the whole sensor and millimetres, and a camera's y is up, its z
    backwards (as Pose2Sim converts it). The coefficients are not in 64ths.
    """
    cameras = parse_xml(path, "Qualisys' XML", CameraError).findall("cameras/camera")
    films = [each for each in cameras if "video" in each.get("model", "").lower()]
    entries: dict[str, Entry] = {}
    for camera in films or cameras:
        name = camera.get("serial", str(len(entries)))
        with refusing(CameraError, f"{path}: camera {name!r}: not Qualisys'"):
            parts = {part.tag: part.attrib for part in camera}
            lens, place, shown = parts["intrinsic"], parts["transform"], parts.get("fov_video")
            if shown is None:
                left = top = 0.0
                size = [(float(lens[f"sensorMax{axis}"]) + 1) / 64 for axis in "UV"]
            else:
                left, top, right, bottom = (
                    float(shown[side]) for side in names_in("left top right bottom")
                )
                size = [right - left + 1, bottom - top + 1]
            fx, fy, cx, cy = (
                float(lens[f"{word}{axis}"]) / 64
                for word in ("focalLength", "centerPoint")
                for axis in "UV"
            )
            words = names_in("radialDistortion1 radialDistortion2 tangentalDistortion1 "
                             "tangentalDistortion2 radialDistortion3")  # fmt: skip
            R = np.array([float(place[f"r{i}{j}"]) for i in "123" for j in "123"]).reshape(3, 3)
            R = np.diag([1.0, -1.0, -1.0]) @ R
            t = -R @ [float(place[axis]) for axis in "xyz"]
            turned = camera.get("viewrotation", "0")
            entries[name] = Entry(
                [fx, fy, cx - left, cy - top],
                size,
                [float(lens.get(word, 0)) for word in words],
                R.tolist(),
                t.tolist(),
                "mm",
                note=None
                if float(turned) == 0
                else f"its pictures are shown turned (viewrotation {shortened(turned)}), its "
                "numbers are those of the pictures as recorded: track them as recorded",
            )
    if not entries:
        raise CameraError(
            f"{path}: the calibration of a motion capture system; save it as Pose2Sim's Calib.toml"
        )
    return entries


def _read_vicon(path: Path) -> dict[str, Entry]:
    """Vicon's cameras by device number, of its video cameras if it has some.

    It has millimetres; a camera's axes are ours, its orientation `x y z w` turns the world's into
    them, its position is in the world.
    """
    cameras = parse_xml(path, "Vicon's XML", CameraError).findall("Camera")
    found = [each for each in cameras if each.find("KeyFrames/KeyFrame") is not None]
    kinds = [" ".join(each.get(word, "") for word in _KINDS_OF_VICON).lower() for each in found]
    films = [each for each, kind in zip(found, kinds, strict=True) if re.search("video|vue", kind)]
    entries: dict[str, Entry] = {}
    for camera in films or found:
        name = camera.get("DEVICEID", str(len(entries)))
        frame = camera.find("KeyFrames/KeyFrame")
        assert frame is not None
        with refusing(CameraError, f"{path}: camera {name!r}: not Vicon's"):
            size, centre, place, turn = (
                np.array([float(number) for number in given.attrib[word].split()])
                for given, word in (
                    (camera, "SENSOR_SIZE"), (frame, "PRINCIPAL_POINT"), (frame, "POSITION"),
                    (frame, "ORIENTATION"),
                )
            )  # fmt: skip
            fx = float(frame.attrib["FOCAL_LENGTH"])
            focal = np.array([fx, fx / float(camera.get("PIXEL_ASPECT_RATIO", 1))])
            R = from_quaternion(turn[[3, 0, 1, 2]] / np.linalg.norm(turn))
            lens = _vicon_lens(frame.attrib, focal, centre, size)
            t = (-R @ place).tolist()
            K = [*focal.tolist(), *centre.tolist()]
            entries[name] = Entry(K, size.tolist(), lens, R.tolist(), t, "mm")
    if not entries:
        raise CameraError(f"{path}: no camera of these is calibrated; calibrate in Vicon's program")
    return entries


def _vicon_lens(
    frame: Mapping[str, str], focal: np.ndarray, centre: np.ndarray, size: np.ndarray
) -> list[float]:
    """Vicon's polynomial, which undoes a distortion, as the coefficients that make it.

    In pixels from its middle a point at d is straight at `d (1 + k1 d^2 + k2 d^4 + k3 d^6)`.
    """
    given = frame.get("VICON_RADIAL2", "").split()[1:]
    middle, undoing = given[:2] or centre, given[2:] or frame.get("VICON_RADIAL", "0").split()
    middle, undoing = (np.array([*map(float, numbers)]) for numbers in (middle, undoing))
    steps = (np.linspace(0.0, side - 1, 41) for side in size)
    seen = np.stack(np.meshgrid(*steps), -1).reshape(-1, 2)
    away = seen - middle
    r2 = (away * away).sum(-1, keepdims=True)
    straight = middle + away * (1 + sum(k * r2 ** (n + 1) for n, k in enumerate(undoing)))
    a, b = np.moveaxis((straight - centre) / focal, -1, 0)
    r2 = a * a + b * b
    columns = [
        [a * r2, b * r2], [a * r2**2, b * r2**2], [2 * a * b, r2 + 2 * b * b],
        [r2 + 2 * a * a, 2 * a * b], [a * r2**3, b * r2**3],
    ]  # fmt: skip
    made = np.stack([np.stack(each, -1) for each in columns], -1) * focal[:, None]
    lens = np.linalg.lstsq(made.reshape(-1, 5), (seen - straight).reshape(-1), rcond=None)[0]
    off = float(np.abs(made @ lens - (seen - straight)).max())
    if off > _MOST_OFF:
        raise CameraError(f"its distortion is no lens's that is known ({off:.1f} pixels off)")
    return lens.tolist()


def _read_arrays(path: Path) -> dict[str, Entry]:
    """Arrays by the usual words, or K or P alone."""
    if path.suffix.lower() == ".npy":
        return _read_content(path, {"K": load_array(path, CameraError).tolist()})
    arrays = load_arrays(path, CameraError, _MOST_BYTES)
    return _read_content(path, {name: array.tolist() for name, array in arrays.items()})


# YAML.


class _Loader(yaml.SafeLoader):
    """Plain values and OpenCV's matrices; names such as 01 stay text, and nothing is repeated."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Refuse aliases, by which a small file becomes a huge one."""
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it repeats parts of itself by aliases; write them out")
        return super().compose_node(parent, index)

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:
        """Refuse brackets in brackets without end, which take long to read."""
        if self.flow_level > _DEEPEST:
            raise yaml.YAMLError(f"brackets nested more than {_DEEPEST} deep")
        super().fetch_flow_collection_start(TokenClass)


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> list[Any]:
    """A matrix as nested lists."""
    values = loader.construct_mapping(node, deep=True) if isinstance(node, yaml.MappingNode) else {}
    channels, columns = re.match("[0-9]{0,3}", str(values.get("dt"))), values.get("cols")
    if channels and channels[0] and isinstance(columns, int):  # 2f: pairs, as of pixels
        columns *= int(channels[0])
    matrix = _plain({**values, "cols": columns})
    if not isinstance(matrix, list):
        raise yaml.YAMLError(
            f"line {node.start_mark.line + 1}: an opencv-matrix of {values.get('rows')} rows and "
            f"{values.get('cols')} columns needs as many numbers as data"
        )
    return matrix


def _whole(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int | str:
    is_text = re.fullmatch(r"0[0-9]+", node.value)
    return node.value if is_text else yaml.SafeLoader.construct_yaml_int(loader, node)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+(\.\d*)?[eE][-+]?\d+|\.\d+([eE][-+]?\d+)?|\d+\.\d*)$"),
    list("-+.0123456789"),
)  # 1e-05 and -.5, which YAML's first version took for text
_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)
_Loader.add_constructor("tag:yaml.org,2002:opencv-nd-matrix", _matrix)  # OpenCV 5: of one axis
_Loader.add_constructor("tag:yaml.org,2002:int", _whole)


def _camera_of(document: object) -> dict[str, Any]:
    """What a document says of a camera, but for when."""
    whole = document if isinstance(document, dict) else {}
    return {str(key): value for key, value in whole.items() if key != "header"}


def _load(path: Path) -> dict[str, Any]:
    if len(text := read_text(path, CameraError)) > _MOST_YAML:
        raise CameraError(f"{path}: more than {_MOST_YAML:,} bytes; not a calibration")
    if text.startswith("%YAML:1.0"):
        text = text.partition("\n")[2]
    with refusing(CameraError, f"{path}: cannot be read as YAML"):
        # ROS ends a message by ---, and may say it again under another time.
        content, *others = [*islice(yaml.load_all(text, Loader=_Loader), 2)] or [None]
    if not isinstance(content, dict):
        raise CameraError(
            f"{path}: no calibration; expected names, camera_matrix or cam0, found "
            f"{shortened(content)}"
        )
    if any(_camera_of(each) not in ({}, _camera_of(content)) for each in others):
        raise CameraError(f"{path}: several cameras, one after the other; give each its own file")
    # ORB-SLAM's have a common word before each.
    return {re.sub(r"^Camera1?\.", "", str(key)): value for key, value in content.items()}


_READERS = {
    **dict.fromkeys((".yml", ".yaml"), _read_yaml),
    **dict.fromkeys((".txt", ".csv", ".ini"), _read_text),
    **dict.fromkeys((".npy", ".npz"), _read_arrays),
    **{".bin": _read_binary, ".mat": _read_matlab, ".toml": _read_toml, ".xml": _read_xml},
    **{".xcp": _read_vicon, ".m": _read_bouguet},
}
"""By the suffix; everything else is JSON."""
