"""Sequence folders as other programs write them: the demo's arm in a few frames."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from made_clip import write_film

from torchcss.io.cameras import calibration, camera_entry
from torchcss.studies.evaluation import silhouette
from torchcss.studies.render.sequences import SyntheticSequence, arm_sequence

NOISE_PX = 1.5


def rendered_arm(seed: int, num_frames: int) -> SyntheticSequence:
    """The demo's arm, of which a shorter film is the beginning of a longer one."""
    length = 4 * math.ceil(num_frames / 4)
    whole = _whole_arm(seed, length)
    return replace(whole, frames=whole.frames[:num_frames], states=whole.states[:num_frames])


@lru_cache(maxsize=8)
def _whole_arm(seed: int, num_frames: int) -> SyntheticSequence:
    """Rendering takes a second: tests of one process share what is the same."""
    return arm_sequence(generator=torch.Generator().manual_seed(seed), num_frames=num_frames)


def write_clip(folder: Path, made: SyntheticSequence) -> Path:
    """Write a video, its camera and exact keypoints, without noise."""
    write_film(folder / "video.mp4", made.frames, made.frame_rate)
    known = calibration((made.camera, "video.mp4"))
    (folder / "cameras.json").write_text(json.dumps(known))
    uv = made.camera.project(made.joints_world).uv.numpy()
    np.savez(
        folder / "keypoints.npz", keypoints=uv, confidence=np.ones(uv.shape[:2]),
        joint_names=np.array(made.body.joint_names),
    )  # fmt: skip
    return folder


def write_arm(folder: Path, num_frames: int) -> SyntheticSequence:
    """Render the demo's arm and write everything that a folder may hold."""
    made, generator = rendered_arm(0, num_frames), torch.Generator().manual_seed(0)
    folder.mkdir(parents=True, exist_ok=True)
    write_film(folder / "video.mp4", made.frames, made.frame_rate)
    camera, body = made.camera, made.body
    entry = {"video": "video.mp4", **camera_entry(camera)}
    known = {"units": "metre, pixel", "cameras": {"cam01": entry}}
    (folder / "cameras.json").write_text(json.dumps(known))
    joints = made.joints_world
    exact = camera.project(joints).uv
    inside = camera.inside_image(exact).numpy()
    noise = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
    names = np.array(body.joint_names)
    np.savez(
        folder / "keypoints2d.npz",
        keypoints=(exact + NOISE_PX * noise).numpy(), confidence=np.ones(inside.shape),
        in_image=inside, joint_names=names, noise_px=np.array(NOISE_PX),
    )  # fmt: skip
    np.savez(
        folder / "reference3d.npz", joints=joints.numpy(), joint_names=names, units=np.array("m")
    )
    np.savez(folder / "mask.npz", mask=np.stack([silhouette(body, x, camera) for x in made.states]))
    base = body.base_transform.numpy()
    np.savez(
        folder / "truth.npz",
        body=np.array(body.name), lengths=np.array(json.dumps(body.lengths)), base_transform=base,
        state_names=np.array(body.state_names), states=made.states.numpy(),
    )  # fmt: skip
    return made
