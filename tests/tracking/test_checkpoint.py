"""A session's state as tensors: twenty frames are ten, a file, another process, and ten more."""

from __future__ import annotations

import pickle
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from made_processes import begin
from made_sequences import rendered_arm
from made_sessions import INTERVAL, seen_by, start_at

from torchcss.errors import ConfigurationError, TrackFileError
from torchcss.io.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.tracking.checkpoint import state_from_tensors, state_tensors
from torchcss.tracking.session import TrackingSession
from torchcss.tracking.settings import Settings, all_terms
from torchcss.types import Frame

SETTINGS = Settings(
    body="arm8", samples=4, modes=2, working_size=120, terms=all_terms(), prediction="surface",
    limb_jumps=1,
)  # fmt: skip
PRINTED = Settings(body="arm8", preset="rr_multiple_hypothesis", working_size=120)
TRACKERS = {
    "ours": (replace(SETTINGS, terms=None), 20),
    "all terms": (SETTINGS, 4),
    "[RR] Fig. 4": (PRINTED, 6),
}
"""Settings, and how many frames are tracked: half of them by another process."""


def sequence_and_session(
    settings: Settings, made: SyntheticSequence | None = None
) -> tuple[list[Frame], TrackingSession]:
    made = made or rendered_arm(3, 6)
    view = seen_by(made.camera, made.joints_world, made.body.joint_names)
    first = start_at(made.body, made.states[0])
    session = TrackingSession(settings, first, [view], frame_interval=INTERVAL)
    return [Frame(i, i * INTERVAL, image) for i, image in enumerate(made.frames)], session


def go_on(folder: str, name: str) -> None:
    """What the other process does: the second half, its last state into a file."""
    settings, num_frames = TRACKERS[name]
    made = pickle.loads((Path(folder) / "made").read_bytes())
    frames, begun = sequence_and_session(settings, made)
    checkpoint = read_checkpoint(Path(folder))
    assert checkpoint is not None
    state = state_from_tensors(checkpoint.tensors, begun.state.body)
    views = [observer.view for observer in begun._observers]
    session = TrackingSession.resume(state, settings, views, frame_interval=INTERVAL)
    for _ in session.track(frames[checkpoint.num_frames :]):
        pass
    write_checkpoint(Path(folder), Checkpoint(num_frames, state_tensors(session.checkpoint())))


@pytest.mark.parametrize("name", TRACKERS)
def test_another_process_goes_on_bit_for_bit(tmp_path: Path, name: str) -> None:
    settings, num_frames = TRACKERS[name]
    half = num_frames // 2
    made = rendered_arm(3, num_frames)
    (tmp_path / "made").write_bytes(pickle.dumps(made))
    frames, session = sequence_and_session(settings, made)
    for _ in session.track(frames[:half]):
        pass
    write_checkpoint(tmp_path, Checkpoint(half, state_tensors(session.checkpoint())))
    for _ in session.track(frames[half:]):
        pass
    whole = state_tensors(session.checkpoint())
    here, *rest = str(Path(__file__).parent), str(tmp_path), name
    script = "import sys; sys.path.insert(0, sys.argv[1]); import test_checkpoint as tests"
    assert begin(f"{script}; tests.go_on(*sys.argv[2:])", here, *rest).end() == 0
    resumed = read_checkpoint(tmp_path)
    assert resumed is not None
    assert set(resumed.tensors) == set(whole)
    assert ("tracker.particles.x" in whole) == (name == "[RR] Fig. 4")
    for key, value in whole.items():
        np.testing.assert_array_equal(resumed.tensors[key].numpy(), value.numpy(), err_msg=key)


def test_everything_that_the_next_frame_needs_is_in_it() -> None:
    frames, session = sequence_and_session(SETTINGS)
    for _ in session.track(frames[:2]):
        pass
    names = set(state_tensors(session.checkpoint()))
    for name in (
        *("tracker.mixture.mean", "tracker.velocity", "tracker.generator_state"),
        *("body.base_rotation", "body.part_shape", "monitor.sums"),
        *("views.0.picture", "views.0.contrast.coefficients", "views.0.appearance.inside"),
    ):
        assert name in names


def test_the_times_of_frames_are_gone_on_with() -> None:
    """A frame that comes late after a checkpoint is known to be late, in search and windows."""
    settings = replace(SETTINGS, terms=None)
    frames, session = sequence_and_session(settings)
    late = [replace(frame, time_s=frame.time_s + INTERVAL * (frame.index > 2)) for frame in frames]
    for _ in session.track(late[:3]):
        pass
    state = state_from_tensors(state_tensors(session.checkpoint()), session.state.body)
    assert state.times == session.state.times
    views = [observer.view for observer in session._observers]
    resumed = TrackingSession.resume(state, settings, views, frame_interval=INTERVAL)
    for one, other in zip(session.track(late[3:5]), resumed.track(late[3:5]), strict=True):
        assert torch.equal(one.state.mixture.mean, other.state.mixture.mean)
    # A checkpoint of before they were kept takes the first interval for a usual one.
    tensors = state_tensors(state)
    del tensors["times"]
    assert state_from_tensors(tensors, state.body).times == ()


def test_observing_ahead_changes_nothing() -> None:
    frames, session = sequence_and_session(replace(SETTINGS, terms=None))
    _, ahead = sequence_and_session(replace(SETTINGS, terms=None))
    seen = ahead.observe(frames[0])
    for frame, following in pairwise(frames[:4]):
        expected = session.step(session.observe(frame))
        later = ahead.observe(following)
        posterior, seen = ahead.step(seen), later
        assert torch.equal(posterior.state.mixture.mean, expected.state.mixture.mean)
    # And the state that is kept is that of the frame that was searched.
    ours, theirs = (state_tensors(each.checkpoint()) for each in (session, ahead))
    assert all(torch.equal(value, theirs[name]) for name, value in ours.items())


def test_what_does_not_fit_is_refused() -> None:
    _, session = sequence_and_session(SETTINGS)
    tensors, body = state_tensors(session.checkpoint()), session.state.body
    with pytest.raises(TrackFileError, match="does not fit the run"):
        state_from_tensors({**tensors, "body.tie": torch.zeros(2, 2)}, body)
    del tensors["tracker.velocity"]
    with pytest.raises(TrackFileError, match="does not fit the run"):
        state_from_tensors(tensors, body)
    views = [observer.view for observer in session._observers]
    with pytest.raises(ConfigurationError, match="same views"):
        TrackingSession.resume(session.state, SETTINGS, [*views, *views])
    with pytest.raises(ConfigurationError, match="at least one camera"):
        TrackingSession(SETTINGS, start_at(body, body.rest), [])
