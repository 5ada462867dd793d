"""`Curvature.AUTOGRAD` of the whole cost: the reference of every closed form."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from made_costs import changed, make_full_cost, printed_cost, random_states
from made_engines import awkward_states

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


@pytest.mark.parametrize("preset", ["ijrr_css", "rr_multiple_hypothesis", "ijrr_gaussian_single"])
@pytest.mark.parametrize("name", ["arm8", "body34"])
def test_the_printed_costs_have_their_derivatives(
    name: str, preset: str, generator: torch.Generator
) -> None:
    """Also behind the camera, out of the picture, at bounds, folded up and straight."""
    cost = printed_cost(make_full_cost(name), preset)
    assert {"contour", "flow", "stabiliser"} <= set(cost.terms(cost.body.rest[None]))
    x = awkward_states(cost, generator)
    exact = replace(cost, choice=replace(cost.choice, curvature=Curvature.EXACT))
    autograd = replace(cost, choice=replace(cost.choice, curvature=Curvature.AUTOGRAD))
    for got, expected in zip(exact.local_model(x), autograd.local_model(x), strict=True):
        scale = expected.abs().flatten(1).amax(1) if expected.dim() > 1 else expected.abs()
        error = (got - expected).abs()
        error = error.flatten(1).amax(1) if error.dim() > 1 else error
        assert float((error / scale.clamp(min=1)).max()) < 1e-8


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
