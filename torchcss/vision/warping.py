"""Images between their pixels, and constant brightness made linear in the flow.

Between pixels an image is the natural cubic spline through them, here with its exact slopes. Cubic
convolution, which needs no coefficients, blurs what it samples: on smooth images the flow found
with it is biased by 0.04 px towards whole pixels, with the spline by less than 0.01 (measured).

By default: `image_spline(images)` of both frames, then `constancy_about` each flow.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchcss.kernels.checked import run
from torchcss.vision import sampling

Images = Float[Tensor, "b c h w"]
"""Any images."""
Field = Float[Tensor, "b 2 h w"]
"""Two numbers for each pixel, along u and along v."""
Plane = Float[Tensor, "b 1 h w"]
"""One number for each pixel."""
Coefficients = Float[Tensor, "b c h+3 w+3"]
"""Of splines: of a pixel before the image, of its own, and of two behind it, along u and v."""

_ROUNDING = 1.0e-5
"""Gradients below this, grey levels per pixel, are rounding; they say nothing of the motion."""


class Constancy(NamedTuple):
    """Constant brightness, linear in the flow: the residual is offset + gradient . flow."""

    gradient: Field
    offset: Plane
    visible: Plane

    def residual(self, flow: Field) -> Plane:
        """By how much brightness differs under a flow."""
        return self.offset + (self.gradient * flow).sum(dim=1, keepdim=True)


def has_flow_kernels(images: Tensor) -> bool:
    """Whether the loops over these images have compiled twins."""
    return images.dtype == torch.float32 and sampling.has_kernels(images)


def image_spline(images: Images) -> Coefficients:
    """Coefficients of the natural cubic B-spline through each image.

    Its second derivatives across the border are zero there: what is added to the coefficients goes
    on in a straight line.
    """
    if has_flow_kernels(images):
        from torchcss.vision import flow_kernels

        height, width = images.shape[-2:]
        found = images.new_empty(*images.shape[:2], height + 3, width + 3)
        memory = images.new_empty(max(height, width))
        for image, to in zip(images.flatten(0, 1), found.flatten(0, 1), strict=True):
            run(flow_kernels.spline, image, memory, to)
        return found
    return _spline_along_u(_spline_along_u(images).mT).mT


def _spline_along_u(values: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n+3"]:
    num = values.shape[-1]
    if num > 1:
        # The pixels at the ends are coefficients themselves.
        inner = values.new_full((num - 2,), 1 / 6)
        own = functional.pad(4 * inner, (1, 1), value=1.0)
        left, right = functional.pad(inner, (0, 1)), functional.pad(inner, (1, 0))
        matrix = own.diag() + left.diag(-1) + right.diag(1)
        # `solve` would make an accelerator wait to see whether the matrix is singular.
        values = torch.linalg.solve_ex(matrix.mT, values, left=False).result
        before, behind = (
            2 * edge - next_to_it
            for edge, next_to_it in (
                (values[..., :1], values[..., 1:2]),
                (values[..., -1:], values[..., -2:-1]),
            )
        )
    else:
        before = behind = values
    return torch.cat([before, values, behind, behind], dim=-1)


def image_slopes(spline: Coefficients) -> Field:
    """Slopes along u and v at the pixels of each image of one channel."""
    if has_flow_kernels(spline):
        from torchcss.vision import flow_kernels

        height, width = (length - 3 for length in spline.shape[-2:])
        found = spline.new_empty(len(spline), 2, height, width)
        for (one,), along in zip(spline, found, strict=True):
            run(flow_kernels.slopes, one, *along)
        return found
    part = spline[..., :-1, :-1]

    def slope_along_u(part: Tensor) -> Tensor:
        steps = (part[..., 2:] - part[..., :-2]) / 2
        return (steps[..., :-2, :] + 4 * steps[..., 1:-1, :] + steps[..., 2:, :]) / 6

    return torch.cat([slope_along_u(part), slope_along_u(part.mT).mT], dim=1)


def constancy_about(
    flow: Field, first: Float[Tensor, "b 3 h w"], second: Coefficients
) -> Constancy:
    """Warp the second frame; the gradient is the mean of both frames', zero where it is noise.

    Args:
        flow: Where pixels go.
        first: Grey levels of the first frame, and their slopes.
        second: Spline through the other, of one channel.
    """
    if has_flow_kernels(flow):
        from torchcss.vision import flow_kernels

        gradient = torch.empty_like(flow, memory_format=torch.contiguous_format)
        offset = torch.empty_like(gradient[:, :1])
        found = Constancy(gradient, offset, torch.empty_like(offset))
        for x, one, (two,), to, (rest,), (seen,) in zip(flow, first, second, *found, strict=True):
            run(flow_kernels.linearise, x, one, two, _ROUNDING**2, to, rest, seen)
        return found
    warped, gradient, visible = _sampled(second, flow)
    gradient = 0.5 * (first[:, 1:] + gradient)
    seen = gradient.square().sum(dim=1, keepdim=True) > _ROUNDING**2
    gradient = torch.where(seen, gradient, 0.0)
    offset = warped - first[:, :1] - (gradient * flow).sum(dim=1, keepdim=True)
    return Constancy(gradient, offset, visible)


def _sampled(spline: Coefficients, flow: Field) -> tuple[Plane, Field, Plane]:
    """Values and slopes at x + flow; also 1 where that is inside the image, 0 elsewhere."""
    height, width = flow.shape[-2:]
    u = flow[:, 0] + torch.arange(width, dtype=flow.dtype, device=flow.device)
    v = flow[:, 1] + torch.arange(height, dtype=flow.dtype, device=flow.device)[:, None]
    inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    u, v = u.clamp(0, width - 1), v.clamp(0, height - 1)
    left, top = u.floor(), v.floor()
    (shares_u, slopes_u), (shares_v, slopes_v) = _basis(u - left), _basis(v - top)
    corner = (top * (width + 3) + left).long().flatten(1)
    flat = spline.flatten(1)
    value = slope_u = slope_v = torch.zeros_like(u)
    for row in range(4):
        taps = [
            flat.gather(1, corner + row * (width + 3) + column).view_as(u) for column in range(4)
        ]
        along = sum(share * tap for share, tap in zip(shares_u, taps, strict=True))
        value = value + shares_v[row] * along
        slope_v = slope_v + slopes_v[row] * along
        along = sum(slope * tap for slope, tap in zip(slopes_u, taps, strict=True))
        slope_u = slope_u + shares_v[row] * along
    return value[:, None], torch.stack([slope_u, slope_v], dim=1), inside[:, None].to(flow.dtype)


def _basis(t: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """Shares of the four coefficients about a place that is t behind the second, and slopes."""
    s = 1 - t
    shares = [
        s * s * s / 6,
        ((3 * t - 6) * t * t + 4) / 6,
        ((3 * s - 6) * s * s + 4) / 6,
        t * t * t / 6,
    ]
    rises = [-s * s / 2, (1.5 * t - 2) * t, (2 - 1.5 * s) * s, t * t / 2]
    return shares, rises
