"""Colours of things and of what surrounds them, and how much a pixel looks like either.

Section 8 [IJRR] weighs contours by a segmentation into foreground and background, and expects more
of what looks at the person as a whole. Here the colours of each thing (a layer) and of its
surroundings are histograms, learned from frames in which it is known where the thing is, and
forgotten by degrees. For a pixel of colour c,

    tanh(1/2 log p(c | thing) / p(c | surroundings)) = P(thing | c) - P(surroundings | c)

is its foreground log-likelihood ratio, squashed to -1..1 (with equal prior odds): 1 where only the
thing has that colour, -1 where only the surroundings have, 0 where both or neither do. Where it is
known what a pixel looks like with nobody before it (`torchcss.vision.background`), that density
takes the place of the surroundings' as far as it is trusted.

By default: `Appearance.unknown`, then per frame `foreground_ratio`, and `learn` once the thing is
found.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.vision.background import Background
from torchcss.vision.sampling import has_kernels

Histograms = Float[Tensor, "layers bins"]

BINS = 12
"""Bins per colour channel."""

_FEWEST = 30.0
"""Pixels from which a histogram counts as known."""

_FLOOR = 3e-5
"""Probability of any bin besides what was seen, against a mean of 1 / 1728."""


class Appearance(NamedTuple):
    """Colour histograms of some layers.

    Attributes:
        inside: Share of the pixels of each thing in each bin; zero if it was never seen.
        outside: The same of its surroundings.
    """

    inside: Histograms
    outside: Histograms

    @classmethod
    def unknown(cls, num_layers: int, *, like: Tensor) -> Appearance:
        """What is known before the first frame.

        Args:
            num_layers: Number of things.
            like: A tensor of the dtype and on the device wanted.
        """
        nothing = like.new_zeros(num_layers, BINS**3)
        return cls(nothing, nothing.clone())

    def learn(
        self,
        colour: Float[Tensor, "3 h w"],
        inside: Bool[Tensor, "layers h w"],
        outside: Bool[Tensor, "layers h w"],
        *,
        inside_rate: float = 0.05,
        outside_rate: float = 0.2,
    ) -> Appearance:
        """Take in a frame in which the things were found.

        Args:
            colour: Red, green, blue in 0..1.
            inside: Pixels of each thing.
            outside: Pixels of its surroundings.
            inside_rate: Share of the new frame in the things' colours, where they are known.
            outside_rate: The same for the surroundings.
        """
        bins = colour_bins(colour)
        return Appearance(
            _mix(self.inside, bins, inside, inside_rate),
            _mix(self.outside, bins, outside, outside_rate),
        )

    def foreground_ratio(
        self, colour: Float[Tensor, "3 h w"], background: Background | None = None
    ) -> Float[Tensor, "layers h w"]:
        """Foreground log-likelihood ratio of each pixel for each thing, squashed to -1..1.

        Where no background is known, 0 for a thing never seen; of such a thing every colour is as
        likely as any other.

        Args:
            colour: Red, green, blue in 0..1.
            background: What the pixels look like with nobody before them; None: not known.
        """
        bins = colour_bins(colour)
        known = (self.inside.sum(-1) > 0) & (self.outside.sum(-1) > 0)
        inside, outside = ((_smooth(part) + _FLOOR).log() for part in (self.inside, self.outside))
        if background is None:
            ratio = (0.5 * torch.where(known[:, None], inside - outside, 0.0)).tanh()
            # Several times faster than by two-dimensional indices.
            return ratio.to(colour).index_select(1, bins.flatten()).unflatten(1, bins.shape)
        # Densities over the unit cube of colours, as the background's.
        inside, outside = (
            torch.where(known[:, None], part + math.log(BINS**3), 0.0)[:, bins]
            for part in (inside, outside)
        )
        trust = background.confidence
        behind = background.log_density(colour) + trust.log()
        either = torch.logaddexp(behind, outside + (1 - trust).log())
        seeing = (0.5 * (inside - either)).tanh()
        # Who stands still looks the same too: a guess may silence the colours, not overrule them.
        blind = (0.5 * (inside - outside)).tanh()
        return torch.where(background.sure, seeing, seeing.maximum(blind.clamp(max=0)))


def colour_bins(colour: Float[Tensor, "3 h w"]) -> Int[Tensor, "h w"]:
    """The bin of each pixel.

    Args:
        colour: Red, green, blue in 0..1.
    """
    red, green, blue = (colour * BINS).int().clamp_(0, BINS - 1)
    return (red * BINS + green) * BINS + blue


def _mix(old: Histograms, bins: Tensor, masks: Tensor, rate: float) -> Histograms:
    counts = _counts(bins, masks)
    number = counts.sum(-1, keepdim=True)
    new = counts.to(old) / number
    mixed = torch.where(old.sum(-1, keepdim=True) > 0, old.lerp(new, rate), new)
    return torch.where(number >= _FEWEST, mixed, old)


def _counts(bins: Int[Tensor, "h w"], masks: Bool[Tensor, "layers h w"]) -> Tensor:
    """Pixels of each mask in each bin."""
    if has_kernels(masks):
        # NumPy's count is such a loop: twenty times as fast as the sums over all pixels.
        rows = [np.bincount(bins.numpy()[mask], minlength=BINS**3) for mask in masks.numpy()]
        return torch.from_numpy(np.reshape(rows, (-1, BINS**3)))
    # `bincount` would have the host wait for the greatest bin.
    counts = torch.zeros(len(masks), BINS**3, dtype=torch.long, device=masks.device)
    return counts.scatter_add_(
        1, bins.flatten().long().expand(len(masks), -1), masks.flatten(1).long()
    )


def _smooth(histograms: Histograms) -> Histograms:
    """Spread each bin over its neighbours, by 1/4, 1/2, 1/4 along each channel."""
    cube = histograms.reshape(-1, BINS, BINS, BINS)
    for axis in (1, 2, 3):
        smooth, inner = 0.5 * cube, BINS - 1
        smooth.narrow(axis, 0, inner).add_(cube.narrow(axis, 1, inner), alpha=0.25)
        smooth.narrow(axis, 1, inner).add_(cube.narrow(axis, 0, inner), alpha=0.25)
        cube = smooth
    return cube.reshape(histograms.shape)
