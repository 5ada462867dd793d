"""A focal length is found from a person who moves; too little to see leaves the prior."""

from __future__ import annotations

import math

import pytest
import torch

from torchcss.body.load import load_body
from torchcss.initialise.focal import DEVIATION, MEAN, Focal, fit_focal
from torchcss.initialise.options import InitialiseOptions
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

SIZE = (640, 480)


def film(focal_px: float, num: int = 12) -> Keypoints:
    """A person near the camera who bends and reaches towards it."""
    body = load_body("body34", free_root=True)
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(num, body.num_parameters, generator=generator, dtype=torch.float64)
    spread = torch.where(body.sticky_deviation.isfinite(), body.sticky_deviation, 0.15)
    x = body.bounds.project(body.sticky_mean + 0.7 * spread * noise)
    camera = Camera.pinhole(*SIZE, focal_px=focal_px)
    middle = body.pose(body.rest).joints.mean(0)
    rotation = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    depth = torch.tensor([0.0, 0.0, 2.2 * focal_px / 480], dtype=torch.float64)
    body = body.with_base(rotation, depth - rotation @ middle)
    uv = camera.project(body.pose(x).joints).uv
    return Keypoints(uv, torch.ones(uv.shape[:-1], dtype=torch.float64), body.joint_names)


def fit(keypoints: Keypoints) -> Focal:
    return fit_focal(
        "body34",
        keypoints,
        SIZE,
        options=InitialiseOptions(sigma=2.0, pose_prior=False),
        generator=torch.Generator().manual_seed(0),
    )


def test_wide_and_narrow_lenses_are_told_apart() -> None:
    wide, narrow = fit(film(380.0)), fit(film(960.0))
    assert wide.pixels < 0.85 * narrow.pixels
    assert wide.num_frames == 12
    for found, true in ((wide, 380.0), (narrow, 960.0)):
        assert found.deviation < DEVIATION
        assert abs(math.log(found.pixels / true)) < 2 * found.deviation


def test_too_little_leaves_the_prior() -> None:
    keypoints = film(500.0, num=3)
    assert fit(keypoints) == Focal(pytest.approx(640 * math.exp(MEAN)), DEVIATION, 0)
    unseen = keypoints._replace(confidence=torch.zeros_like(keypoints.confidence))
    assert fit(unseen).num_frames == 0
