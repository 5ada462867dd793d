"""Counting minima honestly: which ends of descents are minima, and which of them are the same.

Table 1 [IJRR] counts the minima that a sampler finds. The count is worth as much as the tests that
an end of a descent has to pass:

* `is_minimum`: the descent converged inside the bounds, and the cost curves upwards along all the
  variables that no bound holds. What stopped at a saddle or on a slope is no minimum.
* `distinct_modes` (`torchcss.inference.mixture`): minima closer than a standard deviation are one.
  With descents that converged, the number hardly depends on that threshold: halve and double it.
* `joined_minima`: two minima that a path connects along which the cost never rises by more than a
  fraction of a nat are one valley with a ripple, however far apart they are. This is the count
  that depends on no metric; a straight path decides nothing in a curved valley, so that the path is
  relaxed onto its floor.

What to call: `find_minima` samples, descends and applies the first two; `other_minima` counts again
with another threshold, and `joined_minima` where a plateau in the second is in doubt.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.inference.mixture import GaussianMixture, distinct_modes
from torchcss.inference.proposals import Proposal
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.linalg import mask_free, squared_mahalanobis
from torchcss.types import Bounds, CostFunction, Items, LocalModel, Modes, Status


class MinimumTests(NamedTuple):
    """What each end of a descent passes.

    Attributes:
        converged: The optimiser says so.
        inside: It satisfies the bounds.
        upward: No negative curvature on the variables that no bound holds, to within rounding;
            False where the curvature is not finite.
    """

    converged: Bool[Tensor, "*batch"]
    inside: Bool[Tensor, "*batch"]
    upward: Bool[Tensor, "*batch"]

    @property
    def all(self) -> Bool[Tensor, "*batch"]:
        """Passes every test."""
        return self.converged & self.inside & self.upward


def is_minimum(modes: Modes, cost: CostFunction, bounds: Bounds) -> MinimumTests:
    """Test the ends of descents with derivatives evaluated afresh.

    Args:
        modes: What the optimiser returned.
        cost: What it minimised.
        bounds: The limits that it obeyed.
    """
    x = modes.mean
    inside = ((x >= bounds.lower.to(x)) & (x <= bounds.upper.to(x))).all(-1)
    finite = modes.status != Status.NON_FINITE
    safe = torch.where(finite[..., None], x, bounds.project(torch.zeros_like(x)))
    hessian = cost.local_model(safe).hessian.detach()
    # `eigvalsh` raises for all items if one is not finite: such a one is tested as the identity.
    finite = finite & hessian.flatten(-2).isfinite().all(-1)
    hessian = mask_free(hessian, ~modes.active.bool() & finite[..., None])
    # In units in which every curvature is one at most: rounding is then the same for all.
    size = hessian.diagonal(dim1=-2, dim2=-1).abs().clamp(min=torch.finfo(x.dtype).tiny).sqrt()
    least = torch.linalg.eigvalsh(hessian / size[..., :, None] / size[..., None, :])[..., 0]
    rounding = 8 * x.shape[-1] * torch.finfo(x.dtype).eps
    return MinimumTests(modes.status == Status.CONVERGED, inside, finite & (least > -rounding))


@dataclass(frozen=True)
class _NearPlane:
    """A cost with a stiff spring to the plane through a point, one plane per item."""

    cost: CostFunction
    point: Float[Tensor, "b n"]
    normal: Float[Tensor, "b n"]
    stiffness: Float[Tensor, " b"]

    def take(self, items: Items) -> _NearPlane:
        return _NearPlane(
            self.cost.take(items), self.point[items], self.normal[items], self.stiffness[items]
        )

    def value(self, x: Float[Tensor, "b n"]) -> Float[Tensor, " b"]:
        off = ((x - self.point) * self.normal).sum(-1)
        return self.cost.value(x) + 0.5 * self.stiffness * off.square()

    def local_model(self, x: Float[Tensor, "b n"]) -> LocalModel:
        model = self.cost.local_model(x)
        off = ((x - self.point) * self.normal).sum(-1)
        pull = self.stiffness[:, None] * self.normal
        return LocalModel(
            model.value + 0.5 * self.stiffness * off.square(),
            model.gradient + off[:, None] * pull,
            model.hessian + pull[:, :, None] * self.normal[:, None, :],
        )


_NEIGHBOURS = 3
"""How many lower minima each is tried against."""

_STEPS = 200
"""Steps of a descent from a sample, which nearly all converge in."""

_CHECKS = 5
"""Interior points at which the cost along a straight segment is evaluated."""

RISE, DEPTH = 0.1, 5
"""Nats by which a path may rise above its higher end, and how often its segments are halved."""


def low_path(
    cost: CostFunction,
    first: Float[Tensor, "p n"],
    second: Float[Tensor, "p n"],
    bounds: Bounds,
) -> Bool[Tensor, " p"]:
    """Whether a path is found between two states that stays below the higher one plus `RISE`.

    A straight segment along which the cost stays low is a path. One along which it does not is cut
    in two at the lowest point of the plane that halves it, near the valley's floor, and both halves
    are tried, up to `2^DEPTH` pieces. True is a proof, up to what lies between the points checked;
    False only says that this search found no path.

    Args:
        cost: The same for all states (without items of its own).
        first: One end of each path.
        second: The other.
        bounds: Box limits; a box is convex, so that segments stay inside.
    """
    n = first.shape[-1]
    ends = torch.stack([first, second], 1)
    limit = cost.value(ends.reshape(-1, n)).reshape(-1, 2).amax(-1) + RISE
    found = torch.ones_like(limit, dtype=torch.bool)
    # Segments that are still to be shown low, and the pair that each belongs to.
    pair = torch.arange(len(first), device=first.device)
    start, end = first, second
    optimiser = TrustRegionNewton(max_steps=50, tolerance=1e-3 * RISE)
    share = torch.arange(1, _CHECKS + 1, device=first.device).to(first)[:, None] / (_CHECKS + 1)
    for _ in range(DEPTH + 1):
        if not len(pair):
            return found
        inner = start[:, None] + share * (end - start)[:, None]
        height = cost.value(inner.reshape(-1, n)).reshape(-1, _CHECKS).amax(-1)
        high = ~(height <= limit[pair])
        start, end, pair = start[high], end[high], pair[high]
        if not len(pair):
            return found
        along, middle = end - start, 0.5 * (start + end)
        length = along.norm(dim=-1, keepdim=True)
        normal = along / torch.where(length > 0, length, 1.0)
        # A tenth of the way to an end costs a hundred times the rise.
        stiffness = 2 * 100 * RISE / (0.1 * torch.where(length > 0, length, 1.0)[:, 0]).square()
        plane = _NearPlane(cost, middle, normal, stiffness)
        middle = optimiser.minimise(plane, middle, bounds).mean
        blocked = ~(cost.value(middle) <= limit[pair])
        found[pair[blocked]] = False
        # A pair with one blocked segment is lost; its other segments need no more work.
        going = found[pair]
        start, middle, end, pair = start[going], middle[going], end[going], pair[going]
        start, end = torch.cat([start, middle]), torch.cat([middle, end])
        pair = torch.cat([pair, pair])
    found[pair] = False
    return found


def joined_minima(
    cost: CostFunction,
    mean: Float[Tensor, "m n"],
    covariance: Float[Tensor, "m n n"],
    value: Float[Tensor, " m"],
    bounds: Bounds,
) -> Items:
    """Find out which minima are one valley: joined by paths along which the cost hardly rises.

    Every minimum is tried against the lower ones that are nearest to it in their own metrics.

    Args:
        cost: The same for all states.
        mean: The minima.
        covariance: Their covariances.
        value: Their costs, nats.
        bounds: Box limits.

    Returns:
        For each minimum, the index of the lowest minimum of its valley; as many valleys as there
        are different ones.
    """
    num = len(mean)
    label = torch.arange(num, device=mean.device)
    if num < 2:
        return label
    distance = GaussianMixture(mean, covariance, torch.zeros_like(value)).squared_distance(mean)
    rank = value.argsort(stable=True).argsort()
    distance = torch.where(rank[None, :] < rank[:, None], distance, torch.inf)
    near, lower = distance.topk(min(_NEIGHBOURS, num - 1), largest=False)
    higher = torch.arange(num, device=mean.device)[:, None].expand_as(lower)
    pairs = near.isfinite()
    low = low_path(cost, mean[higher[pairs]], mean[lower[pairs]], bounds)
    for child, parent in zip(higher[pairs][low].tolist(), lower[pairs][low].tolist(), strict=True):
        one, other = int(label[child]), int(label[parent])
        best, worse = (one, other) if rank[one] <= rank[other] else (other, one)
        label[label == worse] = best
    return label


class FoundMinima(NamedTuple):
    """What one run of a sampler finds, beside the minimum that it starts from.

    Attributes:
        raw: The samples.
        modes: Where each descended to.
        tests: Which of these are minima.
        minima: Which of these are minima different from the start and from each other, by ascending
            cost.
    """

    raw: Float[Tensor, "s n"]
    modes: Modes
    tests: MinimumTests
    minima: Items


def other_minima(
    modes: Modes, tests: MinimumTests, start: Modes, *, distance: float = 1.0
) -> Items:
    """Minima that are neither the start nor one found before, by ascending cost.

    Args:
        modes: Ends of descents.
        tests: What they pass.
        start: A single mode, without batch dimension.
        distance: Threshold of `distinct_modes`; a minimum so close to the start, in the metric of
            the start, is the start.
    """
    value = torch.where(tests.all, modes.cost, torch.inf)
    apart = squared_mahalanobis(modes.mean - start.mean, start.covariance)
    value = torch.where(apart > distance**2, value, torch.inf)
    return distinct_modes(modes.mean, modes.covariance, value, distance=distance)


def find_minima(
    cost: CostFunction,
    start: Modes,
    bounds: Bounds,
    *,
    proposal: Proposal,
    num_samples: int,
    generator: torch.Generator,
    distance: float = 1.0,
) -> FoundMinima:
    """Sample around a mode, descend from every sample, and count: a run of Table 1 [IJRR].

    Args:
        cost: What to search; the same for all samples.
        start: A single mode, without batch dimension.
        bounds: Box limits.
        proposal: Where samples go.
        num_samples: How many.
        generator: Source of the samples.
        distance: See `other_minima`.
    """
    mixture = GaussianMixture(
        start.mean[None], start.covariance[None], torch.zeros_like(start.cost)[None]
    )
    raw = proposal.sample(mixture, num_samples, bounds, generator=generator).x
    modes = TrustRegionNewton(max_steps=_STEPS).minimise(cost, raw, bounds)
    tests = is_minimum(modes, cost, bounds)
    return FoundMinima(raw, modes, tests, other_minima(modes, tests, start, distance=distance))
