"""The verb `torchcss export`: a track for another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from torchcss.io.export import export_track


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a track as BVH, TRC, C3D, MOT, SMPL parameters, or a table with uncertainties."""

    track: Annotated[Path, tyro.conf.Positional]
    """track.npz, or the folder that it is in."""
    to: Literal["bvh", "trc", "c3d", "mot", "csv", "npz", "npz-smpl"]
    """bvh: skeleton and turns; trc, c3d: joints as markers, metres; mot: joint angles, degrees;
    csv, npz: joints with covariances; npz-smpl: SMPL's pose parameters. c3d needs ezc3d."""
    mode: Literal["best", "all"] | int = "best"
    """best, a rank in every frame (0 is the best), or all: one file each, or one table."""
    follow: bool = False
    """Take the ancestors of the modes of the last frame instead of each frame's ranks."""
    out: Path | None = None
    """File, or folder for files of the usual names; by default the track's folder."""
    start: int | None = None
    """First frame, counted as in the video."""
    stop: int | None = None
    """Frame before which to end."""
    stride: int = 1
    """Take every so many of the track's frames."""
    frame: Literal["world", "y-up"] | None = None
    """world: the track's world as it is; y-up: turned so that Y is up. By default y-up for bvh, trc
    and mot, else world."""
    world_up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """Which axis of the world is up; auto: the one nearest to the body's mean upward direction, or,
    for an arm or a robot, to that of the pictures."""
    rotation_order: Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"] = "ZXY"
    """bvh: order of the rotation channels."""
    scale: float = 1.0
    """bvh: units of the file per metre; 100 for centimetres."""
    t_pose: bool = False
    """bvh: begin with a frame of the T-pose."""
    rest_pose: Literal["hanging", "t-pose"] = "hanging"
    """bvh: the pose in which all channels are zero."""

    def run(self) -> None:
        """Run the verb."""
        done = export_track(
            self.track,
            to=self.to,
            mode=self.mode,
            out=self.out,
            follow=self.follow,
            start=self.start,
            stop=self.stop,
            stride=self.stride,
            frame=self.frame,
            world_up=self.world_up,
            rotation_order=self.rotation_order,
            scale=self.scale,
            t_pose_frame=self.t_pose,
            rest_pose=self.rest_pose,
        )
        for line in (*done.report, *(f"wrote {path}" for path in done.paths)):
            print(line)
