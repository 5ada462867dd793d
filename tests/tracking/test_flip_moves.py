"""Jumps to the poses that look alike from one camera."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import CovarianceScaled
from torchcss.studies.render.sequences import arm_motion
from torchcss.tracking.flip_moves import Flips, flipped_poses
from torchcss.vision.camera import Camera

# World: Y up, the camera at its origin looking along -Z.
CAMERA = Camera(
    [[640.0, 0.0, 319.5], [0.0, 640.0, 239.5], [0.0, 0.0, 1.0]],
    (640, 480),
    R_camera_world=torch.diag(torch.tensor([1.0, -1.0, -1.0])).double(),
)


def posed(name: str, dtype: torch.dtype = torch.float64) -> tuple[BodyModel, Tensor]:
    """A body that faces the camera, its right arm reaching towards it."""
    place = [0.30, 0.16, -1.75] if name == "arm8" else [0.0, 0.0, -3.5]
    body = load_body(name).with_base(torch.eye(3).double(), torch.tensor(place).double())
    if name == "arm8":
        x = arm_motion(body, torch.zeros(1).double())[0]
    else:
        x = body.rest.clone()
        x[body.state_index("r_shoulder_swing")] = -1.0
        x[body.state_index("r_elbow_flexion")] = 0.3
    return body.to(dtype=dtype), x.to(dtype)


def extent(uv: Tensor) -> float:
    return float((uv.amax(0) - uv.amin(0)).max())


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_flips_obey_the_limits_and_look_alike(name: str):
    body, x = posed(name)
    joints = body.pose(x).joints
    poses = flipped_poses(body, CAMERA, x, num=8)
    assert 2 <= len(poses) <= 8
    assert torch.equal(body.bounds.project(poses), poses)
    places = body.pose(poses).joints
    uv = CAMERA.project(joints).uv
    missed = (CAMERA.project(places).uv - uv).norm(dim=-1)
    assert float(missed.max()) <= 6 * 0.02 * extent(uv)
    assert float(missed[0].max()) <= 2 * 0.02 * extent(uv)
    # They are poses of their own, all of them.
    every = torch.cat([joints[None], places])
    apart = (every[:, None] - every).norm(dim=-1).amax(-1)
    assert float((apart + torch.eye(len(every))).min()) >= 0.15
    # The fewer wanted, the same first.
    assert torch.equal(flipped_poses(body, CAMERA, x, num=2), poses[:2])


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_an_arm_that_points_at_the_camera_points_away_from_it_in_a_flip(name: str):
    body, x = posed(name)
    shoulder, wrist = body.joint_index("r_shoulder"), body.joint_index("r_wrist")
    joints = body.pose(x).joints
    assert float(joints[wrist, 2] - joints[shoulder, 2]) > 0.3
    places = body.pose(flipped_poses(body, CAMERA, x, num=8)).joints
    reach = places[:, wrist, 2] - places[:, shoulder, 2]
    assert float(reach.min()) < -0.05


ROBOT = """<robot name="door"><link name="wall"/><link name="leaf"/>
<joint name="hinge" type="revolute"><parent link="wall"/><child link="leaf"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""


def test_nothing_flips_without_limbs_or_out_of_sight(tmp_path: Path):
    behind = load_body("body34").with_base(
        torch.eye(3).double(), torch.tensor([0.0, 0.0, 5.0]).double()
    )
    assert flipped_poses(behind, CAMERA, behind.rest, num=8).shape == (0, 34)
    (tmp_path / "door.urdf").write_text(ROBOT)
    door = load_body(str(tmp_path / "door.urdf")).with_base(
        torch.eye(3).double(), torch.tensor([0.0, 0.0, -2.0]).double()
    )
    assert flipped_poses(door, CAMERA, door.rest, num=8).shape == (0, door.num_parameters)
    body, x = posed("arm8")
    assert flipped_poses(body, CAMERA, x, num=0).shape == (0, 8)


def modes_about(x: Tensor) -> GaussianMixture:
    spread = 0.01 * torch.eye(len(x), dtype=x.dtype)
    return GaussianMixture(
        torch.stack([x, x + 0.01]),
        torch.stack([spread, 2 * spread]),
        torch.tensor([0.0, -1.0], dtype=x.dtype),
    ).normalise()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("log_odds", [0.0, -5.0])
def test_flips_are_components_of_the_odds_stated(
    dtype: torch.dtype, log_odds: float, generator: torch.Generator
):
    body, x = posed("arm8", dtype)
    modes, search = modes_about(x), CovarianceScaled(covariance_scale=1.0)
    move = Flips(search=search, log_odds=log_odds, body=body, camera=CAMERA, num=3)
    samples = move.sample(modes, 10, body.bounds, generator=generator)
    jumps = samples.jumps
    assert jumps is not None
    flips = len(jumps.parent)
    assert 1 <= flips <= 3
    assert {part.dtype for part in jumps.mixture} == {dtype}
    assert torch.equal(jumps.mixture.mean, flipped_poses(body, CAMERA, x, num=3))
    odds = jumps.mixture.log_weight - modes.log_weight[0]
    assert odds.tolist() == pytest.approx([log_odds] * flips, abs=1e-5)
    assert torch.equal(jumps.mixture.covariance, modes.covariance[:1].expand(flips, 8, 8))
    assert jumps.parent.tolist() == [0] * flips, "flips of the best mode"
    # Each flip itself comes first, and the rest is drawn about them.
    assert samples.x.shape == (10, 8)
    assert torch.equal(samples.x[:flips], jumps.mixture.mean)
    assert set(samples.parent.tolist()) == {2 + flip for flip in range(flips)}
    assert bool((samples.log_weight == -torch.inf).all()), "not drawn from the modes"


def test_a_body_out_of_sight_has_no_flips(generator: torch.Generator):
    body = load_body("arm8").with_base(torch.eye(3).double(), torch.tensor([0, 0, 5.0]).double())
    search = CovarianceScaled(covariance_scale=1.0)
    move = Flips(search=search, body=body, camera=CAMERA, num=8)
    samples = move.sample(modes_about(body.rest), 8, body.bounds, generator=generator)
    assert samples.jumps is None
    assert samples.x.shape == (0, 8)
