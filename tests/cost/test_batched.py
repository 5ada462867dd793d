"""Sequences that are alike are evaluated as one: the same results by as many calls as of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from made_costs import FULL, make_full_cost, random_states
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from torchcss.body.load import load_body
from torchcss.body.shape import with_shape
from torchcss.cost.batched import merged
from torchcss.cost.context import FrameContext
from torchcss.cost.pose_prior import PosePrior
from torchcss.cost.temporal import MixturePrior, TemporalPrior
from torchcss.cost.total import TrackingCost, numbered, together
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.types import Curvature, Keypoints
from torchcss.vision.camera import Camera

CHOICE = replace(FULL.having(PosePrior(), MixturePrior(), TemporalPrior()))
TOLERANCE = {torch.float64: 1e-10, torch.float32: 2e-5}


def clip(name: str, number: int, count: int, dtype: torch.dtype, known: bool) -> TrackingCost:
    """The cost of some samples of a clip with a build, a camera, a picture and modes of its own."""
    view = make_full_cost(name, dtype=dtype).views[0]
    lengths = {key: (1 + 0.03 * number) * value for key, value in view.body.lengths.items()}
    body = load_body(name, lengths=lengths).to(dtype)
    shape = body.part_shape.clone()
    shape[:, :2] *= 1 - 0.05 * number
    body = with_shape(body, shape)
    base = view.body.base_translation + 0.02 * number
    body = body.with_base(view.body.base_rotation, base)
    camera, field = view.camera, view.edge_field
    assert field is not None
    focal = camera.K * torch.tensor([1 - 0.05 * number, 1 + 0.02 * number, 1]).to(camera.K)[:, None]
    moved = Camera(
        focal, camera.image_size_wh, distortion=camera.distortion * (number % 2),
        t_camera_world=camera.t_camera_world + 0.01 * number,
    ).to(dtype)  # fmt: skip
    keypoints = view.keypoints
    assert keypoints is not None
    keypoints = Keypoints(keypoints.positions + number, keypoints.confidence, keypoints.names)
    generator = torch.Generator().manual_seed(number)
    modes = random_states(load_body(name), 2 + number % 2, generator=generator).to(dtype)
    context = FrameContext(
        body=body, camera=moved, features=view.features, edge_field=field.roll(9 * number, -1),
        keypoints=keypoints if known else None, modes=modes, deviation=view.deviation,
    )  # fmt: skip
    size = modes.shape[-1]
    covariance = 0.05 * torch.eye(size, dtype=dtype).expand(len(modes), size, size)
    weight = torch.linspace(0, -1, len(modes), dtype=dtype).log_softmax(0)
    cost = TrackingCost(choice=CHOICE, views=(context,))
    parent = torch.arange(count) % len(modes)
    own = cost.of_children(parent, Prior.of(GaussianMixture(modes, covariance, weight)))
    return numbered(own, number)


def beside_each_other(
    name: str, counts: tuple[int, ...], dtype: torch.dtype = torch.float64, *, known: bool = True
) -> tuple[list[TrackingCost], list[Tensor], TrackingCost]:
    """Clips, their samples, and the cost of all of them."""
    costs = [clip(name, n, count, dtype, known) for n, count in enumerate(counts)]
    generator = torch.Generator().manual_seed(0)
    every = load_body(name)
    x = [random_states(every, count, generator=generator).to(dtype) for count in counts]
    sequence = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
    return costs, x, together(costs, sequence)


def same(found: Tensor, expected: list[Tensor]) -> None:
    """Whether numbers agree to rounding, by the largest."""
    whole = torch.cat(expected)
    apart, largest = (found - whole).abs().max(), whole.abs().max()
    assert apart <= TOLERANCE[whole.dtype] * largest, float(apart / largest)


@pytest.mark.parametrize("known", [True, False], ids=["keypoints", "no keypoints"])
@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_the_results_are_those_of_each(name: str, dtype: torch.dtype, known: bool) -> None:
    costs, x, both = beside_each_other(name, (3, 1, 4), dtype, known=known)
    assert merged(both) is not None
    every = torch.cat(x)
    same(both.value(every), [c.value(own) for c, own in zip(costs, x, strict=True)])
    moved = [own.roll(1, 0) for own in x]
    held = [c.held_value(*pair) for c, *pair in zip(costs, moved, x, strict=True)]
    same(both.held_value(torch.cat(moved), every), held)
    models = [c.local_model(own) for c, own in zip(costs, x, strict=True)]
    for found, expected in zip(both.local_model(every), zip(*models, strict=True), strict=True):
        same(found, list(expected))
    for name_, value in both.terms(every).items():
        same(value, [c.terms(own)[name_] for c, own in zip(costs, x, strict=True)])


@pytest.mark.parametrize("curvature", [Curvature.GAUSS_NEWTON, Curvature.AUTOGRAD])
def test_of_any_curvature(curvature: Curvature) -> None:
    costs, x, both = beside_each_other("arm8", (2, 3))
    choice = replace(both.choice, curvature=curvature)
    models = [replace(c, choice=choice).local_model(o) for c, o in zip(costs, x, strict=True)]
    found = replace(both, choice=choice).local_model(torch.cat(x))
    for one, expected in zip(found, zip(*models, strict=True), strict=True):
        same(one, list(expected))


class _Calls(TorchDispatchMode):
    """Counts the operations of torch."""

    def __init__(self) -> None:
        super().__init__()
        self.number = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.number += 1
        return func(*args, **(kwargs or {}))


def calls(evaluate: Callable[[Tensor], Any], x: Tensor) -> int:
    """How many operations an evaluation takes when what is kept has been made."""
    evaluate(x)
    with _Calls() as counted:
        evaluate(x)
    return counted.number


@pytest.mark.parametrize("method", ["value", "local_model"])
def test_a_sequence_more_is_few_calls_more(method: str) -> None:
    costs, x, both = beside_each_other("body34", (2,) * 4)
    alone = calls(getattr(costs[0], method), x[0])
    assert calls(getattr(both, method), torch.cat(x)) < (1 + 3 * 0.25) * alone


def test_sequences_that_are_not_alike_are_evaluated_one_by_one() -> None:
    arm, x, _ = beside_each_other("arm8", (2, 3))
    blind = clip("arm8", 1, 3, torch.float64, known=False)
    both = together([arm[0], blind], torch.tensor([0, 0, 1, 1, 1]))
    assert merged(both) is None
    alone = [arm[0].value(x[0]), blind.value(x[1])]
    torch.testing.assert_close(both.value(torch.cat(x)), torch.cat(alone), rtol=0, atol=0)
    some = both.take(torch.tensor([2, 3]))  # a sequence without samples
    torch.testing.assert_close(some.value(x[1][:2]), alone[1][:2], rtol=1e-12, atol=0)


def test_many_samples_are_evaluated_one_sequence_after_the_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    costs, x, both = beside_each_other("arm8", (2, 3))
    monkeypatch.setattr("torchcss.cost.total.CHUNK", 5)
    alone = [cost.value(own) for cost, own in zip(costs, x, strict=True)]
    torch.testing.assert_close(both.value(torch.cat(x)), torch.cat(alone), rtol=0, atol=0)
