"""Masks that were found with keypoints: of everybody, and of one person alone.

They are a film of everybody beside the keypoints (`masks_of`). Where several people are in a frame,
our NPZ says in `mask_owner [T R C]`, on a grid over the picture, whose mask it is: a place among
all people, -1 in frames of one or nobody. `read_own_masks` reads it.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int, UInt8

from torchcss.errors import KeypointError
from torchcss.files import load_arrays
from torchcss.io.keypoints.arrays import MOST_BYTES, person_places
from torchcss.types import Keypoints

MASK_CELLS = (54, 96)
"""Rows and columns of the grid over a picture."""


def masks_of(keypoints: Path) -> Path:
    """Where the masks lie that were found with these keypoints: white where anybody is."""
    return keypoints.with_name(f"{keypoints.stem}_masks.mp4")


def owner_of_cells(masks: UInt8[np.ndarray, "p h w"]) -> Int[np.ndarray, "r c"] | None:
    """Who has most of the mask in each cell of a picture; None: it is of one person, or nobody."""
    if len(masks) < 2:
        return None
    total = masks.astype(np.int64)
    for axis, cells in enumerate(MASK_CELLS, start=1):
        size = masks.shape[axis]
        begins = np.ceil(np.arange(cells) * size / cells).astype(int)
        total = np.add.reduceat(total, np.minimum(begins, size - 1), axis)
    return total.argmax(0)


class OwnMasks(NamedTuple):
    """What of everybody's masks is one person's.

    Attributes:
        others: Cells of the pictures that are other people's.
        seen: Frames in which the person is seen.
    """

    others: Bool[np.ndarray, "t r c"]
    seen: Bool[np.ndarray, " t"]

    def alone(self, frame: int, mask: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w c"]:
        """The person's part of everybody's mask; all of it where the person may be anywhere."""
        if not self.seen[frame]:
            return np.full_like(mask, 255)
        rows, columns = (
            np.arange(size) * cells // size
            for cells, size in zip(MASK_CELLS, mask.shape[:2], strict=True)
        )
        return np.where(self.others[frame][rows[:, None], columns, None], np.uint8(0), mask)


def read_own_masks(keypoints_file: Path, keypoints: Keypoints) -> OwnMasks | None:
    """What of the masks beside a file of keypoints is the person's; None: the file does not say.

    Args:
        keypoints_file: The file.
        keypoints: The person's, of every frame, in the pixels of the file.
    """
    arrays = load_arrays(keypoints_file, KeypointError, MOST_BYTES)
    owner, names = arrays.get("mask_owner"), list(arrays.get("joint_names", ()))
    if owner is None or owner.shape != (len(keypoints.positions), *MASK_CELLS):
        return None
    column = [names.index(name) for name in keypoints.names]
    person = person_places(arrays["keypoints"][:, :, column], keypoints).numpy()
    others = (owner >= 0) & (owner != person[:, None, None])
    return OwnMasks(others, (keypoints.confidence > 0).any(-1).numpy())
