"""Motion capture onto a body: a motion file to render from, with the errors of every joint.

    python scripts/retarget.py 07_05.amc --asf 07.asf --stop 4 --out walk.npz --picture walk.png
    python scripts/retarget.py jump.bvh --start 1 --out jump.npz --reference jump-reference.npz

Reads ASF/AMC or BVH, cuts out a part, resamples it, and fits the body to hips, knees, ankles,
shoulders, elbows and wrists (`torchcss.solve.retarget`). The motion file (NPZ, metres, radians, Y
up, the middle of the path over the origin, floor at height 0) holds

| array | meaning |
|---|---|
| `body`, `lengths` | name of the body, and its lengths as JSON |
| `state_names [n]`, `states [T n]`, `frame_rate` | the motion |
| `base_transform [4 4]` | base of the body in the world |
| `joint_names [J]`, `joints_world [T J 3]` | its joint centres |
| `error_mm [T]` | mean distance of the limbs' joints from the source |
| `source`, `start_s`, `description` | where it comes from |

`--reference` writes the source's own joints as `scripts/evaluate_track.py` reads them.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from common import Table, start, write_report
from matplotlib.figure import Figure

from torchcss.errors import ConfigurationError
from torchcss.files import prepare_output_folder, save_arrays
from torchcss.io.motion.positions import MotionCapture, read_motion_capture, resample_motion
from torchcss.show.style import save_figure
from torchcss.solve.retarget import Retargeted, retarget
from torchcss.studies.render.motions import Motion
from torchcss.studies.sequence_writer import write_motion
from torchcss.types import frozen


@frozen
class Config:
    """Which motion, onto which body."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """The .bvh or .amc file."""
    asf: Path | None = None
    """Skeleton of an .amc; by default the .asf of the same name beside it."""
    body: str = "body34"
    """A body with a root."""
    start: float = 0.0
    """Seconds to leave out at the beginning."""
    stop: float | None = None
    """Second to stop before; by default the end."""
    rate: float = 50.0
    """Frames per second of the result."""
    units: str | None = None
    """Metres per unit of the file, or m, cm, mm, inch, cmu; by default as stated, or guessed."""
    source_rate: float | None = None
    """Frames per second of the file, instead of what it says (BVH) or 120 (AMC)."""
    seed: int = 0
    """Seed of the starting poses."""
    out: Path
    """Motion file to write, .npz."""
    reference: Path | None = None
    """NPZ file to write with the source's joints, for scripts/evaluate_track.py."""
    report: Path | None = None
    """JSON file to write with the table."""
    picture: Path | None = None
    """PNG file to write: source and body at some moments."""


def main(config: Config) -> dict[str, Any]:
    """Read, fit, print, write; return what is reported."""
    wanted = (config.out, config.reference, config.report, config.picture)
    for path in [path for path in wanted if path is not None]:
        if path.is_dir():
            raise ConfigurationError(f"{path}: expected a file to write, found a folder")
        prepare_output_folder(path.parent)
    whole = read_motion_capture(
        config.file, skeleton=config.asf, units=config.units, frame_rate=config.source_rate
    )
    motion = resample_motion(whole, rate=config.rate, start=config.start, stop=config.stop)
    began = time.perf_counter()
    result = retarget(
        motion, body=config.body, generator=torch.Generator().manual_seed(config.seed)
    )
    seconds = time.perf_counter() - began
    report = report_of(config, whole, result, seconds)
    write_retargeted(config.out, config, result)
    if config.reference is not None:
        write_reference(config.reference, config, result)
    cells = [[name, *row.values()] for name, row in report["error_mm"].items()]
    title = f"Retargeting {config.file.name} onto {config.body}, millimetres"
    table = Table(title, ("joint", "mean", "95 %", "worst"), cells)
    table.print()
    for note in report["notes"]:
        print(note)
    print(
        f"{report['num_frames']} frames of {report['body']}, {report['frames_per_second']:.0f} "
        f"fitted per second; {100 * report['share_of_angles_at_limit']:.1f} % of all angles at a "
        "limit"
    )
    write_report(config.report, report, table)
    if config.picture is not None:
        save_figure(picture(motion, result), config.picture, dpi=80)
    return report


def report_of(
    config: Config, whole: MotionCapture, result: Retargeted, seconds: float
) -> dict[str, Any]:
    """What is printed and written."""
    error = 1000 * result.error
    columns = dict(zip(result.target_names, error.unbind(1), strict=True)) | {"all": error}
    turns = [not name.startswith("root_") for name in result.body.state_names]
    names = np.array(result.body.state_names)[turns]
    share = result.at_limit[:, turns].double().mean(0).tolist()
    return {
        "source": config.file,
        "skeleton": config.asf,
        "body": result.body.name,
        "lengths_m": result.body.lengths,
        "num_frames": len(result.states),
        "frame_rate": config.rate,
        "frames_per_second": len(result.states) / seconds,
        "unit": "mm",
        "direction": "lower is better",
        "error_mm": {
            name: {
                "mean": float(values.mean()),
                "p95": float(values.flatten().quantile(0.95)),
                "worst": float(values.max()),
            }
            for name, values in columns.items()
        },
        "share_of_frames_at_limit": dict(zip(names.tolist(), share, strict=True)),
        "share_of_angles_at_limit": float(np.mean(share)),
        "deepest_collision_mm": 1000 * float(result.depth.max()),
        "notes": [*whole.report, *result.report],
    }


def write_retargeted(path: Path, config: Config, result: Retargeted) -> None:
    description = f"motion capture {config.file.name} from {config.start:g} s on"
    write_motion(
        path,
        Motion(result.body, result.states, config.rate, description),
        {
            "joint_names": result.body.joint_names,
            "joints_world": result.joints,
            "error_mm": 1000 * result.error.mean(1),
            "source": config.file.name,
            "start_s": config.start,
        },
    )


def write_reference(path: Path, config: Config, result: Retargeted) -> None:
    """The limbs' joints of the source, and the middles that the catalogue names."""
    names, joints = list(result.target_names), result.targets.numpy()
    for name, place in (("HumanoidRoot", "hip"), ("vt1", "shoulder")):
        pair = [names.index(f"{side}_{place}") for side in "lr"]
        names, joints = (
            [*names, name],
            np.concatenate([joints, joints[:, pair].mean(1)[:, None]], 1),
        )
    found = {
        "joints": joints,
        "joint_names": names,
        "frame_rate": config.rate,
        "time_s": np.arange(len(joints)) / config.rate,
        "units": "m",
    }
    save_arrays(path, found)


def picture(motion: MotionCapture, result: Retargeted, columns: int = 7) -> Figure:
    """The source (red) and the body (left blue, right green) from two sides, about the hips."""
    names = list(result.body.joint_names)
    chains = [
        [f"{side}_{place}" for place in chain.split()] for side in "lr"
        for chain in ("shoulder elbow wrist hand_tip", "hip knee ankle heel toe ankle")
    ] + [["l_hip", "r_hip", "HumanoidRoot", "vl5", "vt1", "skullbase", "skull_tip"],
         ["l_shoulder", "vt1", "r_shoulder"], ["skullbase", "nose"]]  # fmt: skip
    body, source = result.joints.numpy(), result.source.numpy()
    figure = Figure(figsize=(2.6 * columns, 7.4), layout="constrained")
    axes = figure.subplots(2, columns)
    for column, frame in enumerate(np.linspace(0, len(body) - 1, columns).round().astype(int)):
        middle = body[frame, names.index("HumanoidRoot")]
        for row, side in enumerate((0, 2)):
            axis = axes[row, column]
            flat = [(p[frame] - [middle[0], 0, middle[2]])[:, [side, 1]] for p in (source, body)]
            for joint, parent in enumerate(motion.parents):
                if parent >= 0:
                    axis.plot(*flat[0][[joint, parent]].T, color="tab:red", linewidth=1)
            for chain in chains:
                colour = {"l": "tab:blue", "r": "tab:green"}.get(chain[-1].split("_")[0], "gray")
                line = flat[1][[names.index(name) for name in chain]]
                axis.plot(*line.T, color=colour, linewidth=3, alpha=0.5)
            axis.axhline(0, color="black", linewidth=0.5)
            axis.set(aspect="equal", xlim=(-1, 1), ylim=(-0.1, 2.1))
            axis.set_title(f"{frame / motion.frame_rate:.2f} s, along {'zx'[row]}", fontsize=9)
    return figure


if __name__ == "__main__":
    start(main, Config, __doc__)
