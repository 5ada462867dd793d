"""A robot arm filmed by one camera, tracked from its joints in the first frame only.

    python scripts/track_robot.py --data DATA/robot_models --robot panda --out out/panda

The arm of a URDF (`panda`, `iiwa7`, `ur5`, or the path of a file with `--urdf`) swings smoothly
within its joint limits before clutter, as capsules on its links (`torchcss.studies.render.robots`).
The tracker gets the images, the camera, the base, and the noisy image places of the links' origins
in the first frame; from there on contours, colours and optical flow. What it finds is compared with
the exact
truth: every joint angle (degrees), place and orientation of the end effector (millimetres,
degrees), and all links' origins (millimetres), for the best mode and for the mode of each frame
that is nearest to the truth. Each seed's folder has `overlay.mp4` and the track.

The usual pose of the robot, about which it swings, is a weak prior (a deviation of a radian): the
shoulders of arms with seven joints reach every pose of the upper arm in two ways that look alike.
A link turned about its own axis looks the same: the angle of the last joint shows in the paint's
optical flow alone, if at all. The table tells the joints apart.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from common import Table, start, write_report
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.cli.options import SettingsOptions
from torchcss.errors import ConfigurationError
from torchcss.files import prepare_output_folder
from torchcss.io.tracks import load_track, write_summary
from torchcss.solve.inverse_kinematics import link_pose, pose_errors
from torchcss.studies.demo import track_sequence
from torchcss.studies.render.robots import robot_arm, robot_sequence
from torchcss.tracking.settings import TERMS, Settings
from torchcss.types import frozen

ROBOTS: dict[str, tuple[str, tuple[float, ...]]] = {
    "panda": ("panda_hand", (0.0, -0.3, 0.0, -1.9, 0.0, 1.9, 0.8, 0.02)),
    "iiwa7": ("iiwa_link_ee", (0.0, 0.5, 0.0, -1.2, 0.0, 0.9, 0.0)),
    "ur5": ("tool0", (-0.3, -1.1, 1.3, -1.6, -1.4, 0.0)),
}
"""End effector, and a usual pose of each arm about which it swings."""
TRACKING = Settings(
    samples=60,
    modes=5,
    keypoints_use="first",
    # Neighbouring links of an arm run into each other as capsules.
    terms=tuple(term for term in TERMS if term != "interpenetration"),
)
"""How this script tracks, where nothing else is said."""


@frozen
class Config:
    """What moves, how long, and how it is tracked."""

    data: Path = Path("robot_models")
    """Folder of the robots' files."""
    robot: str = "panda"
    """panda, iiwa7 or ur5."""
    urdf: Path | None = None
    """Another arm; `--link` is its end effector. It swings about the middle of its ranges, which is
    no prior."""
    link: str | None = None
    """End effector."""
    amplitude: float = 0.4
    """Greatest swing of a joint to either side, radians."""
    frames: int = 50
    """Frames, 25 a second."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of motion, room, noise and samples."""
    tracking: SettingsOptions = TRACKING
    """How to track; body and seeds are those above."""
    out: Path = Path("out/robot")
    """Folder of the results."""
    report: Path | None = None
    """Where else to write the JSON file, such as docs/results/robots.json."""


def run_seed(config: Config, path: Path, link: str, middle: Tensor | None, seed: int) -> dict:
    """Render, track and compare."""
    generator = torch.Generator().manual_seed(seed)
    body = robot_arm(path, usual=middle)
    sequence = robot_sequence(
        body,
        generator=generator,
        middle=middle,
        amplitude=config.amplitude,
        num_frames=config.frames,
    )
    settings = replace(config.tracking, body=str(path), seed=seed)
    folder = config.out / f"seed{seed}"
    summary = track_sequence(sequence, folder, settings, generator=generator)
    errors = compare(body, link, sequence.states, folder)
    summary |= errors
    write_summary(folder, summary)
    return errors | {
        "seed": seed,
        "seconds_per_frame": summary["seconds_per_frame"],
        "events": summary["events"],
    }


def compare(body: BodyModel, link: str, truth: Tensor, folder: Path) -> dict[str, Any]:
    """Errors of the best mode, and of the mode nearest to the truth, mean over frames."""
    track = load_track(folder)
    truth = truth[track.frames.tolist()]
    states = torch.from_numpy(track.state)
    absent = ~torch.from_numpy(np.isfinite(track.log_weight))
    links = (body.pose(states).joints - body.pose(truth).joints[:, None]).norm(dim=-1).mean(-1)
    place, turn = torch.zeros_like(links), torch.zeros_like(links)
    for frame, state in enumerate(truth):
        pose = link_pose(body, link, state)
        place[frame], turn[frame] = pose_errors(body, link, pose, states[frame])
    nearest = torch.where(absent, torch.inf, links).argmin(1)
    report: dict[str, Any] = {}
    for name, chosen in (("best", torch.zeros_like(nearest)), ("nearest", nearest)):
        pick = (torch.arange(len(truth)), chosen)
        joints = (states[pick] - truth).abs()
        report[name] = {
            "joints_degrees": {
                parameter: float(joints[:, i].mean().rad2deg())
                for i, parameter in enumerate(body.state_names)
                if body.is_angle[i]
            },
            "joint_degrees": float(joints[:, body.is_angle].mean().rad2deg()),
            "end_effector_mm": 1000 * float(place[pick].mean()),
            "end_effector_degrees": float(turn[pick].mean().rad2deg()),
            "links_mm": 1000 * float(links[pick].mean()),
            "end_effector_mm_by_frame": (1000 * place[pick]).tolist(),
        }
    return report


def main(config: Config) -> dict[str, Any]:
    if config.urdf is None:
        if config.robot not in ROBOTS:
            raise ConfigurationError(f"no robot {config.robot!r}; there are {', '.join(ROBOTS)}")
        link, middle = ROBOTS[config.robot]
        path = config.data / f"{config.robot}.urdf"
    else:
        path, link, middle = config.urdf, config.link, None
        if link is None:
            raise ConfigurationError("--urdf: name its end effector with --link")
    if not path.is_file():
        raise ConfigurationError(
            f"{path}: there is no such file; --data or --urdf says where it is"
        )
    prepare_output_folder(config.out)
    pose = None if middle is None else torch.tensor(middle, dtype=torch.float64)
    rows = [run_seed(config, path, link, pose, seed) for seed in config.seeds]
    report = {"runs": rows, "config": config}
    parts = ("links_mm", "end_effector_mm", "end_effector_degrees", "joint_degrees")
    cells = [
        [f"{path.stem}, seed {row['seed']}, {mode} mode", *(row[mode][part] for part in parts)]
        for row in rows
        for mode in ("best", "nearest")
    ]
    columns = ("robot", "links mm", "tip mm", "tip degrees", "joints degrees")
    table = Table("Robot arms", columns, cells)
    write_report(config.out / "summary.json", report, table)
    write_report(config.report, report, table)
    table.print()
    tell(rows)
    return report


def tell(rows: list[dict[str, Any]]) -> None:
    """The best mode over all seeds."""
    for name in ("links_mm", "end_effector_mm", "end_effector_degrees", "joint_degrees"):
        values = [row["best"][name] for row in rows]
        print(f"{name}: median {np.median(values):.1f}, {min(values):.1f} to {max(values):.1f}")


if __name__ == "__main__":
    start(main, Config, __doc__)
