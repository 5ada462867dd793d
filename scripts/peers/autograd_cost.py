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
from torchcss.body.model import BodyPose, differentiate_twice
from torchcss.cost.flow import FlowTerm, InteriorNodes, flow_targets
from torchcss.cost.interpenetration import Interpenetration, InterpenetrationPairs
from torchcss.cost.joints import JointTerm, match_joints
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.cost.visibility import ContourPredictor, front_facing, visible_nodes
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
    joints = body.pose(body.rest).joints[[body.joint_index(name) for name in names]]
    uv = camera.project(joints).uv
    uv = uv + 3.0 * torch.randn(uv.shape, generator=generator, dtype=dtype)
    keypoints = Keypoints(uv, torch.ones_like(uv[:, 0]), names)
    choice = CostChoice(contour=None, joints=JointTerm(), stabiliser=None, temporal=None)
    alone = TrackingCost(body=body, camera=camera, choice=choice, keypoints=keypoints)
    edges = FeatureExtractor().to(dtype)(made_up_frames(size_wh)[1]).edge_field()
    interior = InteriorNodes(body)
    full = replace(
        alone,
        choice=CostChoice(flow=FlowTerm(), interpenetration=Interpenetration(), temporal=None),
        predictor=ContourPredictor(body, rings=14, meridians=6),
        edge_field=edges,
        interior=interior,
        targets=flow_targets(interior, body, body.rest, camera, torch.full_like(edges, -3.0)),
        pairs=InterpenetrationPairs(body),
    )
    return alone, full, x


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
    """Value (but for a constant), gradient and Hessian of joints, contour, flow and two priors."""
    choice, body, camera, keypoints = cost.choice, cost.body, cost.camera, cost.keypoints
    leaf = x.detach().requires_grad_()
    pose = body.pose(leaf)
    value = torch.zeros_like(x[:, 0])
    if choice.joints is not None and keypoints is not None:
        targets = match_joints(keypoints, body.joint_names)
        projection = camera.project(pose.joints[:, targets.joint])
        value = value + choice.joints.value(projection, targets).sum(-1)
    if choice.contour is not None:
        value = value + contour(cost, body.pose(x), pose)
    if choice.flow is not None:
        value = value + flow(cost, body.pose(x), pose)
    if choice.interpenetration is not None and cost.pairs is not None:
        value = value + choice.interpenetration.value(body, pose, cost.pairs)
    if choice.stabiliser is not None:
        sticky = body.sticky_mean, body.sticky_deviation
        value = value + choice.stabiliser.local_model(leaf, *sticky).value
    return differentiate_twice(value, leaf)


def contour(cost: TrackingCost, found: BodyPose, pose: BodyPose) -> Tensor:
    """Wells of the edges that were found at one pose, at another."""
    term, predictor, field, camera = (
        cost.choice.contour,
        cost.predictor,
        cost.edge_field,
        cost.camera,
    )
    assert term is not None
    assert predictor is not None
    assert field is not None
    nodes = predictor(cost.body, found, camera.centre_world)
    model = camera.project_with_derivatives(nodes.points)
    normal = camera.image_normals(model, nodes.normals)
    node, distance, weight = term.search(model.uv, normal, field)
    weight = weight * (nodes.visible * nodes.exists).flatten()[node]

    uv = camera.project(carried(found, pose, nodes.points, predictor.node_link)).uv
    moved = ((uv - model.uv) * normal).sum(-1).flatten()[node]
    rho = term.potential((distance - moved).square()).rho
    wells = torch.zeros_like(uv[..., 0]).flatten()
    wells = wells.index_add(0, node, weight * (term.unmatched - 0.5 * rho)).reshape(uv.shape[:-1])
    return -cost.choice.contour_weight / (predictor.num_nodes * term.nu) * wells.sum(-1)


def flow(cost: TrackingCost, found: BodyPose, pose: BodyPose) -> Tensor:
    """Residuals of the nodes that were seen at one pose, at another."""
    term, interior, targets, camera = cost.choice.flow, cost.interior, cost.targets, cost.camera
    assert term is not None
    assert interior is not None
    assert targets is not None
    nodes = interior(cost.body, found)
    eye = camera.centre_world
    facing = front_facing(nodes.points, nodes.normals, eye)
    seen = facing * visible_nodes(
        cost.body, found, eye, nodes.points, interior.node_part, wanted=facing
    )
    uv = camera.project(carried(found, pose, nodes.points, interior.node_link)).uv
    rho = term.potential(targets.weight * (uv - targets.uv).square().sum(-1)).rho
    return cost.choice.flow_weight / (interior.num_nodes * term.nu) * (seen * 0.5 * rho).sum(-1)


def carried(found: BodyPose, pose: BodyPose, points: Tensor, link: Tensor) -> Tensor:
    """Where points that lie on links at one pose are at another."""
    away = points - found.tree.translation[:, link]
    local = (found.tree.rotation[:, link] * away[..., :, None]).sum(-2)
    moved = (pose.tree.rotation[:, link] * local[..., None, :]).sum(-1)
    return moved + pose.tree.translation[:, link]
