"""Anthropometric prior on internal proportions, `p_an = N(mu, Sigma)` of section 3.2.1 [IJRR].

The lengths of a body with free proportions (prismatic joints of the tree; left and right share one
parameter, so that the symmetry that the paper assumes holds exactly) are Gaussian about those of
the standard humanoid of the catalogue, which are the paper's source too. The paper gives no
covariance. Here a length L_i of the standard varies as

    L_i (1 + stature * s + individual_i * d_i),    s, d_i independent N(0, 1)

so that `Sigma = stature^2 L L^T + diag((individual L)^2)`: one factor for the size of the whole
body, and one for each length by itself. A person who is 5 % taller then likely has limbs that are
5 % longer, which a prior without correlations would count as evidence against every limb in turn.

Where the numbers come from. In the survey of 4082 men of Gordon et al., *2012 Anthropometric Survey
of U.S. Army Personnel* (ANSUR II, NATICK/TR-15/007), mean and standard deviation are, in cm, for
stature 175.62 and 6.86, upper arm (acromion to radiale) 33.52 and 1.75, forearm (radiale to
stylion) 26.79 and 1.54, biacromial breadth 41.57 and 1.92, bicristal breadth 27.54 and 1.75, height
of the knee (lateral femoral epicondyle) 49.17 and 2.66, of the hip (trochanterion) 90.09 and 4.92.
The common factor is the relative deviation of stature, 3.9 %. What is left of a length's own
relative deviation after it (`individual^2 = own^2 - stature^2`) is 3.5 % for the upper arm, 4.2 %
for the forearm, 2.5 % for the shoulder, 5.0 % for the hip and 3.7 % for the shank.

What is assumed. That every length follows stature in proportion, with independent remainders: real
segments of a limb also go together beyond stature (the height of the hip is left with 3.8 %, more
than independent segments would add up to), so the prior is a little tight on whole limbs. That
joint centres vary as the landmarks on the skin do. The remainders that the above does not give,
which are guesses of that order: thigh 4 %, trunk, hand and foot 3.5 %, head 3 %, the short neck
8 %. Women's means differ; give `scale` or `lengths` to `load_body`. A place of a joint
(`torchcss.body.catalog.PLACES`) is off by 5 % of its length, each by itself: half of its interval.

Call `Anthropometric().local_model(x, body)`. It replaces the stabiliser of the lengths, which would
otherwise count twice: `proportion_columns(body)` says which parameters those are.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.body.catalog import PLACES, PROPORTIONS, without_side
from torchcss.body.model import BodyModel
from torchcss.cost.context import FrameContext
from torchcss.cost.term import OnStates, Term
from torchcss.types import LocalModel, Vectors, frozen

INDIVIDUAL: dict[str, float] = {
    "hip_width": 0.050,
    "trunk": 0.035,
    "shoulder_width": 0.025,
    "neck": 0.080,
    "head": 0.030,
    "upper_arm": 0.035,
    "forearm": 0.042,
    "hand": 0.035,
    "thigh": 0.040,
    "shank": 0.037,
    "foot": 0.035,
}
"""Relative deviation of each length among people of one stature; see the module."""

_OF_PLACES = 0.05
"""Deviation of a joint's place, as a share of its length."""


def proportion_columns(body: BodyModel) -> dict[str, int]:
    """Free lengths and places of a body by name, and the state parameter that changes each.

    Where left and right are not tied, the names are those of the sides: `l_thigh`.
    """
    names = {f"{length}_length" for length in (*PROPORTIONS, *PLACES)}
    return {
        name.removesuffix("_length"): i
        for i, name in enumerate(body.state_names)
        if without_side(name) in names
    }


@frozen
class Anthropometric(Term):
    """The Gaussian prior on internal proportions.

    Attributes:
        stature: Relative standard deviation of the common scale.
    """

    name = "anthropometric"
    kind = "prior"

    stature: float = 0.039

    def prepare(self, context: FrameContext) -> OnStates | None:
        """Bind the prior to a body; None if it has no free lengths."""
        body = context.body
        if not proportion_columns(body):
            return None
        return OnStates(lambda posed, _: self.local_model(posed.x, body))

    def covariance(self, body: BodyModel) -> Float[Tensor, "m m"]:
        """Sigma of the free lengths in the order of `proportion_columns`, square metres."""
        common, own = self._deviations(body)
        return common[:, None] * common + torch.diag(own.square())

    def local_model(self, x: Vectors, body: BodyModel) -> LocalModel:
        """Cost, gradient and (constant) Hessian; zero for a body without free lengths.

        Args:
            x: States.
            body: The body that they belong to.
        """
        columns = list(proportion_columns(body).values())
        common, own = self._deviations(body)
        # Sherman and Morrison: the inverse of a diagonal and one factor.
        share = common / own.square()
        precision = torch.diag(own.square().reciprocal())
        precision = precision - share[:, None] * share / (1 + (share * common).sum())
        # The square of a larger number would overflow; see `stabiliser.long_tailed`.
        limit = 1e-3 * torch.finfo(x.dtype).max ** 0.5
        z = (x[..., columns] - body.sticky_mean[columns]) / own
        offset = z.clamp(-limit, limit) * own
        slope = offset @ precision
        gradient, hessian = torch.zeros_like(x), x.new_zeros(*x.shape, x.shape[-1])
        gradient[..., columns] = slope
        rows = torch.tensor(columns, dtype=torch.long, device=x.device)
        hessian[..., rows[:, None], rows] = precision
        return LocalModel(0.5 * (offset * slope).sum(-1), gradient, hessian)

    def _deviations(self, body: BodyModel) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
        """Standard deviations that stature gives to every length, and those of its own, metres."""
        columns = proportion_columns(body)
        names = list(map(without_side, columns))
        # The parameters count from the body's lengths, and the standard rests at `sticky_mean`.
        built = body.tie.new_tensor([body.lengths.get(name, 0.0) for name in names])
        standard = built + body.sticky_mean[list(columns.values())]
        lengths = body.tie.new_tensor([body.lengths[PLACES.get(name, name)] for name in names])
        places = torch.tensor([name in PLACES for name in names]).to(lengths.device, torch.bool)
        own = body.tie.new_tensor([INDIVIDUAL.get(name, _OF_PLACES) for name in names])
        extent = torch.where(places, lengths, standard)
        return self.stature * standard, own * extent
