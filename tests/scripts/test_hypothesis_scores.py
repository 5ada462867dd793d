"""Edges or the full cost, a pattern or random samples: the small mode, and what is compared."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from made_sequences import write_arm

from torchcss.errors import ConfigurationError


def test_small_mode(script: ModuleType, tmp_path: Path) -> None:
    folder, out = tmp_path / "arm", tmp_path / "scores.json"
    write_arm(folder, 3)
    small = replace(script.TRACKING, working_size=160)
    config = script.Config(sequences=(folder,), seeds=1, frames=3, tracking=small, out=out)
    report = script.main(config)
    (rows,) = report["by_sequence"].values()
    assert list(rows) == ["edges", "full", "random"]
    assert -1 <= rows["edges"]["rank_correlation"] <= 1
    assert 0 <= rows["edges"]["same_best"] <= 1
    assert "rank_correlation" not in rows["full"]
    assert all(row["root_aligned_mm"][0] < 150 for row in rows.values())
    assert len(json.loads(out.read_text())["table"]["rows"]) == 3
    other = replace(config, tracking=replace(small, preset="css"))
    with pytest.raises(ConfigurationError, match=r"expected one of \[RR\], got 'css'"):
        script.main(other)


def test_what_is_compared(script: ModuleType) -> None:
    first = torch.tensor([3.0, 1.0, 2.0, 5.0])
    assert script.rank_correlation(first, 10 * first) == 1
    assert script.rank_correlation(first, -first) == -1
    assert math.isnan(script.rank_correlation(first[:2], first[:2]))
    assert math.isnan(script.rank_correlation(first, torch.ones(4)))
    assert script.same_best(first, first, 2) == 1
    assert script.same_best(first, -first, 2) == 0
    assert script.same_best(first, first[[1, 0, 2, 3]], 1) == 0
