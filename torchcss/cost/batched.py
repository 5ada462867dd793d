"""Several sequences evaluated as one: what stands for the bodies, cameras and terms of each.

The states of S sequences are `[S b n]`, and what differs between the sequences is `[S 1 ...]`, so
that bodies and terms evaluate it as they do a single one's. Pictures stay apart: the nodes of every
sequence look at its own, which takes one call in ten; and so do priors of a few calls.

Sequences are alike, and are evaluated as one, where their bodies have the same parts and
parameters, their cameras pictures of one size, and the same terms have something to say.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import is_
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.kinematics import TreePose
from torchcss.body.model import BodyModel, BodyPose
from torchcss.cost.context import BodyTables, FrameContext, stack_different, stack_modules
from torchcss.cost.outline import Derivatives, ImageNodes, OutlineTerm
from torchcss.cost.region import RegionImages
from torchcss.cost.term import OnPoints, OnStates, Points, Posed, Values
from torchcss.cost.visibility import SeenNodes
from torchcss.types import Curvature, LocalModel, PointCost, frozen
from torchcss.vision.camera import Camera
from torchcss.vision.spline import SplineField

if TYPE_CHECKING:
    from torchcss.cost.total import TrackingCost


class Merged:
    """What stands for several sequences, the last few: a search evaluates the same ones often."""

    def __init__(self) -> None:
        self._known: deque[tuple[tuple[object, ...], TrackingCost | None]] = deque(maxlen=4)

    def of(self, cost: TrackingCost) -> TrackingCost | None:
        """See `merged`."""
        parts = (cost.choice, *cost.past, None, *cost.views)
        for known, found in tuple(self._known):
            if len(known) == len(parts) and all(map(is_, known, parts)):
                return found
        self._known.append((parts, merged(cost)))
        return self._known[-1][1]


def merged(cost: TrackingCost) -> TrackingCost | None:
    """The cost of several sequences as that of one, of states `[S b n]`; None: they are not alike.

    Weight-only terms are left out.
    """
    views = [[v for v in cost.views if v.sequence == past.sequence] for past in cost.past]
    kinds = [_kind(cost, *pair) for pair in zip(cost.past, views, strict=True)]
    if None in kinds or any(kind != kinds[0] for kind in kinds):
        return None
    body = _together([past.body for past in cost.past])
    past = _context(body, cost.past)
    bound: dict[Any, Any] = {}
    by_camera = {_context(body, each): each for each in zip(*views, strict=True)}
    for term in cost.choice.terms:
        for context, each in ({past: cost.past} if term.kind == "prior" else by_camera).items():
            own = [cost.bound[term, one] for one in each]
            if own[0] is None or term.kind == "weight-only":
                bound[term, context] = None
            elif term.kind == "image":
                bound[term, context] = _on_points(own, each)
            elif term.of_several:
                bound[term, context] = term.prepare(replace(context, camera=each[0].camera))
            else:
                bound[term, context] = _EachPrior(own, each)
    return replace(cost, views=tuple(by_camera), past=(past,), bound=bound, sequence=None)


def rows_of(
    sequence: Int[Tensor, " b"], numbers: Sequence[int], most: int
) -> Int[Tensor, "s b"] | None:
    """The samples of each sequence, the last repeated where it has fewer than others.

    None: there are more than may be evaluated at once, or a sequence has none.

    Args:
        sequence: The number of the sequence of each sample.
        numbers: The numbers that there are.
        most: How many samples may be evaluated at once.
    """
    own = sequence == torch.tensor(numbers, device=sequence.device)[:, None]
    counts = own.sum(1)
    least, largest = torch.stack([counts.min(), counts.max()]).tolist()
    if least == 0 or largest * len(numbers) > most:
        return None
    # Those of the first sequence, then those of the second, in the order that they have.
    sort = own.int().argmax(0).argsort(stable=True)
    place = torch.arange(largest, device=sequence.device).minimum(counts[:, None] - 1)
    return sort[counts.cumsum(0)[:, None] - counts[:, None] + place]


def _kind(cost: TrackingCost, past: FrameContext, views: Sequence[FrameContext]) -> Any:
    """What sequences that are alike have in common; None: this one is like no other."""
    found: list[Any] = []
    for term in cost.choice.terms:
        for context in (past,) if term.kind == "prior" else views:
            bound = cost.bound[term, context]
            if term.kind == "image" and bound is not None:
                serves = term.of_several or isinstance(term, OutlineTerm)
                if not (serves and isinstance(bound, OnPoints)):
                    return None
                found.append((bound.scale, bound.size, bound.of_parents is None))
            found.append(bound is None)
    for view in views:
        names = None if view.keypoints is None else view.keypoints.names
        found.append((view.camera.image_size_wh, view.camera.near, view.camera.up, names))
    body = past.body
    return found, body.name, body.state_names, body.part_names, body.joint_names


def _together(each: Sequence[BodyModel]) -> BodyModel:
    """A body that stands for several."""
    own = "base_rotation", "base_translation", "marker_offset"
    body = stack_modules(each, *own, "part_rotation", "part_translation", "part_shape")
    tree = stack_modules([one.tree for one in each], "joint_constant", "link_constant")
    body._modules = {**body._modules, "tree": tree}
    return body


def _context(body: BodyModel, each: Sequence[FrameContext]) -> FrameContext:
    """A view that stands for several."""
    tables = BodyTables.together(body, [one.tables for one in each])
    return FrameContext(
        body=body, camera=Camera.together([one.camera for one in each]), tables=tables
    )


def _apart(posed: Posed, each: Sequence[FrameContext]) -> Iterator[Posed]:
    """The poses of each sequence."""
    x, tree, joints = posed.pose
    for number, context in enumerate(each):
        own = TreePose(*(part[number] for part in tree))
        first = x.new_zeros(x.shape[1], dtype=torch.long)
        parent = first if posed.parent is None else posed.parent[number]
        pose = BodyPose(x[number], own, joints[number])
        yield Posed(context, context.body, pose, parent)


@dataclass(frozen=True, eq=False)
class _EachPrior:
    """A prior on the states of each sequence."""

    priors: Sequence[OnStates]
    contexts: Sequence[FrameContext]

    def value(self, posed: Posed) -> Float[Tensor, "s b"]:
        """See `OnStates.value`."""
        own = zip(self.priors, _apart(posed, self.contexts), strict=True)
        return torch.stack([prior.value(poses) for prior, poses in own])

    def local_model(self, posed: Posed, curvature: Curvature) -> LocalModel:
        """See `OnStates.local_model`."""
        own = zip(self.priors, _apart(posed, self.contexts), strict=True)
        models = [prior.local_model(poses, curvature) for prior, poses in own]
        return LocalModel(*map(torch.stack, zip(*models, strict=True)))


def _on_points(each: Sequence[OnPoints], contexts: Sequence[FrameContext]) -> OnPoints:
    """An image term of all sequences."""
    first, images = each[0], [bound.image for bound in each]
    if isinstance(first.term, OutlineTerm):
        term = _OnPictures.of(first.term)
        return replace(first, term=term, image=_one_picture(images))
    if first.of_parents is None:
        return replace(first, image=_fields(images, stack_different))

    def of_parents(posed: Posed, images: Sequence[Any]) -> Any:
        own = zip(each, _apart(posed, contexts), images, strict=True)
        return _fields([b.of_parents(p, i) for b, p, i in own if b.of_parents], torch.stack)

    return replace(first, image=images, of_parents=of_parents)


def _fields(each: Sequence[Any], together: Callable[[list[Tensor]], Tensor]) -> Any:
    """A record of what is different, with the indices that all have."""
    fields = map(list, zip(*each, strict=True))
    return type(each[0])(*(together(f) if f[0].is_floating_point() else f[0] for f in fields))


def _one_picture(images: Sequence[Any]) -> Any:
    """The colours of all sequences in layers of one picture; other pictures as they are."""
    if not isinstance(images[0], RegionImages):
        return images
    fields, origins = [image.field.coefficients for image in images], [i.origin for i in images]
    left, top = map(min, zip(*origins, strict=True))
    sizes = [field.shape for field in fields]
    ends = [(x + w, y + h) for (x, y), (_, h, w) in zip(origins, sizes, strict=True)]
    right, bottom = map(max, zip(*ends, strict=True))
    whole = fields[0].new_zeros(len(fields), sizes[0][0], bottom - top, right - left)
    for into, field, (x, y), (_, h, w) in zip(whole, fields, origins, sizes, strict=True):
        into[:, y - top : y - top + h, x - left : x - left + w] = field
    layer = torch.stack([image.layer + s * sizes[0][0] for s, image in enumerate(images)])
    return RegionImages(SplineField(whole.flatten(0, 1)), layer, (left, top))


@frozen
class _OnPictures(OutlineTerm):
    """An outline term of which the nodes of each sequence look at a picture of their own."""

    name = "outline"

    term: OutlineTerm

    @classmethod
    def of(cls, term: OutlineTerm) -> _OnPictures:
        """From the term."""
        return cls(
            weight=term.weight,
            nu=term.nu,
            fitted_level=term.fitted_level,
            occlusion_factor=term.occlusion_factor,
            term=term,
        )

    def value(
        self, nodes: SeenNodes, camera: Camera, image: Any, at: Points | None = None
    ) -> Values:
        """See `OutlineTerm.value`."""
        return super().value(nodes, camera, _Pictures(image, nodes), at)

    def point_cost(
        self, nodes: SeenNodes, camera: Camera, image: Any, *, gauss_newton: bool = False
    ) -> PointCost:
        """See `OutlineTerm.point_cost`."""
        pictures = _Pictures(image, nodes)
        return super().point_cost(nodes, camera, pictures, gauss_newton=gauss_newton)

    def match(self, nodes: ImageNodes, image: _Pictures, at: Tensor | None = None) -> Tensor:
        """See `OutlineTerm.match`."""
        rows = nodes if at is None else (*nodes, at)
        shares = image.shares(rows)
        return torch.cat([self.term.match(ImageNodes(*r[:4]), i, *r[4:]) for r, i in shares])

    def derivatives(self, nodes: ImageNodes, image: _Pictures) -> Derivatives:
        """See `OutlineTerm.derivatives`."""
        found = [self.term.derivatives(ImageNodes(*r), i) for r, i in image.shares(nodes)]
        value, gradient, hessian = map(torch.cat, zip(*found, strict=True))
        return value, gradient, hessian

    def matched(self, match: Values) -> Values:
        """See `OutlineTerm.matched`."""
        return self.term.matched(match)


class _Pictures(NamedTuple):
    """What the nodes `[S b p]` of all sequences look at."""

    images: Any
    nodes: SeenNodes

    def shares(self, rows: Sequence[Tensor]) -> Iterable[tuple[Sequence[Tensor], Any]]:
        """Rows of nodes, the first of which are their places, by what they look at."""
        place, (number, batch, points) = rows[0], self.nodes.exists.shape
        if isinstance(self.images, RegionImages):
            layer = self.images.layer[:, None].expand(number, batch, points)
            return [(rows, self.images._replace(layer=layer.flatten()))]
        ends = torch.arange(1, number, device=place.device) * (batch * points)
        ends = [0, *torch.searchsorted(place, ends).tolist(), len(place)]
        spans = [slice(*span) for span in pairwise(ends)]
        return zip(([row[span] for row in rows] for span in spans), self.images, strict=True)
