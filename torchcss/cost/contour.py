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
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.cost.visibility import ContourNodes
from torchcss.robust import Lorentzian, RobustPotential
from torchcss.types import PointCost
from torchcss.vision.camera import Camera, ProjectionModel, pull_back
from torchcss.vision.sampling import sample_bilinear


class EdgeAssignments(NamedTuple):
    """Edges found along the search line of every node, one slot per inner sample of the line.

    Attributes:
        distance: Signed distance from the node along its outward normal, pixels.
        weight: Weight of the assignment; zero in slots without a local maximum.
    """

    distance: Float[Tensor, "*batch p s"]
    weight: Float[Tensor, "*batch p s"]


_TINY = 1e-12
_SHARP_ENOUGH = 0.05
"""Relative curvature, per square pixel, from which a maximum has its full weight: that of a
Gaussian ridge of 4.5 pixels, twice as wide as the detector's own edges."""

_FADE = 0.25
"""Share of the window over which an assignment that enters it comes to count in the sum of 1."""


@dataclass(frozen=True, kw_only=True)
class ContourTerm:
    """The robust edge-matching cost of occluding contours.

    Attributes:
        sigma: Scale of the distance between model and image contour, pixels.
        nu: Level of the outliers of one node (its unit only: the sum is normalised by N nu).
        window: Half length of the search line, pixels. With four sigmas and the Lorentzian, a
            node without a match costs 1.4 nu.
        step: Distance between samples of the search line, pixels.
        fitted_level: Cost of a node where there is no contour, as a share of nu: the mean error per
            node of a fitted model: 0.5 to 0.8 on the demo, whose surface is the model's own, 0.9 on
            the beam clip. Too low a level invites a badly fitting limb to hide.
        occlusion_factor: k of `nu_occ = k nu_bf`. [IJRR] says k > 1, [RR] k < 1; slightly above 1
            keeps hidden nodes dearer than matched ones and cheaper than bad fits.
        potential_kind: The potential rho.
    """

    sigma: float = 2.5
    nu: float = 1.0
    window: float = 12.0
    step: float = 1.0
    fitted_level: float = 0.9
    occlusion_factor: float = 1.1
    potential_kind: type = Lorentzian

    @property
    def potential(self) -> RobustPotential:
        """`rho` on the squared distance in pixels."""
        return self.potential_kind(nu=self.nu, sigma=self.sigma)

    @property
    def unmatched(self) -> float:
        """U, the cost of a visible node without assignment."""
        return 0.5 * float(self.potential(torch.tensor(self.window**2, dtype=torch.float64)).rho)

    def search(
        self,
        uv: Float[Tensor, "*batch p 2"],
        normal_uv: Float[Tensor, "*batch p 2"],
        edge_field: Float[Tensor, "2 h w"],
    ) -> EdgeAssignments:
        """Search the image along the normals.

        Args:
            uv: Projected nodes, pixels.
            normal_uv: Unit outward normals in the image.
            edge_field: Contrast-normalised gradient, of length at most one (edge energy times
                direction).
        """
        # Single precision is enough to find what the derivatives hold fixed, and twice as fast.
        start, along = uv.detach().float(), normal_uv.detach().float()
        # Samples beyond the window, so that a maximum on its very edge is found too.
        reach = math.ceil(self.window / self.step) + 2
        steps = torch.arange(-reach, reach + 1, dtype=start.dtype, device=uv.device)
        line = start[..., None, :] + (self.step * steps)[:, None] * along[..., None, :]
        field, inside = sample_bilinear(edge_field, line.flatten(-3, -2))
        shape = line.shape[-3:-1]
        field_u, field_v = (component.unflatten(-1, shape) for component in field.unbind(-1))
        response = (field_u * along[..., :1] + field_v * along[..., 1:]).abs()
        response = response * inside.unflatten(-1, shape)
        count = response.shape[-1] - 4
        before, left, middle, right, after = (response[..., i : i + count] for i in range(5))
        peak = (middle > left) & (middle >= right)
        curve = (2 * middle - left - right).clamp(min=_TINY)
        shift = 0.5 * (right - left) / curve * peak
        height = middle + 0.25 * (right - left) * shift
        # How far the response falls to either side, 1.5 samples from the maximum. A maximum is born
        # on a slope, where it does not fall to one side: the weight starts at zero there.
        fall = torch.minimum(
            middle - torch.lerp(left, before, 0.5 - shift),
            middle - torch.lerp(right, after, 0.5 + shift),
        )
        sharpness = fall / height.clamp(min=1e-3) * (2 / (1.5 * self.step) ** 2 / _SHARP_ENOUGH)
        weight = height * sharpness.clamp(0, 1) * peak
        distance = self.step * (steps[2:-2] + shift)
        # Weights share 1; one that enters the window takes its share from the others by degrees.
        share = weight * ((self.window - distance.abs()) / (_FADE * self.window)).clamp(0, 1)
        weight = weight / share.sum(-1, keepdim=True).clamp(min=1)
        return EdgeAssignments(distance.to(uv), weight.to(uv))

    def _wells(self, assignments: EdgeAssignments) -> tuple[Tensor, Tensor, Tensor]:
        """Depth of the wells, and first and second derivative of the cost in the distance moved."""
        distance, weight = assignments
        squared = distance.square()
        rho, first, second = self.potential(squared)
        near = squared < self.window**2
        depth = (weight * (self.unmatched - 0.5 * rho).clamp(min=0)).sum(-1)
        weight = torch.where(near, weight, 0.0)
        # d/dt of 1/2 rho((d - t)^2) at t = 0, t the node's motion along its normal.
        slope = -(weight * first * distance).sum(-1)
        curvature = (weight * (first + 2 * second * squared)).sum(-1)
        return depth, slope, curvature

    def value(
        self, nodes: ContourNodes, camera: Camera, edge_field: Float[Tensor, "2 h w"]
    ) -> Float[Tensor, "*batch p"]:
        """Cost of every node, in units of nu."""
        model = camera.project_with_derivatives(nodes.points)
        normal = self._image_normal(model, nodes)
        depth, _, _ = self._wells(self.search(model.uv, normal, edge_field))
        return self._compose(nodes, model, depth)

    def point_cost(
        self,
        nodes: ContourNodes,
        camera: Camera,
        edge_field: Float[Tensor, "2 h w"],
        *,
        gauss_newton: bool = False,
    ) -> PointCost:
        """The same with first and second derivatives in the nodes' positions."""
        model = camera.project_with_derivatives(nodes.points)
        normal = self._image_normal(model, nodes)
        depth, slope, curvature = self._wells(self.search(model.uv, normal, edge_field))
        weight = nodes.visible * nodes.exists * model.valid
        gradient = (weight * slope)[..., None] * normal
        hessian = (weight * curvature)[..., None, None] * normal[..., :, None]
        hessian = hessian * normal[..., None, :]
        value = self._compose(nodes, model, depth)
        return pull_back(model, value, gradient, hessian, gauss_newton=gauss_newton)

    def _image_normal(self, model: ProjectionModel, nodes: ContourNodes) -> Tensor:
        """Unit normal m of the contour in the image, for which `J^T m` is parallel to n."""
        # Only the direction counts; at grazing rays the squares would overflow.
        largest = model.jacobian.abs().amax(dim=(-2, -1), keepdim=True)
        jacobian = model.jacobian / largest.clamp(min=_TINY)
        along = (jacobian * nodes.normals[..., None, :]).sum(-1)
        row_u, row_v = jacobian.unbind(-2)
        uu, vv = row_u.square().sum(-1), row_v.square().sum(-1)
        uv = (row_u * row_v).sum(-1)
        u, v = along.unbind(-1)
        normal = torch.stack([vv * u - uv * v, uu * v - uv * u], dim=-1)
        length = normal.norm(dim=-1, keepdim=True)
        safe = torch.where(length > 0, length, 1.0)
        along = torch.zeros_like(normal)
        along[..., 0] = 1.0
        return torch.where(length > 0, normal / safe, along)

    def _compose(self, nodes: ContourNodes, model: ProjectionModel, depth: Tensor) -> Tensor:
        matched = self.unmatched - torch.where(model.valid, depth, 0.0)
        back_facing = self.fitted_level * self.nu
        occluded = self.occlusion_factor * back_facing
        seen = nodes.visible * matched + (1 - nodes.visible) * occluded
        return nodes.exists * seen + (1 - nodes.exists) * back_facing
