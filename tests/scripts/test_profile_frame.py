"""Stages are timed without those inside them, and a kernel counts for the stage that calls it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


def test_stages_within_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    spec = importlib.util.spec_from_file_location("profile_frame", SCRIPTS / "profile_frame.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "profile_frame", module)
    spec.loader.exec_module(module)
    now = [0.0]
    monkeypatch.setattr(module.time, "process_time", lambda: now[0])

    def spend(seconds: float) -> None:
        now[0] += seconds

    clock, (inner, *_, outer) = module.Clock(), module.STAGES
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
