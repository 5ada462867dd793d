"""Detectors of 2D keypoints: other people's networks behind one interface, `Detector`.

| name | package | model file |
|---|---|---|
| `mediapipe` | mediapipe, the extra `[detect]` | `.task` (`torchcss.io.detector_model`) |
| `rtmlib` | rtmlib | an RTMO network, `.onnx` |

A detector sees one frame after another, and returns everybody whom it finds. What it calls
confidence is made a weight, a share of the inverse variance that a place has where it is sure.

Call `open_detector`.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, UInt8

from torchcss.errors import DetectorError, MissingExtraError
from torchcss.io.detector_model import find_model
from torchcss.io.keypoints.mediapipe import LAYOUT
from torchcss.types import Frame

DetectorName = Literal["mediapipe", "rtmlib"]

MOST_PEOPLE = 4
"""People that MediaPipe looks for in a frame."""

_LEAST_VISIBILITY = 0.1
"""Places of which MediaPipe believes less than that are guesses."""

_SYSTEM_LIBRARIES = "apt-get install libgl1 libegl1 libgles2 libglib2.0-0"


class Detected(NamedTuple):
    """Who was found in a frame.

    Attributes:
        joints: Of everybody: u, v in pixels, centres at integers, and the weight.
        points: Where the detector believes them in space, metres from the middle of the hips, in
            the camera's axes; None: it does not say.
        masks: How much each pixel belongs to each of them, 0 to 255; None: it does not say.
    """

    joints: Float[np.ndarray, "p j 3"]
    points: Float[np.ndarray, "p j 3"] | None = None
    masks: UInt8[np.ndarray, "p h w"] | None = None


class Detector(Protocol):
    """Finds people in the frames of a video, in their order."""

    @property
    def layout(self) -> str:
        """Which joints these are, see `torchcss.joint_names.ALIASES`."""
        ...

    @property
    def relative_noise(self) -> float:
        """Standard deviation of places of weight 1, see `torchcss.io.keypoints.people.People`."""
        ...

    def detect(self, frame: Frame) -> Detected:
        """The people of the next frame."""
        ...

    def close(self) -> None:
        """Give its memory back."""
        ...


def open_detector(name: DetectorName, model: Path | None) -> Detector:
    """Load a detector.

    Args:
        name: Which.
        model: Its file; None: `torchcss.io.detector_model.find_model` finds MediaPipe's.

    Raises:
        MissingExtraError: If its package, or a library of the system, is not installed.
        DetectorError: If there is no model.
    """
    return MediaPipe(model) if name == "mediapipe" else Rtmlib(model)


class MediaPipe:
    """MediaPipe's pose landmarker: 33 landmarks, in space too, and masks.

    Its places are off by 1.8 / visibility standard deviations of what other detectors have.

    Args:
        model: The bundle.
    """

    layout = LAYOUT
    relative_noise = 1.8

    def __init__(self, model: Path | None) -> None:
        with _quiet():
            self._package = _package("mediapipe", 'pip install "torchcss[detect]"')
        vision = self._package.tasks.vision
        options = vision.PoseLandmarkerOptions(
            base_options=self._package.tasks.BaseOptions(model_asset_path=str(find_model(model))),
            running_mode=vision.RunningMode.VIDEO,
            num_poses=MOST_PEOPLE,
            output_segmentation_masks=True,
        )
        try:
            with _quiet():
                self._landmarker = vision.PoseLandmarker.create_from_options(options)
        except (RuntimeError, ValueError) as error:
            raise DetectorError(f"{model}: MediaPipe does not take it: {error}") from error
        self._last_ms = -1

    def detect(self, frame: Frame) -> Detected:
        """The people of the next frame."""
        # It takes the pixels to lie densely, whatever the array's strides say.
        pixels = np.ascontiguousarray(frame.image)
        image = self._package.Image(image_format=self._package.ImageFormat.SRGB, data=pixels)
        self._last_ms = max(self._last_ms + 1, round(1000 * frame.time_s))
        with _quiet():
            found = self._landmarker.detect_for_video(image, self._last_ms)
        landmarks = [[(m.x, m.y, m.visibility) for m in person] for person in found.pose_landmarks]
        joints = np.array(landmarks, dtype=np.float64).reshape(-1, 33, 3)
        joints[..., :2] = joints[..., :2] * (pixels.shape[1], pixels.shape[0]) - 0.5
        sure = joints[..., 2:] > _LEAST_VISIBILITY
        joints[..., 2] **= 2
        points = [[(m.x, m.y, m.z) for m in person] for person in found.pose_world_landmarks]
        # Where nobody is found, it says None.
        masks = [mask.numpy_view() for mask in found.segmentation_masks or ()]
        return Detected(
            np.where(sure, joints, 0.0),
            np.array(points, dtype=np.float64).reshape(-1, 33, 3),
            (255.0 * np.array(masks)).round().astype(np.uint8).reshape(-1, *pixels.shape[:2]),
        )

    def close(self) -> None:
        """Give its memory back."""
        with _quiet():
            self._landmarker.close()


class Rtmlib:
    """RTMO by rtmlib: 17 joints of everybody, without masks.

    Args:
        model: The network, `.onnx`; rtmlib would fetch one by itself, so it has to be given.
    """

    layout = "COCO-17"
    relative_noise = 1.0

    def __init__(self, model: Path | None) -> None:
        if model is None or not model.is_file():
            raise DetectorError(
                f"{model or 'rtmlib'}: give the file of an RTMO network with --detector-model"
            )
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
            self._network = _package("rtmlib", "pip install rtmlib").RTMO(str(model))

    def detect(self, frame: Frame) -> Detected:
        """The people of the next frame."""
        places, scores = self._network(np.ascontiguousarray(frame.image[..., ::-1]))
        return Detected(np.concatenate([places, scores[..., None]], axis=-1).reshape(-1, 17, 3))

    def close(self) -> None:
        """Nothing to give back."""


def _package(name: str, install: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"detecting keypoints needs {error.name}: {install}, or give --keypoints"
        ) from error
    except (ImportError, OSError) as error:  # a shared library that a bare server lacks
        raise MissingExtraError(
            f"{name} does not load ({error}); on Debian and Ubuntu: {_SYSTEM_LIBRARIES}"
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what a library's C++ writes to the standard error from the terminal."""
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        for descriptor in (kept, nowhere):
            with suppress(OSError):
                os.close(descriptor)
