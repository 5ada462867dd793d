import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcss import linalg

BATCHES = [(), (5,), (2, 3)]


def random_covariance(*shape: int, generator: torch.Generator) -> torch.Tensor:
    matrix = torch.randn(*shape, shape[-1], generator=generator, dtype=torch.float64)
    return matrix @ matrix.mT + 0.1 * torch.eye(shape[-1], dtype=torch.float64)


@pytest.mark.parametrize("batch", BATCHES)
def test_solve_on_free_variables(batch, generator):
    hessian = random_covariance(*batch, 4, generator=generator)
    free = torch.tensor([True, False, True, True]).expand(*batch, 4)
    right = torch.where(free, torch.ones(*batch, 4, dtype=torch.float64), 0.0)
    factor, ok = linalg.damped_cholesky(linalg.mask_free(hessian, free), torch.zeros_like(right))
    assert bool(ok.all())
    got = linalg.cholesky_apply(factor, right)
    keep = [0, 2, 3]
    expected = torch.linalg.solve(hessian[..., keep, :][..., :, keep], right[..., keep])
    assert bool((got[..., 1] == 0).all())
    torch.testing.assert_close(got[..., keep], expected)


def test_indefinite_item_is_reported_alone(generator):
    good = random_covariance(3, generator=generator)
    _, ok = linalg.damped_cholesky(torch.stack([good, -good]), torch.zeros(2, 3).double())
    assert ok.tolist() == [True, False]


@pytest.mark.parametrize("batch", BATCHES)
def test_inverse_on_free_is_the_inverse_where_the_cost_is_informative(batch, generator):
    hessian = 10 * random_covariance(*batch, 4, generator=generator) + 2 * torch.eye(4).double()
    free = torch.tensor([True, False, True, True]).expand(*batch, 4)
    prior = torch.tensor([1.0, 7.0, 1.0, 1.0]).double()
    got = linalg.inverse_on_free(hessian, free, prior)
    keep = [0, 2, 3]
    expected = torch.linalg.inv(hessian[..., keep, :][..., :, keep])
    torch.testing.assert_close(got[..., keep, :][..., :, keep], expected)
    assert bool((got[..., 1, keep] == 0).all())
    torch.testing.assert_close(got[..., 1, 1], torch.full(batch, 7.0).double())


def test_inverse_never_exceeds_the_prior():
    hessian = torch.diag(torch.tensor([100.0, 0.0, -5.0, 1e-12])).double()
    prior = torch.tensor([4.0, 9.0, 16.0, 25.0]).double()
    got = linalg.inverse_on_free(hessian, torch.ones(4, dtype=torch.bool), prior)
    expected = torch.diag(torch.tensor([0.01, 9.0, 16.0, 25.0]).double())
    torch.testing.assert_close(got, expected)


def test_inverse_does_not_depend_on_the_other_items(generator):
    informed = 50 * random_covariance(4, generator=generator) + 2 * torch.eye(4).double()
    both = torch.stack([informed, -informed])
    free = torch.ones(2, 4, dtype=torch.bool)
    prior = torch.ones(4).double()
    together = linalg.inverse_on_free(both, free, prior)
    torch.testing.assert_close(together[0], linalg.inverse_on_free(informed, free[0], prior))


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("batch", BATCHES)
def test_distance_and_determinant(batch, size, generator):
    covariance = size * random_covariance(*batch, 4, generator=generator)
    d = torch.randn(*batch, 4, generator=generator, dtype=torch.float64)
    expected = (d * torch.linalg.solve(covariance, d)).sum(-1)
    torch.testing.assert_close(linalg.squared_mahalanobis(d, covariance), expected)
    torch.testing.assert_close(
        linalg.log_determinant(covariance), torch.linalg.slogdet(covariance).logabsdet
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_singular_covariances_stay_finite(dtype):
    covariance = torch.zeros(3, 3, dtype=dtype)
    covariance[:2, :2] = torch.tensor([[1.0, 1.0], [1.0, 1.0]])
    factor = linalg.covariance_factor(covariance)
    torch.testing.assert_close(factor @ factor.mT, covariance)
    assert bool(linalg.log_determinant(covariance).isfinite())
    along, across = torch.tensor([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0]], dtype=dtype)
    near, far = linalg.squared_mahalanobis(torch.stack([along, across]), covariance)
    assert abs(float(near) - 1) < 0.5
    assert float(far) > 1e4
    assert not bool(linalg.squared_mahalanobis(torch.ones(3, dtype=dtype), covariance).isnan())


def test_an_item_without_a_factor_changes_no_other(generator):
    regular = random_covariance(3, generator=generator)
    negative = torch.diag(torch.tensor([1.0, 1.0, 1.0])).double()
    negative[0, 1] = negative[1, 0] = 1.1
    both, d = torch.stack([regular, negative]), torch.ones(3).double()
    assert torch.equal(linalg.log_determinant(both)[0], linalg.log_determinant(regular[None])[0])
    found = linalg.squared_mahalanobis(d, both)
    assert torch.equal(found[0], linalg.squared_mahalanobis(d, regular[None])[0])
    assert bool(found.isfinite().all())


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**31), spread=st.floats(0, 6))
def test_whitening_ignores_units(seed, spread):
    generator = torch.Generator().manual_seed(seed)
    covariance = random_covariance(4, generator=generator)
    d = torch.randn(4, generator=generator, dtype=torch.float64)
    unit = 10 ** (spread * torch.randn(4, generator=generator, dtype=torch.float64))
    torch.testing.assert_close(
        linalg.squared_mahalanobis(unit * d, covariance * torch.outer(unit, unit)),
        linalg.squared_mahalanobis(d, covariance),
        rtol=1e-6,
        atol=0,
    )


@pytest.mark.parametrize("batch", BATCHES)
def test_constrained_inverse_is_as_printed(batch, generator):
    """Nothing is capped, and what a bound holds has no width."""
    hessian = 1e-6 * random_covariance(*batch, 4, generator=generator)
    free = torch.tensor([True, False, True, True]).expand(*batch, 4)
    got, floored = linalg.constrained_inverse(hessian, free, torch.ones(4).double())
    assert not bool(floored.any())
    assert floored.shape == batch
    keep = [0, 2, 3]
    expected = torch.linalg.inv(hessian[..., keep, :][..., :, keep])
    torch.testing.assert_close(got[..., keep, :][..., :, keep], expected)
    assert not bool(got[..., 1, :].any())
    assert not bool(got[..., :, 1].any())


def test_constrained_inverse_floors_what_is_not_positive_definite():
    hessian = torch.diag_embed(
        torch.tensor([[4e3, -1.0, 0.1, -9.0], [4.0, 2.0, 0.1, -9.0], [4.0, 0.0, 0.1, 1.0]])
    ).double()
    free = torch.tensor([[True] * 4, [True, True, True, False], [True] * 4])
    prior = torch.tensor([1.0, 1.0, 4.0, 9.0]).double()
    got, floored = linalg.constrained_inverse(hessian, free, prior)
    assert floored.tolist() == [True, False, True], "a held direction does not count"
    curvature = (hessian.diagonal(dim1=-2, dim2=-1) * prior).clamp(min=linalg.LEAST_CURVATURE)
    expected = prior / curvature
    expected[1] = torch.tensor([0.25, 0.5, 10, 0])  # as it is
    torch.testing.assert_close(got.diagonal(dim1=-2, dim2=-1), expected)


def test_least_width_is_given_to_what_has_none_alone(generator):
    covariance = random_covariance(3, generator=generator)
    assert torch.equal(linalg.with_least_width(covariance), covariance)
    covariance[1] = covariance[:, 1] = 0
    got = linalg.with_least_width(covariance)
    assert float(got[1, 1]) == linalg.LEAST_DEVIATION**2
    covariance[1, 1] = got[1, 1]
    assert torch.equal(got, covariance)
