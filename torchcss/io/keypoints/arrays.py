"""2D joints as arrays: our own NPZ, and what people save of what a detector returns.

Ours is `keypoints [T J 2]`, `confidence [T J]`, `joint_names [J]`; of several people `[T P J 2]`,
`[T P J]` and `person_ids [P]`; and `image_size_wh [2]` and `relative_noise []` (`People`), and
`points [T P J 3]` (`read_points`), and whose masks are where (`torchcss.io.keypoints.masks`). Read
as well, as NPY or as the only array of an NPZ: pairs or triples `[T J 2]`, `[T J 3]` (x, y,
confidence), in another order of axes where their sizes tell it (ST-GCN's `[3 T J 1]`), of several
people `[T P J 3]`, of one picture `[J 3]`, and MoveNet's `[T 1 1 17 3]` or, in fractions,
`[T 1 17 3]` (y, x, confidence). Confidences may be called `scores` and the like.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchcss.errors import KeypointError
from torchcss.files import load_arrays, shortened, unexpected
from torchcss.io.keypoints.frames import FRAMES_AT_MOST
from torchcss.io.keypoints.mediapipe import (
    FOURS,
    LAYOUT,
    NUM_LANDMARKS,
    is_landmark_array,
    landmark_places,
)
from torchcss.io.keypoints.people import (
    LAYOUT_SIZES,
    Frames,
    Names,
    People,
    Person,
    is_there,
    keep_places,
    screened,
)
from torchcss.io.keypoints.words import (
    FRAMES,
    ORDER_NAMES,
    SCORES,
    SHAPES,
    SIDES,
    SIZES,
    first_of,
    key_of,
)
from torchcss.joint_names import names_in
from torchcss.types import Keypoints

_PLACES = names_in(
    "keypoints keypoints2d joints2d kps kpts poses positions pose joints xy keypoint keypoint2d "
    "predkeypoints2d kp2d"
)
_FREEMOCAP = (553, 3)
"""x, y and z of FreeMoCap's points, which are MediaPipe's of body, hands and face."""

MOST_BYTES = 2**31
"""Bytes of the largest set of arrays of keypoints: as of 33 people with 133 in 20,000 frames."""

_MOST_NUMBERS = 8
"""Of a joint: what is more are frames."""

_MOST_PEOPLE = 30
"""More people than this in a single frame are one person in so many frames: networks that lift
joints to space take and give `[1 T J 3]`."""


def read_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> People:
    """Read arrays of joints.

    Raises:
        KeypointError: If there are none of the shapes above.
    """
    texts = {key: each for key, each in arrays.items() if each.dtype.kind in "SU"}
    numbers = {key: each for key, each in arrays.items() if key not in texts}
    alone = len(arrays) == 1
    name = next(iter(arrays)) if alone else key_of(numbers, _PLACES)
    array, counts = _numbered(arrays.get(name or "", np.zeros(0)))
    if array.shape[-2:] == _FREEMOCAP:
        array = array[..., :NUM_LANDMARKS, :]
    if name is None:
        raise unexpected(
            KeypointError, "", "the arrays keypoints, confidence and joint_names", list(arrays)
        )
    kind = path.suffix[1:].upper()
    # Beside a size and the like only those are landmarks that have four numbers.
    fours = not texts and first_of(arrays, SCORES) is None and array.shape[1:] in FOURS
    if landmarks := (alone or fours) and is_landmark_array(array):
        values, kind = landmark_places(array)[:, None], f"MediaPipe landmarks, array {name}"
    else:
        values = _people(name, array)
    if from_movenet := not landmarks and is_movenet(array, alone=alone):
        values = values[..., [1, 0, 2]]
        kind = "MoveNet's arrays, y before x, fractions of the image"
    report = [f"format: {kind}"]
    if len(values) == 1 and values.shape[1] > _MOST_PEOPLE:
        values = values.swapaxes(0, 1)
        report.append(f"{name}: one person in {len(values)} frames, which are the second axis")
    values, told = _with_confidence(name, values, first_of(arrays, SCORES))
    tracks = _tracks(arrays.get("person_ids"), values)
    counts = first_of(numbers, FRAMES) if counts is None else counts
    in_order = counts is None or counts.shape != values.shape[:1] or not np.isfinite(counts).all()
    keys = range(len(values)) if counts is None or in_order else counts.tolist()
    frames: Frames = {}
    for number, frame in zip(keys, values, strict=True):
        frames.setdefault(int(number), []).extend(
            Person(joints, track)
            for joints, track in zip(frame, tracks, strict=True)
            if len(frame) == 1 or is_there(joints)
        )
    size = _positive("image size", _size(numbers), 2)
    noise = _positive("relative_noise", arrays.get("relative_noise"), 1)
    texts = {key: each for key, each in texts.items() if each.shape == values.shape[2:3]}
    return People(
        frames,
        _names(arrays.get("joint_names", first_of(texts, ORDER_NAMES)), values.shape[2]),
        [*report, told],
        LAYOUT if landmarks else None,
        in_order,
        corner_fractions=from_movenet or landmarks,
        size_wh=None if size is None else (size[0], size[1]),
        relative_noise=noise[0] if noise else 1.0,
    )


def _size(numbers: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Width and height, as one array or as two."""
    if (shape := first_of(numbers, SHAPES)) is not None and shape.shape in ((2,), (3,)):
        return shape[1::-1]
    sides = ([first_of(numbers, (side,)) for side in pair] for pair in SIDES)
    pairs = [np.array([w, h]) for w, h in sides if w is not None and h is not None]
    return next(iter(pairs), None) if (size := first_of(numbers, SIZES)) is None else size


def read_points(path: Path, keypoints: Keypoints) -> Keypoints:
    """The keypoints with the `points` of the person that they are, where our NPZ has them.

    Args:
        path: The file that the keypoints were read from, which may be of any format.
        keypoints: Of every frame, in the pixels of the file.
    """
    if path.suffix.lower() != ".npz" or not path.is_file():
        return keypoints
    arrays = load_arrays(path, KeypointError, MOST_BYTES)
    names, nothing = list(arrays.get("joint_names", ())), np.zeros(0)
    pixels, points = arrays.get("keypoints", nothing), arrays.get("points", nothing)
    if points.shape != (*pixels.shape[:3], 3) or not {*keypoints.names} <= {*names}:
        return keypoints  # somebody else's points
    column = [names.index(name) for name in keypoints.names]
    person = person_places(pixels[:, :, column], keypoints)
    points = torch.as_tensor(points).to(keypoints.positions)[:, :, column]
    return keypoints._replace(points=points[torch.arange(len(person)), person])


def person_places(pixels: np.ndarray, keypoints: Keypoints) -> Int[Tensor, " t"]:
    """The place of the person among everybody in every frame, by the pixels `[t p j 2]` of all."""
    gap = torch.as_tensor(pixels).to(keypoints.positions) - keypoints.positions[:, None]
    known = keypoints.confidence[:, None] > 0
    return torch.where(known, gap.norm(dim=-1), 0.0).nan_to_num(torch.inf).sum(-1).argmin(1)


def _numbered(array: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """A table without the column that counts its rows, and that column."""
    is_table = array.ndim == 2 and array.dtype.kind in "iuf" and len(array) > 2 < array.shape[1]
    if is_table and (np.diff(array[:, 0]) == 1).all():
        return array[:, 1:], array[:, 0]
    return array, None


def is_movenet(array: np.ndarray, *, alone: bool = True) -> bool:
    """Whether an array is MoveNet's: y, x, confidence, fractions of the image.

    Of joints in a row of people or pictures that is told by the trunk, which is rather upright.
    """
    if (array.ndim == 5 and array.shape[-1] == 3) or array.shape[-1] == 56:
        return True
    if not alone or array.shape[-2:] != (17, 3) or not bool(((array >= 0) & (array <= 1)).all()):
        return False
    trunk = np.abs(array[..., (5, 6), :2].mean(-2) - array[..., (11, 12), :2].mean(-2))
    upright = (trunk[..., 0] > trunk[..., 1])[trunk.any(-1)]
    return array.shape[1:-2] == (1,) or bool(len(upright) and upright.mean() > 0.5)


def _unfit(name: str, array: np.ndarray, expected: str) -> KeypointError:
    """The error for an array of another kind or shape."""
    got = f"{array.dtype} {list(array.shape)}"
    return KeypointError(f"{name}: expected {expected}, got {got}")


def _tracks(ids: np.ndarray | None, values: np.ndarray) -> list[str | None]:
    """Whom the places of the second axis are, where the file says so or they keep them."""
    count = values.shape[1]
    if ids is None and count > 1 and keep_places([*frame] for frame in values):
        ids = np.arange(count)
    if ids is None:
        return [None] * count
    if ids.shape != (count,) or ids.dtype.kind not in "iuU":
        raise _unfit("person_ids", ids, f"{count} numbers")
    return [str(number) for number in ids]


def _positive(name: str, array: np.ndarray | None, count: int) -> list[float] | None:
    """So many numbers, if the file has them."""
    if array is None:
        return None
    if array.size != count or array.dtype.kind not in "iuf" or not (array > 0).all():
        raise KeypointError(
            f"{name}: expected {count} positive numbers, got {shortened(array.tolist())}"
        )
    return array.ravel().astype(float).tolist()


def _people(name: str, array: np.ndarray) -> np.ndarray:
    """`[t p j 2]` or `[t p j 3]`, from any of the shapes."""
    shape: Sequence[int] = array.shape
    if shape[:1] > (FRAMES_AT_MOST,):
        raise _unfit(name, array, f"{FRAMES_AT_MOST:,} frames at most")
    if array.dtype.kind in "iu" and array.dtype.itemsize == 1:
        raise _unfit(name, array, "pixels, which are more than eight bits count")
    if array.dtype.kind in "iuf" and 0 not in shape:
        values = array.astype(np.float64)
        if shape[-1] == 56 and len(shape) > 2:  # MoveNet's of several people
            return values[..., :51].reshape(shape[0], -1, 17, 3)
        if len(shape) > 2 and shape[-1] == 4:  # x, y, z, confidence
            values = values[..., [0, 1, 3]]
        elif len(shape) == 3 and shape[1] in (2, 3) and shape[2] in LAYOUT_SIZES:
            values = values.swapaxes(1, 2)
        elif (axes := _axes(values.squeeze().shape)) is not None:
            values = values.squeeze().transpose(axes)
        elif len(shape) == 2 and shape[1] in (2, 3) and shape[0] in LAYOUT_SIZES:
            values = values[None]
        elif len(shape) == 2:
            sizes = (n for n in (3, 2) if shape[1] % n == 0 and shape[1] // n in LAYOUT_SIZES)
            values = values.reshape(shape[0], -1, next(sizes, shape[1]))
        elif len(shape) == 5 and shape[1] == 1:
            values = values[:, 0]
        if values.ndim in (3, 4) and values.shape[-1] in (2, 3):
            return values.reshape(len(values), -1, *values.shape[-2:])
    expected = "numbers [frames, joints, 2 or 3] or [frames, people, joints, 2 or 3]"
    raise _unfit(name, array, expected)


def _axes(shape: Sequence[int]) -> list[int] | None:
    """Which axes are frames, joints and coordinates where only their sizes tell; None: unclear."""
    places = [[axis for axis, size in enumerate(shape) if size in sizes]
              for sizes in (LAYOUT_SIZES, (2, 3))]  # fmt: skip
    if len(shape) != 3 or [len(each) for each in places] != [1, 1]:
        return None
    (joints,), (xy,) = places
    if xy == 2 or (joints < 2 and shape[2] <= _MOST_NUMBERS):
        return None  # as it is
    return [3 - joints - xy, joints, xy]


def _with_confidence(
    name: str, values: np.ndarray, given: np.ndarray | None
) -> tuple[np.ndarray, str]:
    """`[t p j 3]`, and where the confidences are from."""
    if given is None and values.shape[-1] == 2:
        told = "no confidence in the file: 1 for every joint that is a number"
        return screened(np.where(np.isfinite(values), values, np.nan)), told
    if given is None:
        return values, f"confidence: the third numbers of {name}"
    if given.dtype.kind not in "biuf" or given.size != math.prod(values.shape[:3]):
        raise _unfit("confidence", given, f"numbers {[n for n in values.shape[:3] if n != 1]}")
    given = given.astype(np.float64).reshape(*values.shape[:3], 1)
    return np.concatenate([values[..., :2], given], -1), "confidence: beside the joints"


def _names(names: np.ndarray | None, num_joints: int) -> Names | None:
    if names is None:
        return None
    if names.shape != (num_joints,) or names.dtype.kind not in "SU":
        raise _unfit("joint_names", names, f"{num_joints} names")
    return tuple(each.decode(errors="replace") if isinstance(each, bytes) else each
                 for each in names.tolist())  # fmt: skip
