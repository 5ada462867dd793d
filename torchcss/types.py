"""Records and enums that the whole package shares.

Axis letters used in shape annotations everywhere:

| letter | axis |
|---|---|
| `*batch` | any leading dimensions (samples, modes, frames) |
| `n` | state parameters |
| `q` | joints of the kinematic tree (every one of one degree of freedom) |
| `l` | links of the tree |
| `p` | surface points |
| `j` | named joint centres |
| `k` | modes of a mixture |
| `t` | frames |
| `h w` | image rows and columns |

Units are metres, radians, seconds, pixels (pixel centres at integers) and nats.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import NamedTuple, Protocol, Self, TypeVar, dataclass_transform

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

Class = TypeVar("Class")


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field,))
def frozen(cls: type[Class]) -> type[Class]:
    """Make a class a choice: a dataclass that never changes, and whose fields are given by name."""
    return dataclass(frozen=True, kw_only=True)(cls)


Vector = Float[Tensor, " n"]
"""One number for each parameter."""

Vectors = Float[Tensor, "*batch n"]
"""A state of each item, or a derivative in it."""

Matrices = Float[Tensor, "*batch n n"]
"""A Hessian or a covariance of each item."""

Numbers = Float[Tensor, "*batch"]
"""One number for each item, such as its cost in nats."""

Trajectory = Float[Tensor, "t n"]
"""A state in every frame, or a derivative in it."""

Times = Float[Tensor, " t"]
"""Seconds at which the frames were shown, increasing."""

Items = Int[Tensor, " m"]
"""Which items, by index."""

ColourImage = UInt8[np.ndarray, "h w 3"]
"""Red, green and blue, 0 to 255."""


def as_array(tensor: Tensor) -> np.ndarray:
    """A tensor's numbers for NumPy, float64."""
    return tensor.double().numpy(force=True)


class LocalModel(NamedTuple):
    """A cost and its first two derivatives at a state; the quadratic model of eq. 11 and 12 [IJRR].

    Attributes:
        value: Cost in nats.
        gradient: First derivative with respect to the state.
        hessian: Second derivative, symmetric; it may be indefinite.
    """

    value: Numbers
    gradient: Vectors
    hessian: Matrices

    def at(self, step: Vectors) -> Numbers:
        """What the quadratic model says of the cost a step away."""
        curved = (self.hessian @ step[..., None])[..., 0]
        return self.value + (step * (self.gradient + 0.5 * curved)).sum(-1)

    def plus(self, other: LocalModel, weight: float = 1.0) -> LocalModel:
        """The sum with another cost, so many times."""
        return LocalModel(*(a + weight * b for a, b in zip(self, other, strict=True)))


class PointCost(NamedTuple):
    """A cost per 3D point with its derivatives with respect to that point, world frame.

    Attributes:
        value: Cost of each point in nats.
        gradient: First derivative, nats per metre.
        hessian: Second derivative, symmetric, nats per square metre.
    """

    value: Float[Tensor, "*batch p"]
    gradient: Float[Tensor, "*batch p 3"]
    hessian: Float[Tensor, "*batch p 3 3"]


class Bounds(NamedTuple):
    """Box limits on the state, the constraints `C_bl x < 0` of section 3.2.3 [IJRR].

    Attributes:
        lower: Least admissible value; `-inf` where there is none.
        upper: Greatest admissible value; `inf` where there is none.
    """

    lower: Vector
    upper: Vector

    def project(self, x: Vectors) -> Vectors:
        """Return the nearest admissible state."""
        return x.clamp(self.lower.to(x), self.upper.to(x))

    def to(self, like: Tensor) -> Bounds:
        """The same in the type and on the device of a tensor."""
        return Bounds(self.lower.to(like), self.upper.to(like))

    def hold(self, x: Vectors, gradient: Vectors) -> Bool[Tensor, "*batch n"]:
        """Variables at a bound that a cost of this gradient pushes against it."""
        return ((x <= self.lower) & (gradient > 0)) | ((x >= self.upper) & (gradient < 0))


class Curvature(Enum):
    """Which second derivative `BodyModel.lift` returns."""

    EXACT = "exact"
    """Closed form, with the second-order kinematics."""
    GAUSS_NEWTON = "gauss-newton"
    """Without the second-order kinematics, eq. 9 of [RR]."""
    AUTOGRAD = "autograd"
    """Double backward through the kinematics: slow, the reference for the other two."""


class Status(IntEnum):
    """Why the optimiser stopped on one item."""

    RUNNING = 0
    """It has not."""
    CONVERGED = 1
    """A Newton step promises to lower the cost by less than the tolerance."""
    SMALL_STEP = 2
    """Short steps lower the cost by less than that, as where it jumps or has a kink."""
    STEP_LIMIT = 3
    """There were `max_steps`."""
    NON_FINITE = 4
    """The cost is not finite at the start."""


class Modes(NamedTuple):
    """What the optimiser returns for every start.

    Attributes:
        mean: The states reached.
        covariance: Inverse Hessian on the free variables (decision "active bounds"), no direction
            wider than the prior: `prior_variance` of `TrustRegionNewton.minimise`.
        cost: Cost at `mean`, nats.
        active: True where a variable ended at a bound that holds it.
        status: A `Status` per item.
        num_steps: Iterations taken per item.
    """

    mean: Vectors
    covariance: Matrices
    cost: Numbers
    active: Int[Tensor, "*batch n"]
    status: Int[Tensor, "*batch"]
    num_steps: Int[Tensor, "*batch"]

    def take(self, items: Items | slice | int) -> Modes:
        """Some of the items, of the first leading dimension."""
        return Modes(*(field[items] for field in self))


class Differentiable(Protocol):
    """Anything that gives a cost and its derivatives, item by item."""

    def local_model(self, x: Vectors) -> LocalModel:
        """Cost, gradient and Hessian at `x`, image matches held fixed."""
        ...


class CostFunction(Differentiable, Protocol):
    """Anything that the optimiser can search: the negative log posterior, eq. 3."""

    def value(self, x: Vectors) -> Numbers:
        """Cost in nats; a pure function of `x`."""
        ...

    def take(self, items: Items) -> CostFunction:
        """The cost of some items of the batch; itself, where all items have the same cost."""
        ...


class BlendedCost(ABC):
    """A `CostFunction` with a Hessian that is positive far from the minimum, and exact at it.

    A cost says that it is one by being derived from this: the optimiser looks for no method.
    """

    @abstractmethod
    def value(self, x: Vectors) -> Numbers:
        """Cost in nats; a pure function of `x`."""

    @abstractmethod
    def local_model(self, x: Vectors) -> LocalModel:
        """Cost, gradient and exact Hessian at `x`."""

    @abstractmethod
    def blended_model(self, x: Vectors, share: Numbers) -> LocalModel:
        """Cost, gradient and a share, 0 to 1, of the second-order parts of the Hessian."""

    @abstractmethod
    def take(self, items: Items) -> CostFunction:
        """The cost of some items of the batch."""


class Keypoints(NamedTuple):
    """2D joints of one body, in one image or in every frame of a sequence.

    Attributes:
        positions: Pixels, centres at integers.
        confidence: From 0, not known, to 1.
        names: Name of every joint: the catalogue's, or the file's own where that has none.
        relative_noise: Standard deviation in multiples of what the cost's joint term is told, since
            views in which the body is larger have more pixels of noise.
        report: What a reader recognised, chosen or corrected, one line each.
        points: Where a detector believes them in space, metres, in the camera's axes from any
            origin; NaN where it does not say. The search for a first pose starts from them as well;
            no cost compares with them.
    """

    positions: Float[Tensor, "*t j 2"]
    confidence: Float[Tensor, "*t j"]
    names: tuple[str, ...]
    relative_noise: float = 1.0
    report: tuple[str, ...] = ()
    points: Float[Tensor, "*t j 3"] | None = None

    @property
    def known(self) -> Bool[Tensor, "*t j"]:
        """Which joints are known: those of some confidence that are somewhere."""
        return (self.confidence > 0) & self.positions.isfinite().all(-1)

    @property
    def says_nothing(self) -> bool:
        """Whether no joint is known, as in a frame in which nobody was detected."""
        return not bool(self.known.any())

    def at(self, frame: int | Int[Tensor, " s"]) -> Self:
        """The keypoints of one frame, or of some."""
        return self._replace(
            positions=self.positions[frame],
            confidence=self.confidence[frame],
            points=None if self.points is None else self.points[frame],
        )

    def only(self, names: tuple[str, ...]) -> Self:
        """Those of some joints, in the order in which they are."""
        columns = [column for column, name in enumerate(self.names) if name in names]
        return self._replace(
            positions=self.positions[..., columns, :],
            confidence=self.confidence[..., columns],
            names=tuple(self.names[column] for column in columns),
            points=None if self.points is None else self.points[..., columns, :],
        )

    def without(self, joints: Bool[Tensor, "*t j"]) -> Self:
        """The same with some joints not known."""
        return self._replace(confidence=torch.where(joints, 0.0, self.confidence))

    def scaled(self, from_wh: tuple[int, int], to_wh: tuple[int, int]) -> Self:
        """The same in pixels of the image at another size.

        Args:
            from_wh: Width and height of the image that they are in now.
            to_wh: Width and height of the resized image.
        """
        factor = self.positions.new_tensor([to_wh[0] / from_wh[0], to_wh[1] / from_wh[1]])
        return self._replace(positions=(self.positions + 0.5) * factor - 0.5)

    def to(self, like: Tensor) -> Self:
        """The same in the type and on the device of a tensor."""
        return self._replace(
            positions=self.positions.to(like),
            confidence=self.confidence.to(like),
            points=None if self.points is None else self.points.to(like),
        )


TIME_ROUNDING = 1 / 600
"""Seconds by which containers round the time between two frames, at most: QuickTime counts 600ths,
Matroska thousandths. Frames that are evenly spaced but for that are tracked as if their times were
not known: at 30 a second it would move deviations by less than 3 %, far less than is known of
them."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One image of a video.

    Attributes:
        index: Place in the file, from 0, whatever part of the file is read.
        time_s: Seconds since the file's first frame. Where the file's own times do not rise from
            one frame to the next, it is an interval of its frame rate after the last.
        image: Red, green, blue.
        mask: Foreground of the image, of its size, white or in shades of belief; None: not known.
    """

    index: int
    time_s: float
    image: ColourImage
    mask: UInt8[np.ndarray, "h w *c"] | None = None
