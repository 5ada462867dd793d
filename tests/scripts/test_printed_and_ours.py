"""As printed against ours, part by part: the small mode, and what is exchanged."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

from made_sequences import write_arm

from torchcss.studies.sequences import read_sequence


def test_small_mode(script: ModuleType, tmp_path: Path) -> None:
    folder, out = tmp_path / "arm", tmp_path / "exchange.json"
    write_arm(folder, 2)
    small = replace(script.Config.tracking, working_size=160, samples=4)
    config = script.Config(sequences=(folder,), seeds=1, frames=2, tracking=small, out=out)
    report = script.main(config)
    (rows,) = report["by_sequence"].values()
    assert set(rows) == {
        "ours", "ours, printed cost", "ours, printed search", "ours, printed dynamics",
        "printed", "printed, our cost", "printed, our search", "printed, our dynamics",
    }  # fmt: skip
    assert len(json.loads(out.read_text())["table"]["rows"]) == 8

    named = script.entrants(config, read_sequence(folder), 0)
    plans = {name: plan for name, (_, _, plan) in named.items()}
    ours, printed = plans["ours"], plans["printed"]
    cost = plans["ours, printed cost"]
    assert cost.choice == printed.choice
    assert cost.tracker == ours.tracker
    search = plans["ours, printed search"]
    assert search.choice == ours.choice
    assert search.one_fit
    assert search.tracker.proposal == printed.tracker.proposal
    assert search.tracker.dynamics == ours.tracker.dynamics
    dynamics = plans["printed, our dynamics"]
    assert dynamics.tracker == replace(printed.tracker, dynamics=ours.tracker.dynamics)
