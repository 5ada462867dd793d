"""A made-up frame, its costs, and the joint term written anew and differentiated by autograd.

`joints_by_autograd(cost, x)` is what `cost.local_model(x)` is, of the joint term alone: projection
and potential from their formulas, and derivatives by double backward through state and pose.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from torchcss.body.load import load_body
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import BodyTables, FrameContext
from torchcss.cost.contour import ContourTerm
from torchcss.cost.flow import FlowTerm
from torchcss.cost.interpenetration import Interpenetration
from torchcss.cost.joints import JointTerm, match_joints
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.total import TrackingCost
from torchcss.cost.visibility import ContourPredictor
from torchcss.joint_names import ALIASES
from torchcss.types import Keypoints, LocalModel
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
    joints = body.pose(body.rest).joints[body.joint_columns(names)]
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


def joints_by_autograd(cost: TrackingCost, x: Tensor) -> LocalModel:
    """The joint term alone: its value from its formula, differentiated twice row by row.

    With pinhole pixels u of the joint centres and keypoints m of weight w, a joint costs
    `nu / 2 log(1 + w |u - m|^2 / (nu sigma^2))`.

    Args:
        cost: A cost of the joint term alone, by a camera without distortion.
        x: States, in front of the camera.
    """
    (term,), (view,) = cost.choice.terms, cost.views
    assert isinstance(term, JointTerm)
    assert view.keypoints is not None
    camera, targets = view.camera, match_joints(view.keypoints, view.body.joint_names)
    leaf = x.detach().requires_grad_()
    points = view.body.pose(leaf).joints[:, targets.joint]
    pixels = (points @ camera.R_camera_world.mT + camera.t_camera_world) @ camera.K.mT
    apart = pixels[..., :2] / pixels[..., 2:] - targets.position
    squared = targets.weight * apart.square().sum(-1)
    value = 0.5 * term.nu * torch.log1p(squared / (term.nu * term.sigma**2)).sum(-1)
    (gradient,) = torch.autograd.grad(value.sum(), leaf, create_graph=True)
    rows = [
        torch.autograd.grad(column.sum(), leaf, retain_graph=True)[0]
        for column in gradient.unbind(-1)
    ]
    return LocalModel(value.detach(), gradient.detach(), torch.stack(rows, -2))
