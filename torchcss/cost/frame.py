"""From the features of one frame to its cost: what a body, a camera and a choice of terms need.

`FrameCosts` holds what is the same in all frames: the contour predictor, the interior nodes, the
pairs of parts. Called with a frame's features and the modes of the frame before, it gives that
frame's `TrackingCost`, with a flow target for the nodes of every mode. A tracker descends from
samples of those modes; `TrackingCost.of_children` gives each sample the targets and the prior of
the mode that it came from, and is the `CostFactory` that `Tracker.step` takes.

    costs = FrameCosts(body, camera, choice, frame_interval=1 / 25, boundary_emphasis=0.3)
    cost = costs(features, body=body, before=state.mixture.mean, keypoints=keypoints)
    state, info = tracker.step(state, cost.of_children, body.bounds)

Several cameras have one `FrameCosts` each; `beside` makes one cost of what they give.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.cost.edge_energy import edge_energy_field
from torchcss.cost.flow import FlowTargets, InteriorNodes, flow_targets
from torchcss.cost.interpenetration import InterpenetrationPairs
from torchcss.cost.part_map import bare_pixels, part_map
from torchcss.cost.region import RegionImages, part_layers, region_field, region_masks
from torchcss.cost.silhouette import SilhouetteImages
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.cost.visibility import ContourPredictor, visible_nodes
from torchcss.stopwatch import Stopwatch
from torchcss.types import Keypoints
from torchcss.vision.appearance import Appearance
from torchcss.vision.background import Background
from torchcss.vision.camera import Camera
from torchcss.vision.features import FrameFeatures


class FrameCosts:
    """Makes the cost of one frame after another.

    Args:
        body: The body; later it may hang on another base.
        camera: Camera of the features.
        choice: Terms and weights.
        frame_interval: Seconds between frames, which scales the expected motion; 0: not known.
        boundary_emphasis: Weight of motion boundaries, see `FrameFeatures.edge_field`.

    Attributes:
        camera: Camera of the features, in the body's type and on its device.
        choice: Terms and weights.
        deviation: Expected motion of every parameter from one frame to the next; None: not known.
    """

    def __init__(
        self,
        body: BodyModel,
        camera: Camera,
        choice: CostChoice,
        *,
        frame_interval: float = 0.0,
        boundary_emphasis: float = 0.0,
    ) -> None:
        self.camera = camera.to(dtype=body.dtype, device=body.tie.device)
        self.choice = choice
        self.deviation = body.motion_rate * frame_interval if frame_interval else None
        self.boundary_emphasis = boundary_emphasis
        outlines = (choice.contour, choice.edge_energy, choice.region)
        self.predictor = ContourPredictor(body) if any(outlines) else None
        layers, layer_of_part = part_layers(body)
        self.num_layers = len(layers)
        self.layer_of_part = torch.tensor(layer_of_part, device=body.tie.device)
        inside = (choice.flow, choice.silhouette)
        self.interior = InteriorNodes(body) if any(inside) else None
        repels = choice.interpenetration is not None
        self.pairs = InterpenetrationPairs(body) if repels else None

    def __call__(
        self,
        features: FrameFeatures | None,
        *,
        body: BodyModel,
        before: Float[Tensor, "k n"] | None = None,
        keypoints: Keypoints | None = None,
        appearance: Appearance | None = None,
        background: Background | None = None,
        stopwatch: Stopwatch | None = None,
    ) -> TrackingCost:
        """The cost of a frame; with modes before it, `of_children` has to follow.

        Args:
            features: Features of the frame; None: the picture is missing, and says nothing.
            body: The body on this frame's base.
            before: The modes of the frame before, which the flow carries on; None: no flow.
            keypoints: Of the frame, in pixels of the features.
            appearance: What the body and its surroundings look like, see `learn`; None: not known.
            background: What is behind the body, see `learn_background`; None: not known.
            stopwatch: Where the time of evaluations is added up.
        """
        cost = TrackingCost(
            body=body,
            camera=self.camera,
            choice=self.choice,
            predictor=self.predictor,
            interior=self.interior,
            keypoints=keypoints,
            pairs=self.pairs,
            deviation=self.deviation,
            stopwatch=stopwatch,
        )
        if features is None:
            return cost
        edge_field = features.edge_field(boundary_emphasis=self.boundary_emphasis).to(body.tie)
        direct = self.choice.edge_energy is not None
        return replace(
            cost,
            edge_field=edge_field,
            energy=edge_energy_field(edge_field) if direct else None,
            **self._looks(features, body, before, appearance, background),
            targets=None if before is None else self._targets(features, body, before),
        )

    def learn(
        self,
        appearance: Appearance | None,
        features: FrameFeatures | None,
        body: BodyModel,
        state: Float[Tensor, " n"],
        *,
        fitted: bool = True,
    ) -> Appearance | None:
        """Take in what body and surroundings look like in a frame.

        None without a term that asks for it, and of a body without flesh.

        Args:
            appearance: What was known before; None: nothing.
            features: Features of the frame, with colours.
            body: The body on this frame's base.
            state: Its pose.
            fitted: Whether its girths are the person's, see `region_masks`.
        """
        coloured = (self.choice.region, self.choice.segmentation, self.choice.silhouette)
        if not any(coloured) or body.num_parts == 0:
            return None
        if features is None or features.colour is None:
            return appearance
        if appearance is None:
            appearance = Appearance.unknown(self.num_layers, like=features.colour)
        inside, outside = region_masks(body, state, self.camera, fitted=fitted)
        return appearance.learn(features.colour, inside, outside)

    def learn_background(
        self,
        background: Background | None,
        features: FrameFeatures | None,
        body: BodyModel,
        modes: Float[Tensor, "k n"],
        log_weight: Float[Tensor, " k"],
    ) -> Background | None:
        """Take in what a frame shows where the body is not.

        None where the choice does not ask for it.

        Args:
            background: What was known before; None: nothing.
            features: Features of the frame, with colours.
            body: The body on this frame's base.
            modes: Poses that it may have.
            log_weight: Their weights.
        """
        asked = self.choice.background or self.choice.silhouette is not None
        if not asked or body.num_parts == 0:
            return None
        if features is None or features.colour is None:
            return background
        if background is None:
            background = Background.unknown(features.colour)
        bare = bare_pixels(body, modes, log_weight, self.camera)
        return background.learn(features.colour, bare, features.flow)

    def _looks(
        self,
        features: FrameFeatures,
        body: BodyModel,
        before: Float[Tensor, "k n"] | None,
        appearance: Appearance | None,
        background: Background | None,
    ) -> dict[str, Any]:
        """What the pixels look like, for the terms that ask for it."""
        images: dict[str, Any] = {}
        colour, likeness, silhouette = features.colour, None, None
        if appearance is not None and colour is not None:
            likeness = appearance.likeness(colour, background if self.choice.background else None)
            if self.choice.silhouette is not None and background is not None:
                known = self.choice.background
                silhouette = likeness if known else appearance.likeness(colour, background)
                silhouette = silhouette.amax(0).masked_fill(~background.sure, torch.nan)
        if features.mask is not None:
            silhouette = 2 * features.mask - 1
        if silhouette is not None and before is not None:
            images["silhouette"] = self._silhouette(silhouette, body, before)
        if likeness is None:
            return images
        if self.choice.region is not None and self.predictor is not None:
            layer = self.layer_of_part[self.predictor.node_part]
            images["region"] = RegionImages(region_field(likeness), layer)
        if self.choice.segmentation is not None and before is not None:
            images["segmentation"] = self.choice.segmentation.images(
                likeness,
                self.layer_of_part,
                self.camera,
                body,
                before.reshape(-1, before.shape[-1])[0],
            )
        return images

    def _silhouette(
        self,
        likeness: Float[Tensor, "h w"],
        body: BodyModel,
        before: Float[Tensor, "k n"],
    ) -> SilhouetteImages | None:
        """The silhouette, of what looks like the body; None if it is not asked for."""
        term = self.choice.silhouette
        if term is None or self.interior is None or self.interior.num_nodes == 0:
            return None
        small = self.camera.scaled(1 / term.reduction)
        best = before.reshape(-1, before.shape[-1])[0]
        parts = part_map(body, best, small, rings=6, meridians=10)
        return term.images(
            likeness.to(body.tie),
            self.camera,
            self.interior(body, body.pose(before)).points.flatten(0, -2),
            float((parts >= 0).sum()) * term.reduction**2,
        )

    def _targets(
        self, features: FrameFeatures, body: BodyModel, before: Float[Tensor, "k n"]
    ) -> FlowTargets | None:
        if self.choice.flow is None or self.interior is None or features.flow is None:
            return None
        pose = body.pose(before)
        points, part = self.interior(body, pose).points, self.interior.node_part
        return flow_targets(
            self.interior,
            body,
            before,
            self.camera,
            features.flow.to(body.tie),
            None if features.flow_outlier is None else features.flow_outlier.to(body.tie),
            visible_nodes(body, pose, self.camera.centre_world, points, part),
        )


def beside(costs: Sequence[TrackingCost]) -> TrackingCost:
    """The cost of a frame that several cameras see: the sum of what each sees, priors once.

    Args:
        costs: The cost of each camera's view, of the same body with the same choice of terms.
    """
    first, *others = costs
    return replace(first, others=tuple(cost.alone for cost in others))
