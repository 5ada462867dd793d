"""Covariances of joints: the Jacobian against autograd, the spread against drawn states."""

from __future__ import annotations

import pytest
import torch

from torchcss import load_body
from torchcss.body.catalog import BODY_NAMES
from torchcss.body.uncertainty import Held, joint_covariance, point_jacobian
from torchcss.errors import ShapeError


@pytest.mark.parametrize("name", [*BODY_NAMES, "free"])
def test_jacobian_is_autograd_s(name: str, generator: torch.Generator):
    body = load_body("body30", free_proportions=True) if name == "free" else load_body(name)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    body = body.with_base(turn * turn.det(), torch.tensor([1.0, -2.0, 3.0]))
    x = 0.3 * torch.randn(2, body.num_parameters, generator=generator, dtype=torch.float64)
    pose = body.pose(x)
    found = point_jacobian(body, pose.tree, pose.joints, body.marker_link)
    for item, ours in zip(x, found, strict=True):
        exact = torch.autograd.functional.jacobian(lambda state: body.pose(state).joints, item)
        torch.testing.assert_close(ours, exact, rtol=0, atol=1e-12)


def test_covariance_is_the_spread_of_drawn_states(generator: torch.Generator):
    body = load_body("body34")
    n = body.num_parameters
    factor = 0.01 * torch.randn(n, n, generator=generator, dtype=torch.float64) / n**0.5
    x = 0.3 * torch.randn(n, generator=generator, dtype=torch.float64)
    found = joint_covariance(body, body.pose(x), factor @ factor.T)
    num = 20000
    drawn = x + torch.randn(num, n, generator=generator, dtype=torch.float64) @ factor.T
    joints = body.pose(drawn).joints
    away = joints - joints.mean(0)
    spread = torch.einsum("sja,sjb->jab", away, away) / (num - 1)
    # Entries of a sample covariance scatter by sqrt((C_aa C_bb + C_ab^2) / num); the turns of a
    # hundredth of a radian leave second-order terms below a percent.
    diagonal = found.diagonal(dim1=-2, dim2=-1)
    product = diagonal[:, :, None] * diagonal[:, None, :]
    scatter = ((product + found**2) / num).sqrt()
    assert ((spread - found).abs() < 5 * scatter + 0.01 * product.sqrt()).all()


def test_covariances_are_symmetric_and_not_negative(generator: torch.Generator):
    body = load_body("arm8", dtype=torch.float32)
    factor = torch.randn(3, 2, 8, 8, generator=generator)
    pose = body.pose(0.1 * torch.randn(3, 2, 8, generator=generator))
    found = joint_covariance(body, pose, factor @ factor.mT)
    assert found.shape == (3, 2, len(body.joint_names), 3, 3)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, found.mT, rtol=1e-4, atol=1e-6)
    assert (torch.linalg.eigvalsh(found) > -1e-5).all()
    with pytest.raises(ShapeError, match="covariance"):
        joint_covariance(body, pose, factor[..., :7])


def test_what_is_held_moves_the_joints_by_their_sensitivity(generator: torch.Generator):
    body = load_body("body34", dtype=torch.float64)
    pose = body.pose(body.rest)
    none = torch.zeros(body.num_parameters, body.num_parameters, dtype=torch.float64)
    axis = torch.nn.functional.normalize(
        torch.randn(3, generator=generator, dtype=torch.float64), dim=0
    )
    eye = pose.joints.mean(0) - 4 * axis
    held = Held(0.03, 0.1, eye, axis)
    found = joint_covariance(body, pose, none, held=held)
    # Bodies of other sizes at distances that look the same, and before other lenses.
    num, joints = 100000, pose.joints
    size, focal = torch.randn(2, num, 1, 1, generator=generator, dtype=torch.float64)
    depth = ((joints.mean(0) - eye) @ axis) * axis
    drawn = eye + (1 + 0.03 * size) * (joints - eye) + 0.1 * focal * depth
    torch.testing.assert_close(found[5], torch.cov(drawn[:, 5].T), rtol=0.05, atol=2e-4)
    hips = body.joint_columns(("l_hip", "r_hip"))
    about = joint_covariance(body, pose, none, about=hips, held=held)
    drawn = drawn - drawn[:, hips].mean(1, keepdim=True)
    torch.testing.assert_close(about[5], torch.cov(drawn[:, 5].T), rtol=0.05, atol=1e-6)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    turned = held.turned(turn).covariance(pose.joints @ turn.T)
    torch.testing.assert_close(turned, turn @ found @ turn.T)
