"""Good files of a tiny clip, the command that tracks it, and films of any images."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest

from torchcss.cli import main as cli
from torchcss.io.video import VideoWriter


def write_film(path: Path, images: Iterable[np.ndarray], rate: float = 25) -> Path:
    """Write a film of images."""
    with VideoWriter(path, rate) as film:
        for image in images:
            film.write(image)
    return path


def grey_film(path: Path, levels: Sequence[int], size_wh: tuple[int, int] = (64, 48)) -> Path:
    """Write a film whose frames are uniform grey, one for each level."""
    width, height = size_wh
    return write_film(path, (np.full((height, width, 3), level, np.uint8) for level in levels))


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """Good files of a tiny clip, for each test to spoil one of."""
    grey_film(tmp_path / "video.mp4", (10, 20, 30))
    camera = {
        "image_size_wh": [64, 48],
        "K": [[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]],
        "R": np.eye(3).tolist(),
        "t": [0, 0, 0],
        "video": "video.mp4",
    }
    (tmp_path / "cameras.json").write_text(
        json.dumps({"units": "metre, pixel", "cameras": {"one": camera}})
    )
    names = ["r_shoulder", "r_elbow", "r_wrist", "r_hand_tip"]
    points = np.tile(np.array([[40.0, 10], [30, 20], [22, 30], [20, 36]]), (3, 1, 1))
    np.savez(
        tmp_path / "keypoints.npz",
        keypoints=points,
        confidence=np.ones((3, 4)),
        joint_names=np.array(names),
    )
    return tmp_path


def track(files: Path, *more: str) -> int:
    return cli.main(
        [
            "track", str(files / "video.mp4"), "--camera", str(files / "cameras.json"),
            "--keypoints", str(files / "keypoints.npz"), "--body", "arm7", "--samples", "3",
            "--modes", "2", "--out", str(files / "out"), *more,
        ]
    )  # fmt: skip
