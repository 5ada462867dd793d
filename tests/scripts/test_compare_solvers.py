"""The comparison of solvers in its small mode, and the peers' problem against ours."""

from __future__ import annotations

import importlib
import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.robust import Lorentzian, Quadratic


def small(script: ModuleType, **options):
    return script.Config(starts=20, subset=3, repeats=1, cores=1, **options)


def test_small_mode(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("scipy")
    out = tmp_path / "tables" / "solvers.json"
    names = (script.OURS, script.EAGER, script.TRF)
    script.main(small(script, solvers=names, out=out))
    report = json.loads(out.read_text())
    assert set(report["solvers"]) == set(names)
    ours, trf = report["solvers"][script.OURS], report["solvers"][script.TRF]
    assert (ours["solves"], trf["solves"]) == (20, 3)
    assert ours["converged"] >= 0.95
    assert ours["ours_lower"] == ours["ours_higher"] == 0
    assert ours["cost_quantiles"] == sorted(ours["cost_quantiles"])
    for row in report["solvers"].values():
        assert row["solves_per_second"] > 0
        assert row["steps_mean"] > 1
    ratio = report["our_rate_over_theirs"]["scipy trf, core"]
    assert ratio == [ours["core"][0] / trf["core"][0]]
    printed = capsys.readouterr().out
    assert all(name in printed for name in names)


def test_absent_libraries_are_left_out(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    absent = ("scipy", "jax")
    monkeypatch.setattr(
        script.importlib.util, "find_spec", lambda name: None if name in absent else find(name)
    )
    asked: list[str] = []

    def measure(config, names):
        asked.extend(names)
        return {name: [[script.run(config, name, 0)]] for name in names}

    monkeypatch.setattr(script, "measure", measure)
    report = script.main(small(script))
    assert asked == list(report["solvers"]) == [script.OURS, script.EAGER]


@pytest.mark.parametrize("potential", ["quadratic", "lorentzian"])
@pytest.mark.parametrize("body", ["arm8", "body34"])
def test_the_peers_have_our_cost(script: ModuleType, body: str, potential: str) -> None:
    pytest.importorskip("scipy")
    from peers.numpy_problem import NumpyProblem

    config = script.Config(body=body, potential=potential, starts=3, cores=1)
    problem = script.make_problem(config)
    assert isinstance(problem.cost.potential, Quadratic if potential == "quadratic" else Lorentzian)
    starts = script.make_starts(config, problem)[0]
    want = problem.cost.local_model(starts)
    peer = NumpyProblem(problem.cost)
    for i, x in enumerate(starts.numpy()):
        value, gradient = peer.value_and_gradient(x)
        assert value == pytest.approx(float(want.value[i]), rel=1e-9)
        scale = float(want.gradient[i].abs().max())
        np.testing.assert_allclose(gradient, want.gradient[i].numpy(), rtol=0, atol=1e-9 * scale)


@pytest.mark.parametrize("potential", ["quadratic", "lorentzian"])
def test_jax_has_the_residuals_of_numpy(script: ModuleType, potential: str) -> None:
    pytest.importorskip("scipy")
    pytest.importorskip("jax")
    from peers.jax_lm import JaxLevenbergMarquardt
    from peers.numpy_problem import NumpyProblem

    config = script.Config(body="arm8", potential=potential, starts=3, cores=1)
    problem = script.make_problem(config)
    solver, peer = JaxLevenbergMarquardt(problem.cost), NumpyProblem(problem.cost)
    x = script.make_starts(config, problem)[0, 0].numpy()
    residual, jacobian = solver.residuals(x)
    np.testing.assert_allclose(residual, peer.residuals(x), rtol=1e-9, atol=1e-9)
    want = peer.jacobian(x)
    np.testing.assert_allclose(jacobian, want, rtol=0, atol=1e-9 * np.abs(want).max())


def test_jax_descends(script: ModuleType) -> None:
    pytest.importorskip("jax")
    config = small(script, body="arm8")
    problem = script.make_problem(config)
    x0 = script.make_starts(config, problem)[0]
    result = script.run(config, script.COMPACTED, 0)
    lower, upper = problem.bounds
    x = torch.from_numpy(result["x"])
    assert bool(((x >= lower) & (x <= upper)).all())
    assert bool((problem.cost.value(x) <= problem.cost.value(x0)).all())
    polished = TrustRegionNewton().minimise(problem.cost, x, problem.bounds).cost
    # Gauss-Newton slows down in curved valleys, and its promises fall faster than what is left.
    assert bool((problem.cost.value(x) < polished + 0.05).all())
