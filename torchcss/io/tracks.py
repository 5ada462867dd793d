"""A track on disk: every frame's modes in `track.npz`, what was run in `summary.json`.

Schema version 2. T frames, K the largest number of modes, n parameters,
J joints:

| array | shape | meaning |
|---|---|---|
| `schema_version` | | 2 |
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
| `base_transform` | T 4 4 | world from the frame in which the root moves (decision "root") |
| `evidence` | | power with which the likelihood counts in the covariances |
| `size_deviation` | | of the logarithm of the body's size, which the covariances hold for known |
| `body` | | JSON: the body that was tracked, see `torchcss.io.track_body` |
| `cameras` | | JSON: cameras and what they recorded, see `torchcss.io.view_files` |
| `settings` | | JSON: what the tracker was told |

The best mode of a frame is first. Absent modes hold zeros (parent -1, cost inf). Version 1 has the
same without the last four, of which three may also be empty.

By default: a `TrackWriter` that is saved now and then, so that a stopped run keeps its frames, and
`torchcss.io.run.Run.open`, or `load_track` for the file alone, to read back.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from enum import Enum
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.bases import on_origin, pose_track
from torchcss.body.model import BodyModel
from torchcss.body.uncertainty import Held, joint_covariance
from torchcss.errors import ShapeError, TrackFileError
from torchcss.files import (
    StrPath,
    extend_arrays,
    load_arrays,
    load_json,
    refusing,
    save_arrays,
    unexpected,
    write_text,
)
from torchcss.io.track_body import body_from_plain, body_to_plain
from torchcss.io.view_files import RecordedCamera, ViewFiles, camera_from_plain, camera_to_plain
from torchcss.vision.camera import Camera

TRACK_VERSION = 2
TRACK_NAME = "track.npz"
SMOOTH_NAME = "smooth.npz"
SUMMARY_NAME = "summary.json"

_ABSENT = {"log_weight": -np.inf, "cost": np.inf, "parent": -1}
"""What stands where there is no mode, if not zero."""

_POWER_KEY = "evidence"
"""Name of `Track.likelihood_power` in the file, as version 1 has it."""


class FrameModes(NamedTuple):
    """One frame of a track, as tensors; appended, arrays will do.

    Attributes:
        frame: Index in the video, greater than the last.
        time_s: Seconds since the video's first frame.
        state: `[k n]`, in any order.
        covariance: `[k n n]`.
        log_weight: `[k]`; modes with `-inf` are left out.
        cost: `[k]`, nats; infinite for all of them where the frame said nothing.
        parent: `[k]`, modes of the frame appended before, -1 for none.
        joints_world: `[k j 3]`, metres.
        base_transform: `[4 4]`.
    """

    frame: int
    time_s: float
    state: Tensor
    covariance: Tensor
    log_weight: Tensor
    cost: Tensor
    parent: Tensor
    joints_world: Tensor
    base_transform: Tensor = torch.eye(4, dtype=torch.float64)


_PER_MODE = FrameModes._fields[2:-1]
"""What a frame has of each mode."""


_GROWING = dict.fromkeys(("frames", "times", "base_transform", *_PER_MODE), 0.0) | _ABSENT
"""Arrays with a row for each frame, and what stands where there is no mode."""


def _shapes(n: int, j: int) -> dict[str, tuple[int, ...]]:
    """Its shapes, for so many parameters and joints."""
    return dict(zip(_PER_MODE, ((n,), (n, n), (), (), (), (j, 3)), strict=True))


class Track(NamedTuple):
    """The modes of every frame, as NumPy arrays, and what they are modes of.

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
        likelihood_power: Power with which the likelihood counts in the covariances.
        size_deviation: Standard deviation of the logarithm of the body's size, which the
            covariances hold for known; 0: it is.
        body: The body that was tracked, on the world's origin; None where the file does not say.
        cameras: What watched it, the first camera first; empty where the file does not say.
        settings: What the tracker was told, as plain data.
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
    likelihood_power: float = 1.0
    size_deviation: float = 0.0
    body: BodyModel | None = None
    cameras: tuple[RecordedCamera, ...] = ()
    settings: Mapping[str, Any] = {}

    @classmethod
    def empty(
        cls, state_names: Sequence[str], joint_names: Sequence[str], body: BodyModel | None = None
    ) -> Track:
        """A track of no frames, for a `TrackWriter` to begin with; what else is known is replaced.

        Args:
            state_names: Names of the parameters.
            joint_names: Names of the joints.
            body: The body that is tracked, on any base.
        """
        return cls(
            **_stacked([], len(state_names), len(joint_names)),
            state_names=tuple(state_names),
            joint_names=tuple(joint_names),
            body=None if body is None else on_origin(body),
        )

    @property
    def num_modes(self) -> Int[np.ndarray, " t"]:
        """How many modes each frame has."""
        return (self.log_weight > -np.inf).sum(axis=1)

    @property
    def first_camera(self) -> Camera | None:
        """The first camera; None where the file does not say."""
        return self.cameras[0].camera if self.cameras else None

    @property
    def first_files(self) -> ViewFiles | None:
        """What the first camera recorded; None where that is not known."""
        return self.cameras[0].files if self.cameras else None

    @property
    def held(self) -> Held | None:
        """What the covariances hold for known and is not; None: all is, or the file has no camera.

        Give it to `torchcss.body.uncertainty.joint_covariance`.
        """
        if not self.cameras:
            return None
        camera, _, focal = self.cameras[0]
        if not (self.size_deviation or focal):
            return None
        return Held(self.size_deviation, focal, camera.centre_world, camera.R_camera_world[2])

    def best_covariances(
        self, body: BodyModel, about: Sequence[int] = ()
    ) -> Float[np.ndarray, "t j 3 3"]:
        """Covariances of the joint centres of the best modes, square metres.

        Args:
            body: The body that was tracked, on the origin.
            about: See `torchcss.body.uncertainty.joint_covariance`.
        """
        state, base, covariance = map(
            torch.from_numpy, (self.state[:, 0], self.base_transform, self.covariance[:, 0])
        )
        pose = pose_track(body, state, base)
        return joint_covariance(body, pose, covariance, about=about, held=self.held).numpy()

    def first(self, num_frames: int) -> Track:
        """The same track up to a frame, as when no more had been tracked."""
        return self.of(self.rows()[:num_frames])

    def of(self, rows: Sequence[FrameModes]) -> Track:
        """The same track with other frames."""
        return self._replace(**_stacked(rows, len(self.state_names), len(self.joint_names)))

    def modes(self, row: int) -> FrameModes:
        """The modes of a frame, counted in the track."""
        k = int(self.num_modes[row])
        return FrameModes(
            frame=int(self.frames[row]),
            time_s=float(self.times[row]),
            base_transform=torch.from_numpy(self.base_transform[row]),
            **{name: torch.from_numpy(getattr(self, name)[row, :k]) for name in _PER_MODE},
        )

    def rows(self) -> list[FrameModes]:
        """All frames, as they were appended."""
        return [self.modes(row) for row in range(len(self.frames))]


def _stacked(rows: Sequence[FrameModes], n: int, j: int) -> dict[str, Any]:
    """The arrays of a track from its frames, filled up to the largest number of modes."""
    t, k = len(rows), max((len(np.asarray(row.cost)) for row in rows), default=0)
    arrays: dict[str, Any] = {
        "frames": np.array([row.frame for row in rows], dtype=np.int64),
        "times": np.array([row.time_s for row in rows], dtype=np.float64),
        "base_transform": np.array([row.base_transform.numpy() for row in rows]).reshape(-1, 4, 4),
    }
    for name, shape in _shapes(n, j).items():
        kind = np.int64 if name == "parent" else np.float64
        arrays[name] = np.full((t, k, *shape), _ABSENT.get(name, 0), dtype=kind)
        for index, row in enumerate(rows):
            values = np.asarray(getattr(row, name))
            arrays[name][index, : len(values)] = values
    return arrays


class TrackWriter:
    """Collects the frames of a track, and writes all that it has as often as it is asked to.

    What was written stays in the file alone, so that a long track takes no memory.

    Args:
        path: The file, usually `track.npz` in the output folder.
        begun: What goes before: `Track.empty`, or the frames of a run that goes on.
    """

    def __init__(self, path: StrPath, begun: Track) -> None:
        self.path = Path(path)
        self._begun = begun.first(0)
        self._rows = begun.rows()
        self._num_written = 0
        self._last = int(begun.frames[-1]) if self._rows else -1
        self._rank_of_parent = np.arange(begun.num_modes[-1] if self._rows else 0)

    def __len__(self) -> int:
        return self._num_written + len(self._rows)

    def append(self, modes: FrameModes) -> None:
        """Add one frame; its modes may be in any order and of any number, but at least one.

        They are put in the order of their weights, and the next frame's parents, which count the
        modes as they were given here, follow.

        Args:
            modes: The frame.

        Raises:
            ShapeError: If a shape does not fit, or a number that must be finite is not.
        """
        frame, k = int(modes.frame), torch.as_tensor(modes.log_weight).numel()
        shapes = _shapes(len(self._begun.state_names), len(self._begun.joint_names))
        per_mode = {
            name: _array(name, getattr(modes, name), (k, *shape)) for name, shape in shapes.items()
        }
        weights, cost = per_mode["log_weight"], per_mode["cost"]
        parents = per_mode["parent"].astype(np.int64)
        base = _array("base_transform", modes.base_transform, (4, 4))
        if np.isnan(weights).any() or (weights == np.inf).any() or not (weights > -np.inf).any():
            raise ShapeError(
                f"frame {frame}: log_weight: expected at least one weight above -inf and none "
                f"infinite or NaN, got {weights.tolist()}"
            )
        if not (np.isfinite(cost).all() or (cost == np.inf).all()):
            raise ShapeError(
                f"frame {frame}: cost: expected finite numbers, or inf for all modes of a frame "
                f"that said nothing, got {cost.tolist()}"
            )
        if not math.isfinite(modes.time_s) or (len(self) and frame <= self._last):
            raise ShapeError(
                f"frame {frame} at {modes.time_s} s: expected frames in rising order, at finite "
                "times"
            )
        if (parents < -1).any() or (parents >= len(self._rank_of_parent)).any():
            raise ShapeError(
                f"frame {frame}: parent: expected -1 to {len(self._rank_of_parent) - 1}, "
                f"got {parents.tolist()}"
            )
        # -1 stands at the end of the extended table, where the index -1 finds it.
        per_mode["parent"] = np.append(self._rank_of_parent, -1)[parents]
        order = np.argsort(-weights, kind="stable")
        order = order[weights[order] > -np.inf]
        self._rank_of_parent = np.full(k, -1)
        self._rank_of_parent[order] = np.arange(len(order))
        ordered = {name: torch.from_numpy(values[order]) for name, values in per_mode.items()}
        base = torch.from_numpy(base)
        self._rows.append(FrameModes(frame, float(modes.time_s), base_transform=base, **ordered))
        self._last = frame

    def track(self) -> Track:
        """Return all frames so far.

        Raises:
            TrackFileError: If what was written is no longer there.
        """
        written = load_track(self.path).rows() if self._num_written else []
        return self._begun.of([*written, *self._rows])

    def save(self) -> None:
        """Write all frames so far; the file is replaced in one step, or stays as it was.

        Raises:
            OutputError: If the disk is full or does not let the file be written.
        """
        track = self._begun.of(self._rows)
        if self._num_written:
            extend_arrays(self.path, _arrays(track), _GROWING)
        else:
            save_track(self.path, track)
        self._num_written += len(self._rows)
        self._rows = []


def save_track(path: StrPath, track: Track) -> None:
    """Write a track; the file is replaced in one step, or stays as it was.

    Args:
        path: The file.
        track: The track.

    Raises:
        OutputError: If the disk is full or does not let the file be written.
    """
    save_arrays(Path(path), _arrays(track))


def _arrays(track: Track) -> dict[str, Any]:
    """What the file holds."""
    arrays = track._asdict()
    for name in ("state_names", "joint_names"):
        arrays[name] = np.array(arrays[name], dtype=np.str_)
    arrays[_POWER_KEY] = arrays.pop("likelihood_power")
    plain = {
        "body": None if track.body is None else body_to_plain(track.body),
        "cameras": [camera_to_plain(camera) for camera in track.cameras],
        "settings": dict(track.settings),
    }
    arrays |= {name: json.dumps(value, default=_plain) for name, value in plain.items()}
    return {"schema_version": TRACK_VERSION, **arrays}


def load_track(path: StrPath) -> Track:
    """Read a track back.

    Args:
        path: The `track.npz`, or the folder that it is in.

    Returns:
        The track.

    Raises:
        TrackFileError: If it is missing, damaged, no track, or of another schema version.
    """
    path = _in_folder(path, TRACK_NAME)
    if path.name == TRACK_NAME and not path.exists():
        smooth = path.with_name(SMOOTH_NAME)
        if smooth.is_file():
            raise TrackFileError(f"{path}: is missing, but there is {smooth}: give that file")
    arrays = load_arrays(path, TrackFileError)
    version = arrays.get("schema_version")
    if version is None or version.shape != () or version.dtype.kind not in "iu":
        raise TrackFileError(
            f"{path}: not a track: expected an array schema_version, "
            f"found {', '.join(arrays) or 'no arrays'}"
        )
    if int(version) not in (1, TRACK_VERSION):
        raise TrackFileError(
            f"{path}: has schema version {int(version)}, this program reads 1 and "
            f"{TRACK_VERSION}; use the version of torchcss that wrote it, or track again"
        )
    return Track(**_checked_arrays(arrays, path), **_described(arrays, path))


def _checked_arrays(arrays: Mapping[str, np.ndarray], path: Path) -> dict[str, Any]:
    """The numbers of a track, of the shapes and types that they must have."""
    optional = {"base_transform", *Track._field_defaults}
    if missing := [name for name in Track._fields if name not in {*arrays, *optional}]:
        raise TrackFileError(f"{path}: not a complete track: {', '.join(missing)} missing")
    t, k = arrays["log_weight"].shape if arrays["log_weight"].ndim == 2 else (-1, -1)
    n, j = arrays["state_names"].size, arrays["joint_names"].size
    shapes: dict[str, tuple[int, ...]] = {
        "frames": (t,), "times": (t,), "state_names": (n,), "joint_names": (j,),
        "base_transform": (t, 4, 4), _POWER_KEY: (), "size_deviation": (),
        **{name: (t, k, *shape) for name, shape in _shapes(n, j).items()},
    }  # fmt: skip
    # A track of somebody else's may be in the world frame, and of the cost as it is.
    standing = np.tile(np.eye(4), (max(t, 0), 1, 1))
    told = {_POWER_KEY: np.ones(()), "size_deviation": np.zeros(())}
    arrays = {"base_transform": standing, **told, **arrays}
    kinds = {"frames": "iu", "parent": "iu", "state_names": "U", "joint_names": "U"}
    values: dict[str, Any] = {}
    for name, shape in shapes.items():
        array = arrays[name]
        if array.shape != shape or array.dtype.kind not in kinds.get(name, "f"):
            raise TrackFileError(
                f"{path}: {name}: expected shape {list(shape)}, "
                f"got {array.dtype} {list(array.shape)}"
            )
        odd = np.isnan if name in ("log_weight", "cost") else lambda array: ~np.isfinite(array)
        if array.dtype.kind == "f" and odd(array).any():
            what = "NaN" if np.isnan(array).any() else "infinity"
            raise TrackFileError(
                f"{path}: {name} holds {what}; the file was not written by torchcss"
            )
        if array.dtype.kind == "U":
            values[name] = tuple(map(str, array))
        else:
            values[name] = array.astype(np.float64 if array.dtype.kind == "f" else np.int64)
    if (values["frames"] < 0).any() or (np.diff(values["frames"]) <= 0).any():
        raise TrackFileError(f"{path}: frames: expected numbers from 0 in rising order")
    _check_numbers(values, path)
    if (empty := (values["log_weight"] == -np.inf).all(1)).any():
        raise TrackFileError(f"{path}: row {empty.argmax()}: no mode; expected one or more a frame")
    power = float(values.pop(_POWER_KEY))
    if power <= 0:
        raise TrackFileError(f"{path}: {_POWER_KEY}: expected a positive power, got {power:g}")
    values["size_deviation"] = float(values["size_deviation"])
    if values["size_deviation"] < 0:
        raise TrackFileError(f"{path}: size_deviation: expected a number that is not negative")
    return {**values, "likelihood_power": power}


_LARGEST = 1e9
"""Of radians, metres and their variances; more overflows where it is squared."""

_LARGEST_WEIGHT = 100.0
"""Of the logarithm, whatever it is that weights are scaled by."""

_LATEST_S, _SHORTEST_S = 1e10, 1e-6
"""Seconds since 1970 are among the former; no camera is faster than the latter."""


def _check_numbers(values: Mapping[str, np.ndarray], path: Path) -> None:
    """Refuse what no tracker writes, and what would overflow further on."""
    for name in ("state", "covariance", "joints_world", "base_transform"):
        if max(values[name].max(initial=0), -values[name].min(initial=0)) > _LARGEST:
            raise TrackFileError(f"{path}: {name}: expected numbers up to {_LARGEST:g}")
    if (np.diagonal(values["covariance"], axis1=-2, axis2=-1) < 0).any():
        raise TrackFileError(f"{path}: covariance: expected variances that are not negative")
    if not np.linalg.det(values["base_transform"][:, :3, :3]).all():
        raise TrackFileError(f"{path}: base_transform: expected a rotation and a place")
    if (values["log_weight"] > _LARGEST_WEIGHT).any():
        raise TrackFileError(f"{path}: log_weight: expected logarithms of weights, at most 1")
    steps = np.abs(np.diff(values["times"]))
    if (np.abs(values["times"]) > _LATEST_S).any() or ((steps > 0) & (steps < _SHORTEST_S)).any():
        raise TrackFileError(
            f"{path}: times: expected seconds, of frames at least {_SHORTEST_S:g} s apart and "
            f"within {_LATEST_S:g} s of 0"
        )


_DESCRIBED = ("body", "cameras", "settings")


def _described(arrays: Mapping[str, np.ndarray], path: Path) -> dict[str, Any]:
    """What the numbers are modes of, as far as the file says it."""
    # Building a body or a camera of any JSON raises whatever the damage leads to.
    with refusing(TrackFileError, f"{path}: its body, cameras or settings are damaged"):
        plain = {name: json.loads(str(arrays[name])) for name in _DESCRIBED if name in arrays}
        body, cameras = plain.get("body"), plain.get("cameras", [])
        return {
            "body": None if body is None else body_from_plain(body),
            "cameras": tuple(camera_from_plain(entry, path.parent) for entry in cameras),
            "settings": dict(plain.get("settings", {})),
        }


def write_summary(path: StrPath, summary: Mapping[str, Any]) -> None:
    """Write what was run and what came out, as JSON with sorted keys; what is no number is null.

    Args:
        path: The file, or the folder that gets a `summary.json`.
        summary: Numbers, strings, paths, enumerations, arrays, tensors, records, dataclasses, and
            lists and mappings of them.

    Raises:
        OutputError: If it cannot be written.
    """
    path = _in_folder(path, SUMMARY_NAME)
    text = json.dumps(_plain(summary), indent=2, sort_keys=True, allow_nan=False)
    write_text(path, text + "\n")


_KINDS = {
    **dict.fromkeys(("events", "notes", "other_views", "changed_beside_preset"), list),
    **dict.fromkeys(("optimiser_status", "settings", "cameras"), dict),
}
"""What entries of a summary are that somebody reads."""

_EVENT = {"event", "frame", "time_s"}


def read_summary(path: StrPath) -> dict[str, Any]:
    """Read a `summary.json`, or the one in a folder.

    Raises:
        TrackFileError: If it is missing or not an object in JSON.
    """
    path = _in_folder(path, SUMMARY_NAME)
    summary = load_json(path, TrackFileError)
    if not isinstance(summary, dict):
        raise TrackFileError(f"{path}: not a summary; expected a JSON object")
    for name, kind in _KINDS.items():
        if not isinstance(found := summary.get(name, kind()), kind):
            what = "a list" if kind is list else "an object"
            raise unexpected(TrackFileError, f"{path}: {name}", what, found)
    for event in summary.get("events", []):
        if not isinstance(event, dict) or not event.keys() >= _EVENT:
            raise unexpected(TrackFileError, f"{path}: events", f"{sorted(_EVENT)} of each", event)
    return summary


def _in_folder(path: StrPath, name: str) -> Path:
    """The file of that name if the path is a folder, else the path."""
    path = Path(path)
    try:
        return path / name if path.is_dir() else path
    except (OSError, ValueError):  # a name that cannot be one; opening it tells why
        return path


def _array(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return a float64 copy of checked shape; only weights and costs may be infinite."""
    source = value.detach().cpu().numpy() if isinstance(value, Tensor) else value
    array = np.array(source, dtype=np.float64)
    if array.shape != shape:
        raise ShapeError(f"{name}: expected a shape {list(shape)}, got {list(array.shape)}")
    if name not in ("log_weight", "cost") and not np.isfinite(array).all():
        raise ShapeError(f"{name}: expected finite numbers, got some that are not")
    return array


def _plain(value: Any) -> Any:
    """Return what JSON knows, for what a summary may hold."""
    if isinstance(value, (Tensor, np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Enum):
        value = value.value
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        value = value._asdict()  # pyright: ignore[reportAttributeAccessIssue]
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, Real):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(entry) for entry in value]
    return str(value)
