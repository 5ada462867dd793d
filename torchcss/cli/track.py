"""The verb `torchcss track`: a video, its camera and its keypoints to a run."""

from __future__ import annotations

from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from torchcss.app.smooth import report, smooth
from torchcss.app.track import TrackOptions, track_video
from torchcss.cli.options import (
    PathArgument,
    SettingsOptions,
    Terminal,
    TerminalOptions,
    first_look,
)
from torchcss.errors import ConfigurationError, OutputError
from torchcss.io.tracks import TRACK_NAME
from torchcss.io.view_files import ViewFiles
from torchcss.tracking.settings import Settings
from torchcss.types import frozen


@frozen
class Track:
    """Track a body through a video, and write its track, summary, overlay and report.html."""

    video: PathArgument
    """A video in any container, or a folder of images."""
    camera: Path | None = None
    """Calibration, if there is one: cameras.json, or the file of Pose2Sim, Anipose, Caliscope,
    EasyMocap, OpenCV, ROS, Kalibr, COLMAP or MATLAB."""
    keypoints: Path | None = None
    """2D joints; by default they are detected, as torchcss detect does. What a detector or an
    annotation tool writes, as a folder (OpenPose, YOLO, EasyMocap), JSON, CSV, HDF5 or arrays, or
    clicked; of an archive of several recordings FILE.npz#SUBJECT/ACTION/CAMERA."""
    out: Path = Path("out/track")
    """Output folder."""
    overwrite: bool = False
    """Replace the run that the folder holds."""
    start: int = 0
    """First frame."""
    stop: int | None = None
    """Frame before which to end."""
    other_videos: tuple[Path, ...] = ()
    """Videos of further synchronised cameras of the same calibration file."""
    other_keypoints: tuple[Path, ...] = ()
    """2D joints of each of them; none: their pictures speak alone."""
    other_offsets: tuple[int, ...] = ()
    """Frame of each of them at the time of the first video's frame 0, by default 0."""
    other_cameras: tuple[str, ...] = ()
    """Camera of each of them in the file; by default the one whose video it is."""
    live: bool = False
    """Watch in the rerun viewer while tracking."""
    live_connect: str | None = None
    """Watch in a viewer that runs, by its address, such as rerun+http://127.0.0.1:9876/proxy."""
    live_save: Path | None = None
    """Write what would be watched as FILE.rrd, which grows while tracking."""
    smooth: bool = False
    """When done, write smooth.npz as well: one smooth trajectory through the modes of all frames,
    as torchcss smooth does."""
    smooth_images: bool = False
    """The same, and fit that trajectory to the images again: a second pass over the video."""
    options: Annotated[
        TrackOptions, tyro.conf.OmitArgPrefixes, tyro.conf.AvoidSubcommands, tyro.conf.SuppressFixed
    ] = TrackOptions()
    settings: SettingsOptions = Settings()
    terminal: TerminalOptions = Terminal()

    def run(self) -> None:
        """Run the verb."""
        others = self.others()
        if self.overwrite and self.options.resume:
            raise ConfigurationError(
                "--resume goes on with a run, --overwrite replaces it: give one of them"
            )
        if (self.out / TRACK_NAME).is_file() and not (self.overwrite or self.options.resume):
            raise OutputError(
                f"{self.out}: holds a run: --resume goes on with it where it was interrupted, "
                "--overwrite replaces it, --out names another folder"
            )
        live, save, connect = None, self.live_save, self.live_connect
        if self.options.resume and save is not None and save.exists():
            raise OutputError(
                f"{save}: holds what was recorded before, which --resume would replace: name "
                f"another file with --live-save; torchcss view {self.out} --save FILE.rrd records "
                "all frames"
            )
        if self.live or connect is not None or save is not None:
            from torchcss.app.live import LiveViewer

            spawn = self.live and connect is None
            live = LiveViewer(self.out.name, save=save, connect=connect, spawn=spawn)
        with self.terminal.working(), nullcontext() if live is None else closing(live):
            run = track_video(
                self.video,
                camera=self.camera,
                keypoints=self.keypoints,
                out=self.out,
                settings=self.settings,
                start=self.start,
                stop=self.stop,
                options=replace(self.options, others=others, live=live),
            )
            if self.smooth or self.smooth_images:
                run = smooth(run, images=self.smooth_images)
        lines = [
            f"{run.summary['num_frames']} frames, {run.summary['seconds_per_frame']:.2f} s each; "
            f"look at {first_look(self.out, self.settings)}"
        ]
        if "smoothed" in run.summary:
            lines.append(report(run.summary["smoothed"]))
        self.terminal.tell(self.out, "\n".join(lines))

    def others(self) -> list[ViewFiles]:
        """What the further cameras recorded."""
        count = len(self.other_videos)
        for name in ("keypoints", "offsets", "cameras"):
            if (number := len(getattr(self, f"other_{name}"))) not in (0, count):
                raise ConfigurationError(
                    f"--other-{name}: expected one for each of the {count} other videos, or none "
                    f"at all; got {number}"
                )
        return [
            ViewFiles(
                video=video,
                keypoints=keypoints,
                camera_name=name,
                layout=self.options.layout,
                normalised=self.options.normalised,
                offset=offset,
                frame_rate=self.options.frame_rate,
            )
            for video, keypoints, offset, name in zip(
                self.other_videos,
                self.other_keypoints or (None,) * count,
                self.other_offsets or (0,) * count,
                self.other_cameras or (None,) * count,
                strict=True,
            )
        ]
