"""The slices of Fig. 8d in their small mode."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "sampler_slices.py"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    specification = importlib.util.spec_from_file_location("sampler_slices", SCRIPT)
    assert specification is not None
    assert specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    monkeypatch.setitem(sys.modules, "sampler_slices", module)
    specification.loader.exec_module(module)
    return module


def test_scaled_covariances_place_samples_at_low_cost(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "slices"
    script.main(script.Config(samples=60, resolution=21, out=out))
    report = json.loads((out / "sampler_slices.json").read_text())
    methods = report["methods"]
    assert list(methods) == ["CONDENSATION", "CSS", "MHT"], "keys are sorted in the file"
    assert 100 * methods["CSS"]["median_cost"] < methods["CONDENSATION"]["median_cost"]
    assert 100 * methods["CSS"]["median_cost"] < methods["MHT"]["median_cost"]
    # The other minimum of the flip is found along the uncertain direction.
    first, second = sorted(methods["CSS"]["minima"])
    assert abs(second[0]) < 0.01
    assert -2 < first[0] < -1
    assert abs(first[1]) < 0.1
    assert (out / "fig8d.png").stat().st_size > 10_000
    assert "median cost" in capsys.readouterr().out
