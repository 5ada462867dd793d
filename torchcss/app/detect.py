"""From a video to its 2D keypoints: everybody in every frame, as one file.

`detect_video` is what `torchcss detect` calls, and `torchcss track` where no keypoints are given.
It writes `keypoints [T P J 2]`, `confidence [T P J]`, `joint_names [J]`, `person_ids [P]`,
`image_size_wh` and `relative_noise`, which `torchcss.io.keypoints` reads.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from torchcss.errors import KeypointError
from torchcss.files import prepare_output_folder, save_arrays
from torchcss.io.detect import Detector, DetectorName, open_detector
from torchcss.io.keypoints.one_person import identified
from torchcss.io.video import VideoReader
from torchcss.joint_names import ALIASES


@dataclass(frozen=True, kw_only=True)
class DetectOptions:
    """What finds the keypoints.

    Attributes:
        detector: mediapipe (33 landmarks, `pip install "torchcss[detect]"`), or rtmlib (17 joints).
        detector_model: The file of its networks; by default the one that
            `torchcss detect --download-model` fetched.
    """

    detector: DetectorName = "mediapipe"
    detector_model: Path | None = None


def detect_video(
    video: Path,
    out: Path,
    options: DetectOptions | None = None,
    *,
    frame_rate: float | None = None,
    detector: Detector | None = None,
) -> Path:
    """Find everybody in every frame of a video, and write their keypoints.

    Args:
        video: A video, or a folder of images.
        out: The file, `.npz`.
        options: What finds them.
        frame_rate: Frames per second of a folder of images; None: 30.
        detector: A detector that is loaded already.

    Returns:
        The file.

    Raises:
        TorchcssError: If the video or the detector cannot be read, or nobody is found.
    """
    options = options or DetectOptions()
    reader = VideoReader(video, image_frame_rate=frame_rate)
    prepare_output_folder(out.parent)
    if detector is None:
        tqdm.write("loading the detector ...", file=sys.stderr)
        detector = open_detector(options.detector, options.detector_model)
    try:
        count = reader.num_selected
        frames = [
            detector.detect(frame) for frame in tqdm(reader, "detecting", count, unit="frame")
        ]
    finally:
        detector.close()
    if not any(len(people) for people in frames):
        raise KeypointError(
            f"{video}: nobody found in {len(frames)} frames; the detector needs most of a person "
            "in the picture: mark the joints of one frame (torchcss init --click), or give "
            "keypoints of another detector with --keypoints"
        )
    size = (reader.info.width, reader.info.height)
    write_people(out, frames, detector, size)
    return out


def write_people(
    out: Path, frames: Sequence[np.ndarray], detector: Detector, image_size_wh: tuple[int, int]
) -> None:
    """Write who is where in every frame, every person under one number; joints that bodies have.

    Args:
        out: The file.
        frames: The people of every frame, `[p j 3]`.
        detector: What found them.
        image_size_wh: Size of the images.
    """
    ids = identified(list(frames))
    count = 1 + max((number for people in ids for number in people), default=0)
    names = {name: column for column, name in enumerate(ALIASES[detector.layout]) if name}
    joints = np.tile((np.nan, np.nan, 0.0), (len(frames), count, len(names), 1))
    for index, (people, numbers) in enumerate(zip(frames, ids, strict=True)):
        joints[index, numbers] = people[:, list(names.values())]
    save_arrays(
        out,
        {
            "keypoints": joints[..., :2],
            "confidence": joints[..., 2],
            "joint_names": list(names),
            "person_ids": np.arange(count),
            "image_size_wh": image_size_wh,
            "relative_noise": detector.relative_noise,
        },
    )
