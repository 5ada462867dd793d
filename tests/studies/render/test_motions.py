"""Key poses: the spline between them, the built-in motions within what a person can do."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.shape import with_shape
from torchcss.cost.interpenetration import InterpenetrationPairs
from torchcss.errors import ConfigurationError
from torchcss.studies.random_person import random_lengths
from torchcss.studies.render.motions import (
    MOTIONS,
    clamped_spline,
    plant_feet,
    sample_times,
)
from torchcss.studies.render.sequences import shot

RATE = 50.0
FASTEST_HAND = 3.0
"""Metres per second: brisk reaching."""
HARDEST = 30.0
"""Metres per second squared, of any joint; a reaching hand is at some 10."""


@pytest.fixture(scope="module", params=list(MOTIONS))
def moved(request: pytest.FixtureRequest) -> tuple[str, BodyModel, Tensor]:
    """A built-in motion, of a person of other lengths where the sequence has one."""
    poses = MOTIONS[request.param]
    lengths = None
    if not poses.body.startswith("arm"):
        lengths = random_lengths(generator=torch.Generator().manual_seed(0))
    body = load_body(poses.body, lengths=lengths)
    return request.param, body, poses.states(body, sample_times(round(poses.duration * RATE), RATE))


def test_the_spline_meets_its_knots_smoothly_and_rests_at_the_ends() -> None:
    knots, values = (0.0, 0.4, 1.5, 1.9, 3.0), (1.0, -2.0, 0.5, 0.5, 4.0)
    at = torch.tensor(knots, dtype=torch.float64)
    assert clamped_spline(knots, values, at).tolist() == pytest.approx(values)
    # Outside it stands still.
    assert clamped_spline(knots, values, at.new_tensor([-1.0, 9.0])).tolist() == pytest.approx(
        [1, 4]
    )
    times = torch.linspace(0, 3, 3001, dtype=torch.float64)
    speed = clamped_spline(knots, values, times).diff() / 1e-3
    assert float(speed[[0, -1]].abs().max()) < 0.05
    assert float(speed.diff().diff().abs().max()) < 1e-3  # accelerations have no jumps


def test_there_is_at_least_one_frame() -> None:
    for frames in (0, -3):
        with pytest.raises(ConfigurationError, match="num_frames must be at least 1"):
            shot("arm", num_frames=frames)


def test_motions_have_the_papers_length() -> None:
    frames = {name: round(poses.duration * RATE) for name, poses in MOTIONS.items()}
    assert frames == {"arm": 400, "body-clutter": 175, "body-dark": 200}
    assert [poses.body for poses in MOTIONS.values()] == ["arm8", "body30", "body34"]


def test_joints_stay_within_their_limits(moved: tuple[str, BodyModel, Tensor]) -> None:
    _, body, states = moved
    lower, upper = body.bounds
    assert bool((states >= lower).all() & (states <= upper).all())


def test_speeds_are_a_persons(moved: tuple[str, BodyModel, Tensor]) -> None:
    _, body, states = moved
    velocity = body.pose(states).joints.diff(dim=0) * RATE
    assert float(velocity.norm(dim=-1).max()) < FASTEST_HAND
    # Without a jump of the velocity either: the spline's second derivative is continuous.
    assert float((velocity.diff(dim=0) * RATE).norm(dim=-1).max()) < HARDEST


def test_it_moves_in_depth(moved: tuple[str, BodyModel, Tensor]) -> None:
    _, body, states = moved
    wrist = body.pose(states).joints[:, body.joint_index("r_wrist"), 2]
    assert float(wrist.max() - wrist.min()) > 0.4


def test_no_part_enters_another(moved: tuple[str, BodyModel, Tensor]) -> None:
    """Not even where all girths are 8 % larger, as those of a rendered figure may be."""
    _, body, states = moved
    stout = body.part_shape.clone()
    stout[:, :2] *= 1.08
    body = with_shape(body, stout)
    pairs = InterpenetrationPairs(body, rings=10, meridians=14)
    near = pairs.near(body, body.pose(states), 1.1)
    square, _, _ = pairs.radial_square(near)
    worst = float(square.min()) if len(square) else math.inf
    assert worst > 1, "a node of a part lies inside another part"


@pytest.mark.parametrize("name", ["body-clutter", "body-dark"])
def test_feet_stay_on_the_ground(name: str) -> None:
    poses = MOTIONS[name]
    body = load_body(poses.body)
    states = poses.states(body, sample_times(round(poses.duration * 25), 25.0))
    marks = [
        body.joint_index(f"{s}_{place}") for s in "lr" for place in ("heel", "midtarsal", "toe")
    ]
    joints = body.pose(states).joints[:, marks]
    assert float((joints - joints[0]).norm(dim=-1).max()) < 0.02
    # It is the legs that keep them there.
    turn = states[:, body.state_index("root_yaw")]
    assert float(turn.max() - turn.min()) > math.radians(50)


def test_planting_leaves_all_but_the_legs_alone() -> None:
    body = load_body("body34")
    states = body.rest.repeat(3, 1)
    states[:, body.state_index("root_x")] = torch.tensor([0.0, 0.01, 0.02])
    planted = plant_feet(body, states)
    others = [
        i
        for i, name in enumerate(body.state_names)
        if not any(leg in name for leg in ("hip", "knee", "ankle"))
    ]
    assert torch.equal(planted[:, others], states[:, others])
    assert not torch.equal(planted, states)


def test_the_dark_sequence_needs_the_clavicles() -> None:
    poses = MOTIONS["body-dark"]
    for side in "lr":
        for angle in ("elevation", "protraction"):
            assert max(poses.degrees[f"{side}_clavicle_{angle}"]) > 20
