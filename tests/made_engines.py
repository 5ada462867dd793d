"""Costs for both engines, awkward states of their bodies, and whether the engines agree there."""

from __future__ import annotations

from dataclasses import replace

import torch
from made_costs import random_states
from torch import Tensor

from torchcss.cost.fused.engine import fused_engine
from torchcss.cost.region import RegionImages, RegionTerm, layer_of_part
from torchcss.cost.total import TrackingCost
from torchcss.cost.visibility import ContourPredictor
from torchcss.vision.spline import spline_field

NATS = {"float64": 1e-6, "float32": 1e-2}
RELATIVE = {"float64": 1e-9, "float32": 1e-6}
"""By how much the engines may differ, in nats or of a cost that is larger."""


def colours_of(cost: TrackingCost) -> TrackingCost:
    """The same cost with what the region term looks at."""
    generator = torch.Generator().manual_seed(3)
    view = cost.views[0]
    assert view.edge_field is not None
    layer = view.tables.of(layer_of_part)
    small = torch.randn(1, int(layer.max()) + 1, 9, 12, generator=generator, dtype=torch.float64)
    size = view.edge_field.shape[1:]
    images = torch.nn.functional.interpolate(small, size, mode="bicubic")[0].tanh()
    nodes, term = view.tables.of(ContourPredictor), RegionTerm()
    region = RegionImages(spline_field(images), layer[nodes.node_part])
    key = (term, view)
    bound = {**cost.bound, key: term.bind(view, region)}
    return replace(cost, choice=cost.choice.having(term), bound=bound)


def assert_close(cost: TrackingCost, x: Tensor, dtype: str) -> None:
    """Both engines agree: in nats, and by the largest entry of an item's derivatives."""
    engine = fused_engine(dtype)  # type: ignore[arg-type]
    fused, eager = replace(cost, engine=engine), replace(cost, engine=None)
    ours, theirs = fused.local_model(x), eager.local_model(x)
    tolerance = NATS[dtype]
    torch.testing.assert_close(ours.value, theirs.value, rtol=RELATIVE[dtype], atol=tolerance)
    torch.testing.assert_close(fused.value(x), ours.value, rtol=1e-6, atol=1e-4)
    terms = fused.terms(x), eager.terms(x)
    torch.testing.assert_close(*terms, rtol=RELATIVE[dtype], atol=tolerance)
    for got, expected in zip(ours[1:], theirs[1:], strict=True):
        n = x.shape[-1]
        scale = 1 + expected.reshape(-1, n).abs().amax() if expected.numel() else 1.0
        torch.testing.assert_close(got / scale, expected / scale, rtol=0, atol=tolerance)


def awkward_states(cost: TrackingCost, generator: torch.Generator) -> Tensor:
    """Behind the camera, across its plane, out of the picture, far away, folded up, wild."""
    body = cost.body
    x = random_states(body, 14, generator=generator)
    wild = torch.randn(x.shape, generator=generator, dtype=x.dtype)
    bounds = body.bounds
    lower, upper = bounds.lower.clamp(min=-3), bounds.upper.clamp(max=3)
    x[6:8] = bounds.project(3 * wild[6:8])
    x[8], x[9] = lower, upper
    x[10:12] = torch.where(wild[10:12] > 0, lower, upper)
    places = [(0, 0, 5), (0, 0, -40), (0, 0, 3.4), (3, 0, 0), (0.9, 0.7, 2.5), (0.0, 0.0, 3.0)]
    if "root_x" in body.state_names:
        columns = [body.state_index(f"root_{axis}") for axis in "xyz"]
        x[: len(places), columns] += x.new_tensor(places)
    x[12:] = body.rest + 1e-9 * wild[12:]
    return x
