"""From a frame to the features that the cost compares with the body.

A frame comes as a decoder gives it: grey `[h, w]`, RGB `[h, w, 3]` or RGBA `[h, w, 4]`, in eight or
sixteen bits or in floating point from 0 to 1. `FeatureExtractor` turns it into grey levels at the
working size, finds its edges (see `torchcss.vision.edges`) and, if it has a flow configuration and
the frame before, the motion from there to here (`torchcss.vision.flow` and `.boundaries`).

The motion is marked *unusable* where the two frames show different things or nothing: after a scene
cut, which leaves more of the image unexplained than any motion does, and when a frame is of one
colour. Then the flow is zero, an outlier everywhere, and no motion boundary is known. A frame shown
twice is no such case: its flow is zero, and rightly so.

Everything in `FrameFeatures` is at the working size; `working_camera` is the camera that belongs to
it. `FrameFeatures.edge_field` is what the contour terms search: edges weighted by motion boundaries
and foreground.

By default: `FeatureExtractor(working_size=640)`, once, then `extractor(frame)` for every frame. For
the features of motion too: `FeatureExtractor(flow=TRACKING, ...)` and `extractor(frame, previous)`.
"""

from __future__ import annotations

from types import EllipsisType
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.kernels import compiler
from torchcss.vision.boundaries import motion_boundaries
from torchcss.vision.camera import Camera
from torchcss.vision.edges import EdgeConfiguration, Image, edge_features, foreground_weight
from torchcss.vision.flow import FlowConfiguration, robust_flow

RawImage = UInt8[Tensor, "h w"] | UInt8[Tensor, "h w c"] | Image | Float[Tensor, "h w c"]
"""A picture: grey, RGB or RGBA, 8 or 16 bits or floating point in 0..1."""

_WHITE = {torch.uint8: 255.0, torch.uint16: 65535.0}
"""The value of white in the integer types that frames come in."""

_CUT_SHARE = 0.3
"""Mean outlier of constant brightness from which two frames are of different scenes: between what
frames half a second apart reach, and what cuts have."""

_DISCONTINUITY_DOUBT = 0.5
"""How far a pixel whose neighbours move otherwise is in doubt. Below 1, since a small, fast limb is
all boundary."""

_FLAT_RANGE = 1.0 / 255.0
"""Range of grey levels up to which a frame is of one colour."""


class Window(NamedTuple):
    """A rectangle of whole pixels of the working size.

    Attributes:
        left: First column.
        top: First row.
        right: Column after the last.
        bottom: Row after the last.
        spare: So many pixels at each side are for the motion to the coming frame alone: what is
            looked at was inside the rest in the frame before.
    """

    left: int
    top: int
    right: int
    bottom: int
    spare: int = 0

    def before(self, height: int, width: int) -> Window:
        """Where it was in the frame before, of an image of a size.

        What is cut off by the image's end keeps its place: how much is, is not known.
        """
        return Window(
            self.left + (self.spare if self.left > 0 else 0),
            self.top + (self.spare if self.top > 0 else 0),
            self.right - (self.spare if self.right < width else 0),
            self.bottom - (self.spare if self.bottom < height else 0),
        )

    @property
    def pixels(self) -> tuple[EllipsisType, slice, slice]:
        """The index of its pixels in an image `[... h w]`."""
        return (..., slice(self.top, self.bottom), slice(self.left, self.right))


class FrameFeatures(NamedTuple):
    """What the terms of the cost see of one frame, at the working size.

    Edges and motion may have been looked for in a window only. Outside it there are no edges, the
    flow is an outlier, and no motion boundary is known.

    Attributes:
        grey: Grey levels in 0..1.
        edge_energy: Edge energy in [0, 1).
        edge_direction: Unit vector (along u, along v) from dark to bright; zero without an edge.
        flow: Optical flow from the frame before to this one, pixels (u right, v down), at the
            pixels of the frame before; None if not computed.
        flow_outlier: Where the flow is in doubt, in 0..1, be it for its brightness or because a
            neighbour moves otherwise; 1 everywhere if it is unusable; None if not computed.
        motion_boundary: Motion-boundary potential S_p in 0..1, section 3.1.2 [IJRR]: low on the
            boundaries, 1 elsewhere; None if not computed.
        mask: Foreground in 0..1; None if none was given.
        colour: Red, green, blue in 0..1, three times the same for a grey frame; None if not asked
            for.
        window: Where the frame was looked at; None: everywhere.
    """

    grey: Image
    edge_energy: Image
    edge_direction: Float[Tensor, "2 h w"]
    flow: Float[Tensor, "2 h w"] | None = None
    flow_outlier: Image | None = None
    motion_boundary: Image | None = None
    mask: Image | None = None
    colour: Float[Tensor, "3 h w"] | None = None
    window: Window | None = None

    def edge_field(self, *, boundary_emphasis: float = 0.3) -> Float[Tensor, "2 h w"]:
        """Edge energy times direction, weighted by motion boundaries and foreground.

        The weight of section 3.1.2 [IJRR], `W = 1 - k S_p`, and that of `foreground_weight`, each
        where the frame has what it needs.

        Args:
            boundary_emphasis: k. Zero weights all edges alike, one excludes those that are on no
                motion boundary; the paper found 0.2 to 0.4 to work well.

        Returns:
            A vector (along u, along v) per pixel, of length less than one.

        Raises:
            ConfigurationError: If k is not in 0..1.
        """
        energy = self.edge_energy
        for weight in self._edge_weights(boundary_emphasis):
            energy = energy * weight
        return energy * self.edge_direction

    def edge_weight(self, *, boundary_emphasis: float = 0.3) -> Image:
        """The weights of `edge_field` alone, one where nothing weighs the edges.

        Args:
            boundary_emphasis: See `edge_field`.
        """
        weight = torch.ones_like(self.edge_energy)
        for factor in self._edge_weights(boundary_emphasis):
            weight = weight * factor
        return weight

    def _edge_weights(self, boundary_emphasis: float) -> list[Tensor]:
        if not 0.0 <= boundary_emphasis <= 1.0:
            raise ConfigurationError(f"boundary_emphasis must lie in 0..1, got {boundary_emphasis}")
        weights = []
        if self.motion_boundary is not None:
            weights.append(1.0 - boundary_emphasis * self.motion_boundary)
        if self.mask is not None:
            weights.append(foreground_weight(self.mask))
        return weights


class FeatureExtractor(nn.Module):
    """Turns frames into features, in the dtype and on the device of the module.

    Args:
        edges: Choices of the edge detector; None takes its defaults.
        flow: Choices of the optical flow, for a video `TRACKING` of `torchcss.vision.flow`; None:
            no features of motion.
        working_size: Longer side of the features in pixels; larger frames are reduced to it,
            smaller ones are left as they are. None: never reduce.
        colour: Keep the colours, for terms that look at them.

    Attributes:
        luma: Weights of red, green and blue in the grey image.

    Raises:
        ConfigurationError: If the working size is not a positive whole number.
    """

    luma: Float[Tensor, " 3"]

    def __init__(
        self,
        *,
        edges: EdgeConfiguration | None = None,
        flow: FlowConfiguration | None = None,
        working_size: int | None = None,
        colour: bool = False,
    ) -> None:
        super().__init__()
        if working_size is not None and (working_size < 1 or int(working_size) != working_size):
            raise ConfigurationError(
                f"working_size must be a positive number of pixels, got {working_size}"
            )
        self.edges = edges or EdgeConfiguration()
        self.flow = flow
        self.working_size = working_size
        self.colour = colour
        # Rec. 601, the weights of video decoders; single precision, whatever torch's default is.
        luma = torch.tensor([0.299, 0.587, 0.114], dtype=torch.float32)
        self.register_buffer("luma", luma, persistent=False)

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
        frame: RawImage | np.ndarray,
        previous: RawImage | np.ndarray | FrameFeatures | None = None,
        mask: Bool[Tensor, "h w"] | Image | np.ndarray | None = None,
        *,
        window: Window | None = None,
    ) -> FrameFeatures:
        """Extract the features of one frame.

        Args:
            frame: Grey `[h, w]`, RGB `[h, w, 3]` or RGBA `[h, w, 4]` (alpha is ignored), uint8,
                uint16, or floating point in 0..1.
            previous: The frame before, of the same size, or its features; None, or an extractor
                without flow configuration: no features of motion.
            mask: Foreground of the frame, of the same size: boolean, or in the types of `frame`.
            window: Where to look for edges and motion; None: everywhere.

        Raises:
            ShapeError: If a picture is of another shape or type, empty, or outside 0..1 or not
                finite, or if the pictures differ in size.
        """
        size = tuple(frame.shape[:2])
        for name, other in (("previous", previous), ("mask", mask)):
            if other is None or isinstance(other, FrameFeatures):
                continue
            if tuple(other.shape[:2]) != size:
                raise ShapeError(
                    f"{name}: expected the frame's size {list(size)}, got {list(other.shape[:2])}"
                )
        planes = self._planes("frame", frame)
        grey = self._luma(planes)
        # Single precision is far finer than the edges, and twice as fast.
        seen = (grey if window is None else grey[window.pixels]).float()
        edges = edge_features(seen, self.edges)
        features = FrameFeatures(
            grey=grey,
            edge_energy=_within(window, grey, edges.energy, 0.0),
            edge_direction=_within(window, grey, edges.direction, 0.0),
            mask=None if mask is None else self._luma(self._planes("mask", mask)),
            colour=planes.expand(3, -1, -1) if self.colour else None,
            window=window,
        )
        if previous is None or self.flow is None:
            return features
        if isinstance(previous, FrameFeatures):
            return self._with_motion(features, previous.grey, self.flow)
        return self._with_motion(
            features, self._luma(self._planes("previous", previous)), self.flow
        )

    def _with_motion(
        self, features: FrameFeatures, previous: Image, choice: FlowConfiguration
    ) -> FrameFeatures:
        """Add flow, outlier map and motion boundaries."""
        grey, window = features.grey, features.window
        if window is not None:
            # Flow is of the pixels of the frame before.
            window = window.before(*grey.shape)
        before, now = (
            picture if window is None else picture[window.pixels] for picture in (previous, grey)
        )
        if not _is_flat(before) and not _is_flat(now):
            # Single precision is far finer than the flow's error, and twice as fast.
            flow = robust_flow(before.float(), now.float(), choice)
            if float(flow.data_outlier.mean()) < _CUT_SHARE:
                doubt = _DISCONTINUITY_DOUBT * flow.smoothness_outlier
                held = (1.0 - flow.data_outlier) * (1.0 - doubt)
                boundary = motion_boundaries(flow)
                return features._replace(
                    flow=_within(window, grey, flow.flow, 0.0),
                    flow_outlier=_within(window, grey, 1.0 - held, 1.0),
                    motion_boundary=_within(window, grey, boundary, 1.0),
                )
        return features._replace(
            flow=grey.new_zeros(2, *grey.shape),
            flow_outlier=torch.ones_like(grey),
            motion_boundary=torch.ones_like(grey),
        )

    def _luma(self, planes: Float[Tensor, "c h w"]) -> Image:
        """Grey levels of a picture of one colour or three."""
        return planes[0] if len(planes) == 1 else (self.luma[:, None, None] * planes).sum(0)

    def _planes(self, name: str, picture: Tensor | np.ndarray) -> Float[Tensor, "c h w"]:
        """A picture as levels in 0..1 at the working size, its one or three colours first.

        Pictures of whole numbers are reduced in single precision, which holds them exactly.
        """
        if not isinstance(picture, Tensor):
            # A copy only where torch cannot share the memory: read-only or mirrored arrays.
            if not picture.flags.writeable or min(picture.strides, default=0) < 0:
                picture = picture.copy()
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
        planes = picture[None] if grey else picture[..., :3].permute(2, 0, 1)
        planes = planes.to(self.luma.device)
        height, width = planes.shape[-2:]
        width, height = self.working_shape(width, height)
        size = height, width
        if picture.dtype in _WHITE:
            small = _shrunk(planes, size).to(self.luma)
            return small.div_(_WHITE[picture.dtype]).clamp_(0.0, 1.0)
        planes = planes.to(self.luma).contiguous()
        least, greatest = (float(bound) for bound in planes.aminmax())
        if not (least >= -1.0e-3 and greatest <= 1.0 + 1.0e-3):
            raise ShapeError(
                f"{name}: expected floating-point levels in 0..1, got {least:g} to {greatest:g}; "
                "divide by the value of white"
            )
        return _resized(planes.clamp(0.0, 1.0), size).clamp(0.0, 1.0)


def _shrunk(planes: Int[Tensor, "c h w"], size: tuple[int, int]) -> Float[Tensor, "c y x"]:
    """Planes of whole numbers at another height and width, in single precision."""
    compiled = compiler.COMPILED and not torch.compiler.is_compiling()
    if planes.shape[1:] == size or not compiled or planes.device.type != "cpu":
        planes = planes.to(torch.float32, memory_format=torch.contiguous_format)
        return _resized(planes, size)
    from torchcss.vision.resample_kernels import resize, triangles

    small = torch.empty(len(planes), *size, dtype=torch.float32)
    resize(planes.permute(1, 2, 0), small, triangles)
    return small


def _resized(planes: Float[Tensor, "c h w"], size: tuple[int, int]) -> Float[Tensor, "c y x"]:
    """Planes at another height and width, if it is another one."""
    if planes.shape[1:] == size:
        return planes
    return functional.interpolate(
        planes[None], size=size, mode="bilinear", align_corners=False, antialias=True
    )[0]


def _within(
    window: Window | None, like: Image, part: Float[Tensor, "*c y x"], other: float
) -> Float[Tensor, "*c h w"]:
    """What was found in a window as an image of the whole frame, one number elsewhere."""
    part = part.to(like)
    if window is None:
        return part
    whole = like.new_full((*part.shape[:-2], *like.shape), other)
    whole[window.pixels] = part
    return whole


def _is_flat(grey: Image) -> bool:
    least, greatest = grey.aminmax()
    return float(greatest - least) <= _FLAT_RANGE
