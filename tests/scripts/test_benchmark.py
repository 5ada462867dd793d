"""The benchmark in its small mode; never what it says about time."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest

from torchcss.cost.interior import InteriorNodes
from torchcss.cost.visibility import ContourPredictor

WAYS = {
    *("joints_value", "joints_closed", "joints_plain"),
    *("full_value", "full_closed", "full_autograd", "full_one_by_one"),
}
TERMS = {"pose", "visibility", "contour", "flow", "joints", "interpenetration", "stabiliser"}


@pytest.fixture
def quick(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, which calls every way once."""
    monkeypatch.setattr(script, "AT_LEAST_S", 0.0)
    return script


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-10), ("float32", 1e-2)])
def test_small_mode_agrees_with_autograd(
    quick: ModuleType,
    dtype: str,
    tolerance: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # A process per way takes seconds to load the libraries; the last test starts one.
    memory = {"peak_mib": 2.0, "added_mib": 1.0}
    monkeypatch.setattr(quick, "memory_in_own_process", lambda config, name: memory)
    out = tmp_path / "tables" / "benchmark.json"
    config = quick.Config(
        samples=12,
        repeats=1,
        plain_joints=7,
        plain_full=4,
        size_wh=(160, 120),
        dtype=dtype,
        out=out,
    )
    quick.main(config)
    report = json.loads(out.read_text())
    metrics = report["metrics"]
    assert set(report["unit"]) == set(metrics)
    assert set(metrics["seconds"]) == set(metrics["memory"]) == WAYS
    for row in metrics["seconds"].values():
        assert 0 < row["lower_quartile"] <= row["median"] <= row["upper_quartile"]
    assert set(metrics["ratio"]) == set(quick.COMPARED)
    assert len(metrics["relative_difference"]) == 2
    assert max(metrics["relative_difference"].values()) < tolerance
    assert set(metrics["seconds_by_term"]["full_value"]) == TERMS
    assert set(metrics["seconds_by_term"]["full_closed"]) == TERMS | {"lift"}
    assert metrics["seconds_of_features"]["median"] > 0
    text = capsys.readouterr().out
    assert "full_autograd takes" in text
    assert "features of a frame" in text


def test_the_full_cost_has_a_thousand_nodes(quick: ModuleType) -> None:
    ways, full = quick.make_ways(quick.Config(samples=1, size_wh=(160, 120)))
    _, x = ways["full_value"]
    tables = full.views[0].tables
    nodes = tables.of(ContourPredictor).num_nodes + tables.of(InteriorNodes).num_nodes
    assert nodes >= 1000
    assert set(full.terms(x)) == TERMS - {"pose", "visibility"}


def test_memory_is_that_of_a_process_of_its_own(quick: ModuleType) -> None:
    config = quick.Config(samples=300, threads=1)
    memory = quick.memory_in_own_process(config, "joints_closed")
    # What importing took may hide what the work adds, so that zero is an honest answer too.
    assert memory["peak_mib"] > memory["added_mib"] >= 0.0
    assert memory["peak_mib"] > 50.0
