"""The study of several cameras, on a few frames of the recordings."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import several_views as script
import torch

from torchcss.tracking.settings import Settings


def test_board_in_small(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = script.Config(
        data=shared_data,
        what=("handheld_board",),
        frames=3,
        tracking=Settings(samples=8),
        out=tmp_path / "j.json",
    )
    rows = script.main(config)["handheld_board"]
    assert list(rows) == ["cam_0", "cam_2", "cam_0 + cam_2"]
    for row in rows.values():
        assert row["frames"] == 3
        assert row["absolute_mm"] < 40
    both, one = rows["cam_0 + cam_2"], rows["cam_0"]
    assert both["stated_along_mm"] < 0.5 * one["stated_along_mm"]
    assert "stated_along_mm" in capsys.readouterr().out
    assert json.loads((tmp_path / "j.json").read_text())["handheld_board"]["cam_0"] == one


@pytest.mark.parametrize("distance", [1.0, 3.0])
def test_sums_of_a_calibrated_tracker(distance: float):
    """Errors drawn from the stated covariance lie inside its regions as often as they should."""
    generator = torch.Generator().manual_seed(0)
    camera = script.Camera(
        [[500.0, 0, 100], [0, 500.0, 100], [0, 0, 1]], (200, 200),
        R_camera_world=[[0.0, 0, -1], [0, 1, 0], [1, 0, 0]],
    )  # fmt: skip
    # Ten times as unsure along the world's x axis, which is the camera's line of sight.
    spread = torch.diag(torch.tensor([distance, 0.1 * distance, 0.1 * distance]).double())
    sums = script.Sums()
    for _ in range(400):
        away = torch.randn(4, 3, generator=generator, dtype=torch.float64) @ spread
        away[0] = torch.nan
        sums.add(away, (spread @ spread).expand(4, 3, 3), camera)
    row = sums.report(0.0)
    assert row["along_mm"] == pytest.approx(row["stated_along_mm"], rel=0.1)
    assert row["across_mm"] == pytest.approx(0.1 * row["along_mm"], rel=0.1)
    assert row["inside_50"] == pytest.approx(0.5, abs=0.05)
    assert row["inside_90"] == pytest.approx(0.9, abs=0.03)
