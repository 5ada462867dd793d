"""evaluate_sides: legs that change places are put back, those that do not stay."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from torchcss.errors import ConfigurationError


def test_motions_are_filmed_and_mended(script: ModuleType, shared_data: Path) -> None:
    report = script.main(script.Config(motions=shared_data / "mocap_cmu", rates=(30.0, 5.0)))
    (rate, frames, spoilt, exchanged, back), (slow, *_) = report["rows"]
    assert (rate, slow) == (30.0, 5.0)
    assert spoilt <= 0.005 * frames
    assert exchanged > 10
    assert back > 80


def test_without_motions(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="no motion"):
        script.main(script.Config(motions=tmp_path))
