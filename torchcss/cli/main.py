"""The `torchcss` command: thin, every verb is a call that a user could write in Python.

| verb | does |
|---|---|
| `torchcss demo` | renders a sequence, tracks it and prints the error against the truth |
| `torchcss init IMAGE` | fits a body to one picture with marked joints |
| `torchcss track VIDEO` | tracks a body through a video |
| `torchcss smooth TRACK` | makes one smooth trajectory of a track's modes |
| `torchcss export TRACK` | writes a track for another program |
| `torchcss view TRACK` | shows a track in space over its pictures (rerun) |
| `torchcss plot TRACK` | draws its modes, trajectories and uncertainties as PNG files |

Bad input ends with one line on standard error and exit status 2; Ctrl-C with status 130. What was
tracked until then is on disk.
"""

from __future__ import annotations

import sys
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from torchcss.app.live import LiveViewer
from torchcss.app.smooth import report, smooth
from torchcss.app.track import track_video
from torchcss.cli.export import Export
from torchcss.cli.init import Init
from torchcss.cli.smooth import Smooth
from torchcss.cli.view import Plot, View
from torchcss.errors import ConfigurationError, OutputError, TorchcssError
from torchcss.io.keypoints.read import Scale
from torchcss.io.view_files import ViewFiles
from torchcss.studies.demo import run_demo
from torchcss.tracking.settings import TERMS, Settings, named_terms


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Track an arm that moves in depth before clutter, and compare with the truth."""

    out: Path = Path("out/demo")
    """Folder for track.npz, summary.json, overlay.mp4 and the rendered input."""
    seed: int = 0
    """Seed of the rendering and of the tracker."""
    frames: int = 50
    """Number of frames, 25 per second."""
    preset: str = "css"
    """Tracker, see torchcss.tracking.presets."""
    samples: int | None = None
    """Samples per frame; the preset's number by default."""
    terms: tuple[str, ...] = TERMS
    """Terms and priors of the cost; `default` stands for the default ones, `still` for those for a
    camera that stands still, `papers` for those of the papers."""
    device: str = "cpu"
    """Where to compute."""
    dtype: Literal["float64", "float32"] = "float64"
    """Floating type."""

    def run(self) -> None:
        """Run the verb."""
        settings = Settings(
            body="arm8",
            preset=self.preset,
            samples=self.samples,
            keypoints_use="first",
            terms=named_terms(self.terms),
            seed=self.seed,
            device=self.device,
            dtype=self.dtype,
        )
        summary = run_demo(self.out, settings=settings, num_frames=self.frames)
        print(
            f"{summary['num_frames']} frames, {summary['seconds_per_frame']:.2f} s each\n"
            f"mean error of the best mode   {summary['mpjpe_mm']:6.1f} mm\n"
            f"mean error, best of the modes {summary['mpjpe_best_of_modes_mm']:6.1f} mm\n"
            f"look at {self.out / 'overlay.mp4'}"
        )


@dataclass(frozen=True, kw_only=True)
class Track:
    """Track a body through a video, and write track.npz, summary.json and overlay.mp4."""

    video: Annotated[Path, tyro.conf.Positional]
    """A video in any container, or a folder of images."""
    camera: Path
    """Calibration: cameras.json, a Pose2Sim .toml, or EasyMocap's intri.yml."""
    keypoints: Path
    """2D joints: OpenPose folder, COCO, AlphaPose, MediaPipe or clicked joints as JSON, CSV (also
    DeepLabCut's), NPZ (also VideoPose3D's: FILE.npz#SUBJECT/ACTION/CAMERA)."""
    out: Path = Path("out/track")
    """Output folder."""
    init: Path | None = None
    """A fitted body that `torchcss init` wrote for the first frame, to start from."""
    camera_name: str | None = None
    """Camera in the file; by default the one whose video this is."""
    body: str = "body34"
    """arm7, arm8, body30, body32 or body34, or a file: URDF, MJCF or BVH."""
    keypoints_use: Literal["first", "all"] = "all"
    """Keypoints as an observation in every frame, or only to start, as the papers do."""
    layout: str | None = None
    """Layout of a keypoint file that does not name its joints, e.g. BODY_25."""
    normalised: Scale = "pixels"
    """Whether keypoints are pixels, or fractions of the image from 0 to 1 or from -1 to 1."""
    start: int = 0
    """First frame."""
    stop: int | None = None
    """Frame before which to end."""
    stride: int = 1
    """Track every so many frames."""
    working_size: int = 640
    """Longer image side, in pixels, on which features are computed."""
    preset: str = "css"
    """Tracker, see torchcss.tracking.presets."""
    samples: int | None = None
    """Samples per frame; the preset's number by default."""
    modes: int | None = None
    """Modes kept; the preset's number by default."""
    prediction: Literal["velocity", "surface"] = "velocity"
    """Where the trunk of a mode is expected: where its own last motion leads, or where its surface
    has gone in the picture, for a person who turns."""
    oversampling: int = 1
    """Draw so many times as many samples; those with the best edges descend."""
    evidence: float | None = None
    """How much one frame counts in the weights of modes, above 0 and at most 1; the preset's number
    by default."""
    limb_jumps: int = 0
    """Most other poses that join the search for an arm for which the colours do not speak."""
    terms: tuple[str, ...] = TERMS
    """Terms and priors of the cost; `default` stands for the default ones, `still` for those for a
    camera that stands still, `papers` for those of the papers."""
    contour_weight: float = Settings.contour_weight
    """Temperature of the contour term, nats."""
    weights: dict[str, float] = field(default_factory=dict)
    """Further factors on terms and priors, such as contour 2 flow 0.5."""
    boundary_emphasis: float = Settings.boundary_emphasis
    """k of the motion-boundary weights W = 1 - k S_p, for the term motion_boundaries."""
    masks: Path | None = None
    """Foreground of every frame: a video or a folder of images of the video's size."""
    other_videos: tuple[Path, ...] = ()
    """Videos of further synchronised cameras of the same calibration file."""
    other_keypoints: tuple[Path, ...] = ()
    """2D joints of each of them; none: their pictures speak alone."""
    other_offsets: tuple[int, ...] = ()
    """Frame of each of them at the time of the first video's frame 0, by default 0."""
    other_cameras: tuple[str, ...] = ()
    """Camera of each of them in the file; by default the one whose video it is."""
    overlay: bool = True
    """Write overlay.mp4, and overlay_2.mp4 and so on of further cameras."""
    recovery: bool = True
    """Tell from the costs when the track is lost, and search more widely then."""
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
    seed: int = 0
    """Seed of all random numbers."""
    device: str = "cpu"
    """Where to compute."""
    dtype: Literal["float64", "float32"] = "float64"
    """Floating type."""

    def run(self) -> None:
        """Run the verb."""
        settings = Settings(
            body=self.body,
            preset=self.preset,
            samples=self.samples,
            modes=self.modes,
            prediction=self.prediction,
            oversampling=self.oversampling,
            evidence=self.evidence,
            limb_jumps=self.limb_jumps,
            keypoints_use=self.keypoints_use,
            terms=named_terms(self.terms),
            working_size=self.working_size,
            contour_weight=self.contour_weight,
            weights=self.weights,
            boundary_emphasis=self.boundary_emphasis,
            seed=self.seed,
            device=self.device,
            dtype=self.dtype,
            overlay=self.overlay,
            recovery=self.recovery,
        )
        others = self.others()
        live = None
        if self.live or self.live_connect is not None or self.live_save is not None:
            live = LiveViewer(
                self.out.name,
                save=self.live_save,
                connect=self.live_connect,
                spawn=self.live and self.live_connect is None,
            )
        with nullcontext() if live is None else closing(live):
            summary = track_video(
                self.video,
                camera=self.camera,
                keypoints=self.keypoints,
                out=self.out,
                settings=settings,
                camera_name=self.camera_name,
                start=self.start,
                stop=self.stop,
                stride=self.stride,
                layout=self.layout,
                normalised=self.normalised,
                masks=self.masks,
                init=self.init,
                live=live,
                others=others,
            )
        print(
            f"{summary['num_frames']} frames, {summary['seconds_per_frame']:.2f} s each; "
            f"track, summary{' and overlay' if self.overlay else ''} are in {self.out}"
        )
        if self.smooth or self.smooth_images:
            done = smooth(self.out, images=self.smooth_images)
            print(report(done.summary["smoothed"]))

    def others(self) -> list[ViewFiles]:
        """What the further cameras recorded."""
        count = len(self.other_videos)
        for name in ("other_keypoints", "other_offsets", "other_cameras"):
            if len(getattr(self, name)) not in (0, count):
                raise ConfigurationError(
                    f"--{name.replace('_', '-')}: expected one for each of the {count} other "
                    f"videos, or none at all; got {len(getattr(self, name))}"
                )
        return [
            ViewFiles(
                video=video,
                keypoints=keypoints,
                camera_name=name,
                layout=self.layout,
                normalised=self.normalised,
                offset=offset,
            )
            for video, keypoints, offset, name in zip(
                self.other_videos,
                self.other_keypoints or (None,) * count,
                self.other_offsets or (0,) * count,
                self.other_cameras or (None,) * count,
                strict=True,
            )
        ]


Verb = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Init, tyro.conf.subcommand("init")]
    | Annotated[Track, tyro.conf.subcommand("track")]
    | Annotated[Smooth, tyro.conf.subcommand("smooth")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Plot, tyro.conf.subcommand("plot")]
)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: What follows `torchcss`; the process's own arguments by default.

    Returns:
        The exit status.
    """
    verb = tyro.cli(Verb, prog="torchcss", args=arguments, description=__doc__)  # type: ignore[arg-type]
    try:
        verb.run()
    except TorchcssError as error:
        print(f"torchcss: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        # A disk that fills up or goes away in mid-write.
        print(f"torchcss: {OutputError(str(error))}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("torchcss: interrupted; the frames tracked so far are on disk", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
