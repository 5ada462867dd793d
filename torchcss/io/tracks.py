"""A track on disk: every frame's modes in `track.npz`, what was run in `summary.json`.

Schema version 1. T frames, K the largest number of modes, n parameters,
J joints:

| array | shape | meaning |
|---|---|---|
| `schema_version` | | 1 |
| `frames` | T | index in the video |
| `times` | T | seconds since the video's first frame |
| `state_names` | n | names of the parameters |
| `state` | T K n | means of the modes |
| `covariance` | T K n n | their covariances |
| `log_weight` | T K | logarithm of the weights; `-inf`: no such mode |
| `cost` | T K | nats |
| `parent` | T K | mode of the frame before that it came from; -1: none |
| `joint_names` | J | names of the joints |
| `joints_world` | T K J 3 | metres, world frame |
| `base_transform` | T 4 4 | world from the frame in which the root moves (design decision 11) |

The best mode of a frame is first. Absent modes hold zeros (parent -1, cost inf).

By default: a `TrackWriter` that is saved now and then, so that a stopped run keeps its frames, and
`load_track` to read back.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from enum import Enum
from fractions import Fraction
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor

from torchcss.errors import ShapeError, TrackFileError
from torchcss.files import load_arrays, load_json, prepare_output_folder, replace_file

__all__ = [
    "SCHEMA_VERSION",
    "SUMMARY_NAME",
    "TRACK_NAME",
    "Track",
    "TrackWriter",
    "load_track",
    "prepare_output_folder",
    "read_summary",
    "write_summary",
]

SCHEMA_VERSION = 1
TRACK_NAME = "track.npz"
SUMMARY_NAME = "summary.json"


class Track(NamedTuple):
    """The modes of every frame, as NumPy arrays; the module's docstring has the table.

    Attributes:
        frames: Index of each frame in the video.
        times: Seconds since the video's first frame.
        state_names: Names of the parameters.
        state: Means of the modes, best first, zero where there is none.
        covariance: Covariances of the modes.
        log_weight: Logarithm of the weights, `-inf` where there is no mode.
        cost: Cost of the modes in nats, `inf` where there is none, and where the frame said
            nothing.
        parent: Mode of the frame before, -1 where there is none.
        joint_names: Names of the joints.
        joints_world: Joint centres of the modes, metres.
        base_transform: World from the frame in which the root moves.
        evidence: Power with which the likelihood counts in the covariances, see
            `torchcss.inference.tracker.stated_evidence`.
    """

    frames: Int[np.ndarray, " t"]
    times: Float[np.ndarray, " t"]
    state_names: tuple[str, ...]
    state: Float[np.ndarray, "t k n"]
    covariance: Float[np.ndarray, "t k n n"]
    log_weight: Float[np.ndarray, "t k"]
    cost: Float[np.ndarray, "t k"]
    parent: Int[np.ndarray, "t k"]
    joint_names: tuple[str, ...]
    joints_world: Float[np.ndarray, "t k j 3"]
    base_transform: Float[np.ndarray, "t 4 4"]
    evidence: float = 1.0

    @property
    def num_modes(self) -> Int[np.ndarray, " t"]:
        """How many modes each frame has."""
        return (self.log_weight > -np.inf).sum(axis=1)


class _Modes(NamedTuple):
    """One frame as it was appended, best mode first."""

    frame: int
    time_s: float
    state: np.ndarray
    covariance: np.ndarray
    log_weight: np.ndarray
    cost: np.ndarray
    parent: np.ndarray
    joints_world: np.ndarray
    base_transform: np.ndarray


class TrackWriter:
    """Collects the frames of a track, and writes all that it has as often as it is asked to.

    Args:
        path: The file, usually `track.npz` in the output folder.
        state_names: Names of the parameters.
        joint_names: Names of the joints.
        evidence: Power with which the likelihood counts in the covariances.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        state_names: Sequence[str],
        joint_names: Sequence[str],
        evidence: float = 1.0,
    ) -> None:
        self.path = Path(path)
        self._state_names = tuple(state_names)
        self._joint_names = tuple(joint_names)
        self._evidence = float(evidence)
        self._modes: list[_Modes] = []
        self._rank_of_parent = np.zeros(0, dtype=np.int64)

    def __len__(self) -> int:
        return len(self._modes)

    def append(
        self,
        *,
        frame: int,
        time_s: float,
        state: Tensor | ArrayLike,
        covariance: Tensor | ArrayLike,
        log_weight: Tensor | ArrayLike,
        cost: Tensor | ArrayLike,
        parent: Tensor | ArrayLike,
        joints_world: Tensor | ArrayLike,
        base_transform: Tensor | ArrayLike | None = None,
    ) -> None:
        """Add one frame; its modes may be in any order and of any number, but at least one.

        They are put in the order of their weights, and the next frame's parents, which count the
        modes as they were given here, follow.

        Args:
            frame: Index in the video, greater than the last.
            time_s: Seconds since the video's first frame.
            state: `[k n]`.
            covariance: `[k n n]`.
            log_weight: `[k]`; modes with `-inf` are left out.
            cost: `[k]`, nats; infinite for all of them where the frame said nothing.
            parent: `[k]`, modes of the frame appended before, -1 for none.
            joints_world: `[k j 3]`, metres.
            base_transform: `[4 4]`; None: the identity.

        Raises:
            ShapeError: If a shape does not fit, or a number that must be finite is not.
        """
        num_parameters, num_joints = len(self._state_names), len(self._joint_names)
        weights = _array("log_weight", log_weight, (None,), finite=False)
        (k,) = weights.shape
        parents = _array("parent", parent, (k,)).astype(np.int64)
        modes = _Modes(
            int(frame),
            float(time_s),
            _array("state", state, (k, num_parameters)),
            _array("covariance", covariance, (k, num_parameters, num_parameters)),
            weights,
            _array("cost", cost, (k,), finite=False),
            parents,
            _array("joints_world", joints_world, (k, num_joints, 3)),
            np.eye(4)
            if base_transform is None
            else _array("base_transform", base_transform, (4, 4)),
        )
        if np.isnan(weights).any() or (weights == np.inf).any() or not (weights > -np.inf).any():
            raise ShapeError(
                f"frame {frame}: log_weight: expected at least one weight above -inf and none "
                f"infinite or NaN, got {weights.tolist()}"
            )
        if not (np.isfinite(modes.cost).all() or (modes.cost == np.inf).all()):
            raise ShapeError(
                f"frame {frame}: cost: expected finite numbers, or inf for all modes of a frame "
                f"that said nothing, got {modes.cost.tolist()}"
            )
        if not math.isfinite(modes.time_s) or (self._modes and frame <= self._modes[-1].frame):
            raise ShapeError(
                f"frame {frame} at {time_s} s: expected frames in rising order, at finite times"
            )
        if (parents < -1).any() or (parents >= len(self._rank_of_parent)).any():
            raise ShapeError(
                f"frame {frame}: parent: expected -1 to {len(self._rank_of_parent) - 1}, "
                f"got {parents.tolist()}"
            )
        # -1 stands at the end of the extended table, where the index -1 finds it.
        parents = np.append(self._rank_of_parent, -1)[parents]
        order = np.argsort(-weights, kind="stable")
        order = order[weights[order] > -np.inf]
        self._rank_of_parent = np.full(k, -1)
        self._rank_of_parent[order] = np.arange(len(order))
        self._modes.append(
            modes._replace(
                state=modes.state[order],
                covariance=modes.covariance[order],
                log_weight=weights[order],
                cost=modes.cost[order],
                parent=parents[order],
                joints_world=modes.joints_world[order],
            )
        )

    def track(self) -> Track:
        """Return what was appended so far."""
        t = len(self._modes)
        k = max((len(modes.cost) for modes in self._modes), default=0)
        n, j = len(self._state_names), len(self._joint_names)
        track = Track(
            frames=np.array([modes.frame for modes in self._modes], dtype=np.int64),
            times=np.array([modes.time_s for modes in self._modes], dtype=np.float64),
            state_names=self._state_names,
            state=np.zeros((t, k, n)),
            covariance=np.zeros((t, k, n, n)),
            log_weight=np.full((t, k), -np.inf),
            cost=np.full((t, k), np.inf),
            parent=np.full((t, k), -1, dtype=np.int64),
            joint_names=self._joint_names,
            joints_world=np.zeros((t, k, j, 3)),
            base_transform=np.array([modes.base_transform for modes in self._modes]).reshape(
                -1, 4, 4
            ),
            evidence=self._evidence,
        )
        for index, modes in enumerate(self._modes):
            for name in ("state", "covariance", "log_weight", "cost", "parent", "joints_world"):
                values = getattr(modes, name)
                getattr(track, name)[index, : len(values)] = values
        return track

    def save(self) -> None:
        """Write all frames so far; the file is replaced in one step, or stays as it was.

        Raises:
            OutputError: If the disk is full or does not let the file be written.
        """
        arrays = self.track()._asdict()
        for name in ("state_names", "joint_names"):
            arrays[name] = np.array(arrays[name], dtype=np.str_)
        with replace_file(self.path) as partial:
            np.savez(partial, schema_version=np.array(SCHEMA_VERSION), **arrays)


def load_track(path: str | os.PathLike[str]) -> Track:
    """Read a track back.

    Args:
        path: The `track.npz`, or the folder that it is in.

    Returns:
        The track.

    Raises:
        TrackFileError: If it is missing, damaged, no track, or of another schema version.
    """
    path = Path(path)
    if _is_folder(path):
        path = path / TRACK_NAME
    arrays = load_arrays(path, TrackFileError)
    version = arrays.get("schema_version")
    if version is None or version.shape != () or version.dtype.kind not in "iu":
        raise TrackFileError(
            f"{path}: not a track: expected an array schema_version, "
            f"found {', '.join(arrays) or 'no arrays'}"
        )
    if int(version) != SCHEMA_VERSION:
        raise TrackFileError(
            f"{path}: has schema version {int(version)}, this program reads {SCHEMA_VERSION}; "
            "use the version of torchcss that wrote it, or track again"
        )
    # A track of somebody else's may be in the world frame, and of the cost as it is.
    absent: dict[str, Any] = {"evidence": np.ones(())}
    missing = [name for name in Track._fields if name not in arrays]
    missing = [name for name in missing if name not in ("base_transform", *absent)]
    if missing:
        raise TrackFileError(f"{path}: not a complete track: {', '.join(missing)} missing")
    t, k = arrays["log_weight"].shape if arrays["log_weight"].ndim == 2 else (-1, -1)
    n, j = arrays["state_names"].size, arrays["joint_names"].size
    shapes = {
        "frames": (t,), "times": (t,), "state_names": (n,), "state": (t, k, n),
        "covariance": (t, k, n, n), "log_weight": (t, k), "cost": (t, k), "parent": (t, k),
        "joint_names": (j,), "joints_world": (t, k, j, 3), "base_transform": (t, 4, 4),
        "evidence": (),
    }  # fmt: skip
    absent["base_transform"] = np.tile(np.eye(4), (max(t, 0), 1, 1))
    kinds = {"frames": "iu", "parent": "iu", "state_names": "U", "joint_names": "U"}
    values: dict[str, Any] = {}
    for name in Track._fields:
        array = arrays.get(name)
        if array is None:
            array = absent[name]
        if array.shape != shapes[name] or array.dtype.kind not in kinds.get(name, "f"):
            raise TrackFileError(
                f"{path}: {name}: expected shape {list(shapes[name])}, "
                f"got {array.dtype} {list(array.shape)}"
            )
        if array.dtype.kind == "f" and np.isnan(array).any():
            raise TrackFileError(f"{path}: {name} holds NaN; the file was not written by torchcss")
        if array.dtype.kind == "U":
            values[name] = tuple(str(entry) for entry in array)
        else:
            values[name] = array.astype(np.float64 if array.dtype.kind == "f" else np.int64)
    values["evidence"] = float(values["evidence"])
    if not 0 < values["evidence"] < np.inf:
        raise TrackFileError(
            f"{path}: evidence: expected a positive power, got {values['evidence']:g}"
        )
    return Track(**values)


def write_summary(path: str | os.PathLike[str], summary: Mapping[str, Any]) -> None:
    """Write what was run and what came out, as JSON with sorted keys; what is no number is null.

    Args:
        path: The file, or the folder that gets a `summary.json`.
        summary: Numbers, strings, paths, enumerations, arrays, tensors, records, dataclasses, and
            lists and mappings of them.

    Raises:
        OutputError: If it cannot be written.
    """
    path = Path(path)
    if _is_folder(path):
        path = path / SUMMARY_NAME
    text = json.dumps(_plain(summary), indent=2, sort_keys=True, allow_nan=False)
    with replace_file(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


def read_summary(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a `summary.json`, or the one in a folder.

    Raises:
        TrackFileError: If it is missing or not an object in JSON.
    """
    path = Path(path)
    if _is_folder(path):
        path = path / SUMMARY_NAME
    summary = load_json(path, TrackFileError)
    if not isinstance(summary, dict):
        raise TrackFileError(f"{path}: not a summary; expected a JSON object")
    return summary


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):  # a name that cannot be one; opening it tells why
        return False


def _array(
    name: str, value: Tensor | ArrayLike, shape: tuple[int | None, ...], *, finite: bool = True
) -> np.ndarray:
    """Return a float64 copy of checked shape."""
    source: Any = value
    if isinstance(source, Tensor):
        source = source.detach().cpu().numpy()
    array = np.array(source, dtype=np.float64)
    if len(array.shape) != len(shape) or any(
        want not in (None, have) for want, have in zip(shape, array.shape, strict=True)
    ):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ShapeError(f"{name}: expected a shape [{wanted}], got {list(array.shape)}")
    if finite and not np.isfinite(array).all():
        raise ShapeError(f"{name}: expected finite numbers, got some that are not")
    return array


def _plain(value: Any) -> Any:
    """Return what JSON knows, for what a summary may hold."""
    if isinstance(value, Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, Enum):
        return _plain(value.value)
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, (Real, Fraction)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return _plain(value._asdict())  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(entry) for entry in value]
    return str(value)
