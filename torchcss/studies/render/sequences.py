"""Rendered sequences with exact ground truth: the demo's arm, and those of the papers' section 6.

`arm_sequence` moves the eight parameters of arm8 smoothly, bending and rotating with reaching
motion towards the camera, before a cluttered, unevenly lit room with a bright pillar (the arm
experiment of section 6 [IJRR] in small). The rendered surface is finer than the tracker's mesh and
carries a cloth texture.

A `Shot` renders any motion of any body as a dressed character in a scene
(`torchcss.studies.render.character`, `torchcss.studies.render.scene`).
`shot("arm")`, `"body-clutter"` and `"body-dark"` are the three sequences of section 6 [IJRR];
`shot_of_motion` films a motion of the user's.

The truth is exact for the rendered surface. Pixel centres are rasterised
(`torchcss.vision.rasterise`), which gives mask and part. The flow of a pixel is that of the
surface point that it sees, carried to the next frame by its triangle; the point is hidden there if
its triangle looks away, if it leaves the image, or if another surface is nearer. Nothing but the
character moves, so elsewhere the flow is 0 and hidden is what the character covers next; shadows
are no motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError
from torchcss.studies.random_person import random_lengths
from torchcss.studies.render.character import Character, Clothing
from torchcss.studies.render.clutter import clutter_background
from torchcss.studies.render.mesh_truth import Labels, MeshTruth, joints_own_parts
from torchcss.studies.render.motions import MOTIONS, Motion, sample_times
from torchcss.studies.render.renderer import (
    Lighting,
    Mesh,
    Picture,
    add_sensor_noise,
    random_texture,
    render_meshes,
)
from torchcss.studies.render.scene import (
    SceneRenderer,
    Standpoint,
    Style,
    lamp,
    level,
    look_at,
)
from torchcss.types import ColourImage, Trajectory, Vector, frozen
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import grid_faces, join_faces

_SKIN = (0.86, 0.63, 0.52)
_SLEEVE = (0.35, 0.42, 0.62)
_UP = (0.0, 1.0, 0.0)
_MARGIN = 0.06
"""Share of a picture's width and height that `camera_in_front` leaves free on every side."""


@frozen
class SyntheticSequence:
    """A rendered sequence and its truth.

    Attributes:
        frames: Images, red, green, blue.
        frame_rate: Frames per second.
        camera: The camera that took them.
        body: The body that moved, hung on its base.
        states: Its true states.
    """

    frames: list[ColourImage]
    frame_rate: float
    camera: Camera
    body: BodyModel
    states: Trajectory

    @property
    def joints_world(self) -> Float[Tensor, "t j 3"]:
        """True positions of the joint centres, metres."""
        return self.body.pose(self.states).joints


def arm_motion(body: BodyModel, times: Float[Tensor, " t"]) -> Trajectory:
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


def film_parts(
    body: BodyModel,
    states: Trajectory,
    painted: Sequence[Mesh],
    *,
    camera: Camera,
    background: Picture,
    lighting: Lighting,
    frame_rate: float,
    generator: torch.Generator,
) -> SyntheticSequence:
    """Film a body's rigid parts before a background.

    Args:
        body: The body, on its base.
        states: Its states.
        painted: The surface of every part as it is where the part is at the world's origin.
        camera: Who looks.
        background: What is behind.
        lighting: The light on the parts.
        frame_rate: Frames per second.
        generator: Source of the sensor's noise.
    """
    frames = []
    for state in states:
        rotation, centre = body.part_poses(body.pose(state))
        meshes = [
            mesh.moved(turn, place)
            for mesh, turn, place in zip(painted, rotation, centre, strict=True)
        ]
        picture = render_meshes(meshes, camera, background=background, shade=lighting.shade)
        frames.append(add_sensor_noise(picture, generator=generator).numpy())
    return SyntheticSequence(
        frames=frames, frame_rate=frame_rate, camera=camera, body=body, states=states
    )


def arm_sequence(*, generator: torch.Generator, num_frames: int = 50) -> SyntheticSequence:
    """Render the demo's sequence.

    Args:
        generator: Source of the room, the textures and the sensor noise.
        num_frames: Number of frames, 25 per second.

    Raises:
        ConfigurationError: If there is to be no frame.
    """
    frame_rate = 25.0
    times = sample_times(num_frames, frame_rate)
    # World: Y up, the camera at its origin looking along -Z. The body faces the camera.
    shoulder = torch.tensor([0.30, 0.16, -1.75], dtype=torch.float64)
    body = load_body("arm8").with_base(torch.eye(3, dtype=torch.float64), shoulder)
    camera = look_at((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), focal_px=640.0, name="demo")
    background = clutter_background(480, 640, generator=generator)
    textures = [random_texture(generator=generator) for _ in body.part_names]
    fine, faces = body.mesh(40, 48), grid_faces(40, 48)
    painted = [
        Mesh(
            fine.points[part].flatten(0, 1),
            fine.normals[part].flatten(0, 1),
            faces,
            fine.points.new_tensor(_SLEEVE if name.endswith(("upper_arm", "clavicle")) else _SKIN),
            texture=textures[part],
        )
        for part, name in enumerate(body.part_names)
    ]
    return film_parts(
        body, arm_motion(body, times), painted, camera=camera, background=background,
        lighting=Lighting(lamp_world=(0.8, 1.6, 0.4), target_world=(0.1, 0.0, -1.7)),
        frame_rate=frame_rate, generator=generator,
    )  # fmt: skip


# The papers' sequences, with a dressed character in a scene.


class SequenceFrame(NamedTuple):
    """A rendered frame and its truth; pixel centres are at integers.

    Attributes:
        image: The picture, red, green, blue.
        mask: Whether the first surface on the line of sight is the tracked character.
        part: Which part of the body it is, -1 where it is none.
        depth: Depth of the surface, metres; `inf` in the scene.
        joints: Joint centres, world frame, metres.
        uv: Their projections, pixels.
        visible: Whether the first surface on the line of sight to a joint is its own limb.
        in_image: Whether it projects into the image.
        flow: Motion to the next frame, pixels; 0 where nothing moves. None for the last frame.
        occluded: Whether what is seen here is hidden or out of the image in the next frame.
    """

    image: Picture
    mask: Bool[Tensor, "h w"]
    part: Int[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    joints: Float[Tensor, "j 3"]
    uv: Float[Tensor, "j 2"]
    visible: Bool[Tensor, " j"]
    in_image: Bool[Tensor, " j"]
    flow: Float[Tensor, "h w 2"] | None
    occluded: Bool[Tensor, "h w"] | None


@frozen
class Shot:
    """All that a sequence is rendered from.

    Attributes:
        name: Name of the sequence.
        body: The body of the person, on its base, of the person's own lengths.
        states: Its states.
        frame_rate: Frames per second.
        camera: Who looks.
        style: Scene and light.
        clothing: Clothes and deformations.
        floor: Height of the floor in the world, metres (Y up).
        seed: Seed of everything that is drawn.
        description: A line about it.
        bystander: For an arm: whether the still rest of the person stands beside it.
        spacing: Cells of the character's mesh, metres.
    """

    name: str
    body: BodyModel
    states: Trajectory
    frame_rate: float
    camera: Camera
    style: Style = Style()
    clothing: Clothing = Clothing()
    floor: float = 0.0
    seed: int = 0
    description: str = ""
    bystander: bool = False
    spacing: float = 0.009

    def frames(self) -> Iterator[SequenceFrame]:
        """Render; the same frames whenever it is called.

        Raises:
            CameraError: If the camera has a distortion.
        """
        characters, generator = self.characters()
        character, *others = characters
        still = [other.pose(other.body.rest) for other in others]
        faces, owner = join_faces(
            [each.faces for each in characters], [each.num_vertices for each in characters]
        )
        part = torch.full_like(owner, -1)
        part[owner == 0] = character.part
        truth = MeshTruth(self.camera, faces, part, joints_own_parts(self.body))
        joints = self.body.pose(self.states).joints
        place = _place(joints, self.camera, self.floor)
        renderer = SceneRenderer(self.camera, place, self.style, generator=generator)

        def posed(state: Vector) -> tuple[list[Mesh], Labels]:
            meshes = [character.pose(state), *still]
            return meshes, truth.labels(torch.cat([mesh.vertices_world for mesh in meshes]))

        upcoming = posed(self.states[0])
        for index in range(len(self.states)):
            meshes, labels = upcoming
            picture = add_sensor_noise(renderer.picture(meshes), generator=generator)
            flow, occluded = None, None
            if index + 1 < len(self.states):
                upcoming = posed(self.states[index + 1])
                flow, occluded = truth.flow(labels, upcoming[1])
            uv, visible, in_image = truth.joints(labels, joints[index])
            yield SequenceFrame(
                picture, labels.part >= 0, labels.part, labels.depth, joints[index], uv, visible,
                in_image, flow, occluded,
            )  # fmt: skip

    def characters(self) -> tuple[list[Character], torch.Generator]:
        """The body's character, whoever stands beside it, and the generator as they leave it."""
        generator = torch.Generator().manual_seed(self.seed)
        characters = [
            Character(self.body, self.clothing, generator=generator, spacing=self.spacing)
        ]
        if self.bystander:
            characters.append(_rest_of_person(self.body, self.clothing, generator))
        return characters, generator


def _place(joints: Float[Tensor, "t j 3"], camera: Camera, floor: float) -> Standpoint:
    """Where the motion is, seen from the camera."""
    lowest, highest = joints.amin((0, 1)), joints.amax((0, 1))
    middle = 0.5 * (lowest + highest)
    behind = float(((joints - middle) @ level(camera.R_camera_world[2])).max())
    return Standpoint(middle, floor, behind + 0.15)


def _rest_of_person(arm: BodyModel, clothing: Clothing, generator: torch.Generator) -> Character:
    """Somebody standing still whose right arm is the given one."""
    body = load_body("body34", lengths=arm.lengths)
    start = body.tree.link_index("r_sternoclavicular_link")
    place = body.pose(body.rest).tree.translation[start]
    base = arm.base_translation - arm.base_rotation @ place
    own = ("r_clavicle", "r_upper_arm", "r_forearm", "r_hand")
    return Character(
        body.with_base(arm.base_rotation, base), clothing, generator=generator, without=own
    )


def _stand(body: BodyModel, state: Vector) -> BodyModel:
    """The body on a base from which its lowest point in a state touches the ground, Y = 0."""
    lowest = body.surface(body.pose(state)).points[:, 1].min()
    return body.with_base(
        body.base_rotation, body.base_translation - lowest * lowest.new_tensor([0.0, 1.0, 0.0])
    )


CLUTTER = Style()
"""The scene of the papers' Figs. 9 and 10: clutter, uneven light, bright pillar."""

DARK = Style(
    scene="dark",
    lamps=(lamp((-1.4, 1.1, 2.8), strength=1.0), lamp((2.2, 1.0, 0.6), strength=0.2)),
    fill=0.05,
    ambient=0.01,
)
"""That of Fig. 11: black background."""

STYLES = {"clutter": CLUTTER, "dark": DARK}


def shot(name: str, *, seed: int = 0, num_frames: int | None = None, small: bool = False) -> Shot:
    """One of the sequences of section 6 [IJRR], ready to be rendered.

    Args:
        name: "arm", "body-clutter" or "body-dark".
        seed: Seed of the person, the scene and the noise; the motion is always the same.
        num_frames: Number of frames; all of the motion by default.
        small: A quarter of the picture's width and height, for tests.

    Raises:
        ConfigurationError: If there is no such sequence, or there is to be no frame.
    """
    if name not in MOTIONS:
        raise ConfigurationError(f"no sequence {name!r}; expected one of {', '.join(MOTIONS)}")
    poses, frame_rate = MOTIONS[name], 50.0
    every = round(poses.duration * frame_rate)  # as many as begin before the motion's end
    times = sample_times(every if num_frames is None else num_frames, frame_rate)
    is_arm = poses.body.startswith("arm")
    lengths = None if is_arm else random_lengths(generator=torch.Generator().manual_seed(seed))
    body = load_body(poses.body, lengths=lengths)
    states = poses.states(body, times)
    if is_arm:
        body = body.with_base(torch.eye(3), torch.tensor([0.42, 1.40, 0.0]))
        camera = look_at((0.0, 1.30, 1.85), (0.0, 1.30, 0.0), focal_px=640.0)
        style, clothing, spacing = ARM_STYLE, ARM_CLOTHING, 0.006
    else:
        body = _stand(body, states[0])
        # Room above the head for arms that reach up.
        camera = look_at((0.3, 1.35, 3.7), (0.0, 1.0, 0.0), focal_px=720.0)
        style, clothing = (
            (DARK, DARK_CLOTHING) if name == "body-dark" else (CLUTTER, CLUTTER_CLOTHING)
        )
        spacing = 0.009
    if small:
        camera, spacing = camera.resized(160, 120), 2 * spacing
    return Shot(
        name=name, body=body, states=states, frame_rate=frame_rate, camera=camera, style=style,
        clothing=clothing, seed=seed, description=poses.description, bystander=is_arm,
        spacing=spacing,
    )  # fmt: skip


ARM_STYLE = Style(
    pillar=0.36,
    wall=0.5,
    specular=0.15,
    lamps=(
        lamp((-1.2, 1.3, 1.6), (-0.1, 0.0, 0.0), strength=1.4),
        lamp((1.8, 0.8, 1.2), (-0.3, 0.0, -0.5), strength=0.4),
    ),
)
ARM_CLOTHING = Clothing(
    sleeve=0.55,
    pattern="stripes",
    shirt=(0.25, 0.33, 0.55),
    accent=(0.72, 0.72, 0.70),
    looseness=0.06,
    muscle=0.009,
)
CLUTTER_CLOTHING = Clothing(sleeve=1.85, pattern="plaid", looseness=0.06)
DARK_CLOTHING = Clothing(
    sleeve=1.85,
    pattern="stripes",
    shirt=(0.60, 0.60, 0.58),
    accent=(0.40, 0.42, 0.46),
    trousers=(0.42, 0.42, 0.45),
    looseness=0.045,
)


def shot_of_motion(
    motion: Motion,
    *,
    name: str = "mocap",
    style: Style | None = None,
    clothing: Clothing | None = None,
    camera: Camera | None = None,
    seed: int = 0,
    num_frames: int | None = None,
    small: bool = False,
) -> Shot:
    """Film any motion, by default with a camera that sees all of it from the front.

    Args:
        motion: Body and states.
        name: Name of the sequence.
        style: Scene and light.
        clothing: Clothes and deformations.
        camera: Who looks.
        seed: Seed of the character, the scene and the noise.
        num_frames: Only the first frames.
        small: A quarter of the picture's width and height, for tests.

    Raises:
        ConfigurationError: If there is to be no frame.
    """
    every = len(motion.states) if num_frames is None else num_frames
    states = motion.states[: len(sample_times(every, motion.frame_rate))]
    points = motion.body.surface(motion.body.pose(states)).points
    camera = camera or camera_in_front(motion.body, states)
    if small:
        width, height = camera.image_size_wh
        camera = camera.resized(width // 4, height // 4)
    return Shot(
        name=name,
        body=motion.body,
        states=states,
        frame_rate=motion.frame_rate,
        camera=camera,
        style=style or CLUTTER,
        clothing=clothing or CLUTTER_CLOTHING,
        floor=float(points[..., 1].min()),
        seed=seed,
        description=motion.description,
        spacing=0.018 if small else 0.009,
    )


def camera_in_front(
    body: BodyModel,
    states: Trajectory,
    *,
    focal_px: float = 720.0,
    azimuth: float = 0.0,
    height: float = 0.12,
) -> Camera:
    """A camera that sees the whole motion, by default from where the body looks at first.

    Args:
        body: The body.
        states: Its motion.
        focal_px: Focal length, of a picture of 640 x 480 pixels.
        azimuth: Angle about the vertical from there, radians.
        height: Height of its centre above the middle of the motion, in distances from it.
    """
    points = body.surface(body.pose(states)).points
    lowest, highest = points.amin((0, 1)), points.amax((0, 1))
    middle = 0.5 * (lowest + highest)
    link = int(body.part_link[0])
    front = level(body.pose(states[0]).tree.rotation[link, :, 2])
    aside = torch.stack([front[2], front[1], -front[0]])
    away = math.cos(azimuth) * front + math.sin(azimuth) * aside + height * front.new_tensor(_UP)
    distance = 1.0
    while True:
        eye = middle + distance * away
        camera = look_at(eye.tolist(), middle.tolist(), focal_px=focal_px)
        size = points.new_tensor(camera.image_size_wh)
        uv, _, valid = camera.project(points)
        inside = (uv > _MARGIN * size).all() & (uv < size - _MARGIN * size).all()
        if bool(valid.all() & inside) or distance > 50:
            return camera
        distance *= 1.05
