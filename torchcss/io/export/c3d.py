"""C3D: the joints as points, for the programs of gait laboratories.

Written by ezc3d, an optional package. Points are in metres; a point that a frame lacks is marked as
invalid (residual -1), as the format wants it. `X_SCREEN` and `Y_SCREEN` say which axes point to the
right and up on the screen of who looks at a standing body from the front. Frames are counted from
the video's first, as far as the format can count, so that times are those of the video.

Its numbers have 24 bits: places far from the origin, as in UTM coordinates, do not fit and are
refused.

Call `write_c3d`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcss.errors import ConfigurationError, optional_package
from torchcss.io.export.selection import Selection

_MOST_FRAMES = 65535
"""The header has 16 bits for the number of a frame."""

_COARSEST_M = 1e-3
"""Steps of the file's numbers, metres, that are still finer than what is tracked."""


def write_c3d(path: Path, selection: Selection, mode: int) -> None:
    """Write one mode as C3D.

    Args:
        path: The file.
        selection: The frames.
        mode: Which of its modes.

    Raises:
        MissingExtraError: If ezc3d is not installed.
        ConfigurationError: If the body is too far from the origin for the format's numbers.
    """
    points = selection.joints[:, mode].transpose(2, 1, 0)
    farthest = np.nanmax(np.abs(points))
    if (step := np.spacing(np.float32(farthest))) > _COARSEST_M:
        raise ConfigurationError(
            f"c3d: the body is {farthest:.0f} m from the world's origin, where this format's "
            f"numbers are {step:.2g} m apart; move the origin in the camera file (t + R times the "
            "place), or export trc or csv"
        )
    ezc3d = optional_package("ezc3d", 'C3D needs the package ezc3d: pip install "torchcss[c3d]"')
    file = ezc3d.c3d()
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [selection.rate]
    point["LABELS"]["value"] = tuple(selection.joint_names)
    point["DESCRIPTIONS"]["value"] = tuple("" for _ in selection.joint_names)
    file.add_parameter("POINT", "UNITS", ["m"])
    for screen, axis in zip(("X_SCREEN", "Y_SCREEN"), selection.upright.T[:2], strict=True):
        name = "XYZ"[int(np.abs(axis).argmax())]
        file.add_parameter("POINT", screen, ["+" + name if axis.sum() > 0 else "-" + name])
    first = round(float(selection.times[0]) * selection.rate)
    if first + len(selection.times) <= _MOST_FRAMES:
        file["header"]["points"]["first_frame"] = first
    file["data"]["points"] = np.concatenate([points, np.ones_like(points[:1])])
    file.write(str(path))
