"""The keypoints that one camera sees at a moment, before there is a body to compare them with."""

from __future__ import annotations

from typing import NamedTuple

from torchcss.types import Keypoints
from torchcss.vision.camera import Camera


class View(NamedTuple):
    """One camera's keypoints.

    Attributes:
        camera: The camera of the image.
        keypoints: In that image's pixels; None if there are none.
    """

    camera: Camera
    keypoints: Keypoints | None = None

    def of_keypoints(self, factor: float) -> View:
        """The same keypoints in a picture that is so many times as large."""
        camera, keypoints = self.camera.scaled(factor), self.keypoints
        if keypoints is not None:
            keypoints = keypoints.scaled(self.camera.image_size_wh, camera.image_size_wh)
        return View(camera, keypoints)
