"""Costs of bodies before a camera, and random states of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.edge_energy import EdgeEnergyTerm
from torchcss.cost.flow import FlowTerm
from torchcss.cost.interpenetration import Interpenetration
from torchcss.cost.joints import JointTerm
from torchcss.cost.temporal import MixturePrior
from torchcss.cost.term import OnStates, Term
from torchcss.cost.total import TrackingCost
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.tracking.settings import Settings, make_choice
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera
from torchcss.vision.features import FrameFeatures

WIDTH, HEIGHT = 160, 120


JOINTS_ONLY = CostChoice(terms=(JointTerm(),))


EVERYTHING = CostChoice().having(JointTerm(sigma=2.0))


FULL = EVERYTHING.having(EdgeEnergyTerm(), FlowTerm(), MixturePrior(), Interpenetration())


@dataclass(frozen=True, eq=False)
class Ready(Term):
    """A term that is bound already, whatever the frame."""

    term: Term
    bound: Any

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.term.name)
        object.__setattr__(self, "kind", self.term.kind)
        object.__setattr__(self, "screens", self.term.screens)
        object.__setattr__(self, "of_past", self.term.of_past)

    def prepare(self, context: FrameContext) -> Any:
        return self.bound


def random_states(body: BodyModel, *batch: int, generator: torch.Generator) -> Tensor:
    size = (*batch, body.num_parameters)
    noise = torch.randn(size, generator=generator, dtype=torch.float64)
    return body.bounds.project(body.sticky_mean + 0.3 * noise)


def make_cost(
    name: str = "arm8",
    choice: CostChoice = EVERYTHING,
    *,
    dtype: torch.dtype = torch.float64,
    own_parents: int | None = None,
) -> TrackingCost:
    """A body upright before a camera with distortion, keypoints, and a rough picture of edges."""
    generator = torch.Generator().manual_seed(1)
    body = load_body(name)
    base = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    depth = 3.5 if name.startswith("body") else 1.8
    body = body.with_base(base, torch.tensor([0.1, -0.1, depth]).double())
    camera = Camera(
        [[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]],
        (WIDTH, HEIGHT),
        distortion=[-0.1, 0.02, 0.001, -0.002, 0.0],
    )
    truth = random_states(body, generator=generator)
    keypoints = camera.project(body.pose(truth).joints).uv
    keypoints = keypoints + 3 * torch.randn(
        keypoints.shape, generator=generator, dtype=torch.float64
    )
    confidence = torch.rand(len(keypoints), generator=generator, dtype=torch.float64)
    keypoints[0], confidence[0] = math.nan, 0.0
    small = torch.randn(1, 2, HEIGHT // 6, WIDTH // 6, generator=generator, dtype=torch.float64)
    field = torch.nn.functional.interpolate(small, (HEIGHT, WIDTH), mode="bicubic")[0]
    field = 0.9 * field / (0.5 + field.norm(dim=0)).clamp(min=1.0)
    parents = random_states(
        body, *(() if own_parents is None else (own_parents,)), generator=generator
    )
    body, parents = body.to(dtype), parents.to(dtype)
    view = FrameContext(
        body=body,
        camera=camera.to(dtype),
        edge_field=field.to(dtype),
        keypoints=Keypoints(keypoints.to(dtype), confidence.to(dtype), body.joint_names),
        modes=parents.reshape(-1, body.num_parameters),
        deviation=body.motion_rate / 25,
    )
    cost = TrackingCost(choice=choice, views=(view,))
    if own_parents is None:
        return cost.of_mode(parents)
    return cost.of_children(torch.arange(own_parents), prior_at(parents))


def prior_at(mean: Tensor) -> Prior:
    """Modes of equal weight and unit covariance."""
    k, n = mean.shape
    unit = torch.eye(n).to(mean).expand(k, n, n)
    return Prior.of(GaussianMixture(mean, unit, mean.new_zeros(k)))


def changed(cost: TrackingCost, **fields: Any) -> TrackingCost:
    """A cost of one view with other things in the view."""
    view, past = (replace(context, **fields) for context in (cost.views[0], cost.past[0]))
    return replace(cost, views=(view, *cost.views[1:]), past=(past,))


def printed_cost(cost: TrackingCost, preset: str) -> TrackingCost:
    """The same view with the terms of a preset, and with motion boundaries."""
    features = cost.views[0].features
    assert features is not None
    noise = torch.rand(features.grey.shape, generator=torch.Generator().manual_seed(4))
    cost = changed(
        cost,
        features=features._replace(motion_boundary=noise.to(features.grey)),
        boundary_emphasis=0.3,
    )
    name = "arm8" if cost.body.num_parts < 6 else "body34"
    return replace(cost, choice=make_choice(Settings(preset=preset, body=name), 2.0), bound={})


def make_full_cost(
    name: str = "arm8", *, dtype: torch.dtype = torch.float64, own_parents: int | None = None
) -> TrackingCost:
    """The same with every term and prior, and what they compare with."""
    cost = make_cost(name, FULL, dtype=dtype, own_parents=own_parents)
    generator = torch.Generator().manual_seed(2)
    body, field = cost.body, cost.views[0].edge_field
    assert field is not None
    small = torch.randn(1, 2, 4, 5, generator=generator, dtype=torch.float64)
    flow = 3 * torch.nn.functional.interpolate(small, (HEIGHT, WIDTH), mode="bicubic")[0]
    features = FrameFeatures(field[0], field.norm(dim=0), field, flow=flow.to(dtype))
    mean = random_states(load_body(name), 3, generator=generator).to(dtype)
    spread = 0.1 + torch.rand(3, body.num_parameters, generator=generator, dtype=torch.float64)
    previous = GaussianMixture(
        mean,
        torch.diag_embed(spread.to(dtype)),
        torch.tensor([0.0, -1.0, -2.0]).to(dtype).log_softmax(0),
    )
    density = MixturePrior().density(previous)
    bound = OnStates(lambda posed, _: MixturePrior().local_model(posed.x, density))
    choice = cost.choice.having(Ready(MixturePrior(), bound))
    return replace(changed(cost, features=features), choice=choice)
