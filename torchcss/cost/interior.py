"""Nodes all over the surface of a body, for terms that look at more than its contour."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.surface import SurfaceSample, surface_points
from torchcss.cost.context import FrameContext
from torchcss.cost.term import Posed
from torchcss.cost.visibility import ContourPredictor, SeenNodes, seen_nodes


class InteriorNodes(nn.Module):
    """A sparse, even choice of surface nodes, fixed in the parts of a body.

    Args:
        body: The body.
        rings: Latitudes on each part.
        meridians: Nodes on each latitude; every other latitude is turned by half a step.

    Attributes:
        node_part: The part of each node.
        node_link: The link of each node.
        points_part: The nodes in the frames of their parts, metres.
        normals_part: Their unit outward normals.
    """

    node_part: Int[Tensor, " p"]
    node_link: Int[Tensor, " p"]
    points_part: Float[Tensor, "parts c 3"]
    normals_part: Float[Tensor, "parts c 3"]

    def __init__(self, body: BodyModel, *, rings: int = 4, meridians: int = 4) -> None:
        super().__init__()
        real, device = torch.float64, body.tie.device
        heights = (torch.arange(rings, dtype=real, device=device) + 0.5) * (2 / rings) - 1
        around = torch.arange(meridians, dtype=real, device=device)
        turned = 0.5 * (torch.arange(rings, device=device) % 2)
        omega = (around + turned[:, None] + 0.25) * (2 * torch.pi / meridians) - torch.pi
        eta = heights.asin()[:, None].expand_as(omega)
        full = (body.num_parts, rings * meridians)
        sample = surface_points(
            body.part_shape.to(real)[:, None, :],
            eta.flatten().expand(full),
            omega.flatten().expand(full),
        )
        parts = torch.arange(body.num_parts, device=device)
        for name, value in (
            ("node_part", parts.repeat_interleave(rings * meridians)),
            ("node_link", body.part_link.repeat_interleave(rings * meridians)),
            ("points_part", sample.points.to(body.dtype)),
            ("normals_part", sample.normals.to(body.dtype)),
        ):
            self.register_buffer(name, value, persistent=False)

    @property
    def num_nodes(self) -> int:
        """Number of nodes."""
        return len(self.node_part)

    def forward(self, body: BodyModel, pose: BodyPose) -> SurfaceSample:
        """World positions and unit outward normals of the nodes, in the order of `node_part`.

        Args:
            body: The body that the nodes were chosen on (its base may have moved).
            pose: Any number of posed bodies.
        """
        return body.in_world(pose, self.points_part, self.normals_part)


def count_nodes(context: FrameContext) -> int:
    """N of eq. 5 of both papers: the nodes on contours and those inside together."""
    return sum(context.tables.of(kind).num_nodes for kind in (ContourPredictor, InteriorNodes))


def interior_nodes(posed: Posed) -> SurfaceSample:
    """The interior nodes of posed bodies."""
    return posed.context.tables.of(InteriorNodes)(posed.body, posed.pose)


def seen_interior(posed: Posed) -> SeenNodes:
    """The same with which of them face the camera, and which of these no other part hides."""
    points, normals = posed.of(interior_nodes)
    part = posed.context.tables.of(InteriorNodes).node_part
    return seen_nodes(posed.body, posed.pose, posed.camera.centre_world, points, normals, part)
