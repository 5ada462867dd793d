"""A camera that looks on, with its keypoints: what a first pose and a track are found from."""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError, KeypointError
from torchcss.files import shortened
from torchcss.initialise.keypoint_checks import check_numbers, typical_sigma
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera


class CameraView(NamedTuple):
    """A camera that looks on, with the keypoints of its video, or of one image of it.

    Attributes:
        camera: Camera of the full-size images. All views share one world.
        keypoints: 2D keypoints by frame of its video, pixels of the full-size images; frames after
            the last of them have none. For a first pose, those of one image (`at`). None: none.
        sigma: Noise of a wrist's keypoint, pixels of the full-size images; None: a share of the
            person's size.
        offset: Its frame at the time of the first view's frame 0.
    """

    camera: Camera
    keypoints: Keypoints | None = None
    sigma: float | None = None
    offset: int = 0

    def at(self, frame: int) -> CameraView:
        """What it sees of one moment.

        Args:
            frame: Of the first view's video.
        """
        keypoints, own = self.keypoints, frame + self.offset
        if keypoints is not None:
            known = 0 <= own < len(keypoints.confidence)
            keypoints = keypoints.at(own) if known else None
        return self._replace(keypoints=keypoints)

    def to(self, like: Tensor) -> CameraView:
        """The same in the type and on the device of a tensor."""
        camera = self.camera.to(dtype=like.dtype, device=like.device)
        return self._replace(camera=camera, keypoints=self.keypoints and self.keypoints.to(like))

    def scaled(self, factor: float) -> CameraView:
        """The same in pictures that are so many times as large."""
        camera, keypoints, sigma = self.camera.scaled(factor), self.keypoints, self.sigma
        if keypoints is not None:
            keypoints = keypoints.scaled(self.camera.image_size_wh, camera.image_size_wh)
        return self._replace(
            camera=camera, keypoints=keypoints, sigma=None if sigma is None else factor * sigma
        )

    def relative_to(self, sigma: float) -> CameraView:
        """The same, its noise told as a multiple of another one, pixels."""
        keypoints = self.keypoints
        if keypoints is not None and self.sigma is not None:
            keypoints = keypoints._replace(relative_noise=self.sigma / sigma)
        return self._replace(keypoints=keypoints)

    def check(self, body: BodyModel) -> None:
        """Refuse keypoints that cannot be a body's in all frames.

        Args:
            body: The body.

        Raises:
            ConfigurationError: If their noise is no number, or the view is not of these types.
            ShapeError: If they are no tensors of a floating type, or not pairs of a joint each.
            KeypointError: If they are not those of all frames, or of none of the body's joints.
        """
        if not (isinstance(self.camera, Camera) and isinstance(self.keypoints, Keypoints | None)):
            raise ConfigurationError(
                "views: expected of each its Camera and Keypoints, if any, got "
                f"{type(self.camera).__name__} and {type(self.keypoints).__name__}"
            )
        if self.sigma is not None and not 0 < self.sigma < math.inf:
            raise ConfigurationError(f"sigma: expected a number of pixels, got {self.sigma}")
        if self.keypoints is None:
            return
        check_numbers(self.keypoints, frames=True)
        names = self.keypoints.names
        if len(names) and not set(names) & set(body.joint_names):
            raise KeypointError(
                f"{body.name} has none of the joints {shortened(', '.join(names))}; its own are "
                f"{shortened(', '.join(body.joint_names))}"
            )

    @property
    def noise(self) -> float:
        """Noise of a wrist's keypoint, pixels of the full-size images; 1 without keypoints."""
        if self.sigma is not None:
            return self.sigma
        if self.keypoints is None:
            return 1.0
        return typical_sigma(self.keypoints)
