"""From a video of any lens to straight pictures, with the camera and the keypoints that fit them.

Cameras are pinholes with Brown's five coefficients. Where a lens is another one (a fisheye lens, or
OpenCV's model of eight and more coefficients), `undistort_video` writes what is tracked instead:

| file | content |
|---|---|
| `NAME.mp4` | the straight pictures, of the same size; black where the lens saw nothing |
| `cameras.json` | their camera |
| `NAME.npz` | the keypoints of the person who is followed, if there are any |
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from torchcss.app.view_files import FrameSelection, open_view
from torchcss.errors import CameraError
from torchcss.files import prepare_output_folder, save_arrays, write_text
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
    prepare_output_folder(out)
    video = out / f"{files.video.stem}.mp4"
    if video.resolve() == files.video.resolve():
        raise CameraError(f"{out}: the folder of the video itself; name another one with --out")
    source = lens.source_pixels(size, K)
    with VideoWriter(video, reader.info.frame_rate, crf=_CRF) as film:
        for frame in tqdm(reader, "straight", reader.num_selected, unit="frame", file=sys.stderr):
            shown = frame.time_s if reader.varies else None
            film.write(straight_image(frame.image, source), shown)
    notes = [loaded.units_note, reader.varying_rate()]
    written: dict[str, Any] = calibration((straight, video))
    if not loaded.metric:
        for entry in written["cameras"].values():
            entry |= {"R": None, "t": None}
    write_text(out / "cameras.json", json.dumps(written, indent=1) + "\n")
    paths = [video, out / "cameras.json"]
    if keypoints is not None:
        arrays, left_out = _straight_keypoints(keypoints, lens.straight_pixels, K)
        paths.append(out / f"{files.video.stem}.npz")
        save_arrays(paths[-1], {**arrays, "image_size_wh": size})
        notes += [*keypoints.report, left_out]
    return paths, [note for note in notes if note]


def _straight_keypoints(
    keypoints: Keypoints, straightened: Any, K: np.ndarray
) -> tuple[dict[str, Any], str | None]:
    """The arrays of straight keypoints, and a line about those that no straight picture shows."""
    pixels, reached = straightened(keypoints.positions.numpy(), K)
    confidence = keypoints.confidence.numpy()
    lost = (confidence > 0) & ~reached
    arrays = {
        "keypoints": np.where(reached[..., None], pixels, 0.0),
        "confidence": np.where(reached, confidence, 0.0),
        "joint_names": list(keypoints.names),
        "relative_noise": keypoints.relative_noise,
    }
    line = f"{lost.sum()} keypoints are where the lens shows nothing: they are left out"
    return arrays, line if lost.any() else None
