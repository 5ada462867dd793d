"""Block-banded symmetric matrices over frames, and quadratics in a box with such a Hessian.

A chain of T states of n parameters, in which terms tie up to w neighbours, has a Hessian of T x T
blocks of which those within w - 1 of the diagonal are not zero. Everything here takes time linear
in T and cubic in n: the Cholesky factor, solutions, the diagonal blocks of the inverse, and the
minimum between bounds. `inference.chain` is what it is for.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcss.linalg import mask_free, multiply, solve_lower, symmetric_part
from torchcss.types import Matrices, Trajectory

_ROUNDS = 200
"""Sets of pinned variables tried; ten are many."""
_HALVINGS = 40
"""Of a step along the projected arc; after them it is shorter than the rounding."""


class Band(NamedTuple):
    """A symmetric block-banded matrix over frames.

    Attributes:
        block: `block[t, d]` is row t, column t - d; zero where that is before the first frame.
    """

    block: Float[Tensor, "t w n n"]

    def times(self, vector: Trajectory) -> Trajectory:
        """Matrix times vector."""
        out = multiply(self.block[:, 0], vector)
        for d in range(1, min(self.block.shape[1], len(vector))):
            lower = self.block[d:, d]
            out[d:] += multiply(lower, vector[:-d])
            out[:-d] += multiply(lower.mT, vector[d:])
        return out

    def plus_diagonal(self, diagonal: Float[Tensor, "*t n"] | float) -> Band:
        """With something added to the diagonal."""
        block = self.block.clone()
        torch.linalg.diagonal(block[:, 0]).add_(diagonal)
        return Band(block)

    def masked(self, free: Bool[Tensor, "t n"]) -> Band:
        """Rows and columns of variables that are not free replaced by those of the identity."""
        block = self.block.clone()
        block[:, 0] = mask_free(block[:, 0], free)
        for d in range(1, min(block.shape[1], len(block))):
            block[d:, d] *= (free[d:, :, None] & free[:-d, None, :]).to(block)
        return Band(block)

    def factor(self) -> BandFactor | None:
        """Block Cholesky factor; None where the matrix is not positive definite."""
        t, width = self.block.shape[:2]
        root = torch.zeros_like(self.block)
        for row in range(t):
            for d in range(min(width - 1, row), -1, -1):
                column, part = row - d, self.block[row, d]
                for e in range(d + 1, min(width - 1, row) + 1):
                    part = part - root[row, e] @ root[column, e - d].mT
                if d:
                    root[row, d] = torch.linalg.solve_triangular(
                        root[column, 0].mT, part, upper=True, left=False
                    )
                else:
                    root[row, 0], failed = torch.linalg.cholesky_ex(part)
                    if bool(failed) or not bool(root[row, 0].isfinite().all()):
                        return None
        return BandFactor(root)


class BandFactor(NamedTuple):
    """The lower block Cholesky factor of a `Band`, in the same layout."""

    block: Float[Tensor, "t w n n"]

    def solve(self, vector: Trajectory) -> Trajectory:
        """Inverse of the matrix times a vector."""
        t, width = self.block.shape[:2]
        out = [vector[0]] * t
        for row in range(t):
            part = vector[row]
            for d in range(1, min(width - 1, row) + 1):
                part = part - self.block[row, d] @ out[row - d]
            out[row] = solve_lower(self.block[row, 0], part)
        for row in reversed(range(t)):
            part = out[row]
            for d in range(1, min(width, t - row)):
                part = part - self.block[row + d, d].mT @ out[row + d]
            out[row] = torch.linalg.solve_triangular(
                self.block[row, 0].mT, part[:, None], upper=True
            )[:, 0]
        return torch.stack(out)

    def inverse_diagonal(self) -> Matrices:
        """Diagonal blocks of the inverse, from the last frame back.

        A vector e of unit variance gives `L^-T e`, whose covariance is the inverse: each frame is
        its own share minus the gains times the frames after it. Their covariance is carried along
        as a factor. (Takahashi's recursion carries the covariance itself, in half of the time; with
        accelerations it lost all digits within 40 frames.)
        """
        t, width = self.block.shape[:2]
        n = self.block.shape[-1]
        diagonal = [self.block[0, 0]] * t
        after = self.block.new_zeros(0, 0)
        for row in reversed(range(t)):
            root, below = self.block[row, 0], range(row + 1, min(row + width, t))
            eye = torch.eye(n, dtype=root.dtype, device=root.device)
            own = torch.linalg.solve_triangular(root.mT, eye, upper=True)
            if len(below):
                links = torch.cat([self.block[r, r - row] for r in below])
                gain = torch.linalg.solve_triangular(root, links, upper=False, left=False)
                known = after[: len(links)]
                own = torch.cat([own, -gain.mT @ known], dim=1)
                below_rows = torch.cat([known.new_zeros(len(known), n), known], dim=1)
                after = torch.cat([own, below_rows[: (width - 2) * n]])
            else:
                after = own
            diagonal[row] = own @ own.mT
            after = torch.linalg.qr(after.mT, mode="r").R.mT
        return symmetric_part(torch.stack(diagonal))


def least_in_box(
    band: Band, gradient: Tensor, lower: Tensor, upper: Tensor, held: Tensor
) -> Trajectory | None:
    """Minimise a quadratic in a box by projected Newton steps (Bertsekas 1982).

    Args:
        band: Second derivative, positive definite on the variables that are not held.
        gradient: Derivative at zero, which is inside the box.
        lower: Lower ends.
        upper: Upper ends.
        held: Variables that stay at zero.

    Returns:
        The minimiser; None if a matrix on the way was not definite in the numbers' precision.
    """
    step, value = torch.zeros_like(gradient), 0.0
    diagonal = torch.where(held, 1.0, torch.linalg.diagonal(band.block[:, 0]))
    size = float((torch.where(held, 0.0, gradient).square() / diagonal).sum())
    for _ in range(_ROUNDS):
        slope = gradient + band.times(step)
        pinned = held | ((step <= lower) & (slope > 0)) | ((step >= upper) & (slope < 0))
        factor = band.masked(~pinned).factor()
        if factor is None:
            return None
        full = -factor.solve(torch.where(pinned, 0.0, slope))
        full = torch.where(pinned, 0.0, full)
        promise = -float((full * slope).sum())
        if not promise > 1e-14 * size:
            break
        length = 1.0
        for _ in range(_HALVINGS):
            trial = torch.minimum(torch.maximum(step + length * full, lower), upper)
            after = float((trial * (gradient + 0.5 * band.times(trial))).sum())
            if value - after > 1e-4 * float(((step - trial) * slope).sum().clamp(min=0)):
                break
            length *= 0.5
        else:
            break
        step, value = trial, after
    return step
