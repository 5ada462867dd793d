"""Points against known places: derivatives against autograd, and what the pose of a link costs."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.cost.fused.targets import FusedTargets
from torchcss.cost.targets import ARM, PointTargets, pose_targets
from torchcss.cost.term import differentiate_twice
from torchcss.errors import BodyError, ConfigurationError, ShapeError
from torchcss.kernels import compiler
from torchcss.solve.inverse_kinematics import link_pose


def cost_of(name: str, link: str, *, place_only: bool = False, **options) -> PointTargets:
    body = load_body(name)
    x = body.bounds.project(torch.full_like(body.rest, 0.3))
    pose = link_pose(body, link, x)
    return pose_targets(body, link, pose[:3, 3] if place_only else pose, **options)


def states(cost: PointTargets, generator: torch.Generator) -> dict[str, Tensor]:
    body = cost.body
    columns = slice(None) if cost.columns is None else cost.columns
    low = body.lower.clamp(min=-3)[columns]
    high = body.upper.clamp(max=3)[columns]
    share = torch.rand(6, len(low), generator=generator, dtype=low.dtype)
    return {
        "anywhere": low + share * (high - low),
        "at bounds": torch.stack([low, high]),
        "at zero": torch.zeros(1, len(low), dtype=low.dtype),
        "on target": body.bounds.project(torch.full_like(body.rest, 0.3))[None, columns],
    }


@pytest.mark.parametrize("place_only", [False, True])
@pytest.mark.parametrize(
    ("name", "link"), [("arm8", "r_wrist_link"), ("body34", "l_elbow_flexion_link")]
)
def test_derivatives_are_those_of_the_value(
    name: str, link: str, place_only: bool, generator: torch.Generator
) -> None:
    cost = cost_of(name, link, place_only=place_only)
    for where, x in states(cost, generator).items():
        found = cost.local_model(x)
        leaf = x.clone().requires_grad_()
        want = differentiate_twice(cost.value(leaf), leaf)
        size = float(want.hessian.abs().max())
        for got, reference in zip(found, want, strict=True):
            torch.testing.assert_close(
                got, reference, rtol=1e-10, atol=1e-11 * size, msg=f"{where}"
            )


def test_errors_and_their_jacobian(generator: torch.Generator) -> None:
    cost = cost_of("arm8", "r_wrist_link", columns=torch.tensor([1, 2, 4, 6]))
    x = states(cost, generator)["anywhere"]
    error, jacobian = cost.errors(x)
    value = (0.5 / cost.sigma**2 * error.square().sum(-1)).sum(-1)
    torch.testing.assert_close(value, cost.value(x))
    for item, state in enumerate(x):
        want = torch.autograd.functional.jacobian(lambda s: cost.errors(s[None])[0][0], state)
        torch.testing.assert_close(jacobian[item], want, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_any_batch_shape(shape: tuple[int, ...], generator: torch.Generator) -> None:
    cost = cost_of("arm7", "r_wrist_link")
    x = 0.3 * torch.randn(*shape, 7, generator=generator, dtype=torch.float64)
    value, gradient, hessian = cost.local_model(x)
    assert (value.shape, gradient.shape, hessian.shape) == (shape, (*shape, 7), (*shape, 7, 7))
    torch.testing.assert_close(cost.value(x), value)
    flat = cost.local_model(x.reshape(-1, 7)).hessian.reshape(hessian.shape)
    torch.testing.assert_close(hessian, flat)


def test_what_a_displacement_and_a_turn_cost() -> None:
    body = load_body("body30")
    x, sigma = body.rest.clone(), 0.1
    cost = pose_targets(body, "root_roll_link", link_pose(body, "root_roll_link", x), sigma=sigma)
    assert float(cost.value(x)) == 0
    moved = x.clone()
    moved[body.state_index("root_x")] += 0.03
    assert float(cost.value(moved)) == pytest.approx(0.5 * 0.03**2 / sigma**2)
    for name in ("root_yaw", "root_pitch", "root_roll"):
        turned = x.clone()
        turned[body.state_index(name)] += 0.4
        want = 0.5 * 4 / 3 * ARM**2 * (1 - math.cos(0.4)) / sigma**2
        assert float(cost.value(turned)) == pytest.approx(want)


def test_what_is_held_stays() -> None:
    body = load_body("arm7")
    held = torch.full_like(body.rest, 0.2)
    columns = torch.tensor([5, 0])
    cost = pose_targets(
        body, "r_wrist_link", torch.eye(4, dtype=held.dtype), columns=columns, held=held
    )
    whole = cost.whole(torch.tensor([[0.7, -0.4]], dtype=held.dtype))
    assert whole.tolist() == [[-0.4, 0.2, 0.2, 0.2, 0.2, 0.7, 0.2]]


def test_bad_input_is_told() -> None:
    body = load_body("arm7")
    with pytest.raises(BodyError, match="no link 'tail'"):
        pose_targets(body, "tail", torch.eye(4))
    with pytest.raises(ShapeError, match=r"a frame \[4, 4\] or a place \[3\], got \[3, 3\]"):
        pose_targets(body, "r_wrist_link", torch.eye(3))


def joints_of(name: str, generator: torch.Generator, *, sticky: bool) -> PointTargets:
    """All joint centres of a body against places of their own for each of seven states."""
    body = load_body(name)
    target = body.pose(body.rest).joints
    apart = torch.randn(7, *target.shape, generator=generator, dtype=target.dtype)
    return PointTargets(
        body=body,
        link=body.marker_link,
        offset=body.marker_offset,
        target=target + 0.3 * apart,
        sigma=0.01 + torch.rand(len(target), generator=generator, dtype=target.dtype),
        sticky=sticky,
    )


@pytest.mark.skipif(not compiler.AVAILABLE, reason="numba is not installed")
@pytest.mark.parametrize("sticky", [False, True])
@pytest.mark.parametrize("name", ["arm7", "arm8", "body34"])
def test_the_compiled_cost_is_the_same(name: str, sticky: bool, generator: torch.Generator) -> None:
    cost = joints_of(name, generator, sticky=sticky)
    compiled = cost.compiled()
    assert isinstance(compiled, FusedTargets)
    low, high = cost.body.bounds.lower.clamp(min=-3), cost.body.bounds.upper.clamp(max=3)
    share = torch.rand(4, len(low), generator=generator, dtype=low.dtype)
    x = torch.stack([low, high, torch.zeros_like(low), *(low + share * (high - low))])
    items = torch.tensor([5, 0, 2])
    for ours, theirs, at in (
        (compiled, cost, x),
        (compiled.take(items), cost.take(items), x[items]),
    ):
        want = theirs.local_model(at)
        for got, reference in zip(ours.local_model(at), want, strict=True):
            size = float(reference.abs().max())
            torch.testing.assert_close(got, reference, rtol=1e-10, atol=1e-12 * size)
        assert torch.equal(ours.value(at), ours.local_model(at).value)
    one = replace(cost, target=cost.target[0])
    torch.testing.assert_close(one.compiled().value(x), one.value(x))


def test_what_has_no_compiled_twin_stays_as_it_is(generator: torch.Generator) -> None:
    cost = cost_of("arm8", "r_wrist_link", columns=torch.tensor([1, 2]))
    assert cost.compiled() is cost
    with pytest.raises(ConfigurationError, match="expected whole states"):
        FusedTargets.of(cost)
