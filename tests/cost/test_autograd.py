"""`Curvature.AUTOGRAD` of the whole cost: the reference of every closed form."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from made_costs import changed, make_full_cost, random_states

from torchcss.cost.term import differentiated
from torchcss.cost.total import TrackingCost
from torchcss.types import Curvature

DEFAULT = ("contour", "region", "flow", "joints", "stabiliser", "temporal", "interpenetration")


def default_cost(name: str) -> TrackingCost:
    """All default terms at once, with what they compare with."""
    from torchcss.cost.region import RegionTerm, part_layers
    from torchcss.vision.appearance import Appearance

    cost = make_full_cost(name, own_parents=4)
    features = cost.views[0].features
    assert features is not None
    generator = torch.Generator().manual_seed(3)
    colour = torch.rand(3, *features.grey.shape, generator=generator, dtype=torch.float64)
    layers = len(part_layers(cost.body)[0])
    masks = torch.rand(layers, *features.grey.shape, generator=generator) < 0.3
    known = Appearance.unknown(layers, like=colour).learn(colour, masks, ~masks)
    cost = changed(cost, features=features._replace(colour=colour), appearance=known)
    return replace(cost, choice=cost.choice.having(RegionTerm()).only(DEFAULT))


@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_the_closed_forms_are_the_derivatives_of_the_cost(
    name: str, generator: torch.Generator
) -> None:
    cost = default_cost(name)
    assert set(cost.terms(cost.body.rest.expand(4, -1))) == set(DEFAULT)
    autograd = replace(cost, choice=replace(cost.choice, curvature=Curvature.AUTOGRAD))
    noise = torch.randn(4, cost.body.num_parameters, generator=generator, dtype=torch.float64)
    wide = random_states(cost.body, 4, generator=generator)
    # Anywhere, at bounds, at rest; and one far to the side, out of the picture in part.
    for x in (wide, cost.body.bounds.project(5 * noise), cost.body.rest.expand(4, -1).clone()):
        closed, other = cost.local_model(x), autograd.local_model(x)
        for got, expected in zip(closed, other, strict=True):
            scale = max(float(expected.abs().max()), 1.0)
            torch.testing.assert_close(got, expected, rtol=0, atol=1e-8 * scale)


def test_a_term_with_a_value_alone_gets_its_derivatives(generator: torch.Generator) -> None:
    from torchcss.cost.term import Posed

    cost = default_cost("arm8")
    view, x = cost.views[0], random_states(cost.body, 4, generator=generator)
    posed = Posed(view, cost.body, cost.body.pose(x), cost.parent)
    for name in ("flow", "joints", "region"):
        (bound,) = (cost.bound[term, view] for term in cost.choice.terms if term.name == name)
        for got, expected in zip(
            differentiated(bound, posed), bound.point_cost(posed), strict=True
        ):
            torch.testing.assert_close(got, expected, rtol=1e-7, atol=1e-7)
