"""Robots with exact truth: arms of a URDF filmed as they move, and a quadruped's trot.

`robot_arm` loads an arm and gives its links shapes of one girth, as arms have it (the URDFs of
robots name meshes, which need not be there). `robot_sequence` moves it smoothly within its joint
limits and renders it before clutter: capsules on the links, a little thinner or thicker than the
tracker's parts, so that what is filmed is not the tracker's model.
`trot` moves a quadruped on a free root, two diagonal legs at a time.

Robots are Z up; the world is Y up. An arm stands on the base that its loader gives it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.load import FileOptions, load_body
from torchcss.body.model import BodyModel
from torchcss.errors import BodyError
from torchcss.studies.render.clutter import clutter_background
from torchcss.studies.render.motions import sample_times
from torchcss.studies.render.renderer import Lighting, Mesh, capsule, random_texture
from torchcss.studies.render.scene import look_at
from torchcss.studies.render.sequences import SyntheticSequence, film_parts
from torchcss.types import Trajectory, Vector
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import grid_faces

_COLOURS = ((0.85, 0.86, 0.88), (0.95, 0.55, 0.15), (0.80, 0.82, 0.86))
"""Painted metal, and a joint cover in a signal colour."""

_GIRTH = 0.055
"""Radius of the links of an arm, metres."""

_ENDLESS = math.pi
"""Range of a joint without limits, to either side."""


def robot_arm(path: str | Path, *, usual: Vector | None = None) -> BodyModel:
    """Load an arm, standing on the world's origin, Y up.

    A shoulder of three joints reaches every pose of the upper arm in two ways, which no image tells
    apart: turned by half a turn about the first and third axis. A usual pose, as the sticky prior
    of section 3.2.2 [IJRR], does.

    Args:
        path: A URDF or MJCF file.
        usual: Pose about which the arm works, if it is known: it departs from that by a radian.

    Raises:
        BodyError: If the file cannot be used or describes no links of any length.
    """
    body = load_body(path, file=FileOptions(shape="bones"), dtype=torch.float64)
    if not body.num_parts:
        raise BodyError(f"{path}: no link has a length; expected an arm")
    upright = body.tie.new_tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    body = body.with_base(upright, upright.new_zeros(3))
    shape = body.part_shape.clone()
    # What was along the bone stays; across it the link is as thick as all others.
    shape[:, 2] = (shape[:, 2] - shape[:, :2].mean(1) + _GIRTH).clamp(min=1.1 * _GIRTH)
    shape[:, :2] = _GIRTH
    body.part_shape = shape
    body.neighbours = _near_pairs(body)
    if usual is not None:
        body.sticky_mean = usual.to(body.tie)
        body.sticky_deviation = torch.ones_like(body.sticky_mean)
    return body


def _near_pairs(body: BodyModel) -> tuple[tuple[str, str], ...]:
    """Parts that touch as long as the joints between them are nearer than the links are thick."""
    rotation, centre = body.part_poses(body.pose(body.rest))
    half = rotation[..., 2] * (body.part_shape[:, 2] - body.part_shape[:, 0])[:, None]
    ends = torch.stack([centre - half, centre + half], 1)
    apart = (ends[:, None, :, None] - ends[None, :, None]).norm(dim=-1).amin((-1, -2))
    reach = 2.5 * body.part_shape[:, 0]
    rows, columns = torch.nonzero((apart < reach).triu(1)).T.tolist()
    names = body.part_names
    return tuple((names[i], names[j]) for i, j in zip(rows, columns, strict=True))


def swing(
    body: BodyModel,
    times: Float[Tensor, " t"],
    *,
    generator: torch.Generator,
    middle: Vector | None = None,
    amplitude: float = 0.5,
) -> Trajectory:
    """Smooth states within the limits: every joint swings about a middle pose.

    Args:
        body: An arm.
        times: Seconds.
        generator: Source of periods and phases.
        middle: The pose in the middle; that of every joint's range by default.
        amplitude: Swing to either side, radians or metres; less where limits are narrower.
    """
    low = body.lower.clamp(min=-_ENDLESS)
    high = body.upper.clamp(max=_ENDLESS)
    middle = 0.5 * (low + high) if middle is None else middle.to(low)
    room = torch.minimum(middle - low, high - middle).clamp(min=0)
    size = torch.minimum(0.8 * room, torch.full_like(room, amplitude))
    draw = torch.rand(2, len(low), generator=generator, dtype=torch.float64).to(low)
    period, phase = 2.5 + 2.5 * draw[0], 2 * math.pi * draw[1]
    return middle + size * (2 * math.pi * times.to(low)[:, None] / period + phase).sin()


def robot_sequence(
    body: BodyModel,
    *,
    generator: torch.Generator,
    middle: Vector | None = None,
    amplitude: float = 0.5,
    num_frames: int = 50,
    frame_rate: float = 25.0,
) -> SyntheticSequence:
    """Film an arm that moves before clutter.

    Args:
        body: What `robot_arm` gives.
        generator: Source of the motion, the background, the paint and the sensor noise.
        middle: See `swing`.
        amplitude: See `swing`.
        num_frames: Number of frames.
        frame_rate: Frames per second.

    Raises:
        ConfigurationError: If there is to be no frame.
    """
    times = sample_times(num_frames, frame_rate)
    states = swing(body, times, generator=generator, middle=middle, amplitude=amplitude)
    (sequence,) = film_robot(body, states, generator=generator, frame_rate=frame_rate)
    return sequence


def film_robot(
    body: BodyModel,
    states: Trajectory,
    *,
    generator: torch.Generator,
    cameras: Sequence[Camera] = (),
    frame_rate: float = 25.0,
) -> list[SyntheticSequence]:
    """Film a robot before clutter: capsules on its links.

    Args:
        body: A body whose parts are about as long as its links.
        states: Its motion.
        generator: Source of the background, the paint and the sensor noise.
        cameras: Who looks; by default one camera that sees all of the motion.
        frame_rate: Frames per second.

    Returns:
        What each camera filmed.
    """
    joints = body.pose(states).joints.flatten(0, 1)
    lowest, highest = joints.amin(0), joints.amax(0)
    centre = 0.5 * (lowest + highest)
    size = float((highest - lowest).norm()) + 4 * float(body.part_shape[:, 0].max())
    if not cameras:
        away = torch.tensor([0.45, 0.25, 1.0], dtype=torch.float64)
        eye = centre + 1.1 * size * 700 / 480 * away / away.norm()
        cameras = [look_at(eye.tolist(), centre.tolist(), focal_px=700.0, name="robot")]
    backgrounds = [
        clutter_background(*reversed(camera.image_size_wh), generator=generator)
        for camera in cameras
    ]
    thickness = 1 + 0.2 * (torch.rand(body.num_parts, generator=generator) - 0.5)
    textures = [random_texture(generator=generator) for _ in body.part_names]
    lamp = centre + size * torch.tensor([0.6, 1.2, 1.0], dtype=torch.float64)
    lighting = Lighting(
        lamp_world=tuple(lamp.tolist()), target_world=tuple(centre.tolist()), cone=0.9
    )
    painted = []
    for part, (shape, factor) in enumerate(zip(body.part_shape, thickness, strict=True)):
        points, normals = capsule(float(shape[0]) * float(factor), float(shape[2] - shape[0]))
        colour, faces = _COLOURS[part % len(_COLOURS)], grid_faces(*points.shape[:2])
        painted.append(
            Mesh(
                points.flatten(0, 1), normals.flatten(0, 1), faces, points.new_tensor(colour),
                texture=textures[part],
            )
        )  # fmt: skip
    return [
        film_parts(
            body, states, painted, camera=camera, background=background, lighting=lighting,
            frame_rate=frame_rate, generator=generator,
        )
        for camera, background in zip(cameras, backgrounds, strict=True)
    ]  # fmt: skip


TROT_LEGS = (("LF", "RH"), ("RF", "LH"))
"""Diagonal pairs of legs, left and right, fore and hind."""


def stand(body: BodyModel) -> Vector:
    """A quadruped on bent legs, at the origin: the middle of its trot, and no state of it.

    Args:
        body: See `trot`.
    """
    state = body.rest.clone()
    for leg in (leg for pair in TROT_LEGS for leg in pair):
        fore = 1.0 if leg[1] == "F" else -1.0
        state[body.state_index(f"{leg}_HFE")] = 0.65 * fore
        state[body.state_index(f"{leg}_KFE")] = -1.15 * fore
    return state


def trot(body: BodyModel, times: Float[Tensor, " t"]) -> Trajectory:
    """States of a quadruped that trots forwards, turning slowly to its left.

    Args:
        body: ANYmal on a free root, or another one whose legs have the joints `LF_HAA` (sideways),
            `LF_HFE` and `LF_KFE` (hip and knee), and so on.
        times: Seconds.
    """
    states = stand(body).expand(len(times), -1).clone()

    def put(name: str, values: Tensor) -> None:
        states[:, body.state_index(name)] += values.to(states)

    turn = 2 * math.pi * 1.5 * times  # a stride and a half a second
    speed, curve = 0.5, 0.25  # metres and radians per second
    heading = curve * times
    put("root_yaw", heading)
    put("root_x", speed / curve * (1 - heading.cos()))
    put("root_z", speed / curve * heading.sin())
    put("root_y", 0.012 * (2 * turn).sin())
    put("root_pitch", 0.025 * (2 * turn + 0.7).sin())
    put("root_roll", 0.03 * turn.sin())
    for pair, start in zip(TROT_LEGS, (0.0, math.pi), strict=True):
        for leg in pair:
            fore = 1.0 if leg[1] == "F" else -1.0
            left = 1.0 if leg[0] == "L" else -1.0
            phase = turn + start
            put(f"{leg}_HAA", 0.06 * left + 0.03 * phase.sin())
            put(f"{leg}_HFE", -0.28 * phase.cos())
            # The knee bends while the leg swings forwards.
            put(f"{leg}_KFE", -0.35 * fore * phase.sin().clamp(min=0))
    return states
