"""landmark_offsets: offsets that keypoints were given are found again."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from torchcss import read_camera
from torchcss.studies.render.sequences import shot
from torchcss.studies.sequence_writer import write_sequence
from torchcss.studies.sequences import read_reference

GIVEN = {
    "hip": (20, 30, -10),
    "shoulder": (-15, 0, 5),
    "knee": (0, 25, 0),
    "wrist": (5, -12, 8),
    "toe": (4, 0, -20),
    "nose": (3, 10, 9),
}  # fmt: skip


def test_offsets_are_found_again(script: ModuleType, tmp_path: Path) -> None:
    clip = tmp_path / "one"
    write_sequence(clip, shot("body-clutter", num_frames=24, small=True))
    camera = read_camera(clip / "cameras.json")
    places, names = read_reference(clip / "reference3d.npz")
    joints = dict(zip(names, np.moveaxis(places, 1, 0), strict=True))
    moved = places.copy()
    for column, name in enumerate(names):
        kind = name[2:] if name[:2] in ("l_", "r_") else name
        if kind in GIVEN:
            outwards = np.array([-1 if name.startswith("r_") else 1, 1, 1])
            moved[:, column] += script.axes(joints, name) @ (
                1e-3 * np.array(GIVEN[kind]) * outwards
            )
    arrays = dict(np.load(clip / "keypoints2d.npz"))
    arrays["keypoints"] = camera.project(torch.from_numpy(moved)).uv.numpy()
    arrays["confidence"] = np.ones(places.shape[:2])
    np.savez(clip / "keypoints2d.npz", **arrays)

    report = script.main(script.Config(data=clip, out=tmp_path / "J.json"))
    found = {joint: (place, before, after) for joint, _, *place, _, before, after in report["rows"]}
    for joint, (place, before, after) in found.items():
        given = GIVEN.get(joint, (0, 0, 0))
        # One camera sees an offset along its line of sight only as limbs and trunk turn.
        assert place == pytest.approx(given, abs=2.0), joint
        assert after <= before + 0.1
        assert after < 1.0
    assert GIVEN.keys() <= found.keys()
