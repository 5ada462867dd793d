"""What cameras send, and what one of them sees of a frame: the input side of the loop.

A camera that sends pictures of one colour, or none any more, is out: it says nothing until it is
back. `torchcss.tracking.session` and `torchcss.tracking.smooth_images` look through these at any
number of cameras.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.cost.frame import FrameCosts
from torchcss.cost.joints import JointObservation
from torchcss.cost.total import TrackingCost
from torchcss.errors import VideoError
from torchcss.stopwatch import Stopwatch
from torchcss.types import Frame
from torchcss.vision.appearance import Appearance
from torchcss.vision.background import Background
from torchcss.vision.camera import Camera
from torchcss.vision.contrast import local_contrast
from torchcss.vision.features import FeatureExtractor, FrameFeatures
from torchcss.vision.spline import SplineField, spline_field

Observe = Callable[[int], JointObservation | None]
"""Keypoints of a frame by its index, in pixels of the working image; None if there are none."""


class ViewStream(NamedTuple):
    """What a further camera sends, one image for each of the first camera's.

    Attributes:
        frames: The images, in order; where they end before the first camera's, the view is out.
        camera: Camera of the full-size images, in the first one's world.
        observe: Keypoints by this stream's frames.
        masks: Foreground of each of the images, of their size; None: not known.
    """

    frames: Iterable[Frame]
    camera: Camera
    observe: Observe
    masks: Iterable[np.ndarray | Tensor] | None = None


class Watcher:
    """One camera's part of the loop: features, and what things look like in its images.

    Args:
        costs: Makes the costs of this camera's images.
        extractor: Makes the features.
        observe: Keypoints by frame.
        masks: Foreground of each of the images; None: not known.
        carries: Whether the image tells where the trunk is expected, see
            `torchcss.tracking.surface_prediction`.

    Attributes:
        features: Those of the image taken in last; None if the view is out.
        appearance: What body and surroundings look like; None: not known yet.
        background: What is behind the body; None: not known yet, or not asked for.
        contrasts: Local contrast of the image before and of the one taken in last; None where there
            is no picture, or nobody asks.
    """

    def __init__(
        self,
        costs: FrameCosts,
        extractor: FeatureExtractor,
        observe: Observe,
        masks: Iterable[np.ndarray | Tensor] | None,
        *,
        carries: bool = False,
    ) -> None:
        self.carries = carries
        self.costs, self.extractor, self.observe = costs, extractor, observe
        self.masks = None if masks is None else iter(masks)
        self.last: np.ndarray | None = None
        self.appearance: Appearance | None = None
        self.background: Background | None = None
        self.index: int | None = None
        self.features: FrameFeatures | None = None
        self.contrasts: tuple[SplineField | None, SplineField | None] = (None, None)

    def look(self, frame: Frame | None) -> None:
        """Take in the next image; None, or one of a single colour, is a view that is out."""
        self.contrasts = (self.contrasts[1], None)
        self.index, self.features = None if frame is None else frame.index, None
        if frame is None:
            self.last = None
            return
        mask = None
        if self.masks is not None and (mask := next(self.masks, None)) is None:
            raise VideoError(f"the masks end before frame {frame.index}; give one for every frame")
        # There is no flow out of or into a missing picture.
        if frame.image.size and frame.image.min() == frame.image.max():
            self.last = None
            return
        features = self.extractor(frame.image, self.last, mask)
        self.features, self.last, colour = features, frame.image, features.colour
        if self.carries:
            # Single precision is far finer than what is compared, and twice as fast.
            contrast = local_contrast(features.grey.float()).to(features.grey)
            self.contrasts = (self.contrasts[0], spline_field(contrast))
        if self.background is not None and colour is not None and not self.background.holds(colour):
            self.background = None

    def cost(
        self, body: BodyModel, before: Tensor | None, stopwatch: Stopwatch | None = None
    ) -> TrackingCost:
        """The cost of the image taken in last; `before` are the modes before it."""
        observation = None if self.index is None else self.observe(self.index)
        if observation is not None and observation.says_nothing:
            observation = None
        return self.costs(
            self.features,
            body=body,
            before=before,
            observation=observation,
            appearance=self.appearance,
            background=self.background,
            stopwatch=stopwatch,
        )

    def learn(self, body: BodyModel, modes: Tensor, log_weight: Tensor | None = None) -> None:
        """Take in what body, surroundings and background look like in that image.

        Args:
            body: The body on this frame's base.
            modes: Poses that it may have, `[k n]`, the best first.
            log_weight: Their weights; None: all the same.
        """
        self.appearance = self.costs.learn(self.appearance, self.features, body, modes[0])
        self.background = self.costs.learn_background(
            self.background,
            self.features,
            body,
            modes,
            modes.new_zeros(len(modes)) if log_weight is None else log_weight,
        )
