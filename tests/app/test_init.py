"""The first pose of a video: what the settings ask for reaches the fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchcss.app.init as app_init
from torchcss.body.catalog import PROPORTIONS
from torchcss.initialise.multi_start import PAPER_LENGTHS, StartSearch
from torchcss.initialise.noise import Noise
from torchcss.tracking.presets import PRESETS
from torchcss.tracking.settings import Settings
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

NOBODY = Keypoints(torch.zeros(1, 1, 2), torch.zeros(1, 1), ("l_wrist",))


@pytest.mark.parametrize("preset", PRESETS)
def test_a_papers_preset_has_the_papers_priors(
    preset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}
    monkeypatch.setattr(app_init, "read_frame", lambda *_: np.zeros((48, 64, 3), np.uint8))
    monkeypatch.setattr(app_init, "initialise", lambda *_, **options: asked.update(options))
    app_init.initialise_video(
        Path("film.mp4"),
        NOBODY,
        Camera.pinhole(64, 48, focal_px=60.0),
        Settings(preset=preset),
        start=0,
        noise=Noise(2.0),
        generator=torch.Generator(),
    )
    options, row = asked["options"], PRESETS[preset]
    assert options.printed == (None if row.cost == "ours" else row.cost)
    proportions = PROPORTIONS if row.cost == "ours" else PAPER_LENGTHS
    assert options.search == StartSearch(proportions=proportions)
    ours = row.terms == "default"
    assert (options.pose_prior, options.colours) == (ours, ours)
