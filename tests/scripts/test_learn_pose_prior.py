"""learn_pose_prior: mixtures that tell poses from others, of people who were held out."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from torchcss.cost.pose_prior import FILE
from torchcss.errors import ConfigurationError


def test_it_learns_and_judges(script: ModuleType, shared_data: Path, tmp_path: Path) -> None:
    motions = shared_data / "mocap_cmu_large"
    if not motions.exists():
        pytest.skip("without the motions")
    some = tmp_path / "motions"
    some.mkdir()
    for name in ("02_01.bvh", "07_01.bvh", "14_04.bvh"):
        (some / name).symlink_to(motions / name)
    out, report = tmp_path / "prior.npz", tmp_path / "report.json"
    config = script.Config(data=some, out=out, report=report, small=True)
    found = script.main(config)
    rows = {name: numbers for name, *numbers in found["rows"]}
    assert list(rows) == ["mixtures", "Gaussians", "stabilisers", "uniform"]
    assert rows["mixtures"][1] > rows["uniform"][1]
    assert json.loads(report.read_text())["held_out"] == found["held_out"] > 0
    with np.load(out) as learnt, np.load(FILE) as shipped:
        assert set(learnt) == set(shipped)
        assert learnt["legs_mean"].shape == (2, 15)


def test_without_the_subjects_it_says_so(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="those held out"):
        script.main(script.Config(data=tmp_path))
