"""evaluate_peers: landmarks are turned into the world, with a detector that knows the truth."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from torchcss import read_camera
from torchcss.studies.render.sequences import shot
from torchcss.studies.sequence_writer import write_sequence
from torchcss.studies.sequences import read_reference


def test_landmarks_are_turned_into_the_world(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clip = tmp_path / "clips" / "one"
    write_sequence(clip, shot("body-clutter", num_frames=3, small=True))
    camera = read_camera(clip / "cameras.json")
    true, names = read_reference(clip / "reference3d.npz")

    def detect(video: Path, out: Path, options: Any, **more: Any) -> Path:
        places = torch.from_numpy(true).double()
        points = places @ camera.R_camera_world.double().T
        confidence = np.ones((3, 1, len(names)))
        confidence[1] = 0.0  # nobody is found in this frame
        np.savez(
            out,
            keypoints=camera.double().project(places).uv[:, None],
            points=1.1 * (points - points.mean(1, keepdim=True))[:, None],
            confidence=confidence,
            joint_names=names,
        )
        return out

    monkeypatch.setattr(script, "detect_video", detect)
    config = script.Config(data=clip, detector_model=Path("model"), out=tmp_path / "J.json")
    ((name, frames, found, pa, root, *ours),) = script.main(config)["rows"]
    assert (name, frames, found) == ("one", 3, 2)
    assert pa < 1e-6  # the scale is taken out
    assert 10 < root < 100
    assert ours == [None] * 4
    written = json.loads((tmp_path / "J.json").read_text())
    assert [cells[0] for cells in written["table"]["rows"]] == ["one", "median", "mean"]
