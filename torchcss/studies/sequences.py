"""A folder with a video and all that is known of it: what trackers are compared on.

| file | content |
|---|---|
| `video.mp4` | the frames |
| `cameras.json` | its camera, in the metric world of the reference (`torchcss.io.cameras`) |
| `keypoints2d.npz` | 2D joints (`torchcss.io.keypoints.read`); maybe `in_image [T J]`, `noise_px` |
| `reference3d.npz` | `joints [T J 3]` in metres, NaN where unknown, and `joint_names [J]` |
| `mask.npz` | `mask [T H W]`, the silhouette; may be missing |
| `truth.npz` | the body that moved, if it was one of ours; may be missing |

`truth.npz` is a motion file: it holds `body` (its name), `state_names [n]` and `states [T n]`, and
maybe `lengths` (JSON, metres), `base_transform [4 4]` (world from the frame in which the root
moves), `frame_rate` and `description`.

A recording with several cameras has one video and one keypoint file per view: `cam01.mp4`,
`keypoints2d_cam01.npz`, `mask_cam01.npz`.

Call `read_sequence(folder)`, or `read_sequence(folder, view="cam01")`; `read_reference` and
`read_motion` read a reference or a motion alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float

from torchcss.body.load import load_body
from torchcss.errors import CameraError, KeypointError, TrackFileError, VideoError
from torchcss.files import StrPath, load_arrays, refusing
from torchcss.io.cameras import check_image_size, load_camera
from torchcss.io.keypoints.read import read_keypoints
from torchcss.io.video import VideoReader
from torchcss.joint_names import canonical_joint_name
from torchcss.studies.render.motions import Motion
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera


class RecordedSequence(NamedTuple):
    """A video and all that is known of it, float64 on the CPU.

    Attributes:
        name: The folder's name, with the view's if there is one.
        video: The video file.
        num_frames: Its number of frames.
        frame_rate: Frames per second.
        camera: The camera, in the world of the reference.
        keypoints: 2D joints; those that the file says are outside the image have confidence 0.
        keypoint_noise_px: Standard deviation of their noise, if the file says it.
        joint_names: The catalogue's names of the reference's joints, the file's own for a place
            that has none.
        joints_world: The reference, metres; NaN where unknown.
        mask: Silhouette in every frame, if known.
        truth: The body that moved, if it was one of ours.
    """

    name: str
    video: Path
    num_frames: int
    frame_rate: float
    camera: Camera
    keypoints: Keypoints
    keypoint_noise_px: float | None
    joint_names: tuple[str, ...]
    joints_world: Float[np.ndarray, "t j 3"]
    mask: Bool[np.ndarray, "t h w"] | None
    truth: Motion | None


def read_sequence(folder: StrPath, *, view: str | None = None) -> RecordedSequence:
    """Read a folder as described above.

    Args:
        folder: The folder.
        view: Which camera, where there are several.

    Raises:
        VideoError: If there is no such folder or video.
        CameraError: If the camera is missing, of another image size, or not in the metric world.
        KeypointError: If the 2D joints are missing or do not fit the video.
        TrackFileError: If reference, mask or truth are malformed or do not fit the video.
    """
    folder = Path(folder)
    suffix = "" if view is None else f"_{view}"
    video = folder / f"{view or 'video'}.mp4"
    if not video.is_file():
        raise VideoError(f"{video}: there is no such video; {_advice(folder)}")
    reader = VideoReader(video)
    size = (reader.info.width, reader.info.height)
    num_frames = reader.info.num_frames or reader.count_frames()
    loaded = load_camera(folder / "cameras.json", view, video=video)
    if loaded.units_note is not None:
        raise CameraError(
            f"{folder / 'cameras.json'}: {loaded.units_note}; a reference in 3D needs the camera "
            "in the reference's world, in metres"
        )
    check_image_size(loaded.camera, *size)
    keypoints, noise = _read_keypoints(folder / f"keypoints2d{suffix}.npz", size, num_frames)
    joints, names = read_reference(folder / "reference3d.npz", num_frames=num_frames)
    frame_rate = float(reader.info.frame_rate)
    mask_file, truth_file = folder / f"mask{suffix}.npz", folder / "truth.npz"
    return RecordedSequence(
        name=folder.resolve().name + ("" if view is None else f":{view}"),
        video=video,
        num_frames=num_frames,
        frame_rate=frame_rate,
        camera=loaded.camera,
        keypoints=keypoints,
        keypoint_noise_px=noise,
        joint_names=tuple(names),
        joints_world=joints,
        mask=_read_mask(mask_file, (num_frames, size[1], size[0])) if mask_file.exists() else None,
        truth=read_motion(truth_file, frame_rate=frame_rate, num_frames=num_frames)
        if truth_file.exists()
        else None,
    )


def _advice(folder: Path) -> str:
    """What is there instead of the video."""
    if not folder.is_dir():
        return f"{folder} is no folder"
    views = sorted(
        file.stem.removeprefix("keypoints2d_") for file in folder.glob("keypoints2d_*.npz")
    )
    if views:
        return f"the folder has the views {', '.join(views)}: choose one"
    return "expected a folder with video.mp4, cameras.json, keypoints2d.npz and reference3d.npz"


def _read_keypoints(
    path: Path, size: tuple[int, int], num_frames: int
) -> tuple[Keypoints, float | None]:
    keypoints = read_keypoints(path, image_size_wh=size, num_frames=num_frames)
    arrays = load_arrays(path, KeypointError)
    inside = arrays.get("in_image")
    if inside is not None:
        if inside.shape != tuple(keypoints.confidence.shape) or inside.dtype != bool:
            raise KeypointError(
                f"{path}: in_image: expected bool {list(keypoints.confidence.shape)}, "
                f"found {inside.dtype} {list(inside.shape)}"
            )
        seen = torch.from_numpy(inside)
        # No detector finds what is not in the picture.
        keypoints = keypoints._replace(
            positions=torch.where(seen[..., None], keypoints.positions, 0.0),
            confidence=torch.where(seen, keypoints.confidence, 0.0),
        )
    noise = arrays.get("noise_px")
    if noise is None:
        return keypoints, None
    if noise.shape != () or not noise > 0:
        raise KeypointError(f"{path}: noise_px: expected one positive number, found {noise}")
    return keypoints, float(noise)


def read_reference(
    path: StrPath, array: str = "joints", *, num_frames: int | None = None
) -> tuple[Float[np.ndarray, "t j 3"], list[str]]:
    """Read joints in space.

    Args:
        path: An NPZ file with `joints [T J 3]` in metres, NaN where unknown, and `joint_names`.
        array: Array of the file that holds the positions.
        num_frames: How many frames there must be; None: any number.

    Returns:
        The positions, metres, and the names that the catalogue has for the joints, the file's own
        for a place that has none.

    Raises:
        TrackFileError: If the file is missing or malformed.
    """
    path = Path(path)
    arrays = load_arrays(path, TrackFileError)
    if array not in arrays:
        raise TrackFileError(
            f"{path}: expected the array {array}, found {', '.join(arrays) or 'none'}; name the "
            "positions with array (--reference-array)"
        )
    _require(path, arrays, "joint_names")
    names = [common_name(str(name)) for name in arrays["joint_names"].reshape(-1)]
    joints = _array(path, arrays, array, (num_frames, len(names), 3))
    units = str(arrays.get("units", "m"))
    if units.lower() not in ("m", "metre", "metres", "meter", "meters"):
        raise TrackFileError(f"{path}: units: expected metres, got {units!r}; convert the file")
    return joints, names


def common_name(name: str) -> str:
    """The catalogue's name of a joint, or its own where the catalogue has none (robots)."""
    return canonical_joint_name(name) or name


def _read_mask(path: Path, shape: tuple[int, int, int]) -> np.ndarray:
    arrays = load_arrays(path, TrackFileError)
    _require(path, arrays, "mask")
    return _array(path, arrays, "mask", shape, numbers=False)


def read_motion(
    path: Path, *, frame_rate: float | None = None, num_frames: int | None = None
) -> Motion:
    """Read how one of our bodies moves.

    Args:
        path: A motion file, see above.
        frame_rate: States per second; None: as the file says.
        num_frames: How many states there must be; None: any number.

    Raises:
        TrackFileError: If an array is missing or does not fit the body.
    """
    arrays = load_arrays(path, TrackFileError)
    needed = ("body", "state_names", "states", *(("frame_rate",) if frame_rate is None else ()))
    _require(path, arrays, *needed)
    base = np.eye(4)
    if "base_transform" in arrays:
        base = _array(path, arrays, "base_transform", (4, 4))
    turn, place = torch.from_numpy(base[:3, :3]), torch.from_numpy(base[:3, 3])
    with refusing(TrackFileError, f"{path}: no motion of a body of ours"):
        lengths = json.loads(str(arrays.get("lengths", "{}")))
        lengths = {str(k): float(v) for k, v in lengths.items()}
        body = load_body(str(arrays["body"]), lengths=lengths).with_base(turn, place)
        rate = float(arrays["frame_rate"] if frame_rate is None else frame_rate)
    names = tuple(str(name) for name in arrays["state_names"].reshape(-1))
    if names != body.state_names:
        raise TrackFileError(
            f"{path}: state_names: expected those of {body.name}, {', '.join(body.state_names)}; "
            f"found {', '.join(names)}"
        )
    states = _array(path, arrays, "states", (num_frames, len(names)))
    if not (rate > 0 and len(states) and np.isfinite(states).all() and np.isfinite(base).all()):
        raise TrackFileError(
            f"{path}: states, base_transform: expected finite numbers and a positive frame_rate"
        )
    return Motion(body, torch.from_numpy(states), rate, str(arrays.get("description", "")))


def _require(path: Path, arrays: Mapping[str, np.ndarray], *names: str) -> None:
    missing = [name for name in names if name not in arrays]
    if missing:
        raise TrackFileError(
            f"{path}: expected the arrays {', '.join(names)}; {', '.join(missing)} missing, found "
            f"{', '.join(arrays) or 'none'}"
        )


def _array(
    path: Path,
    arrays: Mapping[str, np.ndarray],
    name: str,
    shape: tuple[int | None, ...],
    *,
    numbers: bool = True,
) -> np.ndarray:
    """The array, if it is of this shape (None: any), as float64; without numbers, truth values."""
    array = arrays[name]
    fits = len(array.shape) == len(shape) and all(
        size in (None, found) for size, found in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in ("fiu" if numbers else "b"):
        raise TrackFileError(
            f"{path}: {name}: expected {'numbers' if numbers else 'truth values'} of the shape "
            f"{[size or 'frames' for size in shape]}, for as many frames as the video has; found "
            f"{array.dtype} {list(array.shape)}"
        )
    return array.astype(np.float64) if numbers else array
