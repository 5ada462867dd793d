"""The base transform: poses stay, covariances follow, angles come back."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from made_robots import planar_arm
from reference.kinematics import rotation
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, base_without_root, has_root, move_base, root_pose
from torchcss.body.rotations import root_angles, root_rotation


def based_body(name: str = "body34") -> BodyModel:
    body = load_body(name, free_root=True)
    return body.with_base(rotation(0.2, -0.4, 0.9), torch.tensor([0.5, -1.0, 3.0]).double())


NEW_BASE = rotation(-0.5, 0.3, 0.2), torch.tensor([0.1, 0.7, 2.0], dtype=torch.float64)


def random_states(body: BodyModel, *batch: int, generator: torch.Generator) -> Tensor:
    size = (*batch, body.num_parameters)
    return 0.4 * torch.randn(size, generator=generator, dtype=torch.float64)


def test_angles_come_back(generator: torch.Generator) -> None:
    turn = torch.rand(200, 3, generator=generator, dtype=torch.float64) * 2 - 1
    angles = turn * torch.tensor([math.pi, 0.999 * math.pi / 2, math.pi], dtype=torch.float64)
    torch.testing.assert_close(root_angles(root_rotation(angles)), angles, rtol=0, atol=1e-9)


def test_angles_of_a_right_pitch_give_the_rotation_back_all_the_same() -> None:
    """At a right angle yaw and roll are not unique: any pair of the right sum will do."""
    for pitch in (math.pi / 2, -math.pi / 2):
        angles = torch.tensor([0.4, pitch, -0.7], dtype=torch.float64)
        turn = root_rotation(angles)
        found = root_angles(turn)
        assert torch.isfinite(found).all()
        assert float(found[1]) == pytest.approx(pitch)
        torch.testing.assert_close(root_rotation(found), turn, rtol=0, atol=1e-7)


def test_rotation_is_yaw_then_pitch_then_roll() -> None:
    angles = torch.tensor([0.3, -0.5, 0.9], dtype=torch.float64)
    a, b, c = angles.tolist()
    expected = rotation(0, a, 0) @ rotation(b, 0, 0) @ rotation(0, 0, c)
    torch.testing.assert_close(root_rotation(angles), expected)


def test_root_pose_is_that_of_the_root_link(generator: torch.Generator) -> None:
    body = based_body()
    x = random_states(body, 2, 3, generator=generator)
    turn, origin = root_pose(body, x)
    tree = body.pose(x).tree
    link = body.tree.link_index("root_roll_link")
    torch.testing.assert_close(turn, tree.rotation[..., link, :, :])
    torch.testing.assert_close(origin, tree.translation[..., link, :])


def test_which_bodies_have_a_root() -> None:
    assert has_root(load_body("body30"))
    assert not has_root(load_body("arm8"))
    assert has_root(load_body("arm8", free_root=True))


@pytest.mark.parametrize("name", ["arm7", "body34"])
@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
def test_joints_stay_where_they_are(
    name: str, batch: tuple[int, ...], generator: torch.Generator
) -> None:
    body = based_body(name)
    x = random_states(body, *batch, generator=generator)
    covariance = torch.eye(body.num_parameters).double().expand(*batch, -1, -1)
    moved, y, mapped = move_base(body, *NEW_BASE, x, covariance)
    torch.testing.assert_close(moved.pose(y).joints, body.pose(x).joints, rtol=0, atol=1e-12)
    assert y.shape == x.shape
    assert mapped is not None
    assert mapped.shape == covariance.shape
    others = [i for i, name in enumerate(body.state_names) if name not in ROOT_NAMES]
    assert torch.equal(y[..., others], x[..., others])
    assert move_base(body, *NEW_BASE, x)[2] is None


def test_moving_the_base_onto_the_body_zeroes_the_root(generator: torch.Generator) -> None:
    body = based_body()
    x = random_states(body, generator=generator)
    _, y, _ = move_base(body, *root_pose(body, x), x)
    columns = body.state_columns(ROOT_NAMES)
    torch.testing.assert_close(y[columns], torch.zeros(6).double(), rtol=0, atol=1e-12)


def test_moving_there_and_back_changes_nothing(generator: torch.Generator) -> None:
    body = based_body()
    x = random_states(body, 3, generator=generator)
    square = torch.randn(3, 34, 34, generator=generator, dtype=torch.float64)
    covariance = square @ square.mT
    there = move_base(body, *NEW_BASE, x, covariance)
    back = move_base(there[0], body.base_rotation, body.base_translation, there[1], there[2])
    torch.testing.assert_close(back[1], x)
    assert back[2] is not None
    torch.testing.assert_close(back[2], covariance)


def test_covariance_follows_the_jacobian(generator: torch.Generator) -> None:
    body = based_body("arm7")
    x = random_states(body, generator=generator)
    n = body.num_parameters
    square = torch.randn(n, n, generator=generator, dtype=torch.float64)
    covariance = square @ square.mT
    step = 1e-6
    shifts = step * torch.eye(n, dtype=torch.float64)
    ahead = move_base(body, *NEW_BASE, x + shifts)[1]
    behind = move_base(body, *NEW_BASE, x - shifts)[1]
    jacobian = ((ahead - behind) / (2 * step)).T
    mapped = move_base(body, *NEW_BASE, x, covariance)[2]
    assert mapped is not None
    torch.testing.assert_close(mapped, jacobian @ covariance @ jacobian.T, rtol=1e-6, atol=1e-6)


def test_covariance_follows_samples(generator: torch.Generator) -> None:
    """Second moments of mapped samples, to five standard errors; the spread is small enough
    for the map to be linear over it."""
    body = based_body("arm7")
    x = random_states(body, generator=generator)
    n, num = body.num_parameters, 20_000
    root = 1e-3 * torch.randn(n, n, generator=generator, dtype=torch.float64)
    noise = torch.randn(num, n, generator=generator, dtype=torch.float64)
    _, y, covariance = move_base(body, *NEW_BASE, x, root @ root.T)
    assert covariance is not None
    moved = move_base(body, *NEW_BASE, x + noise @ root.T)[1] - y
    found = moved.T @ moved / num
    variance = covariance.diagonal()
    error = ((covariance.square() + torch.outer(variance, variance)) / num).sqrt()
    assert ((found - covariance).abs() < 5 * error + 0.02 * variance.max()).all()


def test_without_its_root_a_body_stands_where_it_stood(
    tmp_path: Path, generator: torch.Generator
) -> None:
    """Also one of a file, which hangs on its root turned to Y up."""
    for name in ("arm8", planar_arm(tmp_path / "arm.urdf", 0.5, 0.4)):
        rooted, fixed = based_body(str(name)), load_body(name, free_root=False)
        x = random_states(rooted, generator=generator)
        fixed = fixed.with_base(*base_without_root(rooted, fixed, x))
        own = x[rooted.state_columns(fixed.state_names)]
        torch.testing.assert_close(fixed.pose(own).joints, rooted.pose(x).joints)
