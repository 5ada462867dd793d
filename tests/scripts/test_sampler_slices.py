"""The slices of Fig. 8d in their small mode."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest


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
