"""Costs with closed-form derivatives and known minima, for the optimiser and the tracker."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.problem import SearchProblem
from torchcss.inference.tracker import SequenceTracker, TrackerInfo, TrackerState
from torchcss.types import Bounds, LocalModel


def box(n: int, lower: float, upper: float, dtype: torch.dtype = torch.float64) -> Bounds:
    """The same limits for every parameter."""
    return Bounds(torch.full((n,), lower, dtype=dtype), torch.full((n,), upper, dtype=dtype))


def unbounded(n: int, dtype: torch.dtype = torch.float64) -> Bounds:
    """No limits at all."""
    return box(n, -torch.inf, torch.inf, dtype)


def single(
    mean: tuple[float, float] = (2.0, 1.0), variance: tuple[float, float] = (1.0, 0.25)
) -> GaussianMixture:
    """One mode of two parameters."""
    covariance = torch.diag(torch.tensor(variance).double())
    return GaussianMixture(torch.tensor([mean]).double(), covariance[None], torch.zeros(1).double())


def follow(
    tracker: SequenceTracker,
    state: TrackerState,
    problems: Iterable[SearchProblem],
    bounds: Bounds,
) -> Iterator[tuple[TrackerState, TrackerInfo]]:
    """Step through a sequence, one problem a frame; yields what `step` returns."""
    for problem in problems:
        state, info = tracker.step(state, problem, bounds)
        yield state, info


class Alike:
    """A cost that is the same for all items."""

    def take(self, items: Tensor) -> Self:
        return self


@dataclass(frozen=True)
class AutogradCost(Alike):
    """Any scalar function of one state, differentiated by autograd: the reference for the rest."""

    function: Callable[[Tensor], Tensor]

    def value(self, x: Tensor) -> Tensor:
        flat = torch.vmap(self.function)(x.reshape(-1, x.shape[-1]))
        return flat.reshape(x.shape[:-1])

    def local_model(self, x: Tensor) -> LocalModel:
        flat = x.reshape(-1, x.shape[-1])
        gradient = torch.vmap(torch.func.jacrev(self.function))(flat)
        hessian = torch.vmap(torch.func.jacfwd(torch.func.jacrev(self.function)))(flat)
        return LocalModel(
            self.value(x), gradient.reshape(x.shape), hessian.reshape(*x.shape, x.shape[-1])
        )


@dataclass(frozen=True)
class Bowl(Alike):
    """A quadratic: its minimum is `minimum`, its covariance the inverse of `hessian`."""

    hessian: Tensor
    minimum: Tensor
    offset: float = 0.0

    def value(self, x: Tensor) -> Tensor:
        return self.local_model(x).value

    def local_model(self, x: Tensor) -> LocalModel:
        difference = x - self.minimum.to(x)
        hessian = self.hessian.to(x)
        gradient = (hessian @ difference[..., None])[..., 0]
        value = 0.5 * (gradient * difference).sum(-1) + self.offset
        return LocalModel(value, gradient, hessian.expand(*x.shape, x.shape[-1]))


@dataclass(frozen=True)
class ItemBowls:
    """One bowl per item of the batch: only `take` keeps the items and their minima together."""

    curvature: Tensor
    minimum: Tensor

    def take(self, items: Tensor) -> ItemBowls:
        return ItemBowls(self.curvature[items], self.minimum[items])

    def value(self, x: Tensor) -> Tensor:
        return self.local_model(x).value

    def local_model(self, x: Tensor) -> LocalModel:
        assert len(x) == len(self.minimum), "the cost was not restricted to the items evaluated"
        difference = x - self.minimum
        # A quartic, so that the items need different numbers of steps.
        value = (self.curvature * difference.pow(4)).sum(-1)
        gradient = 4 * self.curvature * difference.pow(3)
        return LocalModel(
            value, gradient, torch.diag_embed(12 * self.curvature * difference.pow(2))
        )


@dataclass(frozen=True)
class Rosenbrock(Alike):
    """The curved valley in n dimensions; the minimum at ones has the value zero."""

    steepness: float = 100.0

    def value(self, x: Tensor) -> Tensor:
        head, tail = x[..., :-1], x[..., 1:]
        return (self.steepness * (tail - head**2) ** 2 + (1 - head) ** 2).sum(-1)

    def local_model(self, x: Tensor) -> LocalModel:
        head, tail = x[..., :-1], x[..., 1:]
        residual = tail - head**2
        gradient = torch.zeros_like(x)
        gradient[..., :-1] += -4 * self.steepness * residual * head - 2 * (1 - head)
        gradient[..., 1:] += 2 * self.steepness * residual
        diagonal = torch.zeros_like(x)
        diagonal[..., :-1] += self.steepness * (8 * head**2 - 4 * residual) + 2
        diagonal[..., 1:] += 2 * self.steepness
        off = -4 * self.steepness * head
        hessian = (
            torch.diag_embed(diagonal)
            + torch.diag_embed(off, offset=1)
            + torch.diag_embed(off, offset=-1)
        )
        return LocalModel(self.value(x), gradient, hessian)


@dataclass(frozen=True)
class CosineSum(Alike):
    """Waves of random direction in a wide bowl: full of minima, saddles and maxima."""

    frequency: Tensor  # [m n]
    phase: Tensor  # [m]
    amplitude: Tensor  # [m]
    stiffness: float = 0.1

    @staticmethod
    def random(
        n: int,
        m: int,
        *,
        generator: torch.Generator,
        dtype: torch.dtype = torch.float64,
        stiffness: float = 0.1,
    ) -> CosineSum:
        def draw(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

        return CosineSum(draw(m, n), 3 * draw(m), 1 + draw(m).abs(), stiffness)

    def value(self, x: Tensor) -> Tensor:
        wave = self.amplitude * torch.cos(x @ self.frequency.T + self.phase)
        return wave.sum(-1) + 0.5 * self.stiffness * x.square().sum(-1)

    def local_model(self, x: Tensor) -> LocalModel:
        angle = x @ self.frequency.T + self.phase
        gradient = (-self.amplitude * torch.sin(angle)) @ self.frequency + self.stiffness * x
        curvature = -self.amplitude * torch.cos(angle)
        hessian = (self.frequency.T * curvature[..., None, :]) @ self.frequency
        hessian = hessian + self.stiffness * torch.eye(x.shape[-1], dtype=x.dtype)
        return LocalModel(self.value(x), gradient, hessian)


@dataclass(frozen=True)
class DoubleWell(Alike):
    """A long valley along the first parameter with two equal minima, as a limb flipped in depth.

    ``f(u, v) = barrier ((u / distance)^2 - 1)^2 + (v - slope u)^2 / (2 width^2) + tilt u``;
    for `tilt = 0` the minima are `(±distance, ±slope distance)`, both of value zero.
    """

    distance: float = 2.0
    barrier: float = 10.0
    width: float = 0.05
    slope: float = 0.5
    tilt: float = 0.0

    @property
    def minima(self) -> Tensor:
        u = torch.tensor([-self.distance, self.distance], dtype=torch.float64)
        return torch.stack([u, self.slope * u], -1)

    def value(self, x: Tensor) -> Tensor:
        return self.local_model(x).value

    def local_model(self, x: Tensor) -> LocalModel:
        u, v = x[..., 0], x[..., 1]
        across = (v - self.slope * u) / self.width**2
        well = (u / self.distance) ** 2 - 1
        value = self.barrier * well**2 + 0.5 * self.width**2 * across**2 + self.tilt * u
        first = 4 * self.barrier * well * u / self.distance**2 + self.tilt
        second = 4 * self.barrier * (3 * (u / self.distance) ** 2 - 1) / self.distance**2
        gradient = torch.stack([first - self.slope * across, across], -1)
        stiff = torch.full_like(u, 1 / self.width**2)
        hessian = torch.stack(
            [second + self.slope**2 * stiff, -self.slope * stiff, -self.slope * stiff, stiff], -1
        ).reshape(*u.shape, 2, 2)
        return LocalModel(value, gradient, hessian)


@dataclass(frozen=True)
class Jumping(Alike):
    """A cost whose value jumps by up to `height`, as when an edge match changes; smooth model."""

    smooth: CosineSum
    height: float = 1e-2

    def _jump(self, x: Tensor) -> Tensor:
        return self.height * torch.frac(1e4 * x.sum(-1)).abs()

    def value(self, x: Tensor) -> Tensor:
        return self.smooth.value(x) + self._jump(x)

    def local_model(self, x: Tensor) -> LocalModel:
        model = self.smooth.local_model(x)
        return model._replace(value=model.value + self._jump(x))


@dataclass(frozen=True)
class ReprojectedLimbs(Alike):
    """Limbs on a free root seen by one camera: joint centres against their image positions.

    The state is the root's translation and rotation, then `joints` angles for each of `limbs`
    chains. Depth is what one view tells least about, so every limb has forwards and backwards
    minima. With `truth` given as the state that made the observations, the cost there is zero.
    """

    truth: Tensor  # [n]
    limbs: int = 4
    joints: int = 7
    deviation: float = 0.01
    prior_deviation: float = 10.0

    @property
    def num_parameters(self) -> int:
        return 6 + self.limbs * self.joints

    def _forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Joint axes, joint origins, points and which joints move which points."""
        batch, n = x.shape[:-1], x.shape[-1]
        eye = torch.eye(3, dtype=x.dtype).expand(*batch, 3, 3)
        axes, origins = [], []

        def rotate(frame: Tensor, axis: int, angle: Tensor) -> Tensor:
            a, b = (axis + 1) % 3, (axis + 2) % 3
            cosine, sine = torch.cos(angle)[..., None], torch.sin(angle)[..., None]
            columns = list(frame.unbind(-1))
            columns[a], columns[b] = (
                cosine * columns[a] + sine * columns[b],
                cosine * columns[b] - sine * columns[a],
            )
            return torch.stack(columns, -1)

        position = x[..., :3] + x.new_tensor([0.0, 0.0, 4.0])
        for axis in range(3):
            axes.append(eye[..., axis])
            origins.append(position)
        frame = eye
        for axis in range(3):
            axes.append(frame[..., axis])
            origins.append(position)
            frame = rotate(frame, axis, x[..., 3 + axis])
        points = [position, position + 0.3 * frame[..., 0], position + 0.3 * frame[..., 1]]
        moves = [[True] * 6 + [False] * (n - 6)] * 3
        for limb in range(self.limbs):
            angle = 2 * torch.pi * torch.tensor(limb / self.limbs)
            arm = x.new_tensor([float(torch.cos(angle)), float(torch.sin(angle)), 0.0])
            limb_frame, centre = frame, position + 0.2 * (frame @ arm)
            points.append(centre)
            moves.append([True] * 6 + [False] * (n - 6))
            first = 6 + limb * self.joints
            for joint in range(self.joints):
                axes.append(limb_frame[..., joint % 3])
                origins.append(centre)
                limb_frame = rotate(limb_frame, joint % 3, x[..., first + joint])
                if joint % 3 == 2 or joint == self.joints - 1:
                    centre = centre + 0.3 * (limb_frame @ arm)
                    points.append(centre)
                    last = first + joint + 1
                    moves.append([k < 6 or first <= k < last for k in range(n)])
        return (
            torch.stack(axes, -2),
            torch.stack(origins, -2),
            torch.stack(points, -2),
            torch.tensor(moves),
        )

    def _observed(self, x: Tensor) -> Tensor:
        points = self._forward(self.truth.to(x))[2]
        return points[..., :2] / points[..., 2:]

    def value(self, x: Tensor) -> Tensor:
        points = self._forward(x)[2]
        residual = (points[..., :2] / points[..., 2:] - self._observed(x)) / self.deviation
        prior = (x - self.truth.to(x)) / self.prior_deviation
        return 0.5 * residual.square().sum((-2, -1)) + 0.5 * prior.square().sum(-1)

    def local_model(self, x: Tensor) -> LocalModel:
        n = x.shape[-1]
        axes, origins, points, moves = self._forward(x)
        depth = points[..., 2:]
        image = points[..., :2] / depth
        residual = (image - self._observed(x)) / self.deviation**2
        zero = torch.zeros_like(depth)
        one = torch.ones_like(depth)
        # d image / d point and the residual-weighted second derivative of the projection.
        project = torch.stack(
            [
                torch.cat([one, zero, -image[..., :1]], -1) / depth,
                torch.cat([zero, one, -image[..., 1:]], -1) / depth,
            ],
            -2,
        )
        force = (project.mT @ residual[..., None])[..., 0]
        bend = torch.zeros_like(project.mT @ project)
        bend[..., :2, 2] = -residual / depth**2
        bend[..., 2, :2] = bend[..., :2, 2]
        bend[..., 2, 2] = 2 * (residual * image).sum(-1) / depth[..., 0] ** 2
        stiffness = project.mT @ project / self.deviation**2 + bend

        lever = points[..., :, None, :] - origins[..., None, :, :]
        axis = axes[..., None, :, :].expand_as(lever)
        turning = torch.arange(n) >= 3
        jacobian = torch.where(turning[:, None], torch.linalg.cross(axis, lever), axis)
        jacobian = jacobian * moves[..., None].to(x)  # [*batch p n 3]
        gradient = (jacobian * force[..., None, :]).sum((-3, -1))
        columns = jacobian @ stiffness
        hessian = torch.einsum("...pia,...pja->...ij", columns, jacobian)
        moment = torch.linalg.cross(jacobian, force[..., None, :].expand_as(jacobian)).sum(-3)
        curve = torch.where(turning[:, None], axes @ moment.mT, 0.0)  # i above j
        above = torch.stack([moves[moves[:, j]].any(0) & (torch.arange(n) <= j) for j in range(n)])
        curve = torch.where(above.T, curve, 0.0)
        hessian = hessian + curve + curve.triu(1).mT
        prior = (x - self.truth.to(x)) / self.prior_deviation
        gradient = gradient + prior / self.prior_deviation
        hessian = hessian + torch.eye(n, dtype=x.dtype) / self.prior_deviation**2
        value = 0.5 * self.deviation**2 * residual.square().sum(
            (-2, -1)
        ) + 0.5 * prior.square().sum(-1)
        return LocalModel(value, gradient, hessian)
