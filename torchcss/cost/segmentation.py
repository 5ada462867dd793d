"""Whether the pixels that a pose covers look like what it puts there: evidence among modes.

The terms of the contour look at the outline of the pose at hand. A limb that has slipped onto a
chair keeps an outline, and the true one, left uncovered, costs nothing. Here every pixel counts:
each that the pose covers is worth what its colour says for the part seen there against that part's
surroundings (`Appearance.foreground_ratio`), and a pixel that is left uncovered is worth nothing.
The sum is the log-likelihood ratio of a segmentation into the parts of the body and the rest, up to
the tanh that keeps single pixels from deciding.

It has no derivatives in the pose, and is dear. It therefore stays out of the descents, and is asked
of the minima that they find, where the weights are made (step 3 of Fig. 6 [IJRR]):
`TrackingCost.weight_only`. The papers have no such term; section 8 [IJRR] expects help of
silhouettes. In the mean over clips it changes little; on some it decides which pose leads
(`docs/findings.md`).

It asks for a body that is modelled whole. Of an arm alone it would be led astray by the rest of
the person, who wears the same shirt: `make_choice` gives arms none.

What to call: `SegmentationTerm.images` once a frame, then `value` at any number of poses.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from torchcss.body.model import BodyModel
from torchcss.cost.context import FrameContext
from torchcss.cost.part_map import part_map
from torchcss.cost.region import layer_of_part
from torchcss.cost.term import BoundWeight, Need, Term
from torchcss.types import Numbers, Vector, Vectors, frozen
from torchcss.vision.camera import Camera
from torchcss.vision.features import Window

_FEWEST_PIXELS = 20
"""A body of which the reduced image has fewer counts as if it had so many."""


class SegmentationImages(NamedTuple):
    """What the pixels of a frame look like, reduced.

    Attributes:
        camera: Camera of the reduced images: of the window, beyond which all is zero.
        ratio: How much each pixel looks like each layer, in -1..1; a last image of zeros stands
            for what is no part.
        layer: Layer of each part, and last that of no part.
        area: Pixels that the body was expected to cover.
    """

    camera: Camera
    ratio: Float[Tensor, "layers h w"]
    layer: Int[Tensor, " parts"]
    area: float


@frozen
class SegmentationTerm(Term):
    """The foreground log-likelihood ratio of all covered pixels, against the area of the body.

    Attributes:
        weight: Nats per share of the body's area.
        background: Whether it knows what is behind the body, see `torchcss.vision.background`.
        reduction: Pixels of the image, along each side, to one that is looked at.
        rings: Latitudes of the mesh of each part.
        meridians: Longitudes of the mesh of each part.
    """

    name = "segmentation"
    kind = "weight-only"

    weight: float = 400.0
    background: bool = False
    reduction: int = 4
    rings: int = 6
    meridians: int = 10

    @property
    def needs(self) -> frozenset[Need]:
        """Colours, and what is behind them where that is asked for."""
        return frozenset(("appearance", "background") if self.background else ("appearance",))

    def prepare(self, context: FrameContext) -> BoundWeight | None:
        """Reduce the foreground of a frame; None without colours, or without a pose before it."""
        seen = context.foreground(background=self.background)
        if seen is None or context.modes is None:
            return None
        ratio, window = seen
        layer, expected = context.tables.of(layer_of_part), context.modes[0]
        images = self.images(ratio, layer, context.camera, context.body, expected, window=window)
        return self.bind(images)

    def bind(self, images: SegmentationImages) -> BoundWeight:
        """The term on a frame that `images` has prepared."""
        return BoundWeight(self.weight, lambda posed: self.value(posed.body, posed.x, images))

    def images(
        self,
        ratio: Float[Tensor, "layers h w"],
        layer_of_part: Int[Tensor, " parts"],
        camera: Camera,
        body: BodyModel,
        expected: Vector,
        *,
        window: Window | None = None,
    ) -> SegmentationImages:
        """Prepare a frame.

        Args:
            ratio: How much each pixel looks like each layer, in -1..1.
            layer_of_part: Layer of each part of the body.
            camera: Camera of the image.
            body: The body on this frame's base.
            expected: A pose near the one sought, whose area is the unit of the term.
            window: The window that `ratio` is of, which is zero elsewhere; None: all of the image.
        """
        small = _scaled(camera, 1 / self.reduction)
        window = window or Window(0, 0, *camera.image_size_wh)
        reduced = _reduced(ratio, window, camera.image_size_wh, small.image_size_wh)
        layer = functional.pad(layer_of_part, (0, 1), value=len(ratio))
        area = int((self._parts(body, expected, small) >= 0).sum())
        area = float(max(area, _FEWEST_PIXELS))
        # Pixels beyond the window count nothing, and need not be drawn.
        (width, height), (right, bottom) = camera.image_size_wh, small.image_size_wh
        left, top = window.left * right // width, window.top * bottom // height
        right, bottom = -(-window.right * right // width), -(-window.bottom * bottom // height)
        here = small.cropped(left, top, right - left, bottom - top)
        looks = reduced[:, top:bottom, left:right].to(body.tie).contiguous()
        return SegmentationImages(here, looks, layer, area)

    def value(self, body: BodyModel, x: Vectors, images: SegmentationImages) -> Numbers:
        """One, less the ratio summed over the covered pixels as a share of the body's area.

        Zero is a body whose every pixel looks like what it is, one is a body of which nothing is
        known or which covers nothing, two one that lies where nothing looks like it.

        Args:
            body: The body on this frame's base.
            x: Its poses.
            images: What `images` made of the frame.
        """
        # The part of no part is -1, the last entry.
        layer = images.layer[self._parts(body, x, images.camera)]
        batch, (height, width) = layer.shape[:-2], layer.shape[-2:]
        seen = images.ratio.expand(*batch, -1, height, width).gather(-3, layer[..., None, :, :])
        return 1 - seen.sum((-3, -2, -1)) / images.area

    def _parts(self, body: BodyModel, x: Tensor, camera: Camera) -> Tensor:
        return part_map(body, x, camera, rings=self.rings, meridians=self.meridians)


@lru_cache(maxsize=8)
def _scaled(camera: Camera, factor: float) -> Camera:
    """The same camera in every frame: making one takes a millisecond."""
    return camera.scaled(factor)


def _reduced(
    ratio: Float[Tensor, "layers y x"], window: Window, size: tuple[int, int], to: tuple[int, int]
) -> Float[Tensor, "layers+1 h w"]:
    """Means of the blocks of images, and a last image of zeros.

    Args:
        ratio: What the images are in a window; they are zero elsewhere.
        window: The window.
        size: Width and height of the images.
        to: Width and height when they are reduced.
    """
    (width, height), side = to, size[0] // to[0]
    reduced = ratio.new_zeros(len(ratio) + 1, height, width)
    if size != (side * width, side * height):
        whole = ratio.new_zeros(len(ratio), size[1], size[0])
        whole[window.pixels] = ratio
        reduced[:-1] = functional.adaptive_avg_pool2d(whole[None], (height, width))[0]
        return reduced
    left, top, right, bottom = window[:4]
    blocks = functional.pad(ratio, (left % side, -right % side, top % side, -bottom % side))
    rows = blocks.unflatten(1, (-1, side)).sum(2)  # rows first: three times as fast
    part = rows.unflatten(2, (-1, side)).sum(3) / side**2
    reduced[:-1, top // side :, left // side :][:, : part.shape[1], : part.shape[2]] = part
    return reduced
