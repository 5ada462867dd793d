"""What can be chosen about an initialisation."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import field, replace
from typing import Literal

import torch

from torchcss.body.model import BodyModel
from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.fused import engine_for
from torchcss.cost.interpenetration import Interpenetration
from torchcss.cost.joints import JointTerm
from torchcss.cost.pose_prior import PosePrior
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.total import Engine, TrackingCost
from torchcss.errors import ConfigurationError, check_positive
from torchcss.initialise.multi_start import PAPERS, StartSearch
from torchcss.initialise.view import CameraView
from torchcss.robust import Lorentzian
from torchcss.types import frozen

LEAST_JOINTS = 3
"""Fewer joints than this fix neither depth nor direction of a body."""


@frozen
class InitialiseOptions:
    """How a first pose is found.

    Attributes:
        sigma: Noise of a wrist's keypoint, pixels; None: 0.6 % of the person's size.
        learn_noise: Take that as a guess, and learn the noise from the best fit's errors
            (`torchcss.initialise.noise`); None: where `sigma` is not given.
        stature: Height of the standing person, metres, where it is known.
        ground: Height of the floor that the person stands on, metres along the axis of the world
            that points up, where it is known; it tells the size where `stature` does not, see
            `torchcss.initialise.ground`.
        num_modes: Most hypotheses; 1 for the best alone, None for all.
        least_joints: Fewest joints of the body that have to be known; with fewer than
            `LEAST_JOINTS` much stays at its prior.
        pose_prior: Prefer poses that people take (`torchcss.cost.pose_prior`).
        printed: Take a paper's priors: no pose prior, stabilisers on what is hard to estimate
            alone, and in [IJRR] repulsion in all stages. While the second and third stage fit the
            shape, repulsion sees the parts as they were before; afterwards as they were found.
        contours: Run the second and third stage on the picture's contours.
        colours: Let them see the colours on either side too.
        bends: Let the third stage bend the parts, too.
        working_size: Longer side of the picture on which contours are searched.
        search: How widely poses are looked for.
        potential_kind: Robust potential of the keypoints.
        weights: Further factors on terms by name, as in `CostChoice`.
        dtype: Type of the body.
        device: Where to compute.
        free_root: Let a body move about that by itself stands in one place.
        engine: "fused": compiled kernels evaluate the costs, on a CPU where numba is installed;
            "eager": the terms as they are written.
    """

    sigma: float | None = None
    learn_noise: bool | None = None
    stature: float | None = None
    ground: float | None = None
    num_modes: int | None = 8
    least_joints: int = 1
    pose_prior: bool = True
    printed: Literal["ijrr", "rr"] | None = None
    contours: bool = True
    colours: bool = True
    bends: bool = False
    working_size: int = 640
    search: StartSearch = StartSearch()
    potential_kind: type = Lorentzian
    weights: Mapping[str, float] = field(default_factory=dict)
    dtype: torch.dtype = torch.float64
    device: torch.device | str = "cpu"
    free_root: bool = False
    engine: Literal["fused", "eager"] = "fused"

    def __post_init__(self) -> None:
        check_positive(self, "sigma", finite=True)
        if self.ground is not None and not math.isfinite(self.ground):
            raise ConfigurationError(f"ground: expected metres, got {self.ground}")
        if self.num_modes is not None and self.num_modes < 1:
            raise ConfigurationError(
                f"expected at least 1 hypothesis to be kept, got {self.num_modes}"
            )

    def as_papers(self) -> InitialiseOptions:
        """The same, with the three stages of section 5 [IJRR]; of ours is the cost of the edges.

        One fit from a coarse pose to joints and edges, with limits, stabilisers, proportions and
        repulsion.
        """
        search = replace(PAPERS, coarse_pose=self.search.coarse_pose)
        return replace(self, search=search, num_modes=1, printed="ijrr", colours=False, bends=True)

    @property
    def evaluator(self) -> Engine | None:
        """What evaluates the costs; None: the terms as they are written."""
        return engine_for(self.engine, self.device)

    @property
    def joint_choice(self) -> CostChoice:
        """Terms of the first stage: keypoints of known noise, and the priors of a single image."""
        assert self.sigma is not None
        known = self.stature is not None
        return CostChoice(
            terms=(
                JointTerm(sigma=self.sigma, potential_kind=self.potential_kind),
                Stabiliser(hidden_only=self.printed is not None),
                Anthropometric(stature=0.0) if known else Anthropometric(),
                *((PosePrior(),) if self.pose_prior and not self.printed else ()),
                *((Interpenetration(),) if self.printed == "ijrr" else ()),
            ),
            weights=self.weights,
        )

    def joint_cost(self, body: BodyModel, views: Iterable[CameraView]) -> TrackingCost:
        """Cost of the first stage.

        Args:
            body: The body.
            views: The cameras and the keypoints in their pixels, of joints that it has.
        """
        contexts = (
            FrameContext(body=body, camera=view.camera, keypoints=view.keypoints) for view in views
        )
        return TrackingCost(choice=self.joint_choice, views=tuple(contexts), engine=self.evaluator)
