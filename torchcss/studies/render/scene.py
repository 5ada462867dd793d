"""Scenes to film characters in: what stands where, what is painted on it, light and shadows.

Scenes are made around what the camera sees: `clutter_scene` has a stained back wall and a floor of
boards, and before the wall posters, shelves full of boxes, cartons, leaning rods and bright
pillars, all drawn from a generator, so that an edge tracker finds parallel contours of every
direction and width; `dark_scene` is a dark curtain. A scene is rectangles with pictures on them
(`Scenery`) and `Rod`s, in a frame of its own (`SceneFrame`).

By default: `SceneRenderer(camera, place, style, generator=...)`, then `picture(meshes)` for every
frame. The scene does not move and is drawn once. The light of the first lamp is taken away where
characters stand in it, from the scene and from the characters themselves, by the lamp's own picture
of them (a shadow map).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from torchcss.errors import CameraError, ConfigurationError
from torchcss.studies.render.renderer import (
    Colour,
    Lighting,
    Mesh,
    capsule,
    pool,
    render_meshes,
    to_bytes,
    to_display,
    value_noise,
    visible_surface,
)
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import grid_faces, join_faces, rasterise

_TILE = 128
"""Pixels of the pictures that boxes and posters bear."""

_BEFORE_WALL = 0.32
"""Metres from the wall to the middle of a pillar: before the shelves."""

_CEILING = 4.2
"""Height of wall and pillars, metres."""


class Place(NamedTuple):
    """Where a character is in a scene.

    Attributes:
        middle: Middle of what moves, world frame, metres.
        floor: Height of the floor, metres (Y up).
        behind: How far the motion reaches behind its middle, seen from the camera, metres.
    """

    middle: Float[Tensor, "3"]
    floor: float
    behind: float


class Rod(NamedTuple):
    """A cylinder, in the scene's frame, metres.

    Attributes:
        start: Middle of one end.
        end: Middle of the other.
        radius: Its radius.
        colour: Its display colour.
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float
    colour: Colour


class Scene(NamedTuple):
    """All that stands in a scene.

    Attributes:
        scenery: Walls, floor, boxes.
        rods: Broomsticks and laths.
        pillars: Bright pillars.
    """

    scenery: Scenery
    rods: list[Rod]
    pillars: list[Rod]


class SceneFrame(NamedTuple):
    """The scene's axes: right and towards the camera are level, as seen by the camera.

    Its origin is on the floor under the character's middle.
    """

    origin: Tensor
    axes: Tensor  # rows: right, up, towards the camera

    @classmethod
    def of(cls, camera: Camera, place: Place) -> SceneFrame:
        """The axes of a scene around a place.

        Args:
            camera: Who looks.
            place: Where the characters are.
        """
        back = -camera.R_camera_world[2]
        up = back.new_tensor([0.0, 1.0, 0.0])
        back = functional.normalize(back - up * (back @ up), dim=-1)
        right = torch.linalg.cross(up, back)
        origin = torch.stack(
            [place.middle[0], torch.as_tensor(place.floor).to(up), place.middle[2]]
        )
        return cls(origin.to(up), torch.stack([right, up, back]))

    def points(self, places: Any) -> Float[Tensor, "p 3"]:
        """Places in the scene, in the world."""
        return torch.as_tensor(places).to(self.axes) @ self.axes + self.origin

    def about(self, middle: Tensor, offset: Sequence[float]) -> tuple[float, float, float]:
        """A place given from the characters' middle, in the world."""
        place = middle.to(self.axes) + torch.as_tensor(offset).to(self.axes) @ self.axes
        x, y, z = place.tolist()
        return x, y, z

    def ray(self, camera: Camera, u: float, v: float) -> tuple[Tensor, Tensor]:
        """Where the camera is in the scene, and the direction of a pixel."""
        K = camera.K
        direction = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], K[2, 2]])
        start = self.axes @ (camera.centre_world - self.origin)
        return start, self.axes @ (camera.R_camera_world.mT @ direction)

    def sideways(self, camera: Camera, u: float, depth: float) -> float:
        """How far right a column of the picture meets the plane at `depth`."""
        start, direction = self.ray(camera, u, camera.image_size_wh[1] / 2)
        return float(start[0] + (depth - start[2]) / direction[2] * direction[0])

    def span(self, camera: Camera, depth: float) -> tuple[float, float]:
        """Left and right end of what the camera sees of the plane at `depth`."""
        return self.sideways(camera, 0.0, depth), self.sideways(
            camera, camera.image_size_wh[0], depth
        )

    def height_of_view(self, camera: Camera, depth: float) -> float:
        """How high above the floor the middle of the picture is on the plane at `depth`."""
        width, height = camera.image_size_wh
        start, direction = self.ray(camera, width / 2, height / 2)
        return float(start[1] + (depth - start[2]) / direction[2] * direction[1])


class Draw:
    """Random numbers and colours."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def uniform(self, low: float, high: float) -> float:
        """A number between two."""
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def colour(self, low: float, high: float, saturation: float = 0.55) -> Colour:
        """A colour of a lightness between two."""
        hue = torch.rand(3, generator=self.generator)
        colour = (self.uniform(low, high) * (1 + saturation * (hue - hue.mean()))).clamp(0, 1)
        r, g, b = colour.tolist()
        return r, g, b


class Scenery:
    """Rectangles with pictures on them, in the scene's frame, as one mesh.

    Pictures are colours of vertices.
    """

    def __init__(self, draw: Draw) -> None:
        self.draw = draw
        self.points: list[Tensor] = []
        self.normals: list[Tensor] = []
        self.colours: list[Tensor] = []
        self.faces: list[Tensor] = []
        self.count = 0

    def quad(self, corners: Sequence[Sequence[float]], picture: Tensor, cell: float) -> None:
        """A rectangle, anticlockwise from its lower left; the picture's first row is the top."""
        a, b, _, d = torch.tensor(corners, dtype=torch.float64)
        columns, rows = (max(int((side - a).norm() / cell), 1) + 1 for side in (b, d))
        v, u = torch.meshgrid(
            torch.linspace(0, 1, rows, dtype=a.dtype), torch.linspace(0, 1, columns, dtype=a.dtype),
            indexing="ij",
        )  # fmt: skip
        u, v = u.reshape(-1, 1), v.reshape(-1, 1)
        normal = functional.normalize(torch.linalg.cross(b - a, d - a), dim=-1)
        row = ((1 - v[:, 0]) * (picture.shape[0] - 1)).round().long()
        column = (u[:, 0] * (picture.shape[1] - 1)).round().long()
        at = torch.arange((rows - 1) * columns).view(rows - 1, columns)[:, :-1].reshape(-1)
        at = at + self.count
        self.points.append(a + u * (b - a) + v * (d - a))
        self.normals.append(normal.expand(len(u), 3))
        self.colours.append(picture[row, column])
        self.faces.append(torch.stack([at, at + 1, at + columns + 1], -1))
        self.faces.append(torch.stack([at, at + columns + 1, at + columns], -1))
        self.count += len(u)

    def wall(
        self, left: float, right: float, top: float, depth: float, picture: Tensor, cell: float
    ) -> None:
        """The wall at the back."""
        corners = [(left, 0.0, depth), (right, 0.0, depth), (right, top, depth), (left, top, depth)]
        self.quad(corners, picture, cell)

    def floor(self, wall: float, picture: Tensor, cell: float) -> None:
        """The floor, from before the wall to behind the camera."""
        corners = [(-4.0, 0.0, 5.0), (4.0, 0.0, 5.0), (4.0, 0.0, wall), (-4.0, 0.0, wall)]
        self.quad(corners, picture, cell)

    def box(
        self, x: float, y: float, z: float, wide: float, high: float, deep: float,
        picture: Tensor | None = None,
    ) -> None:  # fmt: skip
        """A box about its middle with the same picture on all sides, a random one by default."""
        picture = self.picture() if picture is None else picture
        a, b, c = wide / 2, high / 2, deep / 2
        for side in (
            [(-a, -b, c), (a, -b, c), (a, b, c), (-a, b, c)],
            [(a, -b, c), (a, -b, -c), (a, b, -c), (a, b, c)],
            [(-a, -b, -c), (-a, -b, c), (-a, b, c), (-a, b, -c)],
            [(-a, b, c), (a, b, c), (a, b, -c), (-a, b, -c)],
            [(-a, -b, -c), (a, -b, -c), (a, -b, c), (-a, -b, c)],
        ):
            self.quad([(x + p, y + q, z + r) for p, q, r in side], picture, 0.006)

    def mesh(self, frame: SceneFrame) -> Mesh:
        """All of it, in the world."""
        return Mesh(
            frame.points(torch.cat(self.points)),
            torch.cat(self.normals) @ frame.axes,
            torch.cat(self.faces),
            torch.cat(self.colours),
        )

    def wood(self) -> Float[Tensor, "h w 3"]:
        """Planks."""
        y, x = _grid(_TILE)
        grain = 1 + 0.15 * (40 * y + 3 * (5 * x).sin()).sin()
        return grain[..., None] * torch.tensor([0.42, 0.29, 0.18])

    def picture(self) -> Float[Tensor, "h w 3"]:
        """Something printed: stripes, patches, rings or lines of text."""
        draw, (y, x) = self.draw, _grid(_TILE)
        picture = torch.tensor(draw.colour(0.15, 0.75)).repeat(_TILE, _TILE, 1)
        kind = int(draw.uniform(0, 4))
        if kind == 0:
            slope, count = draw.uniform(-2, 2), draw.uniform(3, 9)
            stripes = ((x + slope * y) * count).remainder(1.0) < draw.uniform(0.2, 0.6)
            picture[stripes] = torch.tensor(draw.colour(0.1, 0.9))
        elif kind == 1:
            for _ in range(7):
                cx, cy, w, h = (draw.uniform(0, 1) for _ in range(4))
                patch = ((x - cx).abs() < 0.3 * w) & ((y - cy).abs() < 0.3 * h)
                picture[patch] = torch.tensor(draw.colour(0.1, 0.9))
        elif kind == 2:
            cx, cy, count = draw.uniform(0.2, 0.8), draw.uniform(0.2, 0.8), draw.uniform(2, 6)
            reach = ((x - cx) ** 2 + (y - cy) ** 2).sqrt()
            picture[(reach * count).remainder(1.0) < 0.45] = torch.tensor(draw.colour(0.1, 0.9))
        else:
            label = (y > 0.25) & (y < 0.7) & (x > 0.1) & (x < 0.9)
            picture[label] = torch.tensor(draw.colour(0.6, 0.9, 0.3))
            lines = (y > 0.32) & (y < 0.64) & ((y * 24).remainder(1.0) < 0.45)
            lines &= (x > 0.16) & (x < draw.uniform(0.5, 0.84))
            picture[lines] = torch.tensor(draw.colour(0.05, 0.3))
        stain = value_noise(_TILE, _TILE, cell=16, generator=draw.generator)
        return picture * (1 + 0.06 * stain)[..., None]


def _grid(size: int) -> tuple[Tensor, Tensor]:
    """Rows and columns of a square picture, 0 to 1."""
    y, x = torch.meshgrid(*(torch.linspace(0, 1, size),) * 2, indexing="ij")
    return y, x


def _plaster(generator: torch.Generator) -> Float[Tensor, "h w 3"]:
    """A stained wall, dark above a pale rail and pale below it."""
    draw = Draw(generator)
    rows, columns = 420, 640
    stain = value_noise(rows, columns, cell=90, octaves=5, generator=generator)[..., None]
    height = torch.linspace(4.2, 0, rows)[:, None, None]
    upper, lower = (
        torch.tensor(draw.colour(0.35, 0.5, 0.5)),
        torch.tensor(draw.colour(0.5, 0.62, 0.3)),
    )
    wall = torch.where(height > 1.25, upper, lower) * (1 + 0.07 * stain)
    rail = (height > 1.2) & (height < 1.27)
    return torch.where(rail, torch.tensor([0.72, 0.72, 0.70]), wall)


def _boards(generator: torch.Generator) -> Float[Tensor, "h w 3"]:
    """A floor of boards that run away from the camera."""
    draw = Draw(generator)
    rows, columns = 300, 600
    grain = value_noise(rows // 10, columns, cell=6, octaves=3, generator=generator)
    grain = functional.interpolate(grain[None, None], (rows, columns), mode="bilinear")[0, 0]
    across = torch.linspace(0, 42, columns)
    tone = 1 + 0.14 * (across.floor() * 12.9898).sin()
    joint = torch.where(across.remainder(1.0) < 0.06, 0.55, 1.0)
    return ((tone * joint) * (1 + 0.08 * grain))[..., None] * torch.tensor(
        draw.colour(0.3, 0.42, 0.5)
    )


def dark_scene(*, wall: float, generator: torch.Generator) -> Scene:
    """A dark curtain and a dark floor.

    Args:
        wall: Place of the wall, towards the camera from the scene's origin, metres.
        generator: Source of the folds and stains.
    """
    scenery = Scenery(Draw(generator))
    cloth = 0.035 * (1 + 0.25 * value_noise(192, 256, cell=16, generator=generator))
    scenery.wall(-5.0, 5.0, 5.0, wall, cloth[..., None] * _tone(0.95, 0.95, 1.15), cell=0.04)
    boards = 0.05 * (1 + 0.3 * value_noise(128, 128, cell=8, generator=generator))
    scenery.floor(wall, boards[..., None] * _tone(1.1, 1.0, 0.9), cell=0.08)
    return Scene(scenery, [], [])


def clutter_scene(
    camera: Camera,
    frame: SceneFrame,
    *,
    wall: float,
    pillars: Sequence[float],
    pillar_width: float,
    generator: torch.Generator,
) -> Scene:
    """A cluttered scene.

    Args:
        camera: Who looks: things stand where it sees them.
        frame: The scene's axes.
        wall: Place of the wall, towards the camera from the scene's origin, metres.
        pillars: Places of pillars, as shares of the picture's width.
        pillar_width: Their diameter, metres.
        generator: Source of everything.
    """
    draw = Draw(generator)
    left, right = frame.span(camera, wall)
    wide, middle = right - left, frame.height_of_view(camera, wall)
    scenery = Scenery(draw)
    scenery.wall(left - 1.5, right + 1.5, _CEILING, wall, _plaster(generator), cell=0.02)
    scenery.floor(wall, _boards(generator), cell=0.02)
    # Posters in the upper half.
    for _ in range(9):
        x, y = draw.uniform(left, right), middle + draw.uniform(0.05, 0.75) * wide / 2
        w, h = draw.uniform(0.25, 0.5), draw.uniform(0.3, 0.6)
        scenery.box(x, y, wall + 0.012, w, h, 0.01)
    # Shelves, with boxes on them.
    for level in (-0.36, -0.02, 0.34):
        y = middle + level * wide / 2 + draw.uniform(-0.05, 0.05)
        start = left + draw.uniform(0.0, 0.4) * wide
        end = start + draw.uniform(0.35, 0.6) * wide
        plank = scenery.wood()
        scenery.box((start + end) / 2, y - 0.012, wall + 0.11, end - start, 0.024, 0.22, plank)
        x = start + 0.03
        while x < end - 0.1:
            w, h = draw.uniform(0.05, 0.2), draw.uniform(0.08, 0.26)
            deep = draw.uniform(0.08, 0.2)
            scenery.box(x + w / 2, y + h / 2, wall + 0.02 + deep / 2, w, h, deep)
            x += w + (draw.uniform(0.005, 0.02) if draw.uniform(0, 1) < 0.7 else 0.15)
    # Cartons on the floor, before the wall.
    for _ in range(9):
        w, h = draw.uniform(0.25, 0.5), draw.uniform(0.2, 0.5)
        scenery.box(draw.uniform(left, right), h / 2, wall + draw.uniform(0.25, 0.5), w, h, 0.35)
    # Broomsticks and laths that lean against the wall: long edges like those of limbs.
    rods = []
    for _ in range(5):
        x, lean = draw.uniform(left, right), draw.uniform(-0.25, 0.25)
        top = (x + lean, draw.uniform(1.3, 2.2), wall + 0.03)
        rods.append(Rod((x, 0.0, wall + 0.3), top, 0.016, draw.colour(0.2, 0.7)))
    bright = []
    depth = wall + _BEFORE_WALL
    for share in pillars:
        x = frame.sideways(camera, share * camera.image_size_wh[0], depth)
        ends = (x, 0.0, depth), (x, _CEILING, depth)
        bright.append(Rod(*ends, pillar_width / 2, (0.97, 0.97, 0.95)))
    return Scene(scenery, rods, bright)


def _tone(red: float, green: float, blue: float) -> Tensor:
    return torch.tensor([red, green, blue])


# Light, shadows, pictures.

_SHADOW_MAP = 512
"""Pixels of a lamp's picture of what stands in its light."""

_SHADOW_BIAS = 0.025
"""Metres that a point must lie behind what the lamp sees to be in its shadow."""

_SUPERSAMPLE = 2


def lamp(
    place: tuple[float, float, float],
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    strength: float = 0.9,
) -> Lighting:
    """A warm spotlight, placed about the characters' middle."""
    return Lighting(
        lamp_world=place,
        target_world=target,
        lamp=strength,
        cone=0.5,
        ambient=0.0,
        colour=(1.0, 0.97, 0.92),
    )


@dataclass(frozen=True, kw_only=True)
class Style:
    """How a sequence looks.

    Attributes:
        scene: "clutter" or "dark".
        lamps: Spotlights, placed about the characters' middle: right, up, towards the camera,
            metres. The first one casts shadows. Their ambient light and highlights are not used.
        shadows: Whether it does.
        fill: Strength of the light from the camera's side, without shadows.
        ambient: Light that is everywhere.
        specular: Strength of the highlights on the characters.
        shininess: Their exponent.
        pillars: Places of bright pillars, as shares of the picture's width.
        pillar_width: Their diameter, metres.
        wall: Distance from the farthest point of the motion to the wall, metres.
        read_noise: Standard deviation of the sensor's noise in the dark, grey levels.
        shot_noise: Its variance per grey level.
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
    pillars: tuple[float, ...] = (0.68,)
    pillar_width: float = 0.14
    wall: float = 0.7
    read_noise: float = 1.5
    shot_noise: float = 0.02

    def __post_init__(self) -> None:
        if self.scene not in ("clutter", "dark"):
            raise ConfigurationError(
                f'Style.scene: expected "clutter" or "dark", got {self.scene!r}; scenes are drawn '
                "in torchcss/studies/render/scene.py"
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
        self, camera: Camera, place: Place, style: Style, *, generator: torch.Generator
    ) -> None:
        if bool((camera.distortion != 0).any()):
            raise CameraError(
                f"{camera.name}: pictures can be rendered without distortion only; give a camera "
                "with zero coefficients"
            )
        self.camera = camera
        frame, wall = SceneFrame.of(camera, place), -place.behind - style.wall
        if style.scene == "clutter":
            scene = clutter_scene(
                camera, frame, wall=wall, pillars=style.pillars,
                pillar_width=style.pillar_width, generator=generator,
            )  # fmt: skip
        else:
            scene = dark_scene(wall=wall, generator=generator)
        self._light = _SceneLight(style, frame, place)
        meshes = [scene.scenery.mesh(frame)]
        meshes += [_cylinder(rod, frame) for rod in (*scene.rods, *scene.pillars)]
        width, height = camera.image_size_wh
        seen = visible_surface(meshes, self._project, height, width, supersample=_SUPERSAMPLE)
        still = self._light.among(meshes).matt()
        first, others = still.parts(seen.points, seen.normals, seen.albedo, camera.centre_world)
        self._seen, self._first, self._others = seen, first, others

    def picture(self, meshes: Sequence[Mesh]) -> UInt8[Tensor, "h w 3"]:
        """Take a picture, without sensor noise.

        Args:
            meshes: The characters.
        """
        width, height = self.camera.image_size_wh
        light = self._light.among(meshes)
        reached = 1 - light.covered(self._seen.points)
        shown = to_display(self._others + reached[:, None] * self._first)
        behind = to_bytes(255 * pool(shown, self._seen.pixel, height, width, _SUPERSAMPLE))
        return render_meshes(
            meshes, self._project, height, width, background=behind,
            eye_world=self.camera.centre_world, lighting=light, supersample=_SUPERSAMPLE,
        ).image  # fmt: skip

    def _project(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        uv, depth, valid = self.camera.project(points)
        return uv, depth, valid


class _SceneLight:
    """The lamps of a scene; meshes that stand in the light of the first one cast shadows."""

    def __init__(self, style: Style, frame: SceneFrame, place: Place) -> None:
        def put(lamp: Lighting) -> Lighting:
            return replace(
                lamp,
                lamp_world=frame.about(place.middle, lamp.lamp_world),
                target_world=frame.about(place.middle, lamp.target_world),
                specular=style.specular,
                shininess=style.shininess,
            )

        # From far away and in all directions alike.
        fill = Lighting(
            lamp_world=(4.0, 5.0, 30.0),
            lamp=style.fill,
            cone=100.0,
            ambient=style.ambient,
            upward=0.0,
        )
        self.lamps = [put(lamp) for lamp in style.lamps]
        self.fill = put(fill)
        self.shadows = style.shadows and bool(self.lamps)
        if self.shadows:
            self._map = _lamp_camera(self.lamps[0])
        self.depth: Tensor | None = None

    def among(self, meshes: Sequence[Mesh]) -> _SceneLight:
        """The same light when meshes stand in it."""
        other = copy(self)
        if self.shadows and meshes:
            corners = [mesh.vertices_world for mesh in meshes]
            faces, _ = join_faces([mesh.faces for mesh in meshes], [len(c) for c in corners])
            uv, depth, valid = self._map.project(torch.cat(corners).double())
            other.depth = rasterise(
                uv, depth, faces, _SHADOW_MAP, _SHADOW_MAP, valid=valid
            ).depth.double()
        return other

    def matt(self) -> _SceneLight:
        """The same light on surfaces without highlights."""
        other = copy(self)
        other.lamps = [replace(lamp, specular=0.0) for lamp in self.lamps]
        other.fill = replace(self.fill, specular=0.0)
        return other

    def covered(self, points: Float[Tensor, "i 3"]) -> Float[Tensor, " i"]:
        """Share of the first lamp that meshes hide from points; a lamp is no point: soft edges."""
        if self.depth is None:
            return torch.zeros_like(points[:, 0])
        uv, own, valid = self._map.project(points.double())
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
        light = [
            lamp.shade(points, normals, albedo, eye).to(points) for lamp in [*self.lamps, self.fill]
        ]
        if not self.shadows:
            return torch.zeros_like(light[0]), torch.stack(light).sum(0)
        first = (1 - self.covered(points))[:, None] * light[0]
        return first, torch.stack(light[1:]).sum(0)

    def shade(self, points: Tensor, normals: Tensor, albedo: Tensor, eye: Tensor) -> Tensor:
        """Light that surface points send to the eye; see `Light`."""
        first, others = self.parts(points, normals, albedo, eye)
        return first + others


def _lamp_camera(lamp: Lighting) -> Camera:
    """A camera that sees what a lamp lights."""
    start = torch.tensor(lamp.lamp_world, dtype=torch.float64)
    forward = functional.normalize(torch.tensor(lamp.target_world).to(start) - start, dim=-1)
    side = forward.new_tensor([0.0, 1.0, 0.0] if abs(float(forward[1])) < 0.9 else [1.0, 0, 0])
    right = functional.normalize(torch.linalg.cross(forward, side), dim=-1)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    middle = 0.5 * (_SHADOW_MAP - 1)
    focal = 0.5 * _SHADOW_MAP / math.tan(min(1.5 * lamp.cone, 1.2))
    return Camera(
        [[focal, 0, middle], [0, focal, middle], [0, 0, 1]],
        (_SHADOW_MAP, _SHADOW_MAP),
        R_camera_world=rotation,
        t_camera_world=-rotation @ start,
    )


def _cylinder(rod: Rod, frame: SceneFrame) -> Mesh:
    """A rod with round ends, in the world."""
    start, end = frame.points([rod.start, rod.end])
    axis = functional.normalize(end - start, dim=-1)
    points, normals = capsule(rod.radius, 0.5 * float((end - start).norm()), meridians=40)
    side = functional.normalize(
        torch.linalg.cross(axis, frame.axes[0] + 0.1 * frame.axes[2]), dim=-1
    )
    turn = torch.stack([side, torch.linalg.cross(axis, side), axis])
    return Mesh(
        points.flatten(0, 1) @ turn + 0.5 * (start + end),
        normals.flatten(0, 1) @ turn,
        grid_faces(*points.shape[:2]),
        torch.tensor(rod.colour),
    )
