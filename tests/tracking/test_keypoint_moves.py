"""Limbs that miss their keypoints are put there."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from made_sessions import moving_arm, session_on
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.joints import JointTerm
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.proposals import CovarianceScaled
from torchcss.stopwatch import Stopwatch
from torchcss.tracking.keypoint_moves import MissedKeypoints, poses_at_keypoints
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

# World: Y up, the camera at its origin looking along -Z.
CAMERA = Camera(
    [[640.0, 0.0, 319.5], [0.0, 640.0, 239.5], [0.0, 0.0, 1.0]],
    (640, 480),
    R_camera_world=torch.diag(torch.tensor([1.0, -1.0, -1.0])).double(),
)
LEG = ("l_knee", "l_ankle")


def standing(dtype: torch.dtype = torch.float64) -> tuple[BodyModel, Tensor]:
    """A body that stands before the camera."""
    body = load_body("body34").with_base(
        torch.eye(3).double(), torch.tensor([0.0, 0.0, -3.5]).double()
    )
    body = body.to(dtype=dtype)
    return body, body.bounds.project(body.rest.clone())


def lifted(body: BodyModel, x: Tensor, side: str = "l") -> Tensor:
    """The same with a thigh that comes towards the camera."""
    x = x.clone()
    x[body.state_index(f"{side}_hip_flexion")] = 1.3
    x[body.state_index(f"{side}_knee_flexion")] = 1.4
    return x


def places(body: BodyModel, x: Tensor) -> Tensor:
    return body.pose(x).joints


def keypoints_of(body: BodyModel, x: Tensor, confidence: float = 1.0) -> Keypoints:
    uv = CAMERA.project(places(body, x)).uv
    return Keypoints(uv, torch.full_like(uv[:, 0], confidence), body.joint_names)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_leg_is_put_where_its_keypoints_are(dtype: torch.dtype):
    body, x = standing(dtype)
    true = lifted(body, x)
    seen = keypoints_of(body, true)
    poses = poses_at_keypoints(body, CAMERA, x, seen, JointTerm(), num=8)
    assert 1 <= len(poses) <= 8
    assert poses.dtype == dtype
    assert torch.equal(body.bounds.project(poses), poses)
    leg = body.joint_columns(LEG)
    missed = (CAMERA.project(places(body, poses)).uv - seen.positions).norm(dim=-1)[:, leg]
    assert float((CAMERA.project(places(body, x)).uv - seen.positions).norm(dim=-1).max()) > 50
    assert float(missed[0].max()) < 5
    away = (places(body, poses) - places(body, true))[:, leg].norm(dim=-1).amax(-1)
    assert float(away.min()) < 0.05, "one of them is the true one"
    # The rest of the body stays.
    rest = body.joint_columns(["l_wrist", "r_wrist", "r_ankle", "skull_tip"])
    moved = (places(body, poses[:1]) - places(body, x))[:, rest].norm(dim=-1)
    assert float(moved.max()) < 0.03
    # The fewer wanted, the same first.
    fewer = poses_at_keypoints(body, CAMERA, x, seen, JointTerm(), num=1)
    assert torch.equal(fewer, poses[:1])


def test_both_legs_find_their_keypoints():
    body, x = standing()
    true = lifted(body, lifted(body, x), side="r")
    seen = keypoints_of(body, true)
    poses = poses_at_keypoints(body, CAMERA, x, seen, JointTerm(), num=8)
    off = (CAMERA.project(places(body, poses)).uv - seen.positions).norm(dim=-1)
    assert float(off.amax(-1).min()) < 30
    assert float(off.mean(-1).min()) < 8


def test_what_is_not_missed_leads_nowhere(generator: torch.Generator):
    body, x = standing()
    true = lifted(body, x)
    term, nothing = JointTerm(), (0, body.num_parameters)

    def found(pose: Tensor, keypoints: Keypoints, num: int = 8) -> tuple[int, ...]:
        return tuple(poses_at_keypoints(body, CAMERA, pose, keypoints, term, num=num).shape)

    seen = keypoints_of(body, true)
    assert found(x, seen)[0] > 0
    assert found(true, seen) == nothing
    assert found(x, keypoints_of(body, true, confidence=0.0)) == nothing
    assert found(x, seen, num=0) == nothing
    wide = JointTerm(sigma=100.0)
    assert not len(poses_at_keypoints(body, CAMERA, x, seen, wide, num=8))
    behind = body.with_base(torch.eye(3).double(), torch.tensor([0.0, 0.0, 5.0]).double())
    assert not len(poses_at_keypoints(behind, CAMERA, x, seen, term, num=8))
    # A keypoint that no pose reaches is not followed.
    far = seen.positions.clone()
    far[body.joint_index("l_wrist")] = torch.tensor([5000.0, -3000.0]).double()
    known = keypoints_of(body, x)._replace(positions=far)
    only = known.confidence.clone()
    only[:] = 0.0
    only[body.joint_index("l_wrist")] = 1.0
    assert found(x, known._replace(confidence=only)) == nothing


ROBOT = """<robot name="door"><link name="wall"/><link name="leaf"/>
<joint name="hinge" type="revolute"><parent link="wall"/><child link="leaf"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""


def test_a_body_without_limbs_is_left_alone(tmp_path: Path):
    (tmp_path / "door.urdf").write_text(ROBOT)
    place = torch.tensor([0.0, 0.0, -2.0]).double()
    door = load_body(str(tmp_path / "door.urdf")).with_base(torch.eye(3).double(), place)
    far = keypoints_of(door, door.rest)
    far = far._replace(positions=far.positions + 200.0)
    poses = poses_at_keypoints(door, CAMERA, door.rest, far, JointTerm(), num=8)
    assert poses.shape == (0, door.num_parameters)


@pytest.mark.parametrize(
    ("settings", "moves"),
    [
        ({}, True),
        ({"keypoints_use": "first"}, False),
        ({"preset": "ijrr_css", "keypoints_use": "all"}, False),
    ],
)
def test_ours_looks_there_where_keypoints_are_tracked(settings: dict[str, str], moves: bool):
    sequence = moving_arm(3)
    session = session_on(sequence, "cpu", **settings)
    steps = []
    for frame in sequence.frames:
        observation = session.observe(frame)
        cost = session._cost(observation, session.state.memory, Stopwatch(), 1.0)
        move = session._missed_keypoints(cost, CovarianceScaled(covariance_scale=8.0))
        steps.append(move is not None)
        if move is not None:
            assert move.camera is cost.camera, "in the pixels of its keypoints"
        session.step(observation)
    assert steps == [False, moves, moves], "the first pose was fitted to the keypoints"


def test_the_poses_are_components_of_the_odds_stated(generator: torch.Generator):
    body, x = standing()
    n = body.num_parameters
    modes = GaussianMixture(
        torch.stack([x, x]), torch.eye(n).double().expand(2, n, n) * 1e-4, torch.zeros(2).double()
    ).normalise()
    search = CovarianceScaled(covariance_scale=1.0)

    def move(pose: Tensor) -> MissedKeypoints:
        return MissedKeypoints(
            search=search,
            body=body,
            camera=CAMERA,
            keypoints=keypoints_of(body, pose),
            term=JointTerm(),
            num=3,
        )

    samples = move(lifted(body, x)).sample(modes, 6, body.bounds, generator=generator)
    assert samples.jumps is not None
    assert 1 <= len(samples.jumps.parent) <= 3
    assert torch.allclose(samples.jumps.mixture.log_weight, modes.log_weight[0] - 5.0)
    assert samples.jumps.parent.tolist() == [0] * len(samples.jumps.parent)
    assert samples.x.shape == (6, n)
    assert move(x).sample(modes, 6, body.bounds, generator=generator).jumps is None
