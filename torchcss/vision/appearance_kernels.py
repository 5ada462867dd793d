"""How often colours are seen, compiled; the twin is the count in `torchcss.vision.appearance`."""

from __future__ import annotations

from torchcss.kernels.compiler import entry


@entry
def count_bins(bins, masks, counts):  # type: ignore[no-untyped-def]
    """Count the pixels of each layer by the bins of their colours.

    Args:
        bins: The bin of each pixel, `[h w]`.
        masks: Pixels of each layer, `[layers h w]`.
        counts: Becomes the number of pixels in each bin, `[layers bins]`; zero at first.
    """
    layers, height, width = masks.shape
    for layer in range(layers):
        for y in range(height):
            for x in range(width):
                if masks[layer, y, x]:
                    counts[layer, bins[y, x]] += 1
