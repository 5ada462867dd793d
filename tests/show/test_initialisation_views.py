"""The picture of the hypotheses of a first pose."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from torchcss.body.model import BodyModel
from torchcss.show import initialisation_views
from torchcss.vision.camera import Camera


def test_both_axes_say_what_they_are(
    body: BodyModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(
        initialisation_views, "save_figure", lambda figure, *_, **__: drawn.append(figure)
    )
    camera = Camera.pinhole(640, 480, focal_px=500.0)
    away = body.with_base(
        body.base_rotation, body.base_translation + body.tie.new_tensor([0, 0, 4])
    )
    initialisation_views.draw_hypotheses(
        tmp_path / "side.png", away, away.sticky_mean[None], camera
    )
    (figure,) = drawn
    told = {(axes.get_xlabel(), axes.get_ylabel()) for axes in figure.axes}
    assert told == {("metres", "metres up")}
