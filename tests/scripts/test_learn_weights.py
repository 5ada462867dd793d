"""Learning weights in small: it runs, repeats, and says what it did."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import learn_weights as script
import pytest

from torchcss.errors import ConfigurationError, TorchcssError
from torchcss.tracking.settings import Settings

SMALL = script.Config(frames=2, epochs=1, starts=1, track=True,
    begin={"contour": 0.1, "region": 0.1},
    tracking=Settings(body="arm8", keypoints_use="first", working_size=160))  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def rendered_once() -> Iterator[None]:
    """The same films for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(script, "load", cache(script.load))
        yield


def test_in_small(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    report = script.main(script.replace(SMALL, out=tmp_path / "j" / "report.json"))
    assert set(report["weights_after"]) == set(SMALL.learnt)
    assert report["weights_after"] != report["weights_before"]
    assert all(weight > 0 for weight in report["weights_after"].values())
    assert len(report["train_mm"]) == 2
    assert report["track_after_mm"]["best_of_modes"] <= report["track_after_mm"]["best_mode"]
    written = json.loads((tmp_path / "j" / "report.json").read_text())
    assert written["test_after_mm"] == pytest.approx(report["test_after_mm"])
    assert "whole track" in capsys.readouterr().out
    again = script.main(script.replace(SMALL, track=False))
    assert again["weights_after"] == report["weights_after"]


def test_bad_sequences_are_refused(tmp_path: Path):
    with pytest.raises(TorchcssError, match="there is no such"):
        script.main(script.replace(SMALL, test=str(tmp_path / "none")))
    with pytest.raises(ConfigurationError, match="no terms"):
        script.main(script.replace(SMALL, begin={"joints": 1.0}))
    with pytest.raises(ConfigurationError, match="segmentation has no derivatives"):
        script.main(script.replace(SMALL, learnt=("contour", "segmentation")))
