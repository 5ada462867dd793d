"""benchmark_batch: both ways of the shipped clip, in small."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
from made_processes import SERVED

from torchcss.errors import ConfigurationError


def test_both_ways_find_the_same(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = replace(script.SETTINGS, samples=5, modes=2, working_size=160)
    out = tmp_path / "J.json"
    report = script.main(
        script.Config(settings=settings, sequences=2, frames=2, repeats=1, out=out)
    )
    assert report["rounds"][0]["same"]
    assert "bit for bit" in capsys.readouterr().out
    assert [row[0] for row in json.loads(out.read_text())["table"]["rows"]][2] == "ratio"


def test_a_folder_without_clips_is_refused(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no clip"):
        script.main(script.Config(data=tmp_path))


def test_processes_of_a_batch(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The processes that start the batches; a batch starts its own.
    monkeypatch.setattr(script.multiprocessing, "get_context", lambda _: SERVED)
    settings = replace(script.SETTINGS, samples=5, modes=2, working_size=160)
    out = tmp_path / "J.json"
    script.main(script.Config(
        settings=settings, sequences=2, frames=2, repeats=1, workers=2, out=out
    ))  # fmt: skip
    one, two = json.loads(out.read_text())["table"]["rows"]
    assert (one[0], two[0]) == ("1 processes", "2 processes")
    assert min(one[1], two[1]) > 0
