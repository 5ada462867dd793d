"""Retargeting: known motions come back, limits hold, real recordings are followed."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from reference.kinematics import rotation

from torchcss.body.catalog import LENGTHS
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.interpenetration import Interpenetration, InterpenetrationPairs
from torchcss.cost.targets import PointTargets
from torchcss.cost.term import differentiate_twice
from torchcss.errors import ConfigurationError, MotionCaptureError
from torchcss.io.motion.positions import (
    LIMB_JOINTS,
    MotionCapture,
    limb_positions,
    read_motion_capture,
    resample_motion,
)
from torchcss.solve.retarget import (
    Retargeting,
    fit_lengths,
    levelled,
    limbs_with_lengths,
    retarget,
)

TREE = {
    "HumanoidRoot": None, "vl5": "HumanoidRoot", "vt1": "vl5", "vc7": "vt1", "skullbase": "vc7",
    "skull_tip": "skullbase", "nose": "skullbase",
    **{f"{s}_{a}": b and f"{s}_{b}" for s in "lr" for a, b in
       {"hip": "", "knee": "hip", "ankle": "knee", "midtarsal": "ankle", "toe": "midtarsal",
        "heel": "ankle", "shoulder": "", "elbow": "shoulder", "wrist": "elbow"}.items()},
}  # fmt: skip
PARENTS = {
    name: above or ("vt1" if "shoulder" in name else "HumanoidRoot") if above is not None else None
    for name, above in TREE.items()
}
"""A skeleton of the body's own joints; parents stand before children."""


def capture_of(
    body: BodyModel, states: torch.Tensor, leave_out: tuple[str, ...] = ()
) -> MotionCapture:
    """A motion of a body as motion capture would have it, zero pose and all."""
    names = [name for name in PARENTS if name not in leave_out]
    index = body.joint_columns(names)
    above = [PARENTS[name] for name in names]
    upright = body.with_base(torch.eye(3), torch.zeros(3))
    rest = upright.pose(torch.zeros_like(body.lower)).joints[index]
    return MotionCapture(
        tuple(names),
        tuple(-1 if parent is None else names.index(parent) for parent in above),
        (rest - rest[0]).numpy(),
        body.pose(states).joints[:, index].numpy(),
        25.0,
        (),
    )


def moving(body: BodyModel, count: int = 40, turns: float = 0.0) -> torch.Tensor:
    """Smooth states about the stabilisers' rest, well within the limits, turning on the spot.

    At the rate of `capture_of` every angle swings once in 1.6 seconds.
    """
    source = torch.Generator().manual_seed(0)
    t = torch.arange(count, dtype=torch.float64)[:, None] / 40
    phase = 2 * math.pi * torch.rand(body.num_parameters, generator=source, dtype=torch.float64)
    spread = torch.where(body.sticky_deviation.isfinite(), body.sticky_deviation, 0.1)
    states = body.sticky_mean + 0.5 * spread * torch.sin(2 * math.pi * t + phase)
    for side in "lr":  # the arms away from the trunk
        states[:, body.state_index(f"{side}_shoulder_raising")] += math.radians(35)
    margin = 0.05
    states = torch.minimum(torch.maximum(states, body.lower + margin), body.upper - margin)
    yaw = torch.linspace(-math.pi * turns, math.pi * turns, count, dtype=torch.float64)
    states[:, body.state_index("root_yaw")] = yaw
    states[:, body.state_index("root_y")] += 0.9
    return states


@pytest.fixture(scope="module")
def subject() -> BodyModel:
    factor = {"thigh": 0.95, "shank": 1.04, "upper_arm": 0.93, "forearm": 1.05, "trunk": 0.97,
              "shoulder_width": 1.02, "hip_width": 1.06, "foot": 1.03}  # fmt: skip
    return load_body("body34", lengths={k: f * LENGTHS[k] for k, f in factor.items()})


def test_a_known_motion_comes_back(subject: BodyModel, generator: torch.Generator) -> None:
    """Turning almost twice about: joints, angles, lengths, and a yaw that has no jump."""
    states = moving(subject, turns=1.9)
    # The motion is not free of collisions, which would be mended.
    choice = Retargeting(repulsion=None)
    found = retarget(capture_of(subject, states), generator=generator, choice=choice)
    # The trunk is measured from hips to shoulders, which a bent back shortens.
    for name in ("thigh", "shank", "upper_arm", "forearm", "hip_width", "foot"):
        assert found.body.lengths[name] == pytest.approx(subject.lengths[name], abs=1e-3)
    assert found.body.lengths["trunk"] == pytest.approx(subject.lengths["trunk"], abs=0.01)
    assert found.target_names == LIMB_JOINTS
    assert found.error.mean() < 0.001
    assert found.error.max() < 0.003
    yaw = found.states[:, found.body.state_index("root_yaw")]
    assert yaw.diff().abs().max() < 0.5
    assert (yaw[-1] - yaw[0]).item() == pytest.approx(2 * math.pi * 1.9, abs=0.1)
    # What the joints tell is told: the legs' and arms' angles to a few degrees.
    told = ("knee_flexion", "elbow_flexion", "hip_flexion", "hip_abduction")
    columns = [i for i, name in enumerate(subject.state_names) if name.endswith(told)]
    apart = (found.states - states)[:, columns].abs()
    assert apart.mean() < math.radians(2)
    assert apart.max() < math.radians(10)


def test_the_world_is_as_promised(subject: BodyModel, generator: torch.Generator) -> None:
    """Y up, path about the origin, feet on the floor, facing the middle of the turns."""
    states = moving(subject, count=20, turns=0.3)
    states[:, 0] += torch.linspace(3, 3.8, len(states))
    states[:, subject.state_index("root_yaw")] += 2.0
    capture = capture_of(subject, states)
    found = retarget(capture, generator=generator)
    hips = found.joints[:, found.body.joint_index("HumanoidRoot")]
    for axis in (0, 2):
        assert abs(hips[:, axis].max() + hips[:, axis].min()) < 0.02
    feet = [found.body.joint_index(f"{side}_{end}") for side in "lr" for end in ("heel", "toe")]
    lowest = found.joints[:, feet, 1].amin(-1)
    assert abs(lowest.quantile(0.05)) < 1e-9
    assert found.body.base_rotation[1].tolist() == pytest.approx([0, 1, 0])
    yaw = found.states[:, found.body.state_index("root_yaw")]
    assert yaw.max() + yaw.min() == pytest.approx(0.0, abs=1e-9)
    torch.testing.assert_close(found.joints, found.body.pose(found.states).joints)
    # The source was moved along: what is left of its own place is one shift.
    _, _, limbs = limb_positions(capture)
    shift = found.targets - torch.from_numpy(limbs)
    torch.testing.assert_close(shift, shift[:1, :1].expand_as(shift))
    moved = found.source - torch.from_numpy(capture.joints)
    torch.testing.assert_close(moved, shift[:1, :1].expand_as(moved))
    lower, upper = found.body.bounds
    assert bool(((found.states >= lower) & (found.states <= upper)).all())
    # Left where it was, it stays there.
    quick = Retargeting(num_starts=1, max_steps=1)
    there = retarget(capture, generator=generator, centred=False, choice=quick)
    torch.testing.assert_close(there.targets, torch.from_numpy(limbs))


@pytest.mark.parametrize("name", ["body30", "body32"])
def test_other_bodies(subject: BodyModel, generator: torch.Generator, name: str) -> None:
    capture = capture_of(subject, moving(subject, count=6))
    found = retarget(capture, body=name, generator=generator, choice=Retargeting(num_starts=2))
    assert found.body.name == name
    assert found.error.mean() < 0.015


def test_bodies_without_root_are_refused(subject: BodyModel, generator: torch.Generator) -> None:
    capture = capture_of(subject, moving(subject, count=2))
    for name in ("arm7", "absent"):
        with pytest.raises(ConfigurationError, match="body30, body32, body34"):
            retarget(capture, body=name, generator=generator)
    without = capture_of(subject, moving(subject, count=2), leave_out=("l_hip", "l_knee", "l_ankle",
                         "l_midtarsal", "l_toe", "l_heel"))  # fmt: skip
    with pytest.raises(MotionCaptureError, match="hips and shoulders"):
        retarget(without, generator=generator)


def test_missing_limbs_rest(subject: BodyModel, generator: torch.Generator) -> None:
    """A skeleton of trunk and legs: the arms hang as the stabilisers have them."""
    missing = ("l_elbow", "l_wrist", "r_elbow", "r_wrist")
    capture = capture_of(subject, moving(subject, count=8), leave_out=missing)
    found = retarget(capture, generator=generator)
    assert len(found.target_names) == 8
    assert found.error.mean() < 0.004
    elbow = found.states[:, found.body.state_index("l_elbow_flexion")]
    assert (elbow - math.radians(30)).abs().max() < math.radians(10)


def test_a_zero_pose_that_faces_elsewhere_is_not_trusted(
    subject: BodyModel, generator: torch.Generator
) -> None:
    capture = capture_of(subject, moving(subject, count=4))
    turned = capture._replace(rest=capture.rest @ np.diag([-1.0, 1.0, -1.0]))
    found = retarget(turned, generator=generator)
    assert any("follow the limbs alone" in line for line in found.report)
    assert found.error.mean() < 0.004


def test_a_steep_root_is_told(subject: BodyModel, generator: torch.Generator) -> None:
    states = moving(subject, count=4)
    states[:, subject.state_index("root_pitch")] = math.radians(82)
    found = retarget(capture_of(subject, states), generator=generator)
    assert any("needs several bases" in line for line in found.report)
    upright = retarget(capture_of(subject, moving(subject, count=4)), generator=generator)
    assert not any("WARNING" in line for line in upright.report)


def test_more_than_two_turns_are_continuous_and_told(
    subject: BodyModel, generator: torch.Generator
) -> None:
    states = moving(subject, count=40, turns=2.5)
    found = retarget(
        capture_of(subject, states), generator=generator, choice=Retargeting(num_starts=1)
    )
    yaw = found.states[:, found.body.state_index("root_yaw")]
    assert (yaw[-1] - yaw[0]).item() == pytest.approx(5 * math.pi, abs=0.1)
    assert found.error.mean() < 0.004
    if yaw.max() > found.body.upper[found.body.state_index("root_yaw")]:
        assert any("beyond the body's limits: root_yaw" in line for line in found.report)


def test_no_numbers_that_make_no_sense() -> None:
    for options in ({"sigma": 0.0}, {"num_starts": 0}, {"settling_s": math.inf}):
        with pytest.raises(ConfigurationError, match="expected"):
            Retargeting(**options)


# The parts.


def test_lengths_stay_in_range(subject: BodyModel) -> None:
    joints = subject.pose(moving(subject)).joints[:, subject.joint_columns(LIMB_JOINTS)]
    lengths, (line,) = fit_lengths(LIMB_JOINTS, joints)
    assert "all within" in line
    assert lengths["thigh"] == pytest.approx(subject.lengths["thigh"])
    large, (line,) = fit_lengths(LIMB_JOINTS, 1.3 * joints)
    assert "thigh 526 -> 469" in line
    for name, value in large.items():
        assert 0.9 <= value / LENGTHS[name] <= 1.1 + 1e-12
    assert large["head"] == pytest.approx(1.1 * LENGTHS["head"])  # grows with the rest


def test_joints_take_lengths_and_keep_directions(
    subject: BodyModel, generator: torch.Generator
) -> None:
    joints = subject.pose(moving(subject, count=6)).joints
    joints = joints[:, subject.joint_columns(LIMB_JOINTS)]
    narrow = joints.clone()
    for side, sign in (("l", 1), ("r", -1)):  # the shoulders 6 cm nearer to each other
        across = (
            joints[:, LIMB_JOINTS.index("l_shoulder")] - joints[:, LIMB_JOINTS.index("r_shoulder")]
        )
        arm = [LIMB_JOINTS.index(f"{side}_{joint}") for joint in ("shoulder", "elbow", "wrist")]
        narrow[:, arm] -= sign * 0.03 * (across / across.norm(dim=-1, keepdim=True))[:, None]
    restored = limbs_with_lengths(LIMB_JOINTS, narrow, subject.lengths)
    torch.testing.assert_close(restored, joints, rtol=0, atol=2e-3)
    elbowless = [i for i, name in enumerate(LIMB_JOINTS) if "elbow" not in name]
    names = tuple(LIMB_JOINTS[i] for i in elbowless)
    restored = limbs_with_lengths(names, narrow[:, elbowless], subject.lengths)
    torch.testing.assert_close(restored, joints[:, elbowless], rtol=0, atol=2e-3)


def test_derivatives_against_autograd(subject: BodyModel, generator: torch.Generator) -> None:
    states = moving(subject, count=3)
    count = len(LIMB_JOINTS)
    target = torch.randn(3, count, 3, generator=generator, dtype=torch.float64)
    cost = PointTargets(
        body=subject,
        link=subject.marker_link[subject.joint_columns(LIMB_JOINTS)],
        offset=0.1 * torch.randn(count, 3, generator=generator, dtype=torch.float64),
        target=target,
        sigma=torch.linspace(0.1, 0.2, count, dtype=torch.float64),
    )
    model = cost.local_model(states)
    x = states.clone().requires_grad_()
    reference = differentiate_twice(cost.value(x), x)
    for found, expected in zip(model, reference, strict=True):
        torch.testing.assert_close(found, expected)
    some = cost.take(torch.tensor([2, 0]))
    torch.testing.assert_close(some.value(states[[2, 0]]), model.value[[2, 0]])
    # The repulsion, which has tests of its own, comes on top.
    term, pairs = Interpenetration(weight=100), InterpenetrationPairs(subject)
    apart = term.local_model(subject, subject.pose(states), pairs)
    both = replace(cost, repulsion=term, pairs=pairs).local_model(states)
    for found, expected, own in zip(both, model, apart, strict=True):
        torch.testing.assert_close(found, expected + own)


@pytest.mark.parametrize("degrees", [-2.0, 0.0, 1.5, 10.0])
def test_a_tilted_floor_is_levelled(degrees: float, generator: torch.Generator) -> None:
    """Steps along a diagonal, with a jump; a ramp is left alone."""
    t = torch.linspace(-1, 1, 60, dtype=torch.float64)
    path = torch.stack([0.8 * t, 0.9 + 0 * t, 1.2 * t], dim=-1)
    joints = path[:, None] + torch.randn(60, 5, 3, generator=generator, dtype=torch.float64)
    joints[..., 1] = 0.8 * torch.rand(60, 5, generator=generator, dtype=torch.float64) + 0.1
    joints[:, 0, 1] = torch.where((t > 0.3) & (t < 0.6), 0.4, 0.0)
    joints[:, 0, ::2] = path[:, ::2]
    share = math.radians(degrees) / math.hypot(1.2, 0.8)
    turn = rotation(1.2 * share, 0.0, -0.8 * share)
    found, report = levelled(joints @ turn.T, path @ turn.T)
    if 0.2 < abs(degrees) < 4:
        torch.testing.assert_close(found, joints, atol=2e-3, rtol=0)
        assert f"{abs(degrees):.1f} degrees" in report[0]
    else:
        torch.testing.assert_close(found, joints @ turn.T)
        assert report == []


# Real recordings.


@pytest.mark.parametrize(
    ("file", "skeleton", "start", "stop", "mean_mm", "worst_mm"),
    [
        ("07_05-walk.amc", "07-walk.asf", 0, 4, 6, 30),
        ("131_04-dance.amc", "131-dance.asf", 2, 6, 14, 60),
        ("pirouette.amc", "pirouette.asf", 1.15, None, 14, 50),
    ],
)
def test_recordings_are_followed(
    shared_data: Path, generator: torch.Generator, file: str, skeleton: str, start: float,
    stop: float | None, mean_mm: float, worst_mm: float,
) -> None:  # fmt: skip
    folder = shared_data / "mocap_cmu"
    whole = read_motion_capture(folder / file, skeleton=folder / skeleton)
    motion = resample_motion(whole, rate=8, start=start, stop=stop)
    found = retarget(motion, generator=generator)
    assert 1000 * found.error.mean() < mean_mm
    assert 1000 * found.error.max() < worst_mm
    lower, upper = found.body.bounds
    assert bool(((found.states >= lower) & (found.states <= upper)).all())
    yaw = found.states[:, found.body.state_index("root_yaw")]
    assert yaw.diff().abs().max() < 2
    if "pirouette" in file:
        assert yaw.max() - yaw.min() > math.radians(680)
    assert found.depth.max() < 0.06
