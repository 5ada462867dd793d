"""Silhouette term: what has come before the background is covered, and the body is nowhere else.

The terms of the contour look a few pixels to either side of it. A limb that is farther off than
that feels nothing, though before a known background the true one stands out. Section 8 [IJRR] hopes
for help of silhouettes. Here body and silhouette have to agree. Let u_m be points of the silhouette
and g_m, in 0..1, how sure it is that they are the body's; r_p nodes all over the surface, hidden
ones too, seen at pi(r_p); N the points that the expected body would have, or the sum of g_m if that
is more; P the number of nodes:

    e(x) = 1/N sum_m g_m phi(s_m) + beta/P sum_p D(pi(r_p))
    s_m = sum_p exp(-|u_m - pi(r_p)|^2 / (2 sigma^2))
    phi(s) = log((1 + epsilon) / (1 + epsilon - exp(-s))) / log((1 + epsilon) / epsilon)

phi falls from 1, where no node is near, to 0, where many are; it is the logarithm of a distance far
off and does not count what is nowhere near anything: another person, a shadow. D is the distance to
the nearest pixel that may be the body, as a share of `reach` and no more than 1.

A pixel of which it is not known what is behind it says nothing: it may be the body, and need not.
The term knows no depth, and nothing of what lies inside the silhouette; both are left to others.

The gradient is exact. In the Hessian the shares in which the nodes cover a point are held fixed, as
edges are to their nodes in the contour term; it is positive semidefinite but for D's part.

By default: `SilhouetteTerm().images(...)` once a frame, then `point_cost`; `torchcss.cost.frame`
does it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from torchcss.cost.context import FrameContext
from torchcss.cost.interior import InteriorNodes, interior_nodes
from torchcss.cost.part_map import grow, part_map
from torchcss.cost.term import Need, OnPoints, Points, Term, Values
from torchcss.types import PointCost, frozen
from torchcss.vision.camera import Camera
from torchcss.vision.spline import SplineField, spline_field

_PAIRS = 64
"""Pairs of a node and a point of the silhouette that take as much memory as one node."""

_FEWEST_POINTS = 5.0
"""A body that is expected to have fewer counts as if it had so many."""


class SilhouetteImages(NamedTuple):
    """The silhouette of a frame, in a reduced image.

    Attributes:
        camera: Camera of the reduced image.
        points: Points of the silhouette in that image, pixels.
        weight: How much each counts, as a share of all points that the body would have.
        bare: D, the distance from what may be the body, as a smooth function.
        sigma: How far from a node a point is covered, pixels of that image.
    """

    camera: Camera
    points: Float[Tensor, "m 2"]
    weight: Float[Tensor, " m"]
    bare: SplineField
    sigma: float


@frozen
class SilhouetteTerm(Term):
    """The disagreement of the body with the silhouette. Lengths are for a person.

    Attributes:
        weight: Nats, for a body of which nothing is covered.
        sigma: How far from a node a point is covered, metres at the body's distance: of who is seen
            close the nodes are farther apart. Points feel nodes within three times as much.
        epsilon: The least that a point counts as covered.
        beta: How much a node that is far out counts against a point that nothing covers.
        reach: Distance from what may be the body beyond which a node is as far out as can be,
            metres likewise.
        near: Points farther than this from all poses before are no limbs, metres likewise.
        least: Ratio from which a pixel is of the silhouette; it is bare below.
        reduction: Pixels of the image, along each side, to one that is looked at.
        spacing: Distance of the points, as a share of sigma.
    """

    name = "silhouette"
    kind = "image"

    weight: float = 800.0
    sigma: float = 0.11
    epsilon: float = 0.01
    beta: float = 0.5
    reach: float = 0.28
    near: float = 0.7
    least: float = 0.3
    reduction: int = 4
    spacing: float = 0.5

    @property
    def needs(self) -> frozenset[Need]:
        """Colours, and what is behind them."""
        return frozenset(("appearance", "background"))

    def prepare(self, context: FrameContext) -> OnPoints | None:
        """Find the silhouette of a frame.

        None without a mask or a known background, or without a pose before it.
        """
        features, modes, body = context.features, context.modes, context.body
        nodes = context.tables.of(InteriorNodes)
        if features is None or modes is None or nodes.num_nodes == 0:
            return None
        foreground = None
        if features.mask is not None:
            foreground = 2 * features.mask - 1
        elif context.background is not None:
            seen = context.foreground(background=True)
            if seen is not None:
                foreground = seen[0].amax(0).masked_fill(~context.background.sure, torch.nan)
        if foreground is None:
            return None
        parts = part_map(
            body, modes[0], context.camera.scaled(1 / self.reduction), rings=6, meridians=10
        )
        images = self.images(
            foreground.to(body.tie),
            context.camera,
            nodes(body, body.pose(modes)).points.flatten(0, -2),
            float((parts >= 0).sum()) * self.reduction**2,
        )
        return self.bind(nodes, images)

    def bind(self, nodes: InteriorNodes, images: SilhouetteImages) -> OnPoints:
        """The term on a frame that `images` has prepared, and on nodes all over the body."""
        return OnPoints(
            term=self,
            find=lambda posed: posed.of(interior_nodes).points,
            image=images,
            camera=images.camera,
            link=nodes.node_link,
            scale=self.weight,
            size=math.ceil(nodes.num_nodes * len(images.points) / _PAIRS),
        )

    def images(
        self,
        ratio: Float[Tensor, "h w"],
        camera: Camera,
        expected: Float[Tensor, "p 3"],
        area: float,
    ) -> SilhouetteImages:
        """Prepare a frame.

        Args:
            ratio: How much more each pixel looks like the body than like what is behind it,
                -1..1; NaN where that is not known.
            camera: Camera of the image.
            expected: Nodes of the poses that the body may have had before, metres.
            area: Pixels that it covered.
        """
        small = camera.scaled(1 / self.reduction)
        width, height = small.image_size_wh
        # The border of odd sizes is shared out among the reduced pixels.
        degree, may_be = (
            functional.adaptive_avg_pool2d(part[None].to(expected), (height, width))[0]
            for part in (ratio.nan_to_num(0.0).clamp(min=0), ~(ratio <= self.least))
        )
        uv, depth, valid = small.project(expected)
        # Of a body that is all behind the camera nothing is seen, in whatever unit.
        metre = float(small.K[0, 0] / depth[valid].median()) if bool(valid.any()) else 1.0
        step = min(max(round(self.spacing * self.sigma * metre), 1), width, height)
        points, weight = self._points(degree, uv[valid], step, self.near * metre)
        full = area / (self.reduction * step) ** 2
        weight = weight / max(full, float(weight.sum()), _FEWEST_POINTS)
        bare = spline_field(self._distance(may_be >= 0.5, expected, self.reach * metre)[None])
        return SilhouetteImages(small, points, weight, bare, self.sigma * metre)

    def value(
        self, points: Points, camera: Camera, images: SilhouetteImages, at: Points | None = None
    ) -> Values:
        """Cost, shared out among the nodes: only the sum has a meaning.

        Args:
            points: Nodes of the posed body, metres.
            camera: Camera of the reduced image.
            images: What `images` made of the frame.
            at: Where the nodes have moved since; None: nowhere.
        """
        uv, _, valid = camera.project(points if at is None else at)
        _, covered, _ = self._cover(uv, valid, images)
        outside = self._outside(points) * valid * images.bare.value(uv)
        return outside + covered[..., None] / points.shape[-2]

    def point_cost(
        self,
        points: Points,
        camera: Camera,
        images: SilhouetteImages,
        *,
        gauss_newton: bool = False,
    ) -> PointCost:
        """The same with first and second derivatives in the nodes' positions.

        Args:
            points: Nodes of the posed body, metres.
            camera: Camera of the reduced image.
            images: What `images` made of the frame.
            gauss_newton: Leave the curvature of the projection out.
        """
        model = camera.project_with_derivatives(points)
        uv = model.uv
        share, covered, slope = self._cover(uv, model.valid, images)
        # Shares of a point's cost are springs to it: their stiffness, and their pull.
        ones = torch.ones_like(images.points[:, :1])
        targets = slope[..., None] * torch.cat([ones, images.points], dim=-1)
        springs = share @ targets
        stiffness = springs[..., 0]
        sample, outside = images.bare.sample(uv), self._outside(points) * model.valid
        gradient = uv * stiffness[..., None] - springs[..., 1:]
        gradient = gradient + outside[..., None] * sample.gradient
        hessian = torch.diag_embed(stiffness[..., None].expand(uv.shape))
        hessian = hessian + outside[..., None, None] * sample.hessian
        value = outside * sample.value + covered[..., None] / points.shape[-2]
        return camera.pull_back(model, value, gradient, hessian, gauss_newton=gauss_newton)

    def _outside(self, points: Tensor) -> Tensor:
        return points.new_tensor(self.beta / max(points.shape[-2], 1))

    def _cover(
        self, uv: Tensor, valid: Tensor, images: SilhouetteImages
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Share of each node in covering each point, the cost of all, and the points' slopes.

        The derivative of the cost by `uv` of node p is `sum_m share[p, m] slope[m] (uv - u_m)`.
        """
        scale = math.sqrt(2) * images.sigma
        # Where a node cannot be seen it is far away.
        node = torch.where(valid[..., None], uv / scale, 1e4)
        target = images.points / scale
        level = -node.square().sum(-1)[..., None] - target.square().sum(-1)
        share = (level + 2 * node @ target.mT).clamp(max=0).exp()
        missed = (-share.sum(-2)).exp()
        left = 1 + self.epsilon - missed
        unit = images.weight / math.log((1 + self.epsilon) / self.epsilon)
        covered = (unit * ((1 + self.epsilon) / left).log()).sum(-1)
        slope = unit * missed / left / images.sigma**2
        return share, covered, slope

    def _points(
        self, degree: Tensor, nodes: Tensor, step: int, near: float
    ) -> tuple[Tensor, Tensor]:
        """Points of the silhouette near any of some nodes, and how sure they are."""
        blocks = functional.avg_pool2d(degree[None], step, ceil_mode=True)[0]
        row, column = torch.nonzero(blocks > self.least, as_tuple=True)
        points = torch.stack([column, row], dim=-1).to(degree) * step + (step - 1) / 2
        close = (torch.cdist(points, nodes) < near).any(-1)
        return points[close], blocks[row, column][close]

    def _distance(self, free: Tensor, like: Tensor, reach: float) -> Tensor:
        """Distance from a mask along the farther axis, as a share of the reach, blurred."""
        from kornia.filters import gaussian_blur2d

        steps = min(max(round(reach), 1), max(free.shape))
        out = [~free]
        for _ in range(steps - 1):
            free = grow(free[None], 1)[0]
            out.append(~free)
        distance = torch.stack(out).to(like).mean(0)
        return gaussian_blur2d(distance[None, None], (5, 5), (1.0, 1.0), border_type="replicate")[
            0, 0
        ]
