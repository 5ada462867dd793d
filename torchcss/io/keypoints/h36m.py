"""2D joints in VideoPose3D's archives, `data_2d_h36m_*.npz`: by subject, action and camera.

`positions_2d` is a dictionary of dictionaries of lists of `[T J 2]`, pixels; `metadata` says
`layout_name` and `num_joints`. NumPy stores such things as Python objects. They are read here
without running what they might ask for: only plain containers and arrays of numbers are allowed.

Which of the recordings is meant stands behind the path, `FILE.npz#S9/Walking 1/0`; not needed where
there is only one.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import KeypointError
from torchcss.files import one_line, shortened
from torchcss.io.keypoints.people import People, screened

_LAYOUTS = {"h36m": "H36M-17", "coco": "COCO-17"}
_MOST_BYTES = 2**31

_ALLOWED = {
    ("builtins", "dict"), ("builtins", "list"), ("builtins", "tuple"), ("builtins", "set"),
    ("_codecs", "encode"),
    *((f"numpy.{core}.multiarray", name) for core in ("core", "_core")
      for name in ("_reconstruct", "scalar")),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
    ("numpy", "ndarray"), ("numpy", "dtype"),
}  # fmt: skip
"""What an archive of arrays needs, old NumPy or new."""


class _PlainUnpickler(pickle.Unpickler):
    """Unpickles containers and arrays, and nothing that could run a programme."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        if (module_name, global_name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module_name}.{global_name}")
        return super().find_class(module_name.replace(".core.", "._core."), global_name)


def is_h36m(path: Path) -> bool:
    """Whether a file is such an archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "positions_2d.npy" in archive.namelist()
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return False


def read_h36m(path: Path, selection: str) -> People:
    """Read one recording.

    Args:
        path: The archive.
        selection: `SUBJECT/ACTION/CAMERA`, or empty where there is only one.

    Raises:
        KeypointError: If the archive is damaged, or which recording is meant is not clear; the
            message names those that there are.
    """
    recordings = _object(path, "positions_2d")
    chosen: Any = recordings
    wanted = [part for part in selection.split("/") if part]
    steps: list[str] = []
    for kind in ("subject", "action", "camera"):
        options = _options(path, chosen, kind)
        step = wanted[len(steps)] if len(steps) < len(wanted) else None
        if step is None and len(options) == 1:
            step = next(iter(options))
        if step not in options:
            problem = "say which" if step is None else f"no {kind} {step!r}"
            prefix = "/".join([*steps, kind.upper()])
            raise KeypointError(
                f"{path}: {problem} recording, as {path.name}#{prefix}...; there are: "
                f"{', '.join(options)}"
            )
        steps.append(str(step))
        chosen = options[str(step)]
    if len(wanted) > len(steps):
        raise KeypointError(f"{path}: expected SUBJECT/ACTION/CAMERA, found {selection!r}")
    where = f"{path}: {'/'.join(steps)}"
    try:
        points = np.asarray(chosen, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise KeypointError(f"{where}: expected numbers [frames, joints, 2]") from error
    if points.ndim != 3 or points.shape[2] not in (2, 3) or 0 in points.shape:
        raise KeypointError(
            f"{where}: expected numbers [frames, joints, 2], got {list(points.shape)}"
        )
    places = np.where(np.isfinite(points[..., :2]), points[..., :2], np.nan)
    found = screened(places, points[..., 2] if points.shape[2] == 3 else 1.0)
    report = [f"format: VideoPose3D's archive, {'/'.join(steps)}"]
    return People([[person] for person in found], None, report, _layout(path, points.shape[1]))


def _layout(path: Path, num_joints: int) -> str | None:
    """The layout that the metadata name; None: by the number of joints."""
    try:
        metadata = _object(path, "metadata")
    except KeypointError:
        return None
    name = metadata.get("layout_name") if isinstance(metadata, dict) else None
    layout = _LAYOUTS.get(name) if isinstance(name, str) else None
    return layout if num_joints == 17 else None


def _options(path: Path, value: Any, kind: str) -> dict[str, Any]:
    """What can be chosen at one level, by name; cameras by number."""
    if kind == "camera":
        items = list(value) if isinstance(value, (list, tuple, np.ndarray)) else []
        if isinstance(value, np.ndarray) and value.ndim == 3:
            items = [value]  # one camera, not in a list
        found = {str(index): item for index, item in enumerate(items) if item is not None}
    else:
        found = {str(key): item for key, item in value.items()} if isinstance(value, dict) else {}
    if not found:
        raise KeypointError(
            f"{path}: positions_2d: expected recordings by {kind}, found {shortened(value)}"
        )
    return found


def _object(path: Path, name: str) -> Any:
    """The Python object in an archive."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as stream:
            data = stream.read(_MOST_BYTES)
        source = io.BytesIO(data)
        version = np.lib.format.read_magic(source)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get(version)
        if read_header is None:
            raise ValueError(f"version {version} of NumPy's format")
        shape, _, dtype = read_header(source)
        if not dtype.hasobject or shape != ():
            raise ValueError(f"expected one object, got {dtype} {list(shape)}")
        content = _PlainUnpickler(source, encoding="latin1").load()
    except Exception as error:  # zipfile, pickle and NumPy raise whatever the damage leads to
        raise KeypointError(
            f"{path}: {name}: cannot be read: {one_line(error)}; get a complete copy"
        ) from error
    return content.item() if isinstance(content, np.ndarray) and content.shape == () else content
