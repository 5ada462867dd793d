"""Pictures of a figure in a room, by pyvista (VTK) off screen.

A `Stage` holds a room, its lights and one or more meshes that change from frame to frame, seen by a
`torchcss.vision.camera.Camera`. Rooms are made around what the camera sees: a back wall and a floor
with uneven light on them, and before the wall posters, shelves full of boxes, cartons and a bright
pillar, all drawn from a generator; or nothing but a dark curtain.

The room does not move and is drawn once. In every frame the figures are drawn over it, and the
first lamp's light is taken away where they stand in it: on the room's surfaces and on the figures
themselves, by the lamp's own picture of them (a shadow map).

The picture is drawn at twice the size and averaged, so that edges are smooth and a pixel is what a
sensor's would be. VTK's window is laid so that pixel centres are at integers, as in the camera: the
silhouette agrees with `torchcss.raster.rasterise` to a fraction of a pixel, which a test measures.
Masks, flow and occlusion therefore come from the rasteriser (`torchcss.synthetic`), not from here.

pyvista is the extra `render`; it is imported where it is used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from torchcss.errors import CameraError, ConfigurationError
from torchcss.figure import Colour, load_pyvista
from torchcss.raster import join_faces, rasterise, value_noise
from torchcss.vision.camera import Camera

_SUPERSAMPLE = 2
_NEAR, _FAR = 0.05, 30.0
"""Metres from the camera between which things are drawn."""

_SHADOW_MAP = 512
"""Pixels of a lamp's picture of the figures."""

_SHADOW_BIAS = 0.025
"""Metres that a point must lie behind what the lamp sees to be in its shadow."""

_OWN_SHADOW = 0.6
"""Share of its lightness that a figure loses in its own shadow."""

_TILE = 128
"""Pixels of the pictures that boxes and posters bear."""


@dataclass(frozen=True, kw_only=True)
class Lamp:
    """A spotlight, placed in the room's frame about the figure.

    Attributes:
        place: Where it stands: right, up, towards the camera, metres from the figure's middle.
        target: What it points at, the same way.
        strength: Brightness on its axis.
        cone: Half angle of its cone, degrees.
        softness: Exponent of its fading from the axis to the edge of the cone.
        colour: Its colour.
    """

    place: tuple[float, float, float]
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    strength: float = 0.8
    cone: float = 40.0
    softness: float = 8.0
    colour: Colour = (1.0, 0.97, 0.92)


@dataclass(frozen=True, kw_only=True)
class Style:
    """How a sequence looks.

    Attributes:
        room: "clutter" or "dark".
        lamps: Spotlights; the first ones cast shadows.
        shadows: Whether lamps cast shadows.
        fill: Strength of the light from the camera's side, without shadows.
        ambient: Light that is everywhere.
        specular: Strength of the highlights on the figure.
        shininess: Their exponent.
        pillars: Places of bright pillars, as shares of the picture's width.
        pillar_width: Their diameter, metres.
        wall: Distance from the farthest point of the motion to the wall, metres.
        read_noise: Standard deviation of the sensor's noise in the dark, grey levels.
        shot_noise: Its variance per grey level.
    """

    room: str = "clutter"
    lamps: tuple[Lamp, ...] = (
        Lamp(place=(-1.6, 1.9, 2.4), target=(0.1, -0.1, 0.0), strength=1.0, cone=40.0),
        Lamp(place=(2.4, 1.2, 1.0), target=(0.3, 0.0, -1.0), strength=0.5, cone=45.0),
    )
    shadows: bool = True
    fill: float = 0.28
    ambient: float = 0.2
    specular: float = 0.22
    shininess: float = 18.0
    pillars: tuple[float, ...] = (0.68,)
    pillar_width: float = 0.14
    wall: float = 0.7
    read_noise: float = 1.5
    shot_noise: float = 0.02

    def __post_init__(self) -> None:
        if self.room not in ("clutter", "dark"):
            raise ConfigurationError(
                f'Style.room: expected "clutter" or "dark", got {self.room!r}; rooms are drawn in '
                "torchcss/render.py"
            )


class Place(NamedTuple):
    """Where a figure is in a room.

    Attributes:
        middle: Middle of what moves, world frame, metres.
        floor: Height of the floor, metres (Y up).
        behind: How far the motion reaches behind its middle, seen from the camera, metres.
    """

    middle: Float[Tensor, "3"]
    floor: float
    behind: float


class Stage:
    """A room with figures, ready to be photographed again and again.

    Args:
        camera: Who looks; without distortion.
        place: Where the figures are.
        style: Room and light.
        generator: Source of the room.

    Raises:
        CameraError: If the camera has a distortion, which a projective renderer cannot draw.
        MissingExtraError: If pyvista is not installed.
    """

    def __init__(
        self, camera: Camera, place: Place, style: Style, *, generator: torch.Generator
    ) -> None:
        pyvista = load_pyvista()
        if bool((camera.distortion != 0).any()):
            raise CameraError(
                f"{camera.name}: pictures can be rendered without distortion only; give a camera "
                "with zero coefficients"
            )
        self._pyvista, self._style = pyvista, style
        self._frame = _RoomFrame.of(camera, place)
        self._plotter = self._make_plotter(camera)
        if style.room == "clutter":
            self._add_clutter(camera, place, generator)
        else:
            self._add_dark(place, generator)
        lights = self._add_lights(place, shadows=style.shadows)
        self._room = self._screenshot()[..., :3]
        self._shadow: _Shadow | None = None
        if style.shadows and lights:
            points, seen = self._seen_points(camera)
            lights[0].intensity = 0.0
            key = (self._room - self._screenshot()[..., :3]).clamp(min=0)
            lamp = style.lamps[0]
            self._shadow = _Shadow(
                self._frame.about(place.middle, lamp.place),
                self._frame.about(place.middle, lamp.target),
                lamp.cone,
                points,
                key * seen[..., None],
            )
        self._plotter.close()
        # The room stays as it is; only the figures are drawn again and again.
        self._plotter = self._make_plotter(camera)
        self._add_lights(place, shadows=False)
        self._meshes: list[Any] = []
        self._colours: list[Tensor] = []
        self._faces: list[Tensor] = []

    def _make_plotter(self, camera: Camera) -> Any:
        width, height = camera.image_size_wh
        # Without a display VTK tries X11 first and says so on the console; it then finds EGL.
        with self._pyvista.vtk_verbosity("off"):
            plotter = self._pyvista.Plotter(
                off_screen=True,
                window_size=(_SUPERSAMPLE * width, _SUPERSAMPLE * height),
                lighting="none",
            )
        plotter.set_background("black")
        # The averaging smooths the edges already, and would otherwise be paid for eight times.
        plotter.render_window.SetMultiSamples(0)
        _set_camera(plotter.camera, camera)
        return plotter

    def _screenshot(self) -> Float[Tensor, "h w 4"]:
        """Red, green, blue and coverage at the large size, 0 to 255."""
        self._plotter.camera.clipping_range = (_NEAR, _FAR)
        self._plotter.render()
        large = self._plotter.screenshot(transparent_background=True, return_img=True)
        return torch.from_numpy(np.array(large)).float()

    def add(self, faces: Tensor, colour: Float[Tensor, "v 3"]) -> int:
        """Add a mesh whose corners will move; returns its number.

        Args:
            faces: Corner indices of the triangles.
            colour: Display colour of every vertex, 0 to 1.
        """
        mesh = self._pyvista.PolyData.from_regular_faces(
            np.zeros((len(colour), 3), np.float32), faces.cpu().numpy()
        )
        mesh.point_data["Normals"] = np.zeros((len(colour), 3), np.float32)
        mesh.point_data.active_normals_name = "Normals"
        mesh.point_data["colour"] = _to_bytes(colour)
        self._draw(mesh, scalars="colour", rgb=True, specular=self._style.specular,
                   specular_power=self._style.shininess)  # fmt: skip
        self._meshes.append(mesh)
        self._colours.append(colour)
        self._faces.append(faces)
        return len(self._meshes) - 1

    def move(
        self, mesh: int, vertices: Float[Tensor, "v 3"], normals: Float[Tensor, "v 3"]
    ) -> None:
        """Move the corners of a mesh.

        Args:
            mesh: The number that `add` gave.
            vertices: World frame, metres.
            normals: Outward, unit.
        """
        target = self._meshes[mesh]
        target.points = vertices.float().cpu().numpy()
        target.point_data["Normals"] = normals.float().cpu().numpy()
        target.Modified()

    def picture(self) -> UInt8[Tensor, "h w 3"]:
        """Take a picture, without sensor noise."""
        room = self._room
        if self._shadow is not None and self._meshes:
            room = self._cast(self._shadow)
        drawn = self._screenshot()
        covered = drawn[..., 3:] / 255
        large = drawn[..., :3] * covered + room * (1 - covered)
        pooled = functional.avg_pool2d(large.permute(2, 0, 1)[None], _SUPERSAMPLE)
        return pooled[0].permute(1, 2, 0).round().to(torch.uint8)

    def _cast(self, shadow: _Shadow) -> Tensor:
        """Darken the figures where they shade themselves; return the room with their shadow."""
        corners = [torch.from_numpy(mesh.points) for mesh in self._meshes]
        faces, _ = join_faces(self._faces, [len(points) for points in corners])
        depth = shadow.map(torch.cat(corners), faces)
        for mesh, points, colour in zip(self._meshes, corners, self._colours, strict=True):
            lit = 1 - _OWN_SHADOW * shadow.of_points(points, depth)[:, None]
            mesh.point_data["colour"] = _to_bytes(colour * lit)
        return self._room - shadow.of_room(depth)

    def _seen_points(self, camera: Camera) -> tuple[Float[Tensor, "h w 3"], Tensor]:
        """What the room's pixels show, in the world, and which of them show anything."""
        depth = torch.from_numpy(-np.array(self._plotter.get_image_depth())).double()
        seen = depth.isfinite()
        rows, columns = depth.shape
        v, u = torch.meshgrid(
            torch.arange(rows).double(), torch.arange(columns).double(), indexing="ij"
        )
        u, v = ((x + 0.5) / _SUPERSAMPLE - 0.5 for x in (u, v))
        K = camera.K
        ray = torch.stack(
            [(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], -1
        )
        local = ray * torch.where(seen, depth, 1.0)[..., None] - camera.t_camera_world
        return local @ camera.R_camera_world, seen.float()

    def close(self) -> None:
        """Free the window."""
        self._plotter.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Lights and scenery.

    def _draw(self, mesh: Any, **options: Any) -> None:
        options = {
            "smooth_shading": False,
            "ambient": self._style.ambient,
            "diffuse": 1.0,
        } | options
        actor = self._plotter.add_mesh(mesh, show_scalar_bar=False, reset_camera=False, **options)
        if mesh.point_data.active_normals_name is not None:
            actor.prop.interpolation = "phong"

    def _add_lights(self, place: Place, *, shadows: bool) -> list[Any]:
        """Add the lamps and the fill; returns the lamps."""
        lights = []
        for lamp in self._style.lamps:
            light = self._pyvista.Light(
                position=self._frame.about(place.middle, lamp.place),
                focal_point=self._frame.about(place.middle, lamp.target),
                color=lamp.colour,
                intensity=lamp.strength,
                light_type="scene light",
                positional=True,
                cone_angle=lamp.cone,
                exponent=lamp.softness,
            )
            self._plotter.add_light(light)
            lights.append(light)
        if shadows:
            self._plotter.enable_shadows()
        if self._style.fill > 0:
            self._plotter.add_light(
                self._pyvista.Light(
                    position=self._frame.about(place.middle, (0.4, 0.5, 3.0)),
                    focal_point=place.middle.tolist(),
                    intensity=self._style.fill,
                    light_type="scene light",
                    positional=False,
                )
            )
        return lights

    def _add_dark(self, place: Place, generator: torch.Generator) -> None:
        wall = -place.behind - self._style.wall
        scenery = _Scenery(_Draw(generator))
        cloth = 0.035 * (1 + 0.25 * value_noise(192, 256, cell=16, generator=generator))
        cloth = cloth[..., None] * torch.tensor([0.95, 0.95, 1.15])
        scenery.wall(-5.0, 5.0, 5.0, wall, cloth, cell=0.04)
        boards = 0.05 * (1 + 0.3 * value_noise(128, 128, cell=8, generator=generator))
        scenery.floor(wall, boards[..., None] * torch.tensor([1.1, 1.0, 0.9]), cell=0.08)
        self._draw(scenery.mesh(self._pyvista, self._frame), scalars="colour", rgb=True)

    def _add_clutter(self, camera: Camera, place: Place, generator: torch.Generator) -> None:
        draw = _Draw(generator)
        wall = -place.behind - self._style.wall
        left, right = self._frame.span(camera, wall)
        wide = right - left
        scenery = _Scenery(draw)
        scenery.wall(left - 1.5, right + 1.5, 4.2, wall, _plaster(generator), cell=0.02)
        scenery.floor(wall, _boards(generator), cell=0.02)
        middle = self._frame.height_of_view(camera, wall)
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
            wood = scenery.wood()
            scenery.box((start + end) / 2, y - 0.012, wall + 0.11, end - start, 0.024, 0.22, wood)
            x = start + 0.03
            while x < end - 0.1:
                w, h = draw.uniform(0.05, 0.2), draw.uniform(0.08, 0.26)
                deep = draw.uniform(0.08, 0.2)
                scenery.box(x + w / 2, y + h / 2, wall + 0.02 + deep / 2, w, h, deep)
                x += w + (draw.uniform(0.005, 0.02) if draw.uniform(0, 1) < 0.7 else 0.15)
        # Cartons on the floor, before the wall.
        for _ in range(9):
            w, h = draw.uniform(0.25, 0.5), draw.uniform(0.2, 0.5)
            scenery.box(
                draw.uniform(left, right), h / 2, wall + draw.uniform(0.25, 0.5), w, h, 0.35
            )
        self._draw(scenery.mesh(self._pyvista, self._frame), scalars="colour", rgb=True,
                   specular=0.08)  # fmt: skip
        # Broomsticks and laths that lean against the wall: long edges like those of limbs.
        for _ in range(5):
            x, lean = draw.uniform(left, right), draw.uniform(-0.25, 0.25)
            self._rod((x, 0.0, wall + 0.3), (x + lean, draw.uniform(1.3, 2.2), wall + 0.03), 0.016,
                      draw.colour(0.2, 0.7))  # fmt: skip
        for share in self._style.pillars:
            x = self._frame.sideways(camera, share * camera.image_size_wh[0], wall + 0.32)
            self._rod((x, 0.0, wall + 0.32), (x, 4.2, wall + 0.32), self._style.pillar_width / 2,
                      (0.86, 0.86, 0.84), ambient=0.4)  # fmt: skip

    def _rod(self, start: Sequence[float], end: Sequence[float], radius: float, colour: Colour,
             *, ambient: float | None = None) -> None:  # fmt: skip
        a, b = self._frame.points([start, end]).tolist()
        axis = np.subtract(b, a)
        rod = self._pyvista.Cylinder(
            center=np.add(a, b) / 2,
            direction=axis,
            radius=radius,
            height=float(np.linalg.norm(axis)),
            resolution=40,
        )
        rod = rod.triangulate().compute_normals(split_vertices=True, feature_angle=40.0)
        more = {} if ambient is None else {"ambient": ambient}
        self._draw(rod, color=colour, specular=0.25, specular_power=25.0, **more)


class _RoomFrame(NamedTuple):
    """The room's axes: right and towards the camera are level, as seen by the camera.

    Its origin is on the floor under the figure's middle.
    """

    origin: Tensor
    axes: Tensor  # rows: right, up, towards the camera

    @classmethod
    def of(cls, camera: Camera, place: Place) -> _RoomFrame:
        back = -camera.R_camera_world[2]
        up = back.new_tensor([0.0, 1.0, 0.0])
        back = functional.normalize(back - up * (back @ up), dim=-1)
        right = torch.linalg.cross(up, back)
        origin = torch.stack(
            [place.middle[0], torch.as_tensor(place.floor).to(up), place.middle[2]]
        )
        return cls(origin.to(up), torch.stack([right, up, back]))

    def points(self, places: Any) -> Float[Tensor, "p 3"]:
        """Places in the room, in the world."""
        return torch.as_tensor(places).to(self.axes) @ self.axes + self.origin

    def about(self, middle: Tensor, offset: Sequence[float]) -> list[float]:
        """A place given from the figure's middle, in the world."""
        return (middle.to(self.axes) + torch.as_tensor(offset).to(self.axes) @ self.axes).tolist()

    def ray(self, camera: Camera, u: float, v: float) -> tuple[Tensor, Tensor]:
        """Where the camera is in the room, and the direction of a pixel."""
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


class _Draw:
    """Random numbers and colours."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def uniform(self, low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def colour(self, low: float, high: float, saturation: float = 0.55) -> Colour:
        hue = torch.rand(3, generator=self.generator)
        colour = (self.uniform(low, high) * (1 + saturation * (hue - hue.mean()))).clamp(0, 1)
        r, g, b = colour.tolist()
        return r, g, b


class _Shadow:
    """The shadow of meshes in the light of one lamp.

    All of the room is taken to be behind the figures as seen from the lamp, which is how the rooms
    are laid out; only a figure asks how deep it is.

    Args:
        place: Where the lamp is, world frame.
        target: What it points at.
        cone: Half angle of its cone, degrees.
        points: What every pixel of the room's picture shows.
        light: What the lamp adds to it.
    """

    def __init__(
        self,
        place: Sequence[float],
        target: Sequence[float],
        cone: float,
        points: Float[Tensor, "h w 3"],
        light: Float[Tensor, "h w 3"],
    ) -> None:
        forward = torch.as_tensor(target, dtype=torch.float64) - torch.as_tensor(place)
        forward = functional.normalize(forward, dim=-1)
        side = forward.new_tensor([0.0, 1.0, 0.0] if abs(float(forward[1])) < 0.9 else [1.0, 0, 0])
        right = functional.normalize(torch.linalg.cross(forward, side), dim=-1)
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        focal = 0.5 * _SHADOW_MAP / math.tan(math.radians(min(cone, 70.0)))
        middle = 0.5 * (_SHADOW_MAP - 1)
        self.camera = Camera(
            [[focal, 0, middle], [0, focal, middle], [0, 0, 1]],
            (_SHADOW_MAP, _SHADOW_MAP),
            R_camera_world=rotation,
            t_camera_world=-rotation @ torch.as_tensor(place, dtype=torch.float64),
        )
        uv, _, valid = self.camera.project(points)
        place_in_map = torch.where(valid[..., None], uv / middle - 1, 9.0)
        self.room, self.light = place_in_map.float(), light

    def map(self, points: Float[Tensor, "v 3"], faces: Tensor) -> Float[Tensor, "s s"]:
        """Depth of meshes as the lamp sees them."""
        uv, depth, valid = self.camera.project(points.double())
        return rasterise(uv, depth, faces, _SHADOW_MAP, _SHADOW_MAP, valid=valid).depth

    def of_room(self, depth: Float[Tensor, "s s"]) -> Float[Tensor, "h w 3"]:
        """Light that the room loses; a lamp is no point, so that the edge is soft."""
        covered = depth.isfinite().float()[None, None]
        soft = functional.avg_pool2d(covered, 5, stride=1, padding=2)
        share = functional.grid_sample(soft, self.room[None], align_corners=True)[0, 0]
        return share[..., None] * self.light

    def of_points(
        self, points: Float[Tensor, "v 3"], depth: Float[Tensor, "s s"]
    ) -> Float[Tensor, " v"]:
        """Share of the lamp that is hidden from points of the meshes themselves."""
        uv, own, _ = self.camera.project(points.double())
        column, row = uv.round().long().clamp(2, _SHADOW_MAP - 3).unbind(-1)
        hidden = [
            own > depth[row + dv, column + du] + _SHADOW_BIAS
            for du in (-2, -1, 0, 1, 2)
            for dv in (-2, -1, 0, 1, 2)
        ]
        return torch.stack(hidden).float().mean(0)


class _Scenery:
    """Rectangles with pictures on them, in the room's frame, as one mesh.

    Pictures are colours of vertices and not textures: VTK's shadow maps take a texture for relief.
    """

    def __init__(self, draw: _Draw) -> None:
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

    def mesh(self, pyvista: Any, frame: _RoomFrame) -> Any:
        """All of it, in the world."""
        points = frame.points(torch.cat(self.points))
        mesh = pyvista.PolyData.from_regular_faces(
            points.float().numpy(), torch.cat(self.faces).numpy()
        )
        mesh.point_data["Normals"] = (torch.cat(self.normals) @ frame.axes).float().numpy()
        mesh.point_data.active_normals_name = "Normals"
        mesh.point_data["colour"] = _to_bytes(torch.cat(self.colours))
        return mesh

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
    draw = _Draw(generator)
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
    draw = _Draw(generator)
    rows, columns = 300, 600
    grain = value_noise(rows // 10, columns, cell=6, octaves=3, generator=generator)
    grain = functional.interpolate(grain[None, None], (rows, columns), mode="bilinear")[0, 0]
    across = torch.linspace(0, 42, columns)
    tone = 1 + 0.14 * (across.floor() * 12.9898).sin()
    joint = torch.where(across.remainder(1.0) < 0.06, 0.55, 1.0)
    return ((tone * joint) * (1 + 0.08 * grain))[..., None] * torch.tensor(
        draw.colour(0.3, 0.42, 0.5)
    )


def _to_bytes(colour: Float[Tensor, "*v 3"]) -> np.ndarray:
    return (255 * colour).round().clamp(0, 255).to(torch.uint8).cpu().numpy()


def _set_camera(view: Any, camera: Camera) -> None:
    """Give VTK's camera the place, the focal lengths and the pixel grid of ours."""
    width, height = camera.image_size_wh
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    centre, rotation = camera.centre_world, camera.R_camera_world
    view.position = centre.tolist()
    view.focal_point = (centre + rotation[2]).tolist()
    view.up = (-rotation[1]).tolist()
    view.view_angle = math.degrees(2 * math.atan(0.5 * height / fy))
    # Pixel 0 reaches from -0.5 to 0.5, so that the window's middle is at (size - 1) / 2.
    view.SetWindowCenter(-2 * (cx + 0.5) / width + 1, 2 * (cy + 0.5) / height - 1)
    view.SetUseExplicitAspectRatio(True)
    view.SetExplicitAspectRatio(width * fy / (height * fx))
    view.clipping_range = (_NEAR, _FAR)
