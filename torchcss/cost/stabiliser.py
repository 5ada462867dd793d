"""Parameter stabilisers: long-tailed "sticky" priors on hard-to-see parameters.

These are the priors of section 3.2.2 [IJRR]. Each such parameter has a rest value mu and a
deviation sigma; its cost is `1/2 rho(((x - mu) / sigma)^2)` with a Lorentzian of unit curvature at
rest. Near rest it is the Gaussian `N(mu, sigma^2)`; beyond `sqrt(nu)` deviations its pull fades, so
a strong observation can unstick the parameter and turn the prior off.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.cost.anthropometric import proportion_columns
from torchcss.cost.context import FrameContext
from torchcss.cost.term import OnStates, Term
from torchcss.robust import Lorentzian
from torchcss.types import LocalModel, Vector, Vectors, frozen

_SEEN = (
    *("shoulder_swing", "shoulder_raising", "elbow_flexion"),
    *("hip_flexion", "hip_abduction", "knee_flexion", "ankle_flexion"),
)
"""Parameters that are easy to estimate. Of those that are hard the papers name the clavicles."""


def long_tailed(
    x: Vectors,
    centre: Float[Tensor, "*#batch n"],
    deviation: Vector,
    nu: float,
) -> LocalModel:
    """Sum over parameters of the Lorentzian prior about `centre`; its Hessian is diagonal.

    Args:
        x: States.
        centre: Where the prior pulls to.
        deviation: Standard deviation at the centre; infinite for parameters without a prior.
        nu: Height of the tails, nats: the pull fades beyond `sqrt(nu)` deviations.
    """
    # The square of a larger number would overflow; the pull is nil there anyway.
    limit = 0.5 * torch.finfo(x.dtype).max ** 0.5
    z = ((x - centre) / deviation).clamp(-limit, limit)
    rho, first, second = Lorentzian(nu=nu, sigma=nu**0.5)(z.square())
    curvature = (first + 2 * second * z.square()) / deviation.square()
    return LocalModel(0.5 * rho.sum(-1), first * z / deviation, torch.diag_embed(curvature))


@frozen
class Stabiliser(Term):
    """The sticky prior of a body's hard-to-see parameters.

    Attributes:
        nu: Height of the tails, nats; the prior lets go at `sqrt(nu)` deviations.
        lengths: Whether free lengths are among the parameters; False: they have a prior of their
            own (`torchcss.cost.anthropometric`), and would count twice.
        hidden_only: Only parameters that are hard to estimate have the prior, as section 3.2.2
            wants: none of the swings and flexions of limbs, which move what the image shows.
    """

    name = "stabiliser"
    kind = "prior"

    nu: float = 9.0
    lengths: bool = False
    hidden_only: bool = False

    def prepare(self, context: FrameContext) -> OnStates:
        """Bind the prior to the rest values of a body."""
        mean, deviation = context.body.sticky_mean, self.deviation(context.body)
        return OnStates(lambda posed, _: long_tailed(posed.x, mean, deviation, self.nu))

    def deviation(self, body: BodyModel) -> Vector:
        """Standard deviations of a body's parameters; infinite where free."""
        deviation, free = body.sticky_deviation.clone(), []
        if not self.lengths:
            free += proportion_columns(body).values()
        if self.hidden_only:
            free += [k for k, name in enumerate(body.state_names) if name.endswith(_SEEN)]
        deviation[free] = math.inf
        return deviation
