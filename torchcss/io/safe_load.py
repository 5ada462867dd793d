"""Reading files that somebody else wrote, JSON and NumPy archives, with one error.

Nothing in such a file is executed (NumPy's pickled objects are refused) and whatever is wrong with
it ends in the error class that the caller names, in one line.

Call `load_json` and `load_arrays`; `real_numbers` turns a piece of JSON into an array.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import TorchcssError
from torchcss.reading import one_line, read_bytes, shortened

__all__ = ["load_array", "load_arrays", "load_json", "one_line", "real_numbers", "shortened"]


def load_json(path: Path, error_class: type[TorchcssError]) -> Any:
    """Return the content of a JSON file.

    Raises:
        error_class: If the file is missing, empty, unreadable or not JSON.
    """
    data = read_bytes(path, error_class)
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise error_class(f"{path}: not a JSON file: {one_line(error)}") from error


def load_arrays(path: Path, error_class: type[TorchcssError]) -> Mapping[str, np.ndarray]:
    """Return all arrays of an NPZ file, in memory.

    Raises:
        error_class: If the file is missing, damaged, no NPZ file, or holds pickled objects.
    """
    if not read_bytes(path, error_class, 4).startswith(b"PK"):
        raise error_class(f"{path}: not an NPZ file; expected what numpy.savez writes")
    try:
        # The stream is ours: NumPy does not close its own where the archive turns out damaged.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:  # zipfile, zlib and NumPy raise a dozen kinds for damaged archives
        reason = (
            "it holds pickled objects, which could run a programme; save plain arrays"
            if "pickle" in str(error)
            else f"{one_line(error)}; get a complete copy"
        )
        raise error_class(f"{path}: cannot be read as an NPZ file: {reason}") from error


def load_array(path: Path, error_class: type[TorchcssError]) -> np.ndarray:
    """Return the array of an NPY file.

    Raises:
        error_class: If the file is missing, damaged, no NPY file, or holds pickled objects.
    """
    if not read_bytes(path, error_class, 6).startswith(b"\x93NUMPY"):
        raise error_class(f"{path}: not an NPY file; expected what numpy.save writes")
    try:
        with path.open("rb") as stream:
            return np.load(stream, allow_pickle=False)
    except Exception as error:  # what a damaged header leads to
        raise error_class(f"{path}: cannot be read as an NPY file: {one_line(error)}") from error


def real_numbers(value: object, where: str, error_class: type[TorchcssError]) -> np.ndarray:
    """Return nested lists of numbers as a float64 array.

    Args:
        value: What JSON or TOML gave.
        where: The place in the file, for the message.
        error_class: What to raise.

    Raises:
        error_class: If it is ragged or holds anything but numbers.
    """
    try:
        if _only_numbers(value):
            return np.asarray(value, dtype=np.float64)
    except (ValueError, TypeError, OverflowError, RecursionError):
        pass  # ragged, beyond the range of float64, or nested without end
    raise error_class(f"{where}: expected numbers, found {shortened(value)}")


def _only_numbers(value: object) -> bool:
    if isinstance(value, list):
        return all(_only_numbers(entry) for entry in value)
    return isinstance(value, (int, float)) and not isinstance(value, bool)
