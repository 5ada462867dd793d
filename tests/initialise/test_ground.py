"""The size that the floor tells."""

import math

import pytest
import torch

from torchcss.body.load import load_body
from torchcss.cost.anthropometric import Anthropometric
from torchcss.errors import BodyError, CameraError, ConfigurationError
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.fit import initialise
from torchcss.initialise.ground import stature_on_floor
from torchcss.initialise.multi_start import StartSearch
from torchcss.initialise.options import InitialiseOptions
from torchcss.initialise.result import Initialisation, stature_of
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

USUAL = Anthropometric().stature
HEIGHT, AWAY = 1.4, 4.0
"""Of the camera above the floor, and how far away the person stands, metres."""

LEVEL = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
"""From a world with y up, in which the camera looks along -z."""


def camera(*, placed: bool = True) -> Camera:
    seen = Camera.pinhole(1280, 960, focal_px=1000.0)
    if not placed:
        return seen
    place = torch.tensor([0.0, HEIGHT, 0.0], dtype=torch.float64)
    return Camera(seen.K, (1280, 960), R_camera_world=LEVEL, t_camera_world=-LEVEL @ place)


def standing(scale: float) -> Initialisation:
    """Somebody who stands before the camera, larger or smaller than is usual."""
    body = load_body("body34", scale=scale)
    x = body.rest
    lowest = body.surface(body.pose(x)).points[..., 1].min()
    place = torch.tensor([0.0, -float(lowest), -AWAY], dtype=torch.float64)
    body = body.with_base(torch.eye(3, dtype=torch.float64), place)
    n = len(x)
    mixture = GaussianMixture(x[None], torch.eye(n).to(x)[None], x.new_zeros(1))
    return Initialisation(body, mixture, x.new_zeros(1), (), dict(body.lengths), scale)


def about_camera(found: Initialisation, factor: float) -> Initialisation:
    """The same picture of somebody larger and farther away."""
    centre = camera().centre_world
    scale = factor * found.scale
    body = load_body("body34", scale=scale)
    place = centre + factor * (found.body.base_translation - centre)
    body = body.with_base(found.body.base_rotation, place)
    return found._replace(body=body, lengths=dict(body.lengths), scale=scale)


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.1])
def test_the_floor_tells_the_size_and_how_well(factor: float) -> None:
    true = standing(1.0)
    right = stature_of(true.lengths, true.scale)
    stature, doubt = stature_on_floor(about_camera(true, factor), camera(), 0.0)
    assert 0.01 < doubt < 0.025 < USUAL
    # What is usual pulls a little towards the size that was found without the floor.
    share = 1 - (doubt / USUAL) ** 2
    assert stature == pytest.approx(right * factor ** (1 - share), rel=1e-3)


def test_a_camera_that_may_be_off_level_tells_little() -> None:
    """In its own frame it is the origin, and down is about y."""
    found = standing(1.0)
    turned = LEVEL @ found.body.base_rotation
    place = LEVEL @ (found.body.base_translation - torch.tensor([0.0, HEIGHT, 0.0]).double())
    found = found._replace(body=found.body.with_base(turned, place))
    usual = stature_of(found.lengths, found.scale)
    stature, doubt = stature_on_floor(found, camera(placed=False), -1.2 * HEIGHT)
    assert usual < stature < 1.01 * usual
    assert 0.95 * USUAL < doubt < USUAL


@pytest.mark.parametrize("floor", [HEIGHT + 0.1, math.inf, -math.inf])
def test_a_floor_that_is_not_below_is_refused(floor: float) -> None:
    with pytest.raises(CameraError, match="below the camera"):
        stature_on_floor(standing(1.0), camera(), floor)


def test_what_has_no_open_size_is_refused() -> None:
    with pytest.raises(BodyError, match="size is known"):
        stature_on_floor(standing(1.0)._replace(lengths={}), camera(), 0.0)


def test_a_floor_that_makes_a_giant_is_refused() -> None:
    with pytest.raises(BodyError, match="ground: stature: expected a person's height"):
        stature_on_floor(standing(1.0), camera(), -3 * HEIGHT)


def test_a_floor_that_is_nowhere_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="ground"):
        InitialiseOptions(ground=math.nan)


@pytest.mark.parametrize("sigma", [0.0, -1.0, math.nan])
def test_a_noise_that_is_none_is_refused(sigma: float) -> None:
    """Zero is not the same as not given."""
    with pytest.raises(ConfigurationError, match=r"Options\.sigma: expected a positive"):
        InitialiseOptions(sigma=sigma)


def test_a_small_adult_is_found_small_and_near() -> None:
    true = standing(0.93)
    names = true.body.joint_names
    uv = camera().project(true.body.pose(true.mixture.mean[0]).joints).uv
    keypoints = Keypoints(uv, torch.ones(len(names)).double(), names)
    search = StartSearch(num_starts=8, num_trunks=2, num_flips=8, num_samples=2)
    errors = {}
    for ground in (None, 0.0):
        found = initialise(
            None, keypoints, camera(), generator=torch.Generator().manual_seed(0),
            options=InitialiseOptions(sigma=1.0, search=search, num_modes=1, ground=ground),
        )  # fmt: skip
        stature = stature_of(found.lengths, found.scale)
        errors[ground] = abs(math.log(stature / stature_of(true.lengths, true.scale)))
        assert (found.size_deviation < 0.9 * USUAL) == (ground is not None)
        assert any("the floor tells the size" in line for line in found.report) == (ground == 0)
    assert errors[0.0] < 0.5 * errors[None]
