"""The fused engine against the eager one."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from weakref import ref

import numpy as np
import pytest
import torch
from made_costs import changed, make_full_cost, printed_cost, random_states
from made_engines import NATS, RELATIVE, assert_close, awkward_states, colours_of
from made_processes import begin
from torch import Tensor

from torchcss.body.shape import with_shape
from torchcss.cost.context import BodyTables
from torchcss.cost.fused.engine import FusedEngine
from torchcss.cost.fused.priors import add_priors
from torchcss.cost.fused.repulsion import add_repulsion
from torchcss.cost.fused.view import add_view
from torchcss.cost.total import TrackingCost, beside, numbered, together
from torchcss.errors import ShapeError
from torchcss.kernels import compiler
from torchcss.kernels.checked import checked
from torchcss.types import Curvature, LocalModel

BODIES = ["arm8", "arm7", "body30", "body32", "body34"]


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", BODIES)
def test_the_engines_agree(name: str, dtype: str, generator: torch.Generator) -> None:
    cost = colours_of(make_full_cost(name, own_parents=12))
    assert_close(cost, random_states(cost.body, 12, generator=generator), dtype)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", BODIES)
def test_matches_that_are_held(name: str, dtype: str, generator: torch.Generator) -> None:
    cost = colours_of(make_full_cost(name, own_parents=26))
    found_at = torch.cat(
        [random_states(cost.body, 12, generator=generator), awkward_states(cost, generator)]
    )
    # States that follow one another share what is found if they are the same.
    found_at[1:4] = found_at[0]
    step = torch.randn(found_at.shape, generator=generator, dtype=torch.float64)
    x = found_at + 0.02 * step
    assert_held_close(cost, x, found_at, dtype)
    parent = torch.zeros(len(x), dtype=torch.long)
    assert_held_close(replace(cost, parent=parent, component=None), x, found_at, dtype)


@pytest.mark.parametrize("preset", ["ijrr_css", "rr_multiple_hypothesis"])
def test_printed_matches_that_are_held(preset: str, generator: torch.Generator) -> None:
    cost = printed_cost(make_full_cost("body34"), preset)
    found_at = random_states(cost.body, 6, generator=generator)
    assert_held_close(cost, found_at + 0.01, found_at, "float64")


def assert_held_close(cost: TrackingCost, x: Tensor, found_at: Tensor, dtype: str) -> None:
    fused = replace(cost, engine=FusedEngine(dtype))  # type: ignore[arg-type]
    got, expected = fused.held_value(x, found_at), cost.held_value(x, found_at)
    torch.testing.assert_close(got, expected, rtol=RELATIVE[dtype], atol=NATS[dtype])
    nothing_moved = fused.held_value(found_at, found_at)
    torch.testing.assert_close(nothing_moved, fused.value(found_at), rtol=1e-6, atol=1e-4)


def test_derivatives_are_those_of_the_cost_with_matches_held(generator: torch.Generator) -> None:
    cost = colours_of(make_full_cost("body34"))
    cost = replace(cost, engine=FusedEngine("float64"))
    x = random_states(cost.body, generator=generator)
    at = x.expand(cost.body.num_parameters, -1).contiguous()
    h = 1e-5 * torch.eye(len(at), dtype=x.dtype)
    slope = (cost.held_value(at + h, at) - cost.held_value(at - h, at)) / 2e-5
    expected = cost.local_model(x).gradient
    torch.testing.assert_close(slope, expected, rtol=1e-5, atol=1e-5 * float(expected.abs().max()))


def test_a_state_that_is_none_gives_none_where_matches_are_held(
    generator: torch.Generator,
) -> None:
    cost = replace(make_full_cost("arm8"), engine=FusedEngine())
    x = random_states(cost.body, 3, generator=generator)
    found_at = x.clone()
    found_at[1] = torch.nan
    assert cost.held_value(x, found_at).isnan().tolist() == [False, True, False]
    with pytest.raises(ShapeError, match="found_at"):
        cost.held_value(x, found_at[:2])


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
    assert_close(together([cost, numbered(other, 1)], sequence), x, "float64")


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_a_sample_does_not_depend_on_its_pool(threads: int, generator: torch.Generator) -> None:
    cost = replace(make_full_cost("body34", own_parents=9), engine=FusedEngine())
    # Without what the eager engine adds, whose items agree to rounding.
    cost = replace(cost, choice=cost.choice.without("edge_energy", "temporal_mixture"))
    x = random_states(cost.body, 9, generator=generator)
    whole = cost.local_model(x)
    cost = replace(cost, engine=FusedEngine(threads=threads))
    order = torch.tensor([4, 8, 0, 2, 1])
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


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", BODIES)
def test_awkward_poses(name: str, dtype: str, generator: torch.Generator) -> None:
    cost = colours_of(make_full_cost(name))
    assert_close(cost, awkward_states(cost, generator), dtype)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("preset", ["ijrr_css", "rr_multiple_hypothesis", "ijrr_gaussian_single"])
@pytest.mark.parametrize("name", BODIES)
def test_printed_costs(name: str, preset: str, dtype: str, generator: torch.Generator) -> None:
    cost = printed_cost(make_full_cost(name), preset)
    usual = random_states(cost.body, 12, generator=generator)
    x = torch.cat([usual, awkward_states(cost, generator)])
    if dtype == "float32" and preset == "ijrr_gaussian_single":
        # Gaussian flow costs thousands of nats where a pose is wrong, more than single precision
        # has hundredths of.
        cost = replace(cost, choice=cost.choice.without("flow"))
    assert_close(cost, x, dtype)


CHECK = """
import torch
from dataclasses import replace
from made_engines import NATS, RELATIVE, assert_close, awkward_states, colours_of
from made_costs import make_full_cost, printed_cost
cost = colours_of(make_full_cost("arm8"))
x = awkward_states(cost, torch.Generator().manual_seed(0))[[0, 7, 9]]
for each in (cost, printed_cost(cost, "ijrr_css"), printed_cost(cost, "ijrr_gaussian_single")):
    assert_close(each, x, "float64")
    assert_close(each, x, "float32")
cost = colours_of(make_full_cost("body34"))  # a root, and parts that hide others
assert_close(cost, awkward_states(cost, torch.Generator().manual_seed(0))[[8]], "float32")
print("checked")
"""


def said(code: str, **variables: str) -> str:
    """What a process of its own prints."""
    here = Path(__file__).parent
    path = os.pathsep.join([str(here.parent), str(here.parents[1])])
    environment = {**os.environ, "PYTHONPATH": path, **variables}
    run = [sys.executable, "-c", code]
    done = subprocess.run(
        run, env=environment, capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_no_index_is_out_of_range() -> None:
    assert said(CHECK, TORCHCSS_CHECK_KERNELS="1") == "checked\n"


FORK = """
import os, torch
from dataclasses import replace
from made_costs import JOINTS_ONLY, make_cost, random_states
from torchcss.cost.fused.engine import FusedEngine
cost = replace(make_cost("arm8", JOINTS_ONLY), engine=FusedEngine(threads=2))
x = random_states(cost.body, 4, generator=torch.Generator().manual_seed(0))
value = cost.value(x)
if os.fork() == 0:
    os._exit(0 if torch.equal(cost.value(x), value) else 1)
tell(os.waitstatus_to_exitcode(os.wait()[1]))
"""


@pytest.mark.skipif(not compiler.COMPILED, reason="numba is not installed")
@pytest.mark.skipif(sys.platform == "win32", reason="no forks")
def test_a_fork_has_threads_of_its_own() -> None:
    begun = begin(FORK)
    assert begun.told.recv() == 0
    assert begun.end() == 0


def test_an_index_out_of_range_is_refused() -> None:
    array = checked(np.zeros((2, 3)))
    array[1, 2] = 1.0
    for index in ((2, 0), (0, -1), 2, -1):
        with pytest.raises(IndexError, match="of an axis of"):
            array[index]


def test_what_is_packed_goes_with_its_frame(generator: torch.Generator) -> None:
    """Else a run would keep the pictures of many frames."""
    cost = colours_of(make_full_cost("arm8"))
    x, frame = random_states(cost.body, 2, generator=generator), ref(cost.views[0])
    engine = FusedEngine("float32")
    packed = engine._view(cost, cost.past[0], cost.views[0])
    engine.value(cost, x)
    assert engine._view(cost, cost.past[0], cost.views[0]) is packed
    for weight in range(40):
        engine.value(cost.with_weights({"contour": float(weight)}), x)
    assert len(engine._packs._of[cost.views[0]]) < 40
    del cost
    gc.collect()
    assert frame() is None
    assert not len(engine._packs._of)
