"""degrade_clips: worse copies of a clip that fit what they hold."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from torchcss.errors import ConfigurationError
from torchcss.io.cameras import read_camera
from torchcss.io.video import VideoReader
from torchcss.studies.render.sequences import shot
from torchcss.studies.sequence_writer import write_sequence


def test_copies_fit_what_they_hold(script: ModuleType, tmp_path: Path) -> None:
    clip = write_sequence(tmp_path / "clip", shot("body-dark", seed=0, num_frames=6, small=True))
    made = script.main(script.Config(clips=(clip,), out=tmp_path))
    assert [path.name for path in made] == [f"clip-{kind}" for kind in script.KINDS]
    keypoints, films = {}, {}
    for folder in (clip, *made):
        video = VideoReader(folder / "video.mp4")
        camera = read_camera(folder / "cameras.json", video=folder / "video.mp4")
        assert camera.image_size_wh == (video.info.width, video.info.height)
        films[folder.name] = [frame.image for frame in video]
        with np.load(folder / "keypoints2d.npz") as file:
            keypoints[folder.name] = file["keypoints"], file["confidence"]
        with np.load(folder / "reference3d.npz") as reference:
            assert len(reference["joints"]) == len(films[folder.name])
        assert len(keypoints[folder.name][0]) == len(films[folder.name])
    points, confidence = keypoints["clip"]
    assert (keypoints["clip-gap"][1][2:4] == 0).all()
    assert np.array_equal(keypoints["clip-gap"][1][4:], confidence[4:])
    assert np.array_equal(keypoints["clip-third"][0], points[::3], equal_nan=True)
    swapped = keypoints["clip-swap"][0]
    assert not np.array_equal(swapped[1], points[1], equal_nan=True)
    assert np.array_equal(np.sort(swapped[1, :, 0]), np.sort(points[1, :, 0]))
    assert 0 < (keypoints["clip-outliers"][0] != points).any(-1).mean() < 0.4
    assert np.ptp(films["clip-grey"][0].astype(int), axis=-1).max() < 12


def test_unknown_kinds_are_refused(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="--kinds"):
        script.chosen(["blurred"])
