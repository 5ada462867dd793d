"""The first pose of a video: `torchcss.initialise` on one of its frames, as the settings say."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from torchcss.cost.view import View
from torchcss.initialise.fit import initialise
from torchcss.initialise.from_joints import LEAST_JOINTS
from torchcss.initialise.result import Initialisation
from torchcss.io.keypoints.read import Keypoints
from torchcss.io.video import VideoReader
from torchcss.tracking.settings import Settings
from torchcss.vision.camera import Camera


def initialise_video(
    video: Path,
    marks: Keypoints,
    camera: Camera,
    settings: Settings,
    *,
    start: int,
    sigma: float,
    generator: torch.Generator,
    others: Sequence[View] = (),
) -> Initialisation:
    """Fit pose, proportions and shape to the frame where tracking starts.

    Args:
        video: A video, or a folder of images.
        marks: Its keypoints.
        camera: Its camera, in the settings' type and on their device.
        settings: Body, terms, working size, type and device.
        start: The frame.
        sigma: Noise of the keypoints, pixels of the full image.
        generator: Source of the starting poses.
        others: What further cameras see of that moment, see `initialise`.

    Raises:
        TorchcssError: If the frame cannot be read, or too few joints are marked in it.
    """
    (frame,) = VideoReader(video, start=start, stop=start + 1)
    return initialise(
        frame.image,
        torch.cat([marks.keypoints[start], marks.confidence[start, :, None]], dim=-1),
        camera,
        settings.body,
        joint_names=marks.joint_names,
        generator=generator,
        sigma=sigma,
        contours="contour" in settings.terms,
        colours="region" in settings.terms,
        working_size=settings.working_size,
        least_joints=LEAST_JOINTS,
        others=others,
        dtype=settings.torch_dtype,
        device=settings.device,
    )
