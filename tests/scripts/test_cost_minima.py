"""The count of spurious minima in its small mode."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest

from torchcss.cost.contour import ContourTerm


def test_small_mode(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script.main(script.Config(small=True, out=tmp_path))
    report = json.loads((tmp_path / "cost_minima.json").read_text())
    rows = {(row["terms"], row["potential"], row["k"]): row for row in report["rows"]}
    assert len(rows) == 2 * len(script.POTENTIALS) * len(script.EMPHASES)
    for row in rows.values():
        assert row["num_slices"] == 8 + 8
        assert row["spurious"] == sorted(row["spurious"], reverse=True)
        assert len(row["spurious"]) == len(report["least_prominences"])
    usual = report["least_prominences"].index(0.02)
    for terms in ("contour", "contour + flow"):
        first = rows[terms, "quadratic", 0.0]
        assert first["fewer"] == 0.0
        for potential in script.POTENTIALS:
            plain, weighted = rows[terms, potential, 0.0], rows[terms, potential, 1.0]
            assert first["spurious"][usual] - plain["fewer"] == pytest.approx(
                plain["spurious"][usual]
            )
            # Edges off the motion boundaries count for nothing: a large effect, on any frame.
            assert weighted["spurious"][usual] < 0.8 * plain["spurious"][usual]
    for name in ("minima_arm8", "variants_arm_0_frame_3"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    assert "Leclerc, wide" in capsys.readouterr().out


def test_variants_cost_the_same_without_a_match(script: ModuleType) -> None:
    scene = next(script.scenes(script.Config(seeds=(0,), frames=(1,))))
    usual = ContourTerm()
    for potential, sigma, _ in script.POTENTIALS.values():
        choice = script.contour_of(scene, potential, sigma, 0.0).choice
        term = choice.find(ContourTerm)
        assert term.weight * term.unmatched == pytest.approx(usual.weight * usual.unmatched)
        ratio = term.fitted_level / term.unmatched
        assert ratio == pytest.approx(usual.fitted_level / usual.unmatched)
