"""A long run: the small mode, and what is noted."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import ModuleType

import numpy as np


def test_small_mode(script: ModuleType, tmp_path: Path) -> None:
    out = tmp_path / "long.json"
    tracking = replace(script.TRACKING, samples=4, modes=2, working_size=160)
    config = script.Config(frames=6, opened=8, every=3, tracking=tracking, out=out)
    report = script.main(config)
    assert [row["frames"] for row in report["rows"]] == [3, 6]
    assert all(row["memory_mib"] > 100 for row in report["rows"])
    assert report["track_mb"] > 0
    assert report["seconds_to_open"] > 0
    assert len(json.loads(out.read_text())["table"]["rows"]) == 2


def test_nothing_jumps(script: ModuleType) -> None:
    frames = [np.full((1, 1, 3), number) for number in range(4)]
    shown = [int(frame[0, 0, 0]) for frame in islice(script.back_and_forth(frames), 9)]
    assert shown == [0, 1, 2, 3, 2, 1, 0, 1, 2]
