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

As printed (`assignment="sum"`, eq. 8 [IJRR], 7 [RR]) a node costs the sum of all its edges,

    sum_e 1/2 rho(W_e d_e^2)

with the weight of the edge's own pixel inside rho: `W = 1 - k S_p` in [IJRR], times that of the
foreground where it is known (section 8); times the strength of the edge in [RR]. The papers do not
say which maxima are edges (here: those of at least `least_edge`), nor what a visible node without
an edge costs (here: `nu_bf`; decision "printed cost"). The cost jumps where an edge enters the
window. With "nearest" the nearest edge alone counts, for Gaussian errors, under which a second edge
would outweigh the first.

Rings without a contour cost `nu_bf`, existing nodes that are hidden `nu_occ = k nu_bf` (eq. 5).
Both lie between a good fit and a bad one, U: as [IJRR] advises, their level is the error per node
of a fitted model, and hidden nodes cost slightly more.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cost.context import FrameContext
from torchcss.cost.interior import count_nodes
from torchcss.cost.outline import Derivatives, ImageNodes, OutlineTerm
from torchcss.cost.term import Need, OnPoints, Values
from torchcss.cost.visibility import places
from torchcss.robust import Lorentzian, RobustPotential, RobustValue
from torchcss.types import frozen
from torchcss.vision.sampling import inside_image, interpolate_bilinear

Pixels = Float[Tensor, "*batch p 2"]
Channels = Float[Tensor, "c h w"]

Each = Float[Tensor, " e"]
"""A number for each edge."""


class EdgeAssignments(NamedTuple):
    """Edges found along the search lines of nodes; a node may have several, or none.

    Attributes:
        node: The node of each edge.
        distance: Signed distance from the node along its outward normal, pixels.
        weight: Weight of the assignment; zero outside the window and where the maximum is flat. As
            printed: W.
    """

    node: Int[Tensor, " e"]
    distance: Each
    weight: Each


class _Maxima(NamedTuple):
    """Local maxima of the response on search lines; see `EdgeAssignments`."""

    node: Int[Tensor, " e"]
    distance: Each
    height: Each
    sharpness: Each


_TINY = 1e-12
_LINES = 16384
"""Lines searched at a time: few enough for the caches, enough to hide the overhead of calls."""

_SHARP_ENOUGH = 0.05
"""Relative curvature, per square pixel, from which a maximum has its full weight: that of a
Gaussian ridge of 4.5 pixels, twice as wide as the detector's own edges."""

_FADE = 0.25
"""Share of the window over which an assignment that enters it comes to count in the sum of 1."""


@frozen
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
        assignment: How the edges of a node share its cost; "sum" and "nearest" are as printed.
        strength: As printed: whether W is in proportion to the edge's response ([RR] 3.2).
        foreground: As printed: whether what is learnt of body and background weighs the edges.
        least_edge: As printed: least response of an edge. Ours.
    """

    name = "contour"

    weight: float = 150.0
    sigma: float = 2.5
    window: float = 12.0
    step: float = 1.0
    fitted_level: float = 0.9
    potential_kind: type = Lorentzian
    assignment: Literal["shared", "sum", "nearest"] = "shared"
    strength: bool = False
    foreground: bool = False
    least_edge: float = 0.4

    @property
    def needs(self) -> frozenset[Need]:
        """Colours of body and background, if they weigh the edges."""
        return frozenset(("appearance", "background") if self.foreground else ())

    @property
    def potential(self) -> RobustPotential:
        """`rho` on the squared distance in pixels."""
        return self.potential_kind(nu=self.nu, sigma=self.sigma)

    @cached_property
    def unmatched(self) -> float:
        """U, the cost of a visible node without assignment."""
        if self.assignment != "shared":
            return self.fitted_level * self.nu
        end = torch.tensor(self.window**2, dtype=torch.float64, device="cpu")
        return 0.5 * float(self.potential(end).rho)

    def prepare(self, context: FrameContext) -> OnPoints | None:
        """Bind the term to the edges of a frame; None without a picture."""
        if self.assignment == "shared":
            field = context.edge_field
            return None if field is None else self.bind(context, field)
        field = context.weighed_edges(foreground=self.foreground)
        return None if field is None else self.bind(context, field, count_nodes(context))

    def search(self, uv: Pixels, normal_uv: Pixels, edge_field: Channels) -> EdgeAssignments:
        """Search the image along the normals.

        Args:
            uv: Projected nodes, pixels; those of a batch are numbered in a row.
            normal_uv: Unit outward normals in the image.
            edge_field: Contrast-normalised gradient, of length at most one (edge energy times
                direction). As printed: `FrameContext.weighed_edges`.
        """
        maxima = self._maxima(uv, normal_uv, edge_field[:2])
        if self.assignment == "shared":
            return self._shared(maxima, uv.shape[:-1].numel())
        node, distance, height, _ = (
            part[(maxima.distance.abs() < self.window) & (maxima.height >= self.least_edge)]
            for part in maxima
        )
        if self.assignment == "nearest":
            far = distance.new_full((uv.shape[:-1].numel(),), torch.inf)
            least = far.scatter_reduce(0, node, distance.abs(), "amin")
            nearest = distance.abs() == least.index_select(0, node)
            node, distance, height = (part[nearest] for part in (node, distance, height))
        place, along = (v.detach().reshape(-1, 2)[node] for v in (uv, normal_uv))
        place = place + distance[:, None] * along
        weight = interpolate_bilinear(edge_field[2:], place)[:, 0]
        return EdgeAssignments(node, distance, weight * height if self.strength else weight)

    def _maxima(self, uv: Pixels, normal_uv: Pixels, edge_field: Float[Tensor, "2 h w"]) -> _Maxima:
        """All local maxima of the response on the search lines, and a little beyond."""
        # Samples run along the first axis in memory, so that neighbours on a line are whole rows.
        start, along = (v.detach().reshape(-1, 2).mT.contiguous() for v in (uv, normal_uv))
        # Samples beyond the window, so that a maximum on its very edge is found too.
        reach = math.ceil(self.window / self.step) + 2
        steps = self.step * torch.arange(-reach, reach + 1, dtype=start.dtype, device=uv.device)
        line = torch.addcmul(start[:, None], steps[:, None], along[:, None]).movedim(0, -1)
        field_u, field_v = interpolate_bilinear(edge_field, line).unbind(-1)
        response = torch.addcmul(field_u * along[0], field_v, along[1]).abs()
        response *= inside_image(line, *edge_field.shape[1:])

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
        return _Maxima(node, distance, height, sharpness)

    def _shared(self, maxima: _Maxima, size: int) -> EdgeAssignments:
        """The maxima of so many nodes with weights that share one."""
        node, distance, height, sharpness = maxima
        weight = height * sharpness.clamp(0, 1) * (distance.abs() < self.window)
        # Weights share 1; one that enters the window takes its share from the others by degrees.
        share = weight * ((self.window - distance.abs()) / (_FADE * self.window)).clamp(max=1)
        total = share.new_zeros(size).index_add(0, node, share).clamp(min=1)
        weight = weight / total.index_select(0, node)
        return EdgeAssignments(node, distance, weight)

    def _wells(
        self, uv: Float[Tensor, "p 2"], normal_uv: Float[Tensor, "p 2"], edge_field: Channels
    ) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"], Float[Tensor, " p"]]:
        """Depth of the wells of nodes, and the cost's derivatives in the distance moved."""
        # Both components of a pixel side by side: fewer misses of the cache.
        edge_field = edge_field.to(uv).movedim(0, -1).contiguous().movedim(-1, 0)
        blocks = []
        for start, along in zip(uv.split(_LINES), normal_uv.split(_LINES), strict=True):
            found = self.search(start, along, edge_field)
            node, distance, weight = found
            well, squared, (_, first, second) = self._well(found, distance)
            # d/dt of 1/2 rho(W (d - t)^2) at t = 0, t the node's motion along its normal.
            rows = (
                well.clamp(min=0) if self.assignment == "shared" else well,
                -weight * first * distance,
                weight * (first + 2 * second * squared),
            )
            none = weight.new_zeros(len(start))
            blocks.append([none.index_add(0, node, row) for row in rows])
        depth, slope, curvature = (torch.cat(parts) for parts in zip(*blocks, strict=True))
        return depth, slope, curvature

    def _well(self, found: EdgeAssignments, distance: Each) -> tuple[Each, Each, RobustValue]:
        """What edges at some distance take off U, and rho with what it is of."""
        node, _, weight = found
        if self.assignment == "shared":
            squared = distance.square()
            value = self.potential(squared)
            return weight * (self.unmatched - 0.5 * value.rho), squared, value
        squared = weight * distance.square()
        value = self.potential(squared)
        share = self.unmatched / node.bincount().to(weight).index_select(0, node)
        return share - 0.5 * value.rho, squared, value

    def match(
        self, nodes: ImageNodes, image: Channels, at: Float[Tensor, "k 2"] | None = None
    ) -> Float[Tensor, " k"]:
        """Depth of the nodes' wells below U, see `OutlineTerm.match`."""
        if at is None:
            return self._wells(nodes.uv, nodes.normal, image)[0]
        moved = ((at - nodes.uv) * nodes.normal).sum(-1)
        found = self.search(nodes.uv, nodes.normal, image)
        wells, _, _ = self._well(found, found.distance - moved.index_select(0, found.node))
        return torch.zeros_like(moved).index_add(0, found.node, wells)

    def derivatives(self, nodes: ImageNodes, image: Channels) -> Derivatives:
        """See `OutlineTerm.derivatives`."""
        depth, slope, curvature = self._wells(nodes.uv, nodes.normal, image)
        normal, weight = nodes.normal, nodes.weight
        gradient = (weight * slope)[:, None] * normal
        hessian = (weight * curvature)[:, None, None] * normal[:, :, None] * normal[:, None, :]
        return depth, gradient, hessian

    def matched(self, match: Values) -> Values:
        """See `OutlineTerm.matched`."""
        return self.unmatched - match
