"""How noisy keypoints are, learnt from what the best fit to them leaves over.

Detectors differ, and so do pictures. Of `m` numbers of the keypoints, errors z in multiples of the
noise that is assumed, a fit with p parameters explains p away; p is counted as the keypoints' share
of the curvature, `tr(H_joints (H_joints + H_priors)^-1)`. What is left says how many times as large
the noise is,

    factor^2 = (a + sum w z^2) / (a + sum w (1 - p / m))

with the robust weights `w` of the joint term, so that outliers count little, and with `a` numbers'
worth of belief in the noise that was assumed. Fit and factor follow from each other; a few turns
make them agree.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.cost.joints import JointTerm, match_joints
from torchcss.cost.total import TrackingCost
from torchcss.initialise.multi_start import StartSearch, widened
from torchcss.initialise.outliers import refine_fits
from torchcss.linalg import symmetric_part
from torchcss.types import Curvature, Vector, Vectors

BELIEF = 10.0
"""How many numbers the noise that is assumed is worth."""

_TURNS = 4

_LEAST = 1e-6
"""Curvature along directions that neither keypoints nor priors determine."""


class Noise(NamedTuple):
    """What is known of the noise of keypoints.

    Attributes:
        sigma: That of a wrist's, pixels of the full image.
        is_guess: Whether it is to be learnt, from there.
    """

    sigma: float
    is_guess: bool = False


def briefly(search: StartSearch) -> StartSearch:
    """How widely to look for a fit that tells the noise: errors do not tell flipped limbs apart."""
    return replace(
        search, num_starts=min(16, search.num_starts), num_flips=0, num_samples=0, leave_out=False
    )


def noise_factor(cost: TrackingCost, x: Vector, search: StartSearch) -> float:
    """How many times as noisy as a cost assumes its keypoints are.

    Args:
        cost: Keypoints and priors of one moment, of a body with its lengths free.
        x: A fit to them.
        search: Whether limits hold.
    """
    factor, state = 1.0, x[None]
    cost = replace(cost, choice=replace(cost.choice, curvature=Curvature.GAUSS_NEWTON))
    for _ in range(_TURNS):
        wide = widened(cost, factor)
        state = refine_fits(wide, state, search).mean
        factor *= _left_over(wide, state, search)
    return factor


def _left_over(cost: TrackingCost, x: Vectors, search: StartSearch) -> float:
    """The factor that follows from the errors of one fit."""
    joints, points = cost.choice.find(JointTerm), cost.body.pose(x[0]).joints
    squared, weight = [], []
    for view in cost.views:
        if view.keypoints is None:
            continue
        targets = match_joints(view.keypoints, cost.body.joint_names)
        uv, _, valid = view.camera.project(points[targets.joint])
        error = targets.weight * (uv - targets.position).square().sum(-1)
        error = error[valid & (targets.weight > 0)]
        squared.append(error / joints.sigma**2)
        weight.append(joints.potential(error).first * joints.sigma**2)
    z2, w = torch.cat(squared), torch.cat(weight)
    m = 2 * max(1, len(z2))
    expected = 2 * float(w.sum()) * max(0.0, 1 - _explained(cost, x, search) / m)
    return math.sqrt((BELIEF + float((w * z2).sum())) / (BELIEF + expected))


def _explained(cost: TrackingCost, x: Vectors, search: StartSearch) -> float:
    """How many parameters the keypoints determine."""
    lower, upper = search.bounds(cost.body)
    moves = (x[0] > lower) & (x[0] < upper)
    image, priors = (
        replace(cost, choice=choice).local_model(x).hessian[0][moves][:, moves]
        for choice in (cost.choice.only(["joints"]), cost.choice.without("joints"))
    )
    told = _positive_part(image)
    whole = told + _positive_part(priors) + _LEAST * torch.eye(len(told)).to(told)
    return float(torch.linalg.solve(whole, told).diagonal().sum())


def _positive_part(matrix: Float[Tensor, "n n"]) -> Float[Tensor, "n n"]:
    values, vectors = torch.linalg.eigh(symmetric_part(matrix))
    return (vectors * values.clamp(min=0.0)) @ vectors.mT
