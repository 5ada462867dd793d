"""Where the picture has carried the trunk: a prediction from the image instead of from the past.

A search looks about where a mode is expected, which is where it was, or where its own last motion
leads (`ConstantVelocity`). Who begins to turn is farther on by some degrees in every frame; the
costs hardly tell a trunk turned by ten degrees from another, so that the modes fall behind until
none can catch up. Here each mode's trunk, taken alone, is fitted before the search to what its
surface looked like in the frame before, from where its last motion leads:

    min_z  nats / sum_j w_j  sum_j e_j(z)  +  1/2 sum_i ((z_i - z'_i) / (s_i d_i))^2

over the parameters z of root and spine, with e_j and w_j the costs and weights of the nodes on the
trunk (`torchcss.cost.surface`), z' what the last motion leads to and d the motion expected in a
frame. Limbs, neck and head come along as they hang: what is small is soon off its nodes, and the
wall beside it stands still. The papers' trackers follow motion in the cost alone (section 3.1.2
[IJRR]); trackers of one mode that live on it are older (Bregler and Malik, 1998).

What to call: `SurfaceMotion(body)`, once; in every frame `SurfaceDynamics` are the dynamics of the
tracker.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcss.body.model import BodyModel
from torchcss.body.root import ROOT_NAMES, has_root
from torchcss.cost.anthropometric import proportion_columns
from torchcss.cost.interior import InteriorNodes
from torchcss.cost.surface import SurfaceTargets, SurfaceTerm, surface_targets
from torchcss.cost.visibility import facing_nodes, seen_nodes
from torchcss.inference.dynamics import Dynamics
from torchcss.inference.mixture import GaussianMixture
from torchcss.inference.trust_region import TrustRegionNewton
from torchcss.types import (
    Bounds,
    Curvature,
    Items,
    LocalModel,
    Numbers,
    PointCost,
    Vector,
    Vectors,
    frozen,
)
from torchcss.vision.camera import Camera
from torchcss.vision.spline import SplineField

_NATS = 30.0
"""What the surface weighs: nats per nu of mean cost per node seen."""

_SPREAD_POSITION = 0.5
_SPREAD_ANGLE = 6.0
"""s: how many times the motion expected in a frame the trunk may be off its last motion. A surface
that turns moves to the side as well; were positions as free as angles, half of a turn would be
taken for a step to the side."""

_FEW_NODES = 10.0
"""Nodes seen below which the surface weighs less."""


class PicturePair(NamedTuple):
    """What one camera has for the fit.

    Attributes:
        camera: The camera, at the size of the pictures.
        before: Local contrast of the frame before; None if there was no picture.
        now: Local contrast of this frame; None if there is no picture.
    """

    camera: Camera
    before: SplineField | None
    now: SplineField | None


class SurfaceMotion:
    """Fits the trunk of modes to where its surface has gone.

    Args:
        body: The body; later it may hang on another base.

    Attributes:
        columns: Parameters that are fitted.
        spread: s of each of them.
        nodes: Nodes on the body's surface.
        on_trunk: Those on the trunk.
        knows: Whether there is anything to fit: not of a body without root, sides or parts.
    """

    def __init__(self, body: BodyModel) -> None:
        self.columns, parts = trunk_of(body)
        steps = [name in ROOT_NAMES[:3] for name in body.state_names]
        free = torch.where(torch.tensor(steps), _SPREAD_POSITION, _SPREAD_ANGLE)
        self.spread = free.to(body.tie)[self.columns]
        self.nodes = InteriorNodes(body, rings=12, meridians=16)
        self.on_trunk = torch.nonzero(parts[self.nodes.node_part])[:, 0]
        self.knows = bool(len(self.columns)) and bool(len(self.on_trunk))

    def __call__(
        self,
        body: BodyModel,
        pairs: Sequence[PicturePair],
        *,
        before: Vectors,
        velocity: Vectors,
        expected: Vectors,
        deviation: Vector | None,
    ) -> Vectors:
        """Poses with the trunk where the pictures have carried it.

        Args:
            body: The body on this frame's base.
            pairs: What each camera has seen.
            before: The modes of the frame before.
            velocity: How far each goes on if it moves as it did into that frame.
            expected: Where they are expected in this frame.
            deviation: Motion expected in a frame; None: not known.

        Returns:
            The expected poses, the trunk moved; as they are without two pictures of one camera,
            without a motion that is expected, and for bodies without root, sides or parts.
        """
        columns = self.columns
        views = self.views(body, pairs, before) if self.knows else ()
        if not views or deviation is None:
            return expected
        lower, upper = (bound[columns].to(before) for bound in (body.lower, body.upper))
        start = (before + velocity)[:, columns].clamp(lower, upper)
        spread = self.spread.to(before) * deviation[columns].to(before)
        cost = SurfaceCost(
            body=body,
            nodes=self.nodes,
            chosen=self.on_trunk,
            views=views,
            columns=columns,
            held=expected,
            expected=start,
            deviation=spread,
        )
        found = TrustRegionNewton().minimise(cost, start, Bounds(lower, upper), scale=spread)
        return expected.index_copy(-1, columns, found.mean)

    def views(
        self, body: BodyModel, pairs: Sequence[PicturePair], before: Vectors
    ) -> tuple[SurfaceView, ...]:
        """What the cameras that have two pictures tell of the trunk.

        Args:
            body: The body on this frame's base.
            pairs: What each camera has seen.
            before: The modes of the frame before.
        """
        pose, part = body.pose(before), self.nodes.node_part[self.on_trunk]
        points, normals = (each[..., self.on_trunk, :] for each in self.nodes(body, pose))
        views = []
        for camera, last, now in pairs:
            if last is None or now is None:
                continue
            nodes = seen_nodes(body, pose, camera.centre_world, points, normals, part)
            views.append(SurfaceView(camera, now, surface_targets(nodes, camera, last)))
        return tuple(views)


@frozen
class SurfaceDynamics:
    """Dynamics of one frame: the trunk goes where the pictures have carried it.

    Modes spread, and all but their trunks move, as other dynamics say.

    Attributes:
        dynamics: The others.
        motion: Fits the trunk.
        body: The body on this frame's base.
        pairs: What each camera has seen.
        deviation: Motion expected in a frame; None: not known.
        intervals: How many usual intervals it comes after the one before it.
    """

    dynamics: Dynamics
    motion: SurfaceMotion
    body: BodyModel
    pairs: Sequence[PicturePair]
    deviation: Vector | None
    intervals: float = 1.0

    def over(self, intervals: float) -> SurfaceDynamics:
        """See `Dynamics.over`."""
        wider = None if self.deviation is None else math.sqrt(intervals) * self.deviation
        return replace(
            self, dynamics=self.dynamics.over(intervals), deviation=wider, intervals=intervals
        )

    def predict(self, mixture: GaussianMixture, velocity: Vectors) -> GaussianMixture:
        """Return the prior of the next frame.

        Args:
            mixture: Posterior of this frame.
            velocity: How far each mode moved in the last interval.
        """
        spread = self.dynamics.predict(mixture, velocity)
        mean = self.motion(
            self.body,
            self.pairs,
            before=mixture.mean,
            velocity=self.intervals * velocity,
            expected=spread.mean,
            deviation=self.deviation,
        )
        return spread._replace(mean=mean)


class SurfaceView(NamedTuple):
    """What one camera tells of the surface.

    Attributes:
        camera: The camera, at the size of the picture.
        contrast: Local contrast of this frame.
        targets: What the nodes of each item looked like in the frame before.
    """

    camera: Camera
    contrast: SplineField
    targets: SurfaceTargets


@frozen
class SurfaceCost:
    """The cost of the module's docstring, of some parameters; each item holds its others.

    Attributes:
        body: The body.
        nodes: Nodes on its surface.
        chosen: Those that are compared.
        views: What each camera tells.
        columns: The parameters.
        held: All parameters of each item; those of `columns` do not count.
        expected: Where the parameters are expected, z'.
        deviation: How far off they may be, s d.
        term: The cost of a node.
    """

    body: BodyModel
    nodes: InteriorNodes
    chosen: Int[Tensor, " p"]
    views: tuple[SurfaceView, ...]
    columns: Items
    held: Vectors
    expected: Float[Tensor, "b m"]
    deviation: Float[Tensor, " m"]
    term: SurfaceTerm = SurfaceTerm()

    def take(self, items: Items) -> SurfaceCost:
        """The cost restricted to some items."""
        views = (view._replace(targets=view.targets.take(items)) for view in self.views)
        held, expected = self.held[items], self.expected[items]
        return replace(self, views=tuple(views), held=held, expected=expected)

    def value(self, x: Float[Tensor, "b m"]) -> Numbers:
        """Cost, nats."""
        return self.local_model(x).value

    def local_model(self, x: Float[Tensor, "b m"]) -> LocalModel:
        """Cost, gradient and Gauss-Newton Hessian, facing held fixed."""
        pose = self.body.pose(self.held.index_copy(-1, self.columns, x))
        points, normals = (each[..., self.chosen, :] for each in self.nodes(self.body, pose))
        value, gradient, hessian = points.new_zeros(()), points.new_zeros(()), points.new_zeros(())
        for view in self.views:
            nodes = facing_nodes(points, normals, view.camera.centre_world)
            cost = self.term.point_cost(nodes, *view)
            share = _share(view.targets)
            value = value + share * cost.value
            gradient = gradient + share[..., None] * cost.gradient
            hessian = hessian + share[..., None, None] * cost.hessian
        lifted = self.body.lift(
            pose,
            points,
            self.nodes.node_link[self.chosen],
            PointCost(value, gradient, hessian),
            curvature=Curvature.GAUSS_NEWTON,
        )
        off, columns = (x - self.expected) / self.deviation, self.columns
        prior = torch.diag(self.deviation.square().reciprocal())
        return LocalModel(
            lifted.value + 0.5 * off.square().sum(-1),
            lifted.gradient[:, columns] + off / self.deviation,
            lifted.hessian[:, columns[:, None], columns] + prior,
        )


def _share(targets: SurfaceTargets) -> Float[Tensor, "b 1"]:
    """Nats per nu that each node weighs."""
    return _NATS / targets.weight.sum(-1, keepdim=True).clamp(min=_FEW_NODES)


def trunk_of(body: BodyModel) -> tuple[Items, Bool[Tensor, " parts"]]:
    """What limbs of both sides hang on: the parameters that move these, and the parts between.

    Neither has entries for a body without root, or without sides.

    Args:
        body: The body.
    """
    sides = [
        torch.tensor([name.startswith(side) for name in body.part_names], device=body.tie.device)
        for side in ("l_", "r_")
    ]
    # Which parameter moves which part.
    moves = (body.tie != 0).mT.double() @ body.tree.ancestors[:, body.part_link].double() > 0
    # Lengths move parts as well, but not in time.
    angles = torch.ones(len(moves), dtype=torch.bool, device=moves.device)
    angles[list(proportion_columns(body).values())] = False
    both = (moves & sides[0]).any(-1) & (moves & sides[1]).any(-1)
    shared = both & angles & has_root(body)
    parts = ~moves[angles & ~shared].any(0) & shared.any()
    return torch.nonzero(shared)[:, 0], parts
