"""Marks that are no marks of their joints are left out, and no others."""

from __future__ import annotations

import math

import pytest
import torch

from torchcss.cost.anthropometric import Anthropometric
from torchcss.cost.choice import CostChoice
from torchcss.cost.context import FrameContext
from torchcss.cost.joints import JointTerm
from torchcss.cost.stabiliser import Stabiliser
from torchcss.cost.total import TrackingCost
from torchcss.initialise.multi_start import PAPERS, StartSearch, optimise
from torchcss.initialise.outliers import (
    best_distinct,
    capped_cost,
    find_outliers,
    price_of_leaving_out,
    refine_fits,
    without,
)
from torchcss.studies.random_person import RandomPerson, random_person
from torchcss.types import Keypoints


def person_and_cost(**options) -> tuple[RandomPerson, TrackingCost]:
    """A person and the cost of the marks, lengths known."""
    someone = random_person(generator=torch.Generator().manual_seed(0), **options)
    keypoints = Keypoints(someone.keypoints, someone.confidence, someone.joint_names)
    choice = CostChoice(terms=(JointTerm(sigma=2.0), Stabiliser(), Anthropometric()))
    view = FrameContext(body=someone.body, camera=someone.camera, keypoints=keypoints)
    return someone, TrackingCost(choice=choice, views=(view,))


def moved(cost: TrackingCost, mark: int, pixels: tuple[float, float]) -> TrackingCost:
    """The same with one mark elsewhere."""
    places = cost.keypoints.positions.clone()
    places[mark] += places.new_tensor(pixels)
    return cost.with_keypoints(cost.keypoints._replace(positions=places))


def test_price_is_that_of_a_place_anywhere_in_the_image():
    _, cost = person_and_cost()
    price = price_of_leaving_out(cost)
    plain = math.log(0.95 / 0.05 * 1920 * 1080 / (2 * math.pi * 4))
    at = dict(zip(cost.keypoints.names, price.tolist(), strict=True))
    assert at["l_wrist"] == pytest.approx(plain)
    assert at["l_hip"] == pytest.approx(plain - math.log(4))


@pytest.mark.parametrize("name", ["r_knee", "l_shoulder", "vc7"])
def test_a_mark_that_is_elsewhere_is_left_out_and_no_other(name: str):
    someone, cost = person_and_cost()
    mark = someone.joint_names.index(name)
    search = StartSearch()
    fits = best_distinct(refine_fits(cost, someone.state[None], search))
    assert not bool(find_outliers(cost, fits, search).any())
    spoilt = moved(cost, mark, (180.0, -120.0))
    outliers = find_outliers(
        spoilt, best_distinct(refine_fits(spoilt, someone.state[None], search)), search
    )
    assert torch.nonzero(outliers)[:, 0].tolist() == [mark]


def test_as_printed_nothing_is_widened_on_the_way():
    """Section 5 [IJRR]: one descent; with the lengths held it goes on at the keypoints' scale."""
    someone, cost = person_and_cost()
    start = someone.body.bounds.project(someone.state[None] + 0.3)
    plain = optimise(cost, start, someone.body.bounds, 60, tolerance=1e-3)
    assert torch.equal(refine_fits(cost, start, PAPERS).mean, plain.mean)
    assert not torch.equal(refine_fits(cost, start, StartSearch()).mean, plain.mean)


def test_where_very_many_marks_do_not_fit_none_is_left_out(generator: torch.Generator):
    someone, cost = person_and_cost()
    size = torch.tensor(cost.camera.image_size_wh)
    anywhere = size * torch.rand(14, 2, generator=generator).double()
    scattered = cost.with_keypoints(cost.keypoints._replace(positions=anywhere))
    search = StartSearch()
    fits = best_distinct(refine_fits(scattered, someone.state[None], search))
    assert not bool(find_outliers(scattered, fits, search).any())


def test_no_mark_costs_more_than_leaving_it_out():
    someone, cost = person_and_cost()
    x = someone.state.expand(2, 3, -1)
    assert torch.equal(capped_cost(cost, x), cost.value(x))
    assert torch.equal(capped_cost(cost, x[0, 0]), cost.value(x[0, 0]))
    mark = someone.joint_names.index("r_elbow")
    far = moved(cost, mark, (0.0, 900.0))
    outliers = torch.arange(14) == mark
    price = price_of_leaving_out(cost)[mark]
    torch.testing.assert_close(
        capped_cost(far, x), without(far, outliers).value(x) + price, rtol=1e-12, atol=0.0
    )


def test_every_item_is_without_its_own_marks(generator: torch.Generator):
    someone, cost = person_and_cost()
    outliers = torch.rand(5, 14, generator=generator) < 0.3
    noise = torch.randn(5, len(someone.state), generator=generator, dtype=torch.float64)
    x = someone.body.bounds.project(someone.state + 0.05 * noise)
    together = without(cost, outliers)
    items = torch.tensor([3, 0, 4])
    for model, rows in (
        (together.local_model(x), range(5)),
        (together.take(items).local_model(x[items]), items.tolist()),
    ):
        for place, row in enumerate(rows):
            alone = without(cost, outliers[row]).local_model(x[row])
            for one, all_of_them in zip(alone, model, strict=True):
                torch.testing.assert_close(all_of_them[place], one, rtol=1e-9, atol=1e-9)
