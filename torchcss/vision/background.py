"""What a camera that stands still sees where nobody is, pixel by pixel.

Where a limb comes out from behind the trunk, its colours are those of the clutter beside it; but
that place looked otherwise a moment ago. The papers expect help of a segmentation into foreground
and background (section 8 [IJRR]). Here every pixel that no likely pose covers teaches what is
behind: a running mean and variance of its colour. A pixel of colour c then belongs to the
background with density

    B(c) = (1 - s) N(c; mean, variance I) + s D(c)

where D is the same colour in shadow: darker by any factor down to `_DARKEST`, hue kept. A person's
own shadow moves along and is no part of the body.

Of places that were covered so far there is only a guess: what does not change may be background.
Nothing is kept when the camera moves (`learn`) or most of the picture changes (`holds`): a wrong
background is worse than none. Clothes that look like the wall behind them are taken for it, so that
in the dark a body is tracked worse than without (`docs/findings.md`).

By default: `Background.unknown`, then per frame `Appearance.foreground_ratio(colour,
background)`, and `learn` once the body is found; `torchcss.tracking.view.Observer` does it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Colours = Float[Tensor, "3 h w"]
Image = Float[Tensor, "h w"]

_DEVIATION = 0.05
"""Standard deviation of a colour channel before anything is learnt: grain and compression."""

_PRIOR_FRAMES = 4.0
"""Frames that this counts for."""

_MEMORY = 50.0
_SHORT_MEMORY = 10.0
"""Frames that mean and variance are made of at the most: light changes by degrees. The shorter one
is for pixels that have never been bare."""

_SURE = 0.9
_GUESS = 0.1
_STILL_FRAMES = 3.0
"""Prior probability that what is not the body is what the pixel showed before: where it was bare,
something else may have come there, other parts of the body or a door that has opened; where it
never was, what has not changed for some frames is a guess. Without the guess a lost limb stays in
front of clutter of its own colour, which it alone hides from being known."""

_SHADOW = 0.2
_DARKEST = 0.3
"""Share of the background that lies in a shadow that was not there, and how dark the darkest is."""

_DARK = 0.05
"""Length of a colour, of at most sqrt(3), below which its hue says nothing."""

_STRANGE = 3.0
"""Standard deviations from which a pixel looks otherwise than it did."""

_MOST_STRANGE_BARE = 0.1
_MOST_STRANGE = 0.4
"""Share of the bare pixels, and of all known ones, from which it is the camera that has moved or
the light that has changed. A person may come to stand before much of the picture."""

_LEAST_MOTION = 0.25
"""Median of the flow where nobody is, pixels, from which the camera moves."""


class Background(NamedTuple):
    """Colours of the background.

    Attributes:
        mean: Mean colour of each pixel; any where nothing is known.
        squares: Sum of the squared deviations of a channel, of so many frames as `frames` says.
        frames: Frames that each pixel is known from, at most `_MEMORY`; zero: not known.
        sure: Whether the pixel was bare in those frames; else it may have shown the body.
    """

    mean: Colours
    squares: Image
    frames: Image
    sure: Bool[Tensor, "h w"]

    @classmethod
    def unknown(cls, like: Colours) -> Background:
        """What is known before the first frame.

        Args:
            like: A picture of the size, dtype and device wanted.
        """
        nothing = torch.zeros_like(like[0])
        return cls(torch.zeros_like(like), nothing, nothing.clone(), nothing > 0)

    @property
    def confidence(self) -> Image:
        """Probability that a pixel without the body shows what it showed before."""
        guess = _GUESS * (self.frames >= _STILL_FRAMES).to(self.frames)
        return guess.masked_fill(self.sure, _SURE)

    @property
    def variance(self) -> Image:
        """Variance of a colour channel of each pixel."""
        prior = _PRIOR_FRAMES * _DEVIATION**2
        return (self.squares + prior) / (self.frames + _PRIOR_FRAMES)

    def learn(
        self, colour: Colours, bare: Bool[Tensor, "h w"], flow: Float[Tensor, "2 h w"] | None = None
    ) -> Background:
        """Take in a frame.

        Args:
            colour: Red, green, blue in 0..1.
            bare: Pixels that the body does not cover, for all that is known of its pose.
            flow: Motion since the frame before, pixels; None: not known.

        Returns:
            What is known now: of a camera that moves, nothing; where most of it looks otherwise
            than before, this frame alone.
        """
        if flow is not None and bool(bare.any()):
            # A median of a sixteenth of the pixels says as much.
            motion = flow[:, ::4, ::4].norm(dim=0)[bare[::4, ::4]]
            if motion.numel() and float(motion.median()) > _LEAST_MOTION:
                return Background.unknown(colour)
        before = self
        if self._share_strange(colour, bare) > _MOST_STRANGE_BARE:
            before = Background.unknown(colour)
        # What a pixel showed while it may have been covered counts for nothing once it is bare.
        old = torch.where(bare & ~before.sure, 0.0, before.frames)
        squares = torch.where(old > 0, before.squares, 0.0)
        sure, taken = before.sure | bare, bare | ~before.sure
        memory = torch.full_like(old, _SHORT_MEMORY).masked_fill(sure, _MEMORY)
        full = taken & (old > memory - 1)
        frames = torch.where(taken, old.minimum(memory - 1) + 1, old)
        offset = torch.where(taken, colour - before.mean, 0.0)
        mean = before.mean + offset / torch.where(old > 0, frames, 1.0).clamp(min=1)
        # Welford's update; the first frame of a pixel has no deviation yet.
        gain = torch.where(old > 0, (offset * (colour - mean)).mean(0), 0.0)
        kept = torch.where(full, 1 - 1 / memory, 1.0)
        return Background(mean, kept * squares + gain, frames, sure)

    def holds(self, colour: Colours) -> bool:
        """Whether a frame, wherever the body is in it, can be of the same scene and light.

        Args:
            colour: Red, green, blue in 0..1.
        """
        return self._share_strange(colour, torch.ones_like(self.sure)) <= _MOST_STRANGE

    def log_density(self, colour: Colours) -> Image:
        """Logarithm of B at each pixel's colour; any where nothing is known.

        Args:
            colour: Red, green, blue in 0..1.
        """
        variance, length = self.variance, self.mean.norm(dim=0).clamp(min=_DARK)
        level = (2 * math.pi * variance).log()
        lit = -0.5 * ((colour - self.mean).square().sum(0) / variance + 3 * level)
        # In shadow: spread evenly along the line from black to the colour, a Gaussian about it.
        along = (colour * self.mean).sum(0) / length
        nearest = along.clamp(min=0).maximum(_DARKEST * length).minimum(length)
        missed = colour.square().sum(0) - along.square() + (along - nearest).square()
        extent = (1 - _DARKEST) * length + (0.5 * level).exp()
        dim = -0.5 * missed / variance - level - extent.log()
        return torch.logaddexp(lit + math.log(1 - _SHADOW), dim + math.log(_SHADOW))

    def _share_strange(self, colour: Colours, where: Bool[Tensor, "h w"]) -> float:
        """Share of the sure pixels in a region that look otherwise than they did."""
        seen = where & self.sure
        if not bool(seen.any()):
            return 0.0
        squared = (colour - self.mean).square().mean(0)
        return float((squared > _STRANGE**2 * self.variance)[seen].double().mean())
