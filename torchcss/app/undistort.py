"""From a video of any lens to straight pictures, with the camera and the keypoints that fit them.

Cameras are pinholes with Brown's five coefficients. Where a lens is another one (a fisheye lens, or
OpenCV's model of eight and more coefficients), `undistort_video` writes what is tracked instead:

| file | content |
|---|---|
| `NAME.mp4` | the straight pictures, of the same size; black where the lens saw nothing |
| `cameras.json` | their camera |
| `NAME.npz` | the keypoints of the person who is followed, if there are any |
| `NAME_masks.mp4` | their masks |

Of several cameras each is made straight by itself, into one folder: its `cameras.json` then holds
them all.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from torchcss.app.view_files import FrameSelection, open_view
from torchcss.errors import CameraError
from torchcss.files import load_json, prepare_output_folder, save_arrays, write_text
from torchcss.io.cameras import calibration, check_image_size, load_lens
from torchcss.io.lenses import straight_image
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.io.view_files import ViewFiles
from torchcss.types import Keypoints

_CRF = 12
"""Of what is encoded a second time no more should be lost than the eye sees."""


def undistort_video(
    files: ViewFiles, camera: Path, out: Path, *, fov: float | None = None, start: int = 0
) -> tuple[list[Path], list[str]]:
    """Write a video, its camera and its keypoints as if there had been no lens.

    Args:
        files: The video, and what belongs to it.
        camera: The calibration file.
        out: The folder.
        fov: Degrees that the straight pictures show from left to right; None: what the middles of
            the borders show, at most 110.
        start: The frame in which the person is chosen.

    Returns:
        The files, and what was assumed.

    Raises:
        TorchcssError: If a file cannot be read, or does not fit the others.
    """
    loaded, lens = load_lens(camera, files.camera_name, video=files.video, fov=fov)
    straight = loaded.camera
    reader = VideoReader(files.video, image_frame_rate=files.frame_rate)
    reader.check_sizes()
    check_image_size(straight, reader.info.width, reader.info.height)
    size, K = straight.image_size_wh, straight.K.numpy()
    # Everything is read before the long work.
    keypoints = None
    if files.keypoints is not None:
        keypoints = open_view(files, loaded, FrameSelection(start=start)).keypoints
    masks = open_view(replace(files, keypoints=None), loaded).masks
    prepare_output_folder(out)
    video = out / f"{files.video.stem}.mp4"
    if video.resolve() == files.video.resolve():
        raise CameraError(f"{out}: the folder of the video itself; name another one with --out")
    written: dict[str, Any] = calibration((straight, video))
    if not loaded.metric:
        for entry in written["cameras"].values():
            entry |= {"R": None, "t": None}
    cameras = out / "cameras.json"
    written["cameras"] = {**_others(cameras, straight.name, video.name), **written["cameras"]}
    source = lens.source_pixels(size, K)
    _write_straight(reader, video, source, reader)
    paths = [video, cameras]
    if masks is not None:
        paths.append(out / f"{files.video.stem}_masks.mp4")
        _write_straight(masks, paths[-1], source, reader)
    write_text(cameras, json.dumps(written, indent=1) + "\n")
    notes = [loaded.units_note, reader.varying_rate()]
    if keypoints is not None:
        arrays, left_out = _straight_keypoints(keypoints, lens.straight_pixels, K)
        paths.append(out / f"{files.video.stem}.npz")
        save_arrays(paths[-1], {**arrays, "image_size_wh": size})
        notes += [*keypoints.report, left_out]
    return paths, [note for note in notes if note]


def _write_straight(
    reader: VideoReader, path: Path, source: Float[np.ndarray, "h w 2"], film: VideoReader
) -> None:
    """Write straight pictures of a reader, shown when those of the film are."""
    height, width = source.shape[:2]
    times = film.frame_times() if film.varies else None
    with VideoWriter(path, film.info.frame_rate, crf=_CRF) as writer:
        for frame in tqdm(reader, "straight", reader.num_selected, unit="frame", file=sys.stderr):
            shown = None if times is None or frame.index >= len(times) else times[frame.index]
            # Masks of odd sizes are a row or column larger.
            writer.write(straight_image(frame.image[:height, :width], source), shown)


def _others(path: Path, name: str, video: str) -> dict[str, Any]:
    """The cameras that were made straight into a folder before this one."""
    if not path.exists():
        return {}
    content = load_json(path, CameraError)
    known = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(known, dict) or not all(isinstance(each, dict) for each in known.values()):
        raise CameraError(f"{path}: is there and not of torchcss undistort; name another --out")
    others = {each: entry for each, entry in known.items() if each != name}
    if same := [each for each, entry in others.items() if entry.get("video") == video]:
        raise CameraError(
            f"{path}: {video} is camera {same[0]!r} there; give the videos names of their own, "
            "or name another --out"
        )
    return others


def _straight_keypoints(
    keypoints: Keypoints, straightened: Any, K: np.ndarray
) -> tuple[dict[str, Any], str | None]:
    """The arrays of straight keypoints, and a line about those that no straight picture shows."""
    pixels, reached = straightened(keypoints.positions.numpy(), K)
    confidence = keypoints.confidence.numpy()
    lost = keypoints.known.numpy() & ~reached
    arrays = {
        "keypoints": np.where(reached[..., None], pixels, 0.0),
        "confidence": np.where(reached, confidence, 0.0),
        "joint_names": list(keypoints.names),
        "relative_noise": keypoints.relative_noise,
    }
    line = f"{lost.sum()} keypoints are where the lens shows nothing: they are left out"
    return arrays, line if lost.any() else None
