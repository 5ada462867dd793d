"""Surface term: nodes look in this frame as they did in the frame before.

For a node j on the surface, x' a mode of the frame before, and c the local contrast of the two
pictures (`torchcss.vision.contrast`),

    residual   = c_t(r_j(x)) - c_{t-1}(r_j(x'))
    e_j(x)     = w_j (f_j 1/2 rho(residual^2) + (1 - f_j) nu_bf)

w_j is 1 for a node that was seen at x', 0 for one that was hidden, turned away or outside the
image; f_j is 1 where the node faces the camera at x, 0 where it faces away, which costs as much as
a well-fitted node. This is the motion of a region of known shape straight from brightness (Bregler
and Malik, Tracking people with twists and exponential maps, 1998, section 2), where the flow term
(`torchcss.cost.flow`, eq. 9 [IJRR]) follows a flow that knows nothing of shape. A body that turns
moves its surface by other pixels in the middle than at the rim, where new sides come into sight;
the flow, smooth and of a few pixels, loses it there.

A node outside the image, or where there is no image, sees no contrast: the splines fade to zero.
Derivatives hold facing fixed.

By default: `surface_targets(...)` for the modes of the frame before, then
`SurfaceTerm().point_cost(...)`.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cost.visibility import SeenNodes
from torchcss.robust import Leclerc, RobustPotential
from torchcss.types import PointCost, frozen
from torchcss.vision.camera import Camera
from torchcss.vision.spline import SplineField


class SurfaceTargets(NamedTuple):
    """What the nodes of each parent mode looked like.

    Attributes:
        level: Local contrast at each node.
        weight: w in [0, 1]; zero where the node was not seen.
    """

    level: Float[Tensor, "*k p"]
    weight: Float[Tensor, "*k p"]

    def take(self, parent: Int[Tensor, "*b"]) -> SurfaceTargets:
        """The targets of each sample, by the index of its parent mode."""
        return SurfaceTargets(self.level[parent], self.weight[parent])


def surface_targets(nodes: SeenNodes, camera: Camera, contrast: SplineField) -> SurfaceTargets:
    """What nodes look like in a picture.

    Args:
        nodes: Nodes at the modes of the frame before, with what was seen of them.
        camera: Camera of that frame, at the size of the picture.
        contrast: Its local contrast.
    """
    projection = camera.project(nodes.points)
    width, height = camera.image_size_wh
    inside = (projection.uv >= 0) & (projection.uv <= projection.uv.new_tensor([width, height]) - 1)
    seen = inside.all(-1) & projection.valid
    return SurfaceTargets(contrast.value(projection.uv), nodes.exists * nodes.visible * seen)


@frozen
class SurfaceTerm:
    """The robust cost of the nodes' change of look.

    Attributes:
        sigma: Scale of the difference of contrasts, in local deviations of the picture.
        nu: Level of the outliers of one node.
        fitted_level: Cost of a node that faces away, `nu_bf`, as a share of nu: about that of a
            node that is found.
    """

    sigma: float = 0.5
    nu: float = 1.0
    fitted_level: float = 0.15

    @property
    def potential(self) -> RobustPotential:
        """`rho` on the squared difference of contrasts."""
        return Leclerc(nu=self.nu, sigma=self.sigma)

    def point_cost(
        self, nodes: SeenNodes, camera: Camera, contrast: SplineField, targets: SurfaceTargets
    ) -> PointCost:
        """Cost of every node, in units of nu, with derivatives in the nodes' positions.

        The Hessian is Gauss and Newton's: it leaves out the curvature of the picture, of rho and of
        the projection, so that it has no negative eigenvalue.

        Args:
            nodes: Nodes at the sample's pose, and which of them face the camera.
            camera: Camera of this frame, at the size of the picture.
            contrast: Local contrast of this frame.
            targets: Targets of each sample's own parent, or of one for all.
        """
        model = camera.project_with_derivatives(nodes.points)
        look = contrast.sample(model.uv)
        error, slope = look.value - targets.level, look.gradient
        rho, first, _ = self.potential(error.square())
        weight = targets.weight * nodes.exists
        hessian = (weight * first)[..., None, None] * slope[..., :, None] * slope[..., None, :]
        gradient = (weight * first * error)[..., None] * slope
        back_facing = self.fitted_level * self.nu
        value = targets.weight * (nodes.exists * 0.5 * rho + (1 - nodes.exists) * back_facing)
        return camera.pull_back(model, value, gradient, hessian, gauss_newton=True)
