"""Losses told from the costs."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Mapping
from typing import Any

import pytest

from torchcss.errors import ConfigurationError
from torchcss.inference.loss_monitor import LossMonitor, MonitorState

MONITOR = LossMonitor()


def judge(
    frames: Iterable[Mapping[str, float]], monitor: LossMonitor = MONITOR
) -> tuple[list[bool], list[MonitorState]]:
    """Whether each frame counts as lost, and what is known after it."""
    return judge_on(monitor.init(), frames, monitor)


def judge_on(
    state: MonitorState, frames: Iterable[Mapping[str, float]], monitor: LossMonitor = MONITOR
) -> tuple[list[bool], list[MonitorState]]:
    """The same, from where another run left off."""
    lost, states = [], []
    for costs in frames:
        state, now = monitor.update(state, costs)
        lost.append(now)
        states.append(state)
    return lost, states


def steady(num: int, seed: int = 0, jump: Mapping[int, float] | None = None) -> list[dict]:
    """Costs of two terms with noise, in some frames with something on top."""
    noise, extra = random.Random(seed), jump or {}
    return [
        {"contour": noise.gauss(100, 8) + extra.get(frame, 0), "joints": noise.gauss(30, 5)}
        for frame in range(num)
    ]


@pytest.mark.parametrize("seed", range(20))
def test_steady_costs_never_alarm(seed: int):
    lost, _ = judge(steady(300, seed))
    assert not any(lost)


@pytest.mark.parametrize("seed", range(5))
def test_a_jump_alarms_within_three_frames_and_ends_with_it(seed: int):
    jump = dict.fromkeys(range(40, 60), 80.0)
    lost, states = judge(steady(90, seed, jump))
    assert not any(lost[:41])
    assert all(lost[42:60])
    assert states[45].score > 4
    # The sum is bounded, so that even a long loss ends soon after its cause.
    assert not any(lost[75:])


def test_one_bad_frame_is_no_loss():
    for at in range(20, 40):
        lost, _ = judge(steady(60, 3, {at: 1e6}))
        assert not any(lost)


def test_terms_come_and_go():
    """Keypoints in every fifth frame: a frame is judged by the terms that it has."""
    frames = steady(200)
    for number, costs in enumerate(frames):
        if number % 5:
            del costs["joints"]
    lost, states = judge(frames)
    assert not any(lost)
    assert len(states[-1].history["joints"]) == 40
    # A term never seen before is learnt, not judged; without any term nothing is.
    state, now = MONITOR.update(states[-1], {"flow": 1e9})
    assert (now, state.score, state.history["flow"]) == (False, 0.0, (1e9,))
    assert MONITOR.update(states[-1], {})[1] is False
    # A loss is told by any of them alone.
    for name in ("contour", "joints"):
        state, now = states[-1], False
        for _ in range(3):
            state, now = MONITOR.update(state, {name: 300.0})
        assert now


@pytest.mark.parametrize("unknown", [{}, {"flow": 3.0}])
def test_a_frame_of_which_nothing_is_known_finds_nothing(unknown: dict[str, float]):
    _, states = judge(steady(60, 1, dict.fromkeys(range(40, 60), 200.0)))
    lost, after = judge_on(states[-1], [unknown] * 3)
    assert all(lost)
    assert after[-1].total == states[-1].total
    assert after[-1].history == states[-1].history


@pytest.mark.parametrize("cost", [math.nan, math.inf])
def test_costs_that_are_no_numbers_count_as_far_off_and_are_not_learnt(cost: float):
    _, states = judge(steady(60))
    lost, after = judge_on(states[-1], [{"contour": cost, "joints": 30.0}] * 3)
    assert lost == [False, True, True]
    assert after[-1].history == states[-1].history
    assert after[-1].excess == states[-1].excess


def test_nothing_is_judged_before_enough_is_known():
    lost, states = judge({"contour": 10.0 ** (frame % 5)} for frame in range(MONITOR.burn_in))
    assert not any(lost)
    assert all(state.score == 0 for state in states)


def test_nothing_is_learnt_while_suspicious():
    lost, states = judge(steady(60, 1, dict.fromkeys(range(40, 60), 200.0)))
    assert lost[-1]
    for state in states[41:]:
        assert state.history == states[40].history
        assert state.excess == states[40].excess
    assert max(states[-1].history["contour"]) < 150


def test_only_the_window_is_remembered():
    _, states = judge(steady(30), LossMonitor(window=10))
    assert len(states[-1].history["contour"]) == len(states[-1].excess) == 10
    # The state is a record: what comes later leaves it as it was.
    assert len(states[3].history["contour"]) == 4


def test_a_sharper_monitor_alarms_first():
    frames = steady(60, 2, dict.fromkeys(range(40, 60), 20.0))
    sharp, _ = judge(frames, LossMonitor(slack=0.5, threshold=4))
    dull, _ = judge(frames, LossMonitor(slack=3.0, threshold=50))
    assert any(sharp)
    assert not any(dull)


@pytest.mark.parametrize("name", ["slack", "threshold", "most", "burn_in", "window", "floor"])
@pytest.mark.parametrize("value", [0, -1, float("nan")])
def test_bad_configuration(name: str, value: Any):
    with pytest.raises(ConfigurationError, match=rf"LossMonitor\.{name}"):
        LossMonitor(**{name: value})


def test_a_window_holds_what_is_learnt_before_anything_is_judged():
    with pytest.raises(ConfigurationError, match=r"LossMonitor\.burn_in: .* the window"):
        LossMonitor(window=5)
    assert LossMonitor(burn_in=5, window=5).burn_in == 5
