"""Flips keep the image and the lengths, and change what they are asked to."""

from __future__ import annotations

import math

import pytest
import torch

from torchcss.body.flips import Segments
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel

CENTRE = torch.tensor([0.2, -0.1, 4.0], dtype=torch.float64)


def flip_plainly(segments: Segments, joints, flipped, centre) -> list[list[float]]:
    """One pose, joint by joint, in floats: the sphere about the parent meets the line of sight."""
    eye = centre.tolist()
    old = [[p - e for p, e in zip(joint, eye, strict=True)] for joint in joints.tolist()]
    new = list(old)
    for child, parent, group in segments._rows:
        dot = lambda a, b: sum(p * q for p, q in zip(a, b, strict=True))  # noqa: E731
        length = math.dist(old[child], old[parent])
        size = math.sqrt(dot(old[child], old[child]))
        d = [p / size for p in old[child]]
        sign = 1.0 if size > dot(d, old[parent]) else -1.0
        sign = -sign if flipped[group] else sign
        foot = dot(d, new[parent])
        inside = length**2 - dot(new[parent], new[parent]) + foot**2
        t = foot + sign * math.sqrt(max(inside, 0.0))
        new[child] = [t * p for p in d]
    return [[p + e for p, e in zip(joint, eye, strict=True)] for joint in new]


def random_joints(body: BodyModel, num: int, generator: torch.Generator) -> torch.Tensor:
    x = 0.5 * torch.randn(num, body.num_parameters, generator=generator, dtype=torch.float64)
    return body.pose(body.bounds.project(x)).joints


@pytest.mark.parametrize("name", ["body30", "body34", "arm7", "arm8"])
def test_lines_of_sight_and_lengths_stay(name: str, generator: torch.Generator):
    body = load_body(name)
    segments = Segments(body)
    joints = random_joints(body, 30, generator)
    flipped = torch.rand(30, len(segments.groups), generator=generator) < 0.5
    found = segments.flip(joints, flipped, CENTRE)
    before = joints[:, segments.joint]
    rays = [
        (each - CENTRE) / (each - CENTRE).norm(dim=-1, keepdim=True) for each in (before, found)
    ]
    torch.testing.assert_close(rays[0], rays[1])
    for item in range(30):
        plain = flip_plainly(segments, before[item], flipped[item].tolist(), CENTRE)
        torch.testing.assert_close(found[item], torch.tensor(plain, dtype=torch.float64))
    child, parent = (torch.tensor(rows) for rows in list(zip(*segments._rows, strict=True))[:2])
    length = [(each[:, child] - each[:, parent]).norm(dim=-1) for each in (before, found)]
    # A line of sight may miss the sphere; nearly all do not.
    kept = (length[0] - length[1]).abs() < 1e-9
    assert float(kept.double().mean()) > 0.8
    # Those that miss are as near as they can come: longer than the segment.
    assert bool((length[1] > length[0] - 1e-9).all())


def test_no_flip_is_no_change_and_two_are_none(generator: torch.Generator):
    body = load_body("body34")
    segments = Segments(body)
    joints = random_joints(body, 20, generator)
    none = torch.zeros(20, len(segments.groups), dtype=torch.bool)
    before = joints[:, segments.joint]
    torch.testing.assert_close(segments.flip(joints, none, CENTRE), before)
    one = none.clone()
    one[:, segments.groups.index("l_wrist")] = True
    after = joints.clone()
    after[:, segments.joint] = segments.flip(joints, one, CENTRE)
    wrist = body.joint_index("l_wrist")
    elbow = body.joint_index("l_elbow")
    changed = (after - joints).norm(dim=-1) > 1e-6
    assert bool(changed[:, wrist].any())
    assert not bool(changed[:, elbow].any())
    back = segments.flip(after, one, CENTRE)[:, segments.joint.tolist().index(wrist)]
    torch.testing.assert_close(back, joints[:, wrist])


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_any_leading_shape_and_single_precision(shape: tuple, generator: torch.Generator):
    body = load_body("body34", dtype=torch.float32)
    segments = Segments(body)
    x = torch.randn(*shape, body.num_parameters, generator=generator)
    joints = body.pose(body.bounds.project(x)).joints
    flipped = torch.ones(*shape, len(segments.groups), dtype=torch.bool)
    found = segments.flip(joints, flipped, CENTRE)
    assert found.shape == (*shape, len(segments.joint), 3)
    assert found.dtype == torch.float32


def test_limbs_own_the_parameters_that_move_nothing_else():
    body = load_body("body34", free_proportions=True)
    limbs = {limb.name: limb for limb in Segments(body).limbs}
    assert set(limbs) == {"l_arm", "r_arm", "l_leg", "r_leg"}
    names = [body.state_names[column] for column in limbs["r_leg"].columns.tolist()]
    assert names == [
        "r_hip_flexion", "r_hip_abduction", "r_hip_twist", "r_knee_flexion", "r_ankle_flexion"
    ]  # fmt: skip
    assert limbs["l_arm"].groups == ("l_elbow", "l_wrist", "l_hand_tip")


@pytest.mark.parametrize("name", ["body34", "arm8"])
def test_joints_move_to_the_lines_of_sight_that_are_given(name: str, generator: torch.Generator):
    body = load_body(name)
    segments = Segments(body)
    joints, others = random_joints(body, 2, generator)
    flipped = torch.rand(len(segments.groups), generator=generator) < 0.5

    def sight(places: torch.Tensor) -> torch.Tensor:
        return (places - CENTRE) / (places - CENTRE).norm(dim=-1, keepdim=True)

    own = segments.flip(joints, flipped, CENTRE, sight(joints))
    torch.testing.assert_close(own, segments.flip(joints, flipped, CENTRE))
    found = segments.flip(joints, flipped, CENTRE, sight(others))
    moved = [child for child, _, _ in segments._rows]
    torch.testing.assert_close(sight(found)[moved], sight(others)[segments.joint][moved])
