"""The fused engine against the eager one on robots from files and on bodies of odd shapes."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from made_costs import changed, make_full_cost, random_states
from made_engines import assert_close, awkward_states, colours_of

from torchcss.body.shape import with_shape
from torchcss.cost.context import BodyTables
from torchcss.cost.total import TrackingCost, beside, numbered, together

ROBOTS = [
    *("panda.urdf", "iiwa7.urdf", "ur5.urdf", "anymal_b.urdf", "poppy_torso.urdf"),
    *("humanoid_gym.xml", "humanoid_CMU.xml"),
]


def shaped(cost: TrackingCost, factor: torch.Tensor) -> TrackingCost:
    """The same with other semi-axes, one factor a part."""
    shape = cost.body.part_shape.clone()
    shape[:, :3] *= factor[:, None]
    body = with_shape(cost.body, shape)
    return colours_of(changed(cost, body=body, tables=BodyTables(body)))


def robot(folder: Path, name: str) -> TrackingCost:
    """A robot's whole cost."""
    if name.endswith(".xml"):
        pytest.importorskip("mujoco")
    return colours_of(make_full_cost(str(folder / "robot_models" / name)))


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_from_files(name: str, shared_data: Path, generator: torch.Generator) -> None:
    cost = robot(shared_data, name)
    x = torch.cat([random_states(cost.body, 6, generator=generator),
                   awkward_states(cost, generator)])  # fmt: skip
    for dtype in ("float64", "float32"):
        assert_close(cost, x, dtype)


def test_views_and_sequences_of_robots(shared_data: Path, generator: torch.Generator) -> None:
    # Two robots of seven joints each, as the samples of a batch have one length.
    first, other = robot(shared_data, "iiwa7.urdf"), make_full_cost("arm7")
    assert first.body.num_parameters == other.body.num_parameters
    second = changed(first, camera=first.camera.resized(200, 150), edge_field=None, features=None)
    x = random_states(first.body, 6, generator=generator)
    assert_close(beside([first, second]), x, "float64")
    first = first.__class__(choice=other.choice, views=first.views)
    assert_close(
        together([first, numbered(other, 1)], torch.tensor([1, 0, 0, 1, 1, 0])), x, "float64"
    )


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_all_parts_hidden(name: str, generator: torch.Generator) -> None:
    cost = make_full_cost(name)
    factor = torch.ones(len(cost.body.part_shape), dtype=torch.float64)
    factor[0] = 6.0  # the first part holds all others
    cost = shaped(cost, factor)
    for dtype in ("float64", "float32"):
        assert_close(cost, random_states(cost.body, 4, generator=generator), dtype)


def test_needles_and_balloons(generator: torch.Generator) -> None:
    cost = make_full_cost("body34")
    count = len(cost.body.part_shape)
    factor = torch.where(torch.arange(count) % 2 == 0, 0.1, 2.0).double()
    cost = shaped(cost, factor)
    assert_close(cost, awkward_states(cost, generator), "float64")
