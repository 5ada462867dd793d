"""Images as smooth functions: uniform cubic B-splines with exact first and second derivatives.

A term of the cost that looks at an image directly has to be twice continuously differentiable in
the point that it looks at. Here the pixels are the coefficients of the spline, so that its values
never leave the range of the pixels; it blurs them by a kernel of variance 1/3. Coefficients outside
the image are zero: the function, and all its derivatives, fade over two pixels across the border.

By default: `spline_field(images)`, then `SplineField.sample(uv)`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

_MARGIN = 4
"""Zero coefficients around the image, pixels: beyond two the spline is zero for good."""


class SplineSample(NamedTuple):
    """The image at points, with its derivatives along u and v.

    Attributes:
        value: Value in the range of the image; 0 outside it.
        gradient: First derivatives, per pixel.
        hessian: Second derivatives, per square pixel.
    """

    value: Float[Tensor, "*batch p"]
    gradient: Float[Tensor, "*batch p 2"]
    hessian: Float[Tensor, "*batch p 2 2"]


class SplineField(NamedTuple):
    """Images as twice continuously differentiable functions.

    Attributes:
        coefficients: Coefficients of the splines at the pixel centres, within a margin of zeros.
    """

    coefficients: Float[Tensor, "layers y x"]

    def value(
        self, uv: Float[Tensor, "*batch p 2"], layer: Int[Tensor, "*#batch p"] | None = None
    ) -> Float[Tensor, "*batch p"]:
        """Evaluate the spline without its derivatives.

        Args:
            uv: Pixel coordinates, anywhere.
            layer: The image that each point looks at; None: the first.
        """
        (f,), (by_value,) = self._summed_along_u(uv, layer, num_derivatives=0)
        return _dot(by_value, f).reshape(uv.shape[:-1])

    def sample(
        self, uv: Float[Tensor, "*batch p 2"], layer: Int[Tensor, "*#batch p"] | None = None
    ) -> SplineSample:
        """Evaluate the spline and its derivatives.

        Args:
            uv: Pixel coordinates, anywhere.
            layer: The image that each point looks at; None: the first.
        """
        (f, f_u, f_uu), along_v = self._summed_along_u(uv, layer, num_derivatives=2)
        by_value, by_slope, by_curvature = along_v
        mixed = _dot(by_slope, f_u)
        gradient = torch.stack([_dot(by_value, f_u), _dot(by_slope, f)], dim=-1)
        hessian = torch.stack([_dot(by_value, f_uu), mixed, mixed, _dot(by_curvature, f)], dim=-1)
        return SplineSample(
            _dot(by_value, f).reshape(uv.shape[:-1]),
            gradient.reshape(uv.shape),
            hessian.reshape(*uv.shape, 2),
        )

    def _summed_along_u(
        self, uv: Tensor, layer: Tensor | None, *, num_derivatives: int
    ) -> tuple[list[list[Tensor]], list[list[Tensor]]]:
        """The four rows around each point, summed with the weights along u and their derivatives.

        Returns the sums by derivative and row, and the weights along v by derivative and row. One
        tensor a tap: on a CPU three times faster than 4 x 4 patches and small matrix products.
        """
        height, width = self.coefficients.shape[-2:]
        column, u = _cell(uv[..., 0].flatten(), width)
        row, v = _cell(uv[..., 1].flatten(), height)
        along_u, along_v = _basis(u, num_derivatives), _basis(v, num_derivatives)
        flat, first = self.coefficients.flatten(), row * width + column
        if layer is not None:
            first = first + (height * width * layer).expand(uv.shape[:-1]).flatten().int()
        sums: list[list[Tensor]] = [[] for _ in along_u]
        for down in range(4):
            rows = [flat.index_select(0, first + (down * width + right)) for right in range(4)]
            taps = [tap.to(uv) for tap in rows]  # converted are the few that are looked at
            for into, weights in zip(sums, along_u, strict=True):
                into.append(_dot(weights, taps))
        return sums, along_v


def spline_field(images: Float[Tensor, "layers h w"]) -> SplineField:
    """Make the smooth functions of a stack of images.

    Args:
        images: The pixels.
    """
    return SplineField(functional.pad(images, (_MARGIN,) * 4))


def _cell(coordinate: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """First of the four coefficients that a coordinate blends, and its fraction of the way."""
    # Clamped in the margin, where all four are zero. Four-byte indices are faster to select with.
    within = coordinate.clamp(1.5 - _MARGIN, size - 2 * _MARGIN + 1.5)
    lower = within.detach().floor()
    return lower.int() + (_MARGIN - 1), within - lower


def _basis(t: Tensor, num_derivatives: int) -> list[list[Tensor]]:
    """The four cubic B-splines on a cell, then their first and second derivatives (0 or 2)."""
    r = 1 - t
    t2, r2 = t * t, r * r
    splines = [[r2 * r / 6, 2 / 3 - t2 + 0.5 * t2 * t, 2 / 3 - r2 + 0.5 * r2 * r, t2 * t / 6]]
    if num_derivatives:
        splines.append([-0.5 * r2, 1.5 * t2 - 2 * t, 2 * r - 1.5 * r2, 0.5 * t2])
        splines.append([r, 3 * t - 2, 3 * r - 2, t])
    return splines


def _dot(weights: list[Tensor], values: list[Tensor]) -> Tensor:
    total = weights[0] * values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = torch.addcmul(total, weight, value)
    return total
