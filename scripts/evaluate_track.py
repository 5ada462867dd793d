"""Errors of a track against a 3D reference, in millimetres, as a table and as JSON.

    python scripts/evaluate_track.py out/ reference3d.npz --out errors.json

The reference is an NPZ file with `joints [T J 3]` in metres, NaN where unknown, and `joint_names`;
its row i belongs to frame i of the video. Names may be spelt as any detector spells them. Which
errors there are and what they need is in `torchcss.studies.metrics`; in Python it is
`torchcss.evaluate`. A detector that says where it believes the joints in space, as MediaPipe does,
is a peer: the last row of the table, in the frames that it saw the person.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from common import Table, finish, start

from torchcss.app.view_files import open_view
from torchcss.errors import ConfigurationError
from torchcss.io.run import Run
from torchcss.joint_names import LIMB_JOINTS
from torchcss.studies.evaluation import Evaluation, evaluate
from torchcss.studies.metrics import LOST_MM
from torchcss.types import frozen

FRAMES_NOTE = (
    "MPJPE means something only if track and reference share one world frame; root-aligned MPJPE, "
    "losses and regions only if their axes agree (a camera file without R and t gives the camera's "
    "axes: --turned); PA-MPJPE needs neither."
)
KINDS = {
    "mpjpe": "absolute",
    "root_aligned_mpjpe": "root_aligned",
    "pa_mpjpe": "procrustes",
}


@frozen
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
    turned: bool = False
    """Give the whole track the one turn that brings it nearest to the reference: for a camera of
    which it is not known how it stands in the reference's world."""


def main(config: Config) -> dict[str, Any]:
    """Evaluate, print, write; return what is written."""
    if config.out is not None and config.out.is_dir():
        raise ConfigurationError(f"--out {config.out}: expected a file to write, found a folder")
    run = Run.open(config.track)
    found = evaluation(run, config)
    report = report_of(found, config)
    columns = [key + suffix for suffix in ("", "_best_of_modes") for key in KINDS]
    cells = [*(report[f"{column}_mm"] for column in columns), report["num_frames_lost"]]
    rows = [[str(config.track), *cells]]
    if (alone := detector_alone(run)) is not None:
        errors = evaluation(alone, config).errors
        report["detector"] = {"num_frames": len(alone.track.frames)} | {
            f"{key}_mm": getattr(errors, KINDS[key]).mean_mm for key in tuple(KINDS)[1:]
        }
        aligned, procrustes = errors.root_aligned.mean_mm, errors.procrustes.mean_mm
        rows.append(["its detector", "", aligned, procrustes, "", "", "", ""])
    table = Table("A track", ("track", *columns, "lost"), rows)
    joints_table(report, columns).print()
    tell(report)
    return finish(config.out, report, table)


def evaluation(run: Run, config: Config) -> Evaluation:
    """The run against the reference."""
    return evaluate(
        run,
        config.reference,
        joints=config.joints,
        root=config.root,
        array=config.reference_array,
        turned=config.turned,
    )


def detector_alone(run: Run) -> Run | None:
    """The run with the joints in space that its detector believes in; None: it says none."""
    if (files := run.track.first_files) is None or not files.video.exists():
        return None
    links = {} if run.track.body is None else run.body.joint_of_name
    keypoints = open_view(files, run.camera, None, links).keypoints
    if keypoints is None or keypoints.points is None:
        return None
    track = run.track
    points = (keypoints.points[track.frames] @ run.camera.R_camera_world).numpy()
    rows = np.isfinite(points).all((1, 2))
    return replace(
        run,
        track=track._replace(
            frames=track.frames[rows],
            joint_names=keypoints.names,
            joints_world=points[rows][:, None],
            log_weight=np.zeros((int(rows.sum()), 1)),
            body=None,
        ),
    )


def report_of(found: Evaluation, config: Config) -> dict[str, Any]:
    """What is printed and written."""
    errors, frames = found.errors, found.frames
    report: dict[str, Any] = {
        "track": config.track,
        "reference": config.reference,
        "reference_array": config.reference_array,
        "root": config.root or "midpoint of l_hip and r_hip",
        "unit": "mm",
        "direction": "lower is better",
        "note": FRAMES_NOTE,
        "joint_names": errors.joint_names,
        "joints_left_out": found.left_out,
        "num_frames": len(frames),
        "num_frames_measured": errors.num_measured,
        "num_modes": found.num_modes,
        "inside": {f"{100 * level:g} %": share for level, share in found.inside().items()},
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


def joints_table(report: dict[str, Any], columns: list[str]) -> Table:
    """Errors joint by joint."""
    joints = {key: report["per_joint_mm"][key] for key in columns}
    rows = [[name, *(joints[key][name] for key in columns)] for name in report["joint_names"]]
    title = f"Millimetres, of the best mode and of the best of {report['num_modes']}"
    return Table(title, ("joint", *columns), rows)


def tell(report: dict[str, Any]) -> None:
    """What was compared, and how often the truth was inside the stated regions."""
    lost = f"{report['num_frames_lost']} of {report['num_frames_measured']} measured frames lost"
    print(f"{report['num_frames']} frames tracked, {lost} (root-aligned > {LOST_MM:g} mm)")
    if report["inside"]:
        shares = ", ".join(f"{100 * s:.0f} % in {level}" for level, s in report["inside"].items())
        print(f"true joints inside the stated regions: {shares}")
    if report["joints_left_out"]:
        print(f"left out, not in both: {', '.join(report['joints_left_out'])}")
    print(FRAMES_NOTE)


if __name__ == "__main__":
    start(main, Config, __doc__)
