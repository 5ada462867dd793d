"""The package's optimiser against SciPy and JAX: same objective, same starts, same machine.

    python scripts/compare_solvers.py --out compare_solvers.json

One reprojection problem (`torchcss.studies.reprojection`: 34 parameters, 22 joints in one image,
sticky priors, joint limits) is descended from random starts by

* `torchcss`: `TrustRegionNewton` on the closed-form cost, both compiled where numba is, without
  the covariances at the ends, which the others do not find either;
* `torchcss, torch cost`: the same on the cost in torch;
* `scipy trf`: `scipy.optimize.least_squares` with bounds and an analytic Jacobian;
* `scipy L-BFGS-B`, which gets value and gradient;
* `jax`: Levenberg-Marquardt, jitted and vmapped (`peers/jax_lm.py`), and `jax compacted`, the same
  with finished items dropped. Compiling is not counted.

Solvers whose library is not installed are left out.

The SciPy solvers take a few of the starts, and their rate is extrapolated. Every solver runs in as
many single-threaded processes as there are cores, so that none gains by how well its libraries use
threads; within a repeat they take turns, and ratios are taken within repeats. Rates are per second
of the clock and, steadier on a busy machine, per second of processor time on one core.

A start counts as converged if the largest entry of the projected gradient fell to a millionth of
the start's. Ours gets a tolerance that reaches this, which takes it half a step more; the peers
keep theirs: SciPy its defaults, JAX a promised decrease of 1e-6 nats. The Lorentzian is so flat far
out that a millionth of the slope there is a strict measure. Costs are those of `ReprojectionCost`
at the states returned.
"""

from __future__ import annotations

import importlib.util
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

# Before the libraries load; the processes that are started inherit it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault(
    "XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import numpy as np
import torch
from common import Table, finish, start
from peers.compiled_reprojection import CompiledReprojection
from torch import Tensor

from torchcss.errors import ConfigurationError
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.kernels import compiler
from torchcss.linalg import covariance_factor
from torchcss.robust import Lorentzian, Quadratic
from torchcss.studies.reprojection import ReprojectionProblem, reprojection_problem
from torchcss.types import frozen

OURS, EAGER = "torchcss", "torchcss, torch cost"
TRF, LBFGS, JAX, COMPACTED = "scipy trf", "scipy L-BFGS-B", "jax", "jax compacted"
LIBRARY = {
    OURS: "torch",
    EAGER: "torch",
    TRF: "scipy",
    LBFGS: "scipy",
    JAX: "jax",
    COMPACTED: "jax",
}
QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
CONVERGED = 1e-6  # Largest entry of the projected gradient over that of the start.


@frozen
class Config:
    """The problem, the starts, and how much work the solvers get."""

    body: str = "body34"
    """Body of the catalogue."""
    potential: Literal["quadratic", "lorentzian"] = "quadratic"
    """Reprojection error."""
    pixel_noise: float = 1.0
    """Noise of the image joints, pixels."""
    spread: float = 0.6
    """Standard deviation of the starts about the truth, radians and metres; 0: samples of the start
    mode's covariance at eight times its standard deviations."""
    starts: int = 1000
    """Starts per process."""
    subset: int = 20
    """How many of these the SciPy solvers take."""
    repeats: int = 3
    """Interleaved repeats, after one that is not counted."""
    cores: int = 2
    """Processes."""
    radius: float = 0.5
    """First and greatest trust radius of ours, radians. Half a radian follows the way down closely
    enough to end as low as the others do; the default of one saves a sixth of the steps."""
    solvers: tuple[str, ...] = tuple(LIBRARY)
    """Which solvers."""
    seed: int = 0
    """Seed of the problem and of the starts."""
    out: Path | None = None
    """JSON file to write."""


def make_problem(config: Config) -> ReprojectionProblem:
    robust = Lorentzian(nu=8.0, sigma=8.0**0.5)
    return reprojection_problem(
        config.body,
        generator=torch.Generator().manual_seed(config.seed),
        pixel_noise=config.pixel_noise,
        potential=Quadratic() if config.potential == "quadratic" else robust,
    )


def make_starts(config: Config, problem: ReprojectionProblem) -> Tensor:
    """All starts, `[cores starts n]`, inside the limits."""
    generator = torch.Generator().manual_seed(config.seed + 1)
    shape = (config.cores, config.starts, len(problem.truth))
    z = torch.randn(shape, generator=generator, dtype=problem.truth.dtype)
    if config.spread:
        return problem.bounds.project(problem.truth + config.spread * z)
    factor = covariance_factor(problem.start.covariance)
    return problem.bounds.project(problem.start.mean + 8 * z @ factor.T)


_SOLVERS: dict[tuple[Config, str], Any] = {}  # Kept by every process, because JAX compiles.


def make_solver(config: Config, problem: ReprojectionProblem, name: str) -> Any:
    """A function from starts to states and iterations."""
    if name in (OURS, EAGER):
        newton = TrustRegionNewton(max_steps=200, tolerance=1e-12, initial_radius=config.radius)
        compiled = name == OURS and compiler.AVAILABLE
        cost = CompiledReprojection.of(problem.cost) if compiled else problem.cost

        def ours(x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            ends = newton.descend(cost, newton.start(torch.from_numpy(x0)), problem.bounds)
            return ends.x.numpy(), ends.num_steps.numpy()

        return ours
    if name in (JAX, COMPACTED):
        from peers.jax_lm import JaxLevenbergMarquardt

        return JaxLevenbergMarquardt(problem.cost, compacted=name == COMPACTED)
    from peers.numpy_problem import NumpyProblem

    peer = NumpyProblem(problem.cost)
    return lambda x0: peer.solve(x0, "trf" if name == TRF else "L-BFGS-B")


def run(config: Config, name: str, part: int) -> dict[str, Any]:
    """One solver on the starts of one process."""
    torch.set_num_threads(1)
    problem = make_problem(config)
    solver = _SOLVERS.setdefault((config, name), make_solver(config, problem, name))
    x0 = make_starts(config, problem)[part].numpy()
    x0 = x0[: config.subset] if name in (TRF, LBFGS) else x0
    wall, processor = time.perf_counter(), time.process_time()
    x, steps = solver(x0)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    return {"x": x, "steps": steps, "wall": wall, "processor": processor}


def measure(config: Config, names: list[str]) -> dict[str, list[list[dict[str, Any]]]]:
    """What every process returned, by solver and repeat."""
    spawn = get_context("spawn")
    pools = [ProcessPoolExecutor(1, mp_context=spawn) for _ in range(config.cores)]
    rounds: dict[str, list[list[dict[str, Any]]]] = {name: [] for name in names}
    for _ in range(1 + config.repeats):
        for name in names:
            tasks = [pool.submit(run, config, name, part) for part, pool in enumerate(pools)]
            rounds[name].append([task.result() for task in tasks])
    for pool in pools:
        pool.shutdown()
    return {name: results[1:] for name, results in rounds.items()}


def quality(problem: ReprojectionProblem, x0: Tensor, parts: list[dict[str, Any]]) -> Any:
    """Costs of the states reached and which of them converged."""
    taken = x0[:, : len(parts[0]["x"])].flatten(0, 1)
    x = torch.from_numpy(np.concatenate([part["x"] for part in parts]))
    slopes = [
        (problem.bounds.project(at - gradient) - at).abs().amax(-1)
        for at in (taken, x)
        for gradient in (problem.cost.local_model(at).gradient,)
    ]
    return problem.cost.value(x).numpy(), (slopes[1] < CONVERGED * slopes[0]).numpy()


def main(config: Config) -> dict[str, Any]:
    """Measure, print, write; return what is written."""
    if unknown := sorted(set(config.solvers) - set(LIBRARY)):
        raise ConfigurationError(f"no solvers {unknown}; there are {', '.join(LIBRARY)}")
    if OURS not in config.solvers:
        raise ConfigurationError(f"solvers: all are compared with {OURS}; name it too")
    names = [name for name in config.solvers if importlib.util.find_spec(LIBRARY[name])]
    problem = make_problem(config)
    x0 = make_starts(config, problem)
    rounds = measure(config, names)
    reached = {name: quality(problem, x0, results[-1]) for name, results in rounds.items()}
    ours = reached[OURS][0].reshape(config.cores, -1)
    rows, ratios = {}, {}
    for name, results in rounds.items():
        cost, converged = reached[name]
        solves = len(cost)
        wall = [solves / max(part["wall"] for part in parts) for parts in results]
        core = [solves / sum(part["processor"] for part in parts) for parts in results]
        steps = np.concatenate([part["steps"] for part in results[-1]])
        same = ours[:, : solves // config.cores].ravel()
        slack = 1e-3 * np.maximum(1, cost)
        rows[name] = {
            "solves": solves,
            "solves_per_second": float(np.median(wall)),
            "solves_per_core_second": float(np.median(core)),
            "steps_mean": float(steps.mean()),
            "steps_quantiles": np.quantile(steps, (0.5, 0.9, 1.0)).tolist(),
            "converged": float(converged.mean()),
            "cost_quantiles": np.quantile(cost, QUANTILES).tolist(),
            "our_cost_quantiles_there": np.quantile(same, QUANTILES).tolist(),
            "ours_lower": float((same < cost - slack).mean()),
            "ours_higher": float((same > cost + slack).mean()),
            "wall": wall,
            "core": core,
        }
    for name in names:
        for rate in ("wall", "core"):
            pairs = zip(rows[OURS][rate], rows[name][rate], strict=True)
            ratios[f"{name}, {rate}"] = [mine / theirs for mine, theirs in pairs]
    report = {"solvers": rows, "our_rate_over_theirs": ratios, "config": config}
    return finish(config.out, report, table_of(report))


def table_of(report: dict[str, Any]) -> Table:
    """The solvers' rates and what they reach, and what ours reaches from the same starts."""
    rows: list[list[str | float | None]] = []
    for name, row in report["solvers"].items():
        ratio = float(np.median(report["our_rate_over_theirs"][f"{name}, core"]))
        rates = (row["solves_per_second"], row["solves_per_core_second"], ratio)
        reached = (row["steps_mean"], row["converged"], *row["cost_quantiles"])
        rows.append([name, *rates, *reached, row["ours_lower"], row["ours_higher"]])
        there = row["our_cost_quantiles_there"]
        rows.append(["ours from the same starts", *[None] * 5, *there, None, None])
    columns = (
        *("solver", "solves per second", "per processor second", "ours is", "steps", "converged"),
        *(f"cost, {100 * q:.0f} %" for q in QUANTILES),
        *("ours lower", "ours higher"),
    )
    return Table("The optimiser", columns, rows)


if __name__ == "__main__":
    start(main, Config, __doc__)
