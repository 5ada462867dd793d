"""Single frames with their cost, a true state and the mode nearest to it: to look at a cost.

The cost of such a frame is that of a tracker whose only mode in the frame before was a given state,
and that knows colours from that frame alone. A `Scene` adds the truth and the mode that the
optimiser reaches from there, whose covariance says along which lines the cost is worth a look
(`torchcss.studies.slices`).

Call `arm_scenes` for frames of the rendered arm, whose truth is exact, or `sequence_scenes` for
those of a recording: where its states are not known, the fit to the keypoints that is nearest the
3D reference stands for the truth. Then `Scene.lines` and `Scene.limits`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES
from torchcss.cost.context import FrameContext
from torchcss.cost.frame import NOTHING_KNOWN
from torchcss.cost.total import TrackingCost
from torchcss.errors import ConfigurationError
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.initialise.fit import initialise
from torchcss.initialise.keypoint_checks import default_sigma
from torchcss.initialise.options import LEAST_JOINTS, InitialiseOptions
from torchcss.initialise.view import CameraView
from torchcss.io.video import VideoReader
from torchcss.joint_names import LIMB_JOINTS
from torchcss.studies.metrics import root_aligned_mpjpe_mm
from torchcss.studies.render.sequences import arm_sequence
from torchcss.studies.sequences import RecordedSequence
from torchcss.studies.slices import StateLine, eigen_lines, joint_lines
from torchcss.tracking.settings import Settings, make_choice, make_plan
from torchcss.tracking.view import NOTHING_SEEN
from torchcss.types import Bounds, ColourImage, Frame, Modes, Vector
from torchcss.vision.features import FrameFeatures

_REACH_M = 0.5
"""How far a slice moves the body, which no limit ends; angles go half a turn at most."""


class Scene(NamedTuple):
    """A frame whose cost is looked at.

    Attributes:
        name: Where the frame comes from.
        image: The frame, at its full size.
        features: Its features, at the working size.
        cost: Its cost, which holds body and working camera too.
        truth: The true state, or what stands for it.
        mode: Where the optimiser gets from there, with its covariance.
    """

    name: str
    image: ColourImage
    features: FrameFeatures
    cost: TrackingCost
    truth: Vector
    mode: Modes

    @property
    def slug(self) -> str:
        """The name as a part of a file's name."""
        return self.name.replace(",", "").replace(" ", "_")

    def lines(self, centre: Vector) -> list[StateLine]:
        """The lines through a state along all joints, then along the mode's eigenvectors.

        A line on which the state cannot move either way without leaving its limits is left out.
        """
        names, covariance = self.cost.body.state_names, self.mode.covariance
        lines = joint_lines(names, centre, covariance) + eigen_lines(centre, covariance)
        limits = self.limits(centre)
        return [line for line in lines if line.interval(limits) != (0.0, 0.0)]

    def limits(self, centre: Vector) -> Bounds:
        """How far a slice through a state may go: the joint limits, and a sensible reach."""
        names, (lower, upper) = self.cost.body.state_names, self.cost.body.bounds
        reach = [_REACH_M if name in ROOT_NAMES[:3] else math.pi for name in names]
        far = torch.tensor(reach).to(centre)
        return Bounds(lower.maximum(centre - far), upper.minimum(centre + far))


def arm_scenes(
    frames: Sequence[int],
    *,
    generator: torch.Generator,
    settings: Settings | None = None,
    name: str = "arm",
) -> Iterator[Scene]:
    """Frames of the demo's sequence, without keypoints, as after the first frame of a track.

    Args:
        frames: Which frames, none of them the first, which has no motion.
        generator: Source of the room, the textures and the sensor noise.
        settings: Terms of the cost; its body must be "arm8".
        name: What the scenes are called.

    Raises:
        ConfigurationError: If a frame has none before it.
    """
    _check_frames(frames)
    settings = settings or Settings(body="arm8")
    sequence = arm_sequence(generator=generator, num_frames=max(frames) + 1)
    body, view = sequence.body.to(dtype=settings.torch_dtype), CameraView(sequence.camera)
    states = sequence.states.to(body.tie)
    moments = [Frame(i, i / sequence.frame_rate, image) for i, image in enumerate(sequence.frames)]
    for index in frames:
        pair, known = moments[index - 1 : index + 1], states[index - 1 : index + 1].unbind()
        yield _scene(f"{name}, frame {index}", pair, known, body, view, settings)


def sequence_scenes(
    sequence: RecordedSequence,
    frames: Sequence[int],
    *,
    generator: torch.Generator,
    settings: Settings,
) -> Iterator[Scene]:
    """Frames of a recorded sequence.

    Where no states are known, body and truth come from the keypoints of the frame: of the distinct
    fits to them, the one whose limbs are nearest the 3D reference. The state before is that fit,
    moved to the keypoints there.

    Args:
        sequence: The sequence.
        frames: Which frames, none of them the first.
        generator: Source of the starting poses of fits.
        settings: Terms of the cost, and the body where none is known.

    Raises:
        ConfigurationError: If a frame has none before it.
        TorchcssError: If the video cannot be read, or no body fits.
    """
    _check_frames(frames)
    dtype = settings.torch_dtype
    view = CameraView(sequence.camera.to(dtype))
    for index in frames:
        pair = tuple(VideoReader(sequence.video, start=index - 1, stop=index + 1))
        if sequence.truth is None:
            body, states, view = _fitted(sequence, index, settings, generator)
        else:
            body = sequence.truth.body.to(dtype=dtype)
            states = sequence.truth.states[index - 1 : index + 1].to(body.tie).unbind()
        yield _scene(f"{sequence.name}, frame {index}", pair, states, body, view, settings)


def _fitted(
    sequence: RecordedSequence, frame: int, settings: Settings, generator: torch.Generator
) -> tuple[BodyModel, tuple[Vector, ...], CameraView]:
    """A body, its states before and in a frame, and the camera with the keypoints they fit."""
    keypoints, camera = sequence.keypoints, sequence.camera.to(settings.torch_dtype)
    options = InitialiseOptions(least_joints=LEAST_JOINTS, dtype=settings.torch_dtype)
    first = initialise(
        None, keypoints.at(frame), camera, settings.body, generator=generator, options=options
    )
    body, sigma = first.body, default_sigma(keypoints.at(frame))
    truth = _nearest(body, first.mixture.mean, sequence, frame)
    before = FrameContext(body=body, camera=camera, keypoints=keypoints.at(frame - 1).to(body.tie))
    alone = TrackingCost(
        choice=make_choice(Settings(terms=("joints", "stabiliser")), sigma), views=(before,)
    )
    previous = TrustRegionNewton().minimise(alone, truth[None], body.bounds).mean[0]
    return body, (previous, truth), CameraView(camera, keypoints, sigma)


def _scene(
    name: str,
    moments: Sequence[Frame],
    states: Sequence[Vector],
    body: BodyModel,
    view: CameraView,
    settings: Settings,
) -> Scene:
    """The second of two moments, as after a track that was at the first state in the first."""
    (before, now), (previous, truth) = moments, states
    observer = make_plan(settings, body, view, now.time_s - before.time_s).observer(body, view)
    seen_before = observer.observe(before, NOTHING_SEEN)
    seen = observer.observe(now, seen_before)
    known = observer.costs.learn(NOTHING_KNOWN, seen_before.features, body, previous[None])
    cost = observer.cost(seen, known, body, previous).of_mode(previous)
    mode = TrustRegionNewton().minimise(cost, truth[None], body.bounds)
    assert seen.features is not None
    return Scene(name, now.image, seen.features, cost, truth, mode.take(0))


def _nearest(
    body: BodyModel, fits: Float[Tensor, "k n"], sequence: RecordedSequence, frame: int
) -> Tensor:
    """The state whose limbs are nearest the reference once the roots are on each other."""
    names = sequence.joint_names
    common = [name for name in LIMB_JOINTS if name in names and name in body.joint_names]
    fitted = body.pose(fits).joints[:, body.joint_columns(common)]
    true = sequence.joints_world[frame, [names.index(name) for name in common]]
    return fits[int(np.argmin(root_aligned_mpjpe_mm(fitted.cpu(), true, common)))]


def _check_frames(frames: Sequence[int]) -> None:
    if not frames or min(frames) < 1:
        raise ConfigurationError(
            f"frames {list(frames)}: expected at least one, and each with a frame before it"
        )
