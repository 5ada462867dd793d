import re
from dataclasses import replace

import problems
import pytest
import scipy.optimize
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcss.errors import ConfigurationError, ShapeError
from torchcss.inference import trust_region
from torchcss.inference.mixture import distinct_modes
from torchcss.inference.trust_region import TrustRegionNewton, default_prior_variance
from torchcss.types import Bounds, LocalModel, Status

NEWTON = TrustRegionNewton()


def randn(*shape: int, generator: torch.Generator) -> torch.Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def limbs(generator: torch.Generator) -> problems.ReprojectedLimbs:
    return problems.ReprojectedLimbs(truth=0.4 * randn(14, generator=generator), limbs=2, joints=4)


@pytest.mark.parametrize("name", ["rosenbrock", "cosines", "double well", "limbs", "bowl"])
def test_derivatives_of_the_problems(name, generator):
    hessian = torch.diag(torch.tensor([1.0, 2.0, 3.0, 4.0]).double())
    cost, n = {
        "rosenbrock": (problems.Rosenbrock(), 5),
        "cosines": (problems.CosineSum.random(4, 6, generator=generator), 4),
        "double well": (problems.DoubleWell(tilt=0.3), 2),
        "limbs": (limbs(generator), 14),
        "bowl": (problems.Bowl(hessian, torch.ones(4).double()), 4),
    }[name]
    x = 0.7 * randn(2, 3, n, generator=generator)
    for got, expected in zip(
        cost.local_model(x), problems.AutogradCost(cost.value).local_model(x), strict=True
    ):
        torch.testing.assert_close(got, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bowl_in_one_step_with_its_covariance(batch, dtype, generator):
    root = randn(4, 4, generator=generator)
    hessian = root @ root.mT + 2 * torch.eye(4).double()
    cost = problems.Bowl(hessian.to(dtype), torch.arange(4.0).to(dtype), offset=-3.0)
    x0 = (torch.arange(4.0) + 0.2 * randn(*batch, 4, generator=generator)).to(dtype)
    modes = NEWTON.minimise(cost, x0, problems.unbounded(4, dtype))
    assert modes.mean.shape == (*batch, 4)
    assert modes.mean.dtype == dtype
    assert modes.cost.shape == modes.status.shape == batch
    tolerance = {"rtol": 1e-4, "atol": 1e-3}
    torch.testing.assert_close(modes.mean, cost.minimum.expand(*batch, 4), **tolerance)
    expected = torch.linalg.inv(hessian).to(dtype).expand(*batch, 4, 4)
    torch.testing.assert_close(modes.covariance, expected, **tolerance)
    assert int(modes.num_steps.max()) <= 3
    assert not bool(modes.active.any())


def test_ends_are_those_of_a_descent_with_covariances(generator):
    cost, x0 = problems.Rosenbrock(), 3 * randn(9, 5, generator=generator)
    bounds = Bounds(torch.full((5,), -1.0).double(), torch.full((5,), 0.8).double())
    assert torch.equal(NEWTON.ends(cost, x0, bounds), NEWTON.minimise(cost, x0, bounds).mean)


def test_rosenbrock_valley(generator):
    modes = NEWTON.minimise(
        problems.Rosenbrock(), randn(20, 2, generator=generator), problems.unbounded(2)
    )
    assert bool((modes.status == Status.CONVERGED).all())
    torch.testing.assert_close(modes.mean, torch.ones(20, 2).double(), rtol=0, atol=2e-3)


@pytest.mark.parametrize("start", [0.0, 1e-9])
def test_leaves_a_saddle(start):
    cost = problems.DoubleWell()
    x0 = torch.tensor([[start, 0.0]]).double()
    modes = NEWTON.minimise(cost, x0, problems.unbounded(2))
    assert int(modes.status) == Status.CONVERGED
    assert float(modes.cost) < 1e-5


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(
    ("across", "barrier"), [(0.0, 1e-2), (0.0, 10.0), (0.0, 1e5), (0.3, 1e-2), (0.3, 10.0)]
)
def test_leaves_a_ridge_between_mirror_images(compiled, across, barrier, monkeypatch):
    """No slope along the ridge's fall, and a Hessian whose diagonal is its spectrum."""
    monkeypatch.setattr(
        trust_region.compiler, "AVAILABLE", compiled and trust_region.compiler.AVAILABLE
    )
    cost = problems.DoubleWell(slope=0.0, barrier=barrier)
    x0 = torch.tensor([[0.0, across]]).double()
    modes = NEWTON.minimise(cost, x0, problems.unbounded(2))
    assert int(modes.status) == Status.CONVERGED
    assert float(modes.cost) < 1e-4


def test_flat_directions_are_no_reason_to_go_on(generator):
    hessian = torch.diag(torch.tensor([5.0, 0.0, 0.0]).double())
    cost = problems.Bowl(hessian, torch.zeros(3).double())
    x0 = randn(8, 3, generator=generator)
    modes = NEWTON.minimise(cost, x0, problems.box(3, -8, 8))
    assert bool((modes.status == Status.CONVERGED).all())
    torch.testing.assert_close(modes.mean[:, 1:], x0[:, 1:])
    variances = torch.diagonal(modes.covariance, dim1=-2, dim2=-1)
    torch.testing.assert_close(variances, torch.tensor([0.2, 16.0, 16.0]).double().expand(8, 3))


def test_active_bounds_hold_and_leave_what_the_slope_leaves():
    hessian = torch.tensor([[2.0, 0.9, 0.0], [0.9, 2.0, 0.0], [0.0, 0.0, 50.0]]).double()
    cost = problems.Bowl(hessian, torch.tensor([3.0, 0.0, 0.5]).double())
    bounds = Bounds(torch.full((3,), -torch.inf), torch.tensor([1.0, torch.inf, 2.0]))
    modes = NEWTON.minimise(cost, torch.zeros(3).double(), bounds)
    assert modes.active.tolist() == [True, False, False]
    assert float(modes.mean[0]) == 1.0
    # On the face x_0 = 1 the minimum of the second variable moves by -H01/H11 (1 - 3).
    torch.testing.assert_close(modes.mean[1], torch.tensor(0.9).double(), atol=1e-4, rtol=0)
    slope = 2.0 * (1.0 - 3.0) + 0.9 * 0.9
    expected = torch.diag(torch.tensor([slope**-2, 0.5, 0.02]).double())
    torch.testing.assert_close(modes.covariance, expected, atol=1e-4, rtol=0)


PRIOR = torch.tensor([0.25, 20.0]).double()


def test_a_held_variable_does_not_swallow_its_neighbours():
    """Two minima half a radian apart, of which one is at a bound, are two."""
    bounds = Bounds(torch.tensor([-1.0, -9.0]).double(), torch.tensor([1.0, 9.0]).double())
    hessian = torch.diag(torch.tensor([2500.0, 100.0]).double())
    means = [torch.tensor([1.1, 0.0]).double(), torch.tensor([0.5, 0.0]).double()]
    found = [
        NEWTON.minimise(problems.Bowl(hessian, mean), mean[None], bounds, prior_variance=PRIOR)
        for mean in means
    ]
    assert found[0].active[0].tolist() == [True, False]
    both = [torch.cat([getattr(mode, name) for mode in found]) for name in ("mean", "covariance")]
    assert len(distinct_modes(*both, torch.tensor([0.0, 15.0]))) == 2
    # Nor is it ever the widest direction, however gentle the slope.
    gentle = problems.Bowl(torch.diag(torch.tensor([1e-6, 100.0]).double()), means[0])
    mode = NEWTON.minimise(gentle, bounds.project(means[0])[None], bounds, prior_variance=PRIOR)
    if bool(mode.active[0, 0]):
        variance = mode.covariance[0].diagonal()
        assert float(variance[0]) <= float(variance[1]) * (1 + 1e-9)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), bounded=st.booleans(), single=st.booleans())
def test_waves(seed, bounded, single):
    """On a cost full of saddles: bounds exact, never above the start, truly stationary."""
    generator = torch.Generator().manual_seed(seed)
    dtype = torch.float32 if single else torch.float64
    cost = problems.CosineSum.random(6, 20, generator=generator, dtype=dtype, stiffness=1.0)
    bounds = problems.box(6, -1.5, 1.5, dtype) if bounded else problems.unbounded(6, dtype)
    x0 = (2 * randn(16, 6, generator=generator)).to(dtype)
    modes = NEWTON.minimise(cost, x0, bounds)
    assert bool(((modes.mean >= bounds.lower) & (modes.mean <= bounds.upper)).all())
    assert bool((modes.cost <= cost.value(bounds.project(x0))).all())
    assert all(bool(x.isfinite().all()) for x in modes[:3])
    assert bool((modes.status != Status.STEP_LIMIT).all())
    settled = modes.status == Status.CONVERGED
    model = cost.local_model(modes.mean)
    gradient = torch.where(modes.active, 0.0, model.gradient)[settled]
    assert not len(gradient) or float(gradient.abs().max()) < 0.05
    free = ~modes.active[settled]
    both = free[:, :, None] & free[:, None, :]
    curvature = torch.linalg.eigvalsh(
        torch.where(both, model.hessian[settled], torch.eye(6, dtype=dtype))
    )
    assert bool((curvature > -1e-3).all())


def test_descends_without_pinning(monkeypatch, generator):
    """The fallback for items whose active set is not settled in time, forced on every one."""
    monkeypatch.setattr(trust_region, "_PINNING_ROUNDS", 0)
    cost = problems.CosineSum.random(6, 20, generator=generator, stiffness=1.0)
    bounds = problems.box(6, -1.5, 1.5)
    x0 = bounds.project(2 * randn(20, 6, generator=generator))
    modes = NEWTON.minimise(cost, x0, bounds)
    assert bool(((modes.mean >= -1.5) & (modes.mean <= 1.5)).all())
    assert bool((modes.cost < cost.value(x0) - 1).all())


def test_a_coupled_variable_is_let_go_from_its_bound():
    """Newton would leave through a bound that the minimum does not lie on."""
    hessian = torch.tensor([[1.0, 0.95], [0.95, 1.0]]).double()
    cost = problems.Bowl(hessian, torch.tensor([-0.5, 2.0]).double())
    modes = NEWTON.minimise(cost, torch.zeros(2).double(), problems.box(2, 0.0, 1.0))
    # On x_1 = 1 the first variable's minimum is -0.5 - 0.95 (1 - 2) = 0.45.
    torch.testing.assert_close(modes.mean, torch.tensor([0.45, 1.0]).double(), rtol=0, atol=2e-3)
    assert modes.active.tolist() == [False, True]


def test_as_low_as_lbfgs(generator):
    cost = problems.CosineSum.random(6, 20, generator=generator, stiffness=1.0)
    bounds = problems.box(6, -1.5, 1.5)
    x0 = bounds.project(2 * randn(40, 6, generator=generator))
    ours = NEWTON.minimise(cost, x0, bounds).cost

    def with_gradient(x):
        model = cost.local_model(torch.as_tensor(x))
        return float(model.value), model.gradient.numpy()

    limits = list(zip(bounds.lower.tolist(), bounds.upper.tolist(), strict=True))
    theirs = [
        scipy.optimize.minimize(
            with_gradient, x.numpy(), jac=True, method="L-BFGS-B", bounds=limits
        )
        for x in x0
    ]
    # Different descents may end in different minima: compare what they reach on average, and
    # check that L-BFGS-B cannot improve on where we stopped.
    standard_error = float(ours.std()) / 40**0.5
    assert float(ours.mean()) < sum(r.fun for r in theirs) / 40 + 3 * standard_error
    for x, value in zip(NEWTON.minimise(cost, x0, bounds).mean, ours, strict=True):
        polished = scipy.optimize.minimize(
            with_gradient, x.numpy(), jac=True, method="L-BFGS-B", bounds=limits
        )
        assert polished.fun > float(value) - 1e-4


@pytest.mark.parametrize("tolerance", [1e-6, 1e-3])
def test_curved_valleys_are_followed_out(tolerance, generator):
    """Short damped steps along a valley are not taken for an end, whatever the tolerance."""
    cost = problems.Rosenbrock(steepness=1e5)
    x0 = torch.tensor([-1.0, 1.0]).double() + 0.1 * randn(10, 2, generator=generator)
    newton = TrustRegionNewton(tolerance=tolerance, max_steps=1000)
    modes = newton.minimise(cost, x0, problems.unbounded(2))
    assert bool((modes.status == Status.CONVERGED).all())
    _, gradient, hessian = cost.local_model(modes.mean)
    assert bool((torch.linalg.eigvalsh(hessian) > 0).all())
    newton_step = torch.linalg.solve(hessian, gradient)
    assert float(0.5 * (gradient * newton_step).sum(-1).max()) < 1.01 * tolerance


def test_limbs_reach_the_truth_or_a_known_alternative(generator):
    cost = limbs(generator)
    x0 = cost.truth + 0.1 * randn(20, 14, generator=generator)
    modes = NEWTON.minimise(cost, x0, problems.box(14, -2.5, 2.5))
    assert float(modes.cost.median()) < 0.1
    assert bool((modes.cost <= cost.value(x0)).all())


def test_an_item_alone_equals_the_item_in_a_batch(generator):
    cost = problems.CosineSum.random(6, 20, generator=generator, stiffness=1.0)
    bounds = problems.box(6, -1.5, 1.5)
    x0 = 2 * randn(12, 6, generator=generator)
    together = NEWTON.minimise(cost, x0, bounds)
    for i in range(12):
        alone = NEWTON.minimise(cost, x0[i], bounds)
        assert int(alone.status) == int(together.status[i])
        assert int(alone.num_steps) == int(together.num_steps[i])
        torch.testing.assert_close(alone.mean, together.mean[i], rtol=1e-7, atol=1e-7)
        torch.testing.assert_close(alone.covariance, together.covariance[i], rtol=1e-5, atol=1e-7)


def test_context_follows_its_item(generator):
    minimum = randn(2, 3, 4, generator=generator)
    cost = problems.ItemBowls(10 ** randn(6, 1, generator=generator), minimum.reshape(6, 4))
    modes = NEWTON.minimise(cost, torch.zeros(2, 3, 4).double(), problems.unbounded(4))
    assert len(set(modes.num_steps.flatten().tolist())) > 1, "the test needs compaction"
    torch.testing.assert_close(modes.mean, minimum, rtol=0, atol=0.1)


class Broken(problems.Rosenbrock):
    """Not finite outside a disc."""

    def local_model(self, x):
        model = super().local_model(x)
        outside = x.square().sum(-1) > 4
        return LocalModel(torch.where(outside, torch.nan, model.value), *model[1:])


def test_non_finite_costs():
    x0 = torch.tensor([[-1.9, 0.1], [5.0, 5.0], [torch.nan, 0.0]]).double()
    modes = NEWTON.minimise(Broken(), x0, problems.unbounded(2))
    assert modes.status.tolist() == [Status.CONVERGED, Status.NON_FINITE, Status.NON_FINITE]
    torch.testing.assert_close(modes.mean[1:], x0[1:], equal_nan=True)
    torch.testing.assert_close(modes.mean[0], torch.ones(2).double(), atol=1e-2, rtol=0)
    assert bool(modes.covariance.isfinite().all())


@pytest.mark.parametrize("height", [1e-4, 1e-2, 1.0])
def test_jumping_costs_stop(height, generator):
    smooth = problems.CosineSum.random(6, 20, generator=generator, stiffness=1.0)
    cost = problems.Jumping(smooth, height)
    x0 = 2 * randn(30, 6, generator=generator)
    modes = NEWTON.minimise(cost, x0, problems.unbounded(6))
    assert not bool((modes.status == Status.STEP_LIMIT).any())
    assert float(modes.num_steps.double().mean()) < 40
    assert bool((modes.cost <= cost.value(x0)).all())
    settled = NEWTON.minimise(smooth, modes.mean, problems.unbounded(6)).cost
    assert float((modes.cost - settled).median()) < 2 * height


def test_a_concave_potential_does_not_shorten_the_steps(generator):
    """The Gauss-Newton model promises too little there; that is no reason to distrust it."""

    class Ramp(problems.Alike):
        """|x|, smoothed: its quadratic upper bound promises half of the decrease."""

        def value(self, x):
            return (1e-4 + x.square()).sqrt().sum(-1)

        def local_model(self, x):
            slope = x / (1e-4 + x.square()).sqrt()
            curvature = (1e-4 + x.square()).rsqrt()
            return LocalModel(self.value(x), slope, torch.diag_embed(curvature))

    x0 = 50 + randn(10, 3, generator=generator)
    modes = TrustRegionNewton(initial_radius=0.1).minimise(Ramp(), x0, problems.unbounded(3))
    assert float(modes.mean.abs().max()) < 0.01
    assert float(modes.num_steps.double().mean()) < 25


def test_step_limit_and_one_evaluation_a_step(generator):
    calls = []

    class Counted(problems.Rosenbrock):
        def local_model(self, x):
            calls.append(len(x))
            return super().local_model(x)

    modes = TrustRegionNewton(max_steps=3).minimise(
        Counted(), 2 * randn(7, 5, generator=generator), problems.unbounded(5)
    )
    assert bool((modes.status == Status.STEP_LIMIT).all())
    assert calls == [7, 7, 7, 7]
    assert bool((modes.num_steps == 3).all())


def test_what_the_first_step_promises(generator):
    """On a bowl the promise is kept; elsewhere the step is the one that minimise tries first."""
    hessian = torch.diag(torch.tensor([1.0, 2.0, 3.0, 4.0]).double())
    bowl = problems.Bowl(hessian, torch.ones(4).double(), offset=-3.0)
    x0, free = 1 + 0.1 * randn(6, 4, generator=generator), problems.unbounded(4)
    kept = NEWTON.minimise(bowl, x0, free)
    promised = NEWTON.promised(NEWTON.step(bowl, NEWTON.start(x0), free)[0], free)
    torch.testing.assert_close(promised.x, kept.mean, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(promised.model.value, kept.cost)
    torch.testing.assert_close(NEWTON.modes(promised, free).covariance, kept.covariance)
    calls = []

    class Counted(problems.Rosenbrock):
        def local_model(self, x):
            calls.append(x)
            return super().local_model(x)

    bounds, x0 = problems.box(3, -1, 0.5), 2 * randn(9, 3, generator=generator)
    promised = NEWTON.promised(NEWTON.step(Counted(), NEWTON.start(x0), bounds)[0], bounds)
    assert len(calls) == 1
    replace(NEWTON, max_steps=1).minimise(Counted(), x0, bounds)
    torch.testing.assert_close(promised.x, calls[2])
    before = problems.Rosenbrock().value(bounds.project(x0))
    assert bool((promised.model.value <= before).all())
    broken = torch.tensor([[5.0, 5.0], [0.5, 0.5]]).double()
    free = problems.unbounded(2)
    promised = NEWTON.promised(NEWTON.step(Broken(), NEWTON.start(broken), free)[0], free)
    assert promised.model.value.isinf().tolist() == [True, False]


class Untouchable(problems.Rosenbrock):
    """For what must not be evaluated."""

    def local_model(self, x):
        raise AssertionError(f"evaluated {len(x)} items")


@pytest.mark.parametrize("pool_size", [None, 4])
def test_a_descent_goes_on_where_it_stopped(generator, pool_size):
    """In one go, or a few steps at first and the rest later, of some items only: the same."""
    newton = replace(NEWTON, pool_size=pool_size)
    cost, bounds = problems.Rosenbrock(), problems.box(3, -2, 2)
    x0 = 2 * randn(9, 3, generator=generator)
    whole = newton.minimise(cost, x0, bounds)
    begun = replace(newton, max_steps=3).descend(
        cost, newton.step(cost, newton.start(x0), bounds)[0], bounds
    )
    assert bool((begun.num_steps <= 3).all())
    before = [part.clone() for part in (begun.x, *begun.model, *begun[2:])]
    some = torch.tensor([7, 2, 5])
    rest = newton.modes(newton.descend(cost, begun.take(some), bounds), bounds)
    for ours, theirs in zip(rest, whole, strict=True):
        torch.testing.assert_close(ours, theirs[some], rtol=1e-9, atol=1e-9)
    newton.descend(cost, begun, bounds)
    assert all(map(torch.equal, before, (begun.x, *begun.model, *begun[2:])))
    # What has converged is not evaluated again.
    state = newton.descend(cost, newton.start(x0), bounds)
    assert bool((state.status == Status.CONVERGED).all())
    again = newton.descend(Untouchable(), state, bounds)
    assert torch.equal(again.x, state.x)


def test_verbs_agree_with_minimise(generator):
    cost, bounds = problems.Rosenbrock(), problems.box(3, -2, 2)
    x0 = randn(4, 3, generator=generator)
    state = NEWTON.step(cost, NEWTON.start(x0), bounds)[0]
    for _ in range(NEWTON.max_steps):
        before = state
        state, info = NEWTON.step(cost, state, bounds)
        assert bool((state.model.value <= before.model.value).all())
        assert bool((info.accepted <= (before.status == Status.RUNNING)).all())
        if not bool((state.status == Status.RUNNING).any()):
            break
    modes = NEWTON.minimise(cost, x0, bounds)
    torch.testing.assert_close(state.x, modes.mean, rtol=1e-9, atol=1e-9)
    assert state.status.tolist() == modes.status.tolist()
    assert state.num_steps.tolist() == modes.num_steps.tolist()


def test_scale_makes_units_irrelevant(generator):
    cost = problems.CosineSum.random(4, 12, generator=generator, stiffness=1.0)
    unit = torch.tensor([1e-3, 1.0, 10.0, 1e3]).double()
    other = problems.CosineSum(cost.frequency / unit, cost.phase, cost.amplitude, 0.0)
    plain = problems.CosineSum(cost.frequency, cost.phase, cost.amplitude, 0.0)
    x0 = randn(10, 4, generator=generator)
    bounds = problems.box(4, -2, 2)
    scaled = Bounds(bounds.lower * unit, bounds.upper * unit)
    a = NEWTON.minimise(plain, x0, bounds)
    b = NEWTON.minimise(other, x0 * unit, scaled, scale=unit)
    torch.testing.assert_close(b.cost, a.cost, rtol=1e-4, atol=1e-4)


def test_default_prior_variance():
    bounds = Bounds(torch.tensor([-1.0, -torch.inf, 2.0]), torch.tensor([3.0, 0.0, 2.0]))
    got = default_prior_variance(bounds)
    assert got[:2].tolist() == [1.0, 1.0]
    assert 0 < float(got[2]) < 1e-10


def test_nothing_to_do_and_bad_input():
    cost = problems.Rosenbrock()
    empty = NEWTON.minimise(cost, torch.zeros(0, 3), problems.unbounded(3, torch.float32))
    assert empty.mean.shape == (0, 3)
    assert empty.covariance.shape == (0, 3, 3)
    with pytest.raises(ShapeError, match=r"bounds.lower.*\[3\]"):
        NEWTON.minimise(cost, torch.zeros(2, 3), problems.unbounded(2))
    with pytest.raises(ShapeError, match="scale"):
        NEWTON.minimise(cost, torch.zeros(3), problems.unbounded(3), scale=torch.ones(2))
    with pytest.raises(ConfigurationError, match="parameter 0"):
        NEWTON.minimise(cost, torch.zeros(3), problems.box(3, 1, -1))
    with pytest.raises(ConfigurationError, match="max_steps"):
        TrustRegionNewton(max_steps=0)
    with pytest.raises(ShapeError, match="x0: expected float32 or float64"):
        NEWTON.minimise(cost, torch.zeros(3).long(), problems.unbounded(3))
    for name in ("scale", "prior_variance"):
        for bad in (0.0, -1.0, torch.nan):
            given = {name: torch.tensor([1.0, bad, 1.0])}
            with pytest.raises(ConfigurationError, match=f"{name}: expected positive"):
                NEWTON.minimise(cost, torch.zeros(3), problems.unbounded(3), **given)


@pytest.mark.parametrize(
    ("part", "shape"),
    [("value", ()), ("value", (5,)), ("gradient", (4, 2)), ("hessian", (4, 2, 2))],
)
def test_answers_of_another_shape_are_refused(part, shape):
    """Before compiled code reads beyond their end."""

    class Wrong(problems.Bowl):
        def local_model(self, x):
            return super().local_model(x)._replace(**{part: torch.zeros(shape).double()})

    cost = Wrong(torch.eye(3).double(), torch.zeros(3).double())
    with pytest.raises(ShapeError, match=rf"{part}: expected \[4.*got {re.escape(str([*shape]))}"):
        NEWTON.minimise(cost, torch.zeros(4, 3).double(), problems.unbounded(3))


def test_the_costs_own_tensors_are_left_alone(generator):
    hessian = torch.eye(3).double()
    cost = problems.Bowl(hessian, torch.zeros(3).double())
    NEWTON.minimise(cost, randn(5, 3, generator=generator), problems.unbounded(3))
    assert torch.equal(hessian, torch.eye(3).double())
