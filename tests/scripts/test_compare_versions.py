"""Another version beside this one: here the same, on two frames of the shipped clip."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

from torchcss.errors import ConfigurationError
from torchcss.studies.demo import CLIP

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "compare_versions.py"


def is_repository() -> bool:
    words = ["git", "-C", str(SCRIPT.parent), "rev-parse", "HEAD"]
    return subprocess.run(words, capture_output=True).returncode == 0


@pytest.mark.skipif(not is_repository(), reason="this is no git repository")
def test_small_mode(script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "versions.json"
    # Each of four processes would search for a first pose, for seconds.
    arm = [*script.clips(script.Config(against="HEAD", frames=2))["arm"], "--samples", "4"]
    given = {"arm": [*arm, "--init", str(CLIP / "body.npz")]}
    monkeypatch.setattr(script, "clips", lambda config: given)
    report = script.main(script.Config(against="HEAD", frames=2, repeats=1, two=True, out=out))
    assert list(report["rows"]) == ["arm: other", "arm: this", "arm: two threads"]
    for row in report["rows"].values():
        assert 0 < row["seconds_per_frame"] < row["seconds"]
        assert row["memory_mib"] > 100
    assert report["rows"]["arm: other"]["times_as_fast"] == [1, 1, 1]
    assert len(json.loads(out.read_text())["table"]["rows"]) == 3


def test_a_version_that_is_none_is_told(script: ModuleType) -> None:
    with pytest.raises(ConfigurationError, match="--against v99"):
        script.main(script.Config(against="v99"))


def test_what_is_tracked(script: ModuleType, tmp_path: Path) -> None:
    assert list(script.clips(script.Config(against="v0.1"))) == ["arm"]
    found = script.clips(script.Config(against="v0.1", data=tmp_path, frames=7))
    assert list(found) == ["arm", "beam", "beam, first"]
    assert all(words[words.index("--stop") + 1] == "7" for words in found.values())


def test_numbers_of_samples(script: ModuleType, tmp_path: Path) -> None:
    config = script.Config(against="v0.1", data=tmp_path, samples=(10, 60))
    found = script.clips(config)
    assert list(found) == ["10 samples", "60 samples"]
    assert all("cam01" in words for words in found.values())
    rows = {f"{num} samples: this": {"seconds_per_frame": num} for num in config.samples}
    (line,) = script.seconds_figure(config, rows).axes[0].lines
    assert list(line.get_ydata()) == [10, 60]
