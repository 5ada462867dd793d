"""What runs on a CPU runs on an accelerator, with the same results; skipped where there is none."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy

import pytest
import torch
from made_sessions import moving_arm, seen_by, session_on, standing_person

from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.tracking.checkpoint import state_from_tensors, state_tensors
from torchcss.tracking.presets import PRESETS
from torchcss.tracking.session import Posterior, TrackingSession

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
    return moving_arm(FRAMES)


@pytest.fixture(scope="module")
def person(arm: SyntheticSequence) -> SyntheticSequence:
    return standing_person(arm)


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
