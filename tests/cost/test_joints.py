"""The keypoint term: derivatives per point against autograd, missing and unseen joints."""

from __future__ import annotations

import math

import pytest
import torch
from reference.autograd import differentiated
from reference.camera import jacobian_of, skew_camera
from torch import Tensor

from torchcss.cost.joints import OUTLIER_LENGTHS, SPREAD, JointTargets, JointTerm, match_joints
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

NAMES = ("l_shoulder", "r_wrist", "nose", "skull_tip", "l_hip", "vt1")
TERM = JointTerm(sigma=3.0, nu=4.0)


def make_camera(distortion: list[float] | None = None) -> Camera:
    return skew_camera((900.0, 880.0), (317.0, 243.0), (640, 480), distortion=distortion)


def observe(
    camera: Camera, points: Tensor, generator: torch.Generator, *, noise: float = 10.0
) -> JointTargets:
    keypoints = camera.project(points).uv
    keypoints = keypoints + noise * torch.randn(
        keypoints.shape, generator=generator, dtype=torch.float64
    )
    confidence = torch.rand(len(NAMES), generator=generator, dtype=torch.float64)
    return match_joints(Keypoints(keypoints, confidence, NAMES), NAMES)


def random_points(*batch: int, generator: torch.Generator) -> Tensor:
    shape = (*batch, len(NAMES), 3)
    return 0.5 * torch.randn(shape, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("distortion", [None, [-0.33, 0.046, -0.0043, 0.0041, 0.067]])
@pytest.mark.parametrize("noise", [0.0, 2.0, 300.0])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_derivatives_per_point_are_those_of_autograd(
    distortion: list[float] | None,
    noise: float,
    batch: tuple[int, ...],
    generator: torch.Generator,
) -> None:
    camera = make_camera(distortion)
    points = random_points(*batch, generator=generator)
    first = points.reshape(-1, len(NAMES), 3)[0]
    targets = observe(camera, first, generator, noise=noise)
    got = TERM.point_cost(points, camera, targets)
    leaf = points.clone().requires_grad_()
    value = TERM.value(leaf, camera, targets)
    expected = differentiated(value, leaf)
    scale = float(expected.hessian.abs().max())
    torch.testing.assert_close(got.value, expected.value)
    torch.testing.assert_close(got.gradient, expected.gradient, rtol=1e-9, atol=1e-9 * scale)
    torch.testing.assert_close(got.hessian, expected.hessian, rtol=1e-9, atol=1e-10 * scale)


def test_gauss_newton_leaves_out_the_curvature_of_the_projection(
    generator: torch.Generator,
) -> None:
    camera = make_camera()
    points = random_points(generator=generator)
    targets = observe(camera, points, generator, noise=40.0)
    model = camera.project_with_derivatives(points)
    error = (model.uv - targets.position).requires_grad_()
    rho = TERM.potential(targets.weight * error.square().sum(-1)).rho
    bowl = differentiated(0.5 * rho, error).hessian
    got = TERM.point_cost(points, camera, targets, gauss_newton=True)
    jacobian = jacobian_of(camera, model)
    torch.testing.assert_close(got.hessian, jacobian.mT @ bowl @ jacobian)


def test_the_potential_is_that_of_its_docstring() -> None:
    """Unit curvature in sigmas at zero, and `nu log` growth far out."""
    near = TERM.potential(torch.tensor(1e-8, dtype=torch.float64))
    assert float(near.first) == pytest.approx(1 / TERM.sigma**2)
    s = torch.tensor([1e8, 4e8], dtype=torch.float64)
    rise = 0.5 * TERM.potential(s).rho.diff()
    assert float(rise) == pytest.approx(TERM.nu * math.log(2.0), rel=1e-5)


def test_weights_follow_confidence_and_spread() -> None:
    keypoints = torch.zeros(len(NAMES), 2, dtype=torch.float64)
    confidence = torch.tensor([1.0, 0.5, 1.0, 1.0, 2.0, 1.0], dtype=torch.float64)
    targets = match_joints(Keypoints(keypoints, confidence, NAMES), NAMES)
    spread = [SPREAD["shoulder"], 1.0, SPREAD["nose"], SPREAD["skull_tip"], SPREAD["hip"], 1.3]
    expected = torch.tensor([1.0, 0.5, 1.0, 1.0, 1.0, 1.0]) / torch.tensor(spread).square()
    torch.testing.assert_close(targets.weight, expected.double())


def test_keypoints_are_matched_by_name() -> None:
    keypoints = torch.arange(8, dtype=torch.float64).reshape(4, 2)
    order = ("nose", "tail", "l_hip", "r_wrist")
    targets = match_joints(Keypoints(keypoints, torch.ones(4).double(), order), NAMES)
    assert targets.joint.tolist() == [2, 4, 1]
    assert targets.position.tolist() == [[0.0, 1.0], [4.0, 5.0], [6.0, 7.0]]
    none = match_joints(Keypoints(keypoints, torch.ones(4).double(), order), ("a",))
    assert none.joint.shape == (0,)
    camera = make_camera()
    cost = TERM.point_cost(torch.zeros(2, 0, 3, dtype=torch.float64), camera, none)
    assert cost.value.shape == (2, 0)
    assert cost.hessian.shape == (2, 0, 3, 3)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30])
def test_missing_keypoints_cost_nothing_whatever_they_hold(
    bad: float, generator: torch.Generator
) -> None:
    camera = make_camera()
    points = random_points(3, generator=generator)
    keypoints = camera.project(points[0]).uv
    keypoints[1] = bad
    confidence = torch.ones(len(NAMES), dtype=torch.float64)
    confidence[1] = 0.0
    targets = match_joints(Keypoints(keypoints, confidence, NAMES), NAMES)
    cost = TERM.point_cost(points, camera, targets)
    for part in cost:
        assert torch.isfinite(part).all()
        assert not part[:, 1].any()
    assert cost.value[1:, 0].all()


@pytest.mark.parametrize("confidence", [math.nan, -1.0, 0.0], ids=["NaN", "negative", "zero"])
def test_confidences_that_are_none(confidence: float, generator: torch.Generator) -> None:
    keypoints = torch.zeros(len(NAMES), 2, dtype=torch.float64)
    all_of_them = torch.full((len(NAMES),), confidence, dtype=torch.float64)
    targets = match_joints(Keypoints(keypoints, all_of_them, NAMES), NAMES)
    assert not targets.weight.any()


def test_a_joint_behind_the_camera_costs_a_constant(generator: torch.Generator) -> None:
    camera = make_camera()
    points = random_points(generator=generator)
    targets = observe(camera, points, generator)
    behind = points.clone()
    behind[1] = (torch.tensor([0.1, 0.2, -2.0]) - camera.t_camera_world) @ camera.R_camera_world
    cost = TERM.point_cost(behind, camera, targets)
    far = targets.weight[1] * (OUTLIER_LENGTHS * TERM.sigma) ** 2
    torch.testing.assert_close(cost.value[1], 0.5 * TERM.potential(far).rho)
    assert not cost.gradient[1].any()
    assert not cost.hessian[1].any()
    assert float(cost.value[1]) > 0
    torch.testing.assert_close(TERM.value(behind, camera, targets), cost.value)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_types(dtype: torch.dtype, generator: torch.Generator) -> None:
    camera = make_camera()
    points = random_points(4, generator=generator)
    double = observe(camera, points[0], generator)
    expected = TERM.point_cost(points, camera, double)
    single = JointTargets(double.joint, double.position.to(dtype), double.weight.to(dtype))
    got = TERM.point_cost(points.to(dtype), camera, single)
    for ours, theirs in zip(got, expected, strict=True):
        assert ours.dtype == dtype
        scale = float(theirs.abs().max())
        torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=1e-4 * scale)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_far_keypoints_and_points_stay_finite(dtype: torch.dtype) -> None:
    camera = make_camera()
    points = torch.tensor(
        [[0, 0, 0], [1e6, 0, 0], [1e15, 1e15, 1e15], [0, 1e3, 1e-3], [0, 0, 5], [1, 1, 1]],
        dtype=dtype,
    )
    for far in (1e4, 1e9, 1e15, 1e30):
        keypoints = torch.full((len(NAMES), 2), far, dtype=dtype)
        targets = match_joints(
            Keypoints(keypoints, torch.ones(len(NAMES), dtype=dtype), NAMES), NAMES
        )
        for part in TERM.point_cost(points, camera, targets):
            assert torch.isfinite(part).all()
