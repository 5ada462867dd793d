"""The camera of a video that nobody calibrated: its focal length, told, read or assumed.

The principal point is the middle of the image, and there is no distortion. The focal length is what
the user says, else what the file says of its lens (`torchcss.io.video.focal_length_35mm`), else a
field of view in the middle of what telephones and cameras have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from torchcss.errors import CameraError
from torchcss.initialise.fit import default_camera
from torchcss.io.cameras import LoadedCamera
from torchcss.io.video import VideoReader, focal_length_35mm

_DIAGONAL_35MM = math.hypot(36.0, 24.0)


@dataclass(frozen=True, kw_only=True)
class Lens:
    """What is known of a lens.

    Attributes:
        focal: Focal length in pixels.
        fov: Angle between the left and the right border of the image, degrees.
    """

    focal: float | None = None
    fov: float | None = None

    def unless(self, calibration: Path) -> Path:
        """The calibration file, which says it all.

        Raises:
            CameraError: If a focal length is given beside it.
        """
        if self.focal is not None or self.fov is not None:
            raise CameraError("give --camera, --focal or --fov, not several")
        return calibration

    def camera_of(self, video: Path) -> LoadedCamera:
        """The camera of a video, in its own frame, and what was assumed.

        Raises:
            CameraError: If focal length or angle make no sense.
            VideoError: If the video cannot be read.
        """
        info = VideoReader(video).info
        size, focal, said = (info.width, info.height), self.focal, ""
        if focal is None and self.fov is None and (equivalent := focal_length_35mm(video)):
            focal = equivalent * math.hypot(*size) / _DIAGONAL_35MM
            said = f", from the file's own: {equivalent:g} mm on 35 mm film"
        camera, note = default_camera(*size, focal_px=focal, field_of_view_degrees=self.fov)
        if said:
            note = note.replace(", as given", said)
        return LoadedCamera(camera, metric=False, units_note=note, video=None)
