"""From a video to its 2D keypoints: everybody in every frame wanted, as one file.

`detect_video` is what `torchcss detect` calls, and `torchcss track` where no keypoints are given.
It writes `keypoints [T P J 2]`, `confidence [T P J]`, `joint_names [J]`, `person_ids [P]`,
`image_size_wh`, `relative_noise` and `frames_seen`, which `torchcss.io.keypoints` reads; of a
detector that says them `points [T P J 3]`, and the masks (`torchcss.io.keypoints.masks`).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from torchcss.errors import KeypointError, OutputError
from torchcss.files import load_arrays, prepare_output_folder, save_arrays
from torchcss.io.detect import Detected, Detector, DetectorName, open_detector
from torchcss.io.keypoints.masks import MASK_CELLS, masks_of, owner_of_cells
from torchcss.io.keypoints.one_person import colours_of, identified
from torchcss.io.video import VideoReader, VideoWriter
from torchcss.joint_names import ALIASES
from torchcss.types import frozen


@frozen
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
    start: int = 0,
    stop: int | None = None,
) -> Path:
    """Find everybody in the frames of a video, and write their keypoints.

    Args:
        video: A video, or a folder of images.
        out: The file, `.npz`; the masks are written beside it.
        options: What finds them.
        frame_rate: Frames per second of a folder of images; None: 30.
        detector: A detector that is loaded already.
        start: First frame given to the detector; nobody is known in those before.
        stop: Frame before which to end; nobody is known in those from there on.

    Returns:
        The file.

    Raises:
        TorchcssError: If the video or the detector cannot be read, nobody is found, or the file
            cannot be written.
    """
    if out.suffix != ".npz" or out.is_dir():
        raise OutputError(f"{out}: expected a file to write, of a name that ends in .npz")
    options = options or DetectOptions()
    reader = VideoReader(video, start=start, stop=stop, image_frame_rate=frame_rate)
    reader.check_sizes()
    prepare_output_folder(out.parent)
    if detector is None:
        tqdm.write("loading the detector ...", file=sys.stderr)
        detector = open_detector(options.detector, options.detector_model)
    try:
        frames, colours, owners = _detected(reader, detector, masks_of(out), start)
    finally:
        detector.close()
    if not any(len(found.joints) for found in frames):
        raise KeypointError(
            f"{video}: nobody found in {len(frames) - start} frames; the detector needs most of a "
            "person in the picture: mark the joints of one frame (torchcss init --click), or give "
            "keypoints of another detector with --keypoints"
        )
    size = (reader.info.width, reader.info.height)
    end = _TO_THE_END
    if stop is not None and len(frames) >= stop:
        end = stop
        # As many rows as the video has frames: whoever reads the file compares the two.
        more = (reader.info.num_frames or 0) - stop
        frames += [_nobody(frames[-1])] * more
        colours += [colours[-1][:0]] * more
        owners += [None] * more
    ids = identified([found.joints for found in frames], colours)
    write_people(out, frames, ids, detector, size, (start, end), owners)
    return out


_TO_THE_END = -1
"""End of the detector's frames where they are all up to the video's end."""


def is_detected(keypoints: Path, stop: int | None) -> bool:
    """Whether a file of keypoints was made from all frames before one.

    True for a file that `detect_video` has not written: there are no others to be had.

    Args:
        keypoints: The file.
        stop: The frame; None: the video's end.
    """
    try:
        _, end = load_arrays(keypoints, KeypointError)["frames_seen"].tolist()
    except (KeyError, ValueError, TypeError):  # a KeypointError is a ValueError
        return True
    return end == _TO_THE_END or (stop is not None and stop <= end)


def _detected(
    reader: VideoReader, detector: Detector, masks: Path, start: int
) -> tuple[list[Detected], list[np.ndarray], list[np.ndarray | None]]:
    """The people of every frame, their colours, and whose masks are where if they are several.

    Nobody is in frames before the start. Their masks go into a film.
    """
    found: list[Detected] = []
    colours: list[np.ndarray] = []
    owners: list[np.ndarray | None] = []
    names = [name or "" for name in ALIASES[detector.layout]]
    with VideoWriter(masks, reader.info.frame_rate) as film:
        for frame in tqdm(reader, "detecting", reader.num_selected, unit="frame"):
            seen = detector.detect(frame)
            before = 0 if found else start
            owners += [None] * (before + 1)
            if seen.masks is not None:
                anywhere = np.full_like(frame.image, 255)
                for _ in range(before):
                    film.write(anywhere)
                several = seen.masks.max(0, initial=0)[..., None].repeat(3, -1)
                film.write(several if len(seen.masks) else anywhere)
                owners[-1] = owner_of_cells(seen.masks)
            found += [*[_nobody(seen)] * before, seen._replace(masks=None)]
            colours += [
                colours_of(frame.image, each.joints, names) for each in found[len(colours) :]
            ]
    return found, colours, owners


def _nobody(like: Detected) -> Detected:
    """A frame in which nobody is found."""
    points = None if like.points is None else like.points[:0]
    return Detected(like.joints[:0], points)


def write_people(
    out: Path,
    frames: Sequence[Detected],
    ids: Sequence[Sequence[int]],
    detector: Detector,
    image_size_wh: tuple[int, int],
    seen: tuple[int, int],
    owners: Sequence[np.ndarray | None],
) -> None:
    """Write who is where in every frame, every person under one number; joints that bodies have.

    Args:
        out: The file.
        frames: The people of every frame.
        ids: Everybody's number in every frame.
        detector: What found them.
        image_size_wh: Size of the images.
        seen: First frame given to the detector, and the one after the last or `_TO_THE_END`.
        owners: Of every frame whose masks are where, `owner_of_cells`.
    """
    count = 1 + max((number for people in ids for number in people), default=0)
    names = {name: column for column, name in enumerate(ALIASES[detector.layout]) if name}
    columns = list(names.values())
    joints = np.tile((np.nan, np.nan, 0.0), (len(frames), count, len(names), 1))
    points = np.full_like(joints, np.nan)
    for index, (found, numbers) in enumerate(zip(frames, ids, strict=True)):
        joints[index, numbers] = found.joints[:, columns]
        if found.points is not None:
            points[index, numbers] = found.points[:, columns]
    arrays = {
        "keypoints": joints[..., :2],
        "confidence": joints[..., 2],
        "joint_names": list(names),
        "person_ids": np.arange(count),
        "image_size_wh": image_size_wh,
        "relative_noise": detector.relative_noise,
        "frames_seen": seen,
    }
    if np.isfinite(points).any():
        arrays["points"] = points
    if any(owner is not None for owner in owners):
        whose = np.full((len(frames), *MASK_CELLS), -1, np.int16)
        for row, owner, numbers in zip(whose, owners, ids, strict=True):
            if owner is not None:
                row[:] = np.array(numbers)[owner]
        arrays["mask_owner"] = whose
    save_arrays(out, arrays, compressed="mask_owner" in arrays)
