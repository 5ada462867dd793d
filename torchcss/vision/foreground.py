"""Foreground weighting: edges near the foreground count more than edges of the background.

Section 8 [IJRR] weights the importance of contours by a foreground/background segmentation. A mask
from any source, soft or hard, becomes a weight image that the edge field is multiplied by:

    weight = background + (1 - background) G_{band/2} * dilate(mask, band)

It is 1, up to two percent, on the foreground and its outline, thin limbs included, and falls to
`background` over a band outside it. The inside keeps its full weight, for an arm in front of the
torso has its outline there. The weight never reaches zero by default: masks are wrong at times, and
an edge that is merely doubted can still hold the body. A mask without any foreground doubts all
edges alike.

By default: `foreground_weight(mask)`; `FrameFeatures.edge_field` calls it where there is a mask.
"""

from __future__ import annotations

import math

import kornia
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchcss.errors import ConfigurationError, ShapeError


def foreground_weight(
    mask: Float[Tensor, "h w"], *, band: float = 8.0, background: float = 0.3
) -> Float[Tensor, "h w"]:
    """Turn a mask into the weight of the edges.

    Args:
        mask: Foreground in 0..1; values between are degrees of belief.
        band: How far outside the foreground edges still count, pixels: the weight is halfway down
            there. It covers the error of the mask.
        background: Weight far from the foreground, 0 to 1.

    Returns:
        Weights from `background` to 1.

    Raises:
        ShapeError: If the mask is not a floating-point image `[h, w]` with at least one pixel.
        ConfigurationError: If the band is not positive or the weight not in 0..1.
    """
    if mask.ndim != 2 or mask.numel() == 0 or not mask.is_floating_point():
        raise ShapeError(
            f"mask: expected a floating-point image [h, w] with at least one pixel, "
            f"got {mask.dtype} {list(mask.shape)}"
        )
    if not (math.isfinite(band) and band > 0.0):
        raise ConfigurationError(f"foreground: band must be positive and finite, got {band}")
    if not 0.0 <= background <= 1.0:
        raise ConfigurationError(f"foreground: background must lie in 0..1, got {background}")
    reach = round(band)
    wide = mask[None, None]
    # A square is dilated one axis after the other; beyond the border there is no foreground.
    wide = functional.max_pool2d(wide, (1, 2 * reach + 1), stride=1, padding=(0, reach))
    wide = functional.max_pool2d(wide, (2 * reach + 1, 1), stride=1, padding=(reach, 0))
    sigma = 0.5 * band
    size = 2 * math.ceil(3.0 * sigma) + 1
    soft = kornia.filters.gaussian_blur2d(
        wide, (size, size), (sigma, sigma), border_type="replicate"
    )
    return background + (1.0 - background) * soft[0, 0].clamp(0.0, 1.0)
