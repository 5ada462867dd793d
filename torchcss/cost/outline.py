"""What the terms of the outline have in common: they look at the image where contour nodes are.

Of each node of the occluding contours (`torchcss.cost.visibility`) that is seen a term tells how
well the image matches it, and what it costs then. What the others cost is the same for all terms:
those without a contour `nu_bf`, those that are hidden `nu_occ = k nu_bf` (eq. 5 [IJRR]). Both are
levels of a fitted model, so that hiding is no better than fitting.

To add such a term derive from `OutlineTerm`: give `match`, `derivatives`, and `matched`, and in
`prepare` call `bind` with what they are to look at.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from torchcss.cost.context import FrameContext
from torchcss.cost.term import OnPoints, Points, Term, Values
from torchcss.cost.visibility import ContourPredictor, SeenNodes, contour_nodes, places
from torchcss.types import PointCost, frozen
from torchcss.vision.camera import Camera, ProjectionModel

Each = Float[Tensor, " k"]
InImage = Float[Tensor, "k 2"]
"""A number, or two, for each node that is seen."""

Derivatives = tuple[Each, InImage, Float[Tensor, "k 2 2"]]
"""Value, gradient and Hessian in the image."""


class ImageNodes(NamedTuple):
    """The contour nodes of a batch that are seen, in the image.

    Attributes:
        place: Their places among all nodes of the batch.
        uv: Where they are, pixels.
        normal: Unit outward normals in the image.
        weight: How much each counts.
    """

    place: Int[Tensor, " k"]
    uv: InImage
    normal: InImage
    weight: Each


@frozen
class OutlineTerm(Term):
    """A term of the contour nodes.

    Attributes:
        weight: Nats per nu of the mean cost per node.
        nu: Level of the outliers of one node (its unit only: the sum is normalised by N nu).
        fitted_level: Cost of a node where there is no contour, as a share of nu: the mean error per
            node of a fitted model. Too low a level invites a badly fitting limb to hide.
        occlusion_factor: k of `nu_occ = k nu_bf`. [IJRR] says k > 1, [RR] k < 1; slightly above 1
            keeps hidden nodes dearer than matched ones and cheaper than bad fits (decision
            "occlusion levels").
    """

    kind = "image"
    watched = True
    screens = True

    weight: float
    nu: float = 1.0
    fitted_level: float
    occlusion_factor: float = 1.1

    @abstractmethod
    def match(self, nodes: ImageNodes, image: Any, at: InImage | None = None) -> Each:
        """How well the image matches the nodes, zero if not at all.

        Args:
            nodes: The nodes.
            image: What `bind` was given.
            at: Where they have moved in the image since, with all that was found held.
        """

    @abstractmethod
    def derivatives(self, nodes: ImageNodes, image: Any) -> Derivatives:
        """The match, and gradient and Hessian of the weighted cost in the nodes' pixels."""

    @abstractmethod
    def matched(self, match: Values) -> Values:
        """Cost of a node by its match, in units of nu."""

    def bind(self, context: FrameContext, image: Any, count: int | None = None) -> OnPoints:
        """The term on what it looks at in a frame.

        Args:
            context: The frame.
            image: What the term looks at.
            count: What the sum over nodes is divided by; None: their number.
        """
        nodes = context.tables.of(ContourPredictor)
        count = nodes.num_nodes if count is None else count
        return OnPoints(
            term=self,
            find=contour_nodes,
            image=image,
            link=nodes.node_link,
            scale=self.weight / (max(count, 1) * self.nu),
            size=nodes.num_nodes,
        )

    def value(
        self, nodes: SeenNodes, camera: Camera, image: Any, at: Points | None = None
    ) -> Values:
        """Cost of every node, in units of nu.

        Args:
            nodes: Nodes on the predicted contours, with what is seen of them.
            camera: The camera of the image.
            image: What the term looks at.
            at: Where the nodes have moved since, with all that was found held.
        """
        seen, model, camera = _in_image(nodes, camera)
        uv = None
        if at is not None:
            uv = camera.project(at.flatten(0, -2).index_select(0, seen.place)).uv
        match = model.valid * self.match(seen, image, uv)
        return self._composed(nodes, _spread(match, seen.place, nodes))

    def point_cost(
        self, nodes: SeenNodes, camera: Camera, image: Any, *, gauss_newton: bool = False
    ) -> PointCost:
        """The same with first and second derivatives in the nodes' positions.

        Args:
            nodes: Nodes on the predicted contours; what is seen of them is held fixed.
            camera: The camera of the image.
            image: What the term looks at.
            gauss_newton: Leave the curvature of the projection out.
        """
        seen, model, camera = _in_image(nodes, camera)
        match, gradient, hessian = self.derivatives(seen, image)
        match = model.valid * match
        cost = camera.pull_back(model, match, gradient, hessian, gauss_newton=gauss_newton)
        match, gradient, hessian = (_spread(part, seen.place, nodes) for part in cost)
        return PointCost(self._composed(nodes, match), gradient, hessian)

    def _composed(self, nodes: SeenNodes, match: Tensor) -> Values:
        back_facing = self.fitted_level * self.nu
        return nodes.cost(self.matched(match), back_facing, self.occlusion_factor)


def _in_image(nodes: SeenNodes, camera: Camera) -> tuple[ImageNodes, ProjectionModel, Camera]:
    """The nodes of the whole batch that count, in the image, their projection and their camera."""
    index = places(nodes.visible * nodes.exists > 0)
    last = nodes.exists.dim() - 1
    points, normals, exists, visible = (
        part.flatten(0, last).index_select(0, index) for part in nodes
    )
    camera = camera.of_rows(index, nodes.exists.numel())
    model = camera.project_with_derivatives(points)
    normal = camera.image_normals(model, normals)
    return ImageNodes(index, model.uv, normal, visible * exists * model.valid), model, camera


def _spread(
    part: Float[Tensor, "k *rest"], index: Int[Tensor, " k"], nodes: SeenNodes
) -> Float[Tensor, "..."]:
    """What was worked out for the nodes that count, and zero for the others: `[*batch p *rest]`."""
    components = part.movedim(0, -1)
    shape, rest = nodes.exists.shape, components.shape[:-1]
    whole = components.new_zeros(*rest, shape.numel()).index_copy(-1, index, components)
    return whole.reshape(*rest, *shape).movedim(
        tuple(range(len(rest))), tuple(range(-len(rest), 0))
    )
