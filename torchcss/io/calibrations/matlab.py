"""Calibrations of MATLAB: its `cameraParams` as a structure, and Bouguet's toolbox.

Pixels of MATLAB's own count from 1: `counted_from_one` of `torchcss.io.calibrations.matrices` takes
1 from the principal point. Bouguet's and those in OpenCV's words count from 0. Its older matrices
are by columns, which `square_matrix` turns.

Call `read_matlab`, for a script `read_bouguet`.
"""

from __future__ import annotations

import re
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import CameraError
from torchcss.files import read_bytes, read_text, refusing, unexpected
from torchcss.io.calibrations.content import one_camera
from torchcss.io.calibrations.entry import Entry, entry_of
from torchcss.io.calibrations.mat_elements import MOST_UNPACKED, check_mat_elements
from torchcss.io.calibrations.matrices import has_camera
from torchcss.io.keypoints.words import plain_word

_OPENCV = re.compile("mtx$|cameramatrix$|dist(ortion)?(coef|$)")
"""OpenCV's names of K and of a lens's coefficients."""


def read_matlab(path: Path) -> dict[str, Entry]:
    """MATLAB's camera parameters, of one camera or a pair; or Bouguet's numbers, or OpenCV's.

    Raises:
        CameraError: If it is of version 7.3, damaged, larger than a calibration, or none.
    """
    from scipy.io import loadmat  # takes a second to import

    data = read_bytes(path, CameraError, MOST_UNPACKED)
    if b"HDF" in data[:16] or data.startswith(b"MATLAB 7.3"):
        raise CameraError(f"{path}: of version 7.3; save it with save('-v7')")
    # SciPy raises whatever the damage leads to.
    with refusing(CameraError, f"{path}: cannot be read as MATLAB's"):
        check_mat_elements(data)
        content = loadmat(BytesIO(data), simplify_cells=True)
    values = {key: _listed(each) for key, each in content.items() if not key.startswith("__")}
    for each in [each for each in values.values() if isinstance(each, dict)]:
        pair = {n: each.get(f"CameraParameters{n}") for n in "12"}
        if all(map(has_camera, pair.values())):
            return {
                n: entry_of(each, is_matlab=True) for n, each in pair.items() if each is not None
            }
        values = each if has_camera(each) else values
    # Bouguet's toolbox and OpenCV's words, whose pixels count from 0.
    if {"fc", "fc_left"} & values.keys() or any(map(_OPENCV.match, map(plain_word, values))):
        return one_camera(path, values)
    if not has_camera(values):
        raise unexpected(
            CameraError, f"{path}", "toStruct(cameraParams) or Bouguet's fc and cc", list(values)
        )
    return {path.stem: entry_of(values, is_matlab=True)}


def read_bouguet(path: Path) -> dict[str, Entry]:
    """What Bouguet's toolbox saves as a script: `fc = [ 657.4 ; 657.8 ];`.

    Raises:
        CameraError: If no camera is in it.
    """
    text, lists = re.sub(r"%.*", "", read_text(path, CameraError)), {}
    # A list ends before the next one begins, and no line is looked at twice.
    for name, said in re.findall(r"(?m)^[ \t]*(\w+)[ \t]*=[ \t]*(\[[^][=]*\]|[^;\n]*)", text):
        with suppress(ValueError):  # a word, or a call
            lists[name] = [float(number) for number in re.split(r"[][;,\s]+", said) if number]
    return one_camera(
        path, {name: each if each[1:] else each[0] for name, each in lists.items() if each}
    )


def _listed(value: Any) -> Any:
    """Arrays as lists, in structures too; None for sparse ones, which no calibration has."""
    if isinstance(value, dict):
        return {key: _listed(each) for key, each in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return value if isinstance(value, (str, int, float, complex)) else None
