"""The joints of all chosen modes in one table, with their covariances: CSV and NPZ; and angles.

The CSV is tidy, a row per frame, mode and joint:

| column | meaning |
|---|---|
| `frame`, `time` | index in the video, seconds |
| `mode`, `parent` | rank in the frame, 0 the best; rank in the track's frame before, -1 for none |
| `weight`, `cost` | share of the mixture, nats |
| `joint` | name |
| `x`, `y`, `z` | metres |
| `cov_xx`, `cov_xy`, `cov_xz`, `cov_yy`, `cov_yz`, `cov_zz` | square metres |

The NPZ has the same as arrays (t frames, m modes, j joints; NaN where a frame lacks a mode):
`frames`, `times` [t]; `mode`, `parent`, `log_weight`, `cost` [t m]; `joint_names` [j]; `joints`
[t m j 3]; `joint_covariance` [t m j 3 3]; `frame_from_world` [3 3]; `frame_rate`.

The angles of one mode are a CSV with a row per frame: `frame`, `time`, then of every parameter but
the root's six its value (`NAME_deg`, or `NAME_m` of what slides) and its standard deviation
(`NAME_deg_sd`), both empty where the frame lacks the mode.

Call `joint_covariances`, then `csv_text` or `npz_arrays`; or `angles_text`.
"""

from __future__ import annotations

import csv
import io

import numpy as np
import torch
from jaxtyping import Float

from torchcss.body.bases import pose_track
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES
from torchcss.body.uncertainty import joint_covariance
from torchcss.io.export.selection import Selection
from torchcss.joint_names import names_in

_CHUNK = 1024  # poses at a time: 30 MB of Jacobians
_UPPER = np.triu_indices(3)
_COLUMNS = names_in(
    "frame time mode parent weight cost joint x y z cov_xx cov_xy cov_xz cov_yy cov_yz cov_zz"
)


def joint_covariances(selection: Selection, body: BodyModel) -> Float[np.ndarray, "t m j 3 3"]:
    """Covariances of all joint centres, square metres, NaN where a frame lacks the mode.

    Args:
        selection: The modes.
        body: The body, on the origin.
    """
    found = np.full((*selection.joints.shape, 3), np.nan)
    rows, columns = np.nonzero(selection.present)
    for start in range(0, len(rows), _CHUNK):
        chosen = rows[start : start + _CHUNK], columns[start : start + _CHUNK]
        state, base, covariance = (
            torch.from_numpy(array[chosen])
            for array in (selection.state, selection.base, selection.covariance)
        )
        pose = pose_track(body, state, base)
        found[chosen] = joint_covariance(body, pose, covariance, held=selection.held).numpy()
    return found


def csv_text(selection: Selection, covariance: Float[np.ndarray, "t m j 3 3"]) -> str:
    """The table as text.

    Args:
        selection: The modes.
        covariance: From `joint_covariances`.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_COLUMNS)
    numbers = np.concatenate([selection.joints, covariance[..., _UPPER[0], _UPPER[1]]], axis=-1)
    for t, m in np.argwhere(selection.present):
        weight = np.exp(selection.log_weight[t, m])
        head = [array[t].item() for array in (selection.frames, selection.times)]
        head += [array[t, m].item() for array in (selection.rank, selection.parent)]
        head += [float(weight), float(selection.cost[t, m])]
        for name, row in zip(selection.joint_names, numbers[t, m].tolist(), strict=True):
            writer.writerow([*head, name, *row])
    return out.getvalue()


def angles_text(selection: Selection, mode: int, body: BodyModel) -> str:
    """The joint angles of one mode as text.

    Args:
        selection: The frames.
        mode: Which of its modes.
        body: The body, on the origin.
    """
    turns = body.is_angle.numpy()
    columns = [n for n, name in enumerate(body.state_names) if name not in ROOT_NAMES]
    variance = np.diagonal(selection.covariance[:, mode], axis1=1, axis2=2)
    both = np.stack([selection.state[:, mode], np.sqrt(variance)], axis=-1)
    both[:, turns] = np.degrees(both[:, turns])
    numbers = both[:, columns].reshape(len(both), -1)
    names = [f"{body.state_names[n]}_{'deg' if turns[n] else 'm'}" for n in columns]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["frame", "time", *(each for name in names for each in (name, f"{name}_sd"))])
    for t, there in enumerate(selection.present[:, mode]):
        cells = [f"{value:.6f}" if there else "" for value in numbers[t]]
        writer.writerow([selection.frames[t], f"{selection.times[t]:.6f}", *cells])
    return out.getvalue()


def npz_arrays(
    selection: Selection, covariance: Float[np.ndarray, "t m j 3 3"]
) -> dict[str, np.ndarray]:
    """The table as arrays.

    Args:
        selection: The modes.
        covariance: From `joint_covariances`.
    """
    return {
        "frames": selection.frames,
        "times": selection.times,
        "frame_rate": np.array(selection.rate),
        "mode": selection.rank,
        "parent": selection.parent,
        "log_weight": selection.log_weight,
        "cost": selection.cost,
        "joint_names": np.array(selection.joint_names, dtype=np.str_),
        "joints": selection.joints,
        "joint_covariance": covariance,
        "frame_from_world": selection.turn,
    }
