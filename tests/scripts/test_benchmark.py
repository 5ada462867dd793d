"""The benchmark in its small mode; never what it says about time."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from torchcss.cost.interior import InteriorNodes
from torchcss.cost.visibility import ContourPredictor

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "benchmark.py"
WAYS = {
    *("joints_value", "joints_closed", "joints_plain"),
    *("full_value", "full_closed", "full_autograd", "full_one_by_one"),
}
TERMS = {"pose", "visibility", "contour", "flow", "joints", "interpenetration", "stabiliser"}


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(SCRIPT.parent)
    specification = importlib.util.spec_from_file_location("benchmark", SCRIPT)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    monkeypatch.setitem(sys.modules, "benchmark", module)
    specification.loader.exec_module(module)
    monkeypatch.setattr(module, "AT_LEAST_S", 0.0)
    return module


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-10), ("float32", 1e-2)])
def test_small_mode_agrees_with_autograd(
    script: ModuleType,
    dtype: str,
    tolerance: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # A process per way takes seconds to load the libraries; the last test starts one.
    memory = {"peak_mib": 2.0, "added_mib": 1.0}
    monkeypatch.setattr(script, "memory_in_own_process", lambda config, name: memory)
    out = tmp_path / "tables" / "benchmark.json"
    config = script.Config(
        samples=12,
        repeats=1,
        plain_joints=7,
        plain_full=4,
        size_wh=(160, 120),
        dtype=dtype,
        out=out,
    )
    script.main(config)
    report = json.loads(out.read_text())
    metrics = report["metrics"]
    assert set(report["unit"]) == set(metrics)
    assert set(metrics["seconds"]) == set(metrics["memory"]) == WAYS
    for row in metrics["seconds"].values():
        assert 0 < row["lower_quartile"] <= row["median"] <= row["upper_quartile"]
    assert set(metrics["ratio"]) == set(script.COMPARED)
    assert len(metrics["relative_difference"]) == 2
    assert max(metrics["relative_difference"].values()) < tolerance
    assert set(metrics["seconds_by_term"]["full_value"]) == TERMS
    assert set(metrics["seconds_by_term"]["full_closed"]) == TERMS | {"lift"}
    assert metrics["seconds_of_features"]["median"] > 0
    text = capsys.readouterr().out
    assert "full_autograd takes" in text
    assert "features of a frame" in text


def test_the_full_cost_has_a_thousand_nodes(script: ModuleType) -> None:
    ways, full = script.make_ways(script.Config(samples=1, size_wh=(160, 120)))
    _, x = ways["full_value"]
    tables = full.views[0].tables
    nodes = tables.of(ContourPredictor).num_nodes + tables.of(InteriorNodes).num_nodes
    assert nodes >= 1000
    assert set(full.terms(x)) == TERMS - {"pose", "visibility"}


def test_memory_is_that_of_a_process_of_its_own(script: ModuleType) -> None:
    config = script.Config(samples=300, threads=1)
    memory = script.memory_in_own_process(config, "joints_closed")
    # What importing took may hide what the work adds, so that zero is an honest answer too.
    assert memory["peak_mib"] > memory["added_mib"] >= 0.0
    assert memory["peak_mib"] > 50.0
