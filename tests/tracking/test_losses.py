"""A lost target is told; in the posteriors and in the summary."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from made_sequences import rendered_arm
from made_sessions import seen_by, session_at, start_at

from torchcss.app.recorder import Recorder
from torchcss.cost.context import FrameContext
from torchcss.cost.term import Kind, OnStates, Posed, Term
from torchcss.inference.loss_monitor import LossMonitor
from torchcss.io.view_files import RecordedCamera
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.tracking.session import Posterior, TrackingSession
from torchcss.tracking.settings import Settings, make_plan, watched_terms
from torchcss.types import Curvature, Frame, LocalModel

ELSEWHERE = range(6, 8)
"""Frames that show a wall. It has some grain: a picture of a single colour is a camera that is out,
and says nothing."""
SETTINGS = Settings(
    body="arm8", terms=("contour",), working_size=120, overlay=False, samples=4, modes=2
)
MONITOR = LossMonitor(burn_in=3, slack=2.5, threshold=4.0)


def track(sequence: SyntheticSequence, num_frames: int, monitor: LossMonitor) -> list[Posterior]:
    """Track from the true first pose; some frames show a wall."""
    wall = np.random.default_rng(0).integers(88, 93, (480, 640, 3), np.uint8)
    images = (wall if index in ELSEWHERE else image for index, image in enumerate(sequence.frames))
    session = session_at(SETTINGS, sequence.body, sequence.states[0], seen_by(sequence.camera))
    session.plan = session.plan._replace(monitor=monitor)
    frames = (Frame(index, index / 25, image) for index, image in enumerate(images))
    return list(session.track(islice(frames, num_frames)))


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    return rendered_arm(3, 12)


@pytest.fixture(scope="module")
def tracked(sequence: SyntheticSequence) -> list[Posterior]:
    return track(sequence, 12, MONITOR)


def test_a_target_that_disappears_is_lost_and_found_again(tracked: list[Posterior]):
    lost = [frame.lost for frame in tracked]
    assert not any(lost[: ELSEWHERE.start])
    assert any(lost[frame] for frame in ELSEWHERE)
    assert not lost[-1]
    assert max(tracked[frame].loss_score for frame in ELSEWHERE) > 2


def test_losses_come_out_in_the_summary(
    sequence: SyntheticSequence, tracked: list[Posterior], tmp_path: Path
):
    session = session_at(SETTINGS, sequence.body, sequence.states[0], seen_by(sequence.camera))
    recorder = Recorder(
        folder=tmp_path,
        session=session,
        recorded=[RecordedCamera(sequence.camera)],
        frame_interval=1 / 25,
    )
    summary = recorder.run(tracked, len(tracked))
    on_disk = json.loads((tmp_path / "summary.json").read_text())
    lost = [frame.lost for frame in tracked]
    assert on_disk["frames_told_lost"] == summary["frames_told_lost"] == sum(lost)
    events = on_disk["events"]
    assert [event["event"] for event in events] == ["lost", "found"]
    assert [event["frame"] for event in events] == [
        lost.index(True),
        lost.index(False, lost.index(True)),
    ]
    for event in events:
        assert event["time_s"] == event["frame"] / 25
        assert event["deviations"] == tracked[event["frame"]].loss_score


def test_what_is_told_changes_nothing(sequence: SyntheticSequence, tracked: list[Posterior]):
    deaf = track(sequence, 12, replace(MONITOR, threshold=1e9))
    assert not any(frame.lost for frame in deaf)
    for one, two in zip(deaf, tracked, strict=True):
        assert torch.equal(one.state.mixture.mean, two.state.mixture.mean)
        assert torch.equal(one.state.mixture.log_weight, two.state.mixture.log_weight)


@dataclass(frozen=True, kw_only=True)
class Constant(Term):
    """A term that the table of terms does not have."""

    name: ClassVar[str] = "constant"
    kind: ClassVar[Kind] = "prior"

    def prepare(self, context: FrameContext) -> OnStates:
        def model(posed: Posed, curvature: Curvature) -> LocalModel:
            x = posed.x
            slope = torch.zeros_like(x)
            return LocalModel(slope.sum(-1) + 1, slope, torch.diag_embed(slope))

        return OnStates(model)


def test_only_what_compares_with_the_image_is_judged(sequence: SyntheticSequence):
    """And what the plan of a session alone knows may be among the terms, as `watched` says."""
    settings = replace(SETTINGS, terms=("contour", "stabiliser", "interpenetration"))
    first, view = start_at(sequence.body, sequence.states[0]), seen_by(sequence.camera)
    plan = make_plan(settings, sequence.body, view, 1 / 25)
    plan = plan._replace(choice=plan.choice.having(Constant()))
    session = TrackingSession(settings, first, view, plan=plan)
    (posterior,) = session.track(sequence.frames[:1])
    assert posterior.terms["constant"] == 1.0
    assert set(session.state.monitor.history) == {"contour"}


def test_every_term_of_the_images_is_judged():
    images = {"contour", "edge_energy", "region", "flow", "joints"}
    assert set(watched_terms()) == images
