"""From a picture and its joints, as files, to a fitted body and pictures of it.

`initialise_image` is what `torchcss init` calls. It writes

| file | content |
|---|---|
| `body.npz` | the fitted body and its hypotheses; `torchcss track --init` takes it |
| `stage1.png`, `stage2.png`, `stage3.png` | the best fit after every stage, over the picture |
| `hypotheses.png` | the hypotheses over the picture |
| `side.png` | the hypotheses from the front, obliquely and from the side |
| `proportions.csv` | fitted lengths beside the standard humanoid's |
| `summary.json` | what was run, found and assumed |
"""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchcss.errors import CameraError
from torchcss.files import prepare_output_folder, replace_file
from torchcss.initialise.fit import default_camera, initialise
from torchcss.initialise.multi_start import Search
from torchcss.initialise.result import Initialisation, stature_of
from torchcss.io.cameras import check_image_size, read_camera
from torchcss.io.fitted_body import FITTED_BODY_NAME, write_fitted_body
from torchcss.io.keypoints.one_image import Joints, read_joints
from torchcss.io.keypoints.read import Scale
from torchcss.io.tracks import write_summary
from torchcss.io.video import read_frame
from torchcss.show.initialisation_views import draw_fit, draw_hypotheses, proportion_table
from torchcss.tracking.settings import check_seed
from torchcss.vision.camera import Camera

NUM_DRAWN = 7
"""Hypotheses drawn at most."""


def initialise_image(
    image: Path,
    *,
    joints: Path | Joints,
    out: Path,
    frame: int = 0,
    camera: Path | None = None,
    camera_name: str | None = None,
    focal_px: float | None = None,
    field_of_view_degrees: float | None = None,
    body: str = "body34",
    stature: float | None = None,
    num_modes: int | None = 8,
    contours: bool = True,
    colours: bool = True,
    layout: str | None = None,
    normalised: bool | Scale = False,
    sigma: float | None = None,
    search: Search | None = None,
    seed: int = 0,
    device: str = "cpu",
    dtype: torch.dtype = torch.float64,
) -> tuple[Initialisation, dict[str, Any]]:
    """Initialise from a picture and write the results.

    Args:
        image: The picture, or a video.
        joints: File of the marked joints, or the joints.
        out: Output folder.
        frame: Which frame of the video.
        camera: Calibration file; None: a pinhole camera.
        camera_name: Camera in the file.
        focal_px: Focal length of the pinhole camera, pixels.
        field_of_view_degrees: Its angle between left and right border, instead.
        body: Name of a body that ships.
        stature: Height of the standing person, metres.
        num_modes: Most hypotheses; None for all.
        contours: Fit shape to contours too.
        colours: Let that fit see the colours on either side of the outline.
        layout: Layout of a joints file that does not name its joints.
        normalised: Whether joints are fractions of the image, and which, see
            `torchcss.io.keypoints.read.Scale`.
        sigma: Noise of a marked wrist, pixels.
        search: How widely interpretations are looked for.
        seed: Seed of all random numbers.
        device: Where to compute.
        dtype: Floating type.

    Returns:
        What was found, and the summary.

    Raises:
        TorchcssError: With one line that says what was wrong, for any bad input.
    """
    check_seed(seed)
    picture = read_frame(image, frame)
    height, width = picture.shape[:2]
    prepare_output_folder(out)
    if camera is None:
        eye, note = default_camera(
            width, height, focal_px=focal_px, field_of_view_degrees=field_of_view_degrees
        )
        notes = [note]
    else:
        if focal_px is not None or field_of_view_degrees is not None:
            raise CameraError("give a camera file, a focal length or a field of view, not several")
        loaded = read_camera(camera, camera_name=camera_name, video=image)
        check_image_size(loaded.camera, width, height)
        eye = loaded.camera
        notes = [f"camera: {eye.name}", *([loaded.units_note] if loaded.units_note else [])]
    if not isinstance(joints, Joints):
        joints = read_joints(
            joints,
            image_size_wh=(width, height),
            layout=layout,
            normalised=normalised,
            frame=frame,
        )
    began = time.perf_counter()
    found = initialise(
        picture,
        torch.cat([joints.keypoints, joints.confidence[:, None]], dim=1),
        eye,
        body,
        joint_names=joints.joint_names,
        generator=torch.Generator().manual_seed(seed),
        sigma=sigma,
        stature=stature,
        num_modes=num_modes,
        contours=contours,
        colours=colours,
        search=search,
        dtype=dtype,
        device=device,
    )
    seconds = time.perf_counter() - began
    found = found._replace(report=(*notes, *joints.report, *found.report))
    eye = eye.to(dtype=dtype, device=device)
    marked = torch.where(joints.confidence[:, None] > 0, joints.keypoints, torch.nan)
    write_fitted_body(out / FITTED_BODY_NAME, found, eye)
    _draw(out, found, picture, eye, marked)
    rows = proportion_table(found.lengths, found.scale)
    with replace_file(out / "proportions.csv") as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["name", "fitted_m", "standard_m", "difference_percent"])
        writer.writeheader()
        writer.writerows(rows)
    summary: dict[str, Any] = {
        "image": image,
        "frame": frame,
        "camera": eye.name,
        "body": body,
        "seed": seed,
        "contours": contours,
        "colours": colours,
        "seconds": seconds,
        "report": found.report,
        "num_hypotheses": len(found.cost),
        "cost": found.cost,
        "stages": {stage.name: stage.cost for stage in found.stages},
        "proportions": rows,
    }
    if "shank" in found.lengths:
        summary["stature_m"] = stature_of(found.lengths, found.scale)
        summary["stature_known"] = stature is not None
    write_summary(out / "summary.json", summary)
    return found, summary


def _draw(out: Path, found: Initialisation, picture: Any, camera: Camera, marked: Tensor) -> None:
    pictures = {
        f"stage{number}.png": draw_fit(
            picture, stage.body, stage.state[None], camera, keypoints=marked,
            text=f"stage {number}: {stage.name}",
        )
        for number, stage in enumerate(found.stages, start=1)
    }  # fmt: skip
    mixture, shown = found.mixture, found.mixture.mean[:NUM_DRAWN]
    pictures["hypotheses.png"] = draw_fit(
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
        Image.fromarray(picture).save(partial, format="PNG")
