"""The verb `torchcss smooth`: one trajectory through the modes of a whole track.

With the track alone it takes seconds. With the images it takes about as long as their features.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import tyro

from torchcss.app.smooth import report, smooth
from torchcss.cli.options import (
    GivenOptions,
    PathArgument,
    Terminal,
    TerminalOptions,
    tell_outside,
)
from torchcss.errors import ConfigurationError
from torchcss.io.run import Given, GivenKeypoints, Run
from torchcss.io.view_files import PATHS
from torchcss.tracking.smooth import Smoothing
from torchcss.tracking.smooth_images import IMAGES
from torchcss.types import frozen


@frozen
class Smooth:
    """Choose among the modes of a track with all frames in view, and smooth what was chosen."""

    track: PathArgument
    """The run's folder, or its track.npz, which stays as it is."""
    out: Path | None = None
    """Folder for smooth.npz and summary.json; by default the run's folder."""
    images: bool = False
    """Fit the trajectory to the images of the run's cameras again; implied by --video."""
    likelihood_power: float | None = None
    """Power of what frames and motions say when modes are weighed; by default that of the track."""
    persistence: float | None = None
    """How many frames say as much, in the covariances, as one that is independent; by default each
    keeps the covariance of its mode."""
    acceleration_ratio: float | None = None
    """Expected accelerations over expected velocities, 1/s; lower is smoother. 10 by default, 20
    with images."""
    lag: int | None = None
    """Most frames after each one that may say something of it; all by default."""
    given: GivenOptions = Given()
    keypoints: Annotated[GivenKeypoints, tyro.conf.OmitArgPrefixes] = GivenKeypoints()
    terminal: TerminalOptions = Terminal()

    def run(self) -> None:
        """Run the verb."""
        images = self.images or self.given.video is not None
        given = [f"--{name}" for name, value in asdict(self.keypoints).items() if value is not None]
        if given and not images:
            raise ConfigurationError(
                f"{', '.join(given)}: of use only with --images, which are fitted then; give it, "
                "or leave them out"
            )
        choice = replace(
            IMAGES if images else Smoothing(),
            likelihood_power=self.likelihood_power,
            persistence=self.persistence,
            lag=self.lag,
        )
        if self.acceleration_ratio is not None:
            choice = replace(choice, acceleration_ratio=self.acceleration_ratio)
        run = Run.open(self.track, self.given, self.keypoints)
        with self.terminal.working():
            if images:
                files = [getattr(e.files, n, None) for e in run.cameras for n in PATHS]
                tell_outside(run, files, (self.given.video, *asdict(self.keypoints).values()))
            done = smooth(run, choice, images=images, out=self.out)
        self.terminal.tell(done.folder, report(done.summary["smoothed"]))
