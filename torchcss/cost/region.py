"""Region term: just inside its contour the image looks like the part, just outside it does not.

Clutter has edges too, and hidden limbs attach to them (section 8 [IJRR], which therefore weighs
contours by foreground and background). Here colours are a term of their own. The foreground
log-likelihood ratio L of a part (`torchcss.vision.appearance`), in -1..1, is looked up a few pixels
to either side of every contour node r, along its outward normal m in the image:

    e(r) = nu / 2 (1 - (L(r - d m) - L(r + d m)) / 2)

It is 0 on a perfect outline, nu / 2 where colours say nothing, and nu where inside and outside are
exchanged. L is blurred and made a spline: e is smooth and bounded, and needs no robust potential.
Derivatives hold normals fixed, and existence and visibility of the nodes.

Where the body has no contour and where it is hidden the costs are those of the contour term.

Where the colours come from: `region_masks` tells which pixels a pose assigns to each part and to
its surroundings. Parts that look alike share a layer (`part_layers`), and what has a part's own
colours is not outside it: the next part of the limb, where there is no contour.

By default: `region_field(ratio)` once per frame, `RegionImages(field, layer)`, then
`RegionTerm().point_cost(...)`; `torchcss.cost.frame` does it.
"""

from __future__ import annotations

from types import EllipsisType
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from torchcss.body.catalog import without_side
from torchcss.body.model import BodyModel
from torchcss.body.root import has_root
from torchcss.cost.context import FrameContext
from torchcss.cost.outline import Derivatives, ImageNodes, OutlineTerm
from torchcss.cost.part_map import grow, part_map
from torchcss.cost.term import Need, OnPoints, Values
from torchcss.cost.visibility import ContourPredictor
from torchcss.types import Vector, frozen
from torchcss.vision.camera import Camera
from torchcss.vision.sampling import gaussian_blur
from torchcss.vision.spline import SplineField, spline_field

_SMOOTHING = 3.0
"""Standard deviation of the blur of foreground ratios, pixels. With more, thin limbs fade."""

_REACH = 30
"""How far the surroundings go, pixels."""

_COARSE = 4
"""Surroundings are found on a grid of so many pixels: their outer border may be rough."""

_CORE = 0.6
"""Share of a part's girth within which colours are taken for its own. A pose is off by some pixels,
which is half of a thin limb: of the wall beside it the limb then learns the colour, and stays there
when the arm has gone."""

_BODY_MARGIN = 12
_ARM_MARGIN = 2
"""Pixels off the outline of a tracked body from which on colours are taken for the part's own too:
of a wide part the core lacks the shade along the outline. A pose is off by less than these, and
only the trunk of a person seen close is wide enough to have them. The outline of an arm is known
better, since it hangs on a base that is told."""

_CORE_PIXELS = 60
"""Fewest pixels that tell colours; of a part with a smaller core all but its outline are taken."""

_GAP = 4
"""Pixels beside an outline that belong to neither side, for the same reason."""


def part_layers(body: BodyModel) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Parts that look alike share a layer: a left one and its right counterpart.

    Returns:
        Names of the layers, and the layer of each part.
    """
    names = [without_side(name) for name in body.part_names]
    layers = tuple(dict.fromkeys(names))
    return layers, tuple(layers.index(name) for name in names)


def layer_of_part(body: BodyModel) -> Int[Tensor, " parts"]:
    """The layer of each part, see `part_layers`."""
    return torch.tensor(part_layers(body)[1], dtype=torch.long, device=body.tie.device)


def region_field(ratio: Float[Tensor, "layers h w"]) -> SplineField:
    """Make the foreground ratios of a frame, or of a window of it, smooth functions.

    Args:
        ratio: How much each pixel looks like each layer, in -1..1.
    """
    # Single precision is far finer than the colours, and twice as fast.
    return spline_field(gaussian_blur(ratio.float(), _SMOOTHING))


class RegionMasks(NamedTuple):
    """Where colours are taken from.

    Attributes:
        inside: What is sure of each layer.
        outside: Its surroundings; neither holds what lies between the two.
        pixels: The index, in an image `[... h w]`, of the part of it that these masks are of.
    """

    inside: Bool[Tensor, "layers y x"]
    outside: Bool[Tensor, "layers y x"]
    pixels: tuple[EllipsisType, slice, slice]


def region_masks(
    body: BodyModel,
    state: Vector,
    camera: Camera,
    *,
    fitted: bool = True,
) -> RegionMasks:
    """Pixels that are each layer's own for all that a pose may be off, and those around it.

    Args:
        body: The body.
        state: Its pose.
        camera: Camera of the image.
        fitted: The girths are the person's; else only the core of a part counts as its own.
    """
    names, layer_of = part_layers(body)
    # A last entry for pixels that see no part, whose index is -1.
    layer_of_part = torch.tensor((*layer_of, -1), device=body.tie.device, dtype=torch.int16)

    girths = state.new_tensor([1.0, _CORE])
    parts, cores = part_map(body, state.expand(2, -1), camera, girth=girths)
    window = _window(parts >= 0, _REACH + _COARSE)
    layer = layer_of_part[parts[window]]
    layers = torch.arange(len(names), device=parts.device, dtype=layer.dtype)[:, None, None]
    own = layer == layers
    if not own.numel():
        return RegionMasks(own, own, window)
    sure = layer_of_part[cores[window]] == layer
    if fitted:
        sure |= _is_alike(layer, _BODY_MARGIN if has_root(body) else _ARM_MARGIN)
    sure &= layer >= 0
    small = torch.bincount(layer[sure].long(), minlength=len(names)) < _CORE_PIXELS
    # The last entry again for pixels that see no part; they belong to no layer anyway.
    small = functional.pad(small, (0, 1))[layer.long()]
    core = own & torch.where(small, _is_alike(layer, 1), sure)
    row, column = torch.nonzero(layer >= 0, as_tuple=True)
    height, width = (-(-side // _COARSE) for side in layer.shape)
    blocks = own.new_zeros(len(names), height, width)
    blocks[layer[row, column].long(), row // _COARSE, column // _COARSE] = True
    blocks = grow(blocks, _REACH // _COARSE)
    far = blocks.repeat_interleave(_COARSE, -1).repeat_interleave(_COARSE, -2)
    near = far[:, : own.shape[1], : own.shape[2]] & ~grow(own, _GAP)
    own_layer = dict(zip(body.part_names, layer_of, strict=True))
    for i, j in {(own_layer[first], own_layer[second]) for first, second in body.neighbours}:
        if i != j:
            near[i] &= ~own[j]
            near[j] &= ~own[i]
    return RegionMasks(core, near, window)


def _is_alike(layer: Int[Tensor, "h w"], radius: int) -> Bool[Tensor, "h w"]:
    """Where all pixels within a square see the same layer."""
    most, least = grow(torch.stack([layer, -layer]), radius)
    return most == -least


def _window(mask: Bool[Tensor, "h w"], margin: int) -> tuple[EllipsisType, slice, slice]:
    """Rows and columns of what is within a margin of a mask, in whole blocks.

    A person fills a quarter of most pictures, and growing masks takes time by their pixels.
    """
    spans = []
    for axis in (1, 0):
        found = torch.nonzero(mask.any(axis))
        if not len(found):
            return (..., slice(0), slice(0))
        start = max(int(found[0]) - margin, 0) // _COARSE * _COARSE
        stop = -(-(int(found[-1]) + margin + 1) // _COARSE) * _COARSE
        spans.append(slice(start, stop))
    return (..., *spans)


class RegionImages(NamedTuple):
    """The foreground ratios of a frame, and which of them each contour node looks at.

    Attributes:
        field: The foreground ratios as smooth functions, one a layer.
        layer: Layer of each contour node.
        origin: Column and row of the frame where `field` begins.
    """

    field: SplineField
    layer: Int[Tensor, " p"]
    origin: tuple[int, int] = (0, 0)


@frozen
class RegionTerm(OutlineTerm):
    """The cost of what the image looks like on either side of the contour.

    Attributes:
        background: Whether it knows what is behind the body, see `torchcss.vision.background`.
        offset: Distance d of the two places from the contour, pixels.
        fitted_level: The mean error per node of a fitted model, 0.23 to 0.32 on the beam clip.
    """

    name = "region"

    weight: float = 400.0
    background: bool = False
    offset: float = 5.0
    fitted_level: float = 0.3

    @property
    def needs(self) -> frozenset[Need]:
        """Colours, and what is behind them where that is asked for."""
        return frozenset(("appearance", "background") if self.background else ("appearance",))

    def prepare(self, context: FrameContext) -> OnPoints | None:
        """Make the foreground of a frame smooth; None where no colours are known."""
        seen = context.foreground(background=self.background)
        if seen is None:
            return None
        ratio, window = seen
        part = context.tables.of(ContourPredictor).node_part
        layer = context.tables.of(layer_of_part)[part]
        origin = (0, 0) if window is None else (window.left, window.top)
        return self.bind(context, RegionImages(region_field(ratio), layer, origin))

    def match(
        self, nodes: ImageNodes, image: RegionImages, at: Float[Tensor, "k 2"] | None = None
    ) -> Float[Tensor, " k"]:
        """The contrast L(r - d m) - L(r + d m), see `OutlineTerm.match`."""
        inside, outside, layer = self._sides(nodes, image, at)
        return image.field.value(inside, layer) - image.field.value(outside, layer)

    def derivatives(self, nodes: ImageNodes, image: RegionImages) -> Derivatives:
        """See `OutlineTerm.derivatives`."""
        *sides, layer = self._sides(nodes, image, None)
        inside, outside = (image.field.sample(side, layer) for side in sides)
        weight = 0.25 * self.nu * nodes.weight
        gradient = weight[..., None] * (outside.gradient - inside.gradient)
        hessian = weight[..., None, None] * (outside.hessian - inside.hessian)
        return inside.value - outside.value, gradient, hessian

    def matched(self, match: Values) -> Values:
        """See `OutlineTerm.matched`."""
        return 0.5 * self.nu * (1 - 0.5 * match)

    def _sides(
        self, nodes: ImageNodes, image: RegionImages, at: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The places inside and outside of the nodes, and the layers that are looked at there."""
        uv, step = nodes.uv if at is None else at, self.offset * nodes.normal
        origin = uv.new_tensor(image.origin)
        return uv - step - origin, uv + step - origin, image.layer[nodes.place % len(image.layer)]
