"""What a term is bound to: one view of one frame, and tables of the body that all frames share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchcss.body.model import BodyModel
from torchcss.inference.mixture import GaussianMixture
from torchcss.types import Keypoints, Vector
from torchcss.vision.appearance import Appearance
from torchcss.vision.background import Background
from torchcss.vision.camera import Camera
from torchcss.vision.edges import foreground_weight
from torchcss.vision.features import FrameFeatures, Window
from torchcss.vision.sampling import gaussian_blur

_T = TypeVar("_T")
_M = TypeVar("_M", bound=nn.Module)

Foreground = tuple[Float[Tensor, "layers y x"], Window | None]
"""See `FrameContext.foreground`."""

_GRAIN = 2.0
"""Pixels over which the belief in the foreground is smoothed before it weighs edges: single pixels
that look like the body are none."""


class BodyTables:
    """Tables of a body, such as its contour predictor, each made when it is first asked for.

    Args:
        body: The body; its base may move afterwards, its shape may not.
        known: Tables that have been made already.
    """

    def __init__(self, body: BodyModel, *known: object) -> None:
        self.body = body
        self._made: dict[Any, Any] = {type(table): table for table in known}

    @classmethod
    def together(cls, body: BodyModel, each: Sequence[BodyTables]) -> BodyTables:
        """The tables of several bodies, as far as they are made; `body` stands for all."""
        tables = cls(body)
        for make in each[0]._made:
            own = [other.of(make) for other in each]
            # What is no module is made of names, which all have in common.
            is_module = isinstance(own[0], nn.Module)
            tables._made[make] = stack_modules(own) if is_module else own[0]
        return tables

    def of(self, make: Callable[[BodyModel], _T]) -> _T:
        """The table that a class or function makes of a body."""
        if make not in self._made:
            self._made[make] = make(self.body)
        return self._made[make]


def stack_modules(each: Sequence[_M], *names: str) -> _M:
    """A module that stands for several: with buffers `[S 1 ...]` in place of each one's.

    Args:
        each: Modules alike but for the numbers in their buffers.
        names: These buffers; by default those that differ.
    """
    stacked = copy(each[0])
    stacked._buffers = dict(each[0]._buffers)
    for name in names or stacked._buffers:
        own = [one.get_buffer(name) for one in each]
        stacked._buffers[name] = torch.stack(own)[:, None] if names else stack_different(own)
    return stacked


def stack_different(each: Sequence[Tensor]) -> Tensor:
    """The tensor that all are, or all of them, `[S 1 ...]`."""
    first, *others = each
    same = all(one is first or torch.equal(one, first) for one in others)
    return first if same else torch.stack(list(each))[:, None]


@dataclass(frozen=True, kw_only=True, eq=False)
class FrameContext:
    """One view of one frame. What is None says nothing.

    Attributes:
        body: The body, hung on its base.
        camera: The camera, at the size of the features.
        tables: Tables of the body; by default made when a term asks for them.
        features: Features of the picture; None: the picture is missing.
        edge_field: Edge energy times gradient direction, weighed by boundaries and foreground.
        boundary_emphasis: Weight of the boundaries in it, see `FrameFeatures.edge_field`.
        keypoints: Those of the frame, in the features' pixels, or one set for each of the modes.
        appearance: What the body's parts and their surroundings look like.
        background: What is behind the body.
        modes: Modes of the frame before, the best first.
        prior: The same one frame ahead, for priors; None: not known.
        deviation: Expected motion of every parameter in one frame; None: not known.
        sequence: Which of the sequences that are evaluated together this is a frame of.
    """

    body: BodyModel
    camera: Camera
    tables: BodyTables = field(default=None)  # type: ignore[assignment]
    features: FrameFeatures | None = None
    edge_field: Float[Tensor, "2 h w"] | None = None
    boundary_emphasis: float = 0.0
    keypoints: Keypoints | None = None
    appearance: Appearance | None = None
    background: Background | None = None
    modes: Float[Tensor, "k n"] | None = None
    prior: GaussianMixture | None = None
    deviation: Vector | None = None
    sequence: int = 0

    def __post_init__(self) -> None:
        if self.tables is None:
            object.__setattr__(self, "tables", BodyTables(self.body))

    def expecting(self, prior: GaussianMixture) -> FrameContext:
        """The same view with the modes one frame ahead; of the same mixture the same object."""
        if not self._expecting or self._expecting[0].prior is not prior:
            self._expecting[:] = [replace(self, prior=prior)]
        return self._expecting[0]

    @cached_property
    def _expecting(self) -> list[FrameContext]:
        """What `expecting` has made last; what is packed of it is kept with it."""
        return []

    def of(self, find: Callable[[FrameContext], _T]) -> _T:
        """What a function finds in this frame, found once for all that ask."""
        if find not in self._found:
            self._found[find] = find(self)
        return self._found[find]

    @cached_property
    def _found(self) -> dict[Any, Any]:
        return {}

    @property
    def is_out(self) -> bool:
        """Whether there is no picture."""
        return self.features is None and self.edge_field is None

    def weighed_edges(self, *, foreground: bool) -> Float[Tensor, "3 h w"] | None:
        """Edge energy times direction as found, and the weight of each pixel; None: no picture.

        Args:
            foreground: Whether what is learnt of body and background weighs them where no mask was
                given (section 8 [IJRR]).
        """
        field, features = self.edge_field, self.features
        if field is None or features is None:
            return None if field is None else torch.cat([field, torch.ones_like(field[:1])])
        found = features.edge_energy * features.edge_direction
        weight = features.edge_weight(boundary_emphasis=self.boundary_emphasis)
        seen = self.foreground(background=True) if foreground and features.mask is None else None
        if seen is not None:
            ratio, window = seen[0].amax(0), seen[1]
            if window is not None:
                ratio, part = ratio.new_zeros(weight.shape), ratio
                ratio[window.pixels] = part
            belief = gaussian_blur(0.5 + 0.5 * ratio, _GRAIN)
            weight = weight * foreground_weight(belief)
        return torch.cat([found, weight[None]]).to(field)

    def foreground(self, *, background: bool) -> Foreground | None:
        """Foreground log-likelihood ratio of pixels for each layer of parts, through a tanh.

        Args:
            background: Whether to use what is known of the picture behind the body.

        Returns:
            The ratios, and the window that they are of: outside it they are zero. None: it is the
            whole picture.
        """
        return self._before_background if background else self._before_surroundings

    @cached_property
    def _before_surroundings(self) -> Foreground | None:
        if self.appearance is None or self.features is None or self.features.colour is None:
            return None
        colour, window = self.features.colour, self.features.window
        seen = colour if window is None else colour[window.pixels]
        # Single precision is far finer than the colours: these are a picture for each layer.
        return self.appearance.foreground_ratio(seen.float()), window

    @cached_property
    def _before_background(self) -> Foreground | None:
        if self.background is None:
            return self._before_surroundings
        if self.appearance is None or self.features is None or self.features.colour is None:
            return None
        return self.appearance.foreground_ratio(self.features.colour, self.background), None
