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

from dataclasses import dataclass
from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cost.visibility import front_facing
from torchcss.robust import Leclerc, RobustPotential
from torchcss.types import PointCost
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


def surface_targets(
    points_world: Float[Tensor, "*k p 3"],
    normals_world: Float[Tensor, "*k p 3"],
    visible: Float[Tensor, "*#k p"],
    camera: Camera,
    contrast: SplineField,
) -> SurfaceTargets:
    """What nodes look like in a picture.

    Args:
        points_world: Nodes at the modes of the frame before, metres.
        normals_world: Their unit outward normals.
        visible: 1 where no other part was in front of the node, 0 where one was.
        camera: Camera of that frame, at the size of the picture.
        contrast: Its local contrast.
    """
    projection = camera.project(points_world)
    width, height = camera.image_size_wh
    inside = (projection.uv >= 0) & (projection.uv <= projection.uv.new_tensor([width, height]) - 1)
    facing = front_facing(points_world, normals_world, camera.centre_world)
    seen = inside.all(-1) & projection.valid
    return SurfaceTargets(contrast.value(projection.uv), facing * visible * seen)


@dataclass(frozen=True, kw_only=True)
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

    def value(
        self,
        points_world: Float[Tensor, "*batch p 3"],
        normals_world: Float[Tensor, "*batch p 3"],
        camera: Camera,
        contrast: SplineField,
        targets: SurfaceTargets,
    ) -> Float[Tensor, "*batch p"]:
        """Cost of every node, in units of nu.

        Args:
            points_world: Nodes at the sample's pose, metres.
            normals_world: Their unit outward normals.
            camera: Camera of this frame, at the size of the picture.
            contrast: Local contrast of this frame.
            targets: Targets of each sample's own parent, or of one for all.
        """
        error = contrast.value(camera.project(points_world).uv) - targets.level
        facing = front_facing(points_world, normals_world, camera.centre_world)
        return self._compose(self.potential(error.square()).rho, facing, targets)

    def point_cost(
        self,
        points_world: Float[Tensor, "*batch p 3"],
        normals_world: Float[Tensor, "*batch p 3"],
        camera: Camera,
        contrast: SplineField,
        targets: SurfaceTargets,
        *,
        gauss_newton: bool = False,
    ) -> PointCost:
        """The same with first and second derivatives in the nodes' positions.

        Args:
            points_world: Nodes at the sample's pose, metres.
            normals_world: Their unit outward normals.
            camera: Camera of this frame, at the size of the picture.
            contrast: Local contrast of this frame.
            targets: Targets of each sample's own parent, or of one for all.
            gauss_newton: Leave out the curvature of the picture, of rho and of the projection, so
                that no Hessian has a negative eigenvalue.
        """
        model = camera.project_with_derivatives(points_world)
        look = contrast.sample(model.uv)
        error = look.value - targets.level
        rho, first, second = self.potential(error.square())
        facing = front_facing(points_world, normals_world, camera.centre_world)
        weight = targets.weight * facing
        bend = first if gauss_newton else first + 2 * second * error.square()
        slope = look.gradient
        hessian = (weight * bend)[..., None, None] * slope[..., :, None] * slope[..., None, :]
        if not gauss_newton:
            hessian = hessian + (weight * first * error)[..., None, None] * look.hessian
        return camera.pull_back(
            model,
            self._compose(rho, facing, targets),
            (weight * first * error)[..., None] * slope,
            hessian,
            gauss_newton=gauss_newton,
        )

    def _compose(
        self, rho: Tensor, facing: Tensor, targets: SurfaceTargets
    ) -> Float[Tensor, "*batch p"]:
        back_facing = self.fitted_level * self.nu
        return targets.weight * (facing * 0.5 * rho + (1 - facing) * back_facing)
