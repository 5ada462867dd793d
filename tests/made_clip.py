"""Good files of a tiny clip, and the command that tracks it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from torchcss.cli import main as cli
from torchcss.io.video import VideoWriter


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """Good files of a tiny clip, for each test to spoil one of."""
    with VideoWriter(tmp_path / "video.mp4", 25) as film:
        for shade in (10, 20, 30):
            film.write(np.full((48, 64, 3), shade, dtype=np.uint8))
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
