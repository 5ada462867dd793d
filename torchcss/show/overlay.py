"""Tracked bodies drawn over the frames of a video.

Every mode of the tracker explains the picture in its own way, and the overlay shows them together:
the best mode as translucent shaded parts with a crisp outline each, what is hidden behind other
parts of the same body as dashes, and every other mode as a thin outline, fainter the less it
weighs. Each mode has its own colour, from the palette of Okabe and Ito, which colour-blind viewers
can tell apart.

Outlines come from rasterised part labels: a lattice point between four pixels belongs to an
outline where their labels differ; smoothing that lattice with a Gaussian gives the distance to the
outline, and with it an antialiased line of constant width. Only the bodies' bounding boxes are
worked on, and bodies that fill a large frame are rasterised more coarsely, so that a frame costs a
fraction of a second whatever its size.

Call `draw_poses` with the best mode first, or `draw_overlay` with what `project_body` gives. Pixels
as everywhere: centres at integers, u counts columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor
from torch.nn import functional

from torchcss.body.model import BodyModel
from torchcss.errors import ConfigurationError, ShapeError, check_shape
from torchcss.show.style import OKABE_ITO
from torchcss.types import ColourImage
from torchcss.vision.camera import Camera
from torchcss.vision.rasterise import (
    Fragments,
    grid_faces,
    interpolate,
    nearest_faces,
    rasterise,
    vertex_normals,
)

Picture = UInt8[Tensor, "h w 3"]
"""Red, green and blue."""

PartLabels = Int[Tensor, "r s"]
"""Part of the body, or triangle, of every coarse pixel; -1 where there is none."""

_ORDER = ("sky", "orange", "purple", "green", "vermilion", "yellow", "blue")
PALETTE = tuple(tuple(bytes.fromhex(OKABE_ITO[name].removeprefix("#"))) for name in _ORDER)
"""Colours of the modes, RGB, best mode first: Okabe and Ito's set without black."""


def palette_colour(mode: int) -> tuple[int, ...]:
    """The colour of the mode of a rank, RGB: the best one has its own, the others' come round."""
    return PALETTE[1 + (mode - 1) % (len(PALETTE) - 1)] if mode else PALETTE[0]


_RINGS, _MERIDIANS = 16, 20
"""Latitudes and longitudes of the mesh of a part."""

_FILL, _HIDDEN, _FAINTEST = 0.45, 0.6, 0.35
"""Opacity of the best mode's surface, of the dashes of hidden outlines, and of the outline of a
mode that weighs nothing; one that weighs as much as the best is opaque."""

_RESOLUTION = 300_000
"""Pixels of the best mode's bounding box that are rasterised at most; larger boxes are rasterised
more coarsely. The others' thin lines need a third."""

_STEPS = 0.25
"""Square coarse pixels: how far the cracks of a raster, enlarged, scatter about the true line:
1/12 for rounding to pixels and 1/6 for interpolating between them."""


class ProjectedBody(NamedTuple):
    """The mesh of a body in one pose as a camera sees it: one explanation of the picture.

    Attributes:
        uv: Projected vertices, pixels.
        depth: Their depth along the optical axis, metres.
        valid: Which of them may be used (in front of the camera).
        faces: Corner indices of the triangles.
        part: Which part of the body every triangle is of; every part has one outline.
    """

    uv: Float[Tensor, "v 2"]
    depth: Float[Tensor, " v"]
    valid: Bool[Tensor, " v"]
    faces: Int[Tensor, "f 3"]
    part: Int[Tensor, " f"]

    @property
    def in_front(self) -> Float[Tensor, "u 2"]:
        """Those vertices that may be used, pixels."""
        return self.uv[self.valid & (self.depth > 0)]

    def alone(self, part: int) -> ProjectedBody:
        """One part of it."""
        chosen = self.part == part
        faces = self.faces[chosen]
        own = torch.zeros_like(self.valid).index_fill(0, faces.flatten(), True)
        return self._replace(valid=self.valid & own, faces=faces, part=self.part[chosen])

    def parts_seen(self, face: PartLabels) -> PartLabels:
        """The part of every pixel's triangle, -1 where there is none."""
        if not len(self.part):
            return face
        return torch.where(face >= 0, self.part[face.clamp_min(0)], -1)


class _Window(NamedTuple):
    """The part of the frame that a body can touch, and how coarsely it is rasterised."""

    top: int
    left: int
    height: int
    width: int
    scale: float

    @property
    def coarse(self) -> tuple[int, int]:
        return max(round(self.height * self.scale), 1), max(round(self.width * self.scale), 1)

    def of(self, picture: Shaped[Tensor, "H W *c"], more: int = 0) -> Shaped[Tensor, "h w *c"]:
        """This part of a picture, or with so many rows and columns more."""
        rows, columns = self.height + more, self.width + more
        return picture[self.top : self.top + rows, self.left : self.left + columns]

    def place(self, uv: Float[Tensor, "v 2"]) -> Float[Tensor, "v 2"]:
        """Pixels of the frame to coarse pixels of the window."""
        rows, columns = self.coarse
        ratio = uv.new_tensor([columns / self.width, rows / self.height])
        return (uv - uv.new_tensor([self.left, self.top]) + 0.5) * ratio - 0.5

    def enlarge(self, maps: Float[Tensor, "c r s"]) -> Float[Tensor, "c h w"]:
        """Coarse maps to the pixels of the window."""
        if maps.shape[1:] == (self.height, self.width):
            return maps
        return functional.interpolate(maps[None], (self.height, self.width), mode="bilinear")[0]


def project_body(body: BodyModel, x: Float[Tensor, "k n"], camera: Camera) -> list[ProjectedBody]:
    """Project the surface of a body in several poses, as `draw_overlay` takes it.

    Args:
        body: The body on its base.
        x: Its poses, the best first.
        camera: Camera of the picture.
    """
    local, faces = body.mesh(_RINGS, _MERIDIANS).points, grid_faces(_RINGS, _MERIDIANS)
    rotation, centre = body.part_poses(body.pose(x))
    seen = camera.project(local.flatten(1, 2) @ rotation.mT + centre[..., None, :])
    part = torch.arange(body.num_parts).repeat_interleave(len(faces))
    faces = faces.repeat(body.num_parts, 1) + _RINGS * _MERIDIANS * part[:, None]
    return [
        ProjectedBody(uv, depth, valid, faces, part)
        for uv, depth, valid in zip(*(t.flatten(1, 2).cpu() for t in seen), strict=True)
    ]


def draw_poses(
    image: ColourImage,
    body: BodyModel,
    x: Float[Tensor, "k n"],
    camera: Camera,
    *,
    weights: Float[Tensor, " k"] | None = None,
    keypoints: Float[Tensor, "j 2"] | None = None,
    text: str | None = None,
) -> ColourImage:
    """Draw poses of a body over the picture, the first as a shaded body.

    Args:
        image: The picture.
        body: The body on its base.
        x: Its states, the best first.
        camera: The picture's camera.
        weights: Weight of every state.
        keypoints: The marked joints.
        text: A line for the lower left corner.
    """
    modes = project_body(body, x, camera)
    picture = torch.from_numpy(np.ascontiguousarray(image))
    return draw_overlay(picture, modes, weights=weights, keypoints=keypoints, text=text).numpy()


def draw_overlay(
    image: Picture,
    modes: Sequence[ProjectedBody],
    *,
    weights: Float[Tensor, " k"] | Sequence[float] | None = None,
    keypoints: Float[Tensor, "j 2"] | None = None,
    text: str | None = None,
) -> Picture:
    """Draw the modes of a tracker over a frame.

    Args:
        image: The frame; it is not changed.
        modes: Projected bodies, the best first. There may be none, and they may be behind the
            camera or out of the picture.
        weights: Weight of every mode, in any unit; equal when absent.
        keypoints: Measured image points, drawn as small rings; those not finite are missing.
        text: A line to write into the lower left corner.

    Returns:
        A new frame.

    Raises:
        ShapeError: If the frame is not uint8 RGB, or there are not as many weights as modes.
        ConfigurationError: If a weight is negative or not finite.
    """
    check_shape("image", image, None, None, 3)
    if image.dtype != torch.uint8 or image.ndim != 3:
        raise ShapeError(
            f"image: expected uint8 of shape [h, w, 3], got {image.dtype} {list(image.shape)}; "
            "scale floating point frames to 0..255 and convert them"
        )
    strength = torch.ones(len(modes)) if weights is None else torch.as_tensor(weights).float().cpu()
    if strength.shape != (len(modes),):
        raise ShapeError(
            f"weights: expected one for each of {len(modes)} modes, got {list(strength.shape)}"
        )
    if not bool((torch.isfinite(strength) & (strength >= 0)).all()):
        raise ConfigurationError(
            f"weights: expected finite and not negative, got {strength.tolist()}; "
            "exponentiate logarithms first"
        )
    drawn = image.clone()
    line = max(1.5, image.shape[0] / 320)
    colours = drawn.new_tensor(
        [palette_colour(mode) for mode in range(len(modes))], dtype=torch.float32
    )
    if modes:
        _draw_body(drawn, modes[0], colours[0], line)
    for index in range(len(modes) - 1, 0, -1):  # the heavier on top
        share = float(strength[index] / strength[0]) if strength[0] > 0 else 0.0
        opacity = _FAINTEST + (1 - _FAINTEST) * min(share, 1.0)
        _draw_outline(drawn, modes[index], colours[index], 2 * line / 3, opacity)
    if keypoints is not None:
        check_shape("keypoints", keypoints, None, 2)
        _draw_keypoints(drawn, keypoints, 2.5 * line)
    if text:
        _draw_text(drawn, text)
    return drawn


def _window(
    uv: Float[Tensor, "v 2"], height: int, width: int, margin: float, resolution: int
) -> _Window | None:
    """Bounding box of points and `margin` in the frame; `None` if it is empty."""
    uv = uv[torch.isfinite(uv).all(-1)]
    if not uv.numel():
        return None
    bound = uv.new_tensor([width, height])
    low = (uv.amin(0) - margin).floor().clamp_min(0).minimum(bound).long().tolist()
    high = (uv.amax(0) + margin).ceil().clamp_min(-1).minimum(bound - 1).long().tolist()
    left, top = low
    columns, rows = high[0] + 1 - left, high[1] + 1 - top
    if columns < 1 or rows < 1:
        return None
    return _Window(top, left, rows, columns, min(1.0, (resolution / (rows * columns)) ** 0.5))


def _labels(mode: ProjectedBody, window: _Window) -> PartLabels:
    """Part labels of a body in its window."""
    place, depth, valid = window.place(mode.uv)[None], mode.depth[None], mode.valid[None]
    return mode.parts_seen(nearest_faces(place, depth, mode.faces, *window.coarse, valid=valid)[0])


def _borders(part: PartLabels) -> Float[Tensor, "R S"]:
    """Length of outline that passes each lattice point, in coarse pixels; zero for most.

    The lattice lies between the pixels and is one larger than the image. An outline runs along the
    cracks between pixels of different labels; where it turns it cuts the corner, so that a line
    has about the same length in every direction.
    """
    # Repeating the labels at the frame's edge draws no line where the frame cuts a body.
    padded = functional.pad(part[None, None].float(), (1, 1, 1, 1), mode="replicate")[0, 0]
    upright = (padded[:, 1:] != padded[:, :-1]).float()
    level = (padded[1:] != padded[:-1]).float()
    return torch.hypot(upright[1:] + upright[:-1], level[:, 1:] + level[:, :-1]) / 2


def _profile(border: Float[Tensor, "R S"], sigma: float) -> Float[Tensor, "r s"]:
    """The lattice smoothed by `sigma` coarse pixels, scaled so that a line is a hill of height 1.

    Across the line the hill is `exp(-d^2 / 2 s^2)` with `s^2 = sigma^2 + _STEPS`.
    """
    reach = int(3 * sigma + 1)
    # Lattice points lie half a pixel off the centres: an even kernel, cut to the image.
    taps = torch.arange(-reach, reach) + 0.5
    kernel = torch.exp(-0.5 * (taps / sigma) ** 2)
    kernel = kernel / kernel.sum()
    smooth = functional.pad(border, (reach - 1,) * 4)
    for axis in (0, 1):
        # By sums of shifted copies: on a CPU ten times faster than a convolution of one channel.
        length = smooth.shape[axis] - len(taps) + 1
        copies = [weight * smooth.narrow(axis, k, length) for k, weight in enumerate(kernel)]
        smooth = sum(copies[1:], copies[0])
    return smooth * (2 * torch.pi * (sigma**2 + _STEPS)) ** 0.5


def _line_spread(width: float, scale: float) -> float:
    """Standard deviation, coarse pixels, that smooths away the raster's steps under a line."""
    return max(0.5 * width * scale, 0.9)


def _cover(
    profile: Float[Tensor, "h w"], sigma: float, scale: float, width: float
) -> Float[Tensor, "h w"]:
    """Antialiased coverage of lines of `width` frame pixels, from their enlarged profile."""
    squared = -2 * (sigma**2 + _STEPS) / scale**2 * profile.clamp(1e-6, 1).log()
    return (width / 2 + 0.5 - squared.sqrt()).clamp(0, 1)


def _blend(target: Picture, window: _Window, colour: Tensor, opacity: Float[Tensor, "h w"]) -> None:
    """Mix `colour` (one, or one per pixel) into the window of the frame, in place."""
    view = window.of(target)
    touched = torch.nonzero(opacity > 0, as_tuple=True)
    alpha = opacity[touched][:, None]
    paint = colour if colour.ndim == 1 else colour[touched]
    view[touched] = torch.lerp(view[touched].float(), paint.float(), alpha).round().to(torch.uint8)


def _draw_outline(
    target: Picture,
    mode: ProjectedBody,
    colour: Float[Tensor, "3"],
    line: float,
    opacity: float,
) -> None:
    """Thin outlines of the visible parts."""
    height, width = target.shape[:2]
    window = _window(mode.in_front, height, width, line + 1, _RESOLUTION // 3)
    if window is None:
        return
    sigma = _line_spread(line, window.scale)
    profile = window.enlarge(_profile(_borders(_labels(mode, window)), sigma)[None])[0]
    _blend(target, window, colour, opacity * _cover(profile, sigma, window.scale, line))


def _draw_body(
    target: Picture,
    mode: ProjectedBody,
    colour: Float[Tensor, "3"],
    line: float,
) -> None:
    """Translucent shaded parts, their outlines, and dashes for what is hidden."""
    height, width = target.shape[:2]
    window = _window(mode.in_front, height, width, 2 * line + 2, _RESOLUTION)
    if window is None:
        return
    place = window.place(mode.uv)
    fragments = rasterise(place, mode.depth, mode.faces, *window.coarse, valid=mode.valid)
    part = mode.parts_seen(fragments.face)
    light, seen = _shading(mode, fragments, height, width)
    sigma = _line_spread(line, window.scale)
    visible = _profile(_borders(part), sigma)
    hidden = _profile(_hidden_borders(mode, part, window, line), sigma)
    light, seen, visible, hidden = window.enlarge(torch.stack((light, seen, visible, hidden)))
    faint, broad, thin = (
        _cover(profile, sigma, window.scale, width)
        for profile, width in ((hidden, 0.7 * line), (visible, 2 * line), (visible, line))
    )
    white = torch.full_like(colour, 255.0)
    _blend(target, window, colour * light[..., None], _FILL * seen)
    _blend(target, window, torch.lerp(colour, white, 0.5), _HIDDEN * faint)
    # A dark line under a bright one stands out from any background.
    _blend(target, window, 0.15 * colour, 0.6 * broad)
    _blend(target, window, torch.lerp(colour, white, 0.7), thin)


def _shading(
    mesh: ProjectedBody, fragments: Fragments, height: int, width: int
) -> tuple[Float[Tensor, "r s"], Float[Tensor, "r s"]]:
    """Lambert's shading per pixel, and where there is a surface.

    The overlay knows no intrinsics; a focal length of the frame's larger side gives normals that
    are good enough to look at.
    """
    middle = mesh.uv.new_tensor([width / 2, height / 2])
    depth = torch.where(torch.isfinite(mesh.depth) & (mesh.depth > 0), mesh.depth, 1.0)
    offset = torch.nan_to_num(mesh.uv - middle).clamp(-1e6, 1e6) / max(height, width)
    points = torch.cat((offset * depth[:, None], depth[:, None]), -1)
    normals = vertex_normals(points, mesh.faces)
    faces, seen = fragments.face.view(-1), fragments.face >= 0
    pixel = torch.nonzero(seen.view(-1))[:, 0]
    weights = fragments.barycentric.view(-1, 3)[pixel]
    normal = functional.normalize(interpolate(normals, mesh.faces, faces[pixel], weights), dim=-1)
    normal = torch.where(normal[:, 2:] > 0, -normal, normal)  # towards the viewer
    lamp = functional.normalize(normal.new_tensor([-0.4, -0.6, -0.7]), dim=0)
    light = torch.ones(seen.numel())
    light[pixel] = (0.3 + 0.8 * (normal @ lamp).clamp_min(0)).clamp_max(1.0).float()
    return light.view(seen.shape), seen.float()


def _hidden_borders(
    mode: ProjectedBody, visible: PartLabels, window: _Window, line: float
) -> Float[Tensor, "R S"]:
    """Dashed lattice of part silhouettes that lie behind other parts of the same body."""
    rows, columns = visible.shape
    dashes = visible.new_zeros(rows + 1, columns + 1, dtype=torch.float32)
    dash = max(round(4 * line * window.scale), 2)
    placed = mode._replace(uv=window.place(mode.uv))
    for number in mode.part.unique().tolist():
        alone = placed.alone(number)
        box = _window(alone.in_front, rows, columns, 2, rows * columns)
        if box is None:
            continue
        own = _labels(alone, box) == number
        border = _borders(own.long())
        # A lattice point counts as hidden where none of its four pixels shows this part.
        shows = functional.pad(box.of(visible) == number, (1, 1, 1, 1))
        shows = shows[1:] | shows[:-1]
        border = border * ~(shows[:, 1:] | shows[:, :-1])
        # Dashes run along the axis that the outline follows more closely, so that lines of every
        # direction are broken: differences of the smoothed silhouette give its direction.
        soft = functional.avg_pool2d(
            functional.pad(own[None, None].float(), (3, 3, 3, 3), mode="replicate"), 5, 1
        )[0, 0]
        across = (soft[1:, 1:] - soft[1:, :-1]).abs()
        down = (soft[1:, 1:] - soft[:-1, 1:]).abs()
        row = torch.arange(box.height + 1)[:, None] + box.top
        column = torch.arange(box.width + 1)[None] + box.left
        phase = torch.where(across > down, row, column) // dash
        lattice = box.of(dashes, 1)
        lattice.copy_(lattice.maximum(border * (phase % 2 == 0)))
    return dashes


def _draw_keypoints(target: Picture, keypoints: Float[Tensor, "j 2"], radius: float) -> None:
    """Yellow rings with a dark rim."""
    height, width = target.shape[:2]
    yellow = target.new_tensor(PALETTE[5], dtype=torch.float32)
    for place in keypoints.detach().double().cpu():
        window = _window(place[None], height, width, radius + 2, height * width)
        if window is None:
            continue
        u, v = place.tolist()
        y = torch.arange(window.top, window.top + window.height)[:, None] - v
        x = torch.arange(window.left, window.left + window.width)[None] - u
        off = ((x**2 + y**2).sqrt() - radius).abs()
        _blend(target, window, 0 * yellow, 0.7 * (0.3 * radius + 1.5 - off).clamp(0, 1).float())
        _blend(target, window, yellow, (0.3 * radius + 0.5 - off).clamp(0, 1).float())


def _draw_text(target: Picture, text: str) -> None:
    """One line in the lower left corner, white on a dark strip."""
    # Pillow comes with matplotlib; imported here because nothing else of the overlay needs it.
    from PIL import Image, ImageDraw, ImageFont

    text = " ".join(text.splitlines())
    height, width = target.shape[:2]
    size = max(10, round(height / 36))
    font = ImageFont.load_default(size)
    left, top, right, bottom = (int(side) for side in font.getbbox(text))
    pad = size // 2
    ink = Image.new("L", (right - left + 2 * pad, bottom - top + 2 * pad), 0)
    ImageDraw.Draw(ink).text((pad - left, pad - top), text, fill=255, font=font)
    cover = torch.from_numpy(np.array(ink, dtype=np.float32) / 255)
    cover = cover[-height:, :width]
    rows, columns = cover.shape
    window = _Window(height - rows, 0, rows, columns, 1.0)
    white = cover.new_full((3,), 255.0)
    _blend(target, window, 0 * white, torch.full_like(cover, 0.55))
    _blend(target, window, white, cover)
