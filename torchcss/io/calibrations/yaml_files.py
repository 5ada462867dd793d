"""Calibrations in YAML: OpenCV, ROS, Kalibr's chain, and EasyMocap's pair of files.

Call `read_calibration_yaml`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from torchcss.errors import CameraError
from torchcss.files import read_text, refusing, shortened, unexpected
from torchcss.io.calibrations.content import cameras_of
from torchcss.io.calibrations.entry import Entry, entry_of, in_metres
from torchcss.io.calibrations.matrices import as_lists, has_camera

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
"""EasyMocap's files."""

_MOST_BYTES = 2**22
"""Bytes of the largest file; the parser takes seconds and fifty times the room for a million."""

_DEEPEST = 50
"""Brackets in brackets."""


def read_calibration_yaml(path: Path) -> dict[str, Entry]:
    """EasyMocap's pair, Kalibr's chain, or cameras of OpenCV, ROS and others.

    Raises:
        CameraError: If it is no YAML, very large, or holds no calibration.
    """
    is_second = path.name == EXTRINSICS
    content = _load(path.with_name(INTRINSICS) if is_second else path)
    if is_second or "names" in content:
        return _easymocap(path, content)
    chain = {name: each for name, each in content.items() if re.fullmatch(r"cam[0-9]+", name)}
    if chain and all(map(has_camera, chain.values())):
        return _kalibr(path, chain)
    return cameras_of(path, content)


def _kalibr(path: Path, chain: Mapping[str, Mapping[str, Any]]) -> dict[str, Entry]:
    """Cameras whose places are given one from the other; the first is the world."""
    entries: dict[str, Entry] = {}
    pose = np.eye(4)
    for name, values in sorted(chain.items(), key=lambda item: int(item[0][3:])):
        entry = entry_of(values)
        step = values.get("T_cn_cnm1")
        if len(chain) > 1 and (step is not None or not entries):
            with refusing(CameraError, f"{path}: {name}: T_cn_cnm1: not 4 rows of 4 numbers"):
                pose = np.asarray(step, float) @ pose if step is not None else pose
            entry = entry._replace(rotation=pose[:3, :3].tolist(), translation=pose[:3, 3].tolist())
        entries[name] = entry
    return entries


def _easymocap(path: Path, intrinsics: Mapping[str, Any]) -> dict[str, Entry]:
    """EasyMocap's cameras; `path` is either of the two files, which are beside one another."""
    second = path.with_name(EXTRINSICS)
    extrinsics = _load(second) if second.is_file() else {}
    names = intrinsics.get("names")
    if not isinstance(names, list) or not all(isinstance(name, (str, int)) for name in names):
        first = path.with_name(INTRINSICS) if path == second else path
        raise unexpected(CameraError, first, "'names', as EasyMocap writes them", names)
    entries = {}
    for name in map(str, names):
        both, end = [*intrinsics.items(), *extrinsics.items()], f"_{name}"
        own = {key.removesuffix(end): each for key, each in both if key.endswith(end)}
        entries[name] = entry_of({**own, "R": own.get("Rot", own.get("R"))})  # the same as a vector
    return in_metres(entries, is_anipose=False)


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
    channels, columns = re.split("[^0-9]", str(values.get("dt")))[0][:3], values.get("cols")
    if channels and isinstance(columns, int):  # 2f: pairs, as of pixels
        columns *= int(channels)
    matrix = as_lists({**values, "cols": columns})
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


def _load(path: Path) -> dict[str, Any]:
    if len(text := read_text(path, CameraError)) > _MOST_BYTES:
        raise CameraError(f"{path}: more than {_MOST_BYTES:,} bytes; not a calibration")
    if text.startswith("%YAML:1.0"):
        text = text.partition("\n")[2]
    with refusing(CameraError, f"{path}: cannot be read as YAML"):
        # ROS ends a message by ---, and may say it again, but for the header with its time.
        content, again = [*islice(yaml.load_all(text, Loader=_Loader), 2), None, None][:2]
    if not isinstance(content, dict):
        raise CameraError(
            f"{path}: no calibration; expected names, camera_matrix or cam0, found "
            f"{shortened(content)}"
        )
    said = again if isinstance(again, dict) else {}
    if said.keys() - {"header"} and {**said, "header": 0} != {**content, "header": 0}:
        raise CameraError(f"{path}: several cameras, one after the other; give each its own file")
    # ORB-SLAM's have a common word before each.
    return {re.sub(r"^Camera1?\.", "", str(key)): value for key, value in content.items()}
