"""The learnt prior on poses."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from made_costs import changed, make_full_cost, random_states

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.cost.fused.engine import FusedEngine
from torchcss.cost.pose_prior import (
    GROUPS,
    BodyDensity,
    PosePrior,
    body_density,
    direction_slopes,
    directions_of,
    learnt_mixtures,
    limb_directions,
    mirrored,
)
from torchcss.initialise.options import InitialiseOptions
from torchcss.vision.camera import Camera, Upright


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body("body34")


@pytest.fixture(scope="module")
def density(body: BodyModel) -> BodyDensity:
    found = body_density(body)
    assert found is not None
    return found


def cross_matrix(axis: torch.Tensor) -> torch.Tensor:
    """What multiplies a vector by an axis from the left."""
    return torch.linalg.cross(axis.expand(3, 3), torch.eye(3).to(axis), dim=-1).mT


def awkward(body: BodyModel, generator: torch.Generator) -> torch.Tensor:
    """Anywhere, at rest, all angles zero, and at both bounds."""
    some = random_states(body, 4, generator=generator)
    far = body.bounds.project(9.0 * torch.ones_like(some[:1]))
    return torch.cat([some, body.rest[None], 0 * some[:1], far, body.bounds.project(-far)])


UPS = [None, Upright((0.0, -1.0, 0.0), 0.2), Upright((0.0, 0.0, 1.0), 0.0)]
"""Not known, a camera that is about level, and a world."""


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("name", ["body30", "body32", "body34"])
def test_derivatives(name: str, up: Upright | None, generator: torch.Generator) -> None:
    body = load_body(name)
    density = body_density(body, up)
    assert density is not None
    assert len(density.which.groups[1].known) == (4 if up is None else 5)
    x = awkward(body, generator).requires_grad_()
    cost = density.cost(body.pose(x).joints)
    (gradient,) = torch.autograd.grad(cost.sum(), x)
    model = density.local_model(body, body.pose(x.detach()))
    torch.testing.assert_close(model.value, cost.detach())
    torch.testing.assert_close(model.gradient, gradient, rtol=1e-9, atol=1e-9)
    assert float(torch.linalg.eigvalsh(model.hessian).amin()) > -1e-9

    slopes = direction_slopes(body, body.pose(x.detach()), density.which)
    for number, (group, slope) in enumerate(zip(density.which.groups, slopes, strict=True)):

        def directions(state: torch.Tensor, group: str = group.name) -> torch.Tensor:
            return limb_directions(body.pose(state).joints, density.which)[group]

        assert number == density.which.groups.index(group)
        for k, state in enumerate(x.detach()):
            expected = torch.func.jacrev(directions)(state)
            torch.testing.assert_close(slope[k], expected, rtol=1e-9, atol=1e-9)


def test_the_hessian_bounds_the_cost_from_above(
    density: BodyDensity, generator: torch.Generator
) -> None:
    """What expectation maximisation is built on, anywhere in the space of directions."""
    for group in density.densities.values():
        size = group.mean.shape[-1]
        u, other = torch.randn(2, 500, size, generator=generator, dtype=torch.float64)
        model, step = group.local_model(u), 2 * other
        bound = model.value + (model.gradient * step).sum(-1)
        bound = bound + 0.5 * (step[:, None] @ model.hessian @ step[..., None])[:, 0, 0]
        assert bool((group.cost(u + step) <= bound + 1e-9).all())


def test_it_is_a_density_on_the_spheres(generator: torch.Generator) -> None:
    mixture = learnt_mixtures()["l_arm"]
    for known in ((0,), (0, 1)):
        of_arm = mixture.density("l_arm", known)
        u = torch.randn(200_000, len(known), 3, generator=generator, dtype=torch.float64)
        u = torch.nn.functional.normalize(u, dim=-1).flatten(-2)
        mean = (-of_arm.cost(u)).exp().mean()
        assert float(mean) * (4 * math.pi) ** len(known) == pytest.approx(1.0, abs=0.15)


def test_tilts_of_a_body_count_where_up_is_known(
    body: BodyModel, generator: torch.Generator
) -> None:
    joints = body.pose(random_states(body, 6, generator=generator)).joints
    standing = body.pose(body.rest).joints
    hips, shoulders = (
        standing[[body.joint_index(f"{side}_{part}") for side in "lr"]].mean(0)
        for part in ("hip", "shoulder")
    )
    up = torch.nn.functional.normalize(shoulders - hips, dim=-1)
    (x, y, z), across = up.tolist(), torch.linalg.cross(up, up.roll(1), dim=-1)

    def costs(deviation: float, about: torch.Tensor, angle: float) -> torch.Tensor:
        density = body_density(body, Upright((x, y, z), deviation))
        assert density is not None
        turn = torch.linalg.matrix_exp(angle * cross_matrix(about / about.norm()))
        return density.cost(torch.cat([joints, standing[None]]) @ turn.mT)

    torch.testing.assert_close(costs(0.0, up, 1.0), costs(0.0, up, 0.0))
    sure, unsure = (costs(s, across, 0.8)[-1] - costs(s, up, 0.0)[-1] for s in (0.0, 0.4))
    assert sure > unsure > 1


def test_only_the_directions_of_limbs_matter(
    body: BodyModel, density: BodyDensity, generator: torch.Generator
) -> None:
    x = random_states(body, 6, generator=generator)
    cost = density.cost(body.pose(x).joints)
    moved = x.clone()
    moved[:, :6] += torch.randn(6, 6, generator=generator, dtype=torch.float64)
    moved[:, body.state_index("neck_flexion")] += 0.1
    moved[:, body.state_index("l_ankle_flexion")] -= 0.1
    torch.testing.assert_close(density.cost(body.pose(moved).joints), cost)
    torch.testing.assert_close(density.cost(1.7 * body.pose(x).joints), cost)


def test_a_mirror_image_is_equally_dense(body: BodyModel, generator: torch.Generator) -> None:
    density = body_density(body, UPS[2])
    assert density is not None
    joints = body.pose(random_states(body, 6, generator=generator)).joints
    names = ["r" + n[1:] if n[:2] == "l_" else "l" + n[1:] if n[:2] == "r_" else n
             for n in body.joint_names]  # fmt: skip
    swapped = joints[:, [body.joint_names.index(name) for name in names]]
    image = swapped * joints.new_tensor([-1.0, 1.0, 1.0])
    torch.testing.assert_close(density.cost(image), density.cost(joints))
    directions, other = (limb_directions(each, density.which) for each in (joints, image))
    for group in ("trunk", "legs"):
        torch.testing.assert_close(other[group], mirrored(directions[group], group))
    torch.testing.assert_close(other["l_arm"], directions["r_arm"])


def test_knees_bend_backwards(body: BodyModel, density: BodyDensity) -> None:
    x = body.rest.expand(3, -1).clone()
    for row, angle in enumerate((0.0, 0.8, -0.8)):
        for knee in ("l_knee_flexion", "r_knee_flexion"):
            x[row, body.state_index(knee)] = angle
    straight, bent, wrong = density.cost(body.pose(x).joints).tolist()
    assert wrong > max(straight, bent) + 3


def test_what_a_body_lacks_is_left_out(body: BodyModel) -> None:
    like = torch.zeros((), dtype=torch.float64)
    above = tuple(n for n in body.joint_names if "knee" not in n and "ankle" not in n)
    which = directions_of(above, like)
    assert which is not None
    assert [group.name for group in which.groups] == ["trunk", "l_arm", "r_arm"]
    short = directions_of(tuple(n for n in body.joint_names if "wrist" not in n), like)
    assert short is not None
    assert {g.name: len(g.known) for g in short.groups} == dict(trunk=2, legs=4, l_arm=1, r_arm=1)
    assert directions_of(load_body("arm8").joint_names, like) is None
    assert body_density(load_body("arm8")) is None


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", ["body34", "arm8"])
def test_as_a_term_of_both_engines(name: str, turned: bool, generator: torch.Generator) -> None:
    cost = make_full_cost(name, own_parents=5)
    if turned:
        turn = torch.linalg.matrix_exp(cross_matrix(cost.body.tie.new_tensor([1.7, 0.3, -0.4])))
        size = cost.camera.image_size_wh
        cost = changed(cost, camera=Camera(cost.camera.K, size, R_camera_world=turn))
        assert cost.camera.up is not None
    cost = replace(cost, choice=cost.choice.having(PosePrior()).only(["pose_prior", "stabiliser"]))
    x = random_states(cost.body, 5, generator=generator)
    assert ("pose_prior" in cost.terms(x)) == (name == "body34")
    fused = replace(cost, engine=FusedEngine())
    assert fused.engine is not None
    for got, expected in zip(fused.local_model(x), cost.local_model(x), strict=True):
        torch.testing.assert_close(got, expected, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(fused.value(x), cost.value(x), rtol=1e-10, atol=1e-10)


def test_the_first_pose_has_it_too() -> None:
    names = {t.name for t in InitialiseOptions(sigma=1.0).joint_choice.terms}
    without = InitialiseOptions(sigma=1.0, pose_prior=False).joint_choice
    assert names - {term.name for term in without.terms} == {"pose_prior"}


def test_every_group_was_learnt() -> None:
    learnt = learnt_mixtures()
    assert list(learnt) == list(GROUPS)
    for mixture in learnt.values():
        assert float(mixture.weight.sum()) == pytest.approx(1.0)
        assert float(torch.linalg.eigvalsh(mixture.covariance).amin()) > 0
