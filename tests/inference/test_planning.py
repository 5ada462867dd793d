"""The compiled step of the trust region gives what its twin in torch gives."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import problems
import pytest
import torch
from made_processes import begin
from torch import Tensor

from torchcss.inference import trust_region
from torchcss.inference.trust_region import TrustRegionNewton, TrustRegionState
from torchcss.kernels import compiler
from torchcss.studies.reprojection import reprojection_problem
from torchcss.types import Bounds, CostFunction, LocalModel, Status

pytestmark = pytest.mark.skipif(not compiler.COMPILED, reason="numba is not installed")

NEWTON = TrustRegionNewton()
Pool, Trial = trust_region._Pool, trust_region._Trial


@dataclass(frozen=True)
class Indefinite(problems.Alike):
    """A quadratic without a minimum but at its bounds; some of its parameters do not matter."""

    hessian: Tensor
    slope: Tensor

    def value(self, x: Tensor) -> Tensor:
        return ((0.5 * x @ self.hessian + self.slope) * x).sum(-1)

    def local_model(self, x: Tensor) -> LocalModel:
        hessian = self.hessian.expand(*x.shape, -1)  # of no memory of its own
        return LocalModel(self.value(x), x @ self.hessian + self.slope, hessian)


class Torn(problems.Rosenbrock):
    """Not a number, or infinite, in a part of the plane."""

    def local_model(self, x: Tensor) -> LocalModel:
        value, gradient, hessian = super().local_model(x)
        value = torch.where(x[..., 0] > 1.5, torch.inf, value)
        gradient = torch.where(x[..., 1:] < -1.5, torch.nan, gradient)
        hessian = torch.where((x[..., :1] < -1.5)[..., None], torch.nan, hessian)
        return LocalModel(value, gradient, hessian)


def randn(*shape: int, generator: torch.Generator) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def made(name: str, generator: torch.Generator) -> tuple[CostFunction, Tensor, Bounds]:
    """A cost, starts, some of them awkward, and bounds."""
    a, inf = randn(7, 7, generator=generator), torch.inf
    if name == "body34":
        problem = reprojection_problem("body34", generator=generator)
        x0 = problem.truth + 0.6 * randn(40, 34, generator=generator)
        return problem.cost, problem.bounds.project(x0), problem.bounds
    cost, n, width = {
        "quadratic": (problems.Bowl(a @ a.T, a[0]), 7, 2.0),
        "indefinite": (Indefinite(a + a.T, a[0]), 7, 1.0),
        "flat": (Indefinite(torch.diag((a[0] > 0) * a[0]), 0 * a[0]), 7, 1.0),
        "saddle": (problems.DoubleWell(), 2, inf),
        "valley": (problems.Rosenbrock(), 5, inf),
        "in a box": (problems.Rosenbrock(), 5, 0.7),
        "waves": (problems.CosineSum.random(6, 20, generator=generator, stiffness=1.0), 6, 1.5),
        "free waves": (problems.CosineSum.random(6, 20, generator=generator), 6, inf),
        "one variable": (problems.CosineSum.random(1, 5, generator=generator), 1, 2.0),
        "no room": (problems.CosineSum.random(6, 20, generator=generator), 6, 0.0),
        "jumps": (problems.Jumping(problems.Rosenbrock(), 1e-2), 3, inf),
        "torn": (Torn(), 2, inf),
        "limbs": (
            problems.ReprojectedLimbs(truth=0.4 * a.flatten()[:14], limbs=2, joints=4), 14, 2.5,
        ),
    }[name]  # fmt: skip
    x0 = 2 * randn(60, n, generator=generator)
    x0[:3] = 0.0  # at a saddle, or on a ridge
    x0[3, 0] = torch.nan
    bounds = problems.box(n, -width, width)
    if name != "indefinite":  # which would fall without end
        bounds.upper[-1] = torch.inf
    return cost, x0, bounds


def check_twins(monkeypatch: pytest.MonkeyPatch, tolerance: float) -> list[Tensor]:
    """Let every compiled step from now on be compared with its twin.

    Returns:
        For every step to come, which items are the same by both.
    """
    compiled, twin, seen = Pool.advance_compiled, Pool.advance, []

    def both(self, items, trial):
        before = self._state.take(torch.arange(len(self._state.status)))
        expected = twin(self, items, trial)
        after = self._state.take(items)
        for into, field in zip(self._state.tensors, before.tensors, strict=True):
            into.copy_(field)
        got = compiled(self, items, trial)
        seen.append(alike(fields(self._state.take(items)), fields(after), tolerance))
        assert torch.equal(got.accepted, expected.accepted)
        assert bool(alike(got[1:], expected[1:], tolerance).all())
        return got

    monkeypatch.setattr(Pool, "advance_compiled", both)
    return seen


def alike(ours: Sequence[Tensor], theirs: Sequence[Tensor], tolerance: float) -> Tensor:
    """Which items are the same in all tensors."""
    near = [
        torch.isclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True).reshape(len(a), -1)
        for a, b in zip(ours, theirs, strict=True)
    ]
    return torch.cat(near, dim=1).all(1)


def fields(state: TrustRegionState) -> tuple[Tensor, ...]:
    return state.x, *state.model, *state[2:]


NAMES = [
    *("quadratic", "indefinite", "flat", "saddle", "valley", "in a box", "waves", "free waves"),
    *("one variable", "no room", "jumps", "torn", "limbs", "body34"),
]


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_a_step_is_that_of_the_twin(name, single, monkeypatch, generator):
    cost, x0, bounds = made(name, generator)
    if single:
        cost, x0 = in_single_precision(cost), x0.float()
        bounds = Bounds(*(bound.float() for bound in bounds))
    scale = 0.5 + torch.rand(x0.shape[-1], generator=generator)
    seen = check_twins(monkeypatch, 1e-2 if single else 1e-6)
    NEWTON.minimise(cost, x0, bounds, scale=scale)
    # In single precision rounding decides now and then whether a matrix counts as definite.
    assert float(torch.cat(seen).double().mean()) >= (0.98 if single else 1.0)
    assert len(seen) > 1


def in_single_precision(cost):
    class Single(problems.Alike):
        def local_model(self, x):
            return LocalModel(*(part.float() for part in cost.local_model(x.double())))

    return Single()


@pytest.mark.parametrize("limit", ["factorisations", "pinning"])
def test_what_is_not_solved_in_time(limit, monkeypatch, generator):
    cost, x0, bounds = made("waves", generator)
    seen = check_twins(monkeypatch, 1e-6)
    if limit == "pinning":
        monkeypatch.setattr(trust_region, "_PINNING_ROUNDS", 1)
    newton = TrustRegionNewton(factorisations=1 if limit == "factorisations" else 8, max_steps=20)
    newton.minimise(cost, x0, bounds)
    assert bool(torch.cat(seen).all())
    assert len(seen) > 5


@pytest.mark.parametrize("compiled", [False, True])
def test_what_has_stopped_stays_as_it_is(compiled, monkeypatch, generator):
    monkeypatch.setattr(trust_region, "_is_compiled", lambda x: compiled)
    cost, x0, bounds = made("waves", generator)
    newton = TrustRegionNewton(max_steps=4)
    state = newton.descend(cost, newton.start(x0), bounds)
    assert set(state.status.tolist()) >= {Status.STEP_LIMIT, Status.NON_FINITE}
    before = [part.clone() for part in state.tensors]
    after, info = newton.step(cost, state, bounds)
    assert bool(alike(fields(after), before, 0.0).all())
    assert not bool(info.accepted.any())


def test_an_item_depends_on_no_other(generator):
    """Not on the pool's size, nor on its order, nor on a place in it: bit for bit."""
    cost, x0, bounds = made("body34", generator)
    start, every = NEWTON.start(x0), torch.arange(40)
    state, _ = NEWTON.step(cost, start, bounds)
    assert bool(start.model.value.isinf().all()), "a step leaves the state before as it is"
    for _ in range(6):
        x = bounds.project(state.x + state.step)
        model, share = cost.local_model(x), torch.ones(len(x)).double()
        whole = state.take(every)
        Pool(NEWTON, cost, whole, bounds, None).advance_compiled(every, Trial(x, model, share))
        for items in (every.flip(0), torch.tensor([17]), torch.arange(5, 29, 3)):
            model_of = LocalModel(*(part[items] for part in model))
            trial = Trial(x[items], model_of, share[items])
            inside, alone = state.take(every), state.take(items)
            Pool(NEWTON, cost, inside, bounds, None).advance_compiled(items, trial)
            first = torch.arange(len(items))
            Pool(NEWTON, cost, alone, bounds, None).advance_compiled(first, trial)
            for some in (inside.take(items), alone):
                assert all(map(torch.equal, fields(some), fields(whole.take(items))))
            others = torch.tensor([item for item in every.tolist() if item not in items.tolist()])
            if len(others):
                assert all(
                    map(torch.equal, fields(inside.take(others)), fields(state.take(others)))
                )
        state = whole


CHECK = """
import torch
from test_planning import NEWTON, made
cost, x0, bounds = made("waves", torch.Generator().manual_seed(0))
print(NEWTON.minimise(cost, x0[:12], bounds).cost.nan_to_num(posinf=0.0).sum().item())
"""

BITS = """
import sys, torch
sys.path[:0] = sys.argv[1:]
from test_planning import NEWTON, made
found = NEWTON.minimise(*made("body34", torch.Generator().manual_seed(0)))
tell([part.numpy().tobytes() for part in found])
"""


def in_a_process(text: str, **variables: str) -> str:
    """What a program prints in a process of its own."""
    here = Path(__file__).parent
    paths = os.pathsep.join([str(here), str(here.parent), str(here.parents[1])])
    environment = {**os.environ, "PYTHONPATH": paths, **variables}
    run = [sys.executable, "-c", text]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_no_index_is_out_of_range(generator):
    found = in_a_process(CHECK, TORCHCSS_CHECK_KERNELS="1")
    cost, x0, bounds = made("waves", generator)
    expected = NEWTON.minimise(cost, x0[:12], bounds).cost.nan_to_num(posinf=0.0).sum()
    assert float(found) == pytest.approx(float(expected), abs=1e-6)


def test_a_process_that_compiles_finds_what_one_with_a_cache_finds(tmp_path):
    found = []
    for _ in range(2):
        begun = begin(BITS, str(Path(__file__).parent), TORCHCSS_CACHE=str(tmp_path))
        found.append(begun.told.recv())
        assert begun.end() == 0
    assert list(tmp_path.rglob("*advance*")), "the first process has compiled"
    assert found[0] == found[1]
