r"""TRC: the joints as markers, for OpenSim and Vicon's relatives.

The header is byte for byte that of Pose2Sim's files, which OpenSim reads: tabs, a line end of `\n`,
marker names in every third column, no blank line before the data, frames counted from 1. Metres. A
marker that a frame lacks is three empty cells. Blanks in names, as a BVH file's joints may have,
become underscores: some readers part columns at blanks.

Call `trc_text`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchcss.io.export.selection import Selection


def trc_header(
    file_name: str, names: Sequence[str], num_frames: int, rate: float, first_frame: int
) -> str:
    """The five lines above the data.

    Args:
        file_name: Name of the file, which stands in its first line.
        names: Names of the markers.
        num_frames: Number of frames.
        rate: Frames per second.
        first_frame: Index of the first frame in the video.
    """
    hertz = f"{rate:.15g}"
    numbers = range(1, len(names) + 1)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{file_name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\t"
        "OrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{hertz}\t{hertz}\t{num_frames}\t{len(names)}\tm\t{hertz}\t{first_frame}\t{num_frames}",
        "Frame#\tTime\t" + "\t\t\t".join(name.replace(" ", "_") for name in names) + "\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in numbers),
    ]
    return "\n".join(lines) + "\n"


def trc_text(selection: Selection, mode: int, file_name: str) -> str:
    """Write one mode as TRC.

    Args:
        selection: The frames.
        mode: Which of its modes.
        file_name: Name of the file.
    """
    rows = []
    points = selection.joints[:, mode].reshape(len(selection.frames), -1)
    for number, (time, point) in enumerate(zip(selection.times, points, strict=True), start=1):
        cells = ["" if np.isnan(value) else repr(float(value)) for value in point]
        rows.append("\t".join([str(number), repr(float(time)), *cells]))
    header = trc_header(
        file_name,
        selection.joint_names,
        len(selection.frames),
        selection.rate,
        int(selection.frames[0]),
    )
    return header + "\n".join(rows) + "\n"
