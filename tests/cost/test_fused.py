"""The fused engine against the eager one."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from made_costs import changed, make_full_cost, random_states
from torch import Tensor

from torchcss.body.shape import with_shape
from torchcss.cost.context import BodyTables
from torchcss.cost.fused.engine import FusedEngine, fused_engine
from torchcss.cost.fused.priors import add_priors
from torchcss.cost.fused.repulsion import add_repulsion
from torchcss.cost.fused.view import add_view
from torchcss.cost.region import RegionImages, RegionTerm, layer_of_part
from torchcss.cost.total import TrackingCost, beside, together
from torchcss.cost.visibility import ContourPredictor
from torchcss.kernels.checked import checked
from torchcss.types import Curvature, LocalModel
from torchcss.vision.spline import spline_field

NATS = {"float64": 1e-6, "float32": 1e-2}
RELATIVE = {"float64": 1e-9, "float32": 1e-6}
"""By how much the engines may differ, in nats or of a cost that is larger."""

BODIES = ["arm8", "arm7", "body30", "body34"]


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
    for got, expected in zip(ours[1:], theirs[1:], strict=True):
        n = x.shape[-1]
        scale = 1 + expected.reshape(-1, n).abs().amax() if expected.numel() else 1.0
        torch.testing.assert_close(got / scale, expected / scale, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", BODIES)
def test_the_engines_agree(name: str, dtype: str, generator: torch.Generator) -> None:
    cost = colours_of(make_full_cost(name, own_parents=12))
    assert_close(cost, random_states(cost.body, 12, generator=generator), dtype)


def test_kernels_are_compiled_once_for_each_precision() -> None:
    assert all(len(kernel.signatures) <= 2 for kernel in (add_priors, add_repulsion, add_view))  # type: ignore[attr-defined]


@pytest.mark.parametrize("curvature", [Curvature.GAUSS_NEWTON, Curvature.AUTOGRAD])
def test_other_curvatures(curvature: Curvature, generator: torch.Generator) -> None:
    cost = make_full_cost("arm8")
    cost = replace(cost, choice=replace(cost.choice, curvature=curvature))
    assert_close(cost, random_states(cost.body, 5, generator=generator), "float64")


def test_several_views_and_sequences(generator: torch.Generator) -> None:
    cost = make_full_cost("arm8")
    other = changed(cost, camera=cost.camera.resized(200, 150), features=None, edge_field=None)
    x = random_states(cost.body, 7, generator=generator)
    assert_close(beside([cost, other]), x, "float64")
    shape = cost.body.part_shape.clone()
    shape[:, :2] *= 1.3
    body = with_shape(cost.body, shape)
    other = changed(other, body=body, tables=BodyTables(body))
    sequence = torch.tensor([1, 0, 1, 1, 0, 0, 1])
    assert_close(together([cost, other], sequence), x, "float64")


def test_a_sample_does_not_depend_on_its_pool(generator: torch.Generator) -> None:
    cost = replace(make_full_cost("body34", own_parents=9), engine=FusedEngine())
    # Without what the eager engine adds, whose items agree to rounding.
    cost = replace(cost, choice=cost.choice.without("edge_energy", "temporal_mixture"))
    x = random_states(cost.body, 9, generator=generator)
    whole = cost.local_model(x)
    order = torch.tensor([4, 8, 0])
    for got, expected in zip(cost.take(order).local_model(x[order]), whole, strict=True):
        torch.testing.assert_close(got, expected[order], rtol=0, atol=0)


@pytest.mark.parametrize("batch", [(), (0,), (2, 3), (2, 0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_leading_shapes_and_types(
    batch: tuple[int, ...], dtype: torch.dtype, generator: torch.Generator
) -> None:
    cost = replace(make_full_cost("arm8", dtype=dtype), engine=FusedEngine())
    n = cost.body.num_parameters
    x = random_states(make_full_cost("arm8").body, *batch, generator=generator)
    model = cost.local_model(x.to(dtype))
    assert all(part.dtype == dtype for part in model)
    assert [part.shape for part in model] == [batch, (*batch, n), (*batch, n, n)]


def test_a_state_that_is_none_spoils_no_other(generator: torch.Generator) -> None:
    cost = replace(make_full_cost("arm8"), engine=FusedEngine())
    x = random_states(cost.body, 3, generator=generator)
    whole = cost.local_model(x)
    x[1] = torch.nan
    spoilt = cost.local_model(x)
    assert spoilt.value[1].isnan()
    kept = torch.tensor([0, 2])
    assert same(LocalModel(*(p[kept] for p in spoilt)), LocalModel(*(p[kept] for p in whole)))


def same(one: LocalModel, other: LocalModel) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


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


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", BODIES)
def test_awkward_poses(name: str, dtype: str, generator: torch.Generator) -> None:
    cost = colours_of(make_full_cost(name))
    assert_close(cost, awkward_states(cost, generator), dtype)


CHECK = """
import torch
from dataclasses import replace
from test_fused import assert_close, awkward_states, colours_of
from made_costs import make_full_cost
cost = colours_of(make_full_cost("arm8"))
x = awkward_states(cost, torch.Generator().manual_seed(0))[[0, 7, 9]]
assert_close(cost, x, "float64")
assert_close(cost, x, "float32")
print("checked")
"""


def test_no_index_is_out_of_range() -> None:
    here = Path(__file__).parent
    paths = [str(here), str(here.parent), str(here.parents[1])]
    environment = {
        **os.environ,
        "TORCHCSS_CHECK_KERNELS": "1",
        "PYTHONPATH": os.pathsep.join(paths),
    }
    run = [sys.executable, "-c", CHECK]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "checked\n", done.stderr


def test_an_index_out_of_range_is_refused() -> None:
    array = checked(np.zeros((2, 3)))
    array[1, 2] = 1.0
    for index in ((2, 0), (0, -1), 2, -1):
        with pytest.raises(IndexError, match="of an axis of"):
            array[index]
