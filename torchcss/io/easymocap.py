"""Calibrations of EasyMocap: `intri.yml` and `extri.yml`, in the YAML that OpenCV writes.

`names` lists the cameras; `K_NAME`, `dist_NAME` and, in newer files, `H_NAME` and `W_NAME` are in
the one file, `Rot_NAME` (or the rotation vector `R_NAME`) and `T_NAME`, metres, in the other:
world to camera. OpenCV's YAML is almost YAML 1.1: its first line and its matrices are its own.

Call `read_easymocap`; `torchcss.io.cameras.read_camera` does.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from torchcss.errors import CameraError
from torchcss.io.safe_load import one_line, shortened
from torchcss.reading import read_text

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"


class _Loader(yaml.SafeLoader):
    """Plain values and OpenCV's matrices."""


def _matrix(loader: yaml.SafeLoader, node: yaml.Node) -> list[Any]:
    """A matrix as nested lists; one of a single row or column as a list."""
    if not isinstance(node, yaml.MappingNode):
        raise yaml.YAMLError("an opencv-matrix has rows, cols and data")
    values: dict[Any, Any] = loader.construct_mapping(node, deep=True)
    rows, columns, data = values.get("rows"), values.get("cols"), values.get("data")
    if not (isinstance(rows, int) and isinstance(columns, int) and isinstance(data, list)):
        raise yaml.YAMLError("an opencv-matrix has rows, cols and data")
    if rows < 1 or columns < 1 or rows * columns != len(data):
        raise yaml.YAMLError(
            f"line {node.start_mark.line + 1}: an opencv-matrix of {rows} rows and {columns} "
            f"columns has other than as many numbers"
        )
    if 1 in (rows, columns):
        return data
    return [data[row * columns : (row + 1) * columns] for row in range(rows)]


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def read_easymocap(path: Path) -> dict[str, dict[str, Any]]:
    """Read all cameras: `K`, `dist`, `size`, `R`, `T` by name, None for what the files do not have.

    Args:
        path: The folder, or either of the files; the other is looked for beside it.

    Raises:
        CameraError: If a file is missing or malformed.
    """
    folder = path if path.is_dir() else path.parent
    intrinsics = path if path.name != EXTRINSICS and not path.is_dir() else folder / INTRINSICS
    extrinsics = folder / EXTRINSICS
    first = _load(intrinsics)
    second = _load(extrinsics) if extrinsics.is_file() else {}
    names = first.get("names")
    if not isinstance(names, list) or not all(isinstance(name, (str, int)) for name in names):
        raise CameraError(
            f"{intrinsics}: expected 'names', as EasyMocap writes them, found {shortened(names)}"
        )
    cameras: dict[str, dict[str, Any]] = {}
    for name in map(str, names):
        size = [first.get(f"W_{name}"), first.get(f"H_{name}")]
        rotation = second.get(f"Rot_{name}")
        cameras[name] = {
            "K": first.get(f"K_{name}"),
            "dist": first.get(f"dist_{name}", first.get(f"D_{name}")),
            "size": None if None in size else size,
            "R": second.get(f"R_{name}") if rotation is None else rotation,
            "T": second.get(f"T_{name}"),
        }
    return cameras


def _load(path: Path) -> dict[str, Any]:
    text = read_text(path, CameraError)
    if text.startswith("%YAML:1.0"):
        text = text.partition("\n")[2]
    try:
        content = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError, OverflowError) as error:
        raise CameraError(f"{path}: cannot be read as YAML: {one_line(error)}") from error
    if not isinstance(content, dict):
        raise CameraError(f"{path}: not EasyMocap's; expected names, found {shortened(content)}")
    return content
