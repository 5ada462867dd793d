"""From the features of one frame to its cost: what a body, a camera and a choice of terms need.

`FrameCosts` holds what is the same in all frames: the camera, the tables of the body, the choice.
Called with a frame's features and the modes of the frame before, it gives that frame's
`TrackingCost`, its terms bound to the frame. A tracker descends from samples of those modes;
`TrackingCost.problem` is what `Tracker.step` takes.

    costs = FrameCosts(body, camera, choice, frame_interval=1 / 25, boundary_emphasis=0.3)
    cost = costs(features, body=body, before=state.mixture.mean, keypoints=keypoints)
    state, info = tracker.step(state, cost.problem(), body.bounds)

Several cameras have one `FrameCosts` each; `torchcss.cost.total.beside` makes one cost of what they
give.
"""

from __future__ import annotations

import math
from copy import copy
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import BodyTables, FrameContext
from torchcss.cost.part_map import bare_pixels
from torchcss.cost.region import part_layers, region_masks
from torchcss.cost.total import Engine, TrackingCost
from torchcss.stopwatch import Stopwatch
from torchcss.types import Keypoints
from torchcss.vision.appearance import Appearance
from torchcss.vision.background import Background
from torchcss.vision.camera import Camera
from torchcss.vision.features import FrameFeatures


class Learnt(NamedTuple):
    """What one camera has taught.

    Attributes:
        appearance: What body and surroundings look like; None: not known.
        background: What is behind the body; None: not known, or not asked for.
    """

    appearance: Appearance | None = None
    background: Background | None = None


NOTHING_KNOWN = Learnt()


class FrameCosts:
    """Makes the cost of one frame after another.

    Args:
        body: The body; later it may hang on another base.
        camera: Camera of the features.
        choice: Terms and weights.
        frame_interval: Seconds between frames, which scales the expected motion; 0: not known.
        boundary_emphasis: Weight of motion boundaries, see `FrameFeatures.edge_field`.
        engine: What evaluates the costs; None: the terms as they are written.

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
        engine: Engine | None = None,
    ) -> None:
        self.camera = camera.to(dtype=body.dtype, device=body.tie.device)
        self.choice = choice
        self.deviation = body.motion_rate * frame_interval if frame_interval else None
        self.boundary_emphasis = boundary_emphasis
        self.engine = engine
        self.tables = BodyTables(body)
        self.num_layers = len(part_layers(body)[0])

    def over(self, intervals: float) -> FrameCosts:
        """The same of a frame that comes so many intervals after the one before it."""
        costs = copy(self)
        if self.deviation is not None:
            costs.deviation = math.sqrt(intervals) * self.deviation
        return costs

    def __call__(
        self,
        features: FrameFeatures | None,
        *,
        body: BodyModel,
        before: Float[Tensor, "k n"] | None = None,
        keypoints: Keypoints | None = None,
        known: Learnt = NOTHING_KNOWN,
        stopwatch: Stopwatch | None = None,
    ) -> TrackingCost:
        """The cost of a frame.

        Args:
            features: Features of the frame; None: the picture is missing, and says nothing.
            body: The body on this frame's base.
            before: The modes of the frame before, which the flow carries on; None: no flow.
            keypoints: Keypoints of the frame, in pixels of the features.
            known: What was learnt from the frames before, see `learn`.
            stopwatch: Where the time of evaluations is added up.
        """
        context = FrameContext(
            body=body,
            camera=self.camera,
            tables=self.tables,
            features=features,
            edge_field=None
            if features is None
            else features.edge_field(boundary_emphasis=self.boundary_emphasis).to(body.tie),
            boundary_emphasis=self.boundary_emphasis,
            keypoints=keypoints,
            appearance=known.appearance,
            background=known.background,
            modes=None if before is None else before.reshape(-1, before.shape[-1]),
            deviation=self.deviation,
        )
        return TrackingCost(
            choice=self.choice, views=(context,), stopwatch=stopwatch, engine=self.engine
        )

    def learn(
        self,
        known: Learnt,
        features: FrameFeatures | None,
        body: BodyModel,
        modes: Float[Tensor, "k n"],
        log_weight: Float[Tensor, " k"] | None = None,
        *,
        fitted: bool = True,
    ) -> Learnt:
        """Take in what body, surroundings and background look like in a frame.

        What no term asks for, and what a body without parts looks like, is not learnt.

        Args:
            known: What was known before.
            features: Features of the frame, with colours.
            body: The body on this frame's base.
            modes: Poses that it may have, the best first.
            log_weight: Their weights; None: all the same.
            fitted: Whether its girths are the person's, see `region_masks`.
        """
        if features is None or features.colour is None or body.num_parts == 0:
            return known
        (appearance, background), colour = known, features.colour
        if "appearance" in self.choice.needs:
            masks = region_masks(body, modes[0], self.camera, fitted=fitted)
            appearance = appearance or Appearance.unknown(self.num_layers, like=colour)
            appearance = appearance.learn(colour[masks.pixels], masks.inside, masks.outside)
        if self.choice.whole_picture:
            weight = modes.new_zeros(len(modes)) if log_weight is None else log_weight
            bare = bare_pixels(body, modes, weight, self.camera)
            background = background or Background.unknown(colour)
            background = background.learn(colour, bare, features.flow)
        return Learnt(appearance, background)
