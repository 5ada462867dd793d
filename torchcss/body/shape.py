"""Shape parameters of a body as extra columns of the state: `x_d` of section 2 [IJRR].

While a body is fitted, shape numbers of its parts (`torchcss.body.surface`) become parameters too,
left and right tied, as mirror images: a part's numbers are `s = s0 + T z` with z the shape
parameters. They deform points inside a link, `p(x, z) = R_l(x) u(s) + t_l(x)`, with u the point's
map in its part's frame, angles (eta, omega) held. With g and A the derivatives of a point's cost,
`w_k = R_l du/ds_k`, and `S_j = (omega_j, v_j)` the twist of a joint above the point, the new
columns are

    gradient_k = sum g . w_k
    hessian_kl = sum w_k . A w_l + g . R_l d2u/ds_k ds_l
    hessian_jk = S_j . ( sum p x A w_k + w_k x g,  sum A w_k )

the last because `d2p/dx_j ds_k = omega_j x w_k`. Sums run over the points of one part, so that the
work over points is one 6-vector per part and shape number, as in `torchcss.body.lift`.

Derivatives of u come from autograd on the nine numbers of one point, by forward differentiation of
`surface_points` (closed forms of a bent, tapered superquadric fill pages), and are exact.

`ShapeParameters(body)` names the parameters; `with_shape` gives a body its numbers;
`lift_with_shape` is the lift with the new columns.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcss.body.catalog import without_side
from torchcss.body.lift import wrench
from torchcss.body.model import BodyModel, BodyPose
from torchcss.body.surface import SHAPE_NAMES, straighten, surface_points
from torchcss.types import Bounds, LocalModel, Numbers, PointCost

CROSS_SECTIONS = ("a1", "a2", "taper_x", "taper_y")
"""The volumetric numbers of the second stage: cross-sections and their tapers."""

WHOLE_SHAPE = ("a1", "a2", "a3", "e1", "e2", "taper_x", "taper_y")
"""The numbers of the third stage; the papers' has the bend, too, which is all of `SHAPE_NAMES`."""

_RANGE = {"a1": 0.35, "a2": 0.35, "a3": 0.15, "e1": 0.3, "e2": 0.3, "taper_x": 0.3, "taper_y": 0.3,
          "bend_x": 3.0, "bend_y": 3.0}  # fmt: skip
"""How far a number may go from the catalogue's: semi-axes by a share of it, others by an amount."""


COMMON_THICKNESS = 0.2
"""Relative deviation that the cross-sections of one body share: stout, slim, or in a coat."""


class ShapeParameters:
    """Which shape numbers of a body are free, left and right tied.

    Args:
        body: The body.
        numbers: Which of `SHAPE_NAMES` are free.

    Attributes:
        names: `thigh_a1` and so on, without side.
        tie: `T`: from the parameters to all shape numbers, parts one after another.
        rest: `s0`, the body's own numbers.
        bounds: Limits on the parameters, which are offsets from the body's numbers.
        precision: Inverse covariance of the prior: independent deviations of half of the range,
            and one common factor of `COMMON_THICKNESS` on all cross-sections. Without it, that all
            parts look thick would be strong evidence that the whole person is small and near.
    """

    def __init__(self, body: BodyModel, numbers: tuple[str, ...] = CROSS_SECTIONS) -> None:
        names: list[str] = []
        rows: list[tuple[int, int]] = []
        spans: list[Tensor] = []
        for part, part_name in enumerate(body.part_names):
            bare = without_side(part_name)
            for number in numbers:
                k, name = SHAPE_NAMES.index(number), f"{bare}_{number}"
                if name not in names:
                    names.append(name)
                    size = body.part_shape[part, k].abs() if number in ("a1", "a2", "a3") else 1.0
                    spans.append(body.part_shape.new_tensor(_RANGE[number]) * size)
                rows.append((9 * part + k, names.index(name)))
        self.names = tuple(names)
        tie = body.part_shape.new_zeros(9 * body.num_parts, len(names))
        signs = _signs_of_mirrored_bends(body)
        for row, column in rows:
            tie[row, column] = signs.get(row, 1.0)
        self.tie: Float[Tensor, "s z"] = tie
        self.rest: Float[Tensor, "parts 9"] = body.part_shape.clone()
        span = torch.stack(spans) if spans else body.part_shape.new_zeros(0)
        self.bounds = Bounds(-span, span)
        thick = (
            COMMON_THICKNESS
            / (0.5 * _RANGE["a1"])
            * body.part_shape.new_tensor([name.endswith(("_a1", "_a2")) for name in names])
        )
        # Sherman and Morrison, in units of the deviations.
        factor = torch.eye(len(names)).to(thick) - thick[:, None] * thick / (1 + thick @ thick)
        own = 2 / span
        self.precision: Float[Tensor, "z z"] = own[:, None] * factor * own

    def shape(self, z: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch parts 9"]:
        """The shape numbers of all parts."""
        return self.rest + (z @ self.tie.T).unflatten(-1, self.rest.shape)


def _signs_of_mirrored_bends(body: BodyModel) -> dict[int, float]:
    """Which bends of a part turn round in the mirror image of its other side's, by their number."""
    turns, centres = body.part_poses(body.pose(body.rest))
    first: dict[str, int] = {}
    signs: dict[int, float] = {}
    for part, name in enumerate(body.part_names):
        other = first.setdefault(without_side(name), part)
        across = centres[part] - centres[other]
        if other == part or not float(length := across.norm()):
            continue
        across = across / length
        mirror = torch.eye(3).to(across) - 2 * torch.outer(across, across)
        kept = (turns[part].mT @ mirror @ turns[other]).diagonal()
        signs |= {9 * part + 7 + axis: 1.0 if kept[axis] > 0 else -1.0 for axis in (0, 1)}
    return signs


def with_shape(body: BodyModel, shape: Float[Tensor, "parts 9"]) -> BodyModel:
    """The same body with other shape numbers; everything else is shared."""
    other = copy.copy(body)
    other._buffers = {**body._buffers, "part_shape": shape.to(body.tie)}
    return other


class ShapeDerivatives(NamedTuple):
    """Derivatives of surface points, in their part's frame, in the nine shape numbers.

    Attributes:
        first: First derivatives of the points.
        second: Second derivatives of the points along the directions that were given.
    """

    first: Float[Tensor, "p 3 9"]
    second: Float[Tensor, "p 9 9"]


def surface_derivatives(
    shape: Float[Tensor, "p 9"],
    eta: Float[Tensor, " p"],
    omega: Float[Tensor, " p"],
    along: Float[Tensor, "p 3"],
) -> ShapeDerivatives:
    """Exact derivatives of surface points at held angles in the shape numbers.

    Args:
        shape: The shape numbers of each point's part.
        eta: Latitudes.
        omega: Longitudes.
        along: Directions in the part's frame whose second derivatives are wanted.
    """
    numbers = shape.shape[-1]
    with torch.enable_grad():
        # A copy of the points for every number: one pass instead of nine small ones. Of each copy
        # the last pass takes another row of the Hessian.
        s = shape.detach().repeat(numbers, 1).requires_grad_()
        points = surface_points(s, eta.detach().repeat(numbers), omega.detach().repeat(numbers))[0]
        first = [
            torch.autograd.grad(points[: len(shape), axis].sum(), s, retain_graph=True)[0]
            for axis in range(3)
        ]
        moved = (points * along.detach().repeat(numbers, 1)).sum()
        (slope,) = torch.autograd.grad(moved, s, create_graph=True)
        rows = slope.unflatten(0, (numbers, -1)).diagonal(dim1=0, dim2=2)
        (second,) = torch.autograd.grad(rows.sum(), s)
    return ShapeDerivatives(
        torch.stack([slope[: len(shape)] for slope in first], dim=-2),
        second.unflatten(0, (numbers, -1)).movedim(0, 1),
    )


def surface_angles(
    shape: Float[Tensor, "*batch 9"], points: Float[Tensor, "*batch 3"]
) -> tuple[Numbers, Numbers]:
    """Latitude and longitude of surface points: the inverse of `surface_points`.

    For points off the surface they are those of a point of the surface nearby.

    Args:
        shape: The shape numbers of each point's part.
        points: In the part's frame, metres.
    """
    a1, a2, a3, e1, e2 = shape[..., :5].unbind(-1)
    x, y, z = straighten(shape, points).unbind(-1)

    def root(value: Tensor, exponent: Tensor) -> Tensor:
        return value.sign() * value.abs() ** (1 / exponent)

    omega = torch.atan2(root(y / a2, e2), root(x / a1, e2))
    # cos(eta) from the section that is at hand: the radius along this longitude.
    section = (x / a1).abs() ** (2 / e2) + (y / a2).abs() ** (2 / e2)
    return torch.atan2(root(z / a3, e1), section ** (e2 / 2 / e1)), omega


def lift_with_shape(
    body: BodyModel,
    pose: BodyPose,
    points: Float[Tensor, "p 3"],
    point_part: Int[Tensor, " p"],
    angles: tuple[Float[Tensor, " p"], Float[Tensor, " p"]],
    cost: PointCost,
    parameters: ShapeParameters,
) -> LocalModel:
    """Sum a cost over surface points of one pose and differentiate it in pose and shape.

    Args:
        body: The body with its present shape numbers.
        pose: The pose at which the cost was evaluated, without batch dimension.
        points: World positions, metres.
        point_part: The part of each point.
        angles: Latitude and longitude of each point on its part.
        cost: Value, gradient and Hessian of each point's cost in its world position.
        parameters: Which shape numbers are free.

    Returns:
        Value, gradient `[n + z]` and Hessian: state first, then shape parameters.
    """
    by_state = body.lift(pose, points, body.part_link[point_part], cost)
    turn = body.part_poses(pose)[0][point_part]
    pull = (turn.mT @ cost.gradient[..., None])[..., 0]
    local = surface_derivatives(body.part_shape[point_part], *angles, pull)
    w = turn @ local.first  # p 3 9
    force = cost.hessian @ w
    # How gradient, wrench and cost of the points change with the shape numbers of their part.
    slope = (cost.gradient[..., None] * w).sum(-2)
    square = w.mT @ force + local.second
    six = wrench(points[..., None].expand_as(force), force)
    six = six + wrench(w, cost.gradient[..., None].expand_as(w), couple=True)
    slope, square, six = (
        each.new_zeros(body.num_parts, *each.shape[1:]).index_add(0, point_part, each)
        for each in (slope, square, six)
    )
    twist = torch.cat([pose.tree.omega, pose.tree.velocity], dim=-1)  # q 6
    above = body.tree.ancestors[:, body.part_link].to(twist)  # q parts
    mixed = torch.einsum("qi,pik,qp->qpk", twist, six, above).flatten(-2)
    mixed = body.tie.T @ mixed @ parameters.tie
    by_shape = parameters.tie.T @ torch.block_diag(*square) @ parameters.tie
    rows = (torch.cat([by_state.hessian, mixed], dim=1), torch.cat([mixed.T, by_shape], dim=1))
    gradient = torch.cat([by_state.gradient, slope.flatten() @ parameters.tie])
    return LocalModel(by_state.value, gradient, torch.cat(rows))
