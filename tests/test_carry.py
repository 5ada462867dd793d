"""The prediction by the flow: the trunk goes where the flow says, limbs and head hang on."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from torchcss.body.model import BodyModel, load_body
from torchcss.carry import Displaced, carried, trunk_of
from torchcss.cost.flow import FlowTargets, FlowTerm, InteriorNodes
from torchcss.cost.total import CostChoice, TrackingCost
from torchcss.errors import ConfigurationError
from torchcss.inference.dynamics import ConstantVelocity, Diffusion
from torchcss.inference.mixture import GaussianMixture
from torchcss.io.video import Frame
from torchcss.pipeline import TrackedFrame, track_frames
from torchcss.presets import make_tracker
from torchcss.settings import Settings, make_choice, make_extractor
from torchcss.vision.camera import Camera

YAW = 3
TRUNK = ("pelvis", "chest")
INTERVAL = 1 / 30


@cache
def the_body() -> BodyModel:
    return load_body("body34")


def a_cost(before: Tensor, after: Tensor, *, dtype: torch.dtype = torch.float64) -> TrackingCost:
    """The cost of a frame whose flow carries every node from one pose to the other."""
    body = the_body().with_base(
        torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    )
    body = body.to(dtype)
    K = [[650.0, 0.0, 319.5], [0.0, 650.0, 239.5], [0.0, 0.0, 1.0]]
    camera = Camera(K, (640, 480)).to(dtype)
    nodes = InteriorNodes(body)
    at_first = nodes(body, body.pose(before.to(dtype)))
    towards = camera.centre_world - at_first.points
    seen = ((at_first.normals * towards).sum(-1) > 0).to(dtype)
    uv = camera.project(nodes(body, body.pose(after.to(dtype))).points).uv
    return TrackingCost(
        body=body,
        camera=camera,
        choice=CostChoice(flow=FlowTerm()),
        interior=nodes,
        targets=FlowTargets(uv, seen),
        deviation=body.motion_rate.to(dtype) * INTERVAL,
    )


def poses(count: int = 1, seed: int = 0) -> Tensor:
    body = the_body()
    generator = torch.Generator().manual_seed(seed)
    x = body.rest + 0.05 * torch.randn(count, len(body.rest), generator=generator).double()
    return body.bounds.project(x)


def shoulders(x: Tensor) -> Tensor:
    """Heading of the line from one shoulder to the other, radians."""
    body = the_body()
    joints = body.pose(x.double()).joints
    left, right = (body.joint_names.index(name) for name in ("l_shoulder", "r_shoulder"))
    line = joints[..., left, :] - joints[..., right, :]
    return torch.atan2(line[..., 2], line[..., 0])


def turn_between(x: Tensor, other: Tensor) -> Tensor:
    """By how many degrees the shoulders are turned from one pose to the other."""
    angle = shoulders(other) - shoulders(x)
    return torch.rad2deg(torch.atan2(angle.sin(), angle.cos()))


def misses(cost: TrackingCost, x: Tensor) -> Tensor:
    """How far the visible nodes of the trunk are from where the flow has carried them, pixels."""
    assert cost.targets is not None
    assert cost.interior is not None
    nodes = cost.interior(cost.body, cost.body.pose(x)).points
    error = (cost.camera.project(nodes).uv - cost.targets.uv).norm(dim=-1)
    names = cost.body.part_names
    of_trunk = torch.tensor([names[part] in TRUNK for part in cost.interior.node_part])
    return error[of_trunk & (cost.targets.weight > 0)]


def turned(x: Tensor, degrees: float) -> Tensor:
    other = x.clone()
    other[..., YAW] += math.radians(degrees)
    return other


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_trunk_turns_with_the_flow(dtype: torch.dtype) -> None:
    before = poses(3).to(dtype)
    after = turned(before, 12.0)
    cost = a_cost(before, after, dtype=dtype)
    found = carried(cost, before, before)
    assert found.dtype == dtype
    # Its nodes, two to three pixels off before, are at their targets. What is left of the angle is
    # the prior's, which thinks of 23 degrees.
    assert misses(cost, before).mean() > 2
    assert misses(cost, found).max() < 0.5
    assert turn_between(before, after).abs().min() > 11
    assert turn_between(found, after).abs().max() < 2
    limbs = torch.ones(before.shape[-1], dtype=torch.bool)
    limbs[trunk_of(the_body())[0]] = False
    assert torch.equal(found[:, limbs], before[:, limbs])


def test_limbs_have_no_say() -> None:
    """Arms that lie on the wall beside the true ones see no motion, nor does a head that is off."""
    before = poses()
    cost = a_cost(before, turned(before, 12.0))
    assert cost.targets is not None
    assert cost.interior is not None
    limbs = {index for index, name in enumerate(cost.body.part_names) if name not in TRUNK}
    outside = torch.tensor([int(part) in limbs for part in cost.interior.node_part])
    nodes = cost.interior(cost.body, cost.body.pose(before))
    still = cost.camera.project(nodes.points).uv
    uv = torch.where(outside[:, None], still, cost.targets.uv)
    misled = replace(cost, targets=FlowTargets(uv, cost.targets.weight))
    assert torch.equal(carried(misled, before, before), carried(cost, before, before))


def test_what_the_last_motion_expects_is_where_it_starts() -> None:
    before = poses()
    expected = turned(before, 4.0)
    expected[:, -1] += 0.1
    cost = a_cost(before, turned(before, 12.0))
    found = carried(cost, before, expected)
    assert float(turn_between(found, turned(before, 12.0)).abs()) < 2
    assert torch.equal(found[:, -1], expected[:, -1])
    assert cost.targets is not None
    blind = FlowTargets(cost.targets.uv, torch.zeros_like(cost.targets.weight))
    blind_cost = replace(cost, targets=blind)
    torch.testing.assert_close(carried(blind_cost, before, expected), expected)


def test_every_mode_has_its_own_flow() -> None:
    before = poses(2, seed=1)
    after = torch.cat([turned(before[:1], 10.0), turned(before[1:], -8.0)])
    found = carried(a_cost(before, after), before, before)
    alone = torch.cat(
        [
            carried(a_cost(one, other), one, one)
            for one, other in zip(before.split(1), after.split(1), strict=True)
        ]
    )
    torch.testing.assert_close(found, alone, atol=1e-6, rtol=0)
    assert found[0, YAW] > before[0, YAW]
    assert found[1, YAW] < before[1, YAW]


def test_two_cameras_agree() -> None:
    before = poses()
    cost = a_cost(before, turned(before, 12.0))
    both = replace(cost, others=(cost.alone,))
    found = carried(both, before, before)
    assert float(turn_between(found, turned(before, 12.0)).abs()) < 2


def test_limits_hold() -> None:
    before = poses()
    index = the_body().state_index("lumbar_twist")
    before[:, index] = the_body().bounds.upper[index]
    after = before.clone()
    after[:, index] += 0.3
    found = carried(a_cost(before, after), before, before)
    body = the_body()
    assert torch.equal(body.bounds.project(found), found)


@pytest.mark.parametrize("lacks", ["flow", "targets", "deviation", "interior"])
def test_what_is_not_known_says_nothing(lacks: str) -> None:
    before = poses()
    cost = a_cost(before, turned(before, 12.0))
    if lacks == "flow":
        cost = replace(cost, choice=CostChoice(flow=None))
    else:
        cost = replace(cost, **{lacks: None})
    assert torch.equal(carried(cost, before, before), before)


def test_only_a_body_with_a_root_has_a_trunk() -> None:
    columns, parts = trunk_of(load_body("arm8"))
    assert len(columns) == 0
    assert not parts.any()
    columns, parts = trunk_of(the_body())
    names = [the_body().state_names[i] for i in columns]
    assert {"root_x", "root_yaw", "lumbar_flexion", "lumbar_twist"} <= set(names)
    assert not any(name.startswith(("l_", "r_", "neck")) for name in names)
    carrying = {name for name, held in zip(the_body().part_names, parts, strict=True) if held}
    assert carrying == {"pelvis", "chest"}


def test_displaced_dynamics_spread_as_the_others() -> None:
    mixture = GaussianMixture(poses(2), torch.eye(34).double().expand(2, 34, 34), torch.zeros(2))
    move = 0.1 * torch.ones(2, 34).double()
    velocity = torch.ones(2, 34).double()
    for inner in (Diffusion(deviation=0.2), ConstantVelocity(deviation=0.2, persistence=0.8)):
        predicted = Displaced(inner, move).predict(mixture, velocity)
        torch.testing.assert_close(predicted.mean, mixture.mean + move)
        torch.testing.assert_close(
            predicted.covariance, inner.predict(mixture, velocity).covariance
        )


def test_the_setting_is_checked() -> None:
    assert Settings(prediction="flow").prediction == "flow"
    with pytest.raises(ConfigurationError, match="velocity or flow"):
        Settings(prediction="guess")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="particles"):
        Settings(prediction="flow", preset="condensation")
    with pytest.raises(ConfigurationError, match="term flow"):
        Settings(prediction="flow", terms=("contour",))


def test_a_limb_beyond_its_limits_is_left_to_the_search() -> None:
    before = poses()
    expected = before.clone()
    body = the_body()
    elbow = body.state_index("l_elbow_flexion")
    expected[:, elbow] = body.bounds.lower[elbow] - 0.2
    found = carried(a_cost(before, turned(before, 5.0)), before, expected)
    assert torch.equal(found[:, elbow], expected[:, elbow])


def a_shifting_picture(count: int, step: int) -> list[np.ndarray]:
    """Cloth that fills the picture and moves to the right by some pixels a frame."""
    generator = torch.Generator().manual_seed(0)
    cloth = torch.rand(1, 3, 60, 110, generator=generator)
    large = functional.interpolate(cloth, size=(240, 440), mode="bicubic").clamp(0, 1)[0]
    pictures = (255 * large).round().byte().permute(1, 2, 0).numpy()
    return [
        np.ascontiguousarray(pictures[:, 120 - step * t : 440 - step * t]) for t in range(count)
    ]


def tracked(prediction: Literal["velocity", "flow"]) -> list[TrackedFrame]:
    settings = Settings(
        prediction=prediction,
        keypoints_use="first",
        terms=("flow", "contour", "temporal", "region", "segmentation"),
    )
    body = the_body().with_base(
        torch.eye(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)
    )
    K = [[325.0, 0.0, 159.5], [0.0, 325.0, 119.5], [0.0, 0.0, 1.0]]
    eye = 1e-4 * torch.eye(34, dtype=torch.float64)
    return list(
        track_frames(
            (Frame(i, i * INTERVAL, image) for i, image in enumerate(a_shifting_picture(2, 8))),
            body=body,
            mixture=GaussianMixture(body.rest[None], eye[None], torch.zeros(1).double()),
            camera=Camera(K, (320, 240)),
            extractor=make_extractor(settings),
            tracker=make_tracker("css", "body34", num_samples=4, num_modes=2, motion=0.02),
            choice=make_choice(settings, 2.0),
            observe=lambda _: None,
            frame_interval=INTERVAL,
            generator=torch.Generator().manual_seed(0),
            carries=settings.prediction == "flow",
        )
    )


def test_a_tracker_goes_with_the_flow() -> None:
    """Eight pixels are 10 cm, three of the motions expected in a frame; a search lags behind it."""
    first, again, lagging = tracked("flow"), tracked("flow"), tracked("velocity")
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one.state.mixture.mean, other.state.mixture.mean)

    def moved(frames: list[TrackedFrame]) -> float:
        uv = [frame.joints_world[0, 0] for frame in frames]
        return float((uv[1] - uv[0])[0])

    assert moved(first) == pytest.approx(8 * 4.0 / 325, abs=0.02)
    assert moved(lagging) < moved(first)
