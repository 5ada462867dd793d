"""The renderer: triangle meshes in, a picture out, on plain torch.

What is seen is found by `torchcss.vision.rasterise`. Light is ambient, plus a lamp with a soft cone
(hence uneven) that gives Lambert's diffuse term and Blinn's highlight `(n . h)^shininess`, h
halfway between the directions to the lamp and to the eye; it is evaluated per sample, on
interpolated normals.

Call `render_meshes`: it draws meshes before a background with antialiased silhouettes.
`random_texture` makes a cloth, `add_sensor_noise` the grain of a sensor. Scenes are in
`torchcss.studies.render.scene`, exact labels in `torchcss.studies.render.mesh_truth`.

Axis letters here, besides those of `torchcss.types`: `v` vertices, `f` triangles, `h w` image rows
and columns, `i` listed samples or points. Images are uint8 RGB, `[h w 3]`; pixel centres are at
integers; colours given as numbers are display values from 0 to 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from torchcss.errors import check_shape
from torchcss.types import frozen
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import interpolate, join_faces, rasterise

READ, SHOT = 1.5, 0.02
"""Noise of the sensor: deviation in the dark, grey levels, and variance per level of signal."""

_GAMMA = 2.2
"""Exponent between display values and light."""

Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""

Point = tuple[float, float, float]
"""A place in the world, metres."""

Picture = UInt8[Tensor, "h w 3"]

Triples = Float[Tensor, "i 3"]
"""Three numbers of listed samples or points: place (metres), normal, colour or light."""

Texture = Callable[[Triples], Float[Tensor, "i 1"]]
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

    def moved(self, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]) -> Mesh:
        """The mesh of a part that was at the world's origin where the part is now."""
        return self._replace(
            vertices_world=self.vertices_world @ rotation.T + translation,
            normals_world=self.normals_world @ rotation.T,
            points_part=self.vertices_world,
        )


Shade = Callable[[Triples, Triples, Triples, Tensor], Triples]
"""What lights surfaces: `Lighting.shade`, or that of the lamps of a scene with their shadows."""


@frozen
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
        colour: Colour of the lamp.
    """

    lamp_world: Point = (-1.5, 2.5, 2.5)
    target_world: Point = (0.0, 0.0, 0.0)
    cone: float = 0.6
    lamp: float = 0.9
    ambient: float = 0.25
    upward: float = 0.5
    specular: float = 0.12
    shininess: float = 20.0
    colour: Colour = (1.0, 1.0, 1.0)

    def shade(
        self, points: Triples, normals: Triples, albedo: Triples, eye: Float[Tensor, "3"]
    ) -> Triples:
        """Light that surface points send to the eye.

        Args:
            points: Surface points, metres.
            normals: Outward normals of any length.
            albedo: Share of the light that is sent back, 0 to 1 (light, not display values).
            eye: Where the camera is, metres.

        Returns:
            Light, not clipped; 1 is white.
        """
        lamp = points.new_tensor(self.lamp_world)
        axis = functional.normalize(points.new_tensor(self.target_world) - lamp, dim=-1)
        normal = functional.normalize(normals, dim=-1)
        to_lamp = functional.normalize(lamp - points, dim=-1)
        to_eye = functional.normalize(eye.to(points) - points, dim=-1)
        halfway = functional.normalize(to_lamp + to_eye, dim=-1)

        # 2 (1 - cos) is the squared angle near the axis and never needs an inverse cosine.
        spread = 2 * (1 + (to_lamp * axis).sum(-1, keepdim=True))
        beam = self.lamp * torch.exp(-spread / self.cone**2) * points.new_tensor(self.colour)
        facing = (normal * to_lamp).sum(-1, keepdim=True).clamp_min(0)
        highlight = (normal * halfway).sum(-1, keepdim=True).clamp_min(0) ** self.shininess
        ambient = self.ambient * (1 + self.upward * normal[:, 1:2])
        # The highlight vanishes with the facing term, or it would glow beyond the shadow line.
        return albedo * (ambient + beam * facing) + beam * self.specular * highlight * facing


class Waves(NamedTuple):
    """Sine waves through space: the weave and the creases of a cloth.

    Attributes:
        vectors: Direction and angular frequency of every wave, radians per metre.
        phases: Phase of every wave, radians.
    """

    vectors: Float[Tensor, "m 3"]
    phases: Float[Tensor, " m"]

    def angles(self, points: Triples) -> Float[Tensor, "i m"]:
        """Where in its period every wave is at some points, radians."""
        return points @ self.vectors.to(points).T + self.phases.to(points)


def random_waves(
    count: int,
    shortest: float,
    longest: float,
    *,
    generator: torch.Generator,
    dtype: torch.dtype = torch.float32,
) -> Waves:
    """Draw waves in random directions.

    Args:
        count: How many.
        shortest: Shortest wavelength, metres.
        longest: Longest wavelength, metres; wavelengths are spread evenly in logarithm.
        generator: Source of randomness.
        dtype: Floating type.
    """
    direction = torch.randn(count, 3, generator=generator, dtype=dtype)
    share = torch.linspace(0, 1, count, dtype=dtype)
    wavelength = shortest * (longest / shortest) ** share
    phases = 2 * math.pi * torch.rand(count, generator=generator, dtype=dtype)
    direction = functional.normalize(direction, dim=-1)
    return Waves(2 * math.pi / wavelength[:, None] * direction, phases)


def random_texture(
    *,
    generator: torch.Generator,
    contrast: float = 0.25,
    shortest: float = 0.02,
    longest: float = 0.15,
) -> Texture:
    """Draw a cloth texture with detail at every scale that a tracker of a limb can see.

    Args:
        generator: Source of randomness.
        contrast: Standard deviation of the factor on the colour, which is about 1.
        shortest: Shortest wavelength, metres.
        longest: Longest wavelength, metres.
    """
    waves = random_waves(7, shortest, longest, generator=generator)
    # A sine of amplitude a has the variance a^2 / 2.
    amplitudes = torch.full_like(waves.phases, contrast * (2 / len(waves.phases)) ** 0.5)

    def texture(points: Triples) -> Float[Tensor, "i 1"]:
        shade = waves.angles(points).sin() @ amplitudes.to(points)[:, None]
        return (1 + shade).clamp_min(0.1)

    return texture


def render_meshes(
    meshes: Sequence[Mesh], camera: Camera, *, background: Picture, shade: Shade | None = None
) -> Picture:
    """Draw meshes before a background.

    The picture is rendered with two samples per pixel and axis, and averaged.

    Args:
        meshes: What to draw.
        camera: Who looks.
        background: What is behind the meshes, of the camera's image size.
        shade: The light on the meshes; that of the default lamp when absent.

    Raises:
        ShapeError: If a mesh or the background has the wrong shape.
    """
    width, height = camera.image_size_wh
    check_shape("background", background, height, width, 3)
    if not meshes:
        return background.clone()
    values = _at_vertices(meshes)
    faces, owner = join_faces(
        [mesh.faces for mesh in meshes], [len(mesh.vertices_world) for mesh in meshes]
    )
    uv, depth, valid = camera.project(values[:, :3])
    rows, columns = 2 * height, 2 * width
    fine = rasterise((uv + 0.5) * 2 - 0.5, depth, faces, rows, columns, valid=valid)
    sample = torch.nonzero(fine.face.view(-1) >= 0)[:, 0]
    face, weights = fine.face.view(-1)[sample], fine.barycentric.view(-1, 3)[sample]
    points, normals, albedo, local = interpolate(values, faces, face, weights).split(3, -1)
    factor = torch.ones_like(albedo[:, :1])
    for index, mesh in enumerate(meshes):
        if mesh.texture is not None:
            here = torch.nonzero(owner[face] == index)[:, 0]
            factor[here] = mesh.texture(local[here]).to(factor)
    albedo = (albedo * factor).clamp(0, 1)
    light = (shade or Lighting().shade)(points, normals, albedo, camera.centre_world)
    # Colours and coverage of all samples, 0 where nothing is seen, averaged over the pixels.
    canvas = light.new_zeros(rows * columns, 4)
    canvas[sample] = torch.cat((to_display(light), torch.ones_like(light[:, :1])), -1)
    canvas = canvas.view(1, rows, columns, 4).permute(0, 3, 1, 2)
    pooled = functional.avg_pool2d(canvas, 2)[0].permute(1, 2, 0)
    return to_bytes(pooled[..., :3] * 255 + (1 - pooled[..., 3:]) * background.to(pooled))


def to_display(light: Triples) -> Triples:
    """Display values of light, 0 to 1."""
    return light.clamp(0, 1) ** (1 / _GAMMA)


def to_light(display: Triples) -> Triples:
    """Light of display values."""
    return display**_GAMMA


def _at_vertices(meshes: Sequence[Mesh]) -> Float[Tensor, "v 12"]:
    """Position, normal, light of the colour and place in the part of all vertices of all meshes."""
    values = []
    for index, mesh in enumerate(meshes):
        vertices, size = mesh.vertices_world, len(mesh.vertices_world)
        check_shape(f"vertices_world of mesh {index}", vertices, size, 3)
        check_shape(f"normals_world of mesh {index}", mesh.normals_world, size, 3)
        check_shape(f"colour of mesh {index}", mesh.colour, 3)
        albedo = to_light(mesh.colour.to(vertices)).expand(size, 3)
        local = vertices if mesh.points_part is None else mesh.points_part
        values.append(torch.cat([vertices, mesh.normals_world, albedo, local], -1))
    return torch.cat(values)


def capsule(
    radius: float, half_length: float
) -> tuple[Float[Tensor, "rings meridians 3"], Float[Tensor, "rings meridians 3"]]:
    """Nodes and unit normals of a cylinder with round ends, along z about the origin.

    Args:
        radius: Metres.
        half_length: Half the length of the cylinder, metres.
    """
    rings = meridians = 24  # of the rings, half on either end
    # The poles themselves are left out, as in the meshes of the parts.
    latitude = (torch.arange(rings, dtype=torch.float64) + 0.5) / rings * math.pi - math.pi / 2
    longitude = torch.arange(meridians, dtype=torch.float64) * (2 * math.pi / meridians)
    up, around = torch.meshgrid(latitude, longitude, indexing="ij")
    normals = torch.stack([up.cos() * around.cos(), up.cos() * around.sin(), up.sin()], -1)
    points = radius * normals
    points[..., 2] += half_length * up.sign()
    return points, normals


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
    total = torch.zeros(height, width)
    for octave in range(octaves):
        size = max(cell / 2**octave, 1.0)
        rows, columns = int(height / size) + 2, int(width / size) + 2
        grid = torch.randn(1, 1, rows, columns, generator=generator)
        smooth = functional.interpolate(grid, (height, width), mode="bicubic", align_corners=True)
        total += smooth[0, 0] * 0.5**octave
    return total


def to_bytes(image: Float[Tensor, "h w 3"]) -> Picture:
    """Round grey levels from 0 to 255."""
    return image.round().clamp(0, 255).to(torch.uint8)


def add_sensor_noise(image: Picture, *, generator: torch.Generator) -> Picture:
    """Add the noise of a sensor: Gaussian, with the variance `READ^2 + SHOT * grey level`.

    Args:
        image: The clean picture.
        generator: Source of randomness.
    """
    clean = image.float()
    noise = torch.randn(clean.shape, generator=generator)
    return to_bytes(clean + noise * (READ**2 + SHOT * clean).sqrt())
