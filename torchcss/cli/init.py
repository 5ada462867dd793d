"""The verb `torchcss init`: a body from one picture, or from one frame of a video."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from torchcss.app.init import PictureFiles, initialise_image
from torchcss.body.catalog import PROPORTIONS
from torchcss.errors import KeypointError
from torchcss.files import prepare_output_folder
from torchcss.initialise.multi_start import PAPER_PROPORTIONS, Search
from torchcss.initialise.options import InitialiseOptions
from torchcss.io.keypoints.read import Scale
from torchcss.io.video import read_frame
from torchcss.show.click import click_joints, write_clicked
from torchcss.types import Keypoints


@dataclass(frozen=True, kw_only=True)
class Init:
    """Fit pose, proportions and shape to one picture with marked joints."""

    image: Annotated[Path, tyro.conf.Positional]
    """The picture, or a video."""
    frame: int = 0
    """Which frame of the video, from 0; `torchcss track --start` takes the same number."""
    joints: Path | None = None
    """Marked joints: clicked JSON, CSV, OpenPose, COCO, MediaPipe or NPZ."""
    click: bool = False
    """Mark the joints by clicking in a window; they are saved as joints.json too."""
    camera: Path | None = None
    """Calibration; without it a pinhole camera of --focal-px, --field-of-view or 54 degrees."""
    camera_name: str | None = None
    """Camera in the file; by default the one whose picture this is."""
    focal_px: float | None = None
    """Focal length in pixels."""
    field_of_view: float | None = None
    """Angle between the left and the right border of the picture, degrees."""
    out: Path = Path("out/init")
    """Folder for body.npz, the overlays, side.png, proportions.csv and summary.json."""
    body: str = "body34"
    """arm7, arm8, body30, body32 or body34, or a URDF, MJCF or BVH file."""
    stature: float | None = None
    """Height of the standing person, metres; by default the prior sets the scale."""
    proportions: Literal["all", "papers"] = "all"
    """Lengths to fit: all, or the papers' (hips, clavicles, neck and skull)."""
    hypotheses: Literal["best", "all"] | int = 8
    """How many hypotheses to keep: best, all, or a number."""
    contours: bool = True
    """Fit cross-sections and tapers to the picture's contours too."""
    colours: bool = True
    """Let these fits see the colours on either side of the outline too."""
    layout: str | None = None
    """Layout of a joints file that does not name its joints, e.g. BODY_25."""
    normalised: Scale = "pixels"
    """Whether joints are pixels, or fractions of the picture from 0 to 1 or from -1 to 1."""
    sigma: float | None = None
    """Noise of a marked wrist, pixels; by default 0.6 % of the person's size."""
    seed: int = 0
    """Seed of all random numbers."""
    device: str = "cpu"
    """Where to compute."""
    dtype: Literal["float64", "float32"] = "float64"
    """Floating type."""

    def run(self) -> None:
        """Run the verb."""
        if self.click == (self.joints is not None):
            raise KeypointError("give a file with --joints, or --click to mark the joints")
        keypoints: Path | Keypoints | None = self.joints
        if keypoints is None:
            picture = read_frame(self.image, self.frame)
            keypoints = click_joints(picture)
            prepare_output_folder(self.out)
            size = (picture.shape[1], picture.shape[0])
            write_clicked(self.out / "joints.json", keypoints, size, frame=self.frame)
        files = PictureFiles(
            image=self.image,
            frame=self.frame,
            keypoints=keypoints,
            layout=self.layout,
            normalised=self.normalised,
            camera=self.camera,
            camera_name=self.camera_name,
            focal_px=self.focal_px,
            field_of_view_degrees=self.field_of_view,
        )
        proportions = PAPER_PROPORTIONS if self.proportions == "papers" else PROPORTIONS
        options = InitialiseOptions(
            sigma=self.sigma,
            stature=self.stature,
            num_modes={"best": 1, "all": None}.get(str(self.hypotheses), self.hypotheses),  # type: ignore[arg-type]
            contours=self.contours,
            colours=self.colours,
            search=Search(proportions=proportions),
            dtype=torch.float32 if self.dtype == "float32" else torch.float64,
            device=self.device,
        )
        found, summary = initialise_image(
            files, self.out, body=self.body, seed=self.seed, options=options
        )
        print("\n".join(found.report))
        print(f"{'length':16}{'fitted, m':>12}{'standard, m':>14}{'difference':>12}")
        for row in summary["proportions"]:
            print(
                f"{row['name']:16}{row['fitted_m']:12.3f}{row['standard_m']:14.3f}"
                f"{row['difference_percent']:+11.1f} %"
            )
        print(f"{len(found.cost)} hypotheses in {summary['seconds']:.1f} s; look at {self.out}")
