"""predictive_power: what is kept back, its density under the modes, and which power predicts it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from torchcss.errors import ConfigurationError
from torchcss.studies.render.sequences import shot
from torchcss.studies.sequence_writer import write_sequence
from torchcss.vision.camera import Camera


def test_a_clip_is_tracked_without_some_keypoints(script: ModuleType, tmp_path: Path) -> None:
    clip = tmp_path / "clips" / "one"
    write_sequence(clip, shot("body-clutter", num_frames=3, small=True))
    config = script.Config(
        data=(tmp_path / "clips",),
        powers=(0.15, 1.0),
        frames=3,
        out=tmp_path / "J.json",
        runs=tmp_path / "runs",
        tracking=replace(script.TRACKING, samples=10, modes=2),
    )
    script.main(replace(config, frames=2))  # as if interrupted
    (row,) = script.main(config)["rows"]
    assert row["clip"] == "clips/one"
    assert row["keypoints"] == 2 * 4  # two frames, an elbow, a wrist, a knee and an ankle
    area = 160 * 120
    assert all(math.log(script.OUTLIERS / area) <= score < 0 for score in row["scores"])
    with np.load(tmp_path / "runs/clips/one/keypoints2d.npz") as shown:
        names = shown["joint_names"].tolist()
        assert (shown["confidence"][1:, names.index("l_wrist")] == 0).all()
        assert (shown["confidence"][1:, names.index("r_wrist")] > 0).all()
    written = json.loads((tmp_path / "J.json").read_text())
    assert [cells[0] for cells in written["table"]["rows"]] == [
        "clips/one",
        "mean",
        "standard error",
    ]
    assert script.main(config)["rows"] == [row]  # from the runs that are there
    (clip / "reference3d.npz").write_bytes(b"")
    first = replace(config.tracking, keypoints_use="first")
    config = replace(config, tracking=first, runs=tmp_path / "first", powers=(0.15,))
    (row,) = script.main(config)["rows"]  # which no reference is needed for
    assert row["keypoints"] == 2 * 8  # of all limbs


def test_limbs_take_turns(script: ModuleType) -> None:
    gone = script.kept_back(("l_wrist", "r_wrist", "r_toe", "l_hip"), 2 * script.BLOCK + 2)
    assert not gone[0].any()
    assert not gone[:, 3].any()
    first = [False, *[True] * script.BLOCK, *[False] * script.BLOCK, True]
    assert gone[:, 0].tolist() == gone[:, 2].tolist() == first
    assert (gone[1:, 0] != gone[1:, 1]).all()


def test_density_of_a_keypoint(script: ModuleType) -> None:
    offset = torch.tensor([[[3.0, 4.0], [0.0, 0.0], [torch.inf, torch.inf]]]).double()
    covariance = torch.diag_embed(torch.tensor([[[1.0, 9.0], [5.0, 5.0], [1.0, 1.0]]])).double()
    log_weight = torch.tensor([[0.5, 0.25, 0.25]]).double().log()
    found = script.Prediction(offset, covariance, log_weight, torch.tensor([0.5]).double(), 1e4)
    # Twice the detector's variance of 4 at half its confidence: 9 and 17, and 13 and 13.
    first = math.exp(-0.5 * (9 / 9 + 16 / 17)) / (2 * math.pi * math.sqrt(9 * 17))
    density = 0.95 * (0.5 * first + 0.25 / (2 * math.pi * 13)) + 0.05 / 1e4
    assert found.score(2.0) == pytest.approx(math.log(density))


def test_noise_is_found_again(script: ModuleType) -> None:
    generator = torch.Generator().manual_seed(0)
    offset = 6.0 * torch.randn(4000, 1, 2, generator=generator).double()
    covariance = 11.0 * torch.eye(2).double().expand(4000, 1, 2, 2)
    ones, zero = torch.ones(4000).double(), torch.zeros(4000, 1).double()
    _, noise = script.Prediction(offset, covariance, zero, ones, 1e8).best()
    assert noise == pytest.approx(5.0, rel=0.06)


def test_places_and_covariances_in_the_picture(script: ModuleType) -> None:
    camera = Camera([[100.0, 0.0, 50.0], [0.0, 200.0, 40.0], [0.0, 0.0, 1.0]], (100, 80))
    joints = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0]]).double()
    spread = torch.diag(torch.tensor([0.01, 0.02, 5.0])).double().expand(2, 3, 3)
    place, covariance = script.in_picture(camera, joints, spread)
    assert place.tolist() == [[50.0, 40.0], [math.inf, math.inf]]
    expected = torch.diag(torch.tensor([0.01 * 50.0**2, 0.02 * 100.0**2])).double()
    assert torch.allclose(covariance[0], expected)


def test_what_the_best_power_of_the_others_gives(script: ModuleType, tmp_path: Path) -> None:
    config = script.Config(data=(tmp_path,), powers=(0.1, 0.2, 0.4), reference=0.1)
    scores: list[list[float]] = [[-5.0, -4.0, -6.0], [-5.0, -4.5, -6.0], [-5.0, -7.0, -4.0]]
    rows: list[dict[str, Any]] = [
        {"clip": str(index), "scores": own} for index, own in enumerate(scores)
    ]
    *clips, mean, error = script.table_of(rows, config).rows
    assert clips[0] == ["0", 0.0, 1.0, -1.0, 0.2, 0.1, -1.0, 0.0]  # the others': -10, -11.5, -10
    assert clips[2] == ["2", 0.0, -2.0, 1.0, 0.4, 0.2, -3.0, -2.0]
    assert mean[2] == pytest.approx(-0.5 / 3)
    assert error[2] == pytest.approx(np.std([1.0, 0.5, -2.0], ddof=1) / 3**0.5)


@pytest.mark.parametrize(
    ("given", "said"),
    [({"reference": 0.7}, "not one of --powers"), ({}, "no clip in it")],
)
def test_wrong_options_are_refused(
    script: ModuleType, tmp_path: Path, given: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigurationError, match=said):
        script.main(script.Config(data=(tmp_path,), **given))
