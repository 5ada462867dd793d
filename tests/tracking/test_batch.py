"""Many sequences side by side find what one after the other finds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from made_sequences import rendered_arm
from made_sessions import seen_by, session_at

import torchcss
from torchcss.body.load import load_body
from torchcss.cost.total import TrackingCost
from torchcss.errors import ConfigurationError, TorchcssError, VideoError
from torchcss.kernels import compiler
from torchcss.studies.render.sequences import SyntheticSequence
from torchcss.tracking import batch
from torchcss.tracking.session import Posterior, TrackingSession
from torchcss.tracking.settings import Settings
from torchcss.vision.camera import Camera


@pytest.fixture(scope="module")
def films() -> list[SyntheticSequence]:
    """Two films of an arm, of two and of three frames, by two cameras, of two builds."""
    short, long = (rendered_arm(seed, num) for seed, num in ((3, 2), (4, 3)))
    lengths = {name: 1.05 * value for name, value in long.body.lengths.items()}
    body = load_body("arm8", lengths=lengths)
    body = body.with_base(long.body.base_rotation, long.body.base_translation)
    camera = long.camera
    shrunk = torch.diag(torch.tensor([0.8, 0.8, 1.0]).double())
    other = Camera(
        shrunk @ camera.K,
        camera.image_size_wh,
        R_camera_world=camera.R_camera_world,
        t_camera_world=camera.t_camera_world,
        distortion=[-0.1, 0.02, 0.0, 0.0, 0.0],
    )
    return [short, replace(long, body=body, camera=other)]


def session_of(film: SyntheticSequence, seed: int, **settings: Any) -> TrackingSession:
    body = film.body
    chosen = Settings(
        body=body.name, seed=seed, **{"samples": 6, "modes": 2, "working_size": 160, **settings}
    )
    view = seen_by(film.camera, film.joints_world, body.joint_names)
    return session_at(chosen, deepcopy(body), film.states[0], view)


def one_by_one(films: list[SyntheticSequence], **settings: Any) -> list[list[Posterior]]:
    """What is found one after the other."""
    return [
        list(session_of(film, seed, **settings).track(film.frames))
        for seed, film in enumerate(films)
    ]


def side_by_side(films: list[SyntheticSequence], **settings: Any) -> list[list[Posterior]]:
    """What is found of all at once."""
    sessions = [session_of(film, seed, **settings) for seed, film in enumerate(films)]
    beside: list[list[Posterior]] = [[] for _ in films]
    pairs = [(session, film.frames) for session, film in zip(sessions, films, strict=True)]
    for moment in torchcss.track_batch(pairs):
        for own, posterior in zip(beside, moment, strict=True):
            own += [] if posterior is None else [posterior]
    return beside


@pytest.mark.parametrize(
    ("engine", "preset"),
    [
        *(("eager", preset) for preset in ("css", "ijrr_condensation")),
        *(
            pytest.param(
                "fused",
                preset,
                marks=pytest.mark.skipif(not compiler.AVAILABLE, reason="needs numba"),
            )
            for preset in (
                "css",
                "ijrr_css",
                "ijrr_cham_rehg",
                "annealed",
                "rr_multiple_hypothesis",
            )
        ),
    ],
)
def test_the_results_are_those_of_one_after_the_other(
    films: list[SyntheticSequence], engine: str, preset: str
) -> None:
    given = {"preset": preset, "engine": engine}
    alone, beside = one_by_one(films, **given), side_by_side(films, **given)
    for one, other in zip(alone, beside, strict=True):
        assert [p.frame.index for p in one] == [p.frame.index for p in other]
        for a, b in zip(one, other, strict=True):
            for mine, theirs in zip(a.state.mixture, b.state.mixture, strict=True):
                if engine == "fused":
                    assert torch.equal(mine, theirs)
                torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-9)
            assert torch.equal(a.state.generator_state, b.state.generator_state)
            assert a.lost == b.lost


@pytest.fixture
def sizes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many sequences each evaluation was of."""
    found: list[int] = []
    answer: Callable[..., None] = batch._answer

    def counted(asks: Any, *more: Any) -> None:
        found.append(len(asks))
        answer(asks, *more)

    monkeypatch.setattr(batch, "_answer", counted)
    return found


def test_samples_of_all_are_one_evaluation(
    films: list[SyntheticSequence], sizes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[int]] = []
    model = TrackingCost.local_model

    def noted(cost: TrackingCost, x: torch.Tensor) -> Any:
        if cost.sequence is not None:
            seen.append(cost.sequence.unique().tolist())
        return model(cost, x)

    monkeypatch.setattr(TrackingCost, "local_model", noted)
    side_by_side(films, engine="eager")
    assert [0, 1] in seen
    # The longer film goes on by itself, and a search that takes longer does.
    assert set(sizes) == {1, 2}
    assert sizes.count(2) > 10


def test_other_settings_are_tracked_beside(
    films: list[SyntheticSequence], sizes: list[int]
) -> None:
    film = films[0]
    few = [session_of(film, 0, curvature=each) for each in ("exact", "gauss-newton")]
    moments = list(torchcss.track_batch((session, film.frames[:1]) for session in few))
    assert len(moments) == 1
    assert set(sizes) == {1}


def test_nothing_is_lost_when_one_fails(films: list[SyntheticSequence]) -> None:
    film = films[1]
    good, bad = (session_of(film, seed, engine="eager") for seed in (0, 1))
    frames = [*film.frames[:1], np.arange(75, dtype=np.uint8).reshape(5, 5, 3)]
    moments = torchcss.track_batch([(bad, frames), (good, film.frames)])
    next(moments)
    with pytest.raises(TorchcssError):
        next(moments)
    assert int(good.state.tracker.frame) == 2
    assert int(bad.state.tracker.frame) == 1
    # Both go on from where they stand.
    for posterior in torchcss.track_batch([(good, film.frames[2:])]):
        assert posterior[0] is not None
    assert int(good.state.tracker.frame) == 3


def test_a_film_that_cannot_be_read_on_keeps_no_other_waiting(
    films: list[SyntheticSequence],
) -> None:
    film = films[1]
    good, bad = (session_of(film, seed, engine="eager") for seed in (0, 1))

    def broken() -> Iterator[np.ndarray]:
        yield film.frames[0]
        raise VideoError("no more")

    moments = torchcss.track_batch([(good, film.frames), (bad, broken())])
    next(moments)
    with pytest.raises(VideoError, match="no more"):
        next(moments)
    assert int(good.state.tracker.frame) == 2
    assert int(bad.state.tracker.frame) == 1


def test_what_fails_in_an_evaluation_is_told_to_those_who_asked(
    films: list[SyntheticSequence], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(cost: TrackingCost, evaluate: Callable[..., Any], x: torch.Tensor) -> None:
        raise VideoError("no more")

    pairs = [(session_of(film, 0, engine="eager"), film.frames) for film in films]
    monkeypatch.setattr(TrackingCost, "_evaluated", fails)
    with pytest.raises(VideoError, match="no more"):
        next(torchcss.track_batch(pairs))


def test_a_session_is_tracked_once_at_a_time(films: list[SyntheticSequence]) -> None:
    session = session_of(films[0], 0)
    with pytest.raises(ConfigurationError, match="one is given twice"):
        next(torchcss.track_batch([(session, films[0].frames)] * 2))
    frames = iter(films[0].frames)  # of which each would get every second one
    with pytest.raises(ConfigurationError, match="one is given twice"):
        next(torchcss.track_batch((session_of(films[0], n), frames) for n in range(2)))


def test_no_sequence_at_all() -> None:
    assert list(torchcss.track_batch([])) == []
