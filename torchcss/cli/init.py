"""The verb `torchcss init`: a body from one picture, or from one frame of a video."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from torchcss.app.init import PictureFiles, initialise_image
from torchcss.body.catalog import PROPORTIONS
from torchcss.cli.options import PathArgument
from torchcss.errors import ConfigurationError, KeypointError
from torchcss.files import load_json, prepare_output_folder
from torchcss.initialise.multi_start import PAPER_LENGTHS, StartSearch
from torchcss.initialise.options import InitialiseOptions
from torchcss.io.video import read_frame
from torchcss.tracking.settings import Settings
from torchcss.types import frozen


@frozen
class Init:
    """Fit pose, proportions and shape to one picture with marked joints."""

    image: PathArgument
    """The picture, or a video."""
    click: bool = False
    """Mark the joints by clicking in a window; they are saved as joints.json too."""
    out: Path = Path("out/init")
    """Folder for body.npz, the overlays, side.png, proportions.csv and summary.json."""
    body: str = Settings.body
    """arm7, arm8, body30, body32 or body34, or a URDF, MJCF or BVH file."""
    free_root: bool = InitialiseOptions.free_root
    """Let a body move about that by itself stands in one place, as robots from files do."""
    stature: float | None = InitialiseOptions.stature
    """Height of the standing person, metres; by default the prior sets the scale."""
    ground: float | None = InitialiseOptions.ground
    """Height of the floor that the person stands on, along the world's axis that points up, metres;
    it tells the size. In a camera's own frame: how far it is above the floor, with a minus."""
    proportions: Literal["all", "papers"] | None = None
    """All lengths (by default), or the papers' eight (places of hips, clavicles and skull tip)
    beside those of trunk and limbs."""
    initialisation: Literal["ours", "papers"] = "ours"
    """From many starts, or the papers' three stages: one fit from a coarse pose, no colours."""
    coarse_pose: Path | None = None
    """JSON file of a pose to start from: radians by parameter of the body."""
    hypotheses: Literal["best", "all"] | int | None = None
    """How many hypotheses to keep: best, all, or a number; by default 8."""
    contours: bool = InitialiseOptions.contours
    """Fit cross-sections and tapers to the picture's contours too."""
    colours: bool | None = None
    """Let these fits see the colours on either side of the outline too, as by default."""
    sigma: float | None = InitialiseOptions.sigma
    """Noise of a marked wrist or a robot's joint, pixels; by default 0.6 % of the body's size."""
    seed: int = Settings.seed
    """Seed of all random numbers."""
    device: str = Settings.device
    """Where to compute."""
    dtype: Literal["float64", "float32"] = Settings.dtype
    """Floating type."""
    engine: Literal["fused", "eager"] = InitialiseOptions.engine
    """What evaluates the costs: compiled kernels, on a CPU, or the terms as they are written."""
    files: Annotated[PictureFiles, tyro.conf.OmitArgPrefixes] = PictureFiles()

    def run(self) -> None:
        """Run the verb."""
        files, keypoints = self.files, None
        if self.initialisation == "papers":
            self._check_papers()
        if self.click == (files.keypoints is not None):
            raise KeypointError("give a file with --keypoints, or --click to mark the joints")
        if self.click:
            # Matplotlib takes half a second to import.
            from torchcss.show.click import click_joints, write_clicked

            picture = read_frame(self.image, files.frame)
            prepare_output_folder(self.out)  # before the work of clicking
            keypoints = click_joints(picture, body=self.body)
            size = (picture.shape[1], picture.shape[0])
            write_clicked(self.out / "joints.json", keypoints, size, frame=files.frame)
        proportions = PAPER_LENGTHS if self.proportions == "papers" else PROPORTIONS
        kept = InitialiseOptions.num_modes if self.hypotheses is None else self.hypotheses
        options = InitialiseOptions(
            sigma=self.sigma,
            stature=self.stature,
            ground=self.ground,
            num_modes={"best": 1, "all": None}.get(str(kept), kept),  # type: ignore[arg-type]
            contours=self.contours,
            colours=InitialiseOptions.colours if self.colours is None else self.colours,
            search=StartSearch(proportions=proportions, coarse_pose=_coarse_pose(self.coarse_pose)),
            dtype=torch.float32 if self.dtype == "float32" else torch.float64,
            device=self.device,
            free_root=self.free_root,
            engine=self.engine,
        )
        if self.initialisation == "papers":
            options = options.as_papers()
        found, summary = initialise_image(
            self.image,
            self.out,
            files=files,
            keypoints=keypoints,
            body=self.body,
            seed=self.seed,
            options=options,
        )
        print("\n".join(found.report))
        if summary["proportions"]:
            print(f"{'length':16}{'fitted, m':>12}{'standard, m':>14}{'difference':>12}")
        for row in summary["proportions"]:
            print(
                f"{row['name']:16}{row['fitted_m']:12.3f}{row['standard_m']:14.3f}"
                f"{row['difference_percent']:+11.1f} %"
            )
        print(f"{len(found.cost)} hypotheses in {summary['seconds']:.1f} s; look at {self.out}")

    def _check_papers(self) -> None:
        """Refuse what the papers' stages have otherwise."""
        theirs = {"hypotheses": "best", "colours": False, "proportions": "papers"}
        given = {name: getattr(self, name) for name in theirs}
        if other := [f"--{n}" for n, value in given.items() if value not in (None, theirs[n])]:
            raise ConfigurationError(
                f"{', '.join(other)}: not with --initialisation papers, which keeps the best of "
                "one fit, without colours, of the papers' proportions; leave it out"
            )


def _coarse_pose(path: Path | None) -> dict[str, float]:
    if path is None:
        return {}
    pose: Any = load_json(path, ConfigurationError)
    if not isinstance(pose, dict) or not all(
        isinstance(value, int | float) and math.isfinite(value) for value in pose.values()
    ):
        example = '{"l_elbow_flexion": 1.2}'
        raise ConfigurationError(f"{path}: expected numbers by parameter, such as {example}")
    return pose
