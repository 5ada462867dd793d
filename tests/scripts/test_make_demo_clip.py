"""The demo's clip: small, whole, and filmed by the script."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import torch

from torchcss.io.cameras import read_camera
from torchcss.io.keypoints.read import read_keypoints
from torchcss.io.video import VideoReader
from torchcss.studies.demo import CLIP, KEYPOINT_NOISE_PX
from torchcss.studies.sequences import read_reference


def check(folder: Path, num_frames: int) -> None:
    """Keypoints of the first frame are the truth's, as far as their noise goes."""
    reader = VideoReader(folder / "video.mp4")
    assert reader.count_frames() == num_frames
    camera = read_camera(folder / "cameras.json")
    joints, names = read_reference(folder / "reference3d.npz")
    assert joints.shape[0] == num_frames
    seen = read_keypoints(folder / "keypoints.npz", image_size_wh=camera.image_size_wh)
    assert list(seen.names) == names
    assert bool((seen.confidence[0] == 1).all())
    assert not bool(seen.confidence[1:].any())
    apart = camera.project(torch.from_numpy(joints[0])).uv - seen.positions[0]
    assert 0 < float(apart.square().mean().sqrt()) < 2 * KEYPOINT_NOISE_PX


def test_the_clip_in_the_package_is_small_and_whole() -> None:
    assert sum(path.stat().st_size for path in CLIP.iterdir()) < 1_000_000
    check(CLIP, 50)


def test_a_clip_is_written(tmp_path: Path, script: ModuleType) -> None:
    folder = script.main(script.Config(out=tmp_path / "clip", frames=2, seed=1))
    check(folder, 2)
    assert {path.name for path in folder.iterdir()} == {path.name for path in CLIP.iterdir()}
