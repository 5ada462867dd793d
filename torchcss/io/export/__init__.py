"""Tracks for other programs: BVH, TRC, C3D, MOT, SMPL's parameters, and tables with uncertainty.

| `to` | file | what | modes |
|---|---|---|---|
| `bvh` | `track.bvh` | skeleton and turns | a file each |
| `trc` | `track.trc` | joints as markers, metres | a file each |
| `c3d` | `track.c3d` | joints as points, metres (needs ezc3d) | a file each |
| `mot` | `track.mot` | joint angles, degrees | a file each |
| `csv` | `track_joints.csv` | joints and their covariances | one file |
| `npz` | `track_joints.npz` | the same as arrays | one file |
| `npz-smpl` | `track_smpl.npz` | SMPL's pose parameters, joints and covariances | one file |

Each format is a module of its own that makes the content; only this one touches the disk. Call
`export_track`.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError, TorchcssError
from torchcss.files import prepare_output_folder, replace_file
from torchcss.io.cameras import read_camera
from torchcss.io.export.bvh import bvh_text
from torchcss.io.export.c3d import write_c3d
from torchcss.io.export.mot import mot_text
from torchcss.io.export.selection import Selection, camera_up, select
from torchcss.io.export.smpl import smpl_arrays
from torchcss.io.export.tables import csv_text, joint_covariances, npz_arrays
from torchcss.io.export.trc import trc_text
from torchcss.io.fitted_body import body_beside
from torchcss.io.run import body_of_track
from torchcss.io.tracks import SUMMARY_NAME, TRACK_NAME, Track, load_track
from torchcss.vision.camera import Camera

__all__ = ["FORMATS", "Export", "export_track"]

FORMATS = ("bvh", "trc", "c3d", "mot", "csv", "npz", "npz-smpl")

_NAMES = {"csv": "track_joints.csv", "npz": "track_joints.npz", "npz-smpl": "track_smpl.npz"}
_Y_UP = ("bvh", "trc", "mot")  # formats whose readers take Y for up
_BODILESS = ("trc", "c3d")
_TABLES = ("csv", "npz", "npz-smpl")
_BVH_DEFAULTS = {
    "rotation_order": "ZXY",
    "scale": 1.0,
    "t_pose_frame": False,
    "rest_pose": "hanging",
}


class Export(NamedTuple):
    """What was written.

    Attributes:
        paths: The files.
        report: What was decided on the way, one line each.
    """

    paths: tuple[Path, ...]
    report: tuple[str, ...]


def export_track(
    track: Track | str | os.PathLike[str],
    *,
    to: str,
    mode: str | int = "best",
    out: str | os.PathLike[str] | None = None,
    follow: bool = False,
    start: int | None = None,
    stop: int | None = None,
    stride: int = 1,
    frame: Literal["world", "y-up"] | None = None,
    world_up: str = "auto",
    body: BodyModel | None = None,
    rotation_order: str = "ZXY",
    scale: float = 1.0,
    t_pose_frame: bool = False,
    rest_pose: str = "hanging",
) -> Export:
    """Write a track in the format of another program.

    Args:
        track: The track, its file, or the folder that it is in.
        to: The format, a member of `FORMATS`.
        mode: "best", the rank of a mode from 0, or "all".
        out: The file, or a folder for files of the usual names; by default the track's folder.
            Several files get `_mode0`, `_mode1`, ... before the suffix.
        follow: Take the ancestors of the modes of the last frame instead of each frame's ranks.
        start: First frame, counted as in the video.
        stop: Frame before which to end.
        stride: Take every so many of the track's frames.
        frame: "world", the track's world as it is, or "y-up", turned so that Y is up; by default
            y-up for BVH, TRC and MOT.
        world_up: Which axis of the world is up (x, y, z, -x, -y or -z); "auto": the one nearest to
            the body's mean upward direction, or, for an arm or a robot, to that of the pictures.
        body: The body that was tracked; by default that of the `body.npz` beside the track's file,
            if there is one, else one that ships.
        rotation_order: BVH: order of the rotation channels.
        scale: BVH: units of the file per metre.
        t_pose_frame: BVH: begin with a frame of the T-pose.
        rest_pose: BVH: the pose of zero channels, "hanging" or "t-pose".

    Returns:
        The files and what was decided.

    Raises:
        TrackFileError: If the track is missing or damaged, or its body cannot be told.
        ConfigurationError: If an option makes no sense, or no frame or mode is left.
        MissingExtraError: If C3D is wanted and ezc3d is not installed.
        OutputError: If a file cannot be written.
    """
    given = {
        "rotation_order": rotation_order,
        "scale": scale,
        "t_pose_frame": t_pose_frame,
        "rest_pose": rest_pose,
    }
    if to not in FORMATS:
        raise ConfigurationError(f"to: expected {', '.join(FORMATS)}, got {to!r}")
    if frame not in (None, "world", "y-up"):
        raise ConfigurationError(f"frame: expected world or y-up, got {frame!r}")
    idle = [name for name, value in given.items() if value != _BVH_DEFAULTS[name]]
    if idle and to != "bvh":
        raise ConfigurationError(f"{', '.join(idle)}: only for bvh, not for {to}; leave it out")
    source = picture_up = None
    if not isinstance(track, Track):
        source = Path(track)
        track = load_track(source)
        body = body_beside(source) if body is None else body
        source = source / TRACK_NAME if source.is_dir() else source
        picture_up = camera_up(_own_camera(source.parent))
    selection = select(
        track,
        mode=mode,
        follow=follow,
        start=start,
        stop=stop,
        stride=stride,
        y_up=frame == "y-up" or (frame is None and to in _Y_UP),
        world_up=world_up,
        picture_up=picture_up,
    )
    if body is not None or to not in _BODILESS:
        body = body_of_track(track, body)
    one_file = to in _TABLES
    paths = _paths(source, to, [""] if one_file and mode == "all" else selection.labels, out)
    report = list(selection.report)
    if to in ("bvh", "mot") and not selection.present.all():
        report.append(f"{to} cannot leave frames out: there the mode's nearest pose stands")
    if one_file:
        assert body is not None
        _write_table(paths[0], to, selection, body)
        return Export(tuple(paths), tuple(report))
    for index, path in enumerate(paths):
        if to == "c3d":
            with replace_file(path) as partial:
                write_c3d(partial, selection, index)
            continue
        if to == "trc":
            text = trc_text(selection, index, path.name)
        else:
            assert body is not None
            if to == "mot":
                text = mot_text(selection, index, body)
            else:
                text, notes = bvh_text(selection, index, body, **given)
                report += [note for note in notes if note not in report]
        _write_text(path, text)
    return Export(tuple(paths), tuple(report))


def _own_camera(folder: Path) -> Camera | None:
    """The camera in the summary beside a track, if there is one that can be read."""
    with suppress(TorchcssError):
        return read_camera(folder / SUMMARY_NAME).camera
    return None


def _write_table(path: Path, to: str, selection: Selection, body: BodyModel) -> None:
    covariance = joint_covariances(selection, body)
    if to == "csv":
        _write_text(path, csv_text(selection, covariance))
        return
    arrays = npz_arrays(selection, covariance)
    if to == "npz-smpl":
        arrays |= smpl_arrays(selection, body)
    with replace_file(path) as partial, partial.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def _write_text(path: Path, text: str) -> None:
    # Line ends as they are, also on Windows: readers of these formats count bytes.
    with replace_file(path) as partial:
        partial.write_text(text, encoding="utf-8", newline="\n")


def _paths(
    source: Path | None, to: str, labels: list[str] | tuple[str, ...], out: object
) -> list[Path]:
    """The files to write, one per label, in a folder that can be written."""
    usual = Path(_NAMES.get(to, f"track.{to}"))
    if out is None and source is None:
        raise ConfigurationError("out: a track in memory has no folder; give a file or a folder")
    target = source.parent if out is None and source is not None else Path(str(out))
    is_folder = target.is_dir() or not target.suffix
    name = usual if is_folder else Path(target.name)
    if name.suffix.lower() != usual.suffix:
        raise ConfigurationError(
            f"out: {target} is no name for {to}; expected a folder or a name in {usual.suffix}"
        )
    folder = target if is_folder else target.parent
    # A single mode goes where the caller says; several, or the usual name, tell which mode it is.
    plain = len(labels) == 1 and not is_folder
    paths = [
        folder / (name.name if plain or not label else f"{name.stem}_{label}{name.suffix}")
        for label in labels
    ]
    if source is not None and any(path.exists() and path.samefile(source) for path in paths):
        raise ConfigurationError(f"out: {source} is the track itself; choose another name")
    prepare_output_folder(folder)
    return paths
