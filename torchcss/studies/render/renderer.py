"""Pictures of a figure in a room, by pyvista (VTK) off screen.

A `Stage` holds a room, its lights and one or more meshes that change from frame to frame, seen by a
`torchcss.vision.camera.Camera`. The rooms are those of `torchcss.studies.render.scene`.

The room does not move and is drawn once. In every frame the figures are drawn over it, and the
first lamp's light is taken away where they stand in it: on the room's surfaces and on the figures
themselves, by the lamp's own picture of them (a shadow map).

The picture is drawn at twice the size and averaged, so that edges are smooth and a pixel is what a
sensor's would be. VTK's window is laid so that pixel centres are at integers, as in the camera: the
silhouette agrees with `torchcss.vision.rasterise.rasterise` to a fraction of a pixel, which a test
measures. Masks, flow and occlusion therefore come from the rasteriser
(`torchcss.studies.render.sequences`), not from here.

pyvista is the extra `render`; it is imported where it is used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from torchcss.errors import CameraError, ConfigurationError
from torchcss.studies.render.character import Colour, load_pyvista
from torchcss.studies.render.scene import Place, Room, RoomFrame, clutter_room, dark_room
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import join_faces, rasterise

_SUPERSAMPLE = 2
_NEAR, _FAR = 0.05, 30.0
"""Metres from the camera between which things are drawn."""

_SHADOW_MAP = 512
"""Pixels of a lamp's picture of the figures."""

_SHADOW_BIAS = 0.025
"""Metres that a point must lie behind what the lamp sees to be in its shadow."""

_OWN_SHADOW = 0.6
"""Share of its lightness that a figure loses in its own shadow."""


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
                "torchcss/studies/render/renderer.py"
            )


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
        self._frame = RoomFrame.of(camera, place)
        self._plotter = self._make_plotter(camera)
        wall = -place.behind - style.wall
        if style.room == "clutter":
            room = clutter_room(
                camera, self._frame, wall=wall, pillars=style.pillars,
                pillar_width=style.pillar_width, generator=generator,
            )  # fmt: skip
        else:
            room = dark_room(wall=wall, generator=generator)
        self._furnish(room)
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
        nowhere = torch.zeros_like(colour)
        mesh = self._new_mesh(nowhere, nowhere, faces, colour)
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

    def _furnish(self, room: Room) -> None:
        mesh = room.scenery.mesh(self._frame)
        drawn = self._new_mesh(mesh.vertices, mesh.normals, mesh.faces, mesh.colour)
        self._draw(drawn, scalars="colour", rgb=True, specular=0.08)
        for rods, more in ((room.rods, {}), (room.pillars, {"ambient": 0.4})):
            for rod in rods:
                a, b = self._frame.points([rod.start, rod.end]).tolist()
                axis = np.subtract(b, a)
                cylinder = self._pyvista.Cylinder(
                    center=np.add(a, b) / 2,
                    direction=axis,
                    radius=rod.radius,
                    height=float(np.linalg.norm(axis)),
                    resolution=40,
                )
                cylinder = cylinder.triangulate().compute_normals(
                    split_vertices=True, feature_angle=40.0
                )
                self._draw(cylinder, color=rod.colour, specular=0.25, specular_power=25.0, **more)

    def _new_mesh(self, vertices: Tensor, normals: Tensor, faces: Tensor, colour: Tensor) -> Any:
        mesh = self._pyvista.PolyData.from_regular_faces(
            vertices.float().cpu().numpy(), faces.cpu().numpy()
        )
        mesh.point_data["Normals"] = normals.float().cpu().numpy()
        mesh.point_data.active_normals_name = "Normals"
        mesh.point_data["colour"] = _to_bytes(colour)
        return mesh


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
