"""All joint angles for a pose: against geometry, random restarts and pytorch-kinematics' poses."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import pytorch_kinematics as pk
import torch
from made_robots import SIX, planar_arm, write_arm
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.targets import pose_targets
from torchcss.errors import BodyError, ConfigurationError, ShapeError
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.solve.inverse_kinematics import Search, inverse_kinematics, link_pose, pose_errors

QUICK = Search(num_samples=64, patience=2, spacing=0.2)


def poses_by_another_program(urdf: Path, x: Tensor) -> Tensor:
    chain = pk.build_serial_chain_from_urdf(urdf.read_bytes(), "tip").to(dtype=x.dtype)
    end = chain.forward_kinematics(x)
    assert isinstance(end, pk.Transform3d)
    return end.get_matrix()


def restarts(body: BodyModel, pose: Tensor, num: int, generator: torch.Generator) -> Tensor:
    """Isolated solutions by descents from anywhere, deduplicated without the module's help."""
    cost = pose_targets(body, "tip", pose)
    share = torch.rand(num, body.num_parameters, generator=generator, dtype=torch.float64)
    x0 = body.lower + share * (body.upper - body.lower)
    modes = TrustRegionNewton(tolerance=1e-16).minimise(cost, x0, body.bounds)
    x = modes.mean[modes.cost < 1e-10]
    distinct = []
    while len(x):
        distinct.append(x[0])
        x = x[(x - x[0]).abs().amax(-1) > 1e-2]
    return torch.stack(distinct)


def test_an_elbow_bends_both_ways(tmp_path: Path, generator: torch.Generator) -> None:
    body = load_body(planar_arm(tmp_path / "arm.urdf", 1.0, 0.75))
    place = torch.tensor([0.9, 0.7, 0.0], dtype=torch.float64)
    found = inverse_kinematics(body, "tip", place, generator=generator, search=QUICK)
    distance = float(place.norm())
    bend = math.acos((distance**2 - 1.0 - 0.5625) / 1.5)
    assert sorted(found.x[:, 1].tolist()) == pytest.approx([-bend, bend], abs=1e-9)
    assert found.num_branches == 2
    assert not found.closed.any()
    assert float(found.position_error.max()) < 1e-10
    assert float(found.angle_error.abs().max()) == 0


def test_single_precision(tmp_path: Path, generator: torch.Generator) -> None:
    body = load_body(planar_arm(tmp_path / "arm.urdf", 1.0, 0.75), dtype=torch.float32)
    place = torch.tensor([0.9, 0.7, 0.0])
    found = inverse_kinematics(body, "tip", place, generator=generator, search=QUICK)
    assert found.x.dtype == torch.float32
    assert found.num_branches == 2
    assert float(found.position_error.max()) < 2e-5


@pytest.mark.parametrize(("distance", "branches"), [(0.6, 2), (2.0, 1)])
def test_self_motions_of_three_equal_bars(
    distance: float, branches: int, tmp_path: Path, generator: torch.Generator
) -> None:
    # With bars of length 1, one closed curve beyond a distance of 1, two within (Burdick 1989).
    body = load_body(planar_arm(tmp_path / "arm.urdf", 1.0, 1.0, 1.0))
    place = torch.tensor([distance, 0.0, 0.0], dtype=torch.float64)
    found = inverse_kinematics(body, "tip", place, generator=generator, search=QUICK)
    assert found.num_branches == branches
    assert found.closed.all()
    assert float(found.position_error.max()) < 1e-10
    assert bool((found.x.abs() <= math.pi).all())
    for branch in range(branches):
        x = found.x[found.branch == branch]
        gap = x.roll(-1, 0) - x
        gap = (gap - 2 * math.pi * (gap / (2 * math.pi)).round()).norm(dim=-1)
        # Around the whole curve, without a hole.
        assert float(gap.max()) < 1.5 * QUICK.spacing


def test_an_arm_of_six_joints(tmp_path: Path, generator: torch.Generator) -> None:
    urdf = write_arm(tmp_path / "six.urdf", SIX)
    body = load_body(urdf)
    truth = torch.tensor([0.4, -0.8, 1.1, 0.5, -0.9, 0.3], dtype=torch.float64)
    pose = link_pose(body, "tip", truth)
    found = inverse_kinematics(body, "tip", pose, generator=generator)
    assert bool(((found.x >= body.lower) & (found.x <= body.upper)).all())
    assert float(found.position_error.max()) < 1e-10
    assert float(found.angle_error.max()) < 1e-10
    # The robot file read by another program, which keeps its numbers in single precision.
    error = (poses_by_another_program(urdf, found.x) - pose).abs().max()
    assert float(error) < 1e-6
    want = restarts(body, pose, 1500, generator)
    assert len(want) >= 4
    nearest = (want[:, None] - found.x).abs().amax(-1).amin(-1)
    assert float(nearest.max()) < 1e-4
    assert len(found.x) == len(want)
    assert float((found.x - truth).abs().amax(-1).min()) < 1e-8


def test_one_fixed_joint_makes_seven_joints_isolated(
    tmp_path: Path, generator: torch.Generator
) -> None:
    body = load_body(write_arm(tmp_path / "seven.urdf"))
    truth = torch.tensor([0.3, 0.7, -0.4, 1.2, 0.5, -0.8, 0.2], dtype=torch.float64)
    pose = link_pose(body, "tip", truth)
    found = inverse_kinematics(
        body, "tip", pose, fixed={"joint3": -0.4}, generator=generator, search=QUICK
    )
    assert bool((found.x[:, 2] == -0.4).all())
    assert found.num_branches == len(found.x) >= 2
    assert float((found.x - truth).abs().amax(-1).min()) < 1e-8
    position, angle = pose_errors(body, "tip", pose, found.x)
    assert float(position.max()) < 1e-10
    assert float(angle.max()) < 1e-10


def test_seven_free_joints_move_along_curves(tmp_path: Path, generator: torch.Generator) -> None:
    urdf = write_arm(tmp_path / "seven.urdf")
    body = load_body(urdf)
    truth = torch.tensor([0.3, 0.7, -0.4, 1.2, 0.5, -0.8, 0.2], dtype=torch.float64)
    pose = link_pose(body, "tip", truth)
    found = inverse_kinematics(body, "tip", pose, generator=generator, search=QUICK)
    assert float((poses_by_another_program(urdf, found.x) - pose).abs().max()) < 1e-6
    assert float(found.angle_error.max()) < 1e-10
    for branch in range(found.num_branches):
        x = found.x[found.branch == branch]
        assert float((x[1:] - x[:-1]).norm(dim=-1).max()) < 1.5 * QUICK.spacing
        if not found.closed[branch]:
            ends = x[[0, -1]]
            room = torch.minimum(ends - body.lower, body.upper - ends)
            assert bool((room.amin(-1) < 1e-9).all()), "a curve ends inside the limits"
    # The elbow swings about the line from shoulder to wrist; on the way it passes the truth.
    assert float((found.x - truth).norm(dim=-1).min()) < 0.5 * QUICK.spacing


def test_a_pose_at_the_limits_is_found(tmp_path: Path, generator: torch.Generator) -> None:
    body = load_body(write_arm(tmp_path / "six.urdf", SIX))
    truth = torch.tensor([0.4, -0.8, 3.1, 0.5, -0.9, 0.3], dtype=torch.float64)
    pose = link_pose(body, "tip", truth)
    found = inverse_kinematics(body, "tip", pose, generator=generator, search=QUICK)
    assert float((found.x - truth).abs().amax(-1).min()) < 1e-6
    assert bool((found.x <= body.upper).all())


def test_an_unreachable_pose_has_no_solution(tmp_path: Path, generator: torch.Generator) -> None:
    body = load_body(planar_arm(tmp_path / "arm.urdf", 1.0, 0.75))
    place = torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64)
    found = inverse_kinematics(body, "tip", place, generator=generator, search=QUICK)
    assert found.x.shape == (0, 2)
    assert found.num_branches == 0
    assert found.num_rounds == QUICK.patience


def test_the_same_seed_gives_the_same_solutions(tmp_path: Path) -> None:
    body = load_body(planar_arm(tmp_path / "arm.urdf", 1.0, 0.8, 0.5, limit=2.5))
    place = torch.tensor([1.2, 0.7, 0.0], dtype=torch.float64)
    first, second = (
        inverse_kinematics(
            body, "tip", place, generator=torch.Generator().manual_seed(3), search=QUICK
        )
        for _ in range(2)
    )
    assert torch.equal(first.x, second.x)
    assert torch.equal(first.branch, second.branch)


def test_bad_questions_are_told(tmp_path: Path, generator: torch.Generator) -> None:
    body = load_body(write_arm(tmp_path / "seven.urdf"))
    pose = link_pose(body, "tip", body.rest)
    with pytest.raises(ConfigurationError, match=r"within its limits, -2\.9 to 2\.9, got 4"):
        inverse_kinematics(body, "tip", pose, fixed={"joint1": 4.0}, generator=generator)
    with pytest.raises(BodyError, match="no parameter 'elbow'"):
        inverse_kinematics(body, "tip", pose, fixed={"elbow": 0.0}, generator=generator)
    # A place alone leaves six joints a redundancy of three: the last one only turns the tip.
    with pytest.raises(ConfigurationError, match="7 free parameters for a pose of 3"):
        inverse_kinematics(body, "tip", pose[:3, 3], generator=generator)
    human = load_body("body30")
    with pytest.raises(ConfigurationError, match="root_x, root_y, root_z: a length without limits"):
        inverse_kinematics(human, "l_wrist_link", pose, generator=generator)
    with pytest.raises(ConfigurationError, match=r"Search\.spacing"):
        Search(spacing=0)
    for share in (-0.1, 1.1):
        with pytest.raises(ConfigurationError, match=r"Search\.share: expected 0 to 1"):
            Search(share=share)
    with pytest.raises(ConfigurationError, match="no free parameter of the body moves 'link0'"):
        inverse_kinematics(body, "link0", pose, generator=generator)
    for bad, message in ((pose * torch.nan, "finite"), (2 * pose, "a rotation")):
        with pytest.raises(ConfigurationError, match=f"pose: expected {message}"):
            inverse_kinematics(body, "tip", bad, generator=generator)
    with pytest.raises(ShapeError, match="pose: expected a tensor, got ndarray"):
        inverse_kinematics(body, "tip", pose.numpy(), generator=generator)  # type: ignore[arg-type]


def test_a_frame_in_single_precision_is_reached(tmp_path: Path, generator: torch.Generator) -> None:
    """Its rotation is none to 1e-7, which no arm could reach to 1e-11."""
    body = load_body(write_arm(tmp_path / "six.urdf", SIX))
    truth = torch.tensor([0.4, -0.8, 1.1, 0.5, -0.9, 0.3], dtype=torch.float64)
    found = inverse_kinematics(
        body, "tip", link_pose(body, "tip", truth).float(), generator=generator
    )
    assert float((found.x - truth).abs().amax(-1).min()) < 1e-5
