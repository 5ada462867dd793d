"""Contour term: image edges along the normals of the predicted occluding contour, eq. 8 [IJRR].

For each visible contour node the image is searched along the node's projected normal, up to a
window on either side. All local maxima of the edge response are kept as assignments; the response
along the normal m is `|G . m|` with G the contrast-normalised gradient of unit range, so one number
holds edge strength and agreement in orientation. Each assignment e, at signed distance d_e, has a
weight `w_e` in [0, 1] (response, sharpness of the maximum; together at most 1, save for those about
to leave the window), and the node costs

    U - sum_e w_e (U - 1/2 rho(d_e^2)),    U = 1/2 rho(window^2)

so a node without an assignment costs exactly U, an assignment that enters or leaves at the window's
edge changes nothing, and one that appears on a slope starts with weight zero: the cost is
continuous. Only the distance along the normal counts (the aperture problem), `W_e = w_e m m^T`.
Derivatives hold nodes, normals and assignments fixed.

Rings without a contour cost `nu_bf`, existing nodes that are hidden `nu_occ = k nu_bf` (eq. 5).
Both lie between a good fit and a bad one, U: as [IJRR] advises, their level is the error per node
of a fitted model, and hidden nodes cost slightly more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cost.context import FrameContext
from torchcss.cost.outline import ImageNodes, OutlineTerm
from torchcss.cost.term import OnPoints
from torchcss.cost.visibility import places
from torchcss.robust import Lorentzian, RobustPotential
from torchcss.vision.sampling import inside_image, interpolate_bilinear


class EdgeAssignments(NamedTuple):
    """Edges found along the search lines of nodes; a node may have several, or none.

    Attributes:
        node: The node of each edge.
        distance: Signed distance from the node along its outward normal, pixels.
        weight: Weight of the assignment; zero outside the window and where the maximum is flat.
    """

    node: Int[Tensor, " e"]
    distance: Float[Tensor, " e"]
    weight: Float[Tensor, " e"]


_TINY = 1e-12
_LINES = 16384
"""Lines searched at a time: few enough for the caches, enough to hide the overhead of calls."""

_SHARP_ENOUGH = 0.05
"""Relative curvature, per square pixel, from which a maximum has its full weight: that of a
Gaussian ridge of 4.5 pixels, twice as wide as the detector's own edges."""

_FADE = 0.25
"""Share of the window over which an assignment that enters it comes to count in the sum of 1."""


@dataclass(frozen=True, kw_only=True)
class ContourTerm(OutlineTerm):
    """The robust edge-matching cost of occluding contours.

    Attributes:
        sigma: Scale of the distance between model and image contour, pixels.
        window: Half length of the search line, pixels. Of 4.8 sigmas, as here, a node without a
            match costs 1.6 nu with the Lorentzian.
        step: Distance between samples of the search line, pixels.
        fitted_level: The mean error per node of a fitted model: 0.5 to 0.8 on the demo, whose
            surface is the model's own, 0.9 on the beam clip.
        potential_kind: The potential rho.
    """

    name: ClassVar[str] = "contour"

    weight: float = 150.0
    sigma: float = 2.5
    window: float = 12.0
    step: float = 1.0
    fitted_level: float = 0.9
    potential_kind: type = Lorentzian

    @property
    def potential(self) -> RobustPotential:
        """`rho` on the squared distance in pixels."""
        return self.potential_kind(nu=self.nu, sigma=self.sigma)

    @property
    def unmatched(self) -> float:
        """U, the cost of a visible node without assignment."""
        return 0.5 * float(self.potential(torch.tensor(self.window**2, dtype=torch.float64)).rho)

    def prepare(self, context: FrameContext) -> OnPoints | None:
        """Bind the term to the edges of a frame; None without a picture."""
        field = context.edge_field
        return None if field is None else self.bind(context, field)

    def search(
        self,
        uv: Float[Tensor, "*batch p 2"],
        normal_uv: Float[Tensor, "*batch p 2"],
        edge_field: Float[Tensor, "2 h w"],
    ) -> EdgeAssignments:
        """Search the image along the normals.

        Args:
            uv: Projected nodes, pixels; those of a batch are numbered in a row.
            normal_uv: Unit outward normals in the image.
            edge_field: Contrast-normalised gradient, of length at most one (edge energy times
                direction).
        """
        # Samples run along the first axis in memory, so that neighbours on a line are whole rows.
        start, along = (v.detach().reshape(-1, 2).mT.contiguous() for v in (uv, normal_uv))
        # Samples beyond the window, so that a maximum on its very edge is found too.
        reach = math.ceil(self.window / self.step) + 2
        steps = self.step * torch.arange(-reach, reach + 1, dtype=start.dtype, device=uv.device)
        line = torch.addcmul(start[:, None], steps[:, None], along[:, None]).movedim(0, -1)
        field_u, field_v = interpolate_bilinear(edge_field, line).unbind(-1)
        response = torch.addcmul(field_u * along[0], field_v, along[1]).abs()
        # The image is convex: only lines with an end outside leave it.
        ends = line[:: len(steps) - 1]
        leaving = (~inside_image(ends, *edge_field.shape[1:])).any(0).nonzero()[:, 0]
        response[:, leaving] *= inside_image(line[:, leaving], *edge_field.shape[1:])

        rises = response[1:] > response[:-1]
        peak = places(rises[1:-2] & ~rises[2:-1])
        size, count = start.shape[1], len(steps) - 4
        before, left, middle, right, after = (
            response[i : i + count].flatten().index_select(0, peak) for i in range(5)
        )
        slot = peak // max(size, 1)
        node = peak - slot * size
        curve = (2 * middle - left - right).clamp(min=_TINY)
        shift = 0.5 * (right - left) / curve
        # Half way between two samples the larger one changes, and with it the parabola; the third
        # difference towards that side makes the height the same from either.
        side = torch.where(shift > 0, 2 * right - middle - after, 2 * left - before - middle)
        height = middle + 0.5 * shift.square() * (curve + shift.abs() * (side - curve))
        # How far the response falls to either side, 1.5 samples from the maximum. A maximum is born
        # on a slope, where it does not fall to one side: the weight starts at zero there.
        fall = middle - torch.maximum(
            torch.lerp(left, before, 0.5 - shift), torch.lerp(right, after, 0.5 + shift)
        )
        sharpness = fall / height.clamp(min=1e-3) * (2 / (1.5 * self.step) ** 2 / _SHARP_ENOUGH)
        distance = self.step * (slot + (2 - reach) + shift)
        weight = height * sharpness.clamp(0, 1) * (distance.abs() < self.window)
        # Weights share 1; one that enters the window takes its share from the others by degrees.
        share = weight * ((self.window - distance.abs()) / (_FADE * self.window)).clamp(max=1)
        total = share.new_zeros(size).index_add(0, node, share).clamp(min=1)
        weight = weight / total.index_select(0, node)
        return EdgeAssignments(node, distance, weight)

    def _wells(
        self,
        uv: Float[Tensor, "p 2"],
        normal_uv: Float[Tensor, "p 2"],
        edge_field: Float[Tensor, "2 h w"],
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"], Float[Tensor, " p"]]:
        """Depth of the wells of nodes, and the cost's derivatives in the distance moved."""
        # Both components of a pixel side by side: fewer misses of the cache.
        edge_field = edge_field.to(uv).movedim(0, -1).contiguous().movedim(-1, 0)
        unmatched, blocks = self.unmatched, []
        for start, along in zip(uv.split(_LINES), normal_uv.split(_LINES), strict=True):
            node, distance, weight = self.search(start, along, edge_field)
            squared = distance.square()
            rho, first, second = self.potential(squared)
            # d/dt of 1/2 rho((d - t)^2) at t = 0, t the node's motion along its normal.
            rows = (
                weight * (unmatched - 0.5 * rho).clamp(min=0),
                -weight * first * distance,
                weight * (first + 2 * second * squared),
            )
            none = weight.new_zeros(len(start))
            blocks.append([none.index_add(0, node, row) for row in rows])
        depth, slope, curvature = (torch.cat(parts) for parts in zip(*blocks, strict=True))
        return depth, slope, curvature

    def match(
        self,
        nodes: ImageNodes,
        image: Float[Tensor, "2 h w"],
        at: Float[Tensor, "k 2"] | None = None,
    ) -> Float[Tensor, " k"]:
        """Depth of the nodes' wells below U, see `OutlineTerm.match`."""
        if at is None:
            return self._wells(nodes.uv, nodes.normal, image)[0]
        moved = ((at - nodes.uv) * nodes.normal).sum(-1)
        node, distance, weight = self.search(nodes.uv, nodes.normal, image)
        rho = self.potential((distance - moved.index_select(0, node)).square()).rho
        wells = weight * (self.unmatched - 0.5 * rho)
        return torch.zeros_like(moved).index_add(0, node, wells)

    def derivatives(
        self, nodes: ImageNodes, image: Float[Tensor, "2 h w"]
    ) -> tuple[Float[Tensor, " k"], Float[Tensor, "k 2"], Float[Tensor, "k 2 2"]]:
        """See `OutlineTerm.derivatives`."""
        depth, slope, curvature = self._wells(nodes.uv, nodes.normal, image)
        normal, weight = nodes.normal, nodes.weight
        gradient = (weight * slope)[:, None] * normal
        hessian = (weight * curvature)[:, None, None] * normal[:, :, None] * normal[:, None, :]
        return depth, gradient, hessian

    def matched(self, match: Float[Tensor, "*batch p"]) -> Float[Tensor, "*batch p"]:
        """See `OutlineTerm.matched`."""
        return self.unmatched - match
