"""Write a rendered sequence as a folder that `torchcss.studies.sequences` reads.

| file | content |
|---|---|
| `video.mp4` | the frames |
| `cameras.json` | the camera `cam01`, metres, world-to-camera |
| `keypoints2d.npz` | `keypoints [T J 2]`, projections with Gaussian noise of `noise_px`; |
| | `keypoints_exact`, `confidence`, `visible`, `in_image`, `joint_names`, `frame_rate` |
| `reference3d.npz` | `joints [T J 3]`, metres, exact; `joint_names`, `frame_rate`, `time_s` |
| `mask.npz` | `mask [T H W]` |
| `truth.npz` | `body`, `lengths` (JSON, metres), `base_transform [4 4]`, `state_names [n]`, |
| | `states [T n]`, `frame_rate`, `seed`, `description` |
| `flow.npz` | `flow [T-1 H W 2]`, float16, pixels from frame i to i + 1; `occluded [T-1 H W]` |

`write_sequence(folder, shot)` renders while it writes: a long film never is in memory as a whole.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchcss.files import StrPath, prepare_output_folder, replace_file, save_arrays, write_text
from torchcss.io.cameras import camera_entry
from torchcss.io.video import VideoWriter
from torchcss.studies.render.motions import Motion
from torchcss.studies.render.sequences import SequenceFrame, Shot
from torchcss.vision.camera import Camera

_HIDDEN_CONFIDENCE = 0.3
"""What a detector says of a joint that it cannot see."""


def write_sequence(
    folder: StrPath, shot: Shot, *, noise_px: float = 2.0, progress: bool = False
) -> Path:
    """Render a shot into a folder.

    Args:
        folder: The folder; made if missing, files in it are replaced.
        shot: What to render.
        noise_px: Standard deviation of the 2D joints' noise.
        progress: Whether to show a bar.

    Returns:
        The folder.

    Raises:
        OutputError: If the folder cannot be written.
    """
    folder = prepare_output_folder(folder)
    frames: Iterable[SequenceFrame] = shot.frames()
    if progress:
        frames = tqdm(frames, total=len(shot.states), desc=shot.name, unit="frame")
    joints = _write_frames(folder, shot, frames)
    _write_joints(folder, shot, joints, noise_px)
    write_camera(folder / "cameras.json", shot.camera)
    motion = Motion(shot.body, shot.states, shot.frame_rate, shot.description)
    write_motion(folder / "truth.npz", motion, {"seed": shot.seed})
    return folder


def _write_frames(folder: Path, shot: Shot, frames: Iterable[SequenceFrame]) -> list[Tensor]:
    """Write film, flow and masks as the frames are rendered.

    Returns the joints of all frames: in space, in the image, whether visible, whether inside it.
    """
    width, height = shot.camera.image_size_wh
    count = len(shot.states)
    mask = np.zeros((count, height, width), bool)
    occluded = np.zeros((count - 1, height, width), bool)
    joints: list[tuple[Tensor, ...]] = []
    with (
        VideoWriter(folder / "video.mp4", shot.frame_rate, crf=14) as film,
        replace_file(folder / "flow.npz") as partial,
        zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        with archive.open("flow.npy", "w", force_zip64=True) as stream:
            # Frame by frame: all of them are half a gigabyte for eight seconds.
            shape = (count - 1, height, width, 2)
            header = {"descr": "<f2", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(stream, header)
            for index, frame in enumerate(frames):
                film.write(frame.image.numpy())
                mask[index] = frame.mask.numpy()
                if frame.flow is not None and frame.occluded is not None:
                    stream.write(frame.flow.numpy().astype("<f2").tobytes())
                    occluded[index] = frame.occluded.numpy()
                joints.append((frame.joints, frame.uv, frame.visible, frame.in_image))
        with archive.open("occluded.npy", "w", force_zip64=True) as stream:
            np.lib.format.write_array(stream, occluded, allow_pickle=False)
    save_arrays(folder / "mask.npz", {"mask": mask}, compressed=True)
    return [torch.stack(part) for part in zip(*joints, strict=True)]


def _write_joints(folder: Path, shot: Shot, joints: list[Tensor], noise_px: float) -> None:
    places, exact, seen, inside = joints
    # Its own generator: the noise of the keypoints does not depend on how the picture was made.
    generator = torch.Generator().manual_seed(shot.seed + 1)
    noise = torch.randn(exact.shape, generator=generator, dtype=exact.dtype)
    save_arrays(
        folder / "keypoints2d.npz",
        {
            "keypoints": exact + noise_px * noise,
            "keypoints_exact": exact,
            "confidence": np.where(seen, 1.0, _HIDDEN_CONFIDENCE),
            "visible": seen,
            "in_image": inside,
            "joint_names": shot.body.joint_names,
            "frame_rate": shot.frame_rate,
            "noise_px": noise_px,
        },
    )
    save_arrays(
        folder / "reference3d.npz",
        {
            "joints": places,
            "joint_names": shot.body.joint_names,
            "camera_names": [shot.camera.name],
            "frame_rate": shot.frame_rate,
            "time_s": np.arange(len(places)) / shot.frame_rate,
            "units": "m",
            "deviation_m": 0.0,
        },
    )


def write_camera(path: Path, camera: Camera) -> None:
    """Write the camera of `video.mp4`."""
    entry = {
        "video": "video.mp4",
        **camera_entry(camera),
        "centre_world": camera.centre_world.tolist(),
    }
    content = {
        "convention": "world to camera: X_cam = R X_world + t; OpenCV axes (x right, y down, "
        "z forward); pixel (0, 0) is the centre of the top-left pixel",
        "world": "right-handed, Y up, metres",
        "units": "metre, pixel",
        "cameras": {camera.name: entry},
    }
    write_text(path, json.dumps(content, indent=1))


def write_motion(path: Path, motion: Motion, more: Mapping[str, Any]) -> None:
    """Write a motion file, see `torchcss.studies.sequences`, with some more arrays."""
    body = motion.body
    known = {
        "body": body.name,
        "lengths": json.dumps(body.lengths),
        "base_transform": body.base_transform.double(),
        "state_names": body.state_names,
        "states": motion.states,
        "frame_rate": motion.frame_rate,
        "description": motion.description,
    }
    save_arrays(path, {**known, **more})
