"""State layout, ties, bases, meshes and the ways to make a body."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace

import pytest
import torch
from reference.kinematics import rotation
from torch import Tensor

from torchcss.body.catalog import BODY_NAMES, LENGTH_RATE, LENGTHS, PLACES, specification
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.shape import with_shape
from torchcss.cost.term import differentiate_twice
from torchcss.errors import BodyError, ConfigurationError, ShapeError
from torchcss.initialise.multi_start import PAPER_PROPORTIONS


def random_states(body: BodyModel, *batch: int, generator: torch.Generator) -> Tensor:
    size = (*batch, body.num_parameters)
    return body.bounds.project(torch.randn(size, generator=generator, dtype=torch.float64))


@pytest.mark.parametrize("name", BODY_NAMES)
def test_layout(name: str) -> None:
    body = load_body(name)
    n = body.num_parameters
    assert n == int(name.removeprefix("body").removeprefix("arm"))
    assert len(set(body.state_names)) == n
    for buffer in (body.lower, body.upper, body.sticky_mean, body.sticky_deviation):
        assert buffer.shape == (n,)
    assert torch.equal(body.tie, torch.eye(n, dtype=torch.float64))
    assert not body.offset.any()
    assert ((body.lower <= body.rest) & (body.rest <= body.upper)).all()
    assert (body.lower < body.upper).all()
    assert (body.sticky_deviation > 0).all()
    assert (body.motion_rate > 0).all()
    inside = (body.lower <= body.sticky_mean) & (body.sticky_mean <= body.upper)
    assert inside[body.sticky_deviation.isfinite()].all()
    for index, joint in enumerate(body.joint_names):
        assert body.joint_index(joint) == index
    for index, parameter in enumerate(body.state_names):
        assert body.state_index(parameter) == index


def test_lengths_hardly_move() -> None:
    body = load_body("body34", free_proportions=(*LENGTHS, *PLACES))
    rates = dict(zip(body.state_names, body.motion_rate.tolist(), strict=True))
    lengths = {f"{name}_length" for name in (*LENGTHS, *PLACES)} & rates.keys()  # not the foot
    assert {rates[name] for name in lengths} == {LENGTH_RATE}
    assert min(rates[name] for name in rates.keys() - lengths) > 0.1


def test_unknown_names_are_refused() -> None:
    body = load_body("arm7")
    with pytest.raises(BodyError, match="no joint 'tail'"):
        body.joint_index("tail")
    with pytest.raises(BodyError, match="no parameter 'wag'"):
        body.state_index("wag")


def test_wrong_states_are_refused() -> None:
    body = load_body("arm7")
    with pytest.raises(ShapeError, match=r"expected a shape \[\.\.\., 7\], got \[8\]"):
        body.pose(torch.zeros(8, dtype=torch.float64))
    for dtype in (torch.float32, torch.long):
        with pytest.raises(ShapeError, match="convert one") as caught:
            body.pose(torch.zeros(7, dtype=dtype))
        assert "\n" not in str(caught.value)
    for other, message in (
        (torch.zeros(7, dtype=torch.long), "expected float32 or float64, got torch.int64"),
        (torch.zeros(7).numpy(), "expected a tensor, got ndarray"),
        (torch.zeros(6), r"expected a shape \[\.\.\., 7\], got \[6\]"),
    ):
        with pytest.raises(ShapeError, match=message):
            body.forward_kinematics(other)  # type: ignore[arg-type]


def test_ties_move_both_sides(generator: torch.Generator) -> None:
    body = load_body("body34", free_proportions=True)
    assert body.num_parameters == 34 + 9
    assert body.tree.num_joints == 34 + 9 + 6
    x = body.rest.clone()
    x[body.state_index("upper_arm_length")] += 0.02
    before, after = body.pose(body.rest).joints, body.pose(x).joints
    for side in ("l", "r"):
        index = [body.joint_index(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist")]
        moved = (after - before)[index].norm(dim=-1)
        torch.testing.assert_close(moved, torch.tensor([0.0, 0.02, 0.02], dtype=torch.float64))


def test_free_proportions_reach_what_lengths_set() -> None:
    """A prismatic parameter stands for the difference from the length built in."""
    lengths = {"forearm": 0.255, "thigh": 0.45, "shoulder_width": 0.16}
    built = load_body("body32", lengths=lengths)
    free = load_body("body32", free_proportions=True)
    x = torch.zeros(free.num_parameters, dtype=torch.float64)
    for name, length in lengths.items():
        x[free.state_index(f"{name}_length")] = length - free.lengths[name]
    torch.testing.assert_close(
        free.pose(x).joints, built.pose(torch.zeros(32, dtype=torch.float64)).joints
    )


def test_the_papers_eight_move_hips_clavicles_and_skull_tip() -> None:
    """x_i of section 2 [IJRR]; left and right mirror each other, limbs keep their lengths."""
    free, rest = load_body("body32", free_proportions=PAPER_PROPORTIONS), load_body("body32")
    assert free.num_parameters == 32 + 8
    x = free.rest.clone()
    moves = dict(zip(PAPER_PROPORTIONS, torch.linspace(-0.008, 0.008, 8).tolist(), strict=True))
    for name, metres in moves.items():
        x[free.state_index(f"{name}_length")] += metres
    moved = free.pose(x).joints
    shift = moved - rest.pose(rest.rest).joints
    expected = {
        "hip": [moves["hip_width"], moves["hip_height"], moves["hip_depth"]],
        "shoulder": [moves[f"clavicle_{axis}"] for axis in ("width", "height", "depth")],
        "skull_tip": [0.0, moves["head"], moves["skull_depth"]],
    }
    pairs = {"hip": ("hip", "knee", "ankle"), "shoulder": ("shoulder", "elbow", "wrist")}
    for name, by in expected.items():
        for joint in pairs.get(name, ()):
            for side, mirror in (("l", 1.0), ("r", -1.0)):
                own = shift[free.joint_index(f"{side}_{joint}")]
                torch.testing.assert_close(own, torch.tensor([mirror * by[0], *by[1:]]).to(own))
    own = shift[free.joint_index("skull_tip")]
    torch.testing.assert_close(own, torch.tensor(expected["skull_tip"]).to(own))
    # A body that is built so stands as the parameters say.
    lengths = {name: free.lengths.get(name, 0.0) + metres for name, metres in moves.items()}
    built = load_body("body32", lengths=lengths)
    face = ("skullbase", "nose", "l_eye", "r_eye", "l_ear", "r_ear")  # grow with the head
    others = [k for k, name in enumerate(built.joint_names) if name not in face]
    torch.testing.assert_close(built.pose(built.rest).joints[others], moved[others])
    again = load_body("body32", lengths=lengths, free_proportions=PAPER_PROPORTIONS)
    for name, length in PLACES.items():
        row = again.state_index(f"{name}_length")
        ends = lengths[name] + torch.stack([again.lower[row], again.upper[row]])
        torch.testing.assert_close(ends, 0.1 * LENGTHS[length] * torch.tensor([-1.0, 1.0]).to(ends))
    with pytest.raises(BodyError, match="unknown lengths"):
        load_body("body32", free_proportions=("tail",))
    with pytest.raises(BodyError, match="finite"):
        load_body("body32", lengths={"hip_depth": math.nan})


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_leading_shapes_and_types(
    batch: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator
) -> None:
    double = load_body("body30")
    body = load_body("body30", dtype=dtype)
    assert body.dtype == dtype
    x = random_states(double, *batch, generator=generator)
    pose = body.pose(x.to(dtype))
    assert pose.joints.shape == (*batch, len(body.joint_names), 3)
    surface = body.surface(pose)
    assert surface.points.shape == (*batch, body.num_parts * 8 * 12, 3)
    assert surface.points.dtype == surface.normals.dtype == pose.joints.dtype == dtype
    tolerance = 1e-12 if dtype == torch.float64 else 1e-5
    torch.testing.assert_close(pose.joints.double(), double.pose(x).joints, rtol=0, atol=tolerance)
    rotation, centre = body.part_poses(pose)
    assert rotation.shape == (*batch, body.num_parts, 3, 3)
    assert centre.shape == (*batch, body.num_parts, 3)


def test_surface_is_the_posed_mesh(generator: torch.Generator) -> None:
    body = BodyModel(specification("arm8"))
    pose = body.pose(random_states(body, generator=generator))
    surface, mesh = body.surface(pose), body.mesh()
    assert mesh.points.shape == (4, 8, 12, 3)
    link_turn, link_origin = pose.tree.rotation, pose.tree.translation
    for part in range(4):
        link = int(body.part_link[part])
        local = mesh.points[part] @ body.part_rotation[part].T + body.part_translation[part]
        world = local @ link_turn[link].T + link_origin[link]
        got = surface.points.unflatten(0, (4, 96))[part]
        torch.testing.assert_close(got, world.reshape(96, 3))
        normal = mesh.normals[part] @ body.part_rotation[part].T @ link_turn[link].T
        got = surface.normals.unflatten(0, (4, 96))[part]
        torch.testing.assert_close(got, normal.reshape(96, 3))
    torch.testing.assert_close(surface.normals.norm(dim=-1), torch.ones(384, dtype=torch.float64))
    assert body.mesh(3).points.shape == (4, 3, 12, 3)
    assert body.mesh(3, 5).points.shape == (4, 3, 5, 3)


def test_a_mesh_is_that_of_the_present_shape() -> None:
    body = load_body("arm8")
    before = body.mesh(6, 10)
    assert body.mesh(6, 10) is before
    thick = with_shape(body, 2 * body.part_shape)
    assert float(thick.mesh(6, 10).points.abs().max()) > 1.5 * float(before.points.abs().max())
    torch.testing.assert_close(body.mesh(6, 10).points, before.points)
    assert body.to(torch.float32).mesh(6, 10).points.dtype == torch.float32


def test_a_mesh_of_inference_mode_is_not_kept() -> None:
    body = load_body("arm8")
    with torch.inference_mode():
        body.mesh()
    x = body.rest.clone().requires_grad_()
    (slope,) = torch.autograd.grad(body.surface(body.pose(x)).points.sum(), x)
    assert bool(slope.any())


def test_a_surface_is_compiled_in_one_graph() -> None:
    body = load_body("arm8")
    x = body.rest[None]
    points = torch.compile(
        lambda x: body.surface(body.pose(x)).points, backend="eager", fullgraph=True
    )
    assert torch.equal(points(x), body.surface(body.pose(x)).points)


def test_another_base_moves_the_whole_body(generator: torch.Generator) -> None:
    body = load_body("body34")
    x = random_states(body, 2, generator=generator)
    turn = rotation(0.8, 0.3, 0.4)
    shift = torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)
    other = body.with_base(turn, shift)
    torch.testing.assert_close(other.pose(x).joints, body.pose(x).joints @ turn.T + shift)
    assert torch.equal(body.base_rotation, torch.eye(3, dtype=torch.float64))
    for bad in (2 * turn, -turn, turn * torch.nan):
        with pytest.raises(ConfigurationError, match="rotation: expected a rotation"):
            body.with_base(bad, shift)
    with pytest.raises(ShapeError, match="rotation: expected float32 or float64"):
        body.with_base(torch.eye(3, dtype=torch.int64), shift)
    with pytest.raises(ShapeError, match="translation: expected a tensor, got list"):
        body.with_base(turn, [0.0, 0.0, 0.0])  # type: ignore[arg-type]


def test_a_pose_can_be_differentiated_in_the_base() -> None:
    body, place = load_body("arm8"), torch.zeros(3, dtype=torch.float64, requires_grad=True)
    joints = body.with_base(torch.eye(3), place).pose(body.rest).joints
    (slope,) = torch.autograd.grad(joints.sum(), place)
    assert slope.tolist() == [len(joints)] * 3


def test_converting_a_rebased_body_leaves_the_first_alone() -> None:
    body = load_body("arm7")
    other = body.with_base(body.base_rotation, body.base_translation).to(torch.float32)
    assert other.dtype == other.tree.lower.dtype == torch.float32
    assert body.dtype == body.tree.lower.dtype == torch.float64
    body.pose(body.rest)
    other.pose(other.rest)


def test_bodies_can_be_copied_and_pickled(generator: torch.Generator) -> None:
    body = load_body("arm8")
    x = random_states(body, generator=generator)
    expected = body.pose(x).joints
    for other in (copy.deepcopy(body), pickle.loads(pickle.dumps(body))):
        assert torch.equal(other.pose(x).joints, expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name_or_path": "body33"}, "no body 'body33'"),
        ({"name_or_path": "body30", "lengths": {"tail": 1.0}}, r"unknown lengths \['tail'\]"),
        ({"name_or_path": "body30", "lengths": {"head": 0.0}}, "must be positive"),
        ({"name_or_path": "body30", "scale": -1.0}, "must be positive"),
        ({"name_or_path": "body30", "scale": float("nan")}, "must be positive"),
        ({"name_or_path": "body30", "scale": float("inf")}, "must be positive"),
    ],
)
def test_bad_requests_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(BodyError, match=message):
        load_body(**arguments)


def test_parts_have_names_of_their_own() -> None:
    """Neighbours go by name."""
    body = specification("arm7")
    twice = replace(body, parts=(*body.parts, body.parts[0]))
    with pytest.raises(BodyError, match=f"part names.*unique; repeated: {body.parts[0].name}$"):
        BodyModel(twice)


def test_differentiate_twice_of_functions_that_do_not_bend() -> None:
    x = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    linear = differentiate_twice((2 * x).sum(-1), x)
    torch.testing.assert_close(linear.gradient, torch.full((4, 3), 2.0, dtype=torch.float64))
    assert not linear.hessian.any()
    partly = differentiate_twice(x[:, 0].square() + x[:, 1], x)
    expected = torch.zeros(3, 3, dtype=torch.float64)
    expected[0, 0] = 2.0
    torch.testing.assert_close(partly.hessian, expected.expand(4, 3, 3))
