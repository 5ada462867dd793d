"""2D joints in HDF5: SLEAP's analysis files, and DeepLabCut's, which are pandas' tables.

Pandas keeps the columns' names as Python objects; they are read without running what they might ask
for (`torchcss.io.keypoints.h36m`). Links into other files are not followed. Needs h5py, the extra
`[hdf5]`.

Call `read_hdf5`.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from torchcss.errors import KeypointError, optional_package
from torchcss.files import read_bytes, refusing
from torchcss.io.keypoints.arrays import read_arrays
from torchcss.io.keypoints.h36m import PlainUnpickler
from torchcss.io.keypoints.people import People
from torchcss.io.keypoints.tables import people_of_rows

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_MOST_NUMBERS = 2**26

_SLEAP_ADVICE = (
    "export it from SLEAP as 'Analysis HDF5' or 'Analysis CSV' (sleap-convert --format analysis)"
)
_DLC_ADVICE = "save it as CSV (save_as_csv=True, or deeplabcut.analyze_videos_converth5_to_csv)"


def read_hdf5(path: Path) -> People:
    """Read SLEAP's analysis file or DeepLabCut's table.

    Raises:
        KeypointError: If it is neither, or damaged; the message says what to export.
        MissingExtraError: If h5py is not installed.
    """
    is_sleap = path.suffix.lower() == ".slp" or ".analysis." in path.name.lower()
    advice = _SLEAP_ADVICE if is_sleap else f"{_DLC_ADVICE}; or {_SLEAP_ADVICE}"
    if read_bytes(path, KeypointError, 8) != _SIGNATURE:
        raise KeypointError(f"{path}: not an HDF5 file; {advice}")
    if path.suffix.lower() == ".slp":
        raise KeypointError(f"{path}: SLEAP's project or predictions; {advice}")
    h5py = optional_package(
        "h5py",
        f"{path}: HDF5 is read by h5py; install it: pip install 'torchcss[hdf5]', or {advice}",
    )
    # h5py and pickle raise whatever the damage leads to.
    damaged = refusing(KeypointError, f"{path}: cannot be read as HDF5", advice=advice)
    with damaged, h5py.File(path, "r") as file:
        if "tracks" in file and "node_names" in file:
            return _read_sleap(path, file)
        group = next((each for each in file.values() if hasattr(each, "keys")), None)
        if group is not None and ("table" in group or "block0_values" in group):
            return _read_pandas(path, group)
    raise KeypointError(f"{path}: neither SLEAP's analysis nor DeepLabCut's table; {advice}")


def _array(path: Path, dataset: Any) -> np.ndarray:
    """A dataset's numbers, if they are of a size that a file of joints has."""
    if dataset.is_virtual or dataset.external or Path(dataset.file.filename) != path:
        raise KeypointError(f"{path}: {dataset.name}: lies in another file; copy it into this one")
    if dataset.size > _MOST_NUMBERS:
        raise KeypointError(f"{path}: {dataset.name}: {dataset.size:,} numbers; not joints")
    return np.asarray(dataset[()])


def _texts(path: Path, dataset: Any) -> list[str]:
    return [
        each.decode() if isinstance(each, bytes) else str(each)
        for each in _array(path, dataset).ravel().tolist()
    ]


def _read_sleap(path: Path, file: Any) -> People:
    """Read `tracks [people, 2, joints, frames]` and its scores, or SLEAP-IO's with frames first."""
    names = _texts(path, file["node_names"])
    points = _array(path, file["tracks"]).astype(np.float64)
    is_turned = points.ndim == 4 and points.shape[2:] == (len(names), 2)
    if is_turned:
        points = points.transpose(1, 3, 2, 0)
    if points.ndim != 4 or points.shape[1:3] != (2, len(names)):
        raise KeypointError(
            f"{path}: tracks: expected numbers [tracks, 2, {len(names)}, frames], got "
            f"{list(points.shape)}"
        )
    points = points.transpose(3, 0, 2, 1)
    # From the video's first frame to the last one with somebody.
    arrays = {"keypoints": points, "joint_names": np.array(names), "frame": np.arange(len(points))}
    if "point_scores" in file:
        scores = _array(path, file["point_scores"]).astype(np.float64)
        scores = scores if is_turned else scores.transpose(2, 0, 1)
        arrays["scores"] = np.where(np.isfinite(points).all(-1), scores, 0.0)
    tracks = _texts(path, file["track_names"]) if "track_names" in file else []
    if len(tracks) == points.shape[1]:
        arrays["person_ids"] = np.array(tracks)
    report = [f"format: SLEAP's analysis, {len(points[0])} tracks"]
    return read_arrays(path, arrays)._replace(report=report, first=0)


def _read_pandas(path: Path, group: Any) -> People:
    """Read a table whose columns are scorer, maybe individual, body part and kind of number."""
    if "table" in group:
        table = _array(path, group["table"])
        columns = _unpickled(group.attrs["non_index_axes"])[0][1]
        names = [name for name in table.dtype.names or () if name.startswith("values_block")]
        several = len(names) > 1
        items = [_unpickled(group["table"].attrs[f"{name}_kind"]) for name in names if several]
        values = _in_order(columns, [table[name] for name in names], items)
        index = table["index"].tolist()
    else:
        values, columns = _blocks(path, group), _levels(path, group, "axis0")
        # Of labelled pictures the last level is the name.
        pictures = [row[-1] for row in _levels(path, group, "axis1")]
        index = pictures or _array(path, group["axis1"]).tolist()
    # As the rows of its CSV.
    columns = [column if isinstance(column, tuple) else (column,) for column in columns]
    levels = [*zip(*(map(str, column) for column in columns), strict=True)]
    levels = levels[1:] if len(levels) > 2 else levels  # without the scorer
    titles = ("individuals", "bodyparts", "coords")[-len(levels) :] if len(levels) > 1 else ("",)
    heads = [[title, *level] for title, level in zip(titles, levels, strict=True)]
    keys = [key.decode() if isinstance(key, bytes) else f"{key}" for key in index]
    rows = [[key, *map(repr, row)] for key, row in zip(keys, values.tolist(), strict=True)]
    return people_of_rows([*enumerate([*heads, *rows], start=1)])


def _unpickled(text: Any) -> Any:
    """A Python object of plain containers, texts and numbers."""
    return PlainUnpickler(io.BytesIO(bytes(text)), encoding="latin1").load()


def _blocks(path: Path, group: Any) -> np.ndarray:
    """The numbers of all columns."""
    keys = sorted(key for key in group if key.endswith("_values"))
    several = len(keys) > 1
    items = [_levels(path, group, key.replace("values", "items")) for key in keys if several]
    columns = _levels(path, group, "axis0")
    return _in_order(columns, [_array(path, group[key]) for key in keys], items)


def _in_order(columns: list[Any], blocks: list[np.ndarray], items: list[list[Any]]) -> np.ndarray:
    """Columns that stand in a block for every kind of number, `items` naming those of each."""
    if not items:
        return blocks[0]
    values = np.full((len(blocks[0]), len(columns)), np.nan)
    for block, names in zip(blocks, items, strict=True):
        values[:, [columns.index(name) for name in names]] = block
    return values


def _levels(path: Path, group: Any, axis: str) -> list[tuple[str, ...]]:
    """The names along an axis that has one level or several; none where it only counts."""
    if axis in group:
        dataset = group[axis]
        return [(text,) for text in _texts(path, dataset)] if dataset.dtype.kind in "SO" else []
    levels = sorted(key for key in group if key.startswith(f"{axis}_level"))
    labels = (_array(path, group[key.replace("level", "label")]) for key in levels)
    texts = (np.array(_texts(path, group[key])) for key in levels)
    return [*zip(*(t[label] for t, label in zip(texts, labels, strict=True)), strict=True)]
