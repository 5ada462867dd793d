"""The camera of a video that nobody calibrated: its focal length, told, read or assumed.

The principal point is the middle of the image, and there is no distortion. The focal length is what
the user says, else what the file says of its lens (`torchcss.io.video.focal_length_35mm`), else it
is fitted to the keypoints (`torchcss.initialise.focal`) and held while tracking.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch

from torchcss.app.view_files import OpenView
from torchcss.errors import CameraError
from torchcss.initialise.fit import default_camera
from torchcss.initialise.focal import DEVIATION, fit_focal
from torchcss.initialise.options import InitialiseOptions
from torchcss.io.cameras import LoadedCamera
from torchcss.io.video import VideoReader, focal_length_35mm
from torchcss.tracking.settings import Settings
from torchcss.types import frozen
from torchcss.vision.camera import Camera

PERSONS = ("body30", "body32", "body34")
"""Bodies of people: a focal length is fitted to them, and their size is not known."""

_DIAGONAL_35MM = math.hypot(36.0, 24.0)

_OF_FILE = 0.05
"""Deviation of what a file says of its lens (ours): a film is often cropped, to steady it."""


@frozen
class KnownLens:
    """What is known of a lens.

    Attributes:
        focal: Focal length in pixels.
        fov: Angle between the left and the right border of the image, degrees.
        source: Who says so.
        deviation: Standard deviation of its logarithm.

    Raises:
        CameraError: If focal length or angle make no sense.
    """

    focal: float | None = None
    fov: float | None = None
    source: str = "as given"
    deviation: float = 0.0

    def __post_init__(self) -> None:
        if None not in (self.focal, self.fov):
            raise CameraError("give --focal or --fov, not both")
        if self.focal is not None and not 0 < self.focal < math.inf:
            raise CameraError(f"--focal: expected a positive number of pixels, got {self.focal:g}")
        if self.fov is not None and not 0 < self.fov < 180:
            raise CameraError(f"--fov: expected degrees between 0 and 180, got {self.fov:g}")

    def unless(self, calibration: Path) -> Path:
        """The calibration file, which says it all.

        Raises:
            CameraError: If a focal length is given beside it.
        """
        if self.is_known:
            raise CameraError("give --camera, --focal or --fov, not several")
        return calibration

    def of(self, video: Path) -> KnownLens:
        """The lens, with what the video's file says of it where the user says nothing.

        Raises:
            VideoError: If the video cannot be read.
        """
        if self.is_known or (equivalent := focal_length_35mm(video)) is None:
            return self
        info = VideoReader(video).info
        focal = equivalent * math.hypot(info.width, info.height) / _DIAGONAL_35MM
        source = f"from the file's own {equivalent:g} mm on 35 mm film"
        return KnownLens(focal=focal, source=source, deviation=_OF_FILE)

    @property
    def is_known(self) -> bool:
        """Whether the focal length is told."""
        return self.focal is not None or self.fov is not None

    def camera(self, width: int, height: int) -> LoadedCamera:
        """A camera of this image size, in its own frame, and what was assumed."""
        if not self.is_known:
            camera, note = default_camera(width, height)
            return LoadedCamera(camera, False, note, DEVIATION)
        camera = Camera.pinhole(width, height, focal_px=self.focal, field_of_view_degrees=self.fov)
        note = f"camera: pinhole, focal length {float(camera.K[0, 0]):.0f} px, {self.source}"
        return LoadedCamera(camera, False, note, self.deviation)


def fitted(view: OpenView, settings: Settings) -> OpenView:
    """The view of a camera whose focal length is fitted to its keypoints, for a person's body.

    Args:
        view: The view of a camera that was assumed; as it is where the body is no person's.
        settings: How to track.
    """
    if view.keypoints is None or settings.body not in PERSONS:
        return view
    size = view.camera.camera.image_size_wh
    found = fit_focal(
        settings.body,
        view.keypoints,
        size,
        options=InitialiseOptions(
            sigma=view.sigma,
            stature=settings.stature,
            pose_prior="pose_prior" in settings.used_terms,
            engine=settings.engine,
        ),
        generator=torch.Generator().manual_seed(settings.seed),
    )
    angle = 2 * math.degrees(math.atan(0.5 * max(size) / found.pixels))
    how = f"fitted to {found.num_frames} frames" if found.num_frames else "assumed, too little seen"
    note = (
        f"camera: not given; focal length {found.pixels:.0f} px ({angle:.0f} degrees along the "
        f"longer side), {how}, known to {100 * found.deviation:.0f} %: distances are as uncertain; "
        "say --focal or --fov if you know it"
    )
    camera = Camera.pinhole(*size, focal_px=found.pixels, name="fitted")
    return view._replace(camera=LoadedCamera(camera, False, note, found.deviation))
