"""A made-up frame, its cost, and that differentiated by autograd: state, pose, projection and all.

`autograd_model(cost, x)` is what `cost.local_model(x)` is, by double backward, row by row. As
there, what is visible and which edges match is found at x and then held fixed: nodes stay where
they are on their links, edges where they are in the image.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from torchcss.body.load import load_body
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import BodyTables, FrameContext
from torchcss.cost.contour import ContourTerm
from torchcss.cost.flow import FlowTerm
from torchcss.cost.interpenetration import Interpenetration
from torchcss.cost.joints import JointTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.total import TrackingCost
from torchcss.cost.visibility import ContourPredictor
from torchcss.joint_names import ALIASES
from torchcss.types import Curvature, Keypoints, LocalModel
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor


def made_up_costs(
    samples: int, size_wh: tuple[int, int], dtype: torch.dtype
) -> tuple[TrackingCost, TrackingCost, Tensor]:
    """The joint term alone, the full cost at 1008 nodes, and states of body34."""
    generator = torch.Generator().manual_seed(0)
    # The camera looks along z with y down; the body stands upright 3.5 m before it, facing it.
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    body = load_body("body34", dtype=dtype).with_base(flip, torch.tensor([0.0, 0.0, 3.5]))
    camera = Camera.pinhole(*size_wh, focal_px=0.94 * size_wh[0]).to(dtype)
    noise = torch.randn(samples, body.num_parameters, generator=generator, dtype=dtype)
    x = body.bounds.project(body.rest + 0.2 * noise)
    names = tuple(name for name in ALIASES["BODY_25B"] if name in body.joint_names)
    joints = body.pose(body.rest).joints[[body.joint_index(name) for name in names]]
    uv = camera.project(joints).uv
    uv = uv + 3.0 * torch.randn(uv.shape, generator=generator, dtype=dtype)
    observation = Keypoints(uv, torch.ones_like(uv[:, 0]), names)
    features = FeatureExtractor().to(dtype)(made_up_frames(size_wh)[1])
    edges = features.edge_field()
    view = FrameContext(
        body=body,
        camera=camera,
        tables=BodyTables(body, ContourPredictor(body, rings=14, meridians=6)),
        features=features._replace(flow=torch.full_like(edges, -3.0)),
        edge_field=edges,
        keypoints=observation,
        modes=body.rest[None],
    )
    alone = TrackingCost(choice=CostChoice(terms=(JointTerm(),)), views=(view,))
    terms = (ContourTerm(), JointTerm(), Stabiliser(), FlowTerm(), Interpenetration())
    return alone, TrackingCost(choice=CostChoice(terms=terms), views=(view,)), x


def made_up_frames(size_wh: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Grey clutter that moves by 3 pixels along both axes."""
    generator = torch.Generator().manual_seed(1)
    width, height = (side + 3 for side in size_wh)
    picture = torch.zeros(1, 1, height, width)
    for scale in (8, 16, 64):
        noise = torch.randn(1, 1, height // scale + 2, width // scale + 2, generator=generator)
        picture += functional.interpolate(noise, (height, width), mode="bicubic")
    picture = picture[0, 0].sigmoid()
    return picture[:-3, :-3], picture[3:, 3:]


def autograd_model(cost: TrackingCost, x: Tensor) -> LocalModel:
    """Value, gradient and Hessian by differentiating the cost as a function of x, matches held."""
    autograd = replace(cost.choice, curvature=Curvature.AUTOGRAD)
    return replace(cost, choice=autograd).local_model(x)
