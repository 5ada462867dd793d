"""A small software renderer: triangle meshes in, pictures and exact labels out.

The synthetic sequences and the overlays need shaded triangle meshes with a correct z-buffer, and
need nothing else of a renderer; torch alone is enough for that. This module knows nothing of
bodies and cameras: it takes meshes, and a function that projects points.

**Visibility.** `rasterise` walks every triangle's pixel rows. With its corners sorted by row, a
triangle covers in row `y` the columns between its long edge and one of its two short edges, each

    x(y) = x_a + (y - y_a) (x_b - x_a) / (y_b - y_a),      y_a <= y < y_b,

and a pixel centre belongs to the half-open span `ceil(x_left) <= column < ceil(x_right)`. Two
triangles that share an edge evaluate the same expression on the same numbers, so a closed mesh has
neither cracks nor pixels covered twice. The nearest surface wins by inverse depth, which is an
affine function of the pixel, so that depth and barycentric coordinates are perspective-correct.
The work is proportional to the number of covered pixels, counted once per layer.

**Shading.** `shade` is ambient light from above, plus a lamp with a soft cone (hence uneven) that
gives Lambert's diffuse term and Blinn's highlight `(n . h)^shininess`, h halfway between the
directions to the lamp and to the eye. It is evaluated per pixel, on interpolated normals.

By default call `render_meshes`: it draws meshes before a background with antialiased silhouettes
and returns the picture with mask, part and depth at the pixel centres. `clutter_background` makes a
room to draw in, `random_texture` a cloth, `add_sensor_noise` the grain of a sensor.

Axis letters here, besides those of `torchcss.types`: `v` vertices, `f` triangles, `h w` image rows
and columns, `i` listed pixels or points. Images are uint8 RGB, `[h w 3]`; pixel centres are at
integers; colours given as numbers are display values from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from torchcss.errors import ConfigurationError, check_shape
from torchcss.vision.rasterise import interpolate, join_faces, rasterise

_GAMMA = 2.2
"""Exponent between display values and light."""

Projection = Callable[
    [Float[Tensor, "v 3"]],
    tuple[Float[Tensor, "v 2"], Float[Tensor, " v"], Bool[Tensor, " v"]],
]
"""World points to pixel `uv`, depth along the optical axis (metres), and whether to use them."""

Texture = Callable[[Float[Tensor, "i 3"]], Float[Tensor, "i 1"]]
"""Part coordinates (metres) to a factor on the colour."""


class Mesh(NamedTuple):
    """A triangle mesh to be drawn, world frame, metres.

    Attributes:
        vertices_world: Corner positions.
        normals_world: Outward normals; any length.
        faces: Corner indices of the triangles.
        colour: Display colour 0 to 1, one for the mesh or one per vertex.
        points_part: Vertices in the part's own frame, where `texture` is evaluated.
        texture: Factor on the colour as a function of `points_part`; plain when absent.
    """

    vertices_world: Float[Tensor, "v 3"]
    normals_world: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    colour: Float[Tensor, "*v 3"]
    points_part: Float[Tensor, "v 3"] | None = None
    texture: Texture | None = None


class RenderedFrame(NamedTuple):
    """A picture with its ground truth.

    Attributes:
        image: RGB picture, silhouettes antialiased.
        mask: True where the pixel centre sees a mesh.
        part: Which mesh of the sequence it sees, -1 for the background.
        depth: Depth of what it sees, `inf` for the background.
    """

    image: UInt8[Tensor, "h w 3"]
    mask: Bool[Tensor, "h w"]
    part: Int[Tensor, "h w"]
    depth: Float[Tensor, "h w"]


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """A lamp with a soft cone, and ambient light that comes mostly from above.

    Attributes:
        lamp_world: Position of the lamp, metres, world frame (Y up).
        target_world: Where the middle of its cone points.
        cone: Angle from the axis, radians, at which the lamp has faded to 1/e; it is what makes
            the light uneven.
        lamp: Strength of the lamp at the target; there is no falloff with distance.
        ambient: Strength of the light from everywhere.
        upward: Share of the ambient light that depends on how far up a surface looks, 0 to 1.
        specular: Strength of the highlight; near 0 for cloth.
        shininess: Exponent of the highlight.
    """

    lamp_world: tuple[float, float, float] = (-1.5, 2.5, 2.5)
    target_world: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cone: float = 0.6
    lamp: float = 0.9
    ambient: float = 0.25
    upward: float = 0.5
    specular: float = 0.12
    shininess: float = 20.0


class SineTexture(NamedTuple):
    """A sum of sine waves through space, the weave and the creases of a cloth.

    Attributes:
        wave_vectors: Direction and angular frequency of every wave, radians per metre.
        phases: Phase of every wave, radians.
        amplitudes: Amplitude of every wave; they are summed, so keep the total below 1.
    """

    wave_vectors: Float[Tensor, "m 3"]
    phases: Float[Tensor, " m"]
    amplitudes: Float[Tensor, " m"]

    def __call__(self, points_part: Float[Tensor, "i 3"]) -> Float[Tensor, "i 1"]:
        """Return the factor on the colour at points of the part, around 1."""
        angle = points_part @ self.wave_vectors.to(points_part).T + self.phases.to(points_part)
        return (1 + angle.sin() @ self.amplitudes.to(points_part)[:, None]).clamp_min(0.1)


def random_texture(
    *,
    generator: torch.Generator,
    contrast: float = 0.25,
    shortest: float = 0.02,
    longest: float = 0.15,
    num_waves: int = 7,
) -> SineTexture:
    """Draw a cloth texture with detail at every scale that a tracker of a limb can see.

    Args:
        generator: Source of randomness.
        contrast: Standard deviation of the factor on the colour.
        shortest: Shortest wavelength, metres.
        longest: Longest wavelength, metres; wavelengths are spread evenly in logarithm.
        num_waves: Number of waves.

    Raises:
        ConfigurationError: If the wavelengths are not positive and ordered, or there are no waves.
    """
    if not 0 < shortest <= longest or num_waves < 1:
        raise ConfigurationError(
            "random_texture: expected 0 < shortest <= longest and num_waves >= 1, got "
            f"{shortest}, {longest} and {num_waves}; wavelengths are in metres"
        )
    device = generator.device
    direction = functional.normalize(
        torch.randn(num_waves, 3, generator=generator, device=device), dim=-1
    )
    share = torch.linspace(0, 1, num_waves, device=device)
    wavelength = shortest * (longest / shortest) ** share
    phases = 2 * torch.pi * torch.rand(num_waves, generator=generator, device=device)
    # A sine of amplitude a has the variance a^2 / 2.
    amplitude = contrast * (2 / num_waves) ** 0.5
    return SineTexture(
        wave_vectors=direction * (2 * torch.pi / wavelength)[:, None],
        phases=phases,
        amplitudes=torch.full_like(phases, amplitude),
    )


def shade(
    points_world: Float[Tensor, "i 3"],
    normals_world: Float[Tensor, "i 3"],
    albedo: Float[Tensor, "i 3"],
    *,
    eye_world: Float[Tensor, "3"],
    lighting: Lighting,
) -> Float[Tensor, "i 3"]:
    """Light that surface points send to the eye.

    Args:
        points_world: Surface points, metres.
        normals_world: Outward normals of any length.
        albedo: Share of the light that is sent back, 0 to 1 (light, not display values).
        eye_world: Where the camera is, metres.
        lighting: The lamp and the ambient light.

    Returns:
        Light, not clipped; 1 is white.
    """
    lamp = points_world.new_tensor(lighting.lamp_world)
    axis = functional.normalize(points_world.new_tensor(lighting.target_world) - lamp, dim=-1)
    normal = functional.normalize(normals_world, dim=-1)
    to_lamp = functional.normalize(lamp - points_world, dim=-1)
    to_eye = functional.normalize(eye_world.to(points_world) - points_world, dim=-1)
    halfway = functional.normalize(to_lamp + to_eye, dim=-1)

    # 2 (1 - cos) is the squared angle near the axis and never needs an inverse cosine.
    spread = 2 * (1 + (to_lamp * axis).sum(-1, keepdim=True))
    beam = lighting.lamp * torch.exp(-spread / lighting.cone**2)
    facing = (normal * to_lamp).sum(-1, keepdim=True).clamp_min(0)
    highlight = (normal * halfway).sum(-1, keepdim=True).clamp_min(0) ** lighting.shininess
    ambient = lighting.ambient * (1 + lighting.upward * normal[:, 1:2])
    # The highlight vanishes with the facing term, or it would glow beyond the shadow line.
    return albedo * (ambient + beam * facing) + beam * lighting.specular * highlight * facing


def render_meshes(
    meshes: Sequence[Mesh],
    project: Projection,
    height: int,
    width: int,
    *,
    background: UInt8[Tensor, "h w 3"],
    eye_world: Float[Tensor, "3"],
    lighting: Lighting | None = None,
    supersample: int = 2,
) -> RenderedFrame:
    """Draw meshes before a background.

    The picture is rendered at `supersample` times the resolution and averaged; mask, part and
    depth are those at the pixel centres, found separately, so that they are exact.

    Args:
        meshes: What to draw.
        project: The camera.
        height: Rows of the picture.
        width: Columns of the picture.
        background: What is behind the meshes.
        eye_world: Where the camera is, for the highlights, metres.
        lighting: The light on the meshes; the default lamp when absent.
        supersample: Samples per pixel and axis.

    Raises:
        ShapeError: If a mesh or the background has the wrong shape.
        ConfigurationError: If `supersample` is less than 1.
    """
    check_shape("background", background, height, width, 3)
    if supersample < 1:
        raise ConfigurationError(f"supersample: expected at least 1, got {supersample}; 2 is usual")
    for index, mesh in enumerate(meshes):
        size = mesh.vertices_world.shape[0]
        check_shape(f"vertices_world of mesh {index}", mesh.vertices_world, size, 3)
        check_shape(f"normals_world of mesh {index}", mesh.normals_world, size, 3)
        check_shape(f"colour of mesh {index}", mesh.colour, 3)
    if not meshes:
        nothing = torch.full((height, width), -1, device=background.device)
        far = torch.full_like(nothing, torch.inf, dtype=torch.float32)
        return RenderedFrame(background.clone(), nothing >= 0, nothing, far)

    vertices = torch.cat([mesh.vertices_world for mesh in meshes])
    normals = torch.cat([mesh.normals_world for mesh in meshes])
    colours = torch.cat(
        [mesh.colour.to(vertices).expand(mesh.vertices_world.shape[0], 3) for mesh in meshes]
    )
    points_part = torch.cat(
        [mesh.vertices_world if mesh.points_part is None else mesh.points_part for mesh in meshes]
    )
    faces, owner = join_faces(
        [mesh.faces for mesh in meshes], [mesh.vertices_world.shape[0] for mesh in meshes]
    )
    uv, depth, valid = project(vertices)

    labels = rasterise(uv, depth, faces, height, width, valid=valid)
    mask = labels.face >= 0
    part = torch.where(mask, owner[labels.face.clamp_min(0)], labels.face)

    fine_height, fine_width = height * supersample, width * supersample
    fine = rasterise(
        (uv + 0.5) * supersample - 0.5, depth, faces, fine_height, fine_width, valid=valid
    )
    pixel = torch.nonzero(fine.face.view(-1) >= 0)[:, 0]
    face, weights = fine.face.view(-1)[pixel], fine.barycentric.view(-1, 3)[pixel]
    at_pixel = interpolate(
        torch.cat((vertices, normals, colours**_GAMMA, points_part), -1), faces, face, weights
    )
    points, normal, albedo, local = at_pixel.split(3, -1)
    factor = torch.ones_like(albedo[:, :1])
    for index, mesh in enumerate(meshes):
        if mesh.texture is not None:
            here = torch.nonzero(owner[face] == index)[:, 0]
            factor[here] = mesh.texture(local[here]).to(factor)
    light = shade(
        points,
        normal,
        (albedo * factor).clamp(0, 1),
        eye_world=eye_world,
        lighting=lighting or Lighting(),
    )
    display = light.clamp(0, 1) ** (1 / _GAMMA)

    canvas = display.new_zeros(fine_height * fine_width, 4)
    canvas[pixel] = torch.cat((display, torch.ones_like(display[:, :1])), -1)
    pooled = functional.avg_pool2d(
        canvas.view(1, fine_height, fine_width, 4).permute(0, 3, 1, 2), supersample
    )[0].permute(1, 2, 0)
    seen = pooled[..., :3] * 255 + (1 - pooled[..., 3:]) * background.to(pooled)
    return RenderedFrame(
        image=_to_bytes(seen),
        mask=mask,
        part=part,
        depth=labels.depth,
    )


def value_noise(
    height: int, width: int, *, cell: float, octaves: int = 3, generator: torch.Generator
) -> Float[Tensor, "h w"]:
    """Smooth noise with standard deviation about 1: random grids, interpolated and summed.

    Args:
        height: Rows.
        width: Columns.
        cell: Size of the coarsest cell, pixels.
        octaves: Number of grids; each has half the cell and half the amplitude of the one before.
        generator: Source of randomness.
    """
    total = torch.zeros(height, width, device=generator.device)
    for octave in range(octaves):
        size = max(cell / 2**octave, 1.0)
        grid = torch.randn(
            1, 1, int(height / size) + 2, int(width / size) + 2,
            generator=generator, device=generator.device,
        )  # fmt: skip
        smooth = functional.interpolate(grid, (height, width), mode="bicubic", align_corners=True)
        total += smooth[0, 0] * 0.5**octave
    return total


def clutter_background(
    height: int, width: int, *, generator: torch.Generator
) -> UInt8[Tensor, "h w 3"]:
    """Paint a cluttered and unevenly lit room: what an edge tracker finds hardest.

    A wall with posters, shelves of books, a window with blinds, a bright pillar, a floor of boards
    and boxes on it: hard edges of every direction and length, many of them parallel pairs like
    those of a limb, over a light that falls off across the picture. Where things stand and how
    they look is random; the kinds of things are the same for every seed.

    Args:
        height: Rows.
        width: Columns.
        generator: Source of randomness; its device is the picture's.
    """
    painter = _Painter(2 * height, 2 * width, generator)  # twice the size, averaged at the end
    aspect, floor = width / height, painter.uniform(0.78, 0.86)
    painter.wall(floor)
    painter.window(painter.uniform(0.0, 0.1) * aspect, painter.uniform(0.06, 0.14), aspect / 4)
    painter.poster(painter.uniform(0.36, 0.42) * aspect, painter.uniform(0.08, 0.16))
    painter.poster(painter.uniform(0.10, 0.22) * aspect, painter.uniform(0.54, 0.58))
    painter.shelves(painter.uniform(0.66, 0.70) * aspect, aspect * 0.97, floor)
    painter.pillar(painter.uniform(0.56, 0.60) * aspect, 0.055 * aspect)
    for left in (0.03, 0.30, 0.44):
        painter.carton(painter.uniform(left, left + 0.08) * aspect, painter.uniform(0.9, 0.97))
    return painter.develop()


class _Painter:
    """A canvas of light `[3, h, w]`; lengths are in image heights, so a picture scales whole."""

    def __init__(self, rows: int, columns: int, generator: torch.Generator) -> None:
        self.generator = generator
        self.y = ((torch.arange(rows, device=generator.device) + 0.5) / rows)[:, None]
        self.x = ((torch.arange(columns, device=generator.device) + 0.5) / rows)[None]
        self.canvas = torch.zeros(3, rows, columns, device=generator.device)

    def uniform(self, low: float, high: float) -> float:
        draw = torch.rand((), generator=self.generator, device=self.generator.device)
        return low + (high - low) * float(draw)

    def colour(self, low: float, high: float, saturation: float) -> Tensor:
        """A random colour of lightness between `low` and `high`."""
        hue = torch.rand(3, generator=self.generator, device=self.generator.device)
        level = self.uniform(low, high)
        return (level * (1 + saturation * (hue - hue.mean()))).clamp(0, 1)

    def brown(self, low: float, high: float) -> Tensor:
        """A random colour of wood or cardboard."""
        warmth = self.uniform(0.1, 0.4)
        tone = self.canvas.new_tensor([1 + warmth, 1.0, 1 - warmth])
        return self.uniform(low, high) * tone

    def fill(self, inside: Tensor, colour: Tensor, shading: Tensor | float = 1.0) -> None:
        """Paint `colour` times `shading` where `inside`."""
        shading = torch.as_tensor(shading, device=self.canvas.device)
        self.canvas = torch.where(inside, colour[:, None, None] * shading, self.canvas)

    def box(self, left: float, right: float, top: float, bottom: float) -> Tensor:
        return (self.x > left) & (self.x < right) & (self.y > top) & (self.y < bottom)

    def wall(self, floor: float) -> None:
        rows, columns = self.canvas.shape[1:]
        stain = value_noise(rows, columns, cell=rows / 3, octaves=4, generator=self.generator)
        everywhere = torch.ones_like(stain, dtype=torch.bool)
        self.fill(everywhere, self.colour(0.40, 0.5, 0.25), 1 + 0.05 * stain)
        # Boards that run away from the viewer: their joints meet at a point above the floor.
        board = (self.x - self.x.mean()) / (self.y - floor + 0.35).clamp_min(0.1) * 5
        tone = 1 + 0.25 * (board.floor() * 12.9898).sin()
        joint = torch.where((board - board.floor()) < 0.05, 0.45, 1.0)
        self.fill(self.y.expand_as(stain) > floor, self.brown(0.2, 0.3), tone * joint)
        self.fill(self.box(-1, 9, floor - 0.03, floor), self.colour(0.5, 0.6, 0.1))
        self.fill(self.box(-1, 9, floor, floor + 0.006), self.colour(0.05, 0.06, 0.1))

    def window(self, left: float, top: float, size: float) -> None:
        right, bottom = left + size, top + 0.36
        self.fill(self.box(left, right, top, bottom), self.colour(0.6, 0.7, 0.1))
        slats = torch.where((self.y * self.uniform(28, 36)) % 1 < 0.3, 0.45, 1.0)
        pane = self.box(left + 0.015, right - 0.015, top + 0.015, bottom - 0.015)
        sky = 1 - 0.3 * (self.y - top)
        self.fill(pane, self.colour(0.75, 0.85, 0.1), slats * sky)
        middle = (left + right) / 2
        self.fill(self.box(middle - 0.008, middle + 0.008, top, bottom), self.colour(0.3, 0.4, 0.1))

    def poster(self, left: float, top: float) -> None:
        wide, high = self.uniform(0.16, 0.22), self.uniform(0.2, 0.26)
        tilt = self.uniform(-0.08, 0.08)
        across, down = self.x - left + tilt * (self.y - top), self.y - top - tilt * (self.x - left)
        sheet = (across > 0) & (across < wide) & (down > 0) & (down < high)
        shadow = (across > 0.008) & (across < wide + 0.008) & (down > 0.008) & (down < high + 0.008)
        self.canvas = torch.where(shadow, self.canvas * 0.6, self.canvas)
        self.fill(sheet, self.colour(0.7, 0.85, 0.3))
        edge = 0.014
        inner = (across > edge) & (across < wide - edge) & (down > edge) & (down < high - edge)
        self.fill(inner, self.colour(0.25, 0.45, 1.2))
        slope, period = self.uniform(-1.5, 1.5), self.uniform(0.04, 0.07)
        stripes = ((across + slope * down) / period) % 1 < 0.45
        self.fill(inner & stripes, self.colour(0.4, 0.7, 1.0))
        reach = ((across - wide / 2) ** 2 + (down - high / 2.4) ** 2).sqrt()
        self.fill(inner & (reach < wide * 0.3), self.colour(0.15, 0.8, 0.8))
        self.fill(inner & (reach < wide * 0.15), self.colour(0.15, 0.8, 0.8))

    def shelves(self, left: float, right: float, floor: float) -> None:
        top, count = 0.12, 3
        pitch = (floor - 0.03 - top) / count
        wood = self.brown(0.22, 0.34)
        self.fill(self.box(left, right, top, floor + 0.02), wood * 0.45)
        for shelf in range(count):
            base, x = top + (shelf + 1) * pitch - 0.015, left + 0.02
            while x < right - 0.07:
                thick = self.uniform(0.014, 0.042)
                lean = self.uniform(-0.12, 0.12) if self.uniform(0, 1) < 0.2 else 0.0
                high = pitch * self.uniform(0.5, 0.85)
                across = self.x - x + lean * (self.y - base)
                spine = (across > 0) & (across < thick) & (self.y > base - high) & (self.y < base)
                # Rounded backs: lit from the left.
                self.fill(spine, self.colour(0.12, 0.6, 1.0), 1.15 - 0.5 * across / thick)
                label = self.uniform(0.15, 0.7)
                band = spine & ((self.y - base + high * label).abs() < 0.012)
                self.fill(band, self.colour(0.5, 0.8, 0.4))
                x += thick + (0.03 if self.uniform(0, 1) < 0.15 else 0.002)
            self.fill(self.box(left, right, base, base + 0.02), wood)
        for side in (left, right - 0.018):
            self.fill(self.box(side, side + 0.018, top - 0.01, floor + 0.02), wood * 1.2)
        self.fill(self.box(left, right, top - 0.015, top), wood * 1.2)

    def pillar(self, left: float, wide: float) -> None:
        shadow = self.box(left + wide, left + 1.5 * wide, 0, 0.95)
        self.canvas = torch.where(shadow, self.canvas * 0.65, self.canvas)
        round_ = ((self.x - left) / wide * 2 - 0.8).clamp(-1, 1.2)
        self.fill(
            self.box(left, left + wide, -1, 0.96), self.colour(0.8, 0.85, 0.1), 1 - 0.4 * round_**2
        )

    def carton(self, left: float, bottom: float) -> None:
        wide, high, deep = self.uniform(0.16, 0.24), self.uniform(0.1, 0.2), 0.045
        top = bottom - high
        brown = self.brown(0.35, 0.5)
        self.fill(self.box(left, left + wide, top, bottom), brown)
        across = (self.x - left - wide) / deep
        side = (across > 0) & (across < 1) & (self.y > top - deep * across)
        self.fill(side & (self.y < bottom - deep * across), brown * 0.55)
        lift = (top - self.y) / deep
        lid = (lift > 0) & (lift < 1) & (self.x > left + deep * lift)
        self.fill(lid & (self.x < left + wide + deep * lift), brown * 1.3)
        tape = self.x - left - 0.45 * wide
        self.fill((tape > 0) & (tape < 0.03) & (self.y > top) & (self.y < bottom), brown * 1.5)
        print_ = self.box(left + 0.015, left + 0.06, bottom - 0.05, bottom - 0.015)
        self.fill(print_ & ((self.y * 110) % 1 < 0.5), brown * 0.3)

    def develop(self) -> UInt8[Tensor, "h w 3"]:
        """Light the room unevenly, average to the final size, and round."""
        rows, columns = self.canvas.shape[1:]
        blotch = value_noise(rows, columns, cell=rows / 2, octaves=2, generator=self.generator)
        grain = value_noise(rows, columns, cell=rows / 60, octaves=2, generator=self.generator)
        x0, y0 = self.uniform(0.2, 0.5) * columns / rows, self.uniform(0.2, 0.4)
        pool = torch.exp(-(((self.x - x0) / 0.7) ** 2) - ((self.y - y0) / 0.55) ** 2)
        light = (0.5 + 0.62 * pool) * (1 + 0.06 * blotch) * (1 + 0.02 * grain)
        picture = functional.avg_pool2d((self.canvas * light)[None].clamp(0, 1), 2)[0]
        return _to_bytes(255 * picture.permute(1, 2, 0))


def _to_bytes(image: Float[Tensor, "h w 3"]) -> UInt8[Tensor, "h w 3"]:
    """Round grey levels from 0 to 255."""
    return image.round().clamp(0, 255).to(torch.uint8)


def add_sensor_noise(
    image: UInt8[Tensor, "h w 3"],
    *,
    generator: torch.Generator,
    read: float = 1.5,
    shot: float = 0.02,
) -> UInt8[Tensor, "h w 3"]:
    """Add the noise of a sensor: Gaussian, with the variance `read^2 + shot * grey level`.

    Args:
        image: The clean picture.
        generator: Source of randomness, on the picture's device.
        read: Standard deviation in the dark, grey levels.
        shot: Variance per grey level of signal.

    Raises:
        ConfigurationError: If a strength is negative.
    """
    if read < 0 or shot < 0:
        raise ConfigurationError(
            f"sensor noise: expected read >= 0 and shot >= 0, got {read} and {shot}"
        )
    clean = image.float()
    noise = torch.randn(clean.shape, generator=generator, device=clean.device)
    return _to_bytes(clean + noise * (read**2 + shot * clean).sqrt())
