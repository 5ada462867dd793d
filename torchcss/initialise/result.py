"""What an initialisation returns: fits of pose and lengths as hypotheses to start from (section 5).

`Initialisation` is the record. The functions make it out of fits: they bring the fits from one body
to another (with lengths free or held, on another base), say how uncertain they are when the lengths
are unknown too, and what the image leaves open.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.body.catalog import BODY_NAMES, LENGTHS, PROPORTION_RANGE, Proportions
from torchcss.body.load import load_body
from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, move_base, root_pose
from torchcss.cost.anthropometric import Anthropometric, proportion_columns
from torchcss.cost.total import TrackingCost
from torchcss.errors import BodyError
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.trust_region import default_prior_variance
from torchcss.initialise.multi_start import StartSearch
from torchcss.linalg import constrained_inverse, inverse_on_free
from torchcss.types import LocalModel, Modes, Vector, Vectors

STANDARD_STATURE = 1.75
"""Stature of the standard humanoid, metres."""

_SOLE = STANDARD_STATURE - sum(LENGTHS[n] for n in ("shank", "thigh", "trunk", "neck", "head"))
"""Height of the ankle joint above the ground."""

_UNDETERMINED = 0.9
"""Share of a parameter's prior deviation from which the image is said not to determine it."""


class Stage(NamedTuple):
    """The best fit after one stage.

    Attributes:
        name: What was fitted to what.
        body: The body at this stage.
        state: Its state.
        cost: Cost in nats of the stage's own cost function.
    """

    name: str
    body: BodyModel
    state: Vector
    cost: float


class Initialisation(NamedTuple):
    """Where tracking starts.

    Attributes:
        body: The body with the fitted lengths and shape, hung on the base of the best fit.
        mixture: The distinct fits, best first.
        cost: Their costs, nats.
        report: What was found and assumed, one line each.
        lengths: The fitted lengths, metres; empty where they were given.
        scale: Overall scale of the standard humanoid that the lengths were compared with.
        stages: The best fit after every stage.
        free_body: The same body with its lengths as parameters; None where they were given.
        free_mixture: The fits of pose and lengths together, best first, on `free_body`.
        left_out: Joints whose keypoints fit no pose and were left out.
        noise: How many times as noisy as was assumed keypoints were found to be.
        size_deviation: What is not known of a person's size, as the deviation of its logarithm;
            zero if the stature was given, or several cameras looked on.
        uncapped: Covariance of the best fit that no prior caps (`with_uncapped`), from which
            the papers' trackers start; None: that of the mixture.
        uncapped_floored: Whether `torchcss.linalg.LEAST_CURVATURE` was needed for it.
    """

    body: BodyModel
    mixture: GaussianMixture
    cost: Float[Tensor, " k"]
    report: tuple[str, ...]
    lengths: Mapping[str, float] = {}
    scale: float = 1.0
    stages: tuple[Stage, ...] = ()
    free_body: BodyModel | None = None
    free_mixture: GaussianMixture | None = None
    left_out: tuple[str, ...] = ()
    noise: float = 1.0
    size_deviation: float = Anthropometric().stature
    uncapped: Float[Tensor, "n n"] | None = None
    uncapped_floored: bool = False

    def hypotheses(self, num: int, *, generator: torch.Generator) -> Vectors:
        """The first `num` states to believe in: the fits, then samples of their mixture.

        Args:
            num: How many.
            generator: Source of the samples.
        """
        fits = self.mixture.mean[:num]
        samples = self.mixture.sample(num - len(fits), generator=generator).x
        return torch.cat([fits, self.body.bounds.project(samples)])


def mixture_of(fits: Modes) -> GaussianMixture:
    """Fits as modes that weigh by their costs."""
    return GaussianMixture(fits.mean, fits.covariance, torch.log_softmax(-fits.cost, dim=0))


def as_initialisation(body: BodyModel, fits: Modes, notes: tuple[str, ...]) -> Initialisation:
    """Fits, the best first, as hypotheses, with what is to be reported about them."""
    best = float(fits.cost[0])
    report = (
        *notes,
        f"first pose: {len(fits.cost)} distinct fits to the keypoints, best cost {best:.1f}",
    )
    stage = Stage("pose and proportions from joints", body, fits.mean[0], best)
    return Initialisation(body, mixture_of(fits), fits.cost, report, stages=(stage,))


def hang_on_best(body: BodyModel, fits: Modes) -> tuple[BodyModel, Modes]:
    """Hang the body on the root of the best fit; the covariances are still to be mapped.

    Fits that lie across it by a right angle, where the root's angles lock, are left out.
    """
    body, mean, _ = move_base(body, *root_pose(body, fits.mean[0]), fits.mean)
    root = body.state_columns(ROOT_NAMES)
    inside = (mean >= body.lower) & (mean <= body.upper)
    keep = torch.nonzero(inside[:, root].all(-1))[:, 0]
    return body, fits._replace(mean=mean).take(keep)


def columns_of(source: BodyModel, target: BodyModel, x: Vectors) -> Float[Tensor, "b m"]:
    """The parameters of one body out of the states of another that has them too."""
    return x[:, source.state_columns(target.state_names)]


def spread_to(source: BodyModel, target: BodyModel, x: Vectors) -> Float[Tensor, "b m"]:
    """States of a body as those of one with more parameters, which stay at zero."""
    full = x.new_zeros(len(x), target.num_parameters)
    full[:, target.state_columns(source.state_names)] = x
    return full


def with_lengths(
    body: BodyModel,
    lengths: Mapping[str, float],
    scale: float,
    *,
    free_root: bool | None,
    free_proportions: Proportions = False,
) -> BodyModel:
    """The body of the same name with other lengths, on the same base.

    Args:
        body: The body.
        lengths: Its lengths, metres.
        scale: Its overall scale.
        free_root: Whether it has root parameters; None: as it is by itself.
        free_proportions: Which lengths and places are parameters.
    """
    other = load_body(
        body.name,
        lengths={name: length / scale for name, length in lengths.items()},
        scale=scale,
        free_proportions=free_proportions,
        free_root=free_root,
        dtype=body.dtype,
        device=body.tie.device,
    )
    return other.with_base(body.base_rotation, body.base_translation)


def with_unknown_lengths(
    cost: TrackingCost, body: BodyModel, fits: Modes, search: StartSearch
) -> Modes:
    """Fits with the covariances that their poses have when the lengths are unknown too.

    Args:
        cost: Cost of the same body with free lengths, on the same base.
        body: The body with lengths held.
        fits: Its fits.
        search: Whether limits hold.
    """
    model, free, columns = _with_lengths(cost, body, fits.mean, search)
    variance = default_prior_variance(cost.body.bounds)
    covariance = inverse_on_free(model.hessian, free, variance, model.gradient)
    return fits._replace(covariance=covariance[:, columns][:, :, columns])


def with_uncapped(found: Initialisation, cost: TrackingCost, search: StartSearch) -> Initialisation:
    """With the best fit's covariance as printed (`torchcss.linalg.constrained_inverse`).

    Args:
        found: The fits on a body with lengths held.
        cost: Cost of the same body on the same base, with free lengths or with lengths held.
        search: Whether limits hold.
    """
    model, free, columns = _with_lengths(cost, found.body, found.mixture.mean[:1], search)
    variance = default_prior_variance(cost.body.bounds)
    covariance, floored = constrained_inverse(model.hessian, free, variance)
    own = covariance[0, columns][:, columns]
    return found._replace(uncapped=own, uncapped_floored=bool(floored[0]))


def _with_lengths(
    cost: TrackingCost, body: BodyModel, x: Vectors, search: StartSearch
) -> tuple[LocalModel, Bool[Tensor, "k m"], list[int]]:
    """The cost about fits, its free parameters, of which lengths are some, and the body's own."""
    loose = cost.body
    columns = loose.state_columns(body.state_names)
    full = spread_to(body, loose, x)
    model, bounds = cost.local_model(full), search.bounds(loose)
    lengths = bounds.upper > bounds.lower
    lengths[columns] = False
    return model, ~bounds.hold(full, model.gradient) | lengths, columns


def stature_of(lengths: Mapping[str, float], scale: float = 1.0) -> float:
    """Height of the standing body, metres; its overall scale tells what was not fitted."""
    names = ("shank", "thigh", "trunk", "neck", "head")
    return scale * _SOLE + sum(lengths.get(name, scale * LENGTHS[name]) for name in names)


def scale_of(stature: float | None) -> float:
    """Scale of the standard humanoid for a person of this height (metres), if it is known.

    Raises:
        BodyError: If it is no person's.
    """
    if stature is None:
        return 1.0
    if not 0.4 <= stature <= 2.8:
        raise BodyError(f"stature: expected a person's height in metres, 0.4 to 2.8, got {stature}")
    return stature / STANDARD_STATURE


def check_stature(body: str, stature: float | None) -> None:
    """Refuse a stature that is no person's, or that of a body from a file, which has its own size.

    Args:
        body: Name of a body that ships, or the path of a file.
        stature: Metres; None: not known.

    Raises:
        BodyError: If it is refused.
    """
    scale_of(stature)
    if stature is not None and body not in BODY_NAMES:
        raise BodyError(
            f"stature: it tells the size of a person; {body} has the lengths of its file: leave "
            "it out"
        )


def fitted_lengths(body: BodyModel, x: Vector, stature: float | None) -> dict[str, float]:
    """Fitted lengths and places; with known stature lengths that add up to it, in their limits."""
    lengths = {
        name: body.lengths.get(name, 0.0) + float(x[column])
        for name, column in proportion_columns(body).items()
    }
    if stature is None or "shank" not in lengths:
        return lengths
    scale = scale_of(stature)
    factor = (stature - scale * _SOLE) / (stature_of(lengths, scale) - scale * _SOLE)
    for name, length in lengths.items():
        if name not in LENGTHS:
            continue
        middle, margin = scale * LENGTHS[name], scale * LENGTHS[name] * PROPORTION_RANGE
        lengths[name] = min(max(length * factor, middle - margin), middle + margin)
    return lengths


def scale_report(stature: float | None, lengths: Mapping[str, float], *, num_views: int = 1) -> str:
    """The line that says what sets the scale, and the lengths.

    Args:
        stature: Height that was given, metres; None: none was.
        lengths: The fitted lengths, metres.
        num_views: How many cameras saw the body.
    """
    if not lengths:
        return "the lengths of the body are its file's, which set the scale"
    fitted = ", ".join(f"{name} {length:.3f} m" for name, length in lengths.items())
    if stature is not None:
        source = f"a stature of {stature:g} m sets the scale"
    elif num_views > 1:
        source = f"{num_views} views set the scale"
    else:
        source = "the prior on proportions sets the scale, which one image does not show"
    return f"{source}; proportions within 10 % of the standard humanoid: {fitted}"


def undetermined(body: BodyModel, modes: Modes, joints: TrackingCost) -> list[str]:
    """Names of the parameters that the image leaves open in the best fit."""
    prior = torch.minimum(
        default_prior_variance(body.bounds).sqrt(), body.sticky_deviation
    ).nan_to_num(posinf=math.inf)
    image = replace(
        joints, choice=joints.choice.without("stabiliser", "anthropometric", "pose_prior")
    )
    curvature = image.local_model(modes.mean[:1]).hessian[0].diagonal()
    free = modes.active[0] == 0
    deviation = modes.covariance[0].diagonal().sqrt()
    loose = free & (deviation > _UNDETERMINED * prior)
    # A parameter that moves no known joint has no curvature at all.
    loose = loose | (curvature.abs() * prior.square() < 1e-6)
    return list(compress(body.state_names, loose.tolist()))
