"""Samples of several clips in one call: each with its own body, camera and pictures."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from made_costs import changed, make_full_cost, random_states

from torchcss.body.shape import with_shape
from torchcss.cost.context import BodyTables
from torchcss.cost.fused.engine import FusedEngine
from torchcss.cost.total import TrackingCost, numbered, together
from torchcss.inference.mixture import GaussianMixture, Prior
from torchcss.types import Keypoints


def two_clips() -> tuple[TrackingCost, TrackingCost]:
    """Two clips of two people by two cameras; the second has no picture of edges."""
    first = make_full_cost("arm8", own_parents=3)
    shape = first.body.part_shape.clone()
    shape[:, :2] *= 1.3
    body, view = with_shape(first.body, shape), first.views[0]
    known = view.keypoints
    assert known is not None
    second = changed(
        make_full_cost("arm8", own_parents=4),
        body=body,
        tables=BodyTables(body),
        camera=view.camera.resized(200, 150),
        keypoints=Keypoints(known.positions + 5, known.confidence, known.names),
        features=None,
        edge_field=None,
    )
    return first, second


def test_one_call_gives_what_two_calls_give(generator: torch.Generator) -> None:
    first, second = two_clips()
    sequence = torch.tensor([1, 0, 1, 1, 0, 0, 1])
    both = together([first, numbered(second, 1)], sequence)
    x = random_states(first.body, len(sequence), generator=generator)
    apart = [(cost, x[sequence == number]) for number, cost in enumerate((first, second))]
    whole = both.local_model(x)
    for number, (cost, own) in enumerate(apart):
        rows = sequence == number
        for got, expected in zip(whole, cost.local_model(own), strict=True):
            torch.testing.assert_close(got[rows], expected, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(both.value(x)[rows], cost.value(own))
        for name, value in both.terms(x).items():
            expected = cost.terms(own).get(name, torch.zeros(len(own)).double())
            torch.testing.assert_close(value[rows], expected)
    assert not torch.allclose(
        first.value(x[sequence == 0]), second.take(torch.arange(3)).value(x[:3])
    )
    items = torch.tensor([6, 1, 2])
    torch.testing.assert_close(both.take(items).value(x[items]), both.value(x)[items])


def test_samples_of_several_clips_descend_from_the_modes_of_their_own(
    generator: torch.Generator,
) -> None:
    sequence, parent = torch.tensor([1, 0, 1, 0, 0]), torch.tensor([2, 1, 0, 0, 1])
    costs = [
        numbered(replace(c, parent=None, component=None), n) for n, c in enumerate(two_clips())
    ]
    priors = [
        Prior.of(
            GaussianMixture(
                mean, 0.01 * torch.eye(mean.shape[-1]).double().expand(3, -1, -1), -weight
            )
        )
        for mean, weight in (
            (random_states(cost.body, 3, generator=generator), torch.rand(3).double())
            for cost in costs
        )
    ]
    both = together(costs, sequence).of_children(parent, *priors)
    x = random_states(costs[0].body, len(sequence), generator=generator)
    for number, (cost, prior) in enumerate(zip(costs, priors, strict=True)):
        rows = sequence == number
        alone = cost.of_children(parent[rows], prior)
        assert not torch.allclose(alone.value(x[rows]), cost.value(x[rows]), atol=1e-3)
        torch.testing.assert_close(both.value(x)[rows], alone.value(x[rows]))
        for got, expected in zip(both.local_model(x), alone.local_model(x[rows]), strict=True):
            torch.testing.assert_close(got[rows], expected, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="zip"):
        together(costs, sequence).of_children(parent, priors[0])


def test_one_clip_is_the_case_of_one(generator: torch.Generator) -> None:
    first, _ = two_clips()
    x = random_states(first.body, 3, generator=generator)
    alone = together([first], torch.zeros(3, dtype=torch.long))
    torch.testing.assert_close(alone.value(x), first.value(x), rtol=0, atol=0)


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_share_out_the_samples_of_all_clips(
    threads: int, generator: torch.Generator
) -> None:
    costs = [
        numbered(replace(cost, engine=FusedEngine("float64", threads)), number)
        for number, cost in enumerate(two_clips())
    ]
    sequence = torch.tensor([1, 0, 1, 1, 0, 0, 1])
    x = random_states(costs[0].body, len(sequence), generator=generator)
    x[2, 0] = torch.nan
    whole = together(costs, sequence).local_model(x)
    for number, cost in enumerate(costs):
        own = cost.local_model(x[sequence == number])
        for got, expected in zip(whole, own, strict=True):
            torch.testing.assert_close(
                got[sequence == number], expected, rtol=0, atol=0, equal_nan=True
            )
    assert [int(row) for row in whole.value.isnan().nonzero()] == [2]
