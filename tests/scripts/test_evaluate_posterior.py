"""evaluate_posterior: rows over clips, and what a mixture says of the truth."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from torchcss.errors import ConfigurationError
from torchcss.studies.render.sequences import shot
from torchcss.studies.sequence_writer import write_sequence


def test_a_clip_is_tracked_and_measured(script: ModuleType, tmp_path: Path) -> None:
    write_sequence(tmp_path / "clips" / "one", shot("body-clutter", num_frames=3, small=True))
    config = script.Config(
        data=tmp_path / "clips",
        out=tmp_path / "J.json",
        runs=tmp_path / "runs",
        tracking=replace(script.TRACKING, samples=10, modes=2),
    )
    (row,) = script.main(config)["rows"]
    assert row["best PA"] <= row["PA"] < 400
    assert row["best root"] <= row["root"]
    assert row["lag PA"] == pytest.approx(row["smooth PA"], abs=1)  # three frames are within it
    assert 0 < row["lag root"] < 400
    assert 1 <= row["rank"] <= 2
    assert 0 <= row["cal."] <= 1
    assert row["cal."] == script.miss(row["inside"])
    assert math.isfinite(row["NLL"])
    written = json.loads((tmp_path / "J.json").read_text())
    assert [cells[0] for cells in written["table"]["rows"]] == [
        "one",
        "median",
        "mean",
        "all together",
    ]
    # A run that is there is not made again.
    again = script.main(config)["rows"][0]
    assert again == {**row, "s": None}


def test_density_and_rank(script: ModuleType) -> None:
    offset = torch.zeros(2, 3, 4, 3, dtype=torch.float64)
    offset[:, 0, :, 0] = 1.0
    offset[1, 1, :, 0] = 3.0
    covariance = 0.25 * torch.eye(3).double().expand(2, 3, 4, 3, 3)
    log_weight = torch.tensor([[0.5, 0.5, 0.0]] * 2).double().log()
    apart = script.Apart(offset, covariance, log_weight)
    assert apart.rank == 1.5  # the second mode in one frame, the first in the other
    height = -1.5 * math.log(2 * math.pi * 0.25)
    first = math.log(0.5 + 0.5 * math.exp(-2.0))
    second = math.log(0.5 * math.exp(-2.0) + 0.5 * math.exp(-18.0))
    assert apart.nll == pytest.approx(-height - 0.5 * (first + second))


@pytest.mark.parametrize(
    ("given", "said"),
    [({"seeds": 0}, "at least 1"), ({}, "no clip in it")],
)  # fmt: skip
def test_wrong_options_are_refused(
    script: ModuleType, tmp_path: Path, given: dict[str, object], said: str
) -> None:
    with pytest.raises(ConfigurationError, match=said):
        script.main(script.Config(data=tmp_path, **given))
