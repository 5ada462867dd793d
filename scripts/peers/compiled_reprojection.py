"""The study problem's cost in compiled kernels: the same numbers many times faster, on a CPU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from peers.reprojection_kernel import Reprojection, Scratch, add_reprojection
from torch import Tensor

from torchcss.cost.fused.pack import array, carried_markers, pack_potential, pack_tree
from torchcss.cost.fused.records import Array, Points, Result, Tree
from torchcss.errors import ConfigurationError, check_shape
from torchcss.kernels.checked import run
from torchcss.studies.reprojection import ReprojectionCost
from torchcss.types import BlendedCost, LocalModel, Numbers, Vectors


@dataclass(frozen=True)
class CompiledReprojection(BlendedCost):
    """A `ReprojectionCost` that is evaluated by compiled kernels.

    In double precision, one state after the other: no result depends on the batch.

    Attributes:
        tree: The body's tree before the camera.
        seen: What it is compared with.
    """

    tree: Tree
    seen: Reprojection

    @staticmethod
    def of(cost: ReprojectionCost) -> CompiledReprojection:
        """Pack a cost.

        Raises:
            ConfigurationError: If its potential has no compiled twin.
        """
        body, camera, noise = cost.body, cost.camera, cost.pixel_noise
        potential = pack_potential(cost.potential)
        if potential is None:
            raise ConfigurationError(f"{type(cost.potential).__name__} has no compiled twin")
        row, place = carried_markers(body, cost.index)
        seen = Reprojection(
            row=row,
            place=place,
            shift=array((camera.K[:2, 2] - cost.target) / noise),
            focal=np.array(cost.focal),
            far=np.array(camera.image_size_wh) / noise,
            near=float(camera.near),
            potential=potential,
            mean=array(body.sticky_mean),
            sharpness=1 / array(body.sticky_deviation),
            nu=cost.nu,
        )
        return CompiledReprojection(pack_tree(body, camera), seen)

    def take(self, items: Tensor) -> CompiledReprojection:
        """The cost restricted to some samples: the same for all of them."""
        return self

    def value(self, x: Vectors) -> Numbers:
        """Cost in nats."""
        return self._evaluated(x, None, 0).value

    def local_model(self, x: Vectors) -> LocalModel:
        """Cost, gradient and exact Hessian."""
        return self._evaluated(x, None, x.shape[-1])

    def blended_model(self, x: Vectors, share: Numbers) -> LocalModel:
        """See `ReprojectionCost.blended_model`."""
        return self._evaluated(x, share, x.shape[-1])

    def _evaluated(self, x: Tensor, share: Tensor | None, size: int) -> LocalModel:
        check_shape("x", x, len(self.seen.mean))
        batch, number = x.shape[:-1], x.shape[:-1].numel()
        shares = np.ones(number) if share is None else array(share.reshape(number))
        result = Result(np.zeros(number), np.zeros((number, size)), np.zeros((number, size, size)))
        states = array(x.reshape(number, -1))
        run(add_reprojection, states, shares, self.tree, self.seen, self._scratch(), result)
        value, gradient, hessian = map(torch.from_numpy, result)
        return LocalModel(
            value.reshape(batch),
            gradient.reshape(*batch, size),
            hessian.reshape(*batch, size, size),
        )

    def _scratch(self) -> Scratch:
        joints, points = len(self.tree.parent), len(self.seen.row)
        columns: list[Array] = [np.zeros(points) for _ in Points._fields[:-1]]
        return Scratch(
            frames=np.zeros((1 + joints, 3, 4)),
            points=Points(*columns, first=np.zeros(1, np.int64)),
            sums=np.zeros((1 + joints, 33)),
            twists=np.zeros((joints, 6)),
            reference=np.zeros(3),
        )
