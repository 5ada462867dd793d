"""Gaussian blur, compiled; the twin is the convolution in `torchcss.vision.sampling`.

A row at a time: the rows about it are added up into one, which is then blurred along itself while
it is still at hand. What is added up are slices, as long as each other: an index that a number is
added to might count from the end, and loops over such are not turned into vector code.
"""

from __future__ import annotations

from torchcss.kernels.compiler import entry


@entry
def blur(image, weight, line, blurred):  # type: ignore[no-untyped-def]
    """Blur an image, the border replicated.

    Args:
        image: Pixels, `[h w]`.
        weight: Of a pixel, of its neighbours, of theirs, and so on, `[r+1]`.
        line: Memory for a row with its border, `[w+2r]`.
        blurred: Becomes the blurred image, `[h w]`.
    """
    height, width = image.shape
    radius = len(weight) - 1
    middle = line[radius : radius + width]
    for y in range(height):
        row, out, share = image[y], blurred[y], weight[0]
        for x in range(width):
            middle[x] = share * row[x]
        for k in range(1, radius + 1):
            above, below, share = image[max(y - k, 0)], image[min(y + k, height - 1)], weight[k]
            for x in range(width):
                middle[x] += share * (above[x] + below[x])
        for k in range(radius):
            line[k], line[radius + width + k] = middle[0], middle[width - 1]
        share = weight[0]
        for x in range(width):
            out[x] = share * middle[x]
        for k in range(1, radius + 1):
            share, right = weight[k], radius + k
            before, after = line[radius - k : right - 2 * k + width], line[right : right + width]
            for x in range(width):
                out[x] += share * (before[x] + after[x])
