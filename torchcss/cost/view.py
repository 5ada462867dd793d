"""What one camera sees of a frame: the images and marks that a cost compares a pose with.

`TrackingCost` is itself a view, that of its first camera, and takes any number of others; the
observations of all views are independent given the pose, so that their costs add up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cost.flow import FlowTargets
from torchcss.cost.region import RegionImages
from torchcss.cost.segmentation import SegmentationImages
from torchcss.cost.silhouette import SilhouetteImages
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera
from torchcss.vision.spline import SplineField


@dataclass(frozen=True, kw_only=True)
class View:
    """One camera's part of a frame. What is None says nothing.

    Attributes:
        camera: The camera of the image that the features were computed on.
        edge_field: Edge energy times gradient direction; None switches the contour term off.
        energy: The edge energy as a smooth function; None switches the edge-energy term off.
        region: What the pixels look like, as smooth functions; None switches the region term off.
        segmentation: What the pixels look like, for the weights of modes; None: not known.
        silhouette: What is before the background; None: not known.
        targets: Where the flow carried the nodes of each sample's parent mode, `[b p 2]`.
        keypoints: Of the frame, in that image's pixels, or one set for each sample; None if there
            are none.
    """

    camera: Camera
    edge_field: Float[Tensor, "2 h w"] | None = None
    energy: SplineField | None = None
    region: RegionImages | None = None
    segmentation: SegmentationImages | None = None
    silhouette: SilhouetteImages | None = None
    targets: FlowTargets | None = None
    keypoints: Keypoints | None = None

    def of_parents(self, parent: Int[Tensor, " b"]) -> Self:
        """The view for samples of some modes, each with the flow of the mode that it came from."""
        return self if self.targets is None else replace(self, targets=self.targets.take(parent))

    def of_samples(self, items: Int[Tensor, " b"]) -> Self:
        """The view for some of the samples, where each has targets of its own."""
        view = self
        if self.targets is not None and self.targets.uv.dim() > 2:
            view = replace(view, targets=self.targets.take(items))
        if self.keypoints is not None and self.keypoints.confidence.dim() > 1:
            view = replace(view, keypoints=self.keypoints.at(items))
        return view

    def of_keypoints(self, factor: float) -> View:
        """The keypoints alone, as they are in a picture that is so many times as large."""
        camera, keypoints = self.camera.scaled(factor), self.keypoints
        if keypoints is not None:
            keypoints = keypoints.scaled(self.camera.image_size_wh, camera.image_size_wh)
        return View(camera=camera, keypoints=keypoints)
