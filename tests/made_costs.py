"""Costs of bodies before a camera, and random states of them."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.edge_energy import EdgeEnergyTerm, edge_energy_field
from torchcss.cost.flow import FlowTerm, InteriorNodes, flow_targets
from torchcss.cost.interpenetration import Interpenetration, InterpenetrationPairs
from torchcss.cost.joints import JointTerm
from torchcss.cost.temporal import MixturePrior
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.cost.visibility import ContourPredictor
from torchcss.inference.mixture import GaussianMixture
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

WIDTH, HEIGHT = 160, 120


JOINTS_ONLY = CostChoice(contour=None, stabiliser=None, temporal=None)


EVERYTHING = CostChoice(joints=JointTerm(sigma=2.0))


FULL = replace(
    EVERYTHING,
    edge_energy=EdgeEnergyTerm(),
    flow=FlowTerm(),
    temporal_mixture=MixturePrior(),
    interpenetration=Interpenetration(),
)


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
    body = body.to(dtype)
    return TrackingCost(
        body=body,
        camera=camera.to(dtype),
        choice=choice,
        predictor=ContourPredictor(body),
        edge_field=field.to(dtype),
        keypoints=Keypoints(keypoints.to(dtype), confidence.to(dtype), body.joint_names),
        parent=parents.to(dtype),
        deviation=body.motion_rate / 25,
    )


def make_full_cost(
    name: str = "arm8", *, dtype: torch.dtype = torch.float64, own_parents: int | None = None
) -> TrackingCost:
    """The same with every term and prior, and what they compare with."""
    cost = make_cost(name, FULL, dtype=dtype, own_parents=own_parents)
    generator = torch.Generator().manual_seed(2)
    body, parent = cost.body, cost.parent
    assert parent is not None
    assert cost.edge_field is not None
    small = torch.randn(1, 2, 4, 5, generator=generator, dtype=torch.float64)
    flow = 3 * torch.nn.functional.interpolate(small, (HEIGHT, WIDTH), mode="bicubic")[0]
    interior = InteriorNodes(body)
    targets = flow_targets(interior, body, parent, cost.camera, flow.to(dtype))
    mean = random_states(load_body(name), 3, generator=generator).to(dtype)
    spread = 0.1 + torch.rand(3, body.num_parameters, generator=generator, dtype=torch.float64)
    previous = GaussianMixture(
        mean,
        torch.diag_embed(spread.to(dtype)),
        torch.tensor([0.0, -1.0, -2.0]).to(dtype).log_softmax(0),
    )
    return replace(
        cost,
        energy=edge_energy_field(cost.edge_field),
        interior=interior,
        targets=targets,
        pairs=InterpenetrationPairs(body),
        previous=MixturePrior().density(previous),
    )
