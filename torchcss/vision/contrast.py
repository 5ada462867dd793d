"""Local contrast: what a picture shows whatever the light on it.

    c = G_b * ((I - m) / sqrt(v + floor^2)),    m = G_r * I,    v = G_r * (I - m)^2

with Gaussians G of deviations r, some stripes of a shirt wide, and b, which lets patterns match
that are off by a few pixels. A shirt that turns under a lamp keeps its stripes and not its
brightness; the border of a shadow on it stands still, and is no stronger in c than any stripe.
Without texture c is near zero.

By default: `local_contrast(grey)`.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from torchcss.errors import check_shape
from torchcss.vision.sampling import gaussian_blur


def local_contrast(
    grey: Float[Tensor, "h w"], *, radius: float = 7.0, blur: float = 2.0, floor: float = 0.03
) -> Float[Tensor, "h w"]:
    """A picture in units of its own local deviation.

    Args:
        grey: Grey levels in 0..1.
        radius: Deviation r of the surroundings that a pixel is compared with, pixels.
        blur: Deviation b of what is left, pixels.
        floor: Deviation below which grey levels are noise.

    Raises:
        ShapeError: If the picture is none.
    """
    check_shape("grey", grey, None, None)
    difference = grey - gaussian_blur(grey, radius)
    deviation = (gaussian_blur(difference.square(), radius) + floor**2).sqrt()
    return gaussian_blur(difference / deviation, blur)
