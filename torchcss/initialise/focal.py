"""The focal length of a camera that nobody calibrated, from a person's joints in several frames.

Near limbs look larger than far ones, the more so the nearer the camera, and so the wider its lens.
For each of some focal lengths the body is fitted to every frame (pose, place and lengths), and what
the best fits cost is a log likelihood. With a prior of what telephones and cameras have it gives
the focal length, and how well that is known. Size and distance stay unknown.

Call `fit_focal`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES
from torchcss.cost.joints import match_joints
from torchcss.cost.total import TrackingCost
from torchcss.initialise.from_joints import hang_before_camera
from torchcss.initialise.multi_start import descend_widened, optimise, starts_about
from torchcss.initialise.options import InitialiseOptions
from torchcss.initialise.view import CameraView
from torchcss.types import Keypoints
from torchcss.vision.camera import Camera

MEAN, DEVIATION = math.log(0.9), 0.25
"""Prior of the logarithm of the focal length in multiples of the image's longer side: telephones
film with 0.7 to 0.9, webcams have 0.7 to 1.1, cameras of laboratories up to 1.5."""

POWER = 0.07
"""How much a frame counts. Keypoints are off the joints in the same way in all frames: with this
power errors are as large as stated."""

MOST_FRAMES = 30
_LEAST_FRAMES = 5
_LEAST_JOINTS = 10
_NUM_STARTS = 8
_SCHEDULE = ((16.0, 12), (4.0, 10))
_MAX_STEPS = 25
_STEPS = range(-5, 6)  # in halves of the prior's deviation


class Focal(NamedTuple):
    """A focal length.

    Attributes:
        pixels: Its posterior mean.
        deviation: Standard deviation of its logarithm.
        num_frames: Frames that were looked at; 0: this is the prior.
    """

    pixels: float
    deviation: float
    num_frames: int


def fit_focal(
    body: str,
    keypoints: Keypoints,
    image_size_wh: tuple[int, int],
    *,
    options: InitialiseOptions,
    generator: torch.Generator,
) -> Focal:
    """Fit the focal length of a camera to a person's joints in frames spread through a clip.

    Args:
        body: Name of a person's body.
        keypoints: Of every frame.
        image_size_wh: Size of the images.
        options: Noise of the keypoints and priors of the pose.
        generator: Source of the starting poses.
    """
    longer = max(image_size_wh)
    free = load_body(body, dtype=options.dtype, free_proportions=True, free_root=True)
    keypoints = keypoints.only(free.joint_names).to(free.tie)
    usable = torch.nonzero(keypoints.known.sum(-1) >= _LEAST_JOINTS)[:, 0]
    if len(usable) < _LEAST_FRAMES:
        return Focal(math.exp(MEAN) * longer, DEVIATION, 0)
    spread = torch.linspace(0, len(usable) - 1, min(MOST_FRAMES, len(usable))).round().long()
    keypoints = keypoints.at(usable[spread])
    offsets = torch.tensor([0.5 * step for step in _STEPS], dtype=torch.float64)
    logs = MEAN + DEVIATION * offsets
    cameras = [
        Camera.pinhole(*image_size_wh, focal_px=longer * math.exp(log)) for log in logs.tolist()
    ]
    costs = _costs(free, keypoints, cameras, options, generator)
    log_density = -POWER * costs.to(logs) - 0.5 * offsets.square()
    weight = log_density.softmax(0)
    mean = (weight * logs).sum()
    deviation = (weight * (logs - mean).square()).sum().sqrt()
    return Focal(longer * math.exp(float(mean)), float(deviation), len(spread))


def _costs(
    free: BodyModel,
    keypoints: Keypoints,
    cameras: list[Camera],
    options: InitialiseOptions,
    generator: torch.Generator,
) -> Float[Tensor, " g"]:
    """What the best fits to all frames cost before each camera, nats."""
    num, middle = len(keypoints.confidence), len(cameras) // 2
    body, places = _hung(free, keypoints, cameras[middle])
    cost = options.joint_cost(body, [CameraView(cameras[middle], keypoints)])
    bounds = options.search.bounds(body)
    frame = torch.arange(num).repeat_interleave(_NUM_STARTS)
    x = starts_about(body, _NUM_STARTS, generator).repeat(num, 1)
    x[:, body.state_columns(ROOT_NAMES[:3])] += places[frame]
    first = _before(cost, cameras[middle], frame)
    x = descend_widened(first, x, bounds, _SCHEDULE)
    best = first.value(x).nan_to_num(math.inf).view(num, _NUM_STARTS).argsort(1)[:, :2]
    x = x[(best + _NUM_STARTS * torch.arange(num)[:, None]).flatten()]
    frame = torch.arange(num).repeat_interleave(2)
    found = x.new_zeros(len(cameras))
    for order in (range(middle, len(cameras)), range(middle - 1, -1, -1)):
        y = x
        for number in order:
            fits = optimise(_before(cost, cameras[number], frame), y, bounds, _MAX_STEPS)
            y = fits.mean
            # The better of two fits to every frame.
            found[number] = fits.cost.nan_to_num(math.inf).view(-1, 2).amin(1).sum()
            if number == middle:
                x = y
    return found


def _hung(
    free: BodyModel, keypoints: Keypoints, camera: Camera
) -> tuple[BodyModel, Float[Tensor, "t 3"]]:
    """The body before the camera, and where it stands in every frame, in the axes of its base."""
    hung = [
        hang_before_camera(free, camera, match_joints(keypoints.at(t), free.joint_names))
        for t in range(len(keypoints.confidence))
    ]
    there = torch.stack([body.base_translation for body in hung])
    return hung[0], (there - there[0]) @ hung[0].base_rotation


def _before(cost: TrackingCost, camera: Camera, frame: Int[Tensor, " b"]) -> TrackingCost:
    """The cost of samples that belong to these frames, before another camera."""
    views = (replace(cost.views[0], camera=camera),)
    return replace(cost, views=views, past=(), bound={}, parent=frame)
