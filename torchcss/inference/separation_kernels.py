"""Choosing modes that are unlike each other, compiled; the twin is `mixture.separated`.

There, each choice takes eight operations on a few kilobytes, whose calls are most of their time.
"""

from __future__ import annotations

from torchcss.kernels.compiler import entry, inlined


@entry
def separate(points, distance, num, taken, left):  # type: ignore[no-untyped-def]
    """Take modes in their order that are unlike those taken before.

    Args:
        points: Landmarks of each mode, `[k m d]`.
        distance: Two modes are alike if no landmark is this far from where it is in the other.
        num: How many to take.
        taken: Becomes whether each mode is taken, `[k]`.
        left: Becomes whether each is unlike all that are taken, `[k]`.
    """
    for k in range(len(points)):
        taken[k], left[k] = False, True
    found = 0
    for best in range(len(points)):
        if found == num or not left[best]:
            continue
        taken[best], found = True, found + 1
        for k in range(best, len(points)):
            if left[k]:
                left[k] = _is_apart(points[best], points[k], distance)


@inlined
def _is_apart(first, second, distance):  # type: ignore[no-untyped-def]
    """Whether a landmark of one mode is so far from where it is in another."""
    for m in range(len(first)):
        square = 0.0 * first[m, 0]
        for d in range(first.shape[1]):
            square += (first[m, d] - second[m, d]) ** 2
        if square >= distance * distance:
            return True
    return False
