"""Edge-energy term: the robustified, normalised edge energy itself, without extracted features.

Section 2 [IJRR] uses "direct image-based cost metrics such as robustified normalized edge energy"
beside the extracted features of eq. 8. The edge energy at the projection r of a contour node is a
number E(r) in [0, 1], 1 on a perfect outline. What it lacks, s = 1 - E(r), grows with the square of
the distance from an edge, and takes the place of the squared error:

    e(r) = 1/2 rho(1 - E(r))

A node without any edge costs `1/2 rho(1)` and feels no force: the basin of an edge is a few pixels
wide, as the smoothing, where the line search of `torchcss.cost.contour` reaches a dozen. In return
there is no search and no assignment, and the derivatives are those of the very function that is
evaluated.

E must be twice continuously differentiable for that. It is a uniform cubic B-spline whose
coefficients are the energies, blurred by a Gaussian; a weighted mean of energies never leaves
[0, 1] (`torchcss.vision.spline`). The blur lowers a ridge, so its height is restored up to the top
of the range.

Where the body has no contour and where it is hidden the costs are those of the contour term.

By default: `edge_energy_field(features.edge_field())` once per frame, then
`EdgeEnergyTerm().point_cost(...)`.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.cost.context import FrameContext
from torchcss.cost.outline import Derivatives, ImageNodes, OutlineTerm
from torchcss.cost.term import OnPoints, Values
from torchcss.robust import Lorentzian, RobustPotential
from torchcss.types import frozen
from torchcss.vision.sampling import gaussian_blur
from torchcss.vision.spline import SplineField, spline_field

_SMOOTHING = 2.0
"""Standard deviation of the blur, pixels: the reach of an edge."""

_RIDGE = 1.2
"""Standard deviation of the ridge that the edge detector makes of a clean step, pixels."""


def edge_energy_field(edge_field: Float[Tensor, "2 h w"]) -> SplineField:
    """Make the smooth edge energy of a frame.

    Args:
        edge_field: Edge energy times direction, weighted or not, of length at most one; see
            `FrameFeatures.edge_field`.
    """
    energy = gaussian_blur(edge_field.norm(dim=0), _SMOOTHING)
    # The spline's own kernel has a variance of 1/3.
    height = math.sqrt(1.0 + (_SMOOTHING**2 + 1.0 / 3.0) / _RIDGE**2)
    coefficients = (height * energy).clamp(0.0, 1.0)
    return spline_field(coefficients[None])


@frozen
class EdgeEnergyTerm(OutlineTerm):
    """The robust potential of the edge energy at occluding contours.

    Attributes:
        sigma: Scale of the square root of the missing energy: an edge weighs the more the nearer it
            comes to 1, within about the square of sigma.
        fitted_level: The mean error per node of a well-fitted model, measured on the demo's
            sequence at its true states.
        potential_kind: The potential rho.
    """

    name = "edge_energy"

    weight: float = 150.0
    sigma: float = 0.5
    fitted_level: float = 0.45
    potential_kind: type = Lorentzian

    @property
    def potential(self) -> RobustPotential:
        """`rho` on the missing energy."""
        return self.potential_kind(nu=self.nu, sigma=self.sigma)

    @property
    def unmatched(self) -> float:
        """The cost of a visible node without an edge, or outside the image."""
        return 0.5 * float(self.potential(torch.ones((), dtype=torch.float64)).rho)

    def prepare(self, context: FrameContext) -> OnPoints | None:
        """Make the edge energy of a frame smooth; None without a picture."""
        field = context.edge_field
        return None if field is None else self.bind(context, edge_energy_field(field))

    def match(
        self, nodes: ImageNodes, image: SplineField, at: Float[Tensor, "k 2"] | None = None
    ) -> Float[Tensor, " k"]:
        """The edge energy, see `OutlineTerm.match`."""
        return image.value(nodes.uv if at is None else at)

    def derivatives(self, nodes: ImageNodes, image: SplineField) -> Derivatives:
        """See `OutlineTerm.derivatives`."""
        energy, slope, bend = image.sample(nodes.uv)
        _, first, second = self.potential((1 - energy).clamp(min=0))
        weight = 0.5 * nodes.weight
        gradient = (-weight * first)[..., None] * slope
        hessian = (weight * second)[..., None, None] * slope[..., :, None] * slope[..., None, :]
        return energy, gradient, hessian - (weight * first)[..., None, None] * bend

    def matched(self, match: Values) -> Values:
        """See `OutlineTerm.matched`."""
        return 0.5 * self.potential((1 - match).clamp(min=0)).rho
