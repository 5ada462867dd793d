"""The compiled Gaussian blur is the convolution."""

from __future__ import annotations

import pytest
import torch

from torchcss.kernels import compiler
from torchcss.vision.sampling import gaussian_blur


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (40, 3), (5, 31, 33), (2, 3, 20, 17)])
@pytest.mark.parametrize("sigma", [0.5, 1.0, 3.0, 8.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kernel_is_the_convolution(
    shape: tuple[int, ...], sigma: float, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = torch.rand(shape, generator=torch.Generator().manual_seed(0), dtype=dtype)
    blurred = gaussian_blur(image, sigma)
    monkeypatch.setattr(compiler, "COMPILED", False)
    tolerance = 1e-6 if dtype == torch.float32 else 1e-14
    torch.testing.assert_close(blurred, gaussian_blur(image, sigma), rtol=0, atol=tolerance)


def test_gradients_pass_through() -> None:
    image = torch.rand(6, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    image.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: gaussian_blur(x, 1.0), image)


def test_flat_stays_flat_and_a_view_is_read_right() -> None:
    image = torch.rand(30, 40, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(gaussian_blur(image.mT, 2.0), gaussian_blur(image, 2.0).mT)
    torch.testing.assert_close(gaussian_blur(torch.full((9, 9), 0.7), 3.0), torch.full((9, 9), 0.7))
