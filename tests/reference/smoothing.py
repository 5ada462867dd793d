"""Plain twins of `torchcss.inference.smoothing`: all paths one by one, one dense least squares."""

from __future__ import annotations

import itertools
import math

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import multivariate_normal


def path_cost(
    path: tuple[int, ...],
    mean: np.ndarray,
    covariance: np.ndarray | None,
    cost: np.ndarray,
    times: np.ndarray,
    velocity: np.ndarray,
) -> float:
    """Negative log of a path: costs, and the densities of its motions relative to none."""
    n, total = mean.shape[-1], 0.0
    nothing = np.zeros((n, n))
    x = [mean[t, k] for t, k in enumerate(path)]
    spread = [nothing if covariance is None else covariance[t, k] for t, k in enumerate(path)]
    for t, k in enumerate(path):
        if np.isfinite(cost[t]).any():
            total += cost[t, k]
        if t >= 1:
            motion = np.diag((velocity * (times[t] - times[t - 1])) ** 2)
            total += surprise(x[t] - x[t - 1], motion, spread[t] + spread[t - 1])
    return total


def surprise(apart: np.ndarray, motion: np.ndarray, wide: np.ndarray) -> float:
    """Negative log density, without what it is where modes are points and do not move."""
    if not wide.any():
        return 0.5 * float((apart**2 / np.diag(motion)).sum())
    zero = np.zeros(len(apart))
    density = multivariate_normal(zero, motion + wide).logpdf(apart)  # type: ignore[arg-type]
    still = multivariate_normal(zero, motion).logpdf(zero)  # type: ignore[arg-type]
    return float(still - density)


def all_paths(
    mean: np.ndarray,
    covariance: np.ndarray | None,
    cost: np.ndarray,
    *arguments: np.ndarray,
) -> tuple[tuple[int, ...], float]:
    """The best of all paths, each one tried."""
    t, k = cost.shape
    trials = {
        path: path_cost(path, mean, covariance, cost, *arguments)  # type: ignore[arg-type]
        for path in itertools.product(range(k), repeat=t)
    }
    best = min(trials, key=lambda path: trials[path])
    return best, trials[best]


def least_squares(
    mean: np.ndarray,
    precision: np.ndarray,
    times: np.ndarray,
    velocity: np.ndarray,
    acceleration: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Matrix A and right-hand side b with 1/2 |A x - b|^2 the whole sum, x all states in a row."""
    t, n = mean.shape
    rows, right = [], []

    def add(parts: dict[int, np.ndarray], value: np.ndarray) -> None:
        row = np.zeros((len(value), t * n))
        for index, matrix in parts.items():
            row[:, index * n : (index + 1) * n] = matrix
        rows.append(row)
        right.append(value)

    for i in range(t):
        values, vectors = np.linalg.eigh(precision[i])
        root = np.sqrt(values.clip(min=0))[:, None] * vectors.T
        add({i: root}, root @ mean[i])
        step = times[i] - times[i - 1] if i else math.nan
        if i >= 1:
            scale = np.diag(1 / (velocity * step))
            add({i: scale, i - 1: -scale}, np.zeros(n))
        if i >= 2:
            before = times[i - 1] - times[i - 2]
            ratio = step / before
            scale = np.diag(1 / (acceleration * step * (step + before) / 2))
            add(
                {i: scale, i - 1: -(1 + ratio) * scale, i - 2: ratio * scale},
                np.zeros(n),
            )
    return np.concatenate(rows), np.concatenate(right)


def bounded(
    matrix: np.ndarray, right: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """The least squares within bounds, by SciPy."""
    found = lsq_linear(matrix, right, (lower, upper), method="bvls", tol=1e-14, max_iter=2000)
    assert found.success
    return found.x


def weights_over_paths(
    mean: np.ndarray, covariance: np.ndarray, cost: np.ndarray, *arguments: np.ndarray, power: float
) -> np.ndarray:
    """Weights of the modes of every frame: sums over all paths through each."""
    t, k = cost.shape
    paths = list(itertools.product(range(k), repeat=t))
    costs = np.array([path_cost(path, mean, covariance, cost, *arguments) for path in paths])
    likely = np.exp(-power * (costs - costs.min()))
    weights = np.array(
        [
            [sum(likely[i] for i, path in enumerate(paths) if path[f] == m) for m in range(k)]
            for f in range(t)
        ]
    )
    return weights / weights.sum(1, keepdims=True)
