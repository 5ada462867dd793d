"""The repulsion between parts: derivatives against autograd, deep, far, and a fist in the torso."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from reference import interpenetration as reference
from reference import kinematics
from reference.autograd import differentiated
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.surface import implicit, surface_points
from torchcss.cost.interpenetration import END, Interpenetration, InterpenetrationPairs, NearNodes
from torchcss.cost.joints import JointTerm, match_joints
from torchcss.cost.term import differentiate_twice
from torchcss.errors import ConfigurationError
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.types import Curvature, Keypoints, LocalModel
from torchcss.vision.camera import Camera

TERM = Interpenetration()


def moved(body: BodyModel) -> BodyModel:
    turn = kinematics.rotation(0.4, -0.9, 0.3)
    return body.with_base(turn, torch.tensor([0.3, -1.1, 4.0]).double())


def random_states(body: BodyModel, *batch: int, generator: torch.Generator) -> Tensor:
    noise = torch.randn(*batch, body.num_parameters, generator=generator, dtype=torch.float64)
    return body.bounds.project(body.sticky_mean + 0.5 * noise)


def with_angles(body: BodyModel, **degrees: float) -> Tensor:
    x = body.sticky_mean.clone()
    for name, angle in degrees.items():
        x[..., body.state_index(name)] = math.radians(angle)
    return x


def fist_in_torso(body: BodyModel) -> Tensor:
    """The whole right hand inside the chest."""
    return with_angles(
        body, r_shoulder_swing=-38.9, r_shoulder_raising=16.3, r_shoulder_twist=-81.8,
        r_elbow_flexion=138.1,
    )  # fmt: skip


def assert_relative(got: Tensor, expected: Tensor, tolerance: float = 1e-10) -> None:
    scale = max(float(expected.abs().max()), 1e-30)
    torch.testing.assert_close(got, expected, rtol=0.0, atol=tolerance * scale)


def by_autograd(term: Interpenetration, body: BodyModel, x: Tensor) -> LocalModel:
    models = []
    for item in x:
        leaf = item.clone().requires_grad_()
        value = reference.interpenetration(
            body, leaf, weight=term.weight, p=term.p, sharpness=term.sharpness, end=END
        )
        models.append(differentiate_twice(value, leaf))
    return LocalModel(*(torch.stack(parts) for parts in zip(*models, strict=True)))


@pytest.mark.parametrize(
    ("name", "free", "term"),
    [
        ("body34", False, TERM),
        ("body34", True, Interpenetration(p=2.0, sharpness=1.5, weight=3.0)),
        ("body30", True, TERM),
        ("arm8", False, Interpenetration(p=3.0, sharpness=1.0)),
        ("arm8", True, TERM),
    ],
)
def test_derivatives_are_those_of_autograd(
    name: str, free: bool, term: Interpenetration, generator: torch.Generator
) -> None:
    body = moved(load_body(name, free_proportions=free))
    x = random_states(body, 1, generator=generator)
    if name == "arm8":  # folded as far as it goes
        x = body.bounds.upper - 0.1 * x.abs()
    if name == "body34":  # not exactly: autograd has no second derivative of |y| where y = 0
        x[0] = fist_in_torso(body) + 0.02 * x[0]
    expected = by_autograd(term, body, x)
    got = term.local_model(body, body.pose(x), InterpenetrationPairs(body))
    assert bool((expected.value > 0).any())
    for ours, theirs in zip(got, expected, strict=True):
        assert_relative(ours, theirs)
    assert_relative(got.hessian, got.hessian.mT, 1e-14)
    torch.testing.assert_close(term.value(body, body.pose(x), InterpenetrationPairs(body)), got[0])


def test_gauss_newton_leaves_the_second_order_kinematics_out() -> None:
    """Its Hessian is that of the nodes moving along straight lines in B's frame."""
    body = load_body("arm8")
    pairs = InterpenetrationPairs(body)
    x = body.bounds.upper.clone()  # the elbow is bent as far as it goes
    pose = body.pose(x)
    near = pairs.near(body, pose, TERM.reach)
    square = pairs.radial_square(near)[0]
    assert bool((square < TERM.reach**2).any())

    leaf = x.clone().requires_grad_()
    frames = reference.part_frames(body, leaf)
    expected = torch.zeros(body.num_parameters, body.num_parameters, dtype=torch.float64)
    for owner in range(len(near.item)):
        a, b = int(pairs.first[near.pair[owner]]), int(pairs.second[near.pair[owner]])
        local = (pairs.nodes[a] @ frames[a][0].T + frames[a][1] - frames[b][1]) @ frames[b][0]
        for row in (near.owner == owner).nonzero()[:, 0].tolist():
            node = int((local.detach() - near.points[row]).square().sum(-1).argmin())
            rows = [
                torch.autograd.grad(local[node, i], leaf, retain_graph=True)[0] for i in (0, 1, 2)
            ]
            jacobian = torch.stack(rows)
            y = near.points[row].clone().requires_grad_()
            value = reference.potential(
                reference.radial_square(body.part_shape[b], y), TERM.p, TERM.sharpness, END
            )
            node_hessian = differentiate_twice(TERM.weight / 26 * value, y).hessian
            expected += jacobian.T @ node_hessian @ jacobian
    got = TERM.local_model(body, pose, pairs, curvature=Curvature.GAUSS_NEWTON)
    exact = TERM.local_model(body, pose, pairs)
    assert_relative(got.hessian, expected)
    assert_relative(got.gradient, exact.gradient, 1e-14)
    assert float((got.hessian - exact.hessian).abs().max()) > 1e-3


def nodes_at(pairs: InterpenetrationPairs, pair: int, points: Tensor) -> NearNodes:
    """Points in the frame of a pair's part B."""
    one = torch.zeros(1, dtype=torch.long)
    owner = torch.zeros(len(points), dtype=torch.long)
    return NearNodes(one, one + pair, torch.eye(3)[None].to(points), points[:1] * 0, owner, points)


@pytest.mark.parametrize("exponents", [(0.7, 1.0), (0.8, 0.8), (0.3, 0.6), (1.0, 1.0), (0.9, 0.2)])
@pytest.mark.parametrize("tapers", [(0.0, 0.0), (-0.33, -0.25), (0.9, -0.4)])
def test_the_implicit_function_and_its_derivatives(
    exponents: tuple[float, float], tapers: tuple[float, float], generator: torch.Generator
) -> None:
    body = load_body("body34")
    body.part_shape[0, 3:7] = torch.tensor([*exponents, *tapers])
    pairs = InterpenetrationPairs(body)
    shape, pair = body.part_shape[0], int((pairs.second == 0).nonzero()[0, 0])
    points = torch.randn(60, 3, generator=generator, dtype=torch.float64) * shape[:3]
    points = torch.cat([points, 2.5 * points])
    points[:20, 0] *= 1e-3
    points[20:40, 2] *= 1e-3
    leaf = points.clone().requires_grad_()
    plain = reference.radial_square(shape, leaf)
    value, gradient, hessian = pairs.radial_square(nodes_at(pairs, pair, points))
    expected = differentiated(plain, leaf)
    assert_relative(value, expected.value, 1e-12)
    assert_relative(gradient, expected.gradient, 1e-11)
    assert_relative(hessian, expected.hessian)

    inside = implicit(shape, points)
    assert bool(((value < 1) == (inside < 0)).all())
    eta, omega = torch.rand(2, 50, generator=generator, dtype=torch.float64) * 3 - 1.5
    surface = surface_points(shape.expand(50, 9), eta, 2 * omega).points
    on_it = pairs.radial_square(nodes_at(pairs, pair, surface))[0]
    torch.testing.assert_close(on_it, torch.ones_like(on_it), rtol=0, atol=1e-10)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_centre_axes_and_far_points_are_finite(dtype: torch.dtype) -> None:
    body = load_body("body34", dtype=dtype)
    pairs = InterpenetrationPairs(body)
    size = torch.tensor([0.0, 1e-30, 1e-12, 1e-3, 0.1, 1.0, 1e3, 1e8], dtype=dtype)
    grid = torch.cartesian_prod(size, size, size)
    for pair in range(0, pairs.num_pairs, 25):
        near = nodes_at(pairs, pair, torch.cat([grid, -grid]))
        for part in pairs.radial_square(near):
            assert bool(part.isfinite().all())


def test_pairs_that_touch_or_cannot_turn_are_left_out() -> None:
    for name, free in (("body30", False), ("body34", False), ("body34", True)):
        body = load_body(name, free_proportions=free)
        pairs = InterpenetrationPairs(body)
        found = {
            (body.part_names[a], body.part_names[b])
            for a, b in zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)
        }
        assert all((b, a) in found for a, b in found)
        assert not any(pair in found for pair in body.neighbours)
        assert ("neck", "head") not in found
        assert ("r_hand", "chest") in found
        assert ("r_shank", "l_shank") in found
        # Without clavicle joints the two are of one piece with the chest.
        assert (("l_clavicle", "r_clavicle") in found) == (name == "body34")


def test_parts_on_slides_are_kept_apart(tmp_path: Path) -> None:
    """Two carriages on one rail meet, although nothing turns between them."""
    rows = ['<robot name="rails"><link name="rail"/>']
    for name, place in (("left", -0.3), ("right", 0.3)):
        rows.append(
            f'<link name="{name}"><visual><geometry><sphere radius="0.1"/></geometry></visual>'
            f'</link><joint name="{name}_slide" type="prismatic"><parent link="rail"/>'
            f'<child link="{name}"/><origin xyz="{place} 0 0"/><axis xyz="1 0 0"/>'
            '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        )
    path = tmp_path / "rails.urdf"
    path.write_text("".join([*rows, "</robot>"]))
    body = load_body(path)
    pairs, x = InterpenetrationPairs(body), torch.tensor([[0.0, 0.0], [0.25, -0.25]]).double()
    names = {body.part_names[part] for part in pairs.first.tolist()}
    assert len(names) == pairs.num_pairs == 2
    model = TERM.local_model(body, body.pose(x), pairs)
    assert float(model.value[0]) == 0.0
    assert float(model.value[1]) > 1.0
    assert float(model.gradient[1, 1]) < 0.0 < float(model.gradient[1, 0])
    assert_relative(model.hessian, by_autograd(TERM, body, x).hessian)


def test_the_chain_runs_from_b_to_a() -> None:
    body = load_body("body34")
    pairs = InterpenetrationPairs(body)
    hand, foot = body.part_names.index("r_hand"), body.part_names.index("l_foot")
    row = int(((pairs.first == hand) & (pairs.second == foot)).nonzero()[0, 0])
    names = [body.tree.joint_names[j] for j in pairs.chain[row].tolist()]
    signs = pairs.sign[row].tolist()
    leg = ["l_ankle_flexion", "l_knee_flexion", "l_hip_twist", "l_hip_abduction", "l_hip_flexion"]
    assert names[:5] == leg
    assert signs[:5] == [-1.0] * 5
    assert names[5:8] == ["lumbar_flexion", "lumbar_bending", "lumbar_twist"]
    assert names[13] == "r_elbow_flexion"
    assert signs[5:14] == [1.0] * 9


def test_standing_costs_little_and_overlap_is_bounded() -> None:
    body = load_body("body34")
    pairs = InterpenetrationPairs(body)
    relaxed = float(TERM.value(body, body.pose(body.sticky_mean), pairs))
    inside = float(TERM.value(body, body.pose(fist_in_torso(body)), pairs))
    assert 0 < relaxed < 1.0
    assert inside > 30.0
    # However parts lie in each other, the cost of one pair is bounded.
    body.part_translation.zero_()
    value = TERM.value(body, body.pose(0 * body.rest), pairs)
    assert float(value) < TERM.weight * pairs.num_pairs * math.exp(TERM.sharpness)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("term", [TERM, Interpenetration(p=2.5, sharpness=3.0)])
def test_parts_centred_on_each_other(dtype: torch.dtype, term: Interpenetration) -> None:
    """The nodes of shrunken hands at the centre of the other parts, where nothing pushes."""
    body = load_body("body34", dtype=dtype)
    pairs = InterpenetrationPairs(body)
    pairs.nodes.mul_(1e-7)
    for pair in range(0, pairs.num_pairs, 11):
        pose = body.pose(body.rest[None])
        rotation, centre = body.part_poses(pose)
        a, b = int(pairs.first[pair]), int(pairs.second[pair])
        link = body.part_link[a]
        shift = pose.tree.translation.clone()
        shift[:, link] += centre[:, b] - centre[:, a]
        model = term.local_model(
            body, pose._replace(tree=pose.tree._replace(translation=shift)), pairs
        )
        assert all(bool(part.isfinite().all()) for part in model)
        assert float(model.value) > 0.9 * term.weight * math.exp(term.sharpness**term.p)
        assert rotation.dtype == dtype


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_wild_states_stay_finite(dtype: torch.dtype, generator: torch.Generator) -> None:
    body = load_body("body34", dtype=dtype, free_proportions=True)
    pairs = InterpenetrationPairs(body)
    noise = torch.randn(40, body.num_parameters, generator=generator, dtype=torch.float64)
    scale = torch.logspace(-2, 4, 40, dtype=torch.float64)[:, None]
    model = TERM.local_model(body, body.pose((scale * noise).to(dtype)), pairs)
    for part in model:
        assert part.dtype == dtype
        assert bool(part.isfinite().all())


def test_single_precision(generator: torch.Generator) -> None:
    body = moved(load_body("body34"))
    x = random_states(body, 20, generator=generator)
    expected = TERM.local_model(body, body.pose(x), InterpenetrationPairs(body))
    body = body.float()
    got = TERM.local_model(body, body.pose(x.float()), InterpenetrationPairs(body))
    for ours, theirs in zip(got, expected, strict=True):
        assert_relative(ours.double(), theirs, 1e-4)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3), (0,)])
@pytest.mark.parametrize("free", [False, True])
def test_leading_shapes_and_items_that_do_not_meet(
    batch: tuple[int, ...], free: bool, generator: torch.Generator
) -> None:
    body = load_body("body34", free_proportions=free)
    pairs = InterpenetrationPairs(body)
    x = random_states(body, *batch, generator=generator)
    got = TERM.local_model(body, body.pose(x), pairs)
    n = body.num_parameters
    assert got.value.shape == batch
    assert got.gradient.shape == (*batch, n)
    assert got.hessian.shape == (*batch, n, n)
    torch.testing.assert_close(TERM.value(body, body.pose(x), pairs), got.value)
    if not x.numel():
        return
    flat = x.reshape(-1, n)
    alone = [TERM.local_model(body, body.pose(item), pairs) for item in flat]
    for ours, parts in zip(got, zip(*alone, strict=True), strict=True):
        expected = torch.stack(parts).reshape(ours.shape)
        torch.testing.assert_close(ours, expected, rtol=1e-9, atol=1e-9)


def test_only_the_relative_pose_matters(generator: torch.Generator) -> None:
    body = load_body("body34")
    pairs = InterpenetrationPairs(body)
    x = random_states(body, 6, generator=generator)
    here, there = (TERM.local_model(b, b.pose(x), pairs) for b in (body, moved(body)))
    for ours, theirs in zip(here, there, strict=True):
        assert_relative(ours, theirs, 1e-12)
    root = [index for index, name in enumerate(body.state_names) if name.startswith("root")]
    assert not here.gradient[:, root].any()
    assert not here.hessian[:, root].any()


def test_nothing_jumps_where_a_potential_ends() -> None:
    """Along a swing of the arm, the change of the cost is that of its gradient, to second order."""
    body = load_body("body34")
    pairs = InterpenetrationPairs(body)
    start, stop = with_angles(body, r_shoulder_swing=60.0), fist_in_torso(body)
    t = torch.linspace(0, 1, 1001, dtype=torch.float64)[:, None]
    x = start + t * (stop - start)
    model = TERM.local_model(body, body.pose(x), pairs)
    along = (model.gradient * (stop - start)).sum(-1) / 1000
    error = (model.value.diff() - 0.5 * (along[1:] + along[:-1])).abs()
    assert float(error.max()) < 1e-3
    assert float(model.value[0]) < 0.5
    assert float(model.value[-1]) > 30


def test_bodies_without_flesh_or_pairs(tmp_path: Path) -> None:
    urdf = '<robot name="a"><link name="b"/><link name="c"/><joint name="j" type="continuous">'
    urdf += '<parent link="b"/><child link="c"/><axis xyz="0 0 1"/></joint></robot>'
    (tmp_path / "a.urdf").write_text(urdf)
    body = load_body(tmp_path / "a.urdf")
    x = torch.zeros(3, 1, dtype=torch.float64)
    for part in TERM.local_model(body, body.pose(x), InterpenetrationPairs(body)):
        assert not part.any()


@dataclass(frozen=True, kw_only=True)
class FistCost:
    """Evidence that wants the fist inside the torso, with or without the prior."""

    body: BodyModel
    evidence: str
    term: Interpenetration | None

    def take(self, items: Tensor) -> FistCost:
        return self

    def value(self, x: Tensor) -> Tensor:
        return self.local_model(x).value

    def local_model(self, x: Tensor) -> LocalModel:
        body, target, pose = self.body, fist_in_torso(self.body), self.body.pose(x)
        weight, n = 0.2**-2 if self.evidence == "pose" else 1.0, x.shape[-1]
        pull = weight * (x - target)
        bowl = weight * torch.eye(n, dtype=x.dtype).expand(*x.shape, n)
        model = LocalModel(0.5 * (pull * (x - target)).sum(-1), pull, bowl)
        if self.evidence == "image":
            camera = Camera(
                [[900.0, 0.0, 320.0], [0.0, 900.0, 240.0], [0.0, 0.0, 1.0]], (640, 480),
                R_camera_world=torch.diag(torch.tensor([1.0, -1.0, -1.0])).double(),
                t_camera_world=[0.0, 0.0, 3.5],
            )  # fmt: skip
            seen = camera.project(body.pose(target).joints).uv
            names = body.joint_names
            targets = match_joints(Keypoints(seen, torch.ones(len(names)).to(x), names), names)
            cost = JointTerm(sigma=5.0).point_cost(pose.joints, camera, targets)
            image = body.lift(pose, pose.joints, body.marker_link, cost)
            model = LocalModel(*(a + b for a, b in zip(model, image, strict=True)))
        if self.term is None:
            return model
        prior = self.term.local_model(body, pose, InterpenetrationPairs(body))
        return LocalModel(*(a + b for a, b in zip(model, prior, strict=True)))


def deepest_hand_node(body: BodyModel, x: Tensor) -> tuple[float, int]:
    """Least inside-outside value of the hand's nodes in the chest, and how many are inside."""
    rotation, centre = body.part_poses(body.pose(x))
    hand, chest = body.part_names.index("r_hand"), body.part_names.index("chest")
    nodes = body.mesh(10, 12).points[hand].flatten(0, 1)
    world = nodes @ rotation[hand].T + centre[hand]
    f = implicit(body.part_shape[chest], (world - centre[chest]) @ rotation[chest])
    return float(f.min()), int((f < 0).sum())


@pytest.mark.parametrize("evidence", ["pose", "image"])
def test_a_fist_driven_into_the_torso(evidence: str) -> None:
    body = load_body("body34")
    start = fist_in_torso(body)[None]
    cost = FistCost(body=body, evidence=evidence, term=None)
    without = TrustRegionNewton().minimise(cost, start, body.bounds).mean[0]
    cost = replace(cost, term=TERM)
    modes = TrustRegionNewton().minimise(cost, start, body.bounds)
    depth, inside = deepest_hand_node(body, without)
    assert inside > 60
    assert depth < -0.9
    depth, inside = deepest_hand_node(body, modes.mean[0])
    assert inside == 0
    assert depth > 0


@pytest.mark.parametrize(
    "bad", [{"p": 1.5}, {"p": 0.5}, {"p": math.nan}, {"weight": 0.0}, {"sharpness": -1.0},
            {"sharpness": 30.0}, {"p": 4.0}, {"weight": math.inf}],
)  # fmt: skip
def test_choices_that_make_no_sense(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError):
        Interpenetration(**bad)
