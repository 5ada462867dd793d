"""Where an interrupted run goes on: named tensors beside its track, in `checkpoint.npz`.

The file says to how many frames of the track it belongs. Of a run that is stopped at any moment the
last complete pair remains, if the track is saved before its checkpoint (it may then be ahead, and
`Track.first` cuts it), and if a new run calls `remove_checkpoint` before it writes its own track.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchcss.errors import TrackFileError
from torchcss.files import load_arrays, output_error, refusing, save_arrays

CHECKPOINT_NAME = "checkpoint.npz"
CHECKPOINT_VERSION = 1

_PREFIX = "tensor."


class Checkpoint(NamedTuple):
    """All that the next frame needs.

    Attributes:
        num_frames: How many frames of the track belong to it.
        tensors: Named tensors, on the processor.
        notes: Small plain data: what JSON knows.
    """

    num_frames: int
    tensors: Mapping[str, Tensor]
    notes: Mapping[str, Any] = {}


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write `checkpoint.npz` whole or not at all.

    Args:
        folder: The run's folder, whose track has been saved with all of the frames.
        checkpoint: What to write; types and values are kept bit for bit.

    Raises:
        OutputError: If it cannot be written.
    """
    tensors = checkpoint.tensors.items()
    arrays = {_PREFIX + name: tensor.detach().cpu().numpy() for name, tensor in tensors}
    about = {
        "schema_version": CHECKPOINT_VERSION,
        "num_frames": checkpoint.num_frames,
        "notes": json.dumps(dict(checkpoint.notes)),
    }
    save_arrays(Path(folder) / CHECKPOINT_NAME, {**about, **arrays})


def read_checkpoint(folder: Path) -> Checkpoint | None:
    """Read `checkpoint.npz` of a run's folder; None if there is none.

    Raises:
        TrackFileError: If it is damaged.
    """
    path = Path(folder) / CHECKPOINT_NAME
    if not path.is_file():
        return None
    arrays = dict(load_arrays(path, TrackFileError))
    with refusing(TrackFileError, f"{path}: not a checkpoint"):
        version = int(arrays["schema_version"])
        num_frames, notes = int(arrays["num_frames"]), json.loads(str(arrays["notes"]))
    if version != CHECKPOINT_VERSION:
        raise TrackFileError(
            f"{path}: has schema version {version}, this program reads {CHECKPOINT_VERSION}; go on "
            "with the version of torchcss that wrote it, or track again without --resume"
        )
    tensors = {
        name.removeprefix(_PREFIX): torch.from_numpy(array)
        for name, array in arrays.items()
        if name.startswith(_PREFIX)
    }
    return Checkpoint(num_frames, tensors, notes)


def remove_checkpoint(folder: Path) -> None:
    """Remove `checkpoint.npz`, which belongs to another track than the one that is begun.

    Raises:
        OutputError: If it is there and cannot be removed.
    """
    path = Path(folder) / CHECKPOINT_NAME
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise output_error(path, error) from error
