"""Scenes to film characters in: a painted backdrop, light and shadows.

A scene is a wall and a floor, painted with what the camera is to see there: the room full of hard
edges of `clutter_background`, or a dark curtain. The light of the first lamp is taken away where
characters stand in it, from the backdrop and from the characters themselves, by the lamp's own
picture of them (a shadow map).

Call `SceneRenderer(camera, place, style, generator=...)`, then `picture(meshes)` for every
frame. The scene does not move and is drawn once. `look_at` makes a camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchcss.errors import CameraError, ConfigurationError
from torchcss.studies.render.clutter import clutter_background, dark_background
from torchcss.studies.render.renderer import (
    Lighting,
    Mesh,
    Picture,
    Point,
    render_meshes,
    to_bytes,
    to_display,
    to_light,
)
from torchcss.types import frozen
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import join_faces, rasterise

_SHADOW_MAP = 512
"""Pixels of a lamp's picture of what stands in its light."""

_SHADOW_BIAS = 0.025
"""Metres that a point must lie behind what the lamp sees to be in its shadow."""

_FARTHEST_M = 50.0
"""Metres from the camera beyond which there is no wall."""


class Standpoint(NamedTuple):
    """Where a character is in a scene.

    Attributes:
        middle: Middle of what moves, world frame, metres.
        floor: Height of the floor, metres (Y up).
        behind: How far the motion reaches behind its middle, seen from the camera, metres.
    """

    middle: Float[Tensor, "3"]
    floor: float
    behind: float


def lamp(place: Point, target: Point = (0.0, 0.0, 0.0), strength: float = 0.9) -> Lighting:
    """A warm spotlight, placed about the characters' middle."""
    return Lighting(
        lamp_world=place,
        target_world=target,
        lamp=strength,
        cone=0.5,
        ambient=0.0,
        colour=(1.0, 0.97, 0.92),
    )


@frozen
class Style:
    """How a sequence looks.

    Attributes:
        scene: "clutter" or "dark".
        lamps: Spotlights, placed about the characters' middle: right, up, towards the camera,
            metres. Their ambient light and highlights are not used.
        shadows: Whether the first lamp casts shadows.
        fill: Strength of the light from the camera's side, without shadows.
        ambient: Light that is everywhere.
        specular: Strength of the highlights on the characters.
        shininess: Exponent of the highlights.
        pillar: Place of the bright pillar of the clutter, as a share of the picture's width.
        wall: Distance from the farthest point of the motion to the wall, metres.
    """

    scene: str = "clutter"
    lamps: tuple[Lighting, ...] = (
        lamp((-1.6, 1.9, 2.4), (0.1, -0.1, 0.0), 1.3),
        lamp((2.4, 1.2, 1.0), (0.3, 0.0, -1.0), 0.4),
    )
    shadows: bool = True
    fill: float = 0.15
    ambient: float = 0.05
    specular: float = 0.1
    shininess: float = 18.0
    pillar: float = 0.68
    wall: float = 0.7

    def __post_init__(self) -> None:
        if self.scene not in ("clutter", "dark"):
            raise ConfigurationError(
                f'Style.scene: expected "clutter" or "dark", got {self.scene!r}; scenes are '
                "painted in torchcss/studies/render/clutter.py"
            )


class SceneRenderer:
    """A scene, ready to be photographed again and again with characters in it.

    Args:
        camera: Who looks.
        place: Where the characters are.
        style: Scene and light.
        generator: Source of the scene.

    Raises:
        CameraError: If the camera has a distortion.
    """

    def __init__(
        self, camera: Camera, place: Standpoint, style: Style, *, generator: torch.Generator
    ) -> None:
        if camera.has_distortion:
            raise CameraError(
                f"{camera.name}: pictures can be rendered without distortion only; give a camera "
                "with zero coefficients"
            )
        self.camera = camera
        width, height = camera.image_size_wh
        if style.scene == "clutter":
            painted = clutter_background(height, width, generator=generator, pillar=style.pillar)
        else:
            painted = dark_background(height, width, generator=generator)
        albedo = to_light(painted.double().reshape(-1, 3) / 255)
        axes = _level_axes(camera)
        self._light = _scene_light(style, place.middle, axes)
        self._points, normals = _backdrop(camera, place, axes[2], style.wall)
        matt = replace(
            self._light, lamps=tuple(replace(one, specular=0.0) for one in self._light.lamps)
        )
        self._first, self._others = matt.parts(self._points, normals, albedo, camera.centre_world)

    def picture(self, meshes: Sequence[Mesh]) -> Picture:
        """Take a picture, without sensor noise.

        Args:
            meshes: The characters.
        """
        width, height = self.camera.image_size_wh
        light = self._light.among(meshes)
        reached = 1 - light.covered(self._points)
        shown = to_display(self._others + reached[:, None] * self._first)
        behind = to_bytes(255 * shown.reshape(height, width, 3))
        return render_meshes(meshes, self.camera, background=behind, shade=light.shade)


def level(direction: Tensor) -> Tensor:
    """A direction without its vertical part, as a unit vector."""
    return functional.normalize(direction * direction.new_tensor([1.0, 0.0, 1.0]), dim=-1)


def _level_axes(camera: Camera) -> Float[Tensor, "3 3"]:
    """Axes of the scene in rows: right and towards the camera, both level, and up between them."""
    back = level(-camera.R_camera_world[2])
    up = back.new_tensor([0.0, 1.0, 0.0])
    return torch.stack([torch.linalg.cross(up, back), up, back])


def _backdrop(
    camera: Camera, place: Standpoint, back: Float[Tensor, "3"], wall: float
) -> tuple[Float[Tensor, "i 3"], Float[Tensor, "i 3"]]:
    """What every pixel sees of wall and floor, and the normals there.

    Args:
        camera: Who looks.
        place: Where the characters are.
        back: From the wall to the camera, level.
        wall: Distance from the characters to the wall, metres.
    """
    width, height = camera.image_size_wh
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    ray = camera.rays(torch.stack([column, row], -1).reshape(-1, 2).to(back))
    up, eye = back.new_tensor([0.0, 1.0, 0.0]), camera.centre_world
    corner = place.middle.to(back) - (place.behind + wall) * back
    corner = torch.stack([corner[0], torch.as_tensor(place.floor).to(back), corner[2]])
    # Distances along the rays; what looks away from a plane never meets it.
    to_wall, to_floor = (
        torch.where(ray @ normal < 0, ((corner - eye) @ normal) / (ray @ normal), torch.inf)
        for normal in (back, up)
    )
    distance = to_wall.minimum(to_floor).clamp(max=_FARTHEST_M)
    normals = torch.where((to_floor < to_wall)[:, None], up, back)
    return eye + distance[:, None] * ray, normals


@dataclass(frozen=True)
class _SceneLight:
    """The lamps of a scene; meshes that stand in the light of the first one cast shadows.

    Attributes:
        lamps: All lamps, in the world; the last one is the fill.
        eye: A camera that sees what the first lamp lights; None: there are no shadows.
        depth: Depths of the meshes in its picture.
    """

    lamps: tuple[Lighting, ...]
    eye: Camera | None
    depth: Float[Tensor, "h w"] | None = None

    def among(self, meshes: Sequence[Mesh]) -> _SceneLight:
        """The same light when meshes stand in it."""
        if self.eye is None or not meshes:
            return self
        corners = [mesh.vertices_world for mesh in meshes]
        faces, _ = join_faces([mesh.faces for mesh in meshes], [len(c) for c in corners])
        uv, depth, valid = self.eye.project(torch.cat(corners).double())
        seen = rasterise(uv, depth, faces, _SHADOW_MAP, _SHADOW_MAP, valid=valid)
        return replace(self, depth=seen.depth)

    def covered(self, points: Float[Tensor, "i 3"]) -> Float[Tensor, " i"]:
        """Share of the first lamp that meshes hide from points; a lamp is no point: soft edges."""
        if self.eye is None or self.depth is None:
            return torch.zeros_like(points[:, 0])
        uv, own, valid = self.eye.project(points.double())
        inside = valid & (uv > 2).all(-1) & (uv < _SHADOW_MAP - 3).all(-1)
        column, row = torch.where(inside[:, None], uv, 2.0).round().long().unbind(-1)
        near = range(-2, 3)
        hidden = sum(
            (own > self.depth[row + dv, column + du] + _SHADOW_BIAS).to(points)
            for du in near
            for dv in near
        )
        return torch.where(inside, hidden / len(near) ** 2, 0.0)

    def parts(
        self, points: Tensor, normals: Tensor, albedo: Tensor, eye: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Light of the first lamp where it reaches, and of all others."""
        light = [one.shade(points, normals, albedo, eye).to(points) for one in self.lamps]
        first = (1 - self.covered(points))[:, None] * light[0]
        return first, torch.stack([torch.zeros_like(first), *light[1:]]).sum(0)

    def shade(self, points: Tensor, normals: Tensor, albedo: Tensor, eye: Tensor) -> Tensor:
        """Light that surface points send to the eye; see `Lighting.shade`."""
        first, others = self.parts(points, normals, albedo, eye)
        return first + others


def _scene_light(style: Style, middle: Float[Tensor, "3"], axes: Tensor) -> _SceneLight:
    """The lamps of a style about the characters' middle."""
    # From far away and in all directions alike.
    fill = Lighting(
        lamp_world=(4.0, 5.0, 30.0), lamp=style.fill, cone=100.0, ambient=style.ambient, upward=0.0
    )

    def about(offset: Point) -> Point:
        x, y, z = (middle.to(axes) + axes.new_tensor(offset) @ axes).tolist()
        return x, y, z

    lamps = tuple(
        replace(
            one,
            lamp_world=about(one.lamp_world),
            target_world=about(one.target_world),
            specular=style.specular,
            shininess=style.shininess,
        )
        for one in (*style.lamps, fill)
    )
    if not (style.shadows and style.lamps):
        return _SceneLight(lamps, None)
    focal = 0.5 * _SHADOW_MAP / math.tan(min(1.5 * lamps[0].cone, 1.2))
    eye = look_at(
        lamps[0].lamp_world, lamps[0].target_world, focal_px=focal,
        image_size_wh=(_SHADOW_MAP, _SHADOW_MAP),
    )  # fmt: skip
    return _SceneLight(lamps, eye)


def look_at(
    eye: Sequence[float],
    target: Sequence[float],
    *,
    focal_px: float,
    image_size_wh: tuple[int, int] = (640, 480),
    name: str = "cam01",
) -> Camera:
    """A camera with level rows that looks at a point; Y is up.

    Args:
        eye: Its centre, metres.
        target: What it looks at.
        focal_px: Focal length.
        image_size_wh: Width and height of the picture.
        name: Its name.
    """
    centre = torch.as_tensor(eye, dtype=torch.float64)
    forward = functional.normalize(torch.as_tensor(target, dtype=torch.float64) - centre, dim=-1)
    # Straight up or down no row is level; any will do.
    steep = bool(forward[1].abs() > 0.999)
    up = forward.new_tensor([0.0, 0.0, 1.0] if steep else [0.0, 1.0, 0.0])
    right = functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    K = Camera.pinhole(*image_size_wh, focal_px=focal_px).K
    return Camera(
        K, image_size_wh, R_camera_world=rotation, t_camera_world=-rotation @ centre, name=name
    )
