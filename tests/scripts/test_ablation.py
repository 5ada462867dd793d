"""The ablation of the cost's terms, on a few frames."""

from __future__ import annotations

import json
from pathlib import Path

import ablation as script
import pytest

from torchcss.errors import ConfigurationError
from torchcss.tracking.settings import TERMS, all_terms


def test_demo_in_small(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "new" / "ablation.json"
    rows = ("joints and priors only", "+ segmentation")
    report = script.main(script.Config(rows=rows, small=True, out=out))
    assert list(report["rows"]) == list(rows)
    cells = [report["rows"][row]["demo"] for row in rows]
    assert all(0 < cell["best_of_modes_mm"] < cell["best_mm"] + 1e-6 for cell in cells)
    assert cells[1]["best_mm"] < 40  # all terms, four frames from a known start
    assert json.loads(out.read_text())["rows"] == report["rows"]
    printed = capsys.readouterr().out
    assert all(row in printed for row in rows)


def test_clip_in_small(shared_data: Path):
    config = script.Config(
        data=shared_data, sequences=("cam01:all",), rows=("+ segmentation",), small=True
    )
    cell = script.main(config)["rows"]["+ segmentation"]["cam01:all"]
    assert cell["frames_lost"] == 0
    assert cell["best_of_modes_mm"] <= cell["best_mm"] < 150


def test_rows_are_of_known_terms_and_end_with_the_default():
    assert all(set(terms) <= set(all_terms()) for terms in script.ROWS.values())
    # Keypoints' lengths are fitted in the first pose; the prior on them is silent in a track.
    assert set(script.ROWS["+ pose prior"]) == set(TERMS) - {"anthropometric"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": ("+ magic",)}, "no rows"),
        ({"sequences": ("cam01",)}, "no sequences"),
        ({"sequences": ("cam01:all",)}, "need --data"),
    ],
)
def test_bad_choices_are_refused(change: dict[str, tuple[str, ...]], message: str):
    with pytest.raises(ConfigurationError, match=message):
        script.main(script.Config(**change))  # type: ignore[arg-type]
