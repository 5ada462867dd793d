"""Lenses that a camera does not follow, by OpenCV's published formulas, and pictures made straight.

A point of the world at (a, b) of the plane at unit depth is seen at the pixel `K (a', b', 1)`.

*Rational* (`cv::calibrateCamera`; k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty), with r2 = a^2 + b^2:

    q  = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    a' = a q + 2 p1 a b + p2 (r2 + 2 a^2) + s1 r2 + s2 r2^2
    b' = b q + p1 (r2 + 2 b^2) + 2 p2 a b + s3 r2 + s4 r2^2

and then the sensor's tilt, a projective map of (a', b') by the angles tx and ty.

*Fisheye* (`cv::fisheye`, Kannala and Brandt, "equidistant"; k1 k2 k3 k4): with t = arctan r,

    (a', b') = (a, b) t / r (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)

*Mirrors*: lenses of which the rational formula holds once (a, b) is divided by, with d^2 = r2 + 1,

| | parameters | divisor | source |
|---|---|---|---|
| `omni` | xi | 1 + xi d | Mei and Rives 2007; `cv::omnidir`, Kalibr's omni, camodocal's MEI |
| `ds` | xi, alpha | alpha e + (1 - alpha) g; g = 1 + xi d, e^2 = r2 + g^2 | Usenko et al. 2018 |
| `eucm` | alpha, beta | alpha sqrt(1 + beta r2) + 1 - alpha | Khomutenko et al. 2016 |

By default: `Lens.straightened_K`, then `Lens.straight_image` and `Lens.straight_pixels`.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch.nn import functional

from torchcss.errors import CameraError
from torchcss.types import ColourImage

MOST_COEFFICIENTS = {False: 14, True: 4}
"""How many coefficients a lens has, by whether it is a fisheye lens."""

_FARTHEST = math.radians(80)
"""Angle from the axis beyond which nothing is straightened."""

_WIDEST = math.radians(110)
"""Angle from left to right of a straight picture, unless it is asked for: beyond, whatever stands
near the border is drawn out."""

_LEAST = 1e-12
"""Radius below which formulas are as at it."""

_STEPS = 20
"""Newton steps of the inverse, which begins at the radial part's."""

_SLOPE = 1e-6
"""Step of the differences that they use."""


class Mirror(NamedTuple):
    """A mirror or a lens that sees as much.

    Attributes:
        model: Which of the table above.
        parameters: Its numbers.
    """

    model: str
    parameters: tuple[float, ...]

    def shrunk(self, r: np.ndarray) -> np.ndarray:
        """How far from the axis is seen what is at r from it, at unit depth."""
        d = np.hypot(r, 1.0)
        if self.model == "eucm":
            alpha, beta = self.parameters
            return r / (alpha * np.sqrt(1 + beta * r * r) + 1 - alpha)
        xi, alpha = (*self.parameters, 0.0)[:2]
        g = 1 + xi * d
        return r / (alpha * np.hypot(r, g) + (1 - alpha) * g)

    def spread(self, m: np.ndarray) -> np.ndarray:
        """What `shrunk` takes to m; infinite where that is behind the camera, or nothing."""
        with np.errstate(invalid="ignore", divide="ignore"):
            if self.model == "eucm":
                alpha, beta = self.parameters
                root = np.sqrt(1 - (2 * alpha - 1) * beta * m * m)
                z = (1 - beta * alpha**2 * m * m) / (alpha * root + 1 - alpha)
                return np.where(z > 0, m / z, np.inf)
            xi, alpha = (*self.parameters, 0.0)[:2]
            root = np.sqrt(1 - (2 * alpha - 1) * m * m)
            z = (1 - alpha**2 * m * m) / (alpha * root + 1 - alpha)
            scale = (z * xi + np.sqrt(z * z + (1 - xi * xi) * m * m)) / (z * z + m * m)
            depth = scale * z - xi
            return np.where(depth > 0, scale * m / depth, np.inf)


MIRRORS = {"omni": ("xi",), "ds": ("xi", "alpha"), "eucm": ("alpha", "beta")}
"""What the numbers of each model are called."""


class Lens(NamedTuple):
    """A lens and the camera's intrinsic matrix.

    Attributes:
        K: Intrinsic matrix; pixel centres at integers.
        coefficients: OpenCV's, in its order; those behind the last are zero.
        is_fisheye: Which of the two formulas holds.
        mirror: What comes before the rational one; None: nothing.
    """

    K: Float[np.ndarray, "3 3"]
    coefficients: tuple[float, ...]
    is_fisheye: bool
    mirror: Mirror | None = None

    def pixels(self, places: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
        """Where points at unit depth are seen; NaN where the formula means nothing.

        Args:
            places: (a, b) of each.
        """
        radius = np.linalg.norm(places, axis=-1, keepdims=True)
        if self.is_fisheye or self.mirror:
            shrunk = np.arctan if self.mirror is None else self.mirror.shrunk
            safe = np.maximum(radius, _LEAST)
            places, radius = places * shrunk(safe) / safe, shrunk(radius)
        limit, _, _ = _radial(*self[1:])
        seen = self._bent(np.where(radius < limit, places, np.nan))
        return seen @ self.K[:2, :2].T + self.K[:2, 2]

    def places(
        self, pixels: Float[np.ndarray, "*b 2"]
    ) -> tuple[Float[np.ndarray, "*b 2"], Bool[np.ndarray, "*b"]]:
        """The points at unit depth that are seen at pixels, and whether the formula reaches them.

        Args:
            pixels: The pixels; one that is not reached gets a place at the border of those that
                are.
        """
        target = (pixels - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        limit, radii, bent_radii = _radial(*self[1:])
        far = np.linalg.norm(target, axis=-1, keepdims=True)
        direction = target / np.where(far > 0, far, 1.0)
        place = direction * np.interp(far, bent_radii, radii)
        for _ in range(_STEPS):
            slopes = [
                (self._bent(place + step) - self._bent(place - step)) / (2 * _SLOPE)
                for step in _SLOPE * np.eye(2)
            ]
            (aa, ba), (ab, bb) = (np.moveaxis(slope, -1, 0) for slope in slopes)
            e_a, e_b = np.moveaxis(self._bent(place) - target, -1, 0)
            inverse = aa * bb - ab * ba
            inverse = 1 / np.where(np.abs(inverse) > 1e-9, inverse, 1.0)
            step = np.stack([bb * e_a - ab * e_b, aa * e_b - ba * e_a], axis=-1)
            place = place - inverse[..., None] * step
            size = np.linalg.norm(place, axis=-1, keepdims=True)
            place = place * np.minimum(1.0, limit / np.maximum(size, limit))
        error = np.linalg.norm(self._bent(place) - target, axis=-1)
        if self.is_fisheye or self.mirror:
            spread = np.tan if self.mirror is None else self.mirror.spread
            safe = np.maximum(np.linalg.norm(place, axis=-1, keepdims=True), _LEAST)
            place = place * np.minimum(spread(safe), math.tan(_FARTHEST)) / safe
        return place, error < 1e-5 * (1 + far[..., 0])

    def _bent(self, places: np.ndarray) -> np.ndarray:
        """(a', b') of places, of a fisheye lens of angles from the axis, else behind the mirror."""
        a, b = np.moveaxis(places, -1, 0)
        r2 = a * a + b * b
        numbers = np.zeros(MOST_COEFFICIENTS[self.is_fisheye])
        numbers[: len(self.coefficients)] = self.coefficients
        if self.is_fisheye:
            return places * _polynomial(r2, *numbers)[..., None]
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tilt_x, tilt_y = numbers
        q = _polynomial(r2, k1, k2, k3) / _polynomial(r2, k4, k5, k6)
        bent = np.stack(
            [
                a * q + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) + r2 * (s1 + s2 * r2),
                b * q + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b + r2 * (s3 + s4 * r2),
            ],
            axis=-1,
        )
        if not (tilt_x or tilt_y):
            return bent
        tilt = _tilt(tilt_x, tilt_y)
        x, y, w = np.moveaxis(bent @ tilt[:, :2].T + tilt[:, 2], -1, 0)
        return np.stack([x / w, y / w], axis=-1)

    def straightened_K(
        self, image_size_wh: tuple[int, int], fov: float | None = None
    ) -> Float[np.ndarray, "3 3"]:
        """Intrinsics of straight pictures of the same size, through the same principal point.

        They show what the middles of the borders show, but no more than 110 degrees from left to
        right.

        Args:
            image_size_wh: Width and height.
            fov: Degrees from left to right; None: as said above.

        Raises:
            CameraError: If the angle is none.
        """
        (width, height), (cx, cy) = image_size_wh, self.K[:2, 2]
        focal = np.diagonal(self.K)[:2]
        if fov is not None:
            if not 0 < fov < 170:
                raise CameraError(f"--fov: expected degrees between 0 and 170, got {fov:g}")
            scale = 0.5 * width / (focal[0] * math.tan(math.radians(0.5 * fov)))
        else:
            borders = np.array([[0, cy], [width - 1, cy], [cx, 0], [cx, height - 1]])
            away = (np.abs(borders - self.K[:2, 2]) / focal).max(-1)
            seen = np.abs(self.places(borders)[0]).max(-1)
            least = 0.5 * width / (focal[0] * math.tan(0.5 * _WIDEST))
            scale = max(least, float((away / np.maximum(seen, 1e-9)).min()))
        return np.array([[scale * focal[0], 0, cx], [0, scale * focal[1], cy], [0, 0, 1]])

    def straight_pixels(
        self, pixels: Float[np.ndarray, "*b 2"], K: Float[np.ndarray, "3 3"]
    ) -> tuple[Float[np.ndarray, "*b 2"], Bool[np.ndarray, "*b"]]:
        """Where straight pictures show what is seen at pixels, and whether they can.

        Args:
            pixels: Of the pictures as recorded.
            K: Of the straight ones.
        """
        places, reached = self.places(pixels)
        return places @ K[:2, :2].T + K[:2, 2], reached

    def source_pixels(
        self, image_size_wh: tuple[int, int], K: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "h w 2"]:
        """Which pixel of a recorded picture every pixel of a straight one shows; NaN: none.

        Args:
            image_size_wh: Width and height of both.
            K: Of the straight one.
        """
        width, height = image_size_wh
        v, u = np.indices((height, width), dtype=float)
        places = (np.stack([u, v], -1) - K[:2, 2]) / np.diagonal(K)[:2]
        pixels = self.pixels(places)
        is_inside = (pixels > -0.5) & (pixels < np.array([width, height]) - 0.5)
        return np.where(is_inside.all(-1, keepdims=True), pixels, np.nan)


def straight_image(image: ColourImage, source: Float[np.ndarray, "h w 2"]) -> ColourImage:
    """A straight picture by cubic interpolation; black where nothing was recorded.

    Args:
        image: As recorded.
        source: From `Lens.source_pixels`.
    """
    height, width = image.shape[:2]
    grid = torch.from_numpy(source / (0.5 * np.array([width - 1, height - 1])) - 1).float()
    black = grid.isnan().any(-1)
    pixels = torch.from_numpy(image.copy()).movedim(-1, 0)[None].float()
    straight = functional.grid_sample(
        pixels, grid.nan_to_num()[None], "bicubic", "border", align_corners=True
    )[0]
    straight = straight.round().clamp(0, 255).masked_fill(black, 0.0)
    return straight.movedim(0, -1).to(torch.uint8).contiguous().numpy()


def _polynomial(x: np.ndarray, *coefficients: float) -> np.ndarray:
    """1 + c1 x + c2 x^2 + ..."""
    value = np.zeros_like(x)
    for coefficient in reversed(coefficients):
        value = x * (coefficient + value)
    return 1 + value


@cache
def _radial(
    coefficients: tuple[float, ...], is_fisheye: bool, mirror: Mirror | None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Up to which radius (or angle) the radial part grows, and its values up to there."""
    farthest = np.array(math.tan(_FARTHEST))
    if mirror is not None:
        farthest = mirror.shrunk(farthest)
    radii = np.linspace(0, _FARTHEST if is_fisheye else float(farthest), 4001)
    k1, k2, _, _, *more = *coefficients, *[0.0] * (MOST_COEFFICIENTS[False] - len(coefficients))
    radial = coefficients if is_fisheye else (k1, k2, 0.0, 0.0, *more[:4])
    bent = Lens(np.eye(3), radial, is_fisheye)._bent(np.stack([radii, 0 * radii], -1))[:, 0]
    falls = np.flatnonzero(~(np.diff(bent) > 0))
    end = int(falls[0]) + 1 if len(falls) else len(radii)
    return float(radii[end - 1]), radii[:end], bent[:end]


def _tilt(x: float, y: float) -> np.ndarray:
    """The map of the plane by which OpenCV models a sensor that is tilted about x, then y."""
    (cos_x, sin_x), (cos_y, sin_y) = ((math.cos(t), math.sin(t)) for t in (x, y))
    about_x = np.array([[1, 0, 0], [0, cos_x, sin_x], [0, -sin_x, cos_x]])
    turn = np.array([[cos_y, 0, -sin_y], [0, 1, 0], [sin_y, 0, cos_y]]) @ about_x
    onto = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    return onto @ turn
