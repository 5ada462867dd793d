"""Rendered sequences with exact ground truth: the demo's arm before clutter.

`arm_sequence` moves the eight parameters of arm8 smoothly, bending and rotating with reaching
motion towards the camera, before a cluttered, unevenly lit room with a bright pillar (the arm
experiment of section 6 [IJRR] in small). The rendered surface is finer than the tracker's mesh and
carries a cloth texture. Frames come from the package's own renderer, so nothing else is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchcss.body.model import BodyModel, load_body
from torchcss.raster import (
    Lighting,
    Mesh,
    add_sensor_noise,
    clutter_background,
    random_texture,
    render_meshes,
)
from torchcss.vision.camera import Camera

_SKIN = (0.86, 0.63, 0.52)
_SLEEVE = (0.35, 0.42, 0.62)


@dataclass(frozen=True, kw_only=True)
class SyntheticSequence:
    """A rendered sequence and its truth.

    Attributes:
        frames: Images, red, green, blue.
        frame_rate: Frames per second.
        camera: The camera that took them.
        body: The body that moved, hung on its base.
        states: Its true states.
    """

    frames: list[UInt8[np.ndarray, "h w 3"]]
    frame_rate: float
    camera: Camera
    body: BodyModel
    states: Float[Tensor, "t n"]

    @property
    def joints_world(self) -> Float[Tensor, "t j 3"]:
        """True positions of the joint centres, metres."""
        return self.body.pose(self.states).joints


def arm_motion(body: BodyModel, times: Float[Tensor, " t"]) -> Float[Tensor, "t n"]:
    """States of arm8 that bend, rotate and reach towards the camera.

    Args:
        body: An arm.
        times: Seconds.
    """
    degree = math.pi / 180
    wave = {
        # rest, amplitude, period in seconds, phase
        "r_clavicle_protraction": (5, 14, 3.2, 0.3),
        "r_shoulder_swing": (-62, 20, 2.9, 0.0),
        "r_shoulder_raising": (28, 20, 2.3, 1.0),
        "r_shoulder_twist": (0, 18, 3.7, 2.0),
        "r_elbow_flexion": (52, 34, 1.9, 0.5),
        "r_forearm_twist": (0, 25, 2.7, 0.0),
        "r_wrist_flexion": (0, 15, 1.7, 0.0),
        "r_wrist_deviation": (0, 8, 2.1, 1.0),
    }
    states = torch.zeros(len(times), body.num_parameters, dtype=times.dtype)
    for column, name in enumerate(body.state_names):
        rest, amplitude, period, phase = wave[name]
        turn = (2 * math.pi / period) * times + phase
        states[:, column] = degree * (rest + amplitude * turn.sin())
    return body.bounds.project(states)


def arm_sequence(
    *, generator: torch.Generator, num_frames: int = 50, frame_rate: float = 25.0
) -> SyntheticSequence:
    """Render the demo's sequence.

    Args:
        generator: Source of the room, the textures and the sensor noise.
        num_frames: Number of frames.
        frame_rate: Frames per second.
    """
    width, height = 640, 480
    body = load_body("arm8")
    # World: Y up, the camera at its origin looking along -Z. The body faces the camera.
    shoulder = torch.tensor([0.30, 0.16, -1.75], dtype=torch.float64)
    body = body.with_base(torch.eye(3, dtype=torch.float64), shoulder)
    focal = [[640.0, 0.0, 319.5], [0.0, 640.0, 239.5], [0.0, 0.0, 1.0]]
    camera = Camera(focal, (width, height), R_camera_world=np.diag([1.0, -1.0, -1.0]), name="demo")
    times = torch.arange(num_frames, dtype=torch.float64) / frame_rate
    states = arm_motion(body, times)
    background = clutter_background(height, width, generator=generator)
    textures = [random_texture(generator=generator) for _ in body.part_names]
    fine = body.mesh(40, 48)
    faces = grid_faces(40, 48)
    lighting = Lighting(lamp_world=(0.8, 1.6, 0.4), target_world=(0.1, 0.0, -1.7))

    def project(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return tuple(camera.project(points))  # type: ignore[return-value]

    frames = []
    for state in states:
        rotation, centre = body.part_poses(body.pose(state))
        meshes = []
        for part, name in enumerate(body.part_names):
            local, normals = fine.points[part].flatten(0, 1), fine.normals[part].flatten(0, 1)
            colour = _SLEEVE if name.endswith(("upper_arm", "clavicle")) else _SKIN
            turn = rotation[part].T
            meshes.append(
                Mesh(
                    local @ turn + centre[part],
                    normals @ turn,
                    faces,
                    torch.tensor(colour, dtype=torch.float64),
                    points_part=local,
                    texture=textures[part],
                )
            )
        picture = render_meshes(
            meshes, project, height, width,
            background=background, eye_world=camera.centre_world, lighting=lighting,
        ).image  # fmt: skip
        frames.append(add_sensor_noise(picture, generator=generator).numpy())
    return SyntheticSequence(
        frames=frames, frame_rate=frame_rate, camera=camera, body=body, states=states
    )


def grid_faces(rings: int, meridians: int) -> Tensor:
    """Triangles `[f 3]` of a mesh of rings closed around the part, poles capped by fans.

    Args:
        rings: Latitudes.
        meridians: Longitudes.
    """
    ring, step = torch.meshgrid(torch.arange(rings - 1), torch.arange(meridians), indexing="ij")
    here = ring * meridians + step
    beside = ring * meridians + (step + 1) % meridians
    quads = torch.stack([here, beside, here + meridians, beside + meridians], dim=-1).reshape(-1, 4)
    sides = torch.cat([quads[:, [0, 1, 3]], quads[:, [0, 3, 2]]])
    fan = torch.arange(1, meridians - 1)
    bottom = torch.stack([torch.zeros_like(fan), fan + 1, fan], dim=-1)
    top = torch.stack([torch.zeros_like(fan), fan, fan + 1], dim=-1) + (rings - 1) * meridians
    return torch.cat([sides, bottom, top])
