"""spectra: two frames of an arm, and the numbers of a covariance that is known."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from made_sequences import write_arm

from torchcss.body.load import load_body


def test_two_frames(script: ModuleType, tmp_path: Path) -> None:
    write_arm(tmp_path / "arm", 2)
    out = tmp_path / "J.json"
    tracking = replace(script.TRACKING, samples=4, modes=2, working_size=160)
    config = script.Config(
        sequences=(tmp_path / "arm",), frames=2, seeds=1, poses=1, tracking=tracking, out=out
    )
    report = script.main(config)
    (run,) = report["by_sequence"]["arm"]
    assert run["body"] == "arm8"
    assert len(run["ratio_by_frame"]) == 2
    assert run["ratio"] > 1
    assert 0 <= run["floored"] <= 1
    assert json.loads(out.read_text())["table"]["rows"][0][1] == run["ratio"]
    for body, size in (("arm8", 8), ("body32", 32)):  # as in Fig. 5
        (pose,) = report["by_sequence"][f"joints of {body}"]
        assert load_body(pose["body"]).num_parameters == size
        assert pose["ratio"] > 100
        assert pose["volume"] < size * math.log10(pose["ratio"])


def test_a_known_covariance(script: ModuleType, generator: torch.Generator) -> None:
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    covariance = torch.zeros(4, 4, dtype=torch.float64)
    covariance[1:, 1:] = turn @ torch.diag(torch.tensor([4.0, 0.04, 0.0004]).double()) @ turn.T
    found = script.spread_of(covariance)  # the first parameter is held
    assert found.ratio == pytest.approx(100)
    assert found.volume == pytest.approx(1 + 2)
