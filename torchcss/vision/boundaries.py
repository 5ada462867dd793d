"""Motion boundaries: where neighbouring pixels move apart, as a smooth field over the image.

Section 3.1.2 [IJRR] processes the outlier map of the robust flow like edges into a smooth potential
S_p in [0, 1] and weights the edges found in the image by W = 1 - k S_p, so that outlines of moving
things count for more than texture and shadows. In formulas, for the outlier map o of the smoothness
term and a Gaussian blur G_s of s pixels:

    line       x = sqrt(2 pi) (s / 2) G_s * o        1 on a clean boundary, two outliers wide
    strength   B = x^2 / (x^2 + half_strength_line^2)
    potential  S_p = 1 - B

The flow is known on the grid of the frame before, and the edges are those of this frame: outliers
are `displaced` along the flow first.

The sign deserves a word: with W = 1 - k S_p the text wants k = 1 to exclude every edge that is
*not* on a motion boundary, so S_p is low on boundaries and 1 elsewhere, a potential with the
boundaries as its valleys.

Only the smoothness term enters. The data term's outliers are occluded strips beside a boundary,
but also glints and aliasing: on the two Middlebury pairs of the tests, adding them lowered the
precision and left the recall as it was; alone they reach an F score of 0.62 and 0.76, where the
smoothness term reaches 0.88 and 0.90.

By default: `motion_boundaries(flow)`.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.errors import ShapeError
from torchcss.kernels.checked import run
from torchcss.vision.flow import OpticalFlow
from torchcss.vision.sampling import gaussian_blur
from torchcss.vision.warping import has_flow_kernels

Images = Float[Tensor, "*batch h w"]

_LEAST_OUTLIER = 1e-3
"""What is less of an outlier is none."""


def motion_boundaries(
    flow: OpticalFlow, *, smoothing: float = 1.5, half_strength_line: float = 0.5
) -> Images:
    """Turn the outlier map of the smoothness term into the potential S_p of the second frame.

    Args:
        flow: What `robust_flow` returns. A flow under quadratic potentials has no outliers, so
            no boundaries either.
        smoothing: Standard deviation of the Gaussian smoothing, pixels. The papers give none.
        half_strength_line: The line response, 1 on a clean boundary, whose strength is one half.

    Raises:
        ShapeError: If the outlier map is not `[..., h, w]` with at least one pixel.
    """
    outlier = flow.smoothness_outlier
    if outlier.ndim < 2 or outlier.numel() == 0:
        raise ShapeError(
            f"smoothness_outlier: expected [..., h, w] with at least one pixel, "
            f"got {list(outlier.shape)}"
        )
    if flow.flow.shape != (*outlier.shape[:-2], 2, *outlier.shape[-2:]):
        raise ShapeError(
            f"flow: expected two numbers for each pixel of smoothness_outlier "
            f"{list(outlier.shape)}, got {list(flow.flow.shape)}"
        )
    outlier = displaced(outlier, flow.flow, reach=math.ceil(2 * smoothing))
    blurred = gaussian_blur(outlier, smoothing)
    squared = (math.sqrt(0.5 * math.pi) * smoothing * blurred).square()
    return 1.0 - squared / (squared + half_strength_line**2)


def displaced(outlier: Images, flow: Float[Tensor, "*batch 2 h w"], *, reach: int) -> Images:
    """Outliers of the flow's smoothness on the grid of the frame that the flow leads to.

    A boundary moves with what is in front, which the flow does not tell: each outlier goes where
    the pixels about it go, on either side of the boundary, and the greatest stays. Where what is
    behind stands still, the place that the boundary has left is among these.

    Args:
        outlier: In 0..1, at the pixels of the frame before.
        flow: Displacement from there to here, pixels.
        reach: How far from a boundary both sides move as they are, pixels.
    """
    height, width = outlier.shape[-2:]
    outliers, moves = outlier.reshape(-1, height, width), flow.reshape(-1, 2, height, width)
    if has_flow_kernels(outliers) and moves.dtype == outliers.dtype:
        from torchcss.vision import flow_kernels

        arrived = outliers.new_zeros(len(outliers), 5, height, width)
        for mark, move, into in zip(outliers, moves, arrived, strict=True):
            run(flow_kernels.displace, mark, move.contiguous(), reach, _LEAST_OUTLIER, into)
        return arrived.amax(1).clamp(max=1.0).reshape(outlier.shape)
    found = torch.zeros_like(outliers).flatten()
    image, row, column = torch.nonzero(outliers > _LEAST_OUTLIER, as_tuple=True)
    mark = outliers[image, row, column]
    for down, right in ((0, 0), (0, reach), (0, -reach), (reach, 0), (-reach, 0)):
        side = (row + down).clamp(0, height - 1), (column + right).clamp(0, width - 1)
        move = moves[image, :, *side]
        to = torch.stack([column, row], -1) + move
        first = to.floor()
        share = to - first
        arrived = torch.zeros_like(found)
        for x in (0, 1):
            for y in (0, 1):
                u, v = (first + first.new_tensor([x, y])).unbind(-1)
                inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
                pixel = torch.where(inside, v * width + u, 0.0)
                part = (share[:, 0] if x else 1 - share[:, 0]) * (
                    share[:, 1] if y else 1 - share[:, 1]
                )
                place = image * (height * width) + pixel.long()
                arrived.index_add_(0, place, torch.where(inside, mark * part, 0.0))
        found = found.maximum(arrived.clamp(max=1.0))
    return found.reshape(outlier.shape)
