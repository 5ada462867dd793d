"""The benchmark in its small mode; never what it says about time."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "benchmark.py"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
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
    # A process per way takes seconds to load the libraries; the test below starts one.
    monkeypatch.setattr(script, "memory_in_own_process", script.measure_memory)
    out = tmp_path / "tables" / "benchmark.json"
    script.main(script.Config(samples=20, repeats=2, plain_chunk=7, dtype=dtype, out=out))
    report = json.loads(out.read_text())
    metrics = report["metrics"]
    assert set(report["unit"]) == set(report["direction"]) == set(metrics)
    assert set(metrics["seconds"]) == set(metrics["memory"]) == set(script.WAYS)
    for row in metrics["seconds"].values():
        assert 0 < row["lower_quartile"] <= row["median"] <= row["upper_quartile"]
    assert set(metrics["times_closed_form"]) == set(metrics["relative_difference"])
    assert max(metrics["relative_difference"].values()) < tolerance
    assert "times the closed form" in capsys.readouterr().out


def test_memory_is_that_of_a_process_of_its_own(script: ModuleType) -> None:
    config = script.Config(samples=300, threads=1)
    memory = script.memory_in_own_process(config, script.PLAIN)
    # What importing took may hide what the work adds, so that zero is an honest answer too.
    assert memory["peak_mib"] > memory["added_mib"] >= 0.0
    assert memory["peak_mib"] > 50.0
