"""The cost of pose, lengths and shape together: stages two and three of section 5 [IJRR].

    f(x, z) = joints(x) + priors(x) + outlines(x, z) + 1/2 z^T P z

`x` is the state of a body (lengths included, if they are free), `z` its shape parameters
(`torchcss.body.shape`), P the precision of their prior. Joints do not see the shape; outlines, by
their edges and by the colours on either side, see both. Contour nodes and their edges are found
fresh at every (x, z), and the derivatives hold them fixed, as everywhere: a node keeps its angles
on the part's surface and moves with pose and shape.

Every item has a shape of its own, so items are worked off one after another. Make a `ShapedCost`
and give it to the optimiser; hold variables by bounds of no width.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.shape import ShapeParameters, lift_with_shape, surface_angles, with_shape
from torchcss.cost.outline import OutlineTerm
from torchcss.cost.total import TrackingCost
from torchcss.cost.visibility import ContourPredictor
from torchcss.types import LocalModel, PointCost, Vector, frozen


class Outline(NamedTuple):
    """What the outline is compared with.

    Attributes:
        term: How.
        image: With what: edge energy times gradient direction, or colours.
        weight: Nats per nu of the mean cost per node.
    """

    term: OutlineTerm
    image: Any
    weight: float


@frozen
class ShapedCost:
    """Cost of pose and shape; a `CostFunction` on states followed by shape parameters.

    Attributes:
        base: The terms that do not see the shape; its body has the shape from which z counts.
        parameters: Which shape numbers are free.
        outlines: The terms that do.
    """

    base: TrackingCost
    parameters: ShapeParameters
    outlines: tuple[Outline, ...]

    def take(self, items: Int[Tensor, " b"]) -> ShapedCost:
        """The cost of some of the items: the same for all."""
        return self

    def value(self, x: Float[Tensor, "b m"]) -> Float[Tensor, " b"]:
        """Cost in nats."""
        return self.local_model(x).value

    def local_model(self, x: Float[Tensor, "b m"]) -> LocalModel:
        """Cost, gradient and Hessian."""
        n = self.base.body.num_parameters
        state, z = x[:, :n], x[:, n:]
        plain = self.base.local_model(state)
        items = range(len(x) if self.outlines else 0)
        outlines = [self._outlines(state[item], z[item]) for item in items]
        pull = z @ self.parameters.precision
        prior = 0.5 * (pull * z).sum(-1)
        gradient = torch.cat([plain.gradient, pull], dim=-1)
        hessian = x.new_zeros(*x.shape, x.shape[-1])
        hessian[:, :n, :n] = plain.hessian
        hessian[:, n:, n:] = self.parameters.precision
        model = LocalModel(plain.value + prior, gradient, hessian)
        if not outlines:
            return model
        return model.plus(
            LocalModel(*(torch.stack(field) for field in zip(*outlines, strict=True)))
        )

    def _outlines(self, x: Vector, z: Float[Tensor, " z"]) -> LocalModel:
        camera, shape = self.base.camera, self.parameters.shape(z)
        body = with_shape(self.base.body, shape)
        predictor = ContourPredictor(body)
        pose = body.pose(x[None])
        nodes = predictor(body, pose, camera.centre_world)
        costs = []
        for term, image, weight in self.outlines:
            scale = weight / (max(predictor.num_nodes, 1) * term.nu)
            cost = term.point_cost(nodes, camera, image)
            costs.append([scale * field[0] for field in cost])
        cost = PointCost(*(sum(fields) for fields in zip(*costs, strict=True)))  # type: ignore[arg-type]
        pose, points, part = body.pose(x), nodes.points[0], predictor.node_part
        rotation, centre = body.part_poses(pose)
        local = ((points - centre[part])[:, None, :] @ rotation[part])[:, 0]
        angles = surface_angles(shape[part], local)
        return lift_with_shape(body, pose, points, part, angles, cost, self.parameters)
