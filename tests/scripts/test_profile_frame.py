"""Stages are timed without those inside them, and a kernel counts for the stage that calls it."""

from __future__ import annotations

from types import ModuleType

import pytest


def test_stages_within_stages(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(script.time, "process_time", lambda: now[0])

    def spend(seconds: float) -> None:
        now[0] += seconds

    clock, (inner, *_, outer) = script.Clock(), script.STAGES
    kernel, inside = clock.kernel(spend), clock.stage(inner, lambda: kernel(2.0))

    def frame() -> None:
        spend(1.0)
        inside()
        kernel(4.0)

    for _ in range(2):
        clock.stage(outer, frame)()
    assert len(clock.frames) == 2
    for times in clock.frames:
        assert times[inner].tolist() == [2.0, 2.0]
        assert times[outer].tolist() == [5.0, 4.0]
