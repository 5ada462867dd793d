"""Points of the body against known places, in double precision; the twin of `cost.targets`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from torchcss.cost.fused import pack
from torchcss.cost.fused.kinematics import find_twists, pose_tree
from torchcss.cost.fused.lift import lift, sum_points
from torchcss.cost.fused.priors import long_tails
from torchcss.cost.fused.records import Array, LongTails, Result, Targets, TargetScratch, Tree
from torchcss.cost.fused.view import choose_reference
from torchcss.cost.targets import PointTargets
from torchcss.errors import ConfigurationError
from torchcss.kernels.checked import run
from torchcss.kernels.compiler import entry
from torchcss.types import Items, LocalModel, Numbers, Vectors


@dataclass(frozen=True)
class FusedTargets:
    """The cost of whole states in one compiled call; a `CostFunction`.

    Attributes:
        tree: The body's tree in the world.
        points: The points and their places.
        tails: The stabilisers, if any.
        scratch: Memory for what is found on the way.
    """

    tree: Tree
    points: Targets
    tails: LongTails
    scratch: TargetScratch

    @staticmethod
    def of(targets: PointTargets) -> FusedTargets:
        """The twin of a cost.

        Raises:
            ConfigurationError: If that is of some columns of the state, or has repulsion.
        """
        if targets.columns is not None or targets.repulsion is not None:
            raise ConfigurationError("FusedTargets: expected whole states, and no repulsion")
        return FusedTargets(*pack.pack_targets(targets))

    def take(self, items: Items) -> FusedTargets:
        """See `PointTargets.take`."""
        place = self.points.place
        if len(place) == 1:
            return self
        return replace(self, points=self.points._replace(place=place[items.numpy()]))

    def value(self, x: Vectors) -> Numbers:
        """See `PointTargets.value`."""
        return self.local_model(x).value

    def local_model(self, x: Vectors) -> LocalModel:
        """See `PointTargets.local_model`."""
        size, n = x.shape
        result = Result(np.zeros(size), np.zeros((size, n)), np.zeros((size, n, n)))
        packed = self.tree, self.points, self.tails, self.scratch
        run(add_targets, pack.array(x), *packed, result)
        return LocalModel(*(torch.from_numpy(part).to(x) for part in result))


@entry
def add_targets(
    x: Array,
    tree: Tree,
    targets: Targets,
    tails: LongTails,
    scratch: TargetScratch,
    result: Result,
) -> None:
    """Add what points of a body cost away from their places, and the stabilisers.

    Args:
        x: The states, `[b n]`.
        tree: The body's tree in the world.
        targets: The points and their places.
        tails: The stabilisers, if any.
        scratch: Memory for what is found on the way.
        result: Where it is added.
    """
    points = scratch.points
    for b in range(len(x)):
        places = targets.place[b if len(targets.place) > 1 else 0]
        pose_tree(x[b], tree, scratch.frames)
        choose_reference(scratch.frames, scratch.reference)
        scratch.sums[:] = 0.0
        for i in range(len(targets.row)):
            frame, own = scratch.frames[targets.row[i]], targets.own[i]
            place, stiffness = places[i], targets.stiffness[i]
            k, m, n = own[0], own[1], own[2]
            px = frame[0, 0] * k + frame[0, 1] * m + frame[0, 2] * n + frame[0, 3]
            py = frame[1, 0] * k + frame[1, 1] * m + frame[1, 2] * n + frame[1, 3]
            pz = frame[2, 0] * k + frame[2, 1] * m + frame[2, 2] * n + frame[2, 3]
            u, v, w = px - place[0], py - place[1], pz - place[2]
            result.value[b] += 0.5 * stiffness * (u * u + v * v + w * w)
            points.x[i], points.y[i], points.z[i] = px, py, pz
            points.gx[i], points.gy[i], points.gz[i] = stiffness * u, stiffness * v, stiffness * w
            points.xx[i], points.yy[i], points.zz[i] = stiffness, stiffness, stiffness
            sum_points(points, i, i + 1, scratch.reference, scratch.sums[targets.row[i]])
        find_twists(scratch.frames, tree, scratch.reference, scratch.twists)
        gradient, hessian = result.gradient[b], result.hessian[b]
        lift(tree, scratch.sums, scratch.twists, 1.0, gradient, hessian)
        result.value[b] += long_tails(x[b], 0, tails, gradient, hessian)
