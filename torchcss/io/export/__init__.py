"""Tracks for other programs: BVH, TRC, C3D, MOT, SMPL's parameters, and tables with uncertainty.

| `to` | file | what | modes |
|---|---|---|---|
| `bvh` | `track.bvh` | skeleton and turns | a file each |
| `trc` | `track.trc` | joints as markers, metres | a file each |
| `c3d` | `track.c3d` | joints as points, metres (needs ezc3d) | a file each |
| `mot` | `track.mot` | joint angles, degrees | a file each |
| `angles` | `track_angles.csv` | joint angles and their standard deviations | a file each |
| `csv` | `track_joints.csv` | joints and their covariances | one file |
| `npz` | `track_joints.npz` | the same as arrays | one file |
| `npz-smpl` | `track_smpl.npz` | SMPL's pose parameters, joints and covariances | one file |

Files are named after the track's: those of `smooth.npz` are `smooth.bvh` and so on.

Each format is a module of its own that makes the content; only this one touches the disk. Call
`export`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, field
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from torchcss.errors import ConfigurationError
from torchcss.files import StrPath, prepare_output_folder, replace_file, save_arrays, write_text
from torchcss.io.export.bvh import BvhStyle, bvh_text
from torchcss.io.export.c3d import write_c3d
from torchcss.io.export.mot import mot_text
from torchcss.io.export.selection import FrameOfFile, Selection, SelectionChoice, select
from torchcss.io.export.smpl import smpl_arrays
from torchcss.io.export.tables import angles_text, csv_text, joint_covariances, npz_arrays
from torchcss.io.export.trc import trc_text
from torchcss.io.run import Run, as_run, body_of_track
from torchcss.io.tracks import Track
from torchcss.types import frozen

Format = Literal["bvh", "trc", "c3d", "mot", "angles", "csv", "npz", "npz-smpl"]
FORMATS: tuple[str, ...] = get_args(Format)

_TABLES = {"csv": "_joints.csv", "npz": "_joints.npz", "npz-smpl": "_smpl.npz"}
_ENDINGS = {**_TABLES, "angles": "_angles.csv"}
_UP: dict[str, FrameOfFile] = {**dict.fromkeys(("bvh", "trc", "mot"), "y-up"), "c3d": "z-up"}
"""What the readers of a format take for up."""


@frozen
class ExportOptions:
    """What goes into a file, and how.

    Attributes:
        selection: Which modes and frames.
        frame: "world", the track's world as it is, or turned so that Y or Z is up; by default y-up
            for BVH, TRC and MOT, z-up for C3D.
        bvh: How a BVH is written; only for that format.
    """

    selection: SelectionChoice = field(default_factory=SelectionChoice)
    frame: FrameOfFile | None = None
    bvh: BvhStyle = field(default_factory=BvhStyle)


class Exported(NamedTuple):
    """What was written.

    Attributes:
        paths: The files.
        report: What was decided on the way, one line each.
    """

    paths: tuple[Path, ...]
    report: tuple[str, ...]


def export(
    run: Run | Track | StrPath,
    path: StrPath | None = None,
    *,
    to: str | None = None,
    options: ExportOptions | None = None,
) -> Exported:
    """Write a track in the format of another program.

    Args:
        run: The run, its folder or track's file, or a track in memory.
        path: The file, or a folder for files of the usual names; by default the run's folder.
            Several files get `_mode0`, `_mode1`, ... before the suffix.
        to: The format, a member of `FORMATS`; by default that of the file's suffix.
        options: What goes into the file.

    Returns:
        The files and what was decided.

    Raises:
        TrackFileError: If the track is missing or damaged, or does not say which body it is of.
        ConfigurationError: If an option makes no sense, or no frame or mode is left.
        MissingExtraError: If C3D is wanted and ezc3d is not installed.
        OutputError: If a file cannot be written.
    """
    options = options or ExportOptions()
    to = to or ("" if path is None else Path(path).suffix.removeprefix("."))
    if to not in FORMATS:
        raise ConfigurationError(f"to: expected {', '.join(FORMATS)}, got {to!r}")
    if options.frame not in (None, *get_args(FrameOfFile)):
        raise ConfigurationError(f"frame: expected world, y-up or z-up, got {options.frame!r}")
    plain = asdict(BvhStyle())
    idle = [name for name, value in asdict(options.bvh).items() if value != plain[name]]
    if idle and to != "bvh":
        raise ConfigurationError(f"{', '.join(idle)}: only for bvh, not for {to}; leave it out")
    if isinstance(run, Track):
        track, source = run, None
    else:
        run = as_run(run)
        track, source = run.track, run.path
    frame = options.frame or _UP.get(to, "world")
    selection = select(track, options.selection, frame=frame)
    one_file = to in _TABLES
    labels = [""] if one_file and options.selection.mode == "all" else selection.labels
    paths = _paths(source, to, labels, path)
    report = list(selection.report)
    if one_file:
        body = body_of_track(track)
        covariance = joint_covariances(selection, body)
        if to == "csv":
            write_text(paths[0], csv_text(selection, covariance))
        else:
            smpl = smpl_arrays(selection, body) if to == "npz-smpl" else {}
            save_arrays(paths[0], {**npz_arrays(selection, covariance), **smpl})
    else:
        report += _write_modes(paths, to, selection, track, options.bvh)
    return Exported(tuple(paths), tuple(report))


def _write_modes(
    paths: Sequence[Path], to: str, selection: Selection, track: Track, style: BvhStyle
) -> list[str]:
    """Write a file for every mode; returns what to report."""
    report: list[str] = []
    if to in ("bvh", "mot") and not selection.present.all():
        report.append(f"{to} cannot leave frames out: there the mode's nearest pose stands")
    for index, path in enumerate(paths):
        if to == "c3d":  # this format and the next are of places, which need no body
            with replace_file(path) as partial:
                write_c3d(partial, selection, index)
        elif to == "trc":
            write_text(path, trc_text(selection, index, path.name))
        elif to == "mot":
            write_text(path, mot_text(selection, index, body_of_track(track)))
        elif to == "angles":
            write_text(path, angles_text(selection, index, body_of_track(track)))
        else:
            text, notes = bvh_text(selection, index, body_of_track(track), style)
            report += [note for note in notes if note not in report]
            write_text(path, text)
    return report


def _paths(source: Path | None, to: str, labels: Sequence[str], out: StrPath | None) -> list[Path]:
    """The files to write, one per label, in a folder that can be written."""
    usual = Path(("track" if source is None else source.stem) + _ENDINGS.get(to, f".{to}"))
    if out is None:
        if source is None:
            raise ConfigurationError(
                "path: a track in memory has no folder; give a file or a folder"
            )
        out = source.parent
    target = Path(out)
    is_folder = target.is_dir() or not target.suffix
    name = usual if is_folder else Path(target.name)
    if name.suffix.lower() != usual.suffix:
        raise ConfigurationError(
            f"path: {target} is no name for {to}; expected a folder or a name in {usual.suffix}"
        )
    folder = target if is_folder else target.parent
    # A single mode goes where the caller says; several, or the usual name, tell which mode it is.
    plain = len(labels) == 1 and not is_folder
    paths = [
        folder / (name.name if plain or not label else f"{name.stem}_{label}{name.suffix}")
        for label in labels
    ]
    if source is not None and any(path.exists() and path.samefile(source) for path in paths):
        raise ConfigurationError(f"path: {source} is the track itself; choose another name")
    prepare_output_folder(folder)
    return paths
