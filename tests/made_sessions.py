"""Sessions that start at the truth of a sequence, with few samples."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.result import Initialisation
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.tracking.view import CameraView
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

INTERVAL = 1 / 25


def start_at(body: BodyModel, state: Tensor, variance: float = 0.01) -> Initialisation:
    """One mode of a body, as uncertain in all directions."""
    n = body.num_parameters
    mixture = GaussianMixture(
        state.reshape(1, n), variance * torch.eye(n).to(state)[None], state.new_zeros(1)
    )
    return Initialisation(body, mixture, state.new_zeros(1), ())


def seen_by(
    camera: Camera,
    joints: Tensor | None = None,
    names: tuple[str, ...] = (),
    *,
    sigma: float = 2.0,
) -> CameraView:
    """A view with the exact keypoints of joints `[t j 3]`; without them, one without keypoints."""
    if joints is None:
        return CameraView(camera, sigma=sigma)
    uv = camera.project(joints).uv
    return CameraView(camera, Keypoints(uv, torch.ones_like(uv[..., 0]), names), sigma)


def session_at(
    settings: Settings, body: BodyModel, state: Tensor, *views: CameraView, variance: float = 0.01
) -> TrackingSession:
    """A session that starts at a state."""
    first = start_at(body, state, variance)
    return TrackingSession(settings, first, views, frame_interval=INTERVAL)
