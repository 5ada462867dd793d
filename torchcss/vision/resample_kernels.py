"""Pictures at another size, compiled; the twin is `torch.nn.functional.interpolate`.

That wants floating-point pixels, channel by channel: turning a large picture of whole numbers into
these takes longer than all sums. Here the pixels are read as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from torch import Tensor

from torchcss.kernels.checked import run
from torchcss.kernels.compiler import entry

Weights = Callable[[int, int], tuple[np.ndarray, np.ndarray]]
"""Weights of the pixels of a row, such as `triangles`."""


@lru_cache(maxsize=32)
def triangles(size: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the pixels of a row that make each pixel of a smaller one.

    As `interpolate` has them with `mode="bilinear"` and `antialias`: a triangle about the centre of
    the new pixel that reaches the centres of its neighbours.

    Args:
        size: Pixels.
        new: Pixels of the smaller row.

    Returns:
        The first pixel that counts, `[new]`, and the weights from it on, `[taps new]`.
    """
    scale = size / new
    centre = (np.arange(new) + 0.5) * scale
    first = np.maximum((centre - scale + 0.5).astype(np.int64), 0)
    last = np.minimum((centre + scale + 0.5).astype(np.int64), size)
    pixel = first[:, None] + np.arange((last - first).max())
    weight = np.maximum(1 - np.abs(pixel + 0.5 - centre[:, None]) / scale, 0)
    weight *= pixel < last[:, None]
    weight /= weight.sum(1, keepdims=True)
    # Beyond the row all weights are zero; the pixels before those are as good.
    shift = np.maximum(first + weight.shape[1] - size, 0)
    for row in np.flatnonzero(shift):
        weight[row] = np.roll(weight[row], shift[row])
    return (first - shift).astype(np.uint32), np.ascontiguousarray(weight.T, np.float32)


@lru_cache(maxsize=32)
def cubics(size: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the pixels of a row that make each pixel of a larger one.

    As `interpolate` has them with `mode="bicubic"`: cubic convolution with the slope -3/4 at one,
    the border replicated. Arguments and results as of `triangles`.
    """
    centre = (np.arange(new) + 0.5) * size / new - 0.5
    place = np.floor(centre).astype(np.int64)[:, None] + np.arange(-1, 3)
    t = np.abs(place - centre[:, None])
    near, far = (1.25 * t - 2.25) * t * t + 1, ((-0.75 * t + 3.75) * t - 6) * t + 3
    pixel = place.clip(0, size - 1)
    first = np.minimum(pixel[:, 0], max(size - 4, 0))
    weight = np.zeros((new, min(4, size)))
    np.add.at(weight, (np.arange(new)[:, None], pixel - first[:, None]), np.where(t < 1, near, far))
    return first.astype(np.uint32), np.ascontiguousarray(weight.T, np.float32)


def resize(picture: Tensor, resized: Tensor, weights: Weights) -> None:
    """Make a picture smaller, or larger.

    Args:
        picture: Numbers of any type, `[h w c]`.
        resized: Becomes the picture, `[c y x]`, single precision.
        weights: `triangles` to make it smaller, `cubics` to make it larger.
    """
    height, width, channels = picture.shape
    rows, (left, across) = (
        weights(size, new) for size, new in zip((height, width), resized.shape[1:], strict=True)
    )
    row = np.empty(width * channels, np.float32)
    columns = left * np.uint32(channels), across
    run(sum_up, picture.flatten(1), *rows, *columns, row, resized)


@entry
def sum_up(picture, top, down, left, across, row, resized):  # type: ignore[no-untyped-def]
    """Sums of rows, and of numbers in these.

    Args:
        picture: The channels of a pixel one after the other, `[h w*c]`.
        top: First row that counts for each new one, `[y]`, see `triangles`.
        down: Weights of the rows, `[taps y]`.
        left: First number that counts for each new one of the first channel, `[x]`.
        across: Weights of the columns, `[taps x]`.
        row: Memory for a row, `[w*c]`, single precision.
        resized: Becomes the picture, `[c y x]`, single precision.
    """
    channels, height, width = resized.shape
    for y in range(height):
        for k in range(len(row)):
            row[k] = 0.0
        for tap in range(len(down)):
            weight, source = down[tap, y], picture[top[y] + tap]
            for k in range(len(row)):
                row[k] += weight * np.float32(source[k])
        for c in range(channels):
            to = resized[c, y]
            for x in range(width):
                to[x] = 0.0
            for tap in range(len(across)):
                # Whole numbers without a sign do not count from the end: this is vector code.
                weights, source = across[tap], row[tap * channels + c :]
                for x in range(width):
                    to[x] += weights[x] * source[left[x]]
