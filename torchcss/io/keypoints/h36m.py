"""2D joints in VideoPose3D's archives, `data_2d_*.npz`: by subject, action and camera.

`positions_2d` is a dictionary of dictionaries of lists of `[T J 2]`, pixels; `metadata` says
`layout_name` and `num_joints`. Which of the recordings is meant stands behind the path,
`FILE.npz#S9/Walking 1/0`; not needed where there is only one. The detections of one video, of which
such archives are made, have `boxes` and `keypoints`: per frame and class `[P 4 J]`, x, y, logit,
probability.

NumPy stores such things as Python objects. They are read here without running what they might ask
for: only plain containers and arrays of numbers are allowed.
"""

from __future__ import annotations

import io
import math
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import array_header, refusing, unexpected
from torchcss.io.keypoints.people import Frames, People, Person, screened
from torchcss.joint_names import names_in

_LAYOUTS = {
    ("h36m", 17): "H36M-17", ("h36m", 16): "H36M-16", ("coco", 17): "COCO-17",
    ("mpii", 16): "MPII-16", ("humaneva15", 15): "HumanEva-15", ("humaneva", 15): "HumanEva-15",
}  # fmt: skip
_MOST_BYTES = 2**30

_ALLOWED = names_in(
    "builtins.dict builtins.list builtins.tuple builtins.set _codecs.encode numpy.ndarray "
    "numpy.dtype numpy.core.multiarray._reconstruct numpy._core.multiarray._reconstruct "
    "numpy.core.multiarray.scalar numpy._core.multiarray.scalar numpy.core.numeric._frombuffer "
    "numpy._core.numeric._frombuffer"
)
"""What an archive of arrays needs, old NumPy or new."""


class _Array(np.ndarray):
    """An array that a pickle fills; NumPy does not count the objects in the list that it reads."""

    def __setstate__(self, state: Any, /) -> None:
        shape, dtype, _, data = state[-4:]
        counted = min(shape, default=0) >= 0 and len(data) == math.prod(shape)
        if dtype.kind not in "biufcSUO" or (dtype.kind == "O" and not counted):
            raise pickle.UnpicklingError(f"it has no numbers or objects {shape} of {dtype}")
        super().__setstate__(state)


def _empty(_kind: object, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array that what follows in the pickle fills; NumPy begins with none of any size."""
    if shape != (0,):
        raise pickle.UnpicklingError(f"it asks for room for {shape} numbers")
    return _Array(shape, np.dtype(dtype))


_EMPTY = {"ndarray": None, "_reconstruct": _empty}
"""What stands for NumPy's own, which would take memory for any shape."""


class PlainUnpickler(pickle.Unpickler):
    """Unpickles containers and arrays, and nothing that could run a programme."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        """Return what the data asks for, if it is harmless."""
        if f"{module_name}.{global_name}" not in _ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module_name}.{global_name}")
        if global_name in _EMPTY:
            return _EMPTY[global_name]
        found = super().find_class(module_name.replace(".core.", "._core."), global_name)
        if global_name == "_frombuffer":
            return lambda *given: found(*given).view(_Array)
        return found


def is_h36m(path: Path) -> bool:
    """Whether a file is such an archive."""
    names = _names(path)
    detected = {"boxes.npy", "keypoints.npy", "metadata.npy"}
    return "positions_2d.npy" in names or detected <= names


def _names(path: Path) -> set[str]:
    """What is in an archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            return set(archive.namelist())
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return set()


def read_h36m(path: Path, selection: str) -> People:
    """Read one recording.

    Args:
        path: The archive.
        selection: `SUBJECT/ACTION/CAMERA`, or empty where there is only one.

    Raises:
        KeypointError: If the archive is damaged, or which recording is meant is not clear; the
            message names those that there are.
    """
    if "positions_2d.npy" not in _names(path):
        return _read_detections(path)
    chosen: Any = _object(path, "positions_2d")
    rest, steps = selection, []
    for kind in ("subject", "action", "camera"):
        options = _options(chosen, kind)
        # Names may hold slashes themselves.
        fitting = [name for name in options if f"{rest}/".startswith(f"{name}/")]
        step = max(fitting, key=len, default=None)
        if not rest and len(options) == 1:
            step = next(iter(options))
        if step is None:
            problem = "say which" if not rest else f"no {kind} {rest.split('/')[0]!r}"
            prefix = "/".join([*steps, kind.upper()])
            raise KeypointError(
                f"{problem} recording, as {path.name}#{prefix}...; there are: {', '.join(options)}"
            )
        rest = rest[len(step) + 1 :] if rest else ""
        steps.append(step)
        chosen = options[step]
    if rest:
        raise KeypointError(f"expected SUBJECT/ACTION/CAMERA, found {selection!r}")
    where = "/".join(steps)
    points = _numbers(chosen)
    if points.ndim != 3 or points.shape[2] not in (2, 3) or 0 in points.shape:
        raise KeypointError(
            f"{where}: expected numbers [frames, joints, 2], got {list(points.shape)}"
        )
    places = np.where(np.isfinite(points[..., :2]), points[..., :2], np.nan)
    found = screened(places, points[..., 2] if points.shape[2] == 3 else None)
    report = [f"format: VideoPose3D's archive, {'/'.join(steps)}"]
    metadata = _metadata(path)
    layout = _LAYOUTS.get((str(metadata.get("layout_name")), points.shape[1]))
    sizes = metadata.get("video_metadata")
    size = _size(sizes.get(steps[0]) if isinstance(sizes, dict) else None)
    frames: Frames = {index: [Person(person)] for index, person in enumerate(found)}
    return People(frames, None, report, layout, in_order=True, size_wh=size)


def _read_detections(path: Path) -> People:
    """Read what a detector found in one video, the people of every frame."""
    entries = np.asarray(_object(path, "keypoints"), dtype=object)
    frames: Frames = {}
    for index, entry in enumerate(entries):
        person = entry[-1] if isinstance(entry, (list, np.ndarray)) and len(entry) else ()
        found = _numbers(person)
        if found.size and (found.ndim != 3 or found.shape[1] not in (3, 4)):
            raise KeypointError(
                f"frame {index}: expected numbers [people, 4, joints], got {list(found.shape)}"
            )
        rows = found.swapaxes(1, 2)[..., [0, 1, -1]] if found.size else ()
        frames[index] = [Person(joints) for joints in rows]
    size = _size(_metadata(path))
    report = ["format: VideoPose3D's detections"]
    return People(frames, None, report, in_order=True, size_wh=size)


def _numbers(value: Any) -> np.ndarray:
    """An array of numbers; of what is none, or ragged, one of a shape that nobody expects."""
    try:
        return np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError):
        return np.zeros(1)


def _metadata(path: Path) -> dict[str, Any]:
    """What an archive says of itself, if anything."""
    try:
        metadata = _object(path, "metadata")
    except KeypointError:
        return {}
    return metadata if isinstance(metadata, dict) else {}


def _size(entry: object) -> tuple[float, float] | None:
    """Width and height of a video, where they are said."""
    found = [entry.get(key) for key in ("w", "h")] if isinstance(entry, dict) else [None]
    if not all(isinstance(side, (int, np.integer)) and side > 0 for side in found):
        return None
    return float(found[0]), float(found[1])  # type: ignore[arg-type]


def _options(value: Any, kind: str) -> dict[str, Any]:
    """What can be chosen at one level, by name; cameras by number."""
    if kind == "camera":
        items = list(value) if isinstance(value, (list, tuple, np.ndarray)) else []
        if isinstance(value, np.ndarray) and value.ndim == 3:
            items = [value]  # one camera, not in a list
        found = {str(index): item for index, item in enumerate(items) if item is not None}
    else:
        found = {str(key): item for key, item in value.items()} if isinstance(value, dict) else {}
    if not found:
        raise unexpected(KeypointError, "positions_2d", f"recordings by {kind}", value)
    return found


def _object(path: Path, name: str) -> Any:
    """The Python object in an archive."""
    # zipfile, pickle and NumPy raise whatever the damage leads to.
    with refusing(KeypointError, f"{name}: cannot be read", advice="get a complete copy"):
        with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as stream:
            source = io.BytesIO(stream.read(_MOST_BYTES))
        header = array_header(source)
        if header is None or not header[1].hasobject:
            raise ValueError(f"expected objects, got {header}")
        content = PlainUnpickler(source, encoding="latin1").load()
    return content.item() if isinstance(content, np.ndarray) and content.shape == () else content
