"""make_clips: clips of captured motions that do not depend on how many are made."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from torchcss.errors import ConfigurationError
from torchcss.studies.sequences import read_sequence


def test_clips_are_the_same_however_many_are_made(
    script: ModuleType, shared_data: Path, tmp_path: Path
) -> None:
    motions = shared_data / "mocap_cmu_large"
    if not motions.exists():
        pytest.skip("without the motions")

    def make(name: str, first: int, num: int) -> list[dict[str, object]]:
        return script.main(
            script.Config(
                motions=motions, out=tmp_path / name, first=first, num=num, seconds=0.1, small=True
            )
        )

    both, second = make("both", 0, 2), make("second", 1, 1)
    assert both[1:] == second
    assert both[0] != {**both[1], "clip": "clip000"}
    assert json.loads((tmp_path / "both" / "clips.json").read_text())["clips"] == both
    for name in ("keypoints2d.npz", "reference3d.npz", "truth.npz"):
        one, other = (np.load(tmp_path / way / "clip001" / name) for way in ("both", "second"))
        assert all(np.array_equal(one[key], other[key]) for key in one)
    sequence = read_sequence(tmp_path / "both" / "clip000")
    assert sequence.num_frames == 3
    # The camera sees all of the person.
    marks = np.load(tmp_path / "both" / "clip000" / "keypoints2d.npz")
    assert marks["in_image"].all()


def test_marks_err_as_the_options_say(script: ModuleType) -> None:
    config = script.Config(motions=Path(), out=Path())
    hidden = torch.zeros(400, 300, dtype=torch.bool)
    hidden[:, 150:] = True
    noise = script.detector_noise(config, hidden, generator=torch.Generator().manual_seed(0))
    seen, unseen = noise[:, :150], noise[:, 150:]
    assert float(seen.mean(0).std()) == pytest.approx(config.offset, rel=0.1)
    within = seen - seen.mean(0)
    assert float(within.std()) == pytest.approx(config.jitter, rel=0.05)
    correlation = (within[1:] * within[:-1]).mean() / within.square().mean()
    assert float(correlation) == pytest.approx(config.persistence, abs=0.03)
    assert float(unseen.std() / seen.std()) == pytest.approx(config.hidden, rel=0.1)


def test_no_motion_is_refused(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no motion of subjects 05, 14"):
        script.main(script.Config(motions=tmp_path, out=tmp_path / "out"))
