"""The bodies that ship: proportions, mirror symmetry, directions of motion, scale."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchcss.body.catalog import BODY_NAMES, LENGTHS, PROPORTION_RANGE, PROPORTIONS, specification
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel

BODIES = tuple(name for name in BODY_NAMES if name.startswith("body"))
MIRROR = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)


def at(body: BodyModel, x: Tensor, name: str) -> Tensor:
    return body.pose(x).joints[..., body.joint_index(name), :]


def state(body: BodyModel, **degrees: float) -> Tensor:
    x = torch.zeros(body.num_parameters, dtype=torch.float64)
    for name, value in degrees.items():
        x[body.state_index(name)] = math.radians(value)
    return x


def test_stature_and_segments_are_the_standard_humanoids() -> None:
    body = load_body("body34")
    x = torch.zeros(34, dtype=torch.float64)
    top, sole = at(body, x, "skull_tip")[1], at(body, x, "l_heel")[1]
    assert float(top - sole) == pytest.approx(1.75, abs=0.03)
    for start, end, name in (
        ("l_shoulder", "l_elbow", "upper_arm"),
        ("r_elbow", "r_wrist", "forearm"),
        ("l_hip", "l_knee", "thigh"),
        ("r_knee", "r_ankle", "shank"),
    ):
        length = (at(body, x, start) - at(body, x, end)).norm()
        assert float(length) == pytest.approx(LENGTHS[name], abs=1e-12)
    assert at(body, x, "nose")[2] > at(body, x, "skullbase")[2]
    assert at(body, x, "l_shoulder")[0] > 0 > at(body, x, "r_shoulder")[0]


@pytest.mark.parametrize("name", BODIES)
def test_equal_angles_mean_mirrored_motion(name: str, generator: torch.Generator) -> None:
    body = load_body(name)
    x = 0.5 * torch.randn(5, body.num_parameters, generator=generator, dtype=torch.float64)
    other = x.clone()
    odd = {f"{part}_{angle}" for part in ("lumbar", "neck") for angle in ("bending", "twist")}
    odd |= {"root_x", "root_yaw", "root_roll"}
    for column, parameter in enumerate(body.state_names):
        if parameter.startswith("l_"):
            twin = body.state_index("r_" + parameter[2:])
            other[:, [column, twin]] = x[:, [twin, column]]
            assert body.lower[column] == body.lower[twin]
            assert body.upper[column] == body.upper[twin]
        elif parameter in odd:
            other[:, column] = -x[:, column]
    joints, mirrored = body.pose(x).joints, body.pose(other).joints
    for index, joint in enumerate(body.joint_names):
        twin = {"l_": "r_", "r_": "l_"}.get(joint[:2])
        where = body.joint_index(twin + joint[2:]) if twin else index
        torch.testing.assert_close(mirrored[:, where], joints[:, index] * MIRROR)


def test_angles_turn_the_way_their_names_say() -> None:
    body = load_body("body34")
    rest = torch.zeros(34, dtype=torch.float64)
    for parameter, joint, axis, sign in (
        ("l_elbow_flexion", "l_wrist", 2, 1),
        ("r_knee_flexion", "r_ankle", 2, -1),
        ("l_hip_flexion", "l_knee", 2, 1),
        ("l_hip_abduction", "l_knee", 0, 1),
        ("r_hip_abduction", "r_knee", 0, -1),
        ("r_ankle_flexion", "r_toe", 1, -1),
        ("lumbar_flexion", "skull_tip", 2, 1),
        ("neck_flexion", "nose", 1, -1),
        ("l_clavicle_elevation", "l_shoulder", 1, 1),
        ("r_clavicle_protraction", "r_shoulder", 2, 1),
        ("l_shoulder_raising", "l_elbow", 0, 1),
        ("root_yaw", "nose", 0, 1),
        ("root_pitch", "skull_tip", 2, 1),
        ("root_roll", "skull_tip", 0, -1),
        ("lumbar_bending", "skull_tip", 0, -1),
        ("lumbar_twist", "nose", 0, 1),
        ("neck_bending", "skull_tip", 0, -1),
        ("neck_twist", "nose", 0, 1),
        ("l_hip_twist", "l_toe", 0, 1),
        ("r_hip_twist", "r_toe", 0, -1),
    ):
        moved = at(body, state(body, **{parameter: 20.0}), joint) - at(body, rest, joint)
        assert sign * float(moved[axis]) > 0.01, parameter


@pytest.mark.parametrize("name", ["arm7", "body34"])
def test_shoulder_angles_do_not_lock_inside_the_limits(name: str) -> None:
    """Decision "root": the three axes stay apart wherever the limits allow."""
    body = load_body(name)
    raising = body.state_index("r_shoulder_raising")
    steps = torch.linspace(0, 1, 41, dtype=torch.float64)
    x = torch.zeros(41, body.num_parameters, dtype=torch.float64)
    x[:, raising] = body.lower[raising] + steps * (body.upper - body.lower)[raising]
    omega = body.pose(x).tree.omega
    rows = [
        body.tree.joint_names.index(f"r_shoulder_{angle}")
        for angle in ("swing", "raising", "twist")
    ]
    volume = torch.linalg.det(omega[:, rows]).abs()
    assert float(volume.min()) > math.sin(math.radians(9.9))


@pytest.mark.parametrize("name", BODY_NAMES)
def test_every_part_rotation_is_one(name: str) -> None:
    body = load_body(name)
    identity = torch.eye(3, dtype=torch.float64).expand(body.num_parts, 3, 3)
    torch.testing.assert_close(body.part_rotation @ body.part_rotation.mT, identity)
    torch.testing.assert_close(
        torch.linalg.det(body.part_rotation), torch.ones(body.num_parts, dtype=torch.float64)
    )


@pytest.mark.parametrize("name", BODY_NAMES)
def test_scale_scales_everything(name: str, generator: torch.Generator) -> None:
    small = load_body(name, free_proportions=True)
    large = load_body(name, free_proportions=True, scale=1.2)
    x = small.bounds.project(
        0.5 * torch.randn(3, small.num_parameters, generator=generator, dtype=torch.float64)
    )
    metres = torch.tensor(
        [name.endswith("_length") or name in ("root_x", "root_y", "root_z")
         for name in small.state_names]
    )  # fmt: skip
    factor = torch.where(metres, 1.2, 1.0).double()
    y = x * factor
    torch.testing.assert_close(large.pose(y).joints, 1.2 * small.pose(x).joints)
    torch.testing.assert_close(
        large.surface(large.pose(y)).points, 1.2 * small.surface(small.pose(x)).points
    )
    torch.testing.assert_close(large.lower, small.lower * factor)
    torch.testing.assert_close(large.upper, small.upper * factor)
    torch.testing.assert_close(large.sticky_mean, small.sticky_mean * factor)
    torch.testing.assert_close(large.sticky_deviation, small.sticky_deviation * factor)


@pytest.mark.parametrize("driver", ["prismatic", "revolute"])
@pytest.mark.parametrize("follower", ["prismatic", "revolute"])
def test_scale_scales_what_follows_another_joint(
    tmp_path: Path, driver: str, follower: str
) -> None:
    """Metres per radian, radians per metre, and where the follower is while the driver is zero."""
    path = tmp_path / "robot.urdf"
    path.write_text(
        "<robot name='r'><link name='a'/><link name='b'/><link name='c'/><link name='d'/>"
        f"<joint name='drive' type='{driver}'><parent link='a'/><child link='b'/>"
        "<axis xyz='0 1 0'/><limit lower='-0.3' upper='0.3'/></joint>"
        f"<joint name='follow' type='{follower}'><parent link='b'/><child link='c'/>"
        "<origin xyz='0 0.1 0.4'/><axis xyz='1 0 0'/><limit lower='-1' upper='0.15'/>"
        "<mimic joint='drive' multiplier='0.5' offset='0.1'/></joint>"
        "<joint name='end' type='fixed'><parent link='c'/><child link='d'/>"
        "<origin xyz='0 0 0.3'/></joint></robot>"
    )
    small, large = load_body(path), load_body(path, scale=2.0)
    unit = 2.0 if driver == "prismatic" else 1.0
    x = torch.tensor([[-0.2], [0.0], [0.1]], dtype=torch.float64)
    torch.testing.assert_close(large.pose(unit * x).joints, 2 * small.pose(x).joints)
    assert (float(small.lower), float(small.upper)) == pytest.approx((-0.3, 0.1))
    torch.testing.assert_close(large.lower, unit * small.lower)
    torch.testing.assert_close(large.upper, unit * small.upper)


def test_proportions_stay_within_their_interval_of_the_standard() -> None:
    lengths = {"forearm": LENGTHS["forearm"] * 1.05}
    body = load_body("body30", free_proportions=True, lengths=lengths)
    names = {name for name in body.state_names if name.endswith("_length")}
    assert names <= {f"{name}_length" for name in PROPORTIONS}
    for name in names:
        length = name.removesuffix("_length")
        row = body.state_index(name)
        ends = body.lengths[length] + torch.stack([body.lower[row], body.upper[row]])
        expected = LENGTHS[length] * (1 + PROPORTION_RANGE * torch.tensor([-1.0, 1.0]).double())
        torch.testing.assert_close(ends, expected)
        assert float(body.sticky_mean[row]) == pytest.approx(LENGTHS[length] - body.lengths[length])


def test_roots_are_free_or_not_as_asked() -> None:
    assert load_body("arm7", free_root=True).num_parameters == 13
    assert load_body("body30", free_root=False).num_parameters == 24


@pytest.mark.parametrize("name", BODY_NAMES)
def test_neighbours_and_ties_name_what_exists(name: str) -> None:
    body = specification(name, free_proportions=True)
    parts = {part.name for part in body.parts}
    assert all({first, second} <= parts for first, second in body.neighbours)
    joints = {joint.name for joint in body.joints}
    assert set(body.ties) <= joints
    assert all(part.shape[0] > 0 for part in body.parts)
