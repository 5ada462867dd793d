"""Keypoints that are none of their joints: found by leaving them out, one after another.

A detector or a person may place a keypoint wrongly altogether. The robust potential pulls towards
it only a little, but one image tells so little of depth that a little is enough to bend a limb the
wrong way. So every keypoint is either one of its joint, with the cost that the joint term gives it,
or an outlier, whose place says nothing: a mixture of two likelihoods. If a share `e` of all
keypoints are outliers and these lie anywhere in an image of area A, leaving one out costs

    log((1 - e) / e * A / (2 pi sigma^2 s^2))

nats (about 14 for two pixels of noise), `s` its joint's own spread. A keypoint is left out if that
makes the best fit to the others cheaper by more. This needs a fit, because the error of an outlier
often shows at its neighbours; and since no keypoint can save more than the whole fit costs, clean
ones are all kept without looking at them one by one.

Call `fits_and_outliers` in place of `torchcss.initialise.multi_start.multi_start_fits`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.cost.joints import JointTargets, JointTerm, match_joints
from torchcss.cost.total import TrackingCost
from torchcss.inference.mixture import distinct_modes
from torchcss.initialise.multi_start import (
    StartSearch,
    descend_widened,
    multi_start_fits,
    optimise,
)
from torchcss.types import Modes, Numbers, Vectors

SHARE = 0.05
"""Share of outliers that is expected."""

_MOST = 0.3
"""Largest share that may be left out: if more do not fit, it is the fit that is wrong."""

_NUM_TRIED = 6
"""Best fits from which every keypoint is left out in turn."""


def fits_and_outliers(
    cost: TrackingCost, *, search: StartSearch, generator: torch.Generator
) -> tuple[Modes, Bool[Tensor, " j"]]:
    """Find the poses that explain the keypoints, and which of these are better left out.

    Args:
        cost: Keypoints and priors of one image; its body hangs before the camera and has a joint
            for every keypoint.
        search: How widely to look.
        generator: Source of the starts.

    Returns:
        The distinct fits to the keypoints that are kept, the best first, and which are left out.
    """
    fits = best_distinct(multi_start_fits(cost, search=search, generator=generator))
    if not search.leave_out:
        return fits, torch.zeros_like(_matched(cost)[1].weight, dtype=torch.bool)
    outliers = find_outliers(cost, fits, search)
    if not bool(outliers.any()):
        return fits, outliers
    # What looks an outlier from a wrong fit may be right from the one that is found without it.
    fits = best_distinct(
        multi_start_fits(without(cost, outliers), search=search, generator=generator)
    )
    return _put_back(cost, fits, outliers, search)


def find_outliers(cost: TrackingCost, fits: Modes, search: StartSearch) -> Bool[Tensor, " j"]:
    """Leave keypoints out, one at a time, as long as that pays; none if that would be very many.

    Args:
        cost: The cost with all keypoints.
        fits: Its fits, the best first.
        search: Limits and effort.

    Returns:
        Which keypoints are outliers.
    """
    weight = _matched(cost)[1].weight
    outliers, price = torch.zeros_like(weight, dtype=torch.bool), price_of_leaving_out(cost)
    while True:
        now = float(fits.cost[0])
        tried = torch.nonzero((weight > 0) & ~outliers & (price < now))[:, 0].tolist()
        if not tried:
            return outliers
        more = outliers.repeat(len(tried), 1)
        more[torch.arange(len(tried)), tried] = True
        starts = fits.mean[:_NUM_TRIED]
        each = without(cost, more.repeat_interleave(len(starts), dim=0))
        ends = refine_fits(each, starts.repeat(len(tried), 1), search)
        ends = Modes(*(field.unflatten(0, (len(tried), -1)) for field in ends))
        total = ends.cost.amin(-1) + price[tried]
        best = int(total.argmin())
        if float(total[best]) >= now:
            return outliers
        if int(more[best].sum()) > _MOST * int((weight > 0).sum()):
            return torch.zeros_like(outliers)
        outliers, fits = more[best], best_distinct(ends.take(best))


def _put_back(
    cost: TrackingCost, fits: Modes, outliers: Bool[Tensor, " j"], search: StartSearch
) -> tuple[Modes, Bool[Tensor, " j"]]:
    """Use the keypoints again that fit after all."""
    price = price_of_leaving_out(cost)
    for column in torch.nonzero(outliers)[:, 0].tolist():
        fewer = outliers.clone()
        fewer[column] = False
        tried = refine_fits(without(cost, fewer), fits.mean[:_NUM_TRIED], search)
        if float(tried.cost.min()) < float(fits.cost[0] + price[column]):
            fits = best_distinct(refine_fits(without(cost, fewer), fits.mean, search))
            outliers = fewer
    return fits, outliers


def _matched(cost: TrackingCost) -> tuple[JointTerm, JointTargets]:
    """The joint term of a cost, and its keypoints matched to the body."""
    joints, keypoints = cost.choice.find(JointTerm), cost.keypoints
    return joints, match_joints(keypoints, cost.body.joint_names)


def price_of_leaving_out(cost: TrackingCost) -> Float[Tensor, " j"]:
    """What it costs to call a keypoint an outlier, nats; a confidence counts as a wider spread."""
    joints, targets = _matched(cost)
    width, height = cost.camera.image_size_wh
    odds = (1 - SHARE) / SHARE * width * height / (2 * math.pi * joints.sigma**2)
    return (odds * targets.weight).clamp(min=1.0).log()


def capped_cost(cost: TrackingCost, x: Vectors) -> Numbers:
    """Cost in nats if no keypoint costs more than leaving it out."""
    joints, targets = _matched(cost)
    points = cost.body.pose(x).joints[..., targets.joint, :]
    each = joints.weight * joints.value(points, cost.camera, targets)
    return cost.value(x) - (each - price_of_leaving_out(cost)).clamp(min=0.0).sum(-1)


def without(cost: TrackingCost, outliers: Bool[Tensor, "*b j"]) -> TrackingCost:
    """The same cost without some keypoints, which may be others for every item of a batch."""
    keypoints = cost.keypoints
    places = keypoints.positions.expand(*outliers.shape, 2)
    if outliers.dim() > 1:
        cost = replace(cost, parent=torch.arange(len(outliers), device=outliers.device))
    return cost.with_keypoints(keypoints._replace(positions=places).without(outliers))


def refine_fits(cost: TrackingCost, x: Vectors, search: StartSearch) -> Modes:
    """Descend from fits to other keypoints or lengths, wide at first if the search anneals."""
    bounds = search.bounds(cost.body)
    x = descend_widened(cost, x, bounds, ((4.0, 8),) if search.anneal else ())
    return optimise(cost, x, bounds, 60, tolerance=1e-3)


def best_distinct(fits: Modes, num: int | None = None) -> Modes:
    """The distinct fits, the best first."""
    return fits.take(distinct_modes(fits.mean, fits.covariance, fits.cost)[:num])
