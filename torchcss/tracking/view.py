"""What a camera sends, what is seen of a frame, and what is remembered: the loop's input side.

An `Observer` turns the frames of a camera (`CameraView`) into what the cost compares with; it holds
constants only. What is seen of a frame depends on the pictures alone (`observe`); what the cost
makes of it depends on what the body and its surroundings look like (`cost`), which is learnt from
the poses found (`learn`).

A camera that sends pictures of one colour, or none any more, is out: it says nothing until it is
back.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from torchcss.body.model import BodyModel
from torchcss.cost.frame import FrameCosts, Learnt
from torchcss.cost.total import TrackingCost
from torchcss.initialise.view import CameraView
from torchcss.stopwatch import Stopwatch
from torchcss.types import Frame, Keypoints, Vectors, frozen
from torchcss.vision.contrast import local_contrast
from torchcss.vision.features import FeatureExtractor, FrameFeatures, Window
from torchcss.vision.spline import SplineField, spline_field


class ViewObservation(NamedTuple):
    """What one camera sees of one moment.

    Attributes:
        frame: Its image; None from a camera that has ended.
        picture: The pixels of that image; None if the camera is out.
        features: Features of the image; None if the camera is out.
        contrast: Local contrast of the image; None if the camera is out, or nobody asks.
        contrast_before: The same of the image before.
    """

    frame: Frame | None
    picture: np.ndarray | None = None
    features: FrameFeatures | None = None
    contrast: SplineField | None = None
    contrast_before: SplineField | None = None


_RINGS, _MERIDIANS = 5, 8
"""Of the mesh by which it is found where a body can be."""

_MARGIN = 0.15
"""How far the body may get in two frames, as a share of its extent in the picture: a wrist at four
metres a second, at 25 frames a second, goes as far as a fifth of a person's height."""

_LEAST_MARGIN = 32
"""Pixels of the working size that edges are searched for beside a contour, and some more."""

_FEW = 64
"""Of so many rows one tells that a picture is not of one colour, as a rule."""

NOTHING_SEEN = ViewObservation(None)


@frozen
class Observer:
    """One camera's part of the loop.

    Attributes:
        view: The camera and its keypoints.
        costs: Makes the costs of this camera's images.
        extractor: Makes the features.
        relative_noise: Noise of this view's keypoints in the features' pixels, in multiples of what
            the keypoint term is told.
        contrast: Whether local contrast is wanted, for `torchcss.tracking.surface_prediction`.
    """

    view: CameraView
    costs: FrameCosts
    extractor: FeatureExtractor
    relative_noise: float = 1.0
    contrast: bool = False

    def over(self, intervals: float) -> Observer:
        """The same for a frame that comes so many intervals after the one before it."""
        return replace(self, costs=self.costs.over(intervals))

    def observe(
        self, frame: Frame | None, before: ViewObservation, window: Window | None = None
    ) -> ViewObservation:
        """See a frame.

        Args:
            frame: The image; None from a camera that has ended.
            before: What was seen of the moment before.
            window: Where the body can be; None: anywhere.
        """
        if frame is None or _is_of_one_colour(frame.image):
            return ViewObservation(frame, contrast_before=before.contrast)
        last = before.picture if before.features is None else before.features
        features = self.extractor(frame.image, last, frame.mask, window=window)
        contrast = None
        if self.contrast:
            # Single precision is far finer than what is compared, and twice as fast.
            contrast = spline_field(local_contrast(features.grey.float()).to(features.grey))
        return ViewObservation(frame, frame.image, features, contrast, before.contrast)

    def window(self, body: BodyModel, modes: Vectors) -> Window | None:
        """Where the body can be two frames after it was in one of these poses.

        None where it may be anywhere: where it is not seen, or where the background matters.

        Args:
            body: The body on the base of that frame.
            modes: The poses.
        """
        if body.num_parts == 0 or self.costs.choice.whole_picture:
            return None
        rotation, centre = body.part_poses(body.pose(modes))
        surface = body.mesh(_RINGS, _MERIDIANS).points.flatten(1, 2) @ rotation.mT
        uv, _, valid = self.costs.camera.project(surface + centre[..., None, :])
        if not bool(valid.all()) or not bool(uv.isfinite().all()):
            return None
        uv = uv.reshape(-1, 2)
        least, greatest = uv.amin(0), uv.amax(0)
        motion = _MARGIN * float((greatest - least).max())
        margin = _LEAST_MARGIN + motion
        width, height = self.costs.camera.image_size_wh
        left, top = (max(0, int(edge - margin)) for edge in least.tolist())
        right, bottom = (
            min(size, math.ceil(float(edge) + margin) + 1)
            for size, edge in zip((width, height), greatest, strict=True)
        )
        if right - left < _LEAST_MARGIN or bottom - top < _LEAST_MARGIN:
            return None
        return Window(left, top, right, bottom, int(motion / 2))

    def recall(self, known: Learnt, seen: ViewObservation) -> Learnt:
        """What is known still holds for a frame: the background of another scene does not."""
        colour = None if seen.features is None else seen.features.colour
        if known.background is None or colour is None or known.background.holds(colour):
            return known
        return known._replace(background=None)

    def cost(
        self,
        seen: ViewObservation,
        known: Learnt,
        body: BodyModel,
        before: Vectors | None,
        *,
        keypoints: bool = True,
        stopwatch: Stopwatch | None = None,
    ) -> TrackingCost:
        """The cost of a frame.

        Args:
            seen: What is seen of it.
            known: What was learnt from the frames before.
            body: The body on this frame's base.
            before: The modes of the frame before; None: no flow.
            keypoints: Whether keypoints count in this frame.
            stopwatch: Where the time of evaluations is added up.
        """
        return self.costs(
            seen.features,
            body=body,
            before=before,
            keypoints=self.keypoints_of(seen.frame, body) if keypoints else None,
            known=known,
            stopwatch=stopwatch,
        )

    def keypoints_of(self, frame: Frame | None, body: BodyModel) -> Keypoints | None:
        """The body's keypoints of a frame, in the features' pixels; None if there are none."""
        known = self.view.keypoints
        if known is None or frame is None or not 0 <= frame.index < len(known.confidence):
            return None
        full = self.view.camera.image_size_wh
        keypoints = known.at(frame.index).only(body.joint_names)
        if keypoints.says_nothing:
            return None
        keypoints = keypoints.scaled(full, self.extractor.working_shape(*full)).to(body.tie)
        return keypoints._replace(relative_noise=self.relative_noise)


def _is_of_one_colour(image: np.ndarray) -> bool:
    """Told by a few rows as a rule."""
    return all(bool(p.size) and p.min() == p.max() for p in (image[::_FEW], image))
