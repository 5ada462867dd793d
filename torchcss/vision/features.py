"""From a frame to the features that the cost compares with the body.

A frame comes as a decoder gives it: grey `[h, w]`, RGB `[h, w, 3]` or RGBA `[h, w, 4]`, in eight or
sixteen bits or in floating point from 0 to 1. `FeatureExtractor` turns it into grey levels at the
working size and finds its edges (see `torchcss.vision.edges`).

Everything in `FrameFeatures` is at the working size; `working_camera` is the camera that belongs to
it.

By default: `FeatureExtractor(working_size=640)`, once, then `extractor(frame)` for every frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.vision.camera import Camera
from torchcss.vision.edges import EdgeConfiguration, edge_features

Frame = (
    UInt8[Tensor, "h w"] | UInt8[Tensor, "h w c"] | Float[Tensor, "h w"] | Float[Tensor, "h w c"]
)
"""A picture: grey, RGB or RGBA, 8 or 16 bits or floating point in 0..1."""

_WHITE = {torch.uint8: 255.0, torch.uint16: 65535.0}
"""The value of white in the integer types that frames come in."""


class FrameFeatures(NamedTuple):
    """What the terms of the cost see of one frame, at the working size.

    Attributes:
        grey: Grey levels in 0..1.
        edge_energy: Edge energy in [0, 1).
        edge_direction: Unit vector (along u, along v) from dark to bright; zero without an edge.
        flow: Optical flow from the frame before to this one, pixels; None if not computed.
        flow_outlier: Outlier map of the flow in 0..1; None if not computed.
        motion_boundary: Motion-boundary potential S_p in 0..1, section 3.1.2 [IJRR]; None if not
            computed.
        mask: Foreground in 0..1; None if none was given.
    """

    grey: Float[Tensor, "h w"]
    edge_energy: Float[Tensor, "h w"]
    edge_direction: Float[Tensor, "2 h w"]
    flow: Float[Tensor, "2 h w"] | None = None
    flow_outlier: Float[Tensor, "h w"] | None = None
    motion_boundary: Float[Tensor, "h w"] | None = None
    mask: Float[Tensor, "h w"] | None = None


class FeatureExtractor(nn.Module):
    """Turns frames into features, in the dtype and on the device of the module.

    Args:
        edges: Choices of the edge detector; None takes its defaults.
        working_size: Longer side of the features in pixels; larger frames are reduced to it,
            smaller ones are left as they are. None: never reduce.

    Raises:
        ConfigurationError: If the working size is not a positive whole number.
    """

    luma: Float[Tensor, " 3"]

    def __init__(
        self, *, edges: EdgeConfiguration | None = None, working_size: int | None = None
    ) -> None:
        super().__init__()
        if working_size is not None and (working_size < 1 or int(working_size) != working_size):
            raise ConfigurationError(
                f"working_size must be a positive number of pixels, got {working_size}"
            )
        self.edges = edges or EdgeConfiguration()
        self.working_size = working_size
        # Rec. 601, the weights of video decoders.
        self.register_buffer("luma", torch.tensor([0.299, 0.587, 0.114]), persistent=False)

    def working_shape(self, width: int, height: int) -> tuple[int, int]:
        """Return the width and height of the features of a frame of the given size."""
        longer = max(width, height)
        if self.working_size is None or longer <= self.working_size:
            return width, height
        factor = self.working_size / longer
        return max(1, round(width * factor)), max(1, round(height * factor))

    def working_camera(self, camera: Camera) -> Camera:
        """Return the camera of the features of the frames that `camera` takes."""
        return camera.resized(*self.working_shape(*camera.image_size_wh))

    def forward(
        self,
        frame: Frame | np.ndarray,
        previous: Frame | np.ndarray | None = None,
        mask: Bool[Tensor, "h w"] | Float[Tensor, "h w"] | np.ndarray | None = None,
    ) -> FrameFeatures:
        """Extract the features of one frame.

        Args:
            frame: Grey `[h, w]`, RGB `[h, w, 3]` or RGBA `[h, w, 4]` (alpha is ignored), uint8,
                uint16, or floating point in 0..1.
            previous: The frame before, of the same size. The features of motion, which need it, are
                not computed yet and stay None.
            mask: Foreground of the frame, of the same size: boolean, or in the types of `frame`.

        Raises:
            ShapeError: If a picture is of another shape or type, empty, or outside 0..1 or not
                finite, or if the pictures differ in size.
        """
        grey = self._grey("frame", frame)
        height, width = grey.shape
        for name, other in (("previous", previous), ("mask", mask)):
            if other is not None and tuple(other.shape[:2]) != (height, width):
                raise ShapeError(
                    f"{name}: expected the frame's size [{height}, {width}], got "
                    f"{list(other.shape[:2])}"
                )
        grey = self._resized(grey)
        edges = edge_features(grey, self.edges)
        return FrameFeatures(
            grey=grey,
            edge_energy=edges.energy,
            edge_direction=edges.direction,
            mask=None if mask is None else self._resized(self._grey("mask", mask)),
        )

    def _grey(self, name: str, picture: Tensor | np.ndarray) -> Float[Tensor, "h w"]:
        """Convert a picture to grey levels in 0..1, with the dtype and device of the module."""
        if not isinstance(picture, Tensor):
            # A copy only where torch cannot share the memory: read-only or mirrored arrays.
            picture = np.require(picture, requirements=["C", "W"])
            try:
                picture = torch.from_numpy(picture)
            except (TypeError, ValueError) as error:
                raise ShapeError(
                    f"{name}: expected uint8, uint16 or floating-point pixels, got {picture.dtype}"
                ) from error
        known = (
            picture.dtype in _WHITE or picture.is_floating_point() or picture.dtype == torch.bool
        )
        grey = picture.ndim == 2
        if not known or picture.numel() == 0 or not (grey or picture.shape[2:] in ((3,), (4,))):
            raise ShapeError(
                f"{name}: expected a picture [h, w], [h, w, 3] or [h, w, 4] of uint8, uint16 or "
                f"floating point in 0..1, got {picture.dtype} {list(picture.shape)}"
            )
        levels = picture.to(self.luma)
        levels = levels if grey else levels[..., :3] @ self.luma
        if picture.dtype in _WHITE:
            return levels / _WHITE[picture.dtype]
        least, greatest = (float(bound) for bound in levels.aminmax())
        if not (least >= -1.0e-3 and greatest <= 1.0 + 1.0e-3):
            raise ShapeError(
                f"{name}: expected floating-point levels in 0..1, got {least:g} to {greatest:g}; "
                "divide by the value of white"
            )
        return levels.clamp(0.0, 1.0)

    def _resized(self, picture: Float[Tensor, "h w"]) -> Float[Tensor, "h w"]:
        height, width = picture.shape
        new_width, new_height = self.working_shape(width, height)
        if (new_width, new_height) == (width, height):
            return picture
        return functional.interpolate(
            picture[None, None],
            size=(new_height, new_width),
            mode="bilinear",
            align_corners=False,
            antialias=True,
        )[0, 0].clamp(0.0, 1.0)
