"""The fused engine against the eager one on robots from files and on bodies of odd shapes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from made_costs import JOINTS_ONLY, changed, make_cost, make_full_cost, random_states
from made_engines import assert_close, awkward_states, colours_of

from torchcss.body.load import FileOptions, load_body
from torchcss.body.shape import with_shape
from torchcss.cost.context import BodyTables
from torchcss.cost.fused.engine import FusedEngine
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


def test_keypoints_of_many_joints_without_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, generator: torch.Generator
) -> None:
    """There is memory for all of them: parts and nodes alone do not say how much."""
    links = "".join(f"<link name='l{n}'/>" for n in range(101))
    joints = "".join(
        f"<joint name='j{n}' type='continuous'><parent link='l{n}'/><child link='l{n + 1}'/>"
        "<origin xyz='0 0.005 0'/></joint>"
        for n in range(100)
    )
    (tmp_path / "a.urdf").write_text(f"<robot name='a'>{links}{joints}</robot>")
    bare = partial(load_body, file=FileOptions(shape="none"))
    monkeypatch.setattr("made_costs.load_body", bare)
    cost = make_cost(str(tmp_path / "a.urdf"), JOINTS_ONLY)
    assert len(cost.views[0].keypoints.names) > 99
    assert not cost.body.num_parts
    x = random_states(cost.body, 2, generator=generator)
    assert_close(cost, x, "float64")
    engine = FusedEngine("float64")
    replace(cost, engine=engine).value(x)
    for memory in engine._workspaces.values():
        assert len(memory.take().points.x) > 99


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
