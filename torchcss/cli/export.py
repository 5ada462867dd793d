"""The verb `torchcss export`: a track for another program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from torchcss.cli.options import GivenOptions, PathArgument
from torchcss.io.export import ExportOptions, Format, export
from torchcss.io.run import Given, Run
from torchcss.types import frozen


@frozen
class Export:
    """Write a track as BVH, TRC, C3D, MOT, SMPL parameters, or a table with uncertainties."""

    track: PathArgument
    """The run's folder, or a track's file in it."""
    to: Format
    """bvh: skeleton and turns; trc, c3d: joints as markers, metres; mot: joint angles, degrees;
    angles: the same as CSV, with standard deviations; csv, npz: joints with covariances; npz-smpl:
    SMPL's pose parameters. c3d needs ezc3d."""
    out: Path | None = None
    """File, or folder for files of the usual names; by default the run's folder."""
    options: Annotated[ExportOptions, tyro.conf.OmitArgPrefixes] = ExportOptions()
    given: GivenOptions = Given()

    def run(self) -> None:
        """Run the verb."""
        run = Run.open(self.track, self.given)
        done = export(run, self.out, to=self.to, options=self.options)
        for line in (*done.report, *(f"wrote {path}" for path in done.paths)):
            print(line)
