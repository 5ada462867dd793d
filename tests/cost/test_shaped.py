"""Pose and shape together: derivatives, and a thick body found from its picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchcss.body.load import load_body
from torchcss.body.shape import (
    ShapeParameters,
    surface_angles,
    with_shape,
)
from torchcss.body.surface import surface_points
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.contour import ContourTerm
from torchcss.cost.frame import NOTHING_KNOWN, FrameCosts
from torchcss.cost.joints import JointTerm
from torchcss.cost.region import RegionTerm
from torchcss.cost.shaped import Outline, ShapedCost
from torchcss.cost.total import TrackingCost
from torchcss.cost.visibility import ContourPredictor
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.initialise.shape import fit_shape
from torchcss.studies.render.renderer import Mesh, render_meshes
from torchcss.tracking.flip_moves import flipped_poses
from torchcss.types import Bounds, Keypoints
from torchcss.vision.camera import Camera
from torchcss.vision.features import FeatureExtractor
from torchcss.vision.rasterise import grid_faces


def problem(thicker: float, by: str) -> tuple[ShapedCost, torch.Tensor, ShapeParameters]:
    """A picture of an arm whose cross-sections are larger than the catalogue's.

    Args:
        thicker: By how much.
        by: What the outline is compared with: "edges" or "colours", those that the catalogue's arm
            takes for its own.
    """
    body = load_body("arm7")
    turn = torch.eye(3, dtype=torch.float64)
    body = body.with_base(turn, torch.tensor([0.0, 0.3, -1.6], dtype=torch.float64))
    camera = Camera(
        [[400.0, 0, 159.5], [0, 400.0, 119.5], [0, 0, 1]], (320, 240),
        R_camera_world=np.diag([1.0, -1.0, -1.0]),
    )  # fmt: skip
    x = body.rest.clone()
    x[body.state_index("r_elbow_flexion")] = 0.6
    parameters = ShapeParameters(body, ("a1", "a2"))
    z = torch.zeros(len(parameters.names), dtype=torch.float64)
    z += thicker * torch.tensor(
        [
            body.part_shape[body.part_names.index("r_" + name[:-3]), :2].mean()
            for name in parameters.names
        ]
    )
    true = with_shape(body, parameters.shape(z))
    rotation, centre = true.part_poses(true.pose(x))
    mesh = true.mesh(40, 40)
    meshes = [
        Mesh(
            mesh.points[part].flatten(0, 1) @ rotation[part].T + centre[part],
            mesh.normals[part].flatten(0, 1) @ rotation[part].T,
            grid_faces(40, 40),
            torch.tensor([0.9, 0.8, 0.7], dtype=torch.float64),
        )
        for part in range(true.num_parts)
    ]
    dark = torch.full((240, 320, 3), 10, dtype=torch.uint8)
    picture = render_meshes(meshes, camera, background=dark)
    features = FeatureExtractor(colour=True)(picture.numpy())
    joints = camera.project(body.pose(x).joints).uv
    seen = torch.ones(len(joints)).double()
    keypoints = Keypoints(joints, seen, body.joint_names)
    base = TrackingCost(
        choice=CostChoice().without("contour", "temporal").having(JointTerm(sigma=1.0)),
        views=(FrameContext(body=body, camera=camera, keypoints=keypoints),),
    )
    if by == "edges":
        outline = Outline(ContourTerm(), features.edge_field().double(), 150.0)
    else:
        term = RegionTerm()
        costs = FrameCosts(body, camera, CostChoice(terms=(term,)))
        known = costs.learn(NOTHING_KNOWN, features, body, x[None], fitted=False)
        cost = costs(features, body=body, known=known)
        outline = Outline(term, cost.bound[term, cost.views[0]].image, 400.0)
    cost = ShapedCost(base=base, parameters=parameters, outlines=(outline,))
    return cost, torch.cat([x, torch.zeros_like(z)]), parameters


@pytest.mark.parametrize(
    ("by", "thicker", "least"), [("edges", 0.2, 0.4), ("colours", 0.2, 0.3), ("colours", -0.2, 0.7)]
)
def test_another_girth_is_found(by: str, thicker: float, least: float):
    cost, start, parameters = problem(thicker, by)
    n = cost.base.body.num_parameters
    held = Bounds(
        torch.cat([start[:n], parameters.bounds.lower]),
        torch.cat([start[:n], parameters.bounds.upper]),
    )
    fit = TrustRegionNewton(max_steps=20, tolerance=1e-2).minimise(cost, start[None], held)
    assert torch.equal(fit.mean[0, :n], start[:n])
    assert float(fit.cost[0]) < float(cost.value(start[None])[0]) - 1
    body = cost.base.body
    shape = parameters.shape(fit.mean[0, n:])
    # The arm hangs across the line of sight along z: the picture shows its width, a number of x.
    # Colours are blurred, and leave more to the prior.
    for part in ("r_upper_arm", "r_forearm"):
        row = body.part_names.index(part)
        grown = float(shape[row, :2].sum() / body.part_shape[row, :2].sum() - 1)
        assert least < grown / thicker < 1.5
    limits = Bounds(*map(torch.cat, zip(body.bounds, parameters.bounds, strict=True)))
    whole = TrustRegionNewton(max_steps=10, tolerance=1e-2).minimise(cost, fit.mean, limits)
    assert float(whole.cost[0]) <= float(fit.cost[0])


@pytest.mark.parametrize("by", ["edges", "colours"])
def test_flesh_goes_to_the_pose_that_the_picture_is_of(by: str):
    """A forearm that comes too close is made thin, and still costs more than the true one."""
    cost, start, parameters = problem(0.2, by)
    body, n = cost.base.body, cost.base.body.num_parameters
    other = flipped_poses(body, cost.base.camera, start[:n], num=1)
    places = body.pose(torch.cat([start[None, :n], other])).joints
    assert float((places[0] - places[1]).norm(dim=-1).max()) > 0.2
    true = start[None, :n]

    def fit(states: torch.Tensor):
        return fit_shape(cost.base, states, parameters, cost.outlines)

    alone = fit(true)
    for states, start_of_best in ((torch.cat([true, other]), 0), (torch.cat([other, true]), 1)):
        for found, expected in zip(fit(states), alone, strict=True):
            assert found.start == start_of_best
            assert found.cost == expected.cost
            assert torch.equal(found.state, expected.state)
            assert torch.equal(found.shape, expected.shape)
    assert fit(other)[0].cost > alone[0].cost + 3


@pytest.mark.parametrize("by", ["edges", "colours"])
def test_slope_is_that_of_nodes_that_keep_their_angles(by: str):
    """The outline's slope in the shape: forces on the nodes times how far they move."""
    cost, start, parameters = problem(0.1, by)
    body, camera, n = cost.base.body, cost.base.camera, cost.base.body.num_parameters
    model = cost.local_model(start[None])
    torch.testing.assert_close(model.hessian, model.hessian.mT)
    predictor, pose = ContourPredictor(body), body.pose(start[None, :n])
    nodes = predictor(body, pose, camera.centre_world)
    part = predictor.node_part
    rotation, centre = (each[0, part] for each in body.part_poses(pose))
    angles = surface_angles(
        body.part_shape[part], ((nodes.points[0] - centre)[:, None] @ rotation)[:, 0]
    )
    ((term, image, weight),) = cost.outlines
    force = term.point_cost(nodes, camera, image).gradient[0]
    step = 1e-6
    for column in range(len(parameters.names)):
        z = torch.zeros_like(start[n:])
        z[column] = step
        ends = [surface_points(parameters.shape(s * z)[part], *angles).points for s in (1, -1)]
        moved = (rotation @ (ends[0] - ends[1])[..., None])[..., 0] / (2 * step)
        slope = weight / predictor.num_nodes * (force * moved).sum()
        torch.testing.assert_close(model.gradient[0, n + column], slope, rtol=1e-6, atol=1e-4)


def test_what_outlines_cost_adds_up():
    edges, start, _ = problem(0.1, "edges")
    colours, _, _ = problem(0.1, "colours")
    both = replace(edges, outlines=(*edges.outlines, *colours.outlines))
    bare = replace(edges, outlines=())
    alone, other, none, sum_ = (
        cost.local_model(start[None]) for cost in (edges, colours, bare, both)
    )
    for a, b, nothing, total in zip(alone, other, none, sum_, strict=True):
        torch.testing.assert_close(total, a + b - nothing)
