"""From a picture and its joints, as files, to a fitted body and pictures of it.

`initialise_image` is what `torchcss init` calls. It writes

| file | content |
|---|---|
| `body.npz` | the fitted body and its hypotheses; `torchcss track --init` takes it |
| `stage1.png`, `stage2.png`, `stage3.png` | the best fit after every stage, over the picture |
| `hypotheses.png` | the hypotheses over the picture |
| `side.png` | the hypotheses from the front, obliquely and from the side |
| `proportions.csv` | fitted lengths beside the standard humanoid's; not for bodies from files |
| `summary.json` | what was run, found and assumed |
"""

from __future__ import annotations

import csv
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from torchcss.app.lens import KnownLens
from torchcss.body.catalog import PROPORTIONS
from torchcss.body.load import load_body
from torchcss.errors import KeypointError
from torchcss.files import prepare_output_folder, replace_file
from torchcss.initialise.fit import initialise
from torchcss.initialise.multi_start import PAPER_LENGTHS, StartSearch
from torchcss.initialise.noise import Noise
from torchcss.initialise.options import LEAST_JOINTS, InitialiseOptions
from torchcss.initialise.result import Initialisation, stature_of
from torchcss.initialise.view import CameraView
from torchcss.io.cameras import check_image_size, load_camera
from torchcss.io.fitted_body import FITTED_BODY_NAME, write_fitted_body
from torchcss.io.keypoints.links import Links
from torchcss.io.keypoints.one_image import read_joints
from torchcss.io.keypoints.read import Scale
from torchcss.io.tracks import write_summary
from torchcss.io.video import read_frame
from torchcss.joint_names import names_in
from torchcss.show.overlay import draw_poses
from torchcss.tracking.presets import PRESETS
from torchcss.tracking.settings import Settings, check_seed
from torchcss.types import Keypoints, frozen
from torchcss.vision.camera import Camera

NUM_DRAWN = 7
"""Hypotheses drawn at most."""


@frozen
class PictureFiles:
    """What belongs to a picture: its keypoints and its camera.

    Attributes:
        frame: Which frame of the video, from 0; `torchcss track --start` takes the same number.
        keypoints: Marked joints: clicked JSON, CSV, OpenPose, COCO, MediaPipe or NPZ.
        layout: Layout of a keypoints file that does not name its joints, e.g. BODY_25.
        normalised: Whether joints are pixels, or fractions of the picture from 0 to 1 or from -1
            to 1.
        camera: Calibration; without it a pinhole camera of --focal, --fov or 54 degrees.
        camera_name: Camera in the file; by default the one whose picture this is.
        focal: Focal length in pixels.
        fov: Angle between the left and the right border of the picture, degrees.
    """

    frame: int = 0
    keypoints: Path | None = None
    layout: str | None = None
    normalised: Scale = "pixels"
    camera: Path | None = None
    camera_name: str | None = None
    focal: float | None = None
    fov: float | None = None

    def read_camera(self, image: Path, width: int, height: int) -> tuple[Camera, list[str]]:
        """The camera of a picture of this size, and what is to be said about it.

        Raises:
            CameraError: If it cannot be read, is of another size, or is given twice.
        """
        lens = KnownLens(focal=self.focal, fov=self.fov)
        if self.camera is None:
            loaded, name = lens.camera(width, height), None
        else:
            loaded = load_camera(lens.unless(self.camera), self.camera_name, video=image)
            check_image_size(loaded.camera, width, height)
            name = f"camera: {loaded.camera.name}"
        return loaded.camera, [note for note in (name, loaded.units_note) if note]

    def read_joints(self, width: int, height: int, links: Links) -> Keypoints:
        """The joints in a picture of this size, and of a body with names of its own.

        Raises:
            KeypointError: If they cannot be read.
        """
        if self.keypoints is None:
            raise KeypointError("give a file with --keypoints, or --click to mark the joints")
        return read_joints(
            self.keypoints,
            image_size_wh=(width, height),
            layout=self.layout,
            normalised=self.normalised,
            frame=self.frame,
            links=links,
        )


def initialise_image(
    image: Path,
    out: Path,
    *,
    files: PictureFiles,
    keypoints: Keypoints | None = None,
    body: str = "body34",
    seed: int = 0,
    options: InitialiseOptions | None = None,
) -> tuple[Initialisation, dict[str, Any]]:
    """Initialise from a picture and write the results.

    Args:
        image: The picture, or a video.
        out: Output folder.
        files: Its camera and its joints.
        keypoints: The joints, if they are not in a file.
        body: Name of a body that ships, or a URDF, MJCF or BVH file.
        seed: Seed of all random numbers.
        options: How to look, and what to fit.

    Returns:
        What was found, and the summary.

    Raises:
        TorchcssError: With one line that says what was wrong, for any bad input.
    """
    check_seed(seed)
    options = options or InitialiseOptions()
    picture = read_frame(image, files.frame)
    from torchcss.show.initialisation_views import proportion_table

    height, width = picture.shape[:2]
    prepare_output_folder(out)
    camera, notes = files.read_camera(image, width, height)
    keypoints = keypoints or files.read_joints(width, height, load_body(body).joint_of_name)
    began, generator = time.perf_counter(), torch.Generator().manual_seed(seed)
    found = initialise(picture, keypoints, camera, body, generator=generator, options=options)
    seconds = time.perf_counter() - began
    found = found._replace(report=(*notes, *keypoints.report, *found.report))
    camera = camera.to(dtype=options.dtype, device=options.device)
    write_fitted_body(out / FITTED_BODY_NAME, found, camera)
    _draw(out, found, picture, camera, keypoints)
    rows = proportion_table(found.lengths, found.scale)
    if rows:  # bodies from files keep their lengths
        _write_proportions(out / "proportions.csv", rows)
    summary: dict[str, Any] = {
        "image": image,
        "frame": files.frame,
        "camera": camera.name,
        "body": body,
        "seed": seed,
        "contours": options.contours,
        "colours": options.colours,
        "seconds": seconds,
        "report": found.report,
        "num_hypotheses": len(found.cost),
        "cost": found.cost,
        "stages": {stage.name: stage.cost for stage in found.stages},
        "proportions": rows,
    }
    if "shank" in found.lengths:
        summary["stature_m"] = stature_of(found.lengths, found.scale)
        summary["stature_known"] = options.stature is not None
    write_summary(out / "summary.json", summary)
    return found, summary


def _write_proportions(path: Path, rows: Sequence[dict[str, object]]) -> None:
    with replace_file(path) as partial, partial.open("w", newline="") as file:
        table = csv.DictWriter(file, names_in("name fitted_m standard_m difference_percent"))
        table.writeheader()
        table.writerows(rows)


def initialise_video(
    video: Path,
    keypoints: Keypoints,
    camera: Camera,
    settings: Settings,
    *,
    start: int,
    noise: Noise,
    generator: torch.Generator,
    others: Sequence[CameraView] = (),
) -> Initialisation:
    """Fit pose, proportions and shape to the frame where tracking starts, as the settings say.

    Args:
        video: A video, or a folder of images.
        keypoints: Its keypoints in every frame.
        camera: Its camera.
        settings: Body, terms, working size, type and device. A paper's preset has the paper's
            priors (`InitialiseOptions.printed`) and proportions (`PAPER_LENGTHS`).
        start: The frame.
        noise: Noise of the keypoints.
        generator: Source of the starting poses.
        others: What further cameras see of that moment, see `initialise`.

    Raises:
        TorchcssError: If the frame cannot be read, or too few joints are known in it.
    """
    paper = PRESETS[settings.preset].cost
    options = InitialiseOptions(
        sigma=noise.sigma,
        stature=settings.stature,
        ground=settings.ground,
        learn_noise=noise.is_guess,
        least_joints=LEAST_JOINTS,
        pose_prior="pose_prior" in settings.used_terms,
        printed=None if paper == "ours" else paper,
        search=StartSearch(proportions=PROPORTIONS if paper == "ours" else PAPER_LENGTHS),
        contours="contour" in settings.used_terms,
        colours="region" in settings.used_terms,
        working_size=settings.working_size,
        dtype=settings.torch_dtype,
        device=settings.device,
        free_root=settings.free_root,
        engine=settings.engine,
    )
    return initialise(
        read_frame(video, start),
        keypoints.at(start),
        camera,
        settings.body,
        generator=generator,
        options=options,
        others=others,
    )


def _draw(
    out: Path, found: Initialisation, picture: Any, camera: Camera, keypoints: Keypoints
) -> None:
    from torchcss.show.initialisation_views import draw_hypotheses

    known = torch.where(keypoints.known[:, None], keypoints.positions, torch.nan)
    pictures = {
        f"stage{number}.png": draw_poses(
            picture, stage.body, stage.state[None], camera, keypoints=known,
            text=f"stage {number}: {stage.name}",
        )
        for number, stage in enumerate(found.stages, start=1)
    }  # fmt: skip
    mixture, shown = found.mixture, found.mixture.mean[:NUM_DRAWN]
    pictures["hypotheses.png"] = draw_poses(
        picture, found.body, shown, camera, weights=mixture.weight[:NUM_DRAWN],
        text=f"{len(shown)} of {len(mixture.mean)} hypotheses",
    )  # fmt: skip
    for name, drawn in pictures.items():
        write_png(out / name, drawn)
    draw_hypotheses(out / "side.png", found.body, shown, camera, cost=found.cost[:NUM_DRAWN])


def write_png(path: Path, picture: Any) -> None:
    """Write a picture `[h, w, 3]` of bytes.

    Raises:
        OutputError: If it cannot be written.
    """
    from PIL import Image

    with replace_file(path) as partial:
        Image.fromarray(picture).save(partial, format="PNG", compress_level=1)
