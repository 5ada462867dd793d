"""Calibrations in TOML: Pose2Sim, Anipose, FreeMoCap and Caliscope.

Call `read_calibration_toml`.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

from torchcss.errors import CameraError
from torchcss.files import read_text, refusing, unexpected
from torchcss.io.calibrations.content import cameras_of
from torchcss.io.calibrations.entry import Entry, in_metres


def read_calibration_toml(path: Path) -> dict[str, Entry]:
    """Pose2Sim's metres, Caliscope's, or Anipose's unit, which is that of the board.

    Raises:
        CameraError: If it is no TOML, or two cameras have one name.
    """
    text = read_text(path, CameraError)
    with refusing(CameraError, f"{path}: cannot be read as TOML"):
        content = tomllib.loads(text)
    entries: dict[str, Entry] = {}
    for table, entry in cameras_of(path, content, "metre").items():
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
    return in_metres(entries, is_anipose="metadata" in content)
