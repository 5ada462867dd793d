"""What runs on a CPU runs on an accelerator, with the same results; skipped where there is none."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from made_sessions import seen_by, session_at

from torchcss.body.load import load_body
from torchcss.studies.render.sequences import SyntheticSequence, arm_sequence
from torchcss.tracking.checkpoint import state_from_tensors, state_tensors
from torchcss.tracking.presets import PRESETS
from torchcss.tracking.session import Posterior, TrackingSession
from torchcss.tracking.settings import Settings

FRAMES = 3


@pytest.fixture(params=["cuda", "xpu"], scope="module")
def device(request: pytest.FixtureRequest) -> str:
    """An accelerator with double precision."""
    name = request.param
    if not getattr(torch, name).is_available():
        pytest.skip(f"no {name} device on this machine")
    return name


@pytest.fixture(scope="module")
def arm() -> SyntheticSequence:
    return arm_sequence(generator=torch.Generator().manual_seed(3), num_frames=FRAMES)


@pytest.fixture(scope="module")
def person(arm: SyntheticSequence) -> SyntheticSequence:
    """A person who stands still before the arm: keypoints fit, edges do not."""
    upright = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    turned = arm.camera.R_camera_world.T @ upright
    place = (
        arm.camera.centre_world
        + arm.camera.R_camera_world.T @ torch.tensor([0.0, 0.0, 3.5]).double()
    )
    body = load_body("body34").with_base(turned, place)
    states = body.sticky_mean.expand(FRAMES, -1)
    return replace(arm, body=body, states=states)


def session_on(sequence: SyntheticSequence, device: str, **settings) -> TrackingSession:
    """A session with the sequence's keypoints, from the truth of its first frame."""
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


def posteriors(sequence: SyntheticSequence, device: str, **settings) -> Iterator[Posterior]:
    return session_on(sequence, device, **settings).track(iter(sequence.frames))


def assert_alike(one: Posterior, other: Posterior, tolerance: float) -> None:
    ours, theirs = one.state.mixture, other.state.mixture
    assert ours.mean.shape == theirs.mean.shape
    torch.testing.assert_close(ours.mean.cpu(), theirs.mean, rtol=0, atol=tolerance)
    torch.testing.assert_close(one.info.cost.cpu(), other.info.cost, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("keypoints_use", ["all", "first"])
@pytest.mark.parametrize("name", ["arm", "person"])
def test_a_track_is_that_of_a_cpu(
    device: str, name: str, keypoints_use: str, request: pytest.FixtureRequest
) -> None:
    sequence = request.getfixturevalue(name)
    there = list(posteriors(sequence, device, keypoints_use=keypoints_use))
    here = list(posteriors(sequence, "cpu", keypoints_use=keypoints_use))
    assert there[0].state.mixture.mean.device.type == device
    # Rounding differs, and a search multiplies it frame after frame.
    assert_alike(there[0], here[0], 1e-5)
    assert len(there) == len(here) == FRAMES


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_every_preset_runs(device: str, preset: str, arm: SyntheticSequence) -> None:
    for posterior in posteriors(arm, device, preset=preset, dtype="float32"):
        assert posterior.state.mixture.mean.device.type == device
        assert posterior.state.mixture.mean.isfinite().all()


def test_a_run_goes_on_from_a_checkpoint(device: str, arm: SyntheticSequence) -> None:
    whole = [each.state.mixture.mean for each in posteriors(arm, device)]
    session = session_on(arm, device)
    for frame in arm.frames[:2]:
        session.step(session.observe(frame))
    tensors = {name: value.cpu() for name, value in state_tensors(session.checkpoint()).items()}
    state = state_from_tensors(tensors, deepcopy(arm.body).to(device=device))
    view = seen_by(arm.camera, arm.joints_world, arm.body.joint_names)
    other = TrackingSession.resume(state, session.settings, [view], frame_interval=1 / 25)
    last = other.step(other.observe(arm.frames[2]))
    torch.testing.assert_close(last.state.mixture.mean, whole[2], rtol=0, atol=1e-6)
