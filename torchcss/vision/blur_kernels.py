"""Gaussian blur, compiled; the twin is the convolution in `torchcss.vision.sampling`.

A row at a time: the rows about it are added up into one, which is then blurred along itself while
it is still at hand. What is added up are slices, as long as each other: an index that a number is
added to might count from the end, and loops over such are not turned into vector code.
"""

from __future__ import annotations

from torchcss.kernels.compiler import entry, inlined

AT_ONCE = 3
"""Neighbours on either side that are added in one pass over a row."""


@inlined
def _add(shares, pairs, into):  # type: ignore[no-untyped-def]
    """Add pairs of rows in their shares; as many as `AT_ONCE` says."""
    p, q, r = shares[0], shares[1], shares[2]
    (a, b), (c, d), (e, f) = pairs
    for x in range(len(into)):
        into[x] += p * (a[x] + b[x]) + q * (c[x] + d[x]) + r * (e[x] + f[x])


@entry
def blur(image, weight, line, blurred):  # type: ignore[no-untyped-def]
    """Blur an image, the border replicated.

    Args:
        image: Pixels, `[h w]`.
        weight: Of a pixel, of its neighbours, of theirs, and so on, `[r+1]`, r a multiple of
            `AT_ONCE`.
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
        for k in range(1, radius + 1, AT_ONCE):
            one = image[max(y - k, 0)], image[min(y + k, height - 1)]
            two = image[max(y - k - 1, 0)], image[min(y + k + 1, height - 1)]
            three = image[max(y - k - 2, 0)], image[min(y + k + 2, height - 1)]
            _add(weight[k : k + AT_ONCE], (one, two, three), middle)
        for k in range(radius):
            line[k], line[radius + width + k] = middle[0], middle[width - 1]
        for x in range(width):
            out[x] = share * middle[x]
        for k in range(1, radius + 1, AT_ONCE):
            left, right = radius - k, radius + k
            one = line[left : left + width], line[right : right + width]
            two = line[left - 1 : left - 1 + width], line[right + 1 : right + 1 + width]
            three = line[left - 2 : left - 2 + width], line[right + 2 : right + 2 + width]
            _add(weight[k : k + AT_ONCE], (one, two, three), out)
