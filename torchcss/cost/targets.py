"""Points of the body against known places in space: 3D observations, and poses of a link.

For points p that are fixed in links, with known places t,

    f(x) = 1/2 sum_p |p(x) - t_p|^2 / sigma_p^2

in nats, with the priors of a body. With markers or triangulated joints this is an observation; with
four points around the origin of one link, and no prior, it is zero exactly where that link has a
given position and orientation, which is what inverse kinematics asks for (`pose_targets`,
`torchcss.inverse_kinematics`). Value, gradient and exact Hessian are in closed form
(`torchcss.body.lift`).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.uncertainty import point_jacobian
from torchcss.cost.interpenetration import Interpenetration, InterpenetrationPairs
from torchcss.cost.stabiliser import Stabiliser, long_tailed
from torchcss.errors import ShapeError, check_shape
from torchcss.kernels import compiler
from torchcss.types import CostFunction, LocalModel, Numbers, PointCost, Vector, Vectors, frozen

States = Float[Tensor, "*batch m"]

_CORNERS = ((1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0))
"""A regular tetrahedron: seen from its middle, errors of orientation about all axes count alike."""


ARM = 0.25
"""Distance of a pose's points from the link's origin, metres: a radian counts as much as this."""


@frozen
class PointTargets:
    """Squared distances of points from where they should be, and priors; a `CostFunction`.

    Attributes:
        body: The body, hung on its base.
        link: The link that carries each point.
        offset: The points in the frames of their links, metres.
        target: Where they should be in the world, metres; the same for all items, or item by item.
        sigma: Standard deviation of each point's coordinates, metres.
        columns: The parameters that x consists of, in its order; None: all.
        held: A whole state of the body, at which the others stay; None: there are none.
        sticky: Whether the stabilisers say what the points do not tell.
        repulsion: Keeps parts out of each other, if `pairs` are there too.
        pairs: Which parts may collide.
    """

    body: BodyModel
    link: Int[Tensor, " p"]
    offset: Float[Tensor, "p 3"]
    target: Float[Tensor, "*#batch p 3"]
    sigma: Float[Tensor, " p"]
    columns: Int[Tensor, " m"] | None = None
    held: Vector | None = None
    sticky: bool = True
    repulsion: Interpenetration | None = None
    pairs: InterpenetrationPairs | None = None

    def compiled(self) -> CostFunction:
        """The same in compiled calls where there are any: for whole states, on a CPU with numba."""
        whole = self.columns is None and self.repulsion is None
        if not (whole and self.target.device.type == "cpu" and compiler.AVAILABLE):
            return self
        # Importing the kernels takes a third of a second.
        from torchcss.cost.fused.targets import FusedTargets

        return FusedTargets.of(self)

    def take(self, items: Int[Tensor, " b"]) -> PointTargets:
        """The cost of some items; the same where all have the same targets."""
        return self if self.target.dim() == 2 else replace(self, target=self.target[items])

    def whole(self, x: States) -> Vectors:
        """States of the body: x, and what is held."""
        if self.columns is None or self.held is None:
            return x
        check_shape("x", x, len(self.columns))
        held = self.held.expand(*x.shape[:-1], len(self.held))
        return held.index_copy(-1, self.columns, x)

    def value(self, x: States) -> Numbers:
        """Cost in nats."""
        return self.local_model(x).value

    def local_model(self, x: States) -> LocalModel:
        """Cost, gradient and exact Hessian."""
        body, weight = self.body, self.sigma.pow(-2)
        pose, points = self._pose(x)
        error = points - self.target
        stiffness = weight[:, None, None] * torch.eye(3, dtype=error.dtype, device=error.device)
        cost = PointCost(
            0.5 * weight * error.square().sum(-1),
            weight[:, None] * error,
            stiffness.expand(*error.shape, 3),
        )
        total = body.lift(pose, points, self.link, cost)
        if self.sticky:
            mean, deviation = body.sticky_mean, body.sticky_deviation
            total = total.plus(long_tailed(pose.x, mean, deviation, Stabiliser.nu))
        if self.repulsion is not None and self.pairs is not None:
            total = total.plus(self.repulsion.local_model(body, pose, self.pairs))
        if self.columns is None:
            return total
        value, slope, curvature = total
        columns = self.columns
        return LocalModel(value, slope[..., columns], curvature[..., columns[:, None], columns])

    def errors(
        self, x: Float[Tensor, "b m"]
    ) -> tuple[Float[Tensor, "b p 3"], Float[Tensor, "b p 3 m"]]:
        """By how much the points miss their targets, metres, and the derivatives of that in x."""
        pose, points = self._pose(x)
        moved = point_jacobian(self.body, pose.tree, points, self.link)
        return points - self.target, moved if self.columns is None else moved[..., self.columns]

    def _pose(self, x: States) -> tuple[BodyPose, Float[Tensor, "*batch p 3"]]:
        pose = self.body.pose(self.whole(x))
        return pose, self.body.points_on_links(pose.tree, self.link, self.offset)


def pose_targets(
    body: BodyModel,
    link: str,
    pose: Float[Tensor, "4 4"] | Float[Tensor, "3"],
    *,
    columns: Int[Tensor, " m"] | None = None,
    held: Vector | None = None,
    sigma: float = 0.1,
) -> PointTargets:
    """The cost of a link that should have a given pose.

    Four points at the corners of a regular tetrahedron about the link's origin, in the mean:

        f(x) = 1/2 (|t - t'|^2 + 2/3 ARM^2 (1 - cos angle) 2) / sigma^2

    with t the origin, and the angle that of the rotation between the orientations.

    Args:
        body: The body on its base.
        link: The link.
        pose: Its frame in the world, or the place of its origin alone, metres.
        columns: The parameters to search; all of them by default.
        held: Values of the others; the rest pose by default.
        sigma: Scale of the errors, metres.

    Raises:
        BodyError: If the body has no such link.
        ShapeError: If the pose is neither.
    """
    if pose.shape not in ((4, 4), (3,)):
        raise ShapeError(f"pose: expected a frame [4, 4] or a place [3], got {list(pose.shape)}")
    corners = ARM / 3**0.5 * body.tie.new_tensor(_CORNERS if pose.dim() == 2 else [[0.0] * 3])
    pose = pose.to(body.tie)
    target = corners @ pose[:3, :3].T + pose[:3, 3] if pose.dim() == 2 else pose[None]
    num = len(corners)
    return PointTargets(
        body=body,
        link=torch.full((num,), body.tree.link_index(link), device=body.tie.device),
        offset=corners,
        target=target,
        sigma=corners.new_full((num,), sigma * num**0.5),
        columns=columns,
        held=body.rest if held is None else held,
        sticky=False,
    )
