import math
import weakref
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from reference import smoothing as plain

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.inference.smoothing import (
    IN_WINDOWS,
    GaussianEvidence,
    Refined,
    Refinement,
    Transition,
    Windows,
    best_path,
    mode_weights,
    refine,
    refine_in_windows,
)
from torchcss.types import Bounds, LocalModel, Status

UNBOUNDED = (-math.inf, math.inf)


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    source = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, generator=source, dtype=torch.float64)


def covariances(*shape: int, n: int, seed: int = 0) -> torch.Tensor:
    root = draw(*shape, n, n, seed=seed)
    return 0.1 * (root @ root.mT + 0.1 * torch.eye(n).double())


def uneven_times(t: int) -> torch.Tensor:
    """Frames at 25 per second of which some are missing."""
    return 0.04 * torch.tensor([1, 1, 3, 1, 2, 1] * t).cumsum(0)[:t].double()


def interval(n: int, lower: float = -math.inf, upper: float = math.inf) -> Bounds:
    return Bounds(*(torch.full((n,), end, dtype=torch.float64) for end in (lower, upper)))


# --- best path -----------------------------------------------------------------------------------


@pytest.mark.parametrize("points", [False, True], ids=["covariances", "points"])
@pytest.mark.parametrize("t", [1, 2, 5])
def test_path_is_the_best_of_all(t: int, points: bool):
    k, n, velocity = 3, 2, 4.0
    for seed in range(5):
        mean, cost = draw(t, k, n, seed=seed), 3 * draw(t, k, seed=seed + 100)
        cost[t // 2, 1] = math.inf  # a mode that is missing
        cost[t // 3] += math.inf if t > 3 else 0.0  # a frame without any
        spread = None if points else covariances(t, k, n=n, seed=seed)
        times = uneven_times(t)
        found = best_path(
            mean,
            spread,
            cost,
            times,
            Transition(velocity=(velocity, 2 * velocity)),
        )
        path, least = plain.all_paths(
            mean.numpy(),
            None if spread is None else spread.numpy(),
            cost.numpy(),
            times.numpy(),
            np.array([velocity, 2 * velocity]),
        )
        assert tuple(found.mode.tolist()) == path
        assert float(found.cost) == pytest.approx(least, rel=1e-9)


def test_path_leaves_a_mode_that_was_better_for_one_frame():
    # Two hands that pass: the cheaper mode changes once, but no body moves like that.
    mean = torch.tensor([[[0.0], [1.0]]] * 7).double()
    cost = torch.tensor([[0.0, 1]] * 3 + [[2.0, 0]] + [[0.0, 1]] * 3).double()
    times = torch.arange(7) / 25
    follow = best_path(mean, None, cost, times, Transition(velocity=3.0))
    assert follow.mode.tolist() == [0] * 7
    jump = best_path(mean, None, cost, times, Transition(velocity=300.0))
    assert jump.mode.tolist() == [0, 0, 0, 1, 0, 0, 0]


def test_a_constant_offset_by_frame_changes_nothing():
    # Costs have no zero.
    mean, cost, times = draw(6, 3, 2), 3 * draw(6, 3, seed=1), uneven_times(6)
    transition, moved = Transition(velocity=5.0), cost + draw(6, 1)
    some, other = (best_path(mean, None, each, times, transition) for each in (cost, moved))
    assert some.mode.tolist() == other.mode.tolist()
    some, other = (mode_weights(mean, None, each, times, transition) for each in (cost, moved))
    torch.testing.assert_close(some, other)


@pytest.mark.parametrize("t", [1, 2, 5])
@pytest.mark.parametrize("power", [0.15, 1.0])
def test_weights_are_sums_over_all_paths(t: int, power: float):
    k, n = 3, 2
    mean, cost, spread = draw(t, k, n), 3 * draw(t, k, seed=1), covariances(t, k, n=n)
    cost[t // 2, 1] = math.inf  # a mode that is missing
    cost[t // 3] += math.inf if t > 3 else 0.0  # a frame without any
    times, velocity = uneven_times(t), np.array([4.0, 8.0])
    found = mode_weights(mean, spread, cost, times, Transition(velocity=(4.0, 8.0)), power=power)
    arguments = (mean.numpy(), spread.numpy(), cost.numpy(), times.numpy(), velocity)
    expected = plain.weights_over_paths(*arguments, power=power)
    np.testing.assert_allclose(found.exp().numpy(), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weights_in_any_type_and_with_padded_modes(dtype: torch.dtype):
    t, k, n = 6, 3, 2
    mean, spread, cost = (
        part.to(dtype) for part in (draw(t, k, n), covariances(t, k, n=n), draw(t, k, seed=3))
    )
    times, transition = uneven_times(t), Transition(velocity=3.0)
    alone = mode_weights(mean, spread, cost, times, transition, power=0.15)
    assert alone.dtype == dtype
    torch.testing.assert_close(alone.exp().sum(1), torch.ones(t, dtype=dtype))
    padded = mode_weights(
        torch.cat([mean, torch.zeros(t, 2, n, dtype=dtype)], 1),
        torch.cat([spread, torch.zeros(t, 2, n, n, dtype=dtype)], 1),
        torch.cat([cost, torch.full((t, 2), math.inf, dtype=dtype)], 1),
        times,
        transition,
        power=0.15,
    )
    torch.testing.assert_close(padded[:, :k], alone)
    assert bool((padded[:, k:] == -math.inf).all())


def test_weights_forget_what_a_path_adds_up():
    # One mode is cheaper by a nat in every frame: the best path never leaves it, however small a
    # share of it is new; the weights do, as far as motions between the modes are possible.
    mean = torch.tensor([[[0.0], [0.1]]] * 50).double()
    cost = torch.tensor([[0.0, 1.0]] * 50).double()
    times, transition = torch.arange(50) / 25, Transition(velocity=2.5)
    assert best_path(mean, None, cost, times, transition).mode.tolist() == [0] * 50
    weights = mode_weights(mean, None, cost, times, transition, power=0.15).exp()
    assert 0.5 < float(weights[25, 0]) < 0.7
    certain = mode_weights(mean, None, cost, times, transition, power=20.0).exp()
    assert float(certain[25, 0]) > 0.999


def test_differences_of_angles_go_the_short_way():
    angle = torch.tensor([3.0, 3.1, -3.1, -3.0]).double()
    mean = torch.stack([angle, angle.flip(0) * 0.5 + 1.0], dim=1)[..., None]
    cost = torch.tensor([[0.0, 2]] * 4).double()
    arguments = (mean, None, cost, torch.arange(4) / 25, Transition(velocity=4.0))
    turning = best_path(*arguments, period=torch.tensor([2 * math.pi]))
    assert turning.mode.tolist() == [0, 0, 0, 0]
    assert best_path(*arguments).mode.tolist() != [0, 0, 0, 0]


def test_path_does_not_depend_on_the_coordinates():
    t, k, n = 6, 3, 2
    mean, spread, cost = draw(t, k, n), covariances(t, k, n=n), draw(t, k, seed=3)
    transition = Transition(velocity=3.0)
    same = best_path(mean, spread, cost, uneven_times(t), transition)
    # From frame 3 on, everything is seen from elsewhere and turned: isotropic motions stay so.
    turn, shift = torch.linalg.qr(draw(n, n, seed=5)).Q, draw(n, seed=6)
    mean[3:], spread[3:] = mean[3:] @ turn.T + shift, turn @ spread[3:] @ turn.T
    moved = best_path(
        mean, spread, cost, uneven_times(t), transition, changes={2: lambda x: x @ turn.T + shift}
    )
    assert moved.mode.tolist() == same.mode.tolist()
    assert float(moved.cost) == pytest.approx(float(same.cost))


def test_path_of_padded_modes_is_that_without_them():
    t, k, n = 6, 3, 2
    mean, spread, cost = draw(t, k, n), covariances(t, k, n=n), draw(t, k, seed=3)
    transition = Transition(velocity=3.0)
    alone = best_path(mean, spread, cost, uneven_times(t), transition)
    padded = best_path(
        torch.cat([mean, torch.zeros(t, 2, n)], 1),
        torch.cat([spread, torch.zeros(t, 2, n, n)], 1),
        torch.cat([cost, torch.full((t, 2), math.inf)], 1),
        uneven_times(t),
        transition,
    )
    assert padded.mode.tolist() == alone.mode.tolist()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_path_in_any_type_and_again(dtype: torch.dtype):
    mean, spread, cost = (
        part.to(dtype) for part in (draw(8, 4, 3), covariances(8, 4, n=3), draw(8, 4))
    )
    transition, times = Transition(velocity=5.0), uneven_times(8)
    paths = [best_path(mean, spread, cost, times, transition) for _ in range(2)]
    assert torch.equal(paths[0].mode, paths[1].mode)
    double = best_path(mean.double(), spread.double(), cost.double(), times, transition)
    assert torch.equal(paths[0].mode, double.mode)


def test_bad_paths_are_refused():
    mean, cost, times = draw(4, 2, 3), draw(4, 2), uneven_times(4)
    transition = Transition(velocity=1.0)
    with pytest.raises(ShapeError, match="cost"):
        best_path(mean, None, cost[:3], times, transition)
    with pytest.raises(ShapeError, match="NaN"):
        best_path(mean, None, cost * math.nan, times, transition)
    with pytest.raises(ShapeError, match="expected finite"):
        best_path(mean / 0, None, cost, times, transition)
    with pytest.raises(ConfigurationError, match="times that increase"):
        best_path(mean, None, cost, times.flip(0), transition)
    with pytest.raises(ConfigurationError, match="power"):
        mode_weights(mean, None, cost, times, transition, power=0.0)
    with pytest.raises(ConfigurationError, match="velocities alone"):
        best_path(mean, None, cost, times, Transition(acceleration=50.0))
    with pytest.raises(ConfigurationError, match="velocity"):
        Transition(velocity=0.0)
    with pytest.raises(ConfigurationError, match="acceleration"):
        Transition(acceleration=(1.0, -1.0))


# --- refinement ----------------------------------------------------------------------------------


def gaussian(t: int, n: int) -> GaussianEvidence:
    evidence = GaussianEvidence.of_modes(draw(t, n, seed=0), covariances(t, n=n, seed=1))
    if t > 4:
        evidence.precision[2] = 0.0  # a frame that says nothing
    return evidence


def dense(evidence: GaussianEvidence, times: torch.Tensor, velocity: float, acceleration: float):
    n = evidence.mean.shape[-1]
    return plain.least_squares(
        evidence.mean.numpy(),
        evidence.precision.numpy(),
        times.numpy(),
        np.full(n, velocity),
        np.full(n, acceleration),
    )


@pytest.mark.parametrize("limits", [UNBOUNDED, (-0.5, 0.4), (0.0, 0.1)])
@pytest.mark.parametrize(
    ("velocity", "acceleration"), [(4.0, math.inf), (math.inf, 60.0), (6.0, 20.0)]
)
@pytest.mark.parametrize("t", [1, 2, 3, 12])
def test_gaussian_refinement_is_the_bounded_least_squares(
    t: int, velocity: float, acceleration: float, limits: tuple[float, float]
):
    n, times = 3, uneven_times(t)
    evidence = gaussian(t, n)
    found = refine(
        evidence,
        torch.zeros(t, n).double(),
        times,
        Transition(velocity=velocity, acceleration=acceleration),
        interval(n, *limits),
    )
    matrix, right = dense(evidence, times, velocity, acceleration)
    exact = plain.bounded(matrix, right, *(np.full(t * n, limit) for limit in limits))
    assert found.mean.flatten().numpy() == pytest.approx(exact, abs=1e-7)
    assert bool((found.mean >= limits[0]).all())
    assert bool((found.mean <= limits[1]).all())
    residual = matrix @ exact - right
    assert float(found.total) == pytest.approx(0.5 * residual @ residual, rel=1e-9)
    assert int(found.status) == Status.CONVERGED
    if limits != UNBOUNDED:
        assert bool(found.active.any())

    free = ~found.active.flatten().numpy()
    prior = 1.0 if limits == UNBOUNDED else ((limits[1] - limits[0]) / 4) ** 2
    told = matrix.T @ matrix + np.eye(t * n) / prior
    inverse = np.zeros((t * n, t * n))
    inverse[np.ix_(free, free)] = np.linalg.inv(told[np.ix_(free, free)])
    for frame in range(t):
        rows = slice(frame * n, (frame + 1) * n)
        expected = inverse[rows, rows] + np.diag(np.where(free[rows], 0.0, prior))
        assert found.covariance[frame].numpy() == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_covariances_keep_their_digits_over_a_long_stiff_chain():
    # Double integrators make the recursions of smoothers unstable: see BandFactor.
    t, n, times = 60, 2, torch.arange(60).double() / 60
    evidence = gaussian(t, n)
    found = refine(evidence, evidence.mean, times, Transition(acceleration=0.3), interval(n))
    matrix, _ = dense(evidence, times, math.inf, 0.3)
    # The prior of the covariances is one in each parameter.
    inverse = np.linalg.inv(matrix.T @ matrix + np.eye(t * n))
    for frame in range(t):
        rows = slice(frame * n, (frame + 1) * n)
        assert found.covariance[frame].numpy() == pytest.approx(inverse[rows, rows], rel=1e-6)


def test_singular_covariances_hold_what_they_know():
    covariance = covariances(5, n=3)
    covariance[:, 1] = covariance[:, :, 1] = 0.0
    mean = draw(5, 3)
    evidence = GaussianEvidence.of_modes(mean, covariance)
    assert bool(evidence.precision.isfinite().all())
    found = refine(evidence, mean + 0.1, uneven_times(5), Transition(velocity=2.0), interval(3))
    assert found.mean[:, 1].numpy() == pytest.approx(mean[:, 1].numpy(), abs=1e-6)
    assert bool(found.covariance.isfinite().all())


def test_steady_motion_stays_and_fills_the_frames_that_say_nothing():
    t, times = 9, uneven_times(9)
    mean = torch.stack([1.0 + 2 * times, 0.5 - times], dim=1)
    seen = torch.ones(t, dtype=torch.bool)
    seen[3:6] = False
    covariance = covariances(t, n=2)
    evidence = GaussianEvidence.of_modes(mean, covariance, seen=seen)
    lost = mean.clone()
    lost[~seen] = 7.0
    found = refine(evidence, lost, times, Transition(acceleration=5.0), interval(2))
    assert found.mean.numpy() == pytest.approx(mean.numpy(), abs=1e-6)
    everything = GaussianEvidence.of_modes(mean, covariance)
    known = refine(everything, mean, times, Transition(acceleration=5.0), interval(2))
    less = torch.linalg.eigvalsh(found.covariance - known.covariance)
    assert bool((less > 0).all())


def test_smoothing_does_not_depend_on_the_frame_rate():
    # Errors persist over frames, so that more of them are not more evidence (see the page).
    found = []
    for rate in (60, 240):
        times = torch.arange(2 * rate + 1).double() / rate
        mean = (6.0 * times).sin()[:, None]
        evidence = GaussianEvidence(mean, torch.full((len(times), 1, 1), 100.0).double())
        smooth = refine(evidence, mean, times, Transition(acceleration=3.0), interval(1))
        found.append(smooth.mean[:: rate // 60])
    coarse, fine = (smooth[40:-40].numpy() for smooth in found)  # away from the ends
    assert coarse.max() < 0.7  # it is smoothed at all
    assert coarse == pytest.approx(fine, abs=0.003)


@pytest.mark.parametrize("shape", [(), (4,)])
def test_equal_bounds_hold_frames(shape: tuple[int, ...]):
    t, n = 6, 4
    evidence, start = gaussian(t, n), draw(t, n, seed=9)
    lower, upper = start.clone(), start.clone()
    lower[2:5], upper[2:5] = -math.inf, math.inf
    found = refine(evidence, start, uneven_times(t), Transition(velocity=3.0), Bounds(lower, upper))
    fixed = torch.tensor([0, 1, 5])
    assert torch.equal(found.mean[fixed], start[fixed])
    assert not torch.equal(found.mean[2:5], start[2:5])
    assert bool(found.active[fixed].all())
    assert not bool(found.active[2:5].any())


def test_a_frame_held_by_equal_bounds_leaves_the_others_their_covariances():
    t, n = 6, 3
    evidence, start, motion = gaussian(t, n), draw(t, n, seed=9), Transition(velocity=9.0)
    bounds = Bounds(*(torch.full((t, n), end, dtype=torch.float64) for end in (-8.0, 8.0)))
    free = refine(evidence, start, uneven_times(t), motion, bounds)
    bounds.lower[0] = bounds.upper[0] = start[0]
    held = refine(evidence, start, uneven_times(t), motion, bounds)
    far = slice(3, None)  # the frames next to it know where it is
    torch.testing.assert_close(held.covariance[far], free.covariance[far], rtol=0.05, atol=1e-3)
    torch.testing.assert_close(held.covariance[0], 16 * torch.eye(n).double())


class Wells:
    """A cost per frame with many minima and saddles, whose Hessian is often indefinite."""

    def value(self, x: torch.Tensor) -> torch.Tensor:
        return self.local_model(x).value

    def local_model(self, x: torch.Tensor) -> LocalModel:
        value = (3 * x).cos().sum(-1) + 0.05 * x.square().sum(-1)
        curvature = torch.diag_embed(-9 * (3 * x).cos() + 0.1)
        return LocalModel(value, -3 * (3 * x).sin() + 0.1 * x, curvature)


@pytest.mark.parametrize("limits", [UNBOUNDED, (-0.7, 0.9)])
def test_refinement_of_a_cost_with_saddles_ends_in_a_minimum(limits: tuple[float, float]):
    t, n, times, start = 7, 3, uneven_times(7), draw(7, 3, seed=4).clamp(*limits)
    found = refine(
        Wells(),
        start,
        times,
        Transition(velocity=8.0, acceleration=90.0),
        interval(n, *limits),
        choice=Refinement(tolerance=1e-12),
    )
    nothing = GaussianEvidence(torch.zeros(t, n).double(), torch.zeros(t, n, n).double())
    matrix, _ = (torch.from_numpy(part) for part in dense(nothing, times, 8.0, 90.0))

    def total(x: torch.Tensor) -> torch.Tensor:
        return Wells().value(x).sum() + 0.5 * (matrix @ x.flatten()).square().sum()

    assert float(found.total) == pytest.approx(float(total(found.mean)))
    assert float(found.total) < float(total(start))
    gradient = torch.autograd.functional.jacobian(total, found.mean)
    assert isinstance(gradient, torch.Tensor)
    assert float(gradient[~found.active].abs().max()) < 1e-5
    hessian = torch.autograd.functional.hessian(total, found.mean)
    assert isinstance(hessian, torch.Tensor)
    free = ~found.active.flatten()
    values = torch.linalg.eigvalsh(hessian.reshape(t * n, t * n)[free][:, free])
    assert float(values.min()) > 0
    assert int(found.status) in (Status.CONVERGED, Status.SMALL_STEP)
    assert bool((torch.linalg.eigvalsh(found.covariance) > 0).all())


def to_polar(x: torch.Tensor) -> torch.Tensor:
    return torch.stack([x.norm(dim=-1), torch.atan2(x[..., 1], x[..., 0])], dim=-1)


@pytest.mark.parametrize("acceleration", [math.inf, 40.0])
def test_refinement_across_a_change_of_coordinates(acceleration: float):
    t, times = 7, uneven_times(7)
    flat = torch.stack([2 + times, 1 + 0.5 * times], dim=1) + 0.1 * draw(t, 2)
    mean = flat.clone()
    mean[4:] = to_polar(flat[4:])
    evidence = GaussianEvidence.of_modes(mean, 0.1 * covariances(t, n=2))
    found = refine(
        evidence,
        mean,
        times,
        Transition(velocity=3.0, acceleration=acceleration),
        interval(2),
        choice=Refinement(tolerance=1e-12),
        changes={3: to_polar},
    )

    def total(x: torch.Tensor) -> torch.Tensor:
        # The states before the change, seen from after it.
        seen = [torch.cat([to_polar(x[:4]), x[4:]]) if i > 3 else x for i in range(t)]
        sum_ = evidence.local_model(x).value.sum()
        for i in range(1, t):
            step, y = times[i] - times[i - 1], seen[i]
            sum_ = sum_ + 0.5 * ((y[i] - y[i - 1]) / (3.0 * step)).square().sum()
            if i > 1:
                before = times[i - 1] - times[i - 2]
                bend = y[i] - y[i - 1] - step / before * (y[i - 1] - y[i - 2])
                scale = acceleration * step * (step + before) / 2
                sum_ = sum_ + 0.5 * (bend / scale).square().sum()
        return sum_

    assert float(found.total) == pytest.approx(float(total(found.mean)))
    gradient = torch.autograd.functional.jacobian(total, found.mean)
    assert isinstance(gradient, torch.Tensor)
    assert float(gradient.abs().max()) < 1e-4


def one_by_one(evidence: GaussianEvidence) -> list[GaussianEvidence]:
    """The cost of every frame alone."""
    return [
        GaussianEvidence(evidence.mean[[t]], evidence.precision[[t]])
        for t in range(len(evidence.mean))
    ]


@pytest.mark.parametrize("window", [(4, 2), (5, 0), (9, 4), (20, 4)])
def test_windows_come_near_what_all_frames_find_together(window: tuple[int, int]):
    t, n, times = 14, 3, uneven_times(14)
    evidence, transition = gaussian(t, n), Transition(velocity=6.0, acceleration=40.0)
    start, bounds = evidence.mean, interval(n, -0.5, 0.4)
    whole = refine(
        evidence, start, times, transition, bounds, choice=Refinement(likelihood_power=0.5)
    )
    nothing = refine(
        evidence,
        start,
        times,
        transition,
        bounds,
        choice=Refinement(likelihood_power=0.5, max_steps=0),
    )
    parts = refine_in_windows(
        one_by_one(evidence),
        start,
        times,
        transition,
        bounds,
        choice=replace(IN_WINDOWS, likelihood_power=0.5, tolerance=1e-9),
        windows=Windows(window=window[0], overlap=window[1]),
    )
    gained = float(nothing.total - parts.total) / float(nothing.total - whole.total)
    if window[0] > t:
        assert parts.mean.numpy() == pytest.approx(whole.mean.numpy(), abs=1e-9)
    assert (0.97 if window[1] else 0.9) < gained <= 1 + 1e-12
    assert parts.cost.numpy() == pytest.approx(evidence.local_model(parts.mean).value.numpy())
    # Where the same variables are free, the covariances are those of all frames.
    same = (parts.active == whole.active).all()
    if bool(same):
        assert parts.covariance.numpy() == pytest.approx(whole.covariance.numpy(), rel=1e-6)


def test_windows_across_a_change_of_coordinates():
    t, times = 12, uneven_times(12)
    flat = torch.stack([2 + times, 1 + 0.5 * times], dim=1) + 0.1 * draw(t, 2)
    mean = flat.clone()
    mean[7:] = to_polar(flat[7:])
    evidence = GaussianEvidence.of_modes(mean, 0.1 * covariances(t, n=2))
    transition, changes = Transition(velocity=3.0, acceleration=40.0), {6: to_polar}
    whole = refine(evidence, mean, times, transition, interval(2), changes=changes)
    parts = refine_in_windows(
        one_by_one(evidence),
        mean,
        times,
        transition,
        interval(2),
        choice=replace(IN_WINDOWS, tolerance=1e-9),
        changes=changes,
        windows=Windows(window=8, overlap=5),
    )
    assert float(parts.total) == pytest.approx(float(whole.total), rel=2e-3)


def test_windows_let_costs_go():
    alive: list[weakref.ref] = []

    class Cost:
        def __init__(self, evidence: GaussianEvidence) -> None:
            self.evidence = evidence

        def local_model(self, x: torch.Tensor) -> LocalModel:
            return self.evidence.local_model(x)

    def costs() -> Iterator[Cost]:
        for evidence in one_by_one(gaussian(30, 2)):
            assert sum(ref() is not None for ref in alive) <= 6
            cost = Cost(evidence)
            alive.append(weakref.ref(cost))
            yield cost
            del cost

    refine_in_windows(
        costs(),
        draw(30, 2),
        uneven_times(30),
        Transition(velocity=3.0),
        interval(2),
        windows=Windows(window=6, overlap=3),
    )
    assert len(alive) == 30


def test_bad_windows_are_refused():
    arguments = (draw(5, 2), uneven_times(5), Transition(velocity=3.0), interval(2))
    with pytest.raises(ConfigurationError, match="longer than its overlap"):
        refine_in_windows(
            one_by_one(gaussian(5, 2)), *arguments, windows=Windows(window=4, overlap=4)
        )
    with pytest.raises(ConfigurationError, match="5 frames, got 4"):
        refine_in_windows(one_by_one(gaussian(4, 2)), *arguments)


@pytest.mark.parametrize("name", ["likelihood_power", "max_steps", "tolerance"])
@pytest.mark.parametrize("number", [-1.0, math.nan, math.inf])
def test_refinements_out_of_range_are_refused(name: str, number: float) -> None:
    with pytest.raises(ConfigurationError, match=f"Refinement.{name}: expected"):
        Refinement(**{name: number})


def refined(dtype: torch.dtype) -> Refined:
    evidence = gaussian(8, 3)
    return refine(
        evidence,
        evidence.mean.to(dtype),
        uneven_times(8).to(dtype),
        Transition(velocity=3.0, acceleration=40.0),
        interval(3, -0.5, 0.5),
    )


def test_refinement_in_any_type_and_again():
    double, again, single = refined(torch.float64), refined(torch.float64), refined(torch.float32)
    for one, other in zip(double, again, strict=True):
        assert torch.equal(one, other)
    assert single.mean.dtype == single.covariance.dtype == torch.float32
    assert single.mean.numpy() == pytest.approx(double.mean.numpy(), abs=1e-4)


def test_a_cost_that_is_not_finite_is_reported():
    evidence = gaussian(5, 2)
    evidence.mean[2, 0] = math.nan
    start = draw(5, 2)
    found = refine(evidence, start, uneven_times(5), Transition(velocity=1.0), interval(2))
    assert int(found.status) == Status.NON_FINITE
    assert torch.equal(found.mean, start)
    evidence.precision[2] = math.nan
    parts = refine_in_windows(
        one_by_one(evidence), start, uneven_times(5), Transition(velocity=1.0), interval(2)
    )
    assert int(parts.status) == Status.NON_FINITE
    assert bool(parts.covariance.isfinite().all())


def test_nothing_known_at_all_leaves_the_start():
    nothing = GaussianEvidence(torch.zeros(3, 2).double(), torch.zeros(3, 2, 2).double())
    start = torch.ones(3, 2).double()
    found = refine(nothing, start, uneven_times(3), Transition(velocity=1.0), interval(2))
    assert torch.equal(found.mean, start)
    assert bool(found.covariance.isfinite().all())


def test_bad_refinements_are_refused():
    evidence, start, times = gaussian(5, 2), draw(5, 2), uneven_times(5)
    transition = Transition(velocity=1.0)
    with pytest.raises(ShapeError, match=r"bounds\.lower"):
        refine(evidence, start, times, transition, interval(3))
    with pytest.raises(ConfigurationError, match="lower <= upper"):
        refine(evidence, start, times, transition, interval(2, 1.0, -1.0))
    with pytest.raises(ShapeError, match="finite start"):
        refine(evidence, start / 0, times, transition, interval(2))
    with pytest.raises(ShapeError, match="times"):
        refine(evidence, start, times[:3], transition, interval(2))
    with pytest.raises(ShapeError, match="at least one frame"):
        refine(evidence, start[:0], times[:0], transition, interval(2))
