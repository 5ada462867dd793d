"""Rooms to render a figure in: what stands where, and what is painted on it.

Rooms are made around what the camera sees: `clutter_room` has a stained back wall and a floor of
boards, and before the wall posters, shelves full of boxes, cartons, leaning rods and bright
pillars, all drawn from a generator, so that an edge tracker finds parallel contours of every
direction and width; `dark_room` is a dark curtain. A room is rectangles with pictures on them
(`Scenery`) and `Rod`s, in a frame of its own (`RoomFrame`); nothing here knows the renderer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from torchcss.studies.render.character import Colour
from torchcss.studies.render.software import value_noise
from torchcss.vision.camera import Camera

_TILE = 128
"""Pixels of the pictures that boxes and posters bear."""

_BEFORE_WALL = 0.32
"""Metres from the wall to the middle of a pillar: before the shelves."""

_CEILING = 4.2
"""Height of wall and pillars, metres."""


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


class PaintedMesh(NamedTuple):
    """Triangles with colours, world frame, metres.

    Attributes:
        vertices: Their corners.
        normals: Unit outward normals at the corners.
        faces: Indices of the corners of each triangle.
        colour: RGB in 0..1 at the corners.
    """

    vertices: Float[Tensor, "v 3"]
    normals: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    colour: Float[Tensor, "v 3"]


class Rod(NamedTuple):
    """A cylinder, in the room's frame, metres.

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


class Room(NamedTuple):
    """All that stands in a room.

    Attributes:
        scenery: Walls, floor, boxes.
        rods: Broomsticks and laths.
        pillars: Bright pillars.
    """

    scenery: Scenery
    rods: list[Rod]
    pillars: list[Rod]


class RoomFrame(NamedTuple):
    """The room's axes: right and towards the camera are level, as seen by the camera.

    Its origin is on the floor under the figure's middle.
    """

    origin: Tensor
    axes: Tensor  # rows: right, up, towards the camera

    @classmethod
    def of(cls, camera: Camera, place: Place) -> RoomFrame:
        """The axes of a room around a place.

        Args:
            camera: Who looks.
            place: Where the figures are.
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
    """Rectangles with pictures on them, in the room's frame, as one mesh.

    Pictures are colours of vertices and not textures: VTK's shadow maps take a texture for relief.
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

    def mesh(self, frame: RoomFrame) -> PaintedMesh:
        """All of it, in the world."""
        return PaintedMesh(
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


def dark_room(*, wall: float, generator: torch.Generator) -> Room:
    """A dark curtain and a dark floor.

    Args:
        wall: Place of the wall, towards the camera from the room's origin, metres.
        generator: Source of the folds and stains.
    """
    scenery = Scenery(Draw(generator))
    cloth = 0.035 * (1 + 0.25 * value_noise(192, 256, cell=16, generator=generator))
    scenery.wall(-5.0, 5.0, 5.0, wall, cloth[..., None] * _tone(0.95, 0.95, 1.15), cell=0.04)
    boards = 0.05 * (1 + 0.3 * value_noise(128, 128, cell=8, generator=generator))
    scenery.floor(wall, boards[..., None] * _tone(1.1, 1.0, 0.9), cell=0.08)
    return Room(scenery, [], [])


def clutter_room(
    camera: Camera,
    frame: RoomFrame,
    *,
    wall: float,
    pillars: Sequence[float],
    pillar_width: float,
    generator: torch.Generator,
) -> Room:
    """A cluttered room.

    Args:
        camera: Who looks: things stand where it sees them.
        frame: The room's axes.
        wall: Place of the wall, towards the camera from the room's origin, metres.
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
        bright.append(Rod(*ends, pillar_width / 2, (0.86, 0.86, 0.84)))
    return Room(scenery, rods, bright)


def _tone(red: float, green: float, blue: float) -> Tensor:
    return torch.tensor([red, green, blue])
