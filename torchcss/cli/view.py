"""The verbs `torchcss view` and `torchcss plot`: a finished track to look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from torchcss.show.plot_track import plot_track
from torchcss.show.track_pictures import TrackFiles
from torchcss.show.view_track import view_track


@dataclass(frozen=True, kw_only=True)
class View:
    """Look at a track in the rerun viewer, or save a recording of it that needs no video."""

    track: Annotated[Path, tyro.conf.Positional]
    """track.npz or smooth.npz, or the folder that the former is in."""
    video: Path | None = None
    """The video that was tracked: draw the modes over it anew. By default the pictures are those of
    overlay.mp4 beside track.npz, if it is there."""
    save: Path | None = None
    """Write a recording, FILE.rrd, instead of opening a viewer; `rerun FILE.rrd` opens it."""
    connect: str | None = None
    """Address of a viewer that runs, instead of opening one."""
    camera: Path | None = None
    """Calibration, as for track; by default the one in summary.json."""
    camera_name: str | None = None
    """Camera in the file; by default the one of the video."""
    body: Path | None = None
    """The fitted body, body.npz; by default the one beside the track, if any."""

    def run(self) -> None:
        """Run the verb."""
        files = TrackFiles.find(
            self.track,
            video=self.video,
            camera=self.camera,
            camera_name=self.camera_name,
            body=self.body,
        )
        view_track(files, save=self.save, connect=self.connect)
        if not files.has_pictures:
            print("without pictures: give --video (and --camera) to see what the modes explain")
        if self.save is not None:
            print(f"wrote {self.save}; open it with: rerun {self.save}")


@dataclass(frozen=True, kw_only=True)
class Plot:
    """Draw a track's modes, trajectories with uncertainties, and frames, as PNG files."""

    track: Annotated[Path, tyro.conf.Positional]
    """track.npz or smooth.npz, or the folder that the former is in."""
    out: Path | None = None
    """Folder for the figures; by default `plots` beside the track."""
    video: Path | None = None
    """The video that was tracked: draw the modes over it anew. By default the frames are those of
    overlay.mp4 beside track.npz, if it is there."""
    frame: int | None = None
    """Frame that is seen from the side; by default the one with the most explanations."""
    camera: Path | None = None
    """Calibration, as for track; by default the one in summary.json."""
    camera_name: str | None = None
    """Camera in the file; by default the one of the video."""
    body: Path | None = None
    """The fitted body, body.npz; by default the one beside the track, if any."""

    def run(self) -> None:
        """Run the verb."""
        files = TrackFiles.find(
            self.track,
            video=self.video,
            camera=self.camera,
            camera_name=self.camera_name,
            body=self.body,
        )
        out = files.path.parent / "plots" if self.out is None else self.out
        for path in plot_track(files, out, frame=self.frame):
            print(f"wrote {path}")
