"""Lenses against numbers that OpenCV 5.0 gave, and the pictures that are made straight."""

from __future__ import annotations

import math

import numpy as np
import pytest

from torchcss.errors import CameraError
from torchcss.io.lenses import Lens, Mirror, straight_image

K = np.array([[611.25, 0.0, 317.5], [0.0, 612.75, 243.0], [0.0, 0.0, 1.0]])
SIZE = (640, 480)
PLACES = np.array([[0.25, -0.4], [-0.55, 0.3], [0.7, 0.45]])
PRISM = (0.11, -0.24, 0.0012, -0.0021, 0.07, 0.1, 0.02, 0.003, 0.004, -0.001, 0.002, 0.0005)
RATIONAL = (0.5, -0.2, 0.001, -0.002, 0.05, 0.45, -0.15, 0.02)
FISHEYE = (0.05, -0.01, 0.003, -0.0004)
OF_OPENCV = {
    "rational": (
        Lens(K, RATIONAL, False),
        [[471.021039, -3.536385], [-24.107821, 429.76693], [750.791003, 523.197656]],
    ),
    "thin prism": (
        Lens(K, PRISM, False),
        [[468.75377, 1.217461], [-8.999915, 422.542469], [707.245606, 495.340987]],
    ),
    "tilted": (
        Lens(K, (*PRISM, 0.02, -0.03), False),
        [[468.751443, 1.372603], [-5.857844, 420.575697], [718.395833, 502.736435]],
    ),
    "fisheye": (
        Lens(K, FISHEYE, True),
        [[461.622787, 11.83766], [12.734654, 409.643583], [682.238299, 478.050019]],
    ),
}
"""Lenses, and where `cv2.projectPoints` or `cv2.fisheye.projectPoints` sees `PLACES`."""


@pytest.mark.parametrize("name", OF_OPENCV)
def test_pixels_are_those_of_opencv_and_lead_back(name: str) -> None:
    lens, expected = OF_OPENCV[name]
    pixels = lens.pixels(PLACES)
    np.testing.assert_allclose(pixels, expected, atol=1e-6)
    places, reached = lens.places(pixels)
    assert reached.all()
    np.testing.assert_allclose(places, PLACES, atol=1e-9)
    middle = K[:2, 2]
    np.testing.assert_allclose(lens.pixels(np.zeros(2)), middle)
    np.testing.assert_allclose(lens.places(middle)[0], 0, atol=1e-12)


def test_a_fisheye_lens_of_no_coefficients_keeps_angles() -> None:
    lens = Lens(K, (), True)
    for angle in (0.1, 0.7, 1.3):
        (u, _) = lens.pixels(np.array([math.tan(angle), 0.0]))
        assert u == pytest.approx(317.5 + 611.25 * angle)


def seen_by_spheres(x: float, y: float, z: float, model: Mirror) -> tuple[float, float]:
    """The papers' own steps: onto one sphere or two, or an ellipsoid, and from there."""
    if model.model == "eucm":
        alpha, beta = model.parameters
        depth = alpha * math.sqrt(beta * (x * x + y * y) + z * z) + (1 - alpha) * z
        return x / depth, y / depth
    xi = model.parameters[0]
    if model.model == "omni":
        length = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        return x / (z + xi), y / (z + xi)
    alpha = model.parameters[1]
    d1 = math.sqrt(x * x + y * y + z * z)
    d2 = math.sqrt(x * x + y * y + (xi * d1 + z) ** 2)
    depth = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    return x / depth, y / depth


@pytest.mark.parametrize(
    "mirror",
    [Mirror("omni", (1.3,)), Mirror("omni", (0.4,)), Mirror("ds", (-0.2, 0.59)),
     Mirror("ds", (0.1, 0.4)), Mirror("eucm", (0.6, 1.1)), Mirror("eucm", (0.4, 0.9))],
)  # fmt: skip
def test_mirrors_are_those_of_the_papers_and_lead_back(mirror: Mirror) -> None:
    lens = Lens(K, (0.05, -0.02, 0.001, -0.002), False, mirror)
    places = np.array([*PLACES.tolist(), [-3.0, 2.0], [0.0, 0.0]])
    pixels = lens.pixels(places)
    for (x, y), pixel in zip(places, pixels, strict=True):
        a, b = seen_by_spheres(2 * x, 2 * y, 2.0, mirror)
        r2 = a * a + b * b
        q = 1 + 0.05 * r2 - 0.02 * r2**2
        bent = [a * q + 0.002 * a * b - 0.002 * (r2 + 2 * a * a),
                b * q + 0.001 * (r2 + 2 * b * b) - 0.004 * a * b]  # fmt: skip
        np.testing.assert_allclose(pixel, K[:2, :2] @ bent + K[:2, 2], atol=1e-9)
    found, reached = lens.places(pixels)
    assert reached.all()
    np.testing.assert_allclose(found, places, atol=1e-9)
    borders, reached = lens.places(np.array([[-1e4, 0.0], [0.0, 1e4]]))
    assert np.isfinite(borders).all()
    assert not reached.any()


def test_beyond_its_turning_point_a_lens_shows_nothing() -> None:
    lens = Lens(K, (-0.4, 0.0, 0.0, 0.0), False)  # grows up to a radius of sqrt(1 / 1.2)
    assert np.isfinite(lens.pixels(np.array([0.9, 0.0]))).all()
    assert np.isnan(lens.pixels(np.array([0.92, 0.0]))).all()
    farthest = 611.25 * (math.sqrt(1 / 1.2) * (1 - 0.4 / 1.2)) + 317.5
    _, reached = lens.places(np.array([[farthest - 1, 243.0], [farthest + 1, 243.0]]))
    assert reached.tolist() == [True, False]


@pytest.mark.parametrize("name", OF_OPENCV)
def test_straight_pictures_show_what_straight_pixels_say(name: str) -> None:
    """A blurred dot, recorded where the lens sees it, is where a pinhole sees it."""
    lens, _ = OF_OPENCV[name]
    straight = lens.straightened_K(SIZE)
    for place in ([0.1, -0.15], [-0.3, 0.2]):
        u, v = lens.pixels(np.array(place))
        rows, columns = np.indices((480, 640))
        dot = 250 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 18)
        image = np.repeat(dot.round().astype(np.uint8)[..., None], 3, axis=-1)
        found = straight_image(image, lens.source_pixels(SIZE, straight))[..., 1].astype(float)
        middle = [(found * grid).sum() / found.sum() for grid in (columns, rows)]
        expected, reached = lens.straight_pixels(np.array([u, v]), straight)
        assert reached
        np.testing.assert_allclose(expected, straight[:2, :2] @ place + straight[:2, 2], atol=1e-6)
        np.testing.assert_allclose(middle, expected, atol=0.05)


def test_what_a_straight_picture_shows() -> None:
    lens = Lens(np.array([[200.0, 0, 319.5], [0, 200.0, 239.5], [0, 0, 1]]), (), True)
    angle = 2 * math.atan(0.5 * 640 / lens.straightened_K(SIZE)[0, 0])
    assert math.degrees(angle) == pytest.approx(110)  # the lens sees 183
    asked = lens.straightened_K(SIZE, fov=90)
    assert asked[0, 0] == pytest.approx(320)
    with pytest.raises(CameraError, match="--fov"):
        lens.straightened_K(SIZE, fov=180)
    narrow = Lens(np.array([[900.0, 0, 319.5], [0, 900.0, 239.5], [0, 0, 1]]), (), True)
    kept = narrow.straightened_K(SIZE)
    (u, _), reached = narrow.straight_pixels(np.array([0.0, 239.5]), kept)
    assert reached
    assert u == pytest.approx(0, abs=1e-6)
    # Black where the lens saw nothing.
    source = lens.source_pixels(SIZE, asked)
    wide = lens.source_pixels(SIZE, lens.straightened_K(SIZE, fov=160))
    assert np.isfinite(source).all()
    assert not np.isfinite(wide[0, 0]).any()
    assert (straight_image(np.full((480, 640, 3), 9, np.uint8), wide)[0, 0] == 0).all()
