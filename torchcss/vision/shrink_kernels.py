"""Pictures of whole numbers made smaller, compiled; the twin is `torch.nn.functional.interpolate`.

That wants floating-point pixels, channel by channel: turning a large picture into these takes
longer than all sums. Here the pixels are read as they are.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from torchcss.kernels.compiler import entry


@lru_cache(maxsize=8)
def triangles(size: int, new: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the pixels of a row that make each pixel of a smaller one.

    As `interpolate` has them with `mode="bilinear"` and `antialias`: a triangle about the centre of
    the new pixel that reaches the centres of its neighbours.

    Args:
        size: Pixels.
        new: Pixels of the smaller row.

    Returns:
        The first pixel that counts, `[new]`, and the weights from it on, `[new taps]`.
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
    for row, by in zip(weight, shift, strict=True):
        row[:] = np.roll(row, by)
    return first - shift, weight.astype(np.float32)


@entry
def shrink(picture, top, down, left, across, row, small):  # type: ignore[no-untyped-def]
    """Make a picture smaller.

    Args:
        picture: Whole numbers, the channels of a pixel one after the other, `[h w*c]`.
        top: First row that counts for each new one, `[y]`, see `triangles`.
        down: Weights of the rows, `[y taps]`.
        left: First column that counts for each new one, `[x]`.
        across: Weights of the columns, `[x taps]`.
        row: Memory for a row, `[w*c]`, single precision.
        small: Becomes the picture, `[c y x]`, single precision.
    """
    channels, height, width = small.shape
    for y in range(height):
        for k in range(len(row)):
            row[k] = 0.0
        for tap in range(down.shape[1]):
            weight, source = down[y, tap], picture[top[y] + tap]
            for k in range(len(row)):
                row[k] += weight * np.float32(source[k])
        for c in range(channels):
            for x in range(width):
                total, first = np.float32(0), left[x] * channels + c
                for tap in range(across.shape[1]):
                    total += across[x, tap] * row[first + tap * channels]
                small[c, y, x] = total
