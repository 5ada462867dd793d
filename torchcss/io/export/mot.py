"""MOT: the joint angles over time, for OpenSim's plots and everything that reads its tables.

The header and the columns' width are byte for byte those that OpenSim writes. The coordinates are
the parameters of our body by our names, turns in degrees, lengths in metres; a model of OpenSim's
that has other coordinates does not take them as they are. Blanks in names become underscores:
OpenSim parts columns at them. The root stands in the file's frame, whatever base the track hung it
on: yaw about Y, pitch about X, roll about Z, each axis turned by those before.

Call `mot_text`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, has_root
from torchcss.body.rotations import euler_angles, root_rotation
from torchcss.io.export.selection import Selection


def mot_header(columns: Sequence[str], num_rows: int) -> str:
    """Everything above the data.

    Args:
        columns: Names of the columns, `time` first.
        num_rows: Number of rows.
    """
    lines = [
        "Coordinates",
        "version=1",
        f"nRows={num_rows}",
        f"nColumns={len(columns)}",
        "inDegrees=yes",
        "",
        "Units are S.I. units (second, meters, Newtons, ...)",
        "If the header above contains a line with 'inDegrees', this indicates whether rotational "
        "values are in degrees (yes) or radians (no).",
        "",
        "endheader",
        "\t".join(name.replace(" ", "_") for name in columns),
    ]
    return "\n".join(lines) + "\n"


def mot_text(selection: Selection, mode: int, body: BodyModel) -> str:
    """Write one mode as MOT.

    Args:
        selection: The frames.
        mode: Which of its modes.
        body: The body, on the origin.
    """
    values = selection.state[:, mode].copy()
    turns = body.is_angle.numpy()
    if has_root(body):
        index = [body.state_index(name) for name in ROOT_NAMES]
        root, base = values[:, index], selection.base[:, mode]
        rotation = base[:, :3, :3] @ root_rotation(torch.from_numpy(root[:, 3:])).numpy()
        place = (base[:, :3, :3] @ root[:, :3, None])[..., 0] + base[:, :3, 3]
        values[:, index] = np.concatenate([place, euler_angles(rotation, "YXZ")], axis=1)
    values[:, turns] = np.degrees(values[:, turns])
    table = np.concatenate([selection.times[:, None], values], axis=1)
    rows = ["\t".join(f"{value:16.8f}" for value in row) for row in table]
    return mot_header(("time", *selection.state_names), len(rows)) + "\n".join(rows) + "\n"
