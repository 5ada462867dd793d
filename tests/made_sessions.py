"""Sessions that start at the truth of a sequence, with few samples."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import torch
from made_sequences import rendered_arm
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.inference.mixture import GaussianMixture
from torchcss.initialise.result import Initialisation
from torchcss.initialise.view import CameraView
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import Settings
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


def moving_arm(frames: int) -> SyntheticSequence:
    """An arm before a plain wall."""
    return rendered_arm(3, frames)


def standing_person(arm: SyntheticSequence) -> SyntheticSequence:
    """A person who stands still before the arm: keypoints fit, edges do not."""
    upright = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    turned = arm.camera.R_camera_world.T @ upright
    place = (
        arm.camera.centre_world
        + arm.camera.R_camera_world.T @ torch.tensor([0.0, 0.0, 3.5]).double()
    )
    body = load_body("body34").with_base(turned, place)
    states = body.sticky_mean.expand(len(arm.states), -1)
    return replace(arm, body=body, states=states)


def session_on(sequence: SyntheticSequence, device: str, **settings) -> TrackingSession:
    """An eager session with a sequence's keypoints, from the truth of its first frame."""
    chosen = Settings(
        body=sequence.body.name,
        device=device,
        engine="eager",
        **{"samples": 6, "modes": 2, "working_size": 160, **settings},
    )
    body = deepcopy(sequence.body).to(dtype=chosen.torch_dtype, device=device)
    state = sequence.states[0].to(dtype=chosen.torch_dtype, device=device)
    view = seen_by(sequence.camera, sequence.joints_world, sequence.body.joint_names)
    return session_at(chosen, body, state, view)
