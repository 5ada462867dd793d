"""Sub-pixel sampling of images, and Gaussian blur.

Pixel (0, 0) is the centre of the top-left pixel, u runs along the rows of the image and v down its
columns. An image of h x w pixels covers -1/2 <= u < w - 1/2 and -1/2 <= v < h - 1/2; a point there
is *inside*. Beyond the outermost centres the border pixels continue for ever, so a sample outside
has a value too, and no derivative across the border.

By default: `sample_bilinear`. A bilinear interpolant has slopes that jump at pixel borders and no
curvature along an axis; a cost that needs smooth derivatives samples a gradient image as further
channels, or a spline (`torchcss.vision.spline`).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from torchcss.errors import ShapeError, check_shape
from torchcss.kernels import compiler
from torchcss.kernels.checked import run


def gaussian_blur(image: Float[Tensor, "*batch h w"], sigma: float) -> Float[Tensor, "*batch h w"]:
    """Blur with a Gaussian cut at three standard deviations, the border replicated.

    Args:
        image: Any number of images.
        sigma: Standard deviation, pixels.
    """
    radius = math.ceil(3.0 * sigma)
    place = torch.arange(radius + 1, dtype=torch.float64, device=image.device)
    weight = (-0.5 * (place / sigma).square()).exp()
    weight = (weight / (2 * weight.sum() - weight[0])).to(image)
    # Rows of a window stand apart in memory, and loops over such are three times as slow.
    images = image.reshape(-1, *image.shape[-2:]).contiguous()
    if has_kernels(image):
        from torchcss.vision.blur_kernels import AT_ONCE, blur

        weight = functional.pad(weight, (0, -radius % AT_ONCE))
        line = image.new_empty(image.shape[-1] + 2 * (len(weight) - 1))
        blurred = torch.empty_like(images)
        for one, into in zip(images.detach(), blurred, strict=True):
            run(blur, one, weight, line, into)
        return blurred.reshape(image.shape)
    both = torch.cat([weight[1:].flip(0), weight])
    padded = functional.pad(images[:, None], (radius,) * 4, mode="replicate")
    along_u = functional.conv2d(padded, both[None, None, None])
    return functional.conv2d(along_u, both[None, None, :, None]).reshape(image.shape)


def has_kernels(images: Tensor) -> bool:
    """Whether loops over these images have compiled twins, which keep no gradient."""
    plain = images.device.type == "cpu" and not (images.requires_grad and torch.is_grad_enabled())
    return compiler.COMPILED and plain and not torch.compiler.is_compiling()


def sample_bilinear(
    image: Float[Tensor, "c h w"], uv: Float[Tensor, "*batch p 2"]
) -> tuple[Float[Tensor, "*batch p c"], Bool[Tensor, "*batch p"]]:
    """Interpolate an image between its four nearest pixels.

    Args:
        image: Any number of channels; converted to the dtype of `uv`.
        uv: Pixel coordinates.

    Returns:
        The values, those of the nearest border point outside the image, and whether each
        point is inside the image.

    Raises:
        ShapeError: If `image` is not `[c, h, w]` with at least one pixel or `uv` not `[..., 2]`.
    """
    return interpolate_bilinear(image, uv), inside_image(uv, *image.shape[1:])


def interpolate_bilinear(
    image: Float[Tensor, "c h w"], uv: Float[Tensor, "*batch p 2"]
) -> Float[Tensor, "*batch p c"]:
    """The same without the test for being inside.

    It is fastest where the coordinates are two blocks in memory, all u and then all v.

    Args:
        image: Any number of channels; converted to the dtype of `uv`.
        uv: Pixel coordinates.

    Raises:
        ShapeError: If `image` is not `[c, h, w]` with at least one pixel or `uv` not `[..., 2]`.
    """
    height, width = _checked_size(image, uv)
    scale = uv.new_tensor([2.0 / width, 2.0 / height])
    grid = ((uv + 0.5) * scale - 1.0).reshape(1, 1, -1, 2)
    # Measured faster than gathering the corners: 24 ms against 27 to 105 ms per million points.
    values = functional.grid_sample(
        image.to(uv)[None], grid, mode="bilinear", padding_mode="border", align_corners=False
    )
    return values[0, :, 0].mT.reshape(*uv.shape[:-1], image.shape[0])


def inside_image(uv: Float[Tensor, "*batch 2"], height: int, width: int) -> Bool[Tensor, "*batch"]:
    """Tell which points lie on a pixel of an image.

    Args:
        uv: Pixel coordinates.
        height: Rows of the image.
        width: Columns of the image.
    """
    u, v = uv.unbind(-1)
    return (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)


def _checked_size(image: Tensor, uv: Tensor) -> tuple[int, int]:
    if image.ndim != 3 or image.numel() == 0:
        raise ShapeError(
            f"image: expected [c, h, w] with at least one pixel, got {list(image.shape)}; "
            "add a channel dimension with image[None]"
        )
    check_shape("uv", uv, 2)
    return image.shape[1], image.shape[2]
