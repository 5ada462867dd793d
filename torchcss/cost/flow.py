"""Flow term: interior nodes follow the robust optical flow, eq. 9 [IJRR].

For a node j on the surface, x' a mode of the previous frame, and F the optical flow from the
previous frame to this one,

    target_j   = r_j(x') + F(r_j(x'))
    residual   = target_j - r_j(x)
    e_j(x)     = 1/2 rho(W_j |residual|^2) + (1 - W_j) nu_bf

The weight W_j in [0, 1] is one minus the flow's outlier map at r_j(x'), and goes to zero where the
node was hidden, turned away or outside the image at x': there is nothing to follow. The constant
(1 - W_j) nu_bf, which eq. 9 lacks, makes such a node cost as much as a well-fitted one; without it
a mode would gain from having lost sight of its nodes. It does not depend on x.

Every sample is compared with the targets of its own parent mode x'. They are computed once per
parent: `flow_targets` for all modes of the previous frame.
`FlowTerm.printed` is eq. 9 as it stands: without that constant, and divided by N of eq. 5.

At x, a node that faces away costs `nu_bf`, one hidden behind another part `nu_occ = k nu_bf`
(eq. 5), both at the level of a fitted model as in `torchcss.cost.contour`. Facing is a ramp in the
angle to the line of sight, occlusion whatever the caller's visibility test says, so that the cost
has no jump where nodes come and go. A node outside the image keeps its residual, which pulls it
back; one behind the camera costs the constant of a residual as long as the image's diagonal.
Derivatives hold facing and visibility fixed.

By default: one `InteriorNodes(body)` per body, then per frame `flow_targets(...)` with the modes of
the frame before, and `FlowTerm().point_cost(...)`.
"""

from __future__ import annotations

import math
from types import EllipsisType
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchcss.cost.context import FrameContext
from torchcss.cost.interior import InteriorNodes, count_nodes, seen_interior
from torchcss.cost.term import Need, OnPoints, Points, Posed, Term, Values
from torchcss.cost.visibility import SeenNodes
from torchcss.errors import ShapeError, check_shape
from torchcss.robust import Lorentzian, RobustPotential, residual_cost
from torchcss.types import PointCost, frozen
from torchcss.vision.camera import Camera
from torchcss.vision.sampling import sample_bilinear

_NEAR_RAMP = 0.1
"""Depth behind the camera's near plane over which a node comes to count, metres."""

_UNKNOWN_FLOW = 1.0e9
"""Displacements from here on mean "unknown" in flow files."""


class FlowTargets(NamedTuple):
    """Where the flow says that the nodes of each parent mode went.

    Attributes:
        uv: Target of each node, pixels.
        weight: W in [0, 1]; zero where there is nothing to follow.
    """

    uv: Float[Tensor, "*k p 2"]
    weight: Float[Tensor, "*k p"]


def flow_targets(
    nodes: SeenNodes,
    camera: Camera,
    flow: Float[Tensor, "2 h w"],
    outlier: Float[Tensor, "h w"] | None = None,
) -> FlowTargets:
    """Follow the nodes of the previous frame's modes along the flow.

    Args:
        nodes: The interior nodes of the modes, with what was seen of them, on the present base.
        camera: Camera of both frames, at the size of the flow.
        flow: Displacement from the previous frame to this one, pixels (u right, v down), at the
            pixels of the previous frame. Infinite ones are unknown, as those from 1e9 on.
        outlier: Outlier map of the flow in [0, 1]; None: no outliers.

    Raises:
        ShapeError: If flow and outlier map are no images of the camera's size.
    """
    width, height = camera.image_size_wh
    check_shape("flow", flow, 2, height, width)
    if flow.ndim != 3:
        raise ShapeError(f"flow: expected one flow [2, {height}, {width}], got {list(flow.shape)}")
    if outlier is not None:
        check_shape("outlier", outlier, height, width)
    projection = camera.project(nodes.points)
    # What is not beside a node is not looked at: it stays as it is in memory.
    channels, box = flow.new_empty(4, height, width), _box(projection.uv, height, width)
    is_known = flow[box].abs().amax(dim=0) < _UNKNOWN_FLOW
    known = is_known.to(flow)
    channels[:2][box] = torch.where(is_known, flow[box], 0.0)
    channels[2][box] = known
    channels[3][box] = known if outlier is None else known * (1 - outlier[box].to(flow))
    values, inside = sample_bilinear(channels, projection.uv)
    # The mean of the known pixels alone: the zeros in place of the others say nothing.
    share = values[..., 2:3]
    moved = values[..., :2] / torch.where(share > 0, share, 1.0)
    seen = nodes.exists * (inside & projection.valid)
    weight = values[..., 3].clamp(0, 1) * seen * nodes.visible
    return FlowTargets(projection.uv + moved, weight)


def _box(uv: Tensor, height: int, width: int) -> tuple[EllipsisType, slice, slice]:
    """The index of the pixels of an image that are beside some places, or nearest to them."""
    within = uv.reshape(-1, 2).clamp(min=0).minimum(uv.new_tensor([width - 1, height - 1]))
    if not len(within):
        return (..., slice(0), slice(0))
    ends = torch.stack([(within.amin(0) - 1).clamp(min=0), within.amax(0) + 3])
    (left, top), (right, bottom) = ends.int().tolist()
    return (..., slice(top, bottom), slice(left, right))


@frozen
class FlowTerm(Term):
    """The robust cost of the interior nodes' displacement from the previous frame.

    Attributes:
        weight: Nats per nu of the mean cost per node. At 50 it holds real limbs a little better,
            but where the flow misses a fast hand, as on the demo, it holds that back; at 20 the
            edges win.
        sigma: Scale of the difference between predicted and measured place, pixels. The flow is
            good to some tenths of a pixel; a wide scale lets a mode lag by as much in every frame.
        nu: Level of the outliers of one node (its unit only: the sum is normalised by N nu).
        fitted_level: Cost of a node without measurement, `nu_bf`, as a share of nu: the mean error
            per node of a fitted model before a real camera, 0.6 to 0.8 on the beam clip (0.1 to 0.3
            on the demo's sequence at its true states). Lower, and a limb gains by facing away from
            a flow that it misses by half a pixel.
        occlusion_factor: k of `nu_occ = k nu_bf`, see `ContourTerm`.
        potential_kind: The potential rho.
        printed: Whether the term is eq. 9 alone; see the module.
    """

    name = "flow"
    kind = "image"
    watched = True
    of_motion = True
    of_several = True

    weight: float = 20.0
    sigma: float = 0.5
    nu: float = 1.0
    fitted_level: float = 0.7
    occlusion_factor: float = 1.1
    potential_kind: type = Lorentzian
    printed: bool = False

    @property
    def untold(self) -> float:
        """Cost of a node without measurement."""
        return 0.0 if self.printed else self.fitted_level * self.nu

    @property
    def needs(self) -> frozenset[Need]:
        """Optical flow."""
        return frozenset(("flow",))

    def prepare(self, context: FrameContext) -> OnPoints | None:
        """Follow the nodes of the modes before; None without flow or modes."""
        features, modes, body = context.features, context.modes, context.body
        if features is None or features.flow is None or modes is None:
            return None
        outlier = None if features.flow_outlier is None else features.flow_outlier.to(body.tie)
        before = seen_interior(Posed(context, body, body.pose(modes)))
        nodes = context.tables.of(InteriorNodes)
        count = count_nodes(context) if self.printed else nodes.num_nodes
        return OnPoints(
            term=self,
            find=seen_interior,
            image=flow_targets(before, context.camera, features.flow.to(body.tie), outlier),
            link=nodes.node_link,
            scale=self.weight / (max(count, 1) * self.nu),
            size=nodes.num_nodes,
            of_parents=lambda posed, aims: FlowTargets(*(posed.of_parent(part) for part in aims)),
        )

    @property
    def potential(self) -> RobustPotential:
        """`rho` on the squared difference in pixels."""
        return self.potential_kind(nu=self.nu, sigma=self.sigma)

    def value(
        self, nodes: SeenNodes, camera: Camera, targets: FlowTargets, at: Points | None = None
    ) -> Values:
        """Cost of every node, in units of nu.

        Args:
            nodes: Interior nodes at the sample's pose, with what is seen of them.
            camera: Camera of this frame, at the size of the flow.
            targets: Targets of each sample's own parent, or of one for all.
            at: Where the nodes have moved since, as they faced the camera before.
        """
        projection = camera.project(nodes.points)
        near = _in_front(projection.depth, projection.valid, camera)
        if at is not None:
            projection = camera.project(at)
        squared = targets.weight * (projection.uv - targets.uv).square().sum(-1)
        return self._composed(0.5 * self.potential(squared).rho, nodes, near, camera, targets)

    def point_cost(
        self, nodes: SeenNodes, camera: Camera, targets: FlowTargets, *, gauss_newton: bool = False
    ) -> PointCost:
        """The same with first and second derivatives in the nodes' positions.

        Args:
            nodes: Interior nodes at the sample's pose, with what is seen of them.
            camera: Camera of this frame, at the size of the flow.
            targets: Targets of each sample's own parent, or of one for all.
            gauss_newton: Leave out the curvature of the projection.
        """
        model = camera.project_with_derivatives(nodes.points)
        near = _in_front(model.depth, model.valid, camera)
        seen = nodes.exists * nodes.visible * near
        error = model.uv - targets.uv
        cost, gradient, hessian = residual_cost(self.potential, error, targets.weight, seen)
        value = self._composed(cost, nodes, near, camera, targets)
        return camera.pull_back(model, value, gradient, hessian, gauss_newton=gauss_newton)

    def _composed(
        self, cost: Tensor, nodes: SeenNodes, near: Tensor, camera: Camera, targets: FlowTargets
    ) -> Values:
        far = self.potential(targets.weight * math.hypot(*camera.image_size_wh) ** 2).rho
        back_facing = self.fitted_level * self.nu
        untold = (1 - targets.weight) * self.untold
        in_front = nodes.cost(cost + untold, back_facing, self.occlusion_factor)
        return near * in_front + (1 - near) * (0.5 * far + untold)


def _in_front(depth: Tensor, valid: Tensor, camera: Camera) -> Values:
    """1 where the camera can see the place, 0 behind its near plane, a ramp in front of that."""
    return ((depth - camera.near) / _NEAR_RAMP).clamp(0, 1) * valid
