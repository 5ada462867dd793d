"""Figures: that they show what they are given, and can be written."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from torchcss.errors import OutputError
from torchcss.show.style import save_figure
from torchcss.studies import plots
from torchcss.studies.slices import Slice, StateLine, sample_slice


def terms(x: torch.Tensor) -> dict[str, torch.Tensor]:
    t = x[:, 0]
    return {
        "contour": 10 * (t**2 - 1) ** 2,
        "flow": 3 * t,
        "interpenetration": torch.zeros_like(t),
    }


@pytest.fixture
def taken() -> Slice:
    axes = torch.eye(2, dtype=torch.float64)
    return sample_slice(
        terms, StateLine("r_elbow_flexion", 0 * axes[0], axes[0], 0.5), (-1.5, 1.5), 101
    )


def test_a_slice_shows_its_terms_above_the_centre(taken: Slice) -> None:
    axes = Figure().subplots()
    plots.draw_slice(axes, taken, plots.unit_of(taken.line))
    curves = {line.get_label(): line for line in axes.get_lines()}
    assert {"contour", "flow", "sum"} <= set(curves)
    assert "interpenetration" not in curves  # it is silent here
    for name in ("contour", "flow", "sum"):
        np.testing.assert_allclose(np.interp(0.0, *curves[name].get_data()), 0.0, atol=1e-9)
    added = np.add(curves["contour"].get_ydata(), curves["flow"].get_ydata())
    np.testing.assert_allclose(curves["sum"].get_ydata(), added, atol=1e-9)
    (circles,) = [line for line in axes.get_lines() if line.get_marker() == "o"]
    assert len(circles.get_xdata()) == 2
    low, high = axes.get_xlim()
    assert (low, high) == pytest.approx(np.rad2deg([-1.5, 1.5]))
    assert axes.get_xlabel() == "degrees"


def test_units_and_titles() -> None:
    zero = torch.zeros(1)
    of = {name: StateLine(name, zero, zero, 0.25) for name in ("root_y", "root_yaw", "eigen 3")}
    assert plots.unit_of(of["root_y"]) == ("metres", 1.0)
    assert plots.unit_of(of["root_yaw"], close=True).label == "degrees"
    assert plots.unit_of(of["eigen 3"], close=True) == ("standard deviations", 4.0)
    assert "radians and metres" in plots.unit_of(of["eigen 3"]).label
    assert plots.title_of(of["eigen 3"]) == "eigen-direction 3"


def test_terms_have_colours_of_their_own() -> None:
    colours = {name: plots.term_colour(name) for name in ("sum", "contour", "flow", "joints")}
    assert len(set(colours.values())) == 4
    assert plots.term_colour("a term of tomorrow") not in colours.values()


def test_a_figure_is_written_at_its_size(taken: Slice, tmp_path: Path) -> None:
    figure = Figure(figsize=(4, 3))
    plots.draw_slice(figure.subplots(), taken, plots.unit_of(taken.line))
    path = save_figure(figure, tmp_path / "new" / "slice.png", dpi=50)
    pixels = matplotlib.image.imread(path)
    assert pixels.shape[:2] == (150, 200)
    assert np.ptp(pixels[..., :3]) == 1.0


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        save_figure(Figure(), tmp_path / "file" / "figure.png")
