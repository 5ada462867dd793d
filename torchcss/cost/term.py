"""The interface of a term: one cue or prior of the cost, one file.

A `Term` is a frozen choice of numbers. Each frame `prepare` binds it to one view of that frame
(`FrameContext`), or says None: this frame tells it nothing. What is bound is evaluated at batches
of posed bodies (`Posed`):

| kind | bound | gives |
|---|---|---|
| `image` | `BoundImage` | value and derivatives of each of its points, in the points' positions |
| `prior` | `OnStates` | value and derivatives in the state x |
| `weight-only` | `BoundWeight` | a value that counts in the weights of modes, not in the search |

To add a term, write a class that derives from `Term` and add it to
`torchcss.cost.choice.TERM_TABLE`. `differentiated` gives the derivatives of a term that has only a
value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.model import BodyModel, BodyPose
from torchcss.cost.context import FrameContext
from torchcss.types import Curvature, LocalModel, Numbers, PointCost, Vectors
from torchcss.vision.camera import Camera

Kind = Literal["image", "prior", "weight-only"]

Need = Literal["flow", "appearance", "background"]
"""What has to be computed or learnt from the pictures for a term: optical flow, the colours of the
parts, or the picture behind the body."""

Points = Float[Tensor, "*batch p 3"]
"""Positions of the points of a term, metres."""

Values = Float[Tensor, "*batch p"]
"""A number for each of them."""

_T = TypeVar("_T")


class Term(Protocol):
    """One cue or prior; a frozen dataclass of numbers.

    Attributes:
        name: Its name in the table, in results and in `CostChoice.weights`.
        kind: What `prepare` returns.
        watched: Whether its cost tells a loss of the track (`torchcss.inference.loss_monitor`).
        screens: Whether it counts where samples are screened ([RR] section 4.2: edges alone).
        of_past: Whether it says what the modes before make likely: it guides descents, and is left
            out where the weights of those modes are multiplied in.
        of_motion: Whether it says how a pose differs from the mode before that it came from.
        of_several: Whether what is bound serves several sequences at once, see
            `torchcss.cost.batched`; priors of which it is false are evaluated one by one.
    """

    name: ClassVar[str]
    kind: ClassVar[Kind]
    watched: ClassVar[bool] = False
    screens: ClassVar[bool] = False
    of_past: ClassVar[bool] = False
    of_motion: ClassVar[bool] = False
    of_several: ClassVar[bool] = False

    @property
    def needs(self) -> frozenset[Need]:
        """What the pictures have to be prepared for."""
        return frozenset()

    def coarse(self) -> Term | None:
        """The term in the coarse cost that finds what moved too fast; None: it is left out."""
        return self if self.kind == "prior" else None

    def prepare(self, context: FrameContext) -> BoundImage | OnStates | BoundWeight | None:
        """Bind the term to one view of one frame; None: the frame says nothing to it."""
        ...


class BoundImage(Protocol):
    """An image term that knows its frame."""

    @property
    def scale(self) -> float:
        """Nats per unit of a point's value: the temperature over N nu, eq. 5 [IJRR]."""
        ...

    @property
    def link(self) -> Int[Tensor, " p"]:
        """The link that carries each point."""
        ...

    @property
    def size(self) -> int:
        """Rows of memory that a sample takes, in points."""
        ...

    def points(self, posed: Posed) -> Points:
        """Positions of the points, metres."""
        ...

    def value(self, posed: Posed, at: Points | None = None) -> Values:
        """Value of each point.

        Args:
            posed: Where visibility and matches are found.
            at: Where the points have moved since, with all that was found held; None: nowhere.
        """
        ...

    def point_cost(self, posed: Posed, *, gauss_newton: bool = False) -> PointCost:
        """Value of each point and its derivatives in the point's position, all else held."""
        ...


class BoundWeight(NamedTuple):
    """A weight-only term that knows its frame.

    Attributes:
        scale: Nats per unit of the value.
        value: Value of each pose.
    """

    scale: float
    value: Callable[[Posed], Numbers]


class Posed:
    """A batch of posed bodies before one camera, and what several terms need of it.

    Args:
        context: The view.
        body: The body.
        pose: The posed bodies.
        parent: The mode of the frame before that each sample descends from; None: the first.
    """

    def __init__(
        self,
        context: FrameContext,
        body: BodyModel,
        pose: BodyPose,
        parent: Int[Tensor, " b"] | None = None,
    ) -> None:
        self.context, self.body, self.pose, self.parent = context, body, pose, parent
        self._found: dict[Any, Any] = {}

    @property
    def camera(self) -> Camera:
        """The camera that looks on."""
        return self.context.camera

    @property
    def x(self) -> Vectors:
        """The states."""
        return self.pose.x

    def of(self, find: Callable[[Posed], _T]) -> _T:
        """What a function finds at these poses, found once for all terms that ask."""
        if find not in self._found:
            self._found[find] = find(self)
        return self._found[find]

    def of_parent(self, values: Tensor) -> Tensor:
        """The rows of each sample's parent, of what has one row a mode."""
        return values[0] if self.parent is None else values[self.parent]


class PointTerm(Protocol):
    """What an image term on points of the body has to give; see `OnPoints`."""

    def value(self, found: Any, camera: Camera, image: Any, at: Tensor | None = None, /) -> Tensor:
        """Cost of every point, of which the image is compared with those `at` another place."""
        ...

    def point_cost(
        self, found: Any, camera: Camera, image: Any, /, *, gauss_newton: bool = False
    ) -> PointCost:
        """The same with first and second derivatives in the points' positions."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class OnPoints:
    """An image term on points of the body that knows its frame; a `BoundImage`.

    Attributes:
        term: The term.
        find: Finds the points of posed bodies, and what the term needs to know of them.
        image: What the term compares them with.
        link: The link of each point.
        scale: Nats per unit of a point's value.
        size: Rows of memory that a sample takes, in points.
        camera: The camera of what they are compared with; None: that of the view.
        of_parents: Picks what the points of each sample are compared with, by its parent; None: all
            samples' are compared with the same.
    """

    term: PointTerm
    find: Callable[[Posed], Any]
    image: Any
    link: Int[Tensor, " p"]
    scale: float
    size: int
    camera: Camera | None = None
    of_parents: Callable[[Posed, Any], Any] | None = None

    def points(self, posed: Posed) -> Points:
        """Positions of the points, metres."""
        found = posed.of(self.find)
        return found if isinstance(found, Tensor) else found.points

    def value(self, posed: Posed, at: Points | None = None) -> Values:
        """Cost of every point."""
        return self.term.value(*self._seen(posed), at)

    def point_cost(self, posed: Posed, *, gauss_newton: bool = False) -> PointCost:
        """Cost and derivatives of every point."""
        return self.term.point_cost(*self._seen(posed), gauss_newton=gauss_newton)

    def _seen(self, posed: Posed) -> tuple[Any, Camera, Any]:
        image = self.image if self.of_parents is None else self.of_parents(posed, self.image)
        return posed.of(self.find), self.camera or posed.camera, image


@dataclass(frozen=True, eq=False)
class OnStates:
    """A prior on states that knows its frame.

    Attributes:
        model: Cost and derivatives, by the curvature that is asked for.
        cost: The cost alone; None: it is as cheap with derivatives.
    """

    model: Callable[[Posed, Curvature], LocalModel]
    cost: Callable[[Posed], Tensor] | None = None

    def value(self, posed: Posed) -> Numbers:
        """Cost, nats."""
        if self.cost is not None:
            return self.cost(posed)
        return self.model(posed, Curvature.EXACT).value

    def local_model(self, posed: Posed, curvature: Curvature) -> LocalModel:
        """Cost and derivatives in the state."""
        return self.model(posed, curvature)


def differentiate_twice(value: Numbers, x: Vectors) -> LocalModel:
    """Gradient and Hessian of a batch of scalars by double backward, one row at a time.

    Args:
        value: Scalars that depend on `x`, item by item.
        x: The leaf to differentiate with respect to.
    """
    (gradient,) = torch.autograd.grad(value.sum(), x, create_graph=True)
    rows = [
        torch.autograd.grad(gradient[..., i].sum(), x, retain_graph=True, allow_unused=True)[0]
        if gradient.requires_grad
        else None
        for i in range(x.shape[-1])
    ]
    hessian = torch.stack([torch.zeros_like(x) if row is None else row for row in rows], dim=-2)
    return LocalModel(value.detach(), gradient.detach(), hessian.detach())


def differentiated(term: BoundImage, posed: Posed) -> PointCost:
    """Value and derivatives of a bound term by autograd, each point in its own position."""
    with torch.enable_grad():
        at = term.points(posed).detach().requires_grad_()
        return PointCost(*differentiate_twice(term.value(posed, at), at))
