"""Errors of a track against a 3D reference, in millimetres, as a table and as JSON.

    python scripts/evaluate_track.py out/ reference3d.npz --out errors.json

The reference is an NPZ file with `joints [T J 3]` in metres, NaN where unknown, and `joint_names`;
its row i belongs to frame i of the video. Names may be spelt as any detector spells them. Which
errors there are and what they need is in `torchcss.studies.metrics`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from common import start, write_report

from torchcss.errors import ConfigurationError, TrackFileError
from torchcss.files import load_arrays
from torchcss.io.tracks import load_track
from torchcss.joint_names import canonical_joint_name
from torchcss.studies.metrics import LIMB_JOINTS, LOST_MM, TrackErrors, track_errors

FRAMES_NOTE = (
    "MPJPE means something only if track and reference share one world frame, root-aligned MPJPE "
    "only if their axes agree; PA-MPJPE needs neither."
)
KINDS = {
    "mpjpe": "absolute",
    "root_aligned_mpjpe": "root_aligned",
    "pa_mpjpe": "procrustes",
}


@dataclass(frozen=True, kw_only=True)
class Config:
    """Which track, which reference, what to compare."""

    track: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TRACK")]
    """The track.npz, or the folder that it is in."""
    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="REFERENCE")]
    """NPZ file with joints [T J 3] in metres and joint_names."""
    out: Path | None = None
    """JSON file to write."""
    joints: tuple[str, ...] = LIMB_JOINTS
    """Joints to compare; those that track or reference lack are left out."""
    reference_array: str = "joints"
    """Array of the reference that holds the positions."""
    root: str | None = None
    """Joint that is aligned for the root-aligned error; by default the midpoint of the hips."""


def main(config: Config) -> dict[str, Any]:
    """Evaluate, print, write; return what is written."""
    if config.out is not None and config.out.is_dir():
        raise ConfigurationError(f"--out {config.out}: expected a file to write, found a folder")
    track = load_track(config.track)
    if not len(track.frames):
        raise TrackFileError(f"{config.track}: the track has no frames; nothing to evaluate")
    positions, names = read_reference(config.reference, config.reference_array)
    if track.frames.min() < 0 or track.frames.max() >= len(positions):
        raise ConfigurationError(
            f"{config.reference}: has {len(positions)} frames, the track covers frames "
            f"{track.frames.min()} to {track.frames.max()}; use the reference of the whole video"
        )
    tracked_names = [common_name(name) for name in track.joint_names]
    common = [name for name in dict.fromkeys(tracked_names) if name in names]
    wanted = list(dict.fromkeys(common_name(name) for name in config.joints))
    compared = [name for name in wanted if name in common]
    if not compared:
        raise ConfigurationError(
            f"no common joints: asked for {', '.join(wanted)}; the track has "
            f"{', '.join(track.joint_names)}; the reference has {', '.join(names)}; "
            "choose with --joints"
        )
    root = None if config.root is None else common_name(config.root)
    needed = ["l_hip", "r_hip"] if root is None else [root]
    if not set(needed) <= set(common):
        raise ConfigurationError(
            f"cannot align the roots: track and reference do not both have {' and '.join(needed)}; "
            f"choose one of {', '.join(common)} with --root"
        )
    reference = positions[track.frames][:, [names.index(name) for name in common]]
    tracked = track.joints_world[:, :, [tracked_names.index(name) for name in common]]
    present = track.log_weight > -np.inf
    errors = track_errors(tracked, reference, common, present=present, compared=compared, root=root)
    left_out = [name for name in wanted if name not in common]
    report = report_of(errors, config, track.frames, present, left_out)
    print_table(report)
    write_report(config.out, report)
    return report


def common_name(name: str) -> str:
    """The catalogue's name of a joint, or its own where the catalogue has none (robots)."""
    return canonical_joint_name(name) or name


def read_reference(path: Path, array: str) -> tuple[np.ndarray, list[str]]:
    """Positions [T J 3] in metres and the joints' names."""
    arrays = load_arrays(path, TrackFileError)
    missing = [name for name in (array, "joint_names") if name not in arrays]
    if missing:
        raise TrackFileError(
            f"{path}: not a reference: expected {array} and joint_names, found "
            f"{', '.join(arrays) or 'no arrays'}; name the positions with --reference-array"
        )
    positions, names = arrays[array], [common_name(str(name)) for name in arrays["joint_names"]]
    if positions.shape[1:] != (len(names), 3) or positions.dtype.kind != "f":
        raise TrackFileError(
            f"{path}: {array}: expected shape [frames, {len(names)}, 3] in floating point, "
            f"got {positions.dtype} {list(positions.shape)}"
        )
    units = str(arrays.get("units", "m"))
    if units.lower() not in ("m", "metre", "metres", "meter", "meters"):
        raise TrackFileError(f"{path}: units: expected metres, got {units!r}; convert the file")
    return positions, names


def report_of(
    errors: TrackErrors, config: Config, frames: np.ndarray, present: np.ndarray, left_out: list
) -> dict[str, Any]:
    """What is printed and written."""
    report: dict[str, Any] = {
        "track": config.track,
        "reference": config.reference,
        "reference_array": config.reference_array,
        "root": config.root or "midpoint of l_hip and r_hip",
        "unit": "mm",
        "direction": "lower is better",
        "note": FRAMES_NOTE,
        "joint_names": errors.joint_names,
        "joints_left_out": left_out,
        "num_frames": len(frames),
        "num_frames_measured": errors.num_measured,
        "num_modes": int(present.sum(axis=1).max()),
        "lost_threshold_mm": LOST_MM,
        "num_frames_lost": int(errors.lost.sum()),
        "frames_lost": frames[errors.lost],
        "frames": frames,
        "per_joint_mm": {},
        "per_frame_mm": {},
    }
    for key, field in KINDS.items():
        for suffix in ("", "_best_of_modes"):
            kind = getattr(errors, field + suffix)
            report[f"{key}{suffix}_mm"] = kind.mean_mm
            per_joint = dict(zip(errors.joint_names, kind.per_joint_mm, strict=True))
            report["per_joint_mm"][key + suffix] = per_joint
            report["per_frame_mm"][key + suffix] = kind.per_frame_mm
    return report


def print_table(report: dict[str, Any]) -> None:
    """The report for people: one line per joint, then the means."""
    columns = [key + suffix for suffix in ("", "_best_of_modes") for key in KINDS]
    titles = ("MPJPE", "root-al.", "PA") * 2
    print(f"{'millimetres':>16} | {'best mode':^26} | best of {report['num_modes']} modes")
    print(f"{'joint':>16} |" + "".join(f" {title:>8}" for title in titles))
    for joint in report["joint_names"]:
        cells = [report["per_joint_mm"][column][joint] for column in columns]
        print(f"{joint:>16} |" + "".join(f" {cell:8.1f}" for cell in cells))
    means = [report[f"{column}_mm"] for column in columns]
    print(f"{'mean':>16} |" + "".join(f" {mean:8.1f}" for mean in means))
    lost = f"{report['num_frames_lost']} of {report['num_frames_measured']} measured frames lost"
    print(f"{report['num_frames']} frames tracked, {lost} (root-aligned > {LOST_MM:g} mm)")
    if report["joints_left_out"]:
        print(f"left out, not in both: {', '.join(report['joints_left_out'])}")
    print(FRAMES_NOTE)


if __name__ == "__main__":
    start(main, Config, __doc__)
