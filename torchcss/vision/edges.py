"""Edge energy: where the image has an outline, whatever the light.

Section 3.1.2 [IJRR]: the images are smoothed with a Gaussian kernel, contrast normalised, and put
through a Sobel edge detector. In formulas, for a grey image I in 0..1 and a Gaussian blur G_s of s
pixels:

    smooth      S = G_smoothing * I
    detail      T = S - G_window * S
    deviation   D = sqrt(pi / 2) G_window * |T|
    normalised  N = T / sqrt(D^2 + floor^2)
    gradient    g = sqrt(2 pi) smoothing Sobel(N)
    energy      E = |g|^2 / (|g|^2 + half_energy_step^2)

Without a window there is no contrast normalisation, as in [RR] 3.2: N = S / floor.

D is the local standard deviation, estimated from absolute deviations so that one strong edge in the
window does not hide its neighbours; the floor is the noise below which a region counts as flat. The
factor of g makes a clean step of h deviations have |g| = h, whatever the smoothing. E is in [0, 1).

Where a mask of the foreground is known, `foreground_weight` makes of it the weight of the edges:
one on the body and its outline, lower far from it.

By default: `edge_features(grey)`; `FeatureExtractor` calls it for every frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchcss.errors import ShapeError, check_positive
from torchcss.types import frozen
from torchcss.vision.sampling import gaussian_blur

Image = Float[Tensor, "h w"]

_ROUNDING = 1.0e-4
"""Gradients of the normalised image below this are rounding; a flat image has energy zero."""


@frozen
class EdgeConfiguration:
    """Choices of the edge detector; the papers give none of these numbers.

    Attributes:
        smoothing: Standard deviation of the Gaussian smoothing, pixels.
        window: Standard deviation of the window of the contrast normalisation, pixels; None: there
            is none.
        floor: Least local standard deviation, grey levels of 0..1; without a window the only one.
        half_energy_step: The step, in local standard deviations, whose energy is one half.
    """

    smoothing: float = 1.2
    window: float | None = 16.0
    floor: float = 0.06
    half_energy_step: float = 1.0

    def __post_init__(self) -> None:
        check_positive(self, "smoothing", "window", "floor", "half_energy_step", finite=True)


class EdgeFeatures(NamedTuple):
    """The edges of one image.

    Attributes:
        energy: Edge energy in [0, 1); exactly zero where the image is flat.
        direction: Unit vector (along u, along v) from dark to bright; zero where the energy is.
        gradient: Gradient of the normalised image (along u, along v), in the units of a step that
            many local standard deviations high.
    """

    energy: Image
    direction: Float[Tensor, "2 h w"]
    gradient: Float[Tensor, "2 h w"]


def edge_features(grey: Image, configuration: EdgeConfiguration | None = None) -> EdgeFeatures:
    """Find the edges of a grey image.

    Args:
        grey: Grey levels in 0..1.
        configuration: Choices of the detector; None takes the defaults.

    Raises:
        ShapeError: If the image is not `[h, w]` with at least one pixel or not of a real floating
            point type.
    """
    _check_image("grey", grey)
    choice = configuration or EdgeConfiguration()
    height, width = grey.shape
    smooth = gaussian_blur(grey[None, None], choice.smoothing)
    if choice.window is None:
        normalised = smooth / choice.floor
    else:
        detail = smooth - gaussian_blur(smooth, choice.window)
        deviation = math.sqrt(0.5 * math.pi) * gaussian_blur(detail.abs(), choice.window)
        normalised = detail / torch.sqrt(deviation.square() + choice.floor**2)
    gradient = _sobel(normalised)
    # The border is replicated, which halves the slope across it.
    if width > 1:
        gradient[0, :, 0] *= 2.0
        gradient[0, :, -1] *= 2.0
    if height > 1:
        gradient[1, 0] *= 2.0
        gradient[1, -1] *= 2.0
    gradient = math.sqrt(2.0 * math.pi) * choice.smoothing * gradient

    squared = gradient.square().sum(dim=0)
    present = squared > _ROUNDING**2
    squared = torch.where(present, squared, 0.0)
    gradient = torch.where(present, gradient, 0.0)
    energy = squared / (squared + choice.half_energy_step**2)
    direction = gradient / torch.where(present, squared, 1.0).sqrt()
    return EdgeFeatures(energy, direction, gradient)


def _sobel(image: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "2 h w"]:
    """Derivatives along u and v over three by three pixels, the border replicated.

    In slices: the size is another one in every frame, and a convolution is made for its size.
    """
    padded = functional.pad(image, (1, 1, 1, 1), mode="replicate")[0, 0]
    rows = padded[:-2] + 2 * padded[1:-1] + padded[2:]
    columns = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
    return torch.stack([rows[:, 2:] - rows[:, :-2], columns[2:] - columns[:-2]]) / 8


def _check_image(name: str, image: Tensor) -> None:
    if image.ndim != 2 or image.numel() == 0 or not image.is_floating_point():
        raise ShapeError(
            f"{name}: expected a floating-point image [h, w] with at least one pixel, "
            f"got {image.dtype} {list(image.shape)}"
        )


def foreground_weight(mask: Image, *, band: float = 8.0, background: float = 0.3) -> Image:
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
    """
    _check_image("mask", mask)
    reach = round(band)
    wide = mask[None, None]
    # A square is dilated one axis after the other; beyond the border there is no foreground.
    wide = functional.max_pool2d(wide, (1, 2 * reach + 1), stride=1, padding=(0, reach))
    wide = functional.max_pool2d(wide, (2 * reach + 1, 1), stride=1, padding=(reach, 0))
    soft = gaussian_blur(wide, 0.5 * band)[0, 0]
    return background + (1.0 - background) * soft.clamp(0.0, 1.0)
