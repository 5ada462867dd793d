"""The verbs `torchcss view`, `plot` and `report`: a finished track to look at."""

from __future__ import annotations

import shlex
from pathlib import Path

from torchcss.cli.options import GivenOptions, PathArgument, tell_outside
from torchcss.io.run import Given, Run
from torchcss.show.track_pictures import known_video, without_pictures
from torchcss.types import frozen


def _opened(track: Path, given: Given) -> Run:
    """The run, whose video may lie outside its folder."""
    run = Run.open(track, given)
    tell_outside(run, [known_video(run)], [given.video])
    return run


def _tell_missing(run: Run) -> None:
    """Say which frames have no pictures, if there are such."""
    if (told := without_pictures(run)) is not None:
        print(told)


@frozen
class View:
    """Look at a track in the rerun viewer, or save a recording of it that needs no video."""

    track: PathArgument
    """The run's folder, or a track's file in it (track.npz, smooth.npz)."""
    save: Path | None = None
    """Write a recording, FILE.rrd, instead of opening a viewer; `rerun FILE.rrd` opens it."""
    connect: str | None = None
    """Address of a viewer that runs, instead of opening one."""
    given: GivenOptions = Given()

    def run(self) -> None:
        """Run the verb."""
        from torchcss.show.viewer import view_track

        run = _opened(self.track, self.given)
        view_track(run, save=self.save, connect=self.connect, anew=self.given.video is not None)
        _tell_missing(run)
        if self.save is not None:
            print(f"wrote {self.save}; open it with: rerun {shlex.quote(str(self.save))}")


@frozen
class Plot:
    """Draw a track's modes, trajectories with uncertainties, and frames, as PNG files."""

    track: PathArgument
    """The run's folder, or a track's file in it (track.npz, smooth.npz)."""
    out: Path | None = None
    """Folder for the figures; by default `plots` (`smooth_plots`) in the run's folder."""
    frame: int | None = None
    """Frame that is seen from the side; by default the one with the most explanations."""
    given: GivenOptions = Given()

    def run(self) -> None:
        """Run the verb."""
        from torchcss.show.posterior_plots import plot_track

        run = _opened(self.track, self.given)
        anew = self.given.video is not None
        for path in plot_track(run, self.out, frame=self.frame, anew=anew):
            print(f"wrote {path}")
        _tell_missing(run)


@frozen
class Report:
    """Write report.html: film, figures, what was assumed and how to go on, on one page."""

    track: PathArgument
    """The run's folder, or a track's file in it (track.npz, smooth.npz)."""
    given: GivenOptions = Given()

    def run(self) -> None:
        """Run the verb."""
        from torchcss.show.report import write_report_page

        run = _opened(self.track, self.given)
        print(f"wrote {write_report_page(run, anew=self.given.video is not None)}")
        _tell_missing(run)
