"""The study problem's cost in compiled kernels is that of torch."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from peers.compiled_reprojection import CompiledReprojection

from torchcss.errors import ConfigurationError
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.kernels import compiler
from torchcss.robust import Leclerc, Lorentzian, Quadratic
from torchcss.studies.reprojection import ReprojectionProblem, reprojection_problem
from torchcss.types import BlendedCost

pytestmark = pytest.mark.skipif(not compiler.COMPILED, reason="numba is not installed")

ROBUST = Lorentzian(nu=8.0, sigma=8.0**0.5)


def made(body="body34", **options) -> tuple[ReprojectionProblem, torch.Tensor]:
    """A problem and states, in some of which joints are behind the camera."""
    generator = torch.Generator().manual_seed(0)
    problem = reprojection_problem(body, generator=generator, **options)
    z = torch.randn(3, 8, len(problem.truth), generator=generator, dtype=torch.float64)
    x = problem.truth + 0.6 * z
    if body == "body34":
        x[0, :4, problem.cost.body.state_index("root_z")] = 3.4
    return problem, x


@pytest.mark.parametrize("body", ["body34", "arm8"])
@pytest.mark.parametrize("potential", [Quadratic(), ROBUST, Leclerc(nu=8.0, sigma=2.0)])
def test_it_is_the_cost_in_torch(body, potential) -> None:
    problem, x = made(body, potential=potential, pixel_noise=2.0)
    cost = CompiledReprojection.of(problem.cost)
    assert isinstance(cost, BlendedCost)
    share = torch.linspace(0, 1, 24, dtype=torch.float64).reshape(3, 8)
    pairs = [
        (cost.local_model(x), problem.cost.local_model(x)),
        (cost.blended_model(x, share), problem.cost.blended_model(x, share)),
    ]
    for ours, theirs in pairs:
        for got, want in zip(ours, theirs, strict=True):
            assert got.shape == want.shape
            assert float((got - want).abs().max()) < 1e-12 * float(want.abs().max())
    torch.testing.assert_close(cost.value(x), problem.cost.value(x), rtol=1e-12, atol=0)


def test_no_state_depends_on_another() -> None:
    problem, x = made()
    cost, x = CompiledReprojection.of(problem.cost), x.flatten(0, 1)
    whole, some = cost.local_model(x), torch.tensor([17, 3, 20])
    for part, all_of in zip(cost.local_model(x[some]), whole, strict=True):
        assert torch.equal(part, all_of[some])


def test_descents_end_where_those_in_torch_end() -> None:
    problem, x = made(potential=ROBUST)
    newton = TrustRegionNewton(initial_radius=0.5)
    ends = [
        newton.minimise(cost, x, problem.bounds)
        for cost in (problem.cost, CompiledReprojection.of(problem.cost))
    ]
    torch.testing.assert_close(ends[0].cost, ends[1].cost, rtol=0, atol=1e-4)


def test_other_potentials_are_refused() -> None:
    class Other(Quadratic):
        """Unknown to kernels."""

    problem, _ = made("arm8", potential=Other())
    with pytest.raises(ConfigurationError, match="Other has no compiled twin"):
        CompiledReprojection.of(problem.cost)


CHECK = """
from test_compiled_reprojection import CompiledReprojection, made
problem, x = made("arm8")
print(CompiledReprojection.of(problem.cost).local_model(x).hessian.sum().item())
"""


def test_no_index_is_out_of_range() -> None:
    here = Path(__file__).parent
    repository = here.parents[1]
    paths = os.pathsep.join(map(str, (here, repository, repository / "scripts")))
    environment = {**os.environ, "TORCHCSS_CHECK_KERNELS": "1", "PYTHONPATH": paths}
    run = [sys.executable, "-c", CHECK]
    done = subprocess.run(run, env=environment, capture_output=True, text=True, check=False)
    problem, x = made("arm8")
    expected = float(problem.cost.local_model(x).hessian.sum())
    assert float(done.stdout) == pytest.approx(expected, rel=1e-9), done.stderr
