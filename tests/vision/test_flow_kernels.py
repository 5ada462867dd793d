"""The compiled loops of the flow give what their twins in torch give."""

from __future__ import annotations

import pytest
import torch

from torchcss.kernels import compiler
from torchcss.vision import boundaries, flow, warping

pytestmark = pytest.mark.skipif(not compiler.COMPILED, reason="numba is not installed")

SIZES = [(1, 1), (1, 9), (7, 1), (2, 3), (33, 26)]


def both(monkeypatch: pytest.MonkeyPatch, run):
    compiled = run()
    monkeypatch.setattr(compiler, "COMPILED", False)
    return compiled, run()


@pytest.mark.parametrize("size", SIZES)
def test_structure(size, monkeypatch, generator):
    images = torch.rand(3, 2, *size, generator=generator)
    got, expected = both(monkeypatch, lambda: flow._structure(images))
    torch.testing.assert_close(got, expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("radius", [0, 1, 2])
@pytest.mark.parametrize("size", SIZES)
def test_median(size, radius, monkeypatch, generator):
    images = torch.randn(2, 2, *size, generator=generator)
    got, expected = both(monkeypatch, lambda: flow._median(images, radius))
    assert torch.equal(got, expected)


@pytest.mark.parametrize("size", SIZES)
def test_spline(size, monkeypatch, generator):
    images = torch.rand(2, 1, *size, generator=generator)

    def spline_and_slopes():
        spline = warping.image_spline(images)
        return spline, warping.image_slopes(spline)

    got, expected = both(monkeypatch, spline_and_slopes)
    torch.testing.assert_close(got[0], expected[0], rtol=0, atol=2e-6)
    torch.testing.assert_close(got[1], expected[1], rtol=0, atol=2e-6)


@pytest.mark.parametrize(
    ("size", "new"),
    [
        *[((1, 1), (8, 9)), ((1, 9), (1, 12)), ((2, 3), (5, 4)), ((33, 26), (41, 33))],
        *[((9, 8), (7, 6)), ((5, 4), (5, 3)), ((33, 26), (26, 21))],
    ],
)
def test_resized(size, new, monkeypatch, generator):
    images = torch.rand(2, 2, *size, generator=generator)
    got, expected = both(monkeypatch, lambda: flow._resized(images, new))
    assert got.shape == (2, 2, *new)
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("size", SIZES)
def test_carried_marks(size, monkeypatch, generator):
    marks = torch.rand(2, *size, generator=generator)
    marks[marks < 0.3] = 0.0
    moves = 4 * torch.randn(2, 2, *size, generator=generator)
    moves[0, 0, 0, 0] = torch.nan
    got, expected = both(monkeypatch, lambda: boundaries.displaced(marks, moves, reach=3))
    torch.testing.assert_close(got, expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize("steps", [7, 20])
@pytest.mark.parametrize("size", SIZES)
def test_solver(size, steps, monkeypatch, generator):
    height, width = size

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(2, *shape, generator=generator)

    start, weight = random(2, *size) - 0.5, 1000 * random(1, *size)
    constancy = warping.Constancy(
        0.1 * random(2, *size) - 0.05, 0.04 * random(1, *size) - 0.02, torch.ones(2, 1, *size)
    )
    right, down = 30 * random(1, height, width - 1), 30 * random(1, height - 1, width)
    energy = flow._Quadratic.of(constancy, weight, right, down)
    got, expected = both(monkeypatch, lambda: flow._solve(start, energy, steps))
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-5)


def test_nothing_to_go_by_is_no_motion(generator):
    """No links, no gradient: the flow stays where it is."""
    start, zero = torch.rand(1, 2, 4, 5, generator=generator), torch.zeros(1, 1, 4, 5)
    constancy = warping.Constancy(torch.zeros(1, 2, 4, 5), zero, zero)
    energy = flow._Quadratic.of(constancy, zero, zero[..., 1:], zero[..., 1:, :])
    got = flow._solve(start, energy, 20)
    assert torch.equal(got, start)


@pytest.mark.parametrize("size", SIZES)
def test_linearised_brightness(size, monkeypatch, generator):
    """Also where pixels leave the image, far and near, and where there is no gradient."""
    first, second = torch.rand(2, 2, 3, *size, generator=generator)
    first[0, 1:], second[0] = 0.0, 0.5
    second = warping.image_spline(second[:, :1])
    moves = 3 * torch.randn(2, 2, *size, generator=generator)
    moves[1, 0, 0, 0] = -100.0
    got, expected = both(monkeypatch, lambda: warping.constancy_about(moves, first, second))
    assert torch.equal(got.visible, expected.visible)
    assert not got.gradient[0].any()
    torch.testing.assert_close(got.gradient, expected.gradient, rtol=0, atol=2e-5)
    expected_residual = expected.residual(moves)
    torch.testing.assert_close(got.residual(moves), expected_residual, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("size", SIZES)
def test_weights(size, monkeypatch, generator):
    """Also where neighbours have nothing in common, and where a pixel is seen once only."""
    moves = 10 * torch.randn(2, 2, *size, generator=generator)
    gradient = 0.1 * torch.randn(2, 2, *size, generator=generator)
    offset, seen = torch.rand(2, 2, 1, *size, generator=generator)
    constancy = warping.Constancy(gradient, offset, (seen > 0.3).float())
    choice = flow.TRACKING_FLOW.data, flow.TRACKING_FLOW.smoothness
    got, expected = both(monkeypatch, lambda: flow._weighed(moves, constancy, *choice))
    for own, other in zip(got, expected, strict=True):
        torch.testing.assert_close(own, other, rtol=1e-4, atol=1e-5)
