"""What calibration files say of their cameras, format by format, before anything is checked.

| format | recognised by | module |
|---|---|---|
| ours | JSON: `cameras`, by name or in a list, or the cameras by name alone | `content` |
| RealSense | JSON: `fx` and the rest, number by number | `content` |
| Nerfstudio | JSON: `fl_x`, and `frames` with `transform_matrix` | `content` |
| Pose2Sim, Anipose, FreeMoCap, Caliscope | `.toml`: a table for each camera | `toml_files` |
| EasyMocap | `intri.yml` with `names`, beside it `extri.yml` | `yaml_files` |
| Kalibr | YAML: `cam0` with `intrinsics` | `yaml_files` |
| OpenCV, ROS | YAML, JSON or XML: `camera_matrix`; `M1`, `D1`, `M2`, `D2` of a pair | `content` |
| OpenPose, Metashape | XML: `Intrinsics`, or `f`, `cx`, `cy` from the middle | `xml_files` |
| COLMAP | `cameras.txt`, `cameras.bin`, or their folder; places in `images` beside | `colmap` |
| KITTI, ROS | `.txt`: numbers below or behind what they are | `text` |
| Qualisys, Vicon | `.qca.txt`, `.xcp` | `qualisys`, `vicon` |
| MATLAB | `.mat`: `cameraParams` as a structure; JSON | `matlab`, `entry` |
| Bouguet | `.mat`, `.m`: `fc`, `cc`, `kc` | `matlab` |
| arrays | `.npz`: `mtx`, `dist`, and the like; `.txt`, `.npy`: K or P alone; of several | here |

Most of them are the same few things in other words: those of K, P and places are in `matrices`,
those of lenses in `lens`, those of the image size in `entry`, which makes a camera of them.
COLMAP's principal point counts from the corner of the image, MATLAB's from 1; `matrices` brings
both to pixel centres at integers. A 3 x 4 matrix P that projects points of the world is taken
apart; matrices by columns are turned. A folder may hold a file for every camera. Places from which
single pictures were taken (COLMAP, Nerfstudio) are entries by the pictures' names.

Call `read_entries`.
"""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

from torchcss.errors import CameraError
from torchcss.files import load_array, load_arrays, load_json, naming, read_bytes
from torchcss.io.calibrations.colmap import COLMAP_NAMES, read_colmap
from torchcss.io.calibrations.content import cameras_of
from torchcss.io.calibrations.entry import Entry
from torchcss.io.calibrations.mat_elements import MOST_UNPACKED
from torchcss.io.calibrations.matlab import read_bouguet, read_matlab
from torchcss.io.calibrations.qualisys import read_qualisys
from torchcss.io.calibrations.text import BY_HAND, read_calibration_text
from torchcss.io.calibrations.toml_files import read_calibration_toml
from torchcss.io.calibrations.vicon import read_vicon
from torchcss.io.calibrations.xml_files import read_calibration_xml
from torchcss.io.calibrations.yaml_files import INTRINSICS, read_calibration_yaml

_KINDS = (".xml", ".toml", ".yaml", ".yml", ".json", ".npz", ".npy", ".txt", ".xcp")
"""What a folder of a file for each camera may hold; the first that there is."""

_OTHERS = {
    r"\.(sfm|abc)$": f"Meshroom's; {BY_HAND}",
    r"\.(pickle|pkl|p)$": "a pickle, from which code may run: not read; save K, dist, R and t with "
    "numpy.savez",
    "Camera-system parameters": "Kalibr's report; give the camchain.yaml beside it",
    r"<document[^>]*>\s*<chunk": "Metashape's cameras of a project; save each camera's calibration "
    "as Agisoft's XML (Tools, Camera Calibration)",
    "capturingreality|^#? ?name,x,y,": f"RealityCapture's; {BY_HAND}",
    "sfm_data_version": f"openMVG's; {BY_HAND}",
    '"projection_type"[^}]*"focal': f"OpenSfM's; {BY_HAND} (opensfm export_colmap)",
    "^# Bundle file": f"Bundler's; {BY_HAND}",
    r"camera matrix K \[3x3\]": f"Pix4D's; {BY_HAND}",
}
"""Files of other kinds by how their names end, or by what they begin with, and what to do."""


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
    is_qualisys = path.name.lower().endswith(".qca.txt")
    reader = read_qualisys if is_qualisys else _READERS.get(path.suffix.lower(), _read_json)
    with naming(path, CameraError):
        return reader(path)


def _read_folder(path: Path) -> dict[str, Entry]:
    """The cameras of a program's folder, or of a file for each of them."""
    places = [path / name for name in (INTRINSICS, *COLMAP_NAMES)]
    places += [
        path / inner / name for inner in ("sparse/0", "0", "sparse") for name in COLMAP_NAMES
    ]
    programs = ([place] for place in places if place.is_file())
    kinds = ([f for f in sorted(path.iterdir()) if f.suffix.lower() == kind] for kind in _KINDS)
    files = next(filter(None, chain(programs, kinds)), None)
    if files is None:
        names = ", ".join((INTRINSICS, *COLMAP_NAMES))
        raise CameraError(
            f"{path}: no calibration in this folder; expected {names} or a file for every camera"
        )
    if len(files) > 1 and files[0].suffix.lower() == ".npy":  # an array each
        with naming(path, CameraError):
            arrays = {file.stem: load_array(file, CameraError).tolist() for file in files}
            return cameras_of(path, arrays)
    found: dict[str, Entry] = {}
    for file in files:
        for name, entry in read_entries(file).items():
            # Some programs call every camera the same.
            found[name if name not in found else f"{file.stem}/{name}"] = entry
    return found


def _read_json(path: Path) -> dict[str, Entry]:
    content = load_json(path, CameraError)
    return cameras_of(path, {"cameras": content} if isinstance(content, list) else content)


def _read_arrays(path: Path) -> dict[str, Entry]:
    """Arrays by the usual words, or K or P alone."""
    if path.suffix.lower() == ".npy":
        return cameras_of(path, {"K": load_array(path, CameraError).tolist()})
    arrays = load_arrays(path, CameraError, MOST_UNPACKED)
    return cameras_of(path, {name: array.tolist() for name, array in arrays.items()})


_READERS = {
    **dict.fromkeys((".yml", ".yaml"), read_calibration_yaml),
    **dict.fromkeys((".txt", ".csv", ".ini"), read_calibration_text),
    **dict.fromkeys((".npy", ".npz"), _read_arrays),
    **{".bin": read_colmap, ".mat": read_matlab, ".toml": read_calibration_toml},
    **{".xml": read_calibration_xml, ".xcp": read_vicon, ".m": read_bouguet},
}
"""By the suffix; everything else is JSON."""
