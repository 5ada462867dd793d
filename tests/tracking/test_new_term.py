"""A term that the package has never heard of, from one class and one entry in the table."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from jaxtyping import Int
from made_sequences import rendered_arm
from made_sessions import seen_by, session_at
from torch import Tensor

from torchcss.cost.choice import TERM_TABLE
from torchcss.cost.context import FrameContext
from torchcss.cost.term import Kind, Posed, Term, differentiated
from torchcss.inference.implicit import TermWeights, weighted_minimum
from torchcss.kernels import compiler
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.studies.slices import joint_lines, sample_slice
from torchcss.tracking.session import Posterior, TrackingSession
from torchcss.tracking.settings import Settings, all_terms
from torchcss.types import Frame, PointCost


@dataclass(frozen=True, kw_only=True)
class Middle(Term):
    """Joints are near the middle of the picture, where there is a picture."""

    name: ClassVar[str] = "middle"
    kind: ClassVar[Kind] = "image"
    watched: ClassVar[bool] = True

    sigma: float = 200.0

    def prepare(self, context: FrameContext) -> BoundMiddle | None:
        if context.is_out:
            return None
        return BoundMiddle(self, context.body.marker_link)


@dataclass(frozen=True, eq=False)
class BoundMiddle:
    term: Middle
    link: Int[Tensor, " j"]
    scale: float = 1.0
    size: int = 0

    def points(self, posed: Posed) -> Tensor:
        return posed.pose.joints

    def value(self, posed: Posed, at: Tensor | None = None) -> Tensor:
        uv = posed.camera.project(self.points(posed) if at is None else at).uv
        middle = 0.5 * uv.new_tensor(posed.camera.image_size_wh)
        return 0.5 * ((uv - middle) / self.term.sigma).square().sum(-1)

    def point_cost(self, posed: Posed, *, gauss_newton: bool = False) -> PointCost:
        return differentiated(self, posed)


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    return rendered_arm(3, 3)


@pytest.fixture
def settings(monkeypatch: pytest.MonkeyPatch) -> Settings:
    monkeypatch.setitem(TERM_TABLE, "middle", Middle)
    terms = ("contour", "stabiliser", "temporal", "middle")
    return Settings(
        body="arm8", terms=terms, samples=4, modes=2, working_size=160, weights={"middle": 2.0}
    )


def tracked(
    sequence: SyntheticSequence, settings: Settings
) -> tuple[TrackingSession, list[Posterior]]:
    body, first = sequence.body, sequence.states[0]
    session = session_at(settings, body, first, seen_by(sequence.camera))
    frames = (Frame(index, index / 25, image) for index, image in enumerate(sequence.frames))
    return session, list(session.track(frames))


def test_it_tracks_is_timed_weighed_and_watched(
    sequence: SyntheticSequence, settings: Settings
) -> None:
    assert "middle" in all_terms()
    session, found = tracked(sequence, settings)
    last = found[-1]
    assert set(last.terms) == set(settings.terms)
    assert last.term_seconds["middle"] > 0
    assert session.state.monitor is not None
    assert len(session.state.monitor.history["middle"]) == len(found)
    # Half the weight, half the cost of the same poses.
    half = replace(settings, weights={"middle": 1.0})
    first, other = (tracked(sequence, each)[1][0] for each in (settings, half))
    assert first.terms["middle"] > 1.5 * other.terms["middle"]
    missing = [Frame(0, 0.0, np.zeros_like(sequence.frames[0]))]
    session = session_at(settings, sequence.body, sequence.states[0], seen_by(sequence.camera))
    assert "middle" not in next(iter(session.track(missing))).terms


@pytest.mark.skipif(not compiler.AVAILABLE, reason="needs numba")
def test_both_engines_know_it(sequence: SyntheticSequence, settings: Settings) -> None:
    """Without a kernel it is evaluated eagerly and added to what the kernels give."""
    view, x = seen_by(sequence.camera), sequence.states[:3]
    found = []
    for engine in ("fused", "eager"):
        each = replace(settings, engine=engine, engine_dtype="float64")
        session = session_at(each, sequence.body, x[0], view)
        seen = session.observe(Frame(0, 0.0, sequence.frames[0])).views[0]
        (observer,) = session._observers
        cost = observer.cost(seen, session.state.memory[0], sequence.body, None)
        assert (cost.engine is None) == (engine == "eager")
        without = replace(cost, choice=cost.choice.without("middle"))
        assert bool((cost.value(x) > without.value(x)).all())
        found.append((cost.value(x), *cost.local_model(x)))
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-6)


def test_it_is_learnt_and_plotted(sequence: SyntheticSequence, settings: Settings) -> None:
    session = session_at(settings, sequence.body, sequence.states[0], seen_by(sequence.camera))
    seen = session.observe(Frame(0, 0.0, sequence.frames[0]))
    (observer,), (view,) = session._observers, seen.views
    cost = observer.cost(view, session.state.memory[0], sequence.body, None)
    weights = TermWeights(("middle",))
    x = weighted_minimum(cost, weights, sequence.states[:2], sequence.body.bounds)
    x.square().sum().backward()
    assert weights.log_weight.grad is not None
    assert float(weights.log_weight.grad.abs()) > 0
    n = sequence.body.num_parameters
    line = joint_lines(sequence.body.state_names, sequence.states[0], torch.eye(n).double())[0]
    drawn = sample_slice(cost.terms, line, (-0.2, 0.2), 11)
    assert float(np.ptp(drawn.values["middle"])) > 0
