"""The ablation: rows of settings, and how their errors are compared."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

from torchcss import Settings
from torchcss.errors import ConfigurationError
from torchcss.studies.render.sequences import shot
from torchcss.studies.sequence_writer import write_sequence
from torchcss.tracking.settings import all_terms


def test_two_rows_of_a_clip(script: ModuleType, tmp_path: Path) -> None:
    write_sequence(tmp_path / "clips" / "one", shot("body-clutter", num_frames=2, small=True))
    config = script.Config(
        data=tmp_path / "clips",
        rows=("without flow",),
        runs=tmp_path / "runs",
        seeds=1,
        tracking=replace(script.Config.tracking, samples=10, modes=2),
        out=tmp_path / "ablation.json",
    )
    rows = script.main(config)["rows"]
    assert list(rows) == ["the default", "without flow"]
    table = json.loads((tmp_path / "ablation.json").read_text())["table"]["rows"]
    assert table[0][1] == f"{rows['the default'][0]['PA']:.1f}"
    apart = rows["without flow"][0]["PA"] - rows["the default"][0]["PA"]
    assert f"({apart:+.1f} ± nan)" in table[1][1]
    summary = json.loads((tmp_path / "runs/without-flow/one/0/summary.json").read_text())
    assert "flow" not in summary["settings"]["terms"]


def test_differences_are_paired_by_clip(script: ModuleType) -> None:
    def rows(*values: float) -> list[dict[str, object]]:
        inside = dict.fromkeys((0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95), 0.5)
        named = ("PA", "best PA", "root", "best root", "NLL", "lost")
        return [{**dict.fromkeys(named, value), "s": None, "inside": inside} for value in values]

    found = script.row_of(rows(12.0, 14.0, 20.0, 22.0), rows(10.0, 12.0, 19.0, 19.0), 2)
    assert found[0] == "17.0 (+2.0 ± 0.0)"
    assert found[-1] is None
    assert script.row_of(default := rows(10.0, 12.0), default, 1)[0] == "11.0"


def test_each_figure_is_judged_with_all_others(script: ModuleType) -> None:
    def rows(*values: float) -> list[dict[str, object]]:
        still = dict.fromkeys(script.ERRORS, 50.0)
        return [{"clip": "one", **still, "PA": value} for value in values]

    default = rows(10.0, 12.0, 11.0, 13.0)
    assert script.judged(rows(13.0, 15.2, 14.0, 16.2), default) == ["one PA +3.1 ± 0.1"]
    assert script.judged(rows(11.0, 9.0, 14.0, 13.5), default) == []
    # Three standard errors of one figure of forty are none.
    clips = [{**row, "clip": str(clip)} for clip in range(10) for row in default]
    apart = [0.5, 1.0, 1.5, 3.0]
    varied = [{**row, "PA": row["PA"] + step} for row, step in zip(clips, apart, strict=False)]
    assert script.judged(varied, clips[:4])
    assert not script.judged([*varied, *clips[4:]], clips)


def test_rows_are_settings(script: ModuleType) -> None:
    base = Settings()
    for name in script.ROWS:
        settings = script.settings_of(name, base)
        assert set(settings.used_terms) <= set(all_terms())
        assert (settings == base) == (name == script.DEFAULT)
    assert "contour" not in script.settings_of("without contour", base).used_terms
    with pytest.raises(ConfigurationError, match="no rows"):
        script.main(script.Config(data=Path(), rows=("+ magic",)))
