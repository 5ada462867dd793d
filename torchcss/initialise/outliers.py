"""Marks that are no marks of their joints: found by leaving them out, one after another.

A detector or a person may mark a joint at a wrong place altogether. The robust potential pulls
towards such a mark only a little, but one image tells so little of depth that a little is enough to
bend a limb the wrong way. So every mark is either one of its joint, with the cost that the joint
term gives it, or a gross one, whose place says nothing: a mixture of two likelihoods. If a share
`e` of all marks is gross and these lie anywhere in an image of area A, leaving a mark out costs

    log((1 - e) / e * A / (2 pi sigma^2 s^2))

nats (about 14 for two pixels of noise), `s` its joint's own spread. A mark is left out if that
makes the best fit to the others cheaper by more. This needs a fit, because the error of a gross
mark often shows at its neighbours; and since no mark can save more than the whole fit costs, clean
marks are all kept without looking at them one by one.

Call `explain` in place of `torchcss.initialise.multi_start.find_interpretations`.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.cost.joints import JointObservation
from torchcss.cost.total import TrackingCost
from torchcss.inference.mixture import distinct_modes
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.initialise.multi_start import Search, descend, find_interpretations
from torchcss.types import Modes

SHARE = 0.05
"""Share of gross marks that is expected."""

_MOST = 0.3
"""Largest share of marks that may be left out: if more do not fit, it is the fit that is wrong."""

_NUM_TRIED = 6
"""Best fits from which every mark is left out in turn."""


def explain(
    cost: TrackingCost, *, search: Search, generator: torch.Generator
) -> tuple[Modes, Bool[Tensor, " m"]]:
    """Find the interpretations of the marks, and which of these are better left out.

    Args:
        cost: Keypoints and priors of one image; its body hangs before the camera.
        search: How widely to look.
        generator: Source of the starts.

    Returns:
        The distinct fits to the marks that are kept, the best first, and which marks are left out.
    """
    fits = best_distinct(find_interpretations(cost, search=search, generator=generator))
    assert cost.observation is not None
    gross = torch.zeros_like(cost.observation.weight, dtype=torch.bool)
    if search.leave_out:
        gross = leave_out(cost, fits, search)
    if not bool(gross.any()):
        return fits, gross
    # What looks gross from a wrong fit may be right from the one that is found without it.
    fits = best_distinct(
        find_interpretations(without(cost, gross), search=search, generator=generator)
    )
    fits, gross = _put_back(cost, fits, gross, search)
    return fits, gross


def leave_out(cost: TrackingCost, fits: Modes, search: Search) -> Bool[Tensor, " m"]:
    """Leave marks out, one at a time, as long as that pays; none if that would be very many.

    Args:
        cost: The cost with all marks.
        fits: Its fits, the best first.
        search: Limits and effort.

    Returns:
        Which marks are gross.
    """
    assert cost.observation is not None
    weight = cost.observation.weight
    gross, price = torch.zeros_like(weight, dtype=torch.bool), price_of_leaving_out(cost)
    seen = int((weight > 0).sum())
    while True:
        now = float(fits.cost[0])
        tried = torch.nonzero((weight > 0) & ~gross & (price < now))[:, 0].tolist()
        if not tried:
            return gross
        more = gross.repeat(len(tried), 1)
        more[torch.arange(len(tried)), tried] = True
        starts = fits.mean[:_NUM_TRIED]
        ends = refine(
            _EachWithout.of(cost, more.repeat_interleave(len(starts), dim=0)),
            starts.repeat(len(tried), 1), search,
        )  # fmt: skip
        ends = Modes(*(field.unflatten(0, (len(tried), -1)) for field in ends))
        total = ends.cost.amin(-1) + price[tried]
        best = int(total.argmin())
        if float(total[best]) >= now:
            return gross
        if int(more[best].sum()) > _MOST * seen:
            return torch.zeros_like(gross)
        gross, fits = more[best], best_distinct(Modes(*(field[best] for field in ends)))


def _put_back(
    cost: TrackingCost, fits: Modes, gross: Bool[Tensor, " m"], search: Search
) -> tuple[Modes, Bool[Tensor, " m"]]:
    """Use the marks again that fit after all."""
    price = price_of_leaving_out(cost)
    for mark in torch.nonzero(gross)[:, 0].tolist():
        fewer = gross.clone()
        fewer[mark] = False
        tried = refine(without(cost, fewer), fits.mean[:_NUM_TRIED], search)
        if float(tried.cost.min()) < float(fits.cost[0] + price[mark]):
            fits, gross = best_distinct(refine(without(cost, fewer), fits.mean, search)), fewer
    return fits, gross


class _EachWithout(TrackingCost):
    """The same cost, for every item without some marks of its own."""

    @classmethod
    def of(cls, cost: TrackingCost, gross: Bool[Tensor, "b m"]) -> _EachWithout:
        """Make it from a cost and the marks that each item is without."""
        fields = {field.name: getattr(cost, field.name) for field in dataclasses.fields(cost)}
        return cls(**{**fields, "observation": without(cost, gross).observation})

    def take(self, items: Int[Tensor, " s"]) -> _EachWithout:
        """The cost of some of the items."""
        assert self.observation is not None
        observation = copy.copy(self.observation)
        observation.weight = observation.weight[items]
        return replace(self, observation=observation)


def price_of_leaving_out(cost: TrackingCost) -> Float[Tensor, " m"]:
    """What it costs to call a mark gross, nats; a confidence counts as a wider spread."""
    joints, observation = cost.choice.joints, cost.observation
    assert joints is not None
    assert observation is not None
    width, height = cost.camera.image_size_wh
    odds = (1 - SHARE) / SHARE * width * height / (2 * math.pi * joints.sigma**2)
    return (odds * observation.weight).clamp(min=1.0).log()


def capped_cost(cost: TrackingCost, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch"]:
    """Cost in nats if no mark costs more than leaving it out."""
    joints, observation = cost.choice.joints, cost.observation
    assert joints is not None
    assert observation is not None
    projection = cost.camera.project(cost.body.pose(x).joints[..., observation.index, :])
    each = cost.choice.joint_weight * joints.value(projection, observation)
    return cost.value(x) - (each - price_of_leaving_out(cost)).clamp(min=0.0).sum(-1)


def without(cost: TrackingCost, gross: Bool[Tensor, "*b m"]) -> TrackingCost:
    """The same cost without some marks."""
    assert cost.observation is not None
    observation: JointObservation = copy.copy(cost.observation)
    observation.weight = torch.where(gross, 0.0, observation.weight)
    return replace(cost, observation=observation)


def refine(cost: TrackingCost, x: Float[Tensor, "b n"], search: Search) -> Modes:
    """Descend from fits to other marks or with other lengths: wide at first, then to the end."""
    bounds = search.bounds(cost.body)
    x = descend(cost, x, bounds, ((4.0, 8),))
    return TrustRegionNewton(max_steps=60, tolerance=1e-3).minimise(cost, x, bounds)


def best_distinct(fits: Modes, num: int | None = None) -> Modes:
    """The distinct fits, the best first."""
    keep = distinct_modes(fits.mean, fits.covariance, fits.cost)[:num]
    return Modes(*(field[keep] for field in fits))
