"""The verb `torchcss smooth`: one trajectory through the modes of a whole track.

With the track alone it takes seconds. With video, camera and keypoints it also fits the trajectory
to the images again, which takes about as long as their features.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchcss.app.smooth import smooth_file, smooth_video
from torchcss.errors import ConfigurationError
from torchcss.io.fitted_body import read_fitted_body
from torchcss.io.keypoints.read import Scale
from torchcss.tracking.smooth import Smoothing
from torchcss.tracking.smooth_images import IMAGES


@dataclass(frozen=True, kw_only=True)
class Smooth:
    """Choose among the modes of a track with all frames in view, and smooth what was chosen."""

    track: Annotated[Path, tyro.conf.Positional]
    """track.npz, or the folder that it is in. It stays as it is."""
    out: Path | None = None
    """Folder for smooth.npz and summary.json; by default the track's folder."""
    evidence: float = Smoothing.evidence
    """Power of each frame's evidence when modes are chosen; below 1 because errors of images
    persist over frames."""
    persistence: float = Smoothing.persistence
    """How many frames say as much, in the covariances, as one that is independent."""
    agility: float | None = None
    """Expected accelerations over expected velocities, 1/s; lower is smoother. 10 by default, 20
    with a video."""
    video: Path | None = None
    """The video that was tracked: fit the trajectory to its images again."""
    camera: Path | None = None
    """Its calibration, as for track; needed with a video."""
    keypoints: Path | None = None
    """Its 2D joints, as for track; needed with a video."""
    camera_name: str | None = None
    """Camera in the file; by default the one whose video this is."""
    layout: str | None = None
    """Layout of a keypoint file that does not name its joints, e.g. BODY_25."""
    normalised: Scale = "pixels"
    """Whether keypoints are pixels, or fractions of the image from 0 to 1 or from -1 to 1."""
    masks: Path | None = None
    """Foreground of every frame: a video or a folder of images of the video's size."""
    body: Path | None = None
    """The fitted body, body.npz; by default the one beside the track, if any, else the flesh of the
    standard humanoid on the track's lengths."""

    def run(self) -> None:
        """Run the verb."""
        choice = replace(
            Smoothing() if self.video is None else IMAGES,
            evidence=self.evidence,
            persistence=self.persistence,
        )
        if self.agility is not None:
            choice = replace(choice, agility=self.agility)
        if self.video is None:
            self._refuse_options_of_images()
            body = None if self.body is None else read_fitted_body(self.body).body
            print(report(smooth_file(self.track, out=self.out, choice=choice, body=body)))
            return
        if self.camera is None or self.keypoints is None:
            raise ConfigurationError(
                "--video: the images can be fitted only with --camera and --keypoints; give both, "
                "or leave the video out"
            )
        done = smooth_video(
            self.track,
            video=self.video,
            camera=self.camera,
            keypoints=self.keypoints,
            out=self.out,
            choice=choice,
            camera_name=self.camera_name,
            layout=self.layout,
            normalised=self.normalised,
            masks=self.masks,
            body=self.body,
        )
        print(report(done))

    def _refuse_options_of_images(self) -> None:
        """Without a video, what tells of its images would be ignored."""
        given = {
            "--camera": self.camera is not None,
            "--keypoints": self.keypoints is not None,
            "--camera-name": self.camera_name is not None,
            "--layout": self.layout is not None,
            "--normalised": self.normalised != Smooth.normalised,
            "--masks": self.masks is not None,
        }
        if idle := [option for option, there in given.items() if there]:
            raise ConfigurationError(
                f"{', '.join(idle)}: of use only with --video, whose images are fitted then; give "
                "the video, or leave them out"
            )


def report(effect: dict[str, Any]) -> str:
    """What smoothing did, in a few lines.

    Args:
        effect: What `smooth_file` returned.
    """
    lines = [
        f"jitter {effect['jitter_before_m_per_s2']:.1f} to {effect['jitter_after_m_per_s2']:.1f} "
        f"m/s^2, joints moved by {effect['mean_change_mm']:.0f} mm in the mean",
        f"{effect['frames_not_the_trackers_best']} frames take another mode than the tracker's "
        f"best, {effect['path_switches']} switches between modes are left",
    ]
    blind = len(effect["frames_without_evidence"])
    if blind:
        lines.append(f"{blind} frames had no evidence and follow from their neighbours")
    if "mean_cost_after_images" in effect:
        lines.append(
            f"mean cost of a frame {effect['mean_cost_before_images']:.1f} to "
            f"{effect['mean_cost_after_images']:.1f} nats"
        )
    return "\n".join([*lines, f"wrote {effect['file']}"])
